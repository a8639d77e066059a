"""Fast point feature histograms of oriented points (Rusu, Blodow and Beetz 2009): what a matched pair of rooms is aligned by."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import Array

BINS = 11  # of each of the three angles


def fpfh(points: Array, normals: Array, radius: float) -> Array:
    """(N, 33) float64 histograms, each third sums to 100; 0 where a point has no neighbour.

    Args:
        points: (N, 3) m.
        normals: (N, 3) unit vectors, pointing to the same side (into the room).
        radius: of the neighbourhood, m.
    """
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray") if len(points) else np.zeros((0, 2), np.int64)
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T  # each pair is seen from both ends
    gap = points[other] - points[one]
    apart = np.linalg.norm(gap, axis=1)
    kept = apart > 1e-9
    one, other, gap, apart = one[kept], other[kept], gap[kept], apart[kept]
    simple = _simple(normals[one], normals[other], gap / apart[:, None], one, len(points))
    many = np.maximum(np.bincount(one, minlength=len(points)), 1)
    near = np.zeros_like(simple)
    for column in range(simple.shape[1]):
        near[:, column] = np.bincount(one, simple[other, column] / apart, len(points))
    full = simple + near / many[:, None]
    parts = full.reshape(len(points), 3, BINS)
    out: Array = (100 * parts / np.maximum(parts.sum(axis=2, keepdims=True), 1e-12)).reshape(len(points), 3 * BINS)
    return out


def _simple(normal: Array, other: Array, towards: Array, owner: Array, count: int) -> Array:
    """(count, 33): of each point, how the three angles of the Darboux frames with its neighbours are spread, as shares."""
    across = np.cross(normal, towards)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    third = np.cross(normal, across)
    alpha = (across * other).sum(axis=1)
    phi = (normal * towards).sum(axis=1)
    theta = np.arctan2((third * other).sum(axis=1), (normal * other).sum(axis=1)) / np.pi
    angles = np.stack([alpha, phi, theta], axis=1)  # each in [-1, 1]
    bins = np.clip(((angles + 1) / 2 * BINS).astype(np.int64), 0, BINS - 1) + np.arange(3) * BINS
    flat = np.bincount((owner[:, None] * 3 * BINS + bins).ravel(), minlength=count * 3 * BINS)
    many = np.maximum(np.bincount(owner, minlength=count), 1)
    out: Array = flat.reshape(count, 3 * BINS) / many[:, None]
    return out
