"""Engineered features of a room: the twelve of the thesis, and its place in the graph (seeds 3.1.1; method 3).

Lengths are metres and nothing depends on the frame. Sizes are taken as logarithms, then all is scaled by statistics of a training
set, which stand in `engineered.json` (made by ``train.py task=feature_scale``): either every feature by its spread over
rooms (``"standard"``), or all of them by how much they differ between two maps' views of one room (``"matched"``: features that
a partial view changes count less).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from topomerge.embedding.room_cells import Descriptor, room_cells, rows_of
from topomerge.embedding.schema import THESIS_FEATURES
from topomerge.errors import InputError
from topomerge.io.weight_files import read_weights_json
from topomerge.types import Array, TopometricMap

GRAPH_FEATURES = (
    "area",  # log of 1 + m2 of floor
    "clear_height",  # m, floor to ceiling; that of the map's median room where none was seen
    "degree",  # log of 1 + rooms that one can walk to
    "doors",  # log of 1 + doors and openings
    "area_share",  # log of the room's area over the mean of its storey
    "step",  # m, of its floor above that of its storey
)
FEATURES = (*THESIS_FEATURES, *GRAPH_FEATURES)
SCALINGS = ("matched", "standard", "none")
PLANE_NEIGHBOURS = 32
ROUGHNESS_CELLS = 500  # cells of a room whose roughness is measured


def engineered(features: str = "all", scaling: str = "matched") -> Descriptor:
    """The descriptor: (R, 18) float64, or (R, 12) with ``features="thesis"``.

    Raises:
        InputError: unknown features or scaling.
    """
    if features not in ("all", "thesis"):
        raise InputError(f"features {features!r}: all, thesis are possible")
    if scaling not in SCALINGS:
        raise InputError(f"scaling {scaling!r}: {', '.join(SCALINGS)} are possible")
    chosen = len(FEATURES) if features == "all" else len(THESIS_FEATURES)

    def describe(map: TopometricMap) -> Array:
        return scaled(raw_features(map)[:, :chosen], scaling)

    return describe


def raw_features(map: TopometricMap) -> Array:
    """(R, 18) float64 in the order of `FEATURES`, not scaled."""
    geometry = [thesis_features(cells, map.grid.edge) for cells in room_cells(map)]
    return np.concatenate([np.array(geometry).reshape(-1, len(THESIS_FEATURES)), _graph_features(map)], axis=1)


def scaled(values: Array, scaling: str) -> Array:
    """Features scaled by the statistics of the training set: columns are the first of `FEATURES`."""
    if scaling == "none":
        return values
    mean, spread, differences = _statistics()
    n = values.shape[1]
    if scaling == "standard":
        return (values - mean[:n]) / spread[:n]
    root = np.linalg.cholesky(np.linalg.inv(differences[:n, :n]))
    out: Array = (values - mean[:n]) @ root
    return out


def _statistics() -> tuple[Array, Array, Array]:
    """Mean (D,), standard deviation (D,) and covariance (D, D) of the differences between two views of a room."""
    scale = read_weights_json("topomerge.embedding", "engineered.json")
    if tuple(scale["features"]) != FEATURES:
        raise InputError("engineered.json is of other features: run train.py task=feature_scale export=package")
    return np.array(scale["mean"]), np.array(scale["spread"]), np.array(scale["differences"])


def thesis_features(cells: Array, edge: float) -> Array:
    """(12,) float64 in the order of `THESIS_FEATURES` of one room's cells (n, 3) of edge length `edge`, m."""
    points = (cells + 0.5) * edge
    if not len(points):
        return np.zeros(len(THESIS_FEATURES))
    away = points - points.mean(axis=0)
    values, axes = np.linalg.eigh(away.T @ away / len(points))
    values = np.maximum(values[::-1], 0.0)
    s1, s2, s3 = np.sqrt(values) + 1e-9
    wide = np.unique(cells[:, 0].astype(np.int64) << 32 | cells[:, 1])
    columns = np.stack([wide >> 32, wide & 0xFFFFFFFF], axis=1)
    height = float(np.ptp(cells[:, 2]) + 1) * edge
    return np.array(
        [
            np.log1p(len(cells) * edge**2),
            (s2 - s3) / s1,
            np.log1p(_smallest_rectangle(columns) * edge**2 * height),
            height,
            np.log1p(len(columns) * edge**2),
            np.linalg.norm(away, axis=1).mean(),
            values[2] / max(values[0], 1e-12),
            s3,
            s3 / (s1 + s2),
            s2 / s1,
            abs(axes[2, 2]),
            roughness(points),
        ]
    )


