"""The thesis' descriptors of a room, of the points that a network sees: the same while training and when a map is embedded.

`embedding.engineered` and `embedding.shapedna` look at all cells of a map. Training sets keep 512 points a room
(`graph.room_points`), hence these two.
"""

from __future__ import annotations

import numpy as np

from topomerge.embedding.engineered import thesis_features
from topomerge.embedding.laplacian import smallest_eigenvalues, surface_laplacian
from topomerge.embedding.schema import SPECTRUM_FEATURES, THESIS_FEATURES
from topomerge.embedding.shapedna import SHAPE_LEAST_CELLS, thinned
from topomerge.types import Array

SAMPLED_POINTS = 256  # points: eigenvalues of more cost too much for tens of thousands of rooms
FEATURE_CELL = 0.05  # m: points are put into cells of this size; in cells of 0.1 m they would lie on borders
SPECTRUM_SPACING = 0.251  # m: cells lie 0.1 m apart, and with 0.25 m every fifth one would fall on a border


def point_features(points: Array) -> Array:
    """(R, 12) float32 `THESIS_FEATURES` of points (R, P, 3), m. The first one counts different points: it stops at 256."""
    out = np.zeros((len(points), len(THESIS_FEATURES)), np.float32)
    for room, sample in enumerate(_samples(points)):
        out[room] = thesis_features(_cells(sample), FEATURE_CELL)
    return out


def point_spectra(points: Array) -> Array:
    """(R, 32) float32 smallest eigenvalues above 0, 1/m2, of the surface that points (R, P, 3), m, lie on; ascending."""
    out = np.zeros((len(points), len(SPECTRUM_FEATURES)), np.float32)
    for room, sample in enumerate(_samples(points)):
        different = np.unique(np.round(sample.astype(np.float64), 3), axis=0)
        if len(different) < SHAPE_LEAST_CELLS:
            continue
        values = smallest_eigenvalues(surface_laplacian(thinned(different, SPECTRUM_SPACING)), len(SPECTRUM_FEATURES))
        if len(values):
            number = np.arange(1, len(values) + 1)
            slope = (values @ number) / (number @ number)  # Weyl's law for those that are too many for so few points
            rest = np.maximum(slope * np.arange(len(values) + 1, len(SPECTRUM_FEATURES) + 1), values[-1])
            out[room] = np.concatenate([values, rest])
    return out


def _samples(points: Array) -> Array:
    """Evenly spread over the points, which are in the order of their place."""
    return points[:, np.linspace(0, points.shape[1] - 1, min(SAMPLED_POINTS, points.shape[1])).astype(int)]


def _cells(points: Array) -> Array:
    """(n, 3) int64 different cells, of which the lowest corner is 0."""
    away = points.astype(np.float64) - points.min(axis=0)
    return np.unique(np.floor(away / FEATURE_CELL + 0.5).astype(np.int64), axis=0)
