"""Fast point feature histograms of oriented points (Rusu, Blodow and Beetz 2009): what a matched pair of rooms is aligned by."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import Array

ANGLE_BINS = 11  # of each of the three angles


def fpfh(points: Array, normals: Array, radius: float) -> Array:
    """(N, 33) float64 histograms, each third sums to 100; 0 where a point has no neighbour.

    Args:
        points: (N, 3) m.
        normals: (N, 3) unit vectors, pointing to the same side (into the room).
        radius: of the neighbourhood, m.
    """
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray") if len(points) else np.zeros((0, 2), np.int64)
    point, neighbour = np.concatenate([pairs, pairs[:, ::-1]]).T  # each pair is seen from both ends
    gap = points[neighbour] - points[point]
    distance = np.linalg.norm(gap, axis=1)
    distinct = distance > 1e-9
    point, neighbour, gap, distance = point[distinct], neighbour[distinct], gap[distinct], distance[distinct]
    simple = _simple_histograms(normals[point], normals[neighbour], gap / distance[:, None], point, len(points))
    neighbours = np.maximum(np.bincount(point, minlength=len(points)), 1)
    around = np.zeros_like(simple)
    for column in range(simple.shape[1]):
        around[:, column] = np.bincount(point, simple[neighbour, column] / distance, len(points))
    thirds = (simple + around / neighbours[:, None]).reshape(len(points), 3, ANGLE_BINS)
    histograms: Array = 100 * thirds / np.maximum(thirds.sum(axis=2, keepdims=True), 1e-12)
    return histograms.reshape(len(points), 3 * ANGLE_BINS)


def _simple_histograms(normal: Array, other: Array, towards: Array, point: Array, count: int) -> Array:
    """(count, 33): of each point, how the three angles of the Darboux frames with its neighbours are spread, as shares.

    Args:
        normal, other: (P, 3) of the point and of its neighbour, of each pair.
        towards: (P, 3) unit vector from the point to the neighbour.
        point: (P,) row of the point.
    """
    across = np.cross(normal, towards)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    third = np.cross(normal, across)
    alpha = (across * other).sum(axis=1)
    phi = (normal * towards).sum(axis=1)
    theta = np.arctan2((third * other).sum(axis=1), (normal * other).sum(axis=1)) / np.pi
    angles = np.stack([alpha, phi, theta], axis=1)  # each in [-1, 1]
    bins = np.clip(((angles + 1) / 2 * ANGLE_BINS).astype(np.int64), 0, ANGLE_BINS - 1) + np.arange(3) * ANGLE_BINS
    flat = np.bincount((point[:, None] * 3 * ANGLE_BINS + bins).ravel(), minlength=count * 3 * ANGLE_BINS)
    neighbours = np.maximum(np.bincount(point, minlength=count), 1)
    histograms: Array = flat.reshape(count, 3 * ANGLE_BINS) / neighbours[:, None]
    return histograms