def _smallest_rectangle(columns: Array) -> float:
    """Area, in cells, of the smallest rectangle about columns (n, 2)."""
    first = np.flatnonzero(np.diff(columns[:, 0], prepend=-1))  # columns ascend: of each row only the ends can be corners
    ends = columns[np.concatenate([first, np.append(first[1:], len(columns)) - 1])]
    corners = (ends[:, None] + np.array([(0, 0), (1, 0), (0, 1), (1, 1)])[None]).reshape(-1, 2).astype(float)
    hull = corners[ConvexHull(corners).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    extents = [np.ptp(hull @ np.array([(c, -s), (s, c)]), axis=0) for c, s in along]
    return float(min(np.prod(e) for e in extents))


def roughness(points: Array) -> float:
    """Mean distance (m) of points (n, 3) to the plane of their 32 nearest; of at most 500 of them, evenly spread."""
    if len(points) < 4:
        return 0.0
    sample = points[np.linspace(0, len(points) - 1, min(ROUGHNESS_CELLS, len(points))).astype(int)]
    _, near = cKDTree(points).query(sample, min(PLANE_NEIGHBOURS, len(points)))
    around = points[near]
    middle = around.mean(axis=1, keepdims=True)
    away = around - middle
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    return float(np.abs(np.einsum("ni,ni->n", sample - middle[:, 0], axes[:, :, 0])).mean())


def _graph_features(map: TopometricMap) -> Array:
    """(R, 6) float64 in the order of `GRAPH_FEATURES`."""
    rooms, edges, count = map.rooms, map.open_edges, len(map.rooms)
    ends = edges["rooms"].reshape(-1, 2)
    pairs = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    flat = np.isin(edges["kind"], ("door", "opening"))
    seen = rooms["height"][rooms["height"] > 0]
    usual = float(np.median(seen)) if len(seen) else 0.0
    storeys = max(len(map.storeys), 1)
    mean = np.bincount(rooms["storey"], rooms["area"], storeys) / np.maximum(np.bincount(rooms["storey"], minlength=storeys), 1)
    floors = np.zeros(count)
    for room, cells in enumerate(room_floors(map)):
        floors[room] = cells - map.storeys["floor"][rooms["storey"][room]] if np.isfinite(cells) else 0.0
    columns = [
        np.log1p(rooms["area"]),
        np.where(rooms["height"] > 0, rooms["height"], usual),
        np.log1p(np.bincount(pairs[:, 0], minlength=count)),
        np.log1p(np.bincount(ends[flat].ravel(), minlength=count)),
        np.log(np.maximum(rooms["area"], 0.1) / np.maximum(mean[rooms["storey"]], 0.1)),
        floors,
    ]
    return np.stack(columns, axis=1).astype(np.float64).reshape(count, len(GRAPH_FEATURES))


def room_floors(map: TopometricMap) -> Array:
    """(R,) height of each room's floor, m: the lower quartile of its navigable cells; nan without any."""
    z = map.navigable.origin[2] + (map.navigable.cells[:, 2] + 0.5) * map.navigable.edge
    rows = rows_of(map.navigable_room, len(map.rooms))
    return np.array([np.quantile(z[r], 0.25) if len(r) else np.nan for r in rows])
