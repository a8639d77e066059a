"""Engineered descriptors of rooms."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from topomerge.archive import read_weights_json
from topomerge.embedding.graph import LAYOUT_FEATURES, SPECTRUM_FEATURES, THESIS_FEATURES
from topomerge.embedding.quarter_turns import (
    Descriptor,
    TurnedRows,
    collect_room_cells,
    find_neighbours,
    get_rows,
    group_rows,
    join_rooms,
)
from topomerge.embedding.shapedna import SHAPE_LEAST_CELLS, build_surface_laplacian, compute_smallest_eigenvalues, thin_points
from topomerge.errors import InputError
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


def build_engineered(features: str = "all", scaling: str = "matched") -> Descriptor:
    """Return the descriptor: (R, 18) float64, or (R, 12) with ``features="thesis"``.

    Raises:
        InputError: unknown features or scaling.
    """
    if features not in ("all", "thesis"):
        raise InputError(f"features {features!r}: all, thesis are possible")
    if scaling not in SCALINGS:
        raise InputError(f"scaling {scaling!r}: {', '.join(SCALINGS)} are possible")
    chosen = len(FEATURES) if features == "all" else len(THESIS_FEATURES)

    def describe(map: TopometricMap) -> Array:
        return scale_features(compute_raw_features(map)[:, :chosen], scaling)

    return describe


def compute_raw_features(map: TopometricMap) -> Array:
    """Return (R, 18) float64 in the order of `FEATURES`, not scaled."""
    geometry = [compute_thesis_features(cells, map.grid.edge) for cells in collect_room_cells(map)]
    return np.concatenate([np.array(geometry).reshape(-1, len(THESIS_FEATURES)), _compute_graph_features(map)], axis=1)


def scale_features(values: Array, scaling: str) -> Array:
    """Scale features by the statistics of the training set: columns are the first of `FEATURES`."""
    if scaling == "none":
        return values
    mean, spread, differences = _load_statistics()
    n = values.shape[1]
    if scaling == "standard":
        return (values - mean[:n]) / spread[:n]
    root = np.linalg.cholesky(np.linalg.inv(differences[:n, :n]))
    out: Array = (values - mean[:n]) @ root
    return out


def _load_statistics() -> tuple[Array, Array, Array]:
    """Load the mean (D,), standard deviation (D,) and covariance (D, D) of the differences between two views of a room."""
    scale = read_weights_json("topomerge.embedding", "engineered.json")
    if tuple(scale["features"]) != FEATURES:
        raise InputError("engineered.json is of other features: run train.py task=feature_scale export=package")
    return np.array(scale["mean"]), np.array(scale["spread"]), np.array(scale["differences"])


def compute_thesis_features(cells: Array, edge: float) -> Array:
    """Return (12,) float64 in the order of `THESIS_FEATURES` of one room's cells (n, 3) of edge length `edge`, m."""
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
            np.log1p(_measure_smallest_rectangle(columns) * edge**2 * height),
            height,
            np.log1p(len(columns) * edge**2),
            np.linalg.norm(away, axis=1).mean(),
            values[2] / max(values[0], 1e-12),
            s3,
            s3 / (s1 + s2),
            s2 / s1,
            abs(axes[2, 2]),
            measure_roughness(points),
        ]
    )


def _measure_smallest_rectangle(columns: Array) -> float:
    """Measure the area, in cells, of the smallest rectangle about columns (n, 2)."""
    first = np.flatnonzero(np.diff(columns[:, 0], prepend=-1))  # columns ascend: of each row only the ends can be corners
    ends = columns[np.concatenate([first, np.append(first[1:], len(columns)) - 1])]
    corners = (ends[:, None] + np.array([(0, 0), (1, 0), (0, 1), (1, 1)])[None]).reshape(-1, 2).astype(float)
    hull = corners[ConvexHull(corners).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    extents = [np.ptp(hull @ np.array([(c, -s), (s, c)]), axis=0) for c, s in along]
    return float(min(np.prod(e) for e in extents))


def measure_roughness(points: Array) -> float:
    """Measure the mean distance (m) of points (n, 3) to the plane of their 32 nearest; of at most 500 of them, evenly spread."""
    if len(points) < 4:
        return 0.0
    sample = points[np.linspace(0, len(points) - 1, min(ROUGHNESS_CELLS, len(points))).astype(int)]
    _, near = cKDTree(points).query(sample, min(PLANE_NEIGHBOURS, len(points)))
    around = points[near]
    middle = around.mean(axis=1, keepdims=True)
    away = around - middle
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    return float(np.abs(np.einsum("ni,ni->n", sample - middle[:, 0], axes[:, :, 0])).mean())


def _compute_graph_features(map: TopometricMap) -> Array:
    """Return (R, 6) float64 in the order of `GRAPH_FEATURES`."""
    rooms, edges, count = map.rooms, map.open_edges, len(map.rooms)
    ends = edges["rooms"].reshape(-1, 2)
    pairs = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    flat = np.isin(edges["kind"], ("door", "opening"))
    seen = rooms["height"][rooms["height"] > 0]
    usual = float(np.median(seen)) if len(seen) else 0.0
    storeys = max(len(map.storeys), 1)
    mean = np.bincount(rooms["storey"], rooms["area"], storeys) / np.maximum(np.bincount(rooms["storey"], minlength=storeys), 1)
    floors = np.zeros(count)
    for room, cells in enumerate(estimate_room_floors(map)):
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


def estimate_room_floors(map: TopometricMap) -> Array:
    """Return (R,) height of each room's floor, m: the lower quartile of its navigable cells; nan without any."""
    z = map.navigable.origin[2] + (map.navigable.cells[:, 2] + 0.5) * map.navigable.edge
    rows = group_rows(map.navigable_room, len(map.rooms))
    return np.array([np.quantile(z[r], 0.25) if len(r) else np.nan for r in rows])


LAYOUT_REACH = 12.0  # m at most between two doors, seen from above
LAYOUT_CLIMB = 2.0  # m at most between doors of one storey


def compute_door_layout(edge_index: Array, middle: Array, door: Array) -> tuple[Array, Array]:
    """Return pairs of edges (columns of `edge_index`) whose doors are two, and near, in both orders; and (M, 5) float32 of each.

    Args:
        edge_index: (2, 2E) as of `embedding.graph`: the second half are the ways back of the first.
        middle: (R, 3) of rooms, m.
        door: (2E, 3) of the edges' doors, m.

    Returns:
        (2, M) int64, by the first edge ascending; (M, 5) `LAYOUT_FEATURES`, of the second door seen from the first one's room.
    """
    count = edge_index.shape[1]
    if not count:
        return np.zeros((2, 0), np.int64), np.zeros((0, len(LAYOUT_FEATURES)), np.float32)
    door, number = np.asarray(door, float), np.arange(count) % (count // 2)
    away = door[None] - door[:, None]
    distance = np.linalg.norm(away[..., :2], axis=2)
    near = (distance <= LAYOUT_REACH) & (abs(away[..., 2]) <= LAYOUT_CLIMB) & (number[:, None] != number[None])
    first, second = np.nonzero(near)
    out = (door - np.asarray(middle, float)[edge_index[0]])[first, :2]
    to, apart = away[first, second], distance[first, second]
    size = np.maximum(np.linalg.norm(out, axis=1) * apart, 1e-9)
    sine = (out[:, 0] * to[:, 1] - out[:, 1] * to[:, 0]) / size
    cosine = (out * to[:, :2]).sum(axis=1) / size
    same = edge_index[0][first] == edge_index[0][second]
    columns = np.stack([apart, to[:, 2], sine, cosine, same], axis=1)
    return np.stack([first, second]).astype(np.int64), columns.astype(np.float32)


SAMPLED_POINTS = 256  # points: eigenvalues of more cost too much for tens of thousands of rooms
FEATURE_CELL = 0.05  # m: points are put into cells of this size; in cells of 0.1 m they would lie on borders
SPECTRUM_SPACING = 0.251  # m: cells lie 0.1 m apart, and with 0.25 m every fifth one would fall on a border


def compute_point_features(points: Array) -> Array:
    """Return (R, 12) float32 `THESIS_FEATURES` of points (R, P, 3), m. The first one counts different points: it stops at 256."""
    out = np.zeros((len(points), len(THESIS_FEATURES)), np.float32)
    for room, sample in enumerate(_sample_points(points)):
        out[room] = compute_thesis_features(_find_cells(sample), FEATURE_CELL)
    return out


def compute_point_spectra(points: Array) -> Array:
    """Return (R, 32) float32 smallest eigenvalues above 0, 1/m2, of the surface that points (R, P, 3), m, lie on; ascending."""
    out = np.zeros((len(points), len(SPECTRUM_FEATURES)), np.float32)
    for room, sample in enumerate(_sample_points(points)):
        different = np.unique(np.round(sample.astype(np.float64), 3), axis=0)
        if len(different) < SHAPE_LEAST_CELLS:
            continue
        values = compute_smallest_eigenvalues(
            build_surface_laplacian(thin_points(different, SPECTRUM_SPACING)), len(SPECTRUM_FEATURES)
        )
        if len(values):
            number = np.arange(1, len(values) + 1)
            slope = (values @ number) / (number @ number)  # Weyl's law for those that are too many for so few points
            rest = np.maximum(slope * np.arange(len(values) + 1, len(SPECTRUM_FEATURES) + 1), values[-1])
            out[room] = np.concatenate([values, rest])
    return out


def _sample_points(points: Array) -> Array:
    """Sample evenly over the points, which are in the order of their place."""
    return points[:, np.linspace(0, points.shape[1] - 1, min(SAMPLED_POINTS, points.shape[1])).astype(int)]


def _find_cells(points: Array) -> Array:
    """Return (n, 3) int64 different cells, of which the lowest corner is 0."""
    away = points.astype(np.float64) - points.min(axis=0)
    return np.unique(np.floor(away / FEATURE_CELL + 0.5).astype(np.int64), axis=0)


def build_feather(features: Descriptor | None = None, steps: int = 2, points: int = 6, largest: float = 1.5) -> Descriptor:
    """Return the descriptor: (R, 2 * steps * points * F) float64: real parts, then imaginary parts.

    Args:
        features: descriptor of F columns of about unit spread; the engineered features if None.
        steps: longest walk; walks of 1, ..., steps are taken.
        points: values of theta at which the characteristic function is sampled, evenly up to `largest`.

    Raises:
        InputError: a number below 1 or a `largest` that is not above 0.
    """
    if steps < 1 or points < 1 or not largest > 0:
        raise InputError(f"FEATHER needs 1 step and point or more and theta above 0, not {steps}, {points} and {largest}")
    describe_rooms = build_engineered(scaling="standard") if features is None else features
    theta = np.linspace(largest / points, largest, points)

    def describe(map: TopometricMap) -> Array:
        angle = get_rows(describe_rooms(map))[:, :, None] * theta
        walk, reached = compute_walk_matrix(map), np.eye(len(map.rooms))
        parts: list[Array] = []
        for _ in range(steps):
            reached = reached @ walk
            parts += [np.tensordot(reached, wave, 1).reshape(len(reached), -1) for wave in (np.cos(angle), np.sin(angle))]
        return np.concatenate(parts[::2] + parts[1::2], axis=1)

    return describe


def compute_walk_matrix(map: TopometricMap) -> Array:
    """Return (R, R) probability of each step of a lazy walk: to stay, or through one of the room's doors, alike often."""
    count = len(map.rooms)
    ends = map.edges["rooms"].reshape(-1, 2)
    adjacent = np.eye(count)
    adjacent[ends[:, 0], ends[:, 1]] = adjacent[ends[:, 1], ends[:, 0]] = 1.0
    out: Array = adjacent / adjacent.sum(axis=1, keepdims=True)
    return out


CONTEXT_KINDS = ("join", "mean")
MOST_STEPS = 20  # no room of a building is much farther from another


def add_context(descriptor: Descriptor, k: int = 1, how: str = "join") -> Descriptor:
    """Return a descriptor of (k + 1) D columns: the room's own, and that of its surroundings within 1, ..., k steps.

    Args:
        descriptor: of D columns.
        k: steps over doors and stairs; 0 gives the descriptor back.
        how: ``"join"``: the geometry of all rooms within reach is joined and described as one room (thesis); ``"mean"``: the
            mean of their descriptors.

    Raises:
        InputError: k is no whole number from 0 to `MOST_STEPS`, `how` is unknown; or, when called, the descriptor gives rows
            for quarter turns, which see their surroundings themselves.
    """
    if not isinstance(k, int) or isinstance(k, bool) or not 0 <= k <= MOST_STEPS:
        raise InputError(f"steps of context must be a whole number from 0 to {MOST_STEPS}, not {k}")
    if how not in CONTEXT_KINDS:
        raise InputError(f"context {how!r}: {', '.join(CONTEXT_KINDS)} are possible")
    if k == 0:
        return descriptor

    def describe(map: TopometricMap) -> Array:
        rows = descriptor(map)
        if isinstance(rows, TurnedRows):
            raise InputError("steps of context are for descriptors of single rooms; this one sees what is around: leave k out")
        parts = [rows]
        for step in range(1, k + 1):
            around = find_neighbours(map, step)
            parts.append(_describe_unions(descriptor, map, around, rows) if how == "join" else _average_rows(rows, around))
        return np.concatenate(parts, axis=1)

    return describe


def _average_rows(rows: Array, around: list[Array]) -> Array:
    return np.stack([rows[rooms].mean(axis=0) for rooms in around]) if len(rows) else rows


def _describe_unions(descriptor: Descriptor, map: TopometricMap, around: list[Array], rows: Array) -> Array:
    """Return the descriptor of each union; rooms with the same surroundings share the work."""
    by_rooms: dict[tuple[int, ...], Array] = {}
    out = np.zeros_like(rows)
    for room, rooms in enumerate(around):
        key = tuple(rooms.tolist())
        if key not in by_rooms:
            by_rooms[key] = get_rows(descriptor(join_rooms(map, rooms)))[0] if len(key) > 1 else rows[room]
        out[room] = by_rooms[key]
    return out
