"""The truth about a simulated floor and its rooms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from topomerge.datasets.core.building import Building

from topomerge.metrics import (
    HALF,
    SAME,
    RoomScores,
    Scores,
    compute_overlaps,
    is_storeys_right,
    score_doors,
    score_edges,
    score_rooms,
)
from topomerge.types import Array, Sim3, TopometricMap, TrueRoom


@dataclass(frozen=True, eq=False)
class FloorRasters:
    """Rasters (storeys, rows, columns) of a building's floors.

    Args:
        room: int32, true room of each cell, -1: wall, doorway or outside.
        origin: (2,) of the rasters.
        cell: m.
    """

    room: Array
    origin: Array
    cell: float

    def compute_cells(self, points: Array) -> Array:
        """Compute (n, 2) row and column of points, within the raster."""
        ij = np.floor((np.asarray(points)[:, 1::-1] - self.origin[::-1]) / self.cell).astype(np.int64)
        return np.clip(ij, 0, np.array(self.room.shape[1:]) - 1)


def rasterize_floors(building: Building, cell: float) -> FloorRasters:
    """Return the raster of the true rooms; a room that is two storeys high is on both."""
    corners = np.concatenate([r.polygon for r in building.rooms])
    origin = corners.min(axis=0) - 1.0
    columns, rows = np.ceil((corners.max(axis=0) + 1.0 - origin) / cell).astype(int)
    rooms = np.full((len(building.storeys), int(rows), int(columns)), -1, np.int32)
    for i, room in enumerate(building.rooms):
        for k, floor in enumerate(building.storeys["floor"]):
            if k >= room.storey and floor < room.ceiling - 1.5:
                fill(rooms[k], (room.polygon - origin) / cell, i)
    return FloorRasters(rooms, origin, cell)


def fill(raster: Array, polygon: Array, value: int) -> None:
    """Set the cells of a raster whose centres lie in a polygon, given in cells: (k, 2) column and row."""
    low = np.clip(np.floor(polygon.min(axis=0)).astype(int), 0, None)
    high = np.clip(np.ceil(polygon.max(axis=0)).astype(int), 0, raster.shape[::-1])
    if (high <= low).any():
        return
    a, b = polygon, np.roll(polygon, -1, axis=0)
    y = (np.arange(low[1], high[1]) + 0.5)[:, None]
    crossed = (a[:, 1] <= y) != (b[:, 1] <= y)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    row, edge = np.nonzero(crossed)
    column = np.clip(np.ceil(x[row, edge] - 0.5).astype(int) - low[0], 0, high[0] - low[0])
    flips = np.zeros((high[1] - low[1], high[0] - low[0] + 1), np.int32)
    np.add.at(flips, (row, column), 1)
    inside = np.cumsum(flips, axis=1)[:, :-1] % 2 == 1
    raster[low[1] : high[1], low[0] : high[0]][inside] = value


TRUTH_CELL = 0.1  # m, of the raster
WORD_SPREAD = 0.3  # m
SCAN_NEAR = 0.2  # m
WALL_ZONE = 0.4  # m about true rooms where the map may say anything: walls, and the doorways in them
FLOOR_BELOW, FLOOR_ABOVE = 0.6, 1.6  # m about a floor at which one stands on it
LEAST_SEEN_AREA = 0.5  # m2 that a scan must have seen of a room for it to be expected
TRUTH_MARGIN = 2.0  # m around the rooms
OUTSIDE_ROOMS, NOT_JUDGED = -1, -2  # true labels: of no true room but judged; not judged


@dataclass(frozen=True, eq=False)
class FloorTruth:
    """The truth about a scan, in the frame of its building.

    Args:
        raster: (L, rows, columns) int32 true room of each judged column, `OUTSIDE_ROOMS` or `NOT_JUDGED`.
        origin: (2,) m.
        visited: (T,) bool, rooms that the surveyor was in.
        floors: (L,) m.
        height: (L,) m from floor to ceiling.
        doors: (D, 5) rooms on both sides (-1 outside) and centre, m.
        edges: (E, 2) rooms joined by doors, openings or stairs.
        matrix: (4, 4) the scan's frame into the building's.
        anchors: (A, 3) places in the scan's frame.
        drift: (A, 3) what to add to a place there to undo the drift, in the scan's frame.
        complete: () bool, are all rooms listed? If not, what the map finds elsewhere is neither right nor wrong.
    """

    raster: Array
    origin: Array
    visited: Array
    floors: Array
    height: Array
    doors: Array
    edges: Array
    matrix: Array
    anchors: Array
    drift: Array
    complete: Array

    def transform_to_building(self, points: Array) -> Array:
        """Return (n, 3) points of the scan in the frame of the building, without the drift."""
        points = np.asarray(points, np.float64)
        if len(self.anchors) and len(points):
            points = points + self.drift[cKDTree(self.anchors).query(points)[1]]
        return points @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def compute_columns(self, places: Array) -> tuple[Array, Array]:
        """Compute (n, 2) rows and columns of places in the building's frame, and which of them are on the raster."""
        ij = np.floor((places[:, 1::-1] - self.origin[::-1]) / TRUTH_CELL).astype(np.int64)
        inside: Array = np.all((ij >= 0) & (ij < self.raster.shape[1:]), axis=1)
        return ij, inside


def build_truth(
    building: Building,
    visited: Array,
    points: Array,
    anchors: Array | None = None,
    drift: Array | None = None,
    complete: bool = True,
) -> FloorTruth:
    """Build the truth about a scan that is in the frame of its building (`transform_truth` for another one).

    Args:
        visited: (T,) bool.
        points: (n, 3) of the scan.
        anchors, drift: as of `FloorTruth`; None: the scan has no drift.
    """
    floors, none = building.storeys["floor"], np.zeros((0, 3))
    raster, origin = draw_rooms(building.rooms, floors)
    truth = FloorTruth(
        raster=raster,
        origin=origin,
        visited=visited,
        floors=floors,
        height=building.storeys["ceiling"] - floors,
        doors=np.column_stack([building.doors["rooms"], building.doors["centre"]]).astype(float).reshape(-1, 5),
        edges=building.list_edges(),
        matrix=np.eye(4),
        anchors=none if anchors is None else anchors,
        drift=none if drift is None else drift,
        complete=np.array(complete),
    )
    return mask_unseen(truth, points)


def transform_truth(truth: FloorTruth, frame: Sim3) -> FloorTruth:
    """Return the truth about a scan after it was moved by a frame."""
    turn = Sim3(frame.yaw).matrix[:3, :3] * frame.scale
    matrix = truth.matrix @ frame.inverse().matrix
    return replace(truth, matrix=matrix, anchors=frame.apply(truth.anchors), drift=truth.drift @ turn.T)


def draw_rooms(rooms: tuple[TrueRoom, ...], floors: Array) -> tuple[Array, Array]:
    """Draw (L, rows, columns) int32 raster of the rooms' floors, -1 elsewhere, and its origin (m)."""
    corners = np.concatenate([r.polygon for r in rooms])
    origin = corners.min(axis=0) - TRUTH_MARGIN
    columns, rows = np.ceil((corners.max(axis=0) + TRUTH_MARGIN - origin) / TRUTH_CELL).astype(int).tolist()
    raster = np.full((len(floors), rows, columns), OUTSIDE_ROOMS, np.int32)
    for i, room in enumerate(rooms):
        storey = int(np.argmin(np.abs(floors - room.floor)))
        fill(raster[storey], (room.polygon - origin) / TRUTH_CELL, i)
    return raster, origin


def mask_unseen(truth: FloorTruth, points: Array) -> FloorTruth:
    """Return the truth without the columns that are not judged: walls, and what the scan has not seen.

    Args:
        points: (n, 3) of the scan.
    """
    places = truth.transform_to_building(points)
    out = truth.raster.copy()
    ij, inside = truth.compute_columns(places)
    for k, floor in enumerate(truth.floors):
        level = inside & (places[:, 2] > floor - 0.3) & (places[:, 2] < floor + truth.height[k] + 0.3)
        seen = np.zeros(out.shape[1:], bool)
        seen[ij[level, 0], ij[level, 1]] = True
        near = ndimage.distance_transform_edt(~seen) * TRUTH_CELL <= SCAN_NEAR if seen.any() else seen
        of_room = out[k] >= 0
        walls = ~of_room & (ndimage.distance_transform_edt(~of_room) * TRUTH_CELL <= WALL_ZONE)
        out[k][walls | (of_room & ~near) | (~of_room & ~truth.complete)] = NOT_JUDGED
    return replace(truth, raster=out)


def predict_columns(map: TopometricMap, truth: FloorTruth) -> Array:
    """Predict (L, rows, columns) int32: the map's room of each column, -1 none."""
    out = np.full(truth.raster.shape, -1, np.int32)
    walk, solid = map.navigable_room >= 0, map.room >= 0
    walked = truth.transform_to_building(map.navigable.compute_centroids()[walk]), map.navigable_room[walk]
    filled = truth.transform_to_building(map.grid.compute_centroids()[solid]), map.room[solid]
    for k, floor in enumerate(truth.floors):
        z = walked[0][:, 2] - floor
        level = (z > -FLOOR_BELOW) & (z < min(FLOOR_ABOVE, truth.height[k]))
        where, room = walked[0][level], walked[1][level]
        order = np.argsort(-np.abs(where[:, 2] - floor), kind="stable")  # the nearest to the floor is written last
        ij, inside = truth.compute_columns(where[order])
        stood = np.full(out.shape[1:], -1, np.int32)
        stood[ij[inside, 0], ij[inside, 1]] = room[order][inside]
        z = filled[0][:, 2] - floor
        level = (z > -0.3) & (z < truth.height[k] + 0.3)
        over = _find_most_common(truth, filled[0][level], filled[1][level])
        out[k] = predict_storey_columns(truth, k, stood, over)
    return out


def predict_storey_columns(truth: FloorTruth, storey: int, stood: Array, over: Array) -> Array:
    """Predict the (rows, columns) int32 room of the map at each column of a storey, -1 none.

    Args:
        stood: (rows, columns) rooms of the columns where one can stand, -1 elsewhere.
        over: (rows, columns) rooms of what stands between floor and ceiling, -1 none.
    """
    floor_of = np.append(truth.visited, False)[truth.raster[storey]] & (truth.raster[storey] >= 0)
    wide = np.where(floor_of, _spread_labels(stood, WORD_SPREAD), _spread_labels(stood, TRUTH_CELL))  # a turned raster has holes
    wide = np.where(wide >= 0, wide, np.where(floor_of, over, -1))
    return np.where(floor_of, _spread_labels(wide, WORD_SPREAD), wide)


def _spread_labels(labels: Array, reach: float) -> Array:
    """Return the labels, with those of the nearest labelled column within `reach` m where there are none."""
    if not (labels >= 0).any():
        return labels
    far, (i, j) = ndimage.distance_transform_edt(labels < 0, return_indices=True)
    return np.where(far * TRUTH_CELL <= reach, labels[i, j], -1)


def _find_most_common(truth: FloorTruth, places: Array, room: Array) -> Array:
    """Return (rows, columns) int32 the commonest room of each column, -1 none."""
    out = np.full(truth.raster.shape[1:], -1, np.int32)
    ij, inside = truth.compute_columns(places)
    if inside.any():
        count, columns = int(room.max()) + 1, truth.raster.shape[2]
        key = (ij[inside, 0] * columns + ij[inside, 1]) * count + room[inside]
        key, votes = np.unique(key, return_counts=True)
        key = key[np.argsort(votes, kind="stable")]
        out.ravel()[key // count] = key % count
    return out


@dataclass(frozen=True)
class FloorScores:
    """All scores of a map; see `metrics` for the definitions."""

    rooms: RoomScores
    doors: Scores
    edges: Scores
    storeys: bool
    true_rooms: int
    found_rooms: int  # that count
    true_storeys: int
    found_storeys: int


def evaluate_map(map: TopometricMap, truth: FloorTruth, columns: Array | None = None) -> FloorScores:
    """Score a map.

    Expected are the visited rooms of which the scan saw `LEAST_SEEN_AREA`. Rooms that the map calls glimpsed or outside and that
    lie mostly outside of those are not held against it, and no more are doors that lead to one, or that are where a true door
    leads out of the visited rooms.

    Args:
        columns: `predict_columns(map, truth)` where it is known already.
    """
    columns = predict_columns(map, truth) if columns is None else columns
    place = (truth.raster >= 0) | ((truth.raster == OUTSIDE_ROOMS) & (columns >= 0))
    true, labels = truth.raster[place], columns[place]
    true_count = len(truth.visited)
    seen = np.bincount(true[true >= 0], minlength=true_count) * TRUTH_CELL**2
    expected = truth.visited & (seen >= LEAST_SEEN_AREA)
    own = np.bincount(labels[(labels >= 0) & np.append(expected, False)[true]], minlength=len(map.rooms))
    all_of = np.bincount(labels[labels >= 0], minlength=len(map.rooms))
    counted = ~(map.rooms["glimpsed"] | (map.rooms["outside"] > 0.5)) | (2 * own > all_of)
    if not truth.complete:
        counted &= all_of * TRUTH_CELL**2 >= LEAST_SEEN_AREA
    rooms = score_rooms(np.where(true >= 0, true, -1), labels, true_count, counted, expected)
    ends = truth.doors[:, :2].astype(np.int64)
    requested = ((ends >= 0) & np.append(expected, False)[ends]).all(axis=1)
    edges = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    at = truth.transform_to_building(edges["centre"])
    serious = counted[edges["rooms"]].all(axis=1)
    doors = score_doors(truth.doors[requested, 2:], at, serious, truth.doors[~requested, 2:])
    pairs = truth.edges[expected[truth.edges].all(axis=1)] if len(truth.edges) else truth.edges
    assigned = np.where(rooms.each >= SAME, rooms.assigned, -1)
    floors = truth.floors[[bool(np.isin(level, np.flatnonzero(expected)).any()) for level in truth.raster]]
    return FloorScores(
        rooms=rooms,
        doors=doors,
        edges=score_edges(pairs.tolist(), map.edges["rooms"], assigned, counted),
        storeys=is_storeys_right(floors, _compute_levels(map, truth)),
        true_rooms=int(expected.sum()),
        found_rooms=int(counted.sum()),
        true_storeys=len(floors),
        found_storeys=len(map.storeys),
    )


def _compute_levels(map: TopometricMap, truth: FloorTruth) -> Array:
    """Return the heights of the map's storeys in the building's frame, m."""
    return map.storeys["floor"] * truth.matrix[2, 2] + truth.matrix[2, 3]


WHOLE_SHARE = 0.8  # of a true room's floor, from which on it was seen as a whole
LEAST_JUDGED_AREA = 0.5  # m2 of a map's room on judged floor, from which on something is true about it


@dataclass(frozen=True, eq=False)
class RoomTruth:
    """Of each room of a map, (R,) bool.

    Args:
        one: has it an IoU of a half with what was seen of a true room?
        whole: does it cover `WHOLE_SHARE` of a true room?
        entered: does most of it lie in rooms that the surveyor was in?
        outside: does most of it lie outside of all true rooms?
        judged: is enough of it on judged floor?
    """

    one: Array
    whole: Array
    entered: Array
    outside: Array
    judged: Array


def compute_room_truth(
    map: TopometricMap, truth: FloorTruth, rooms: Sequence[TrueRoom], columns: Array | None = None
) -> RoomTruth:
    """Compute the truth about the rooms of a map.

    Args:
        rooms: the true ones, in the building's frame.
        columns: `predict_columns(map, truth)` where it is at hand already.
    """
    columns = predict_columns(map, truth) if columns is None else columns
    count, trues = len(map.rooms), len(truth.visited)
    judged = columns[(columns >= 0) & (truth.raster >= -1)], truth.raster[(columns >= 0) & (truth.raster >= -1)]
    of_room = np.bincount(judged[0], minlength=count)
    visited = np.bincount(judged[0], np.append(truth.visited, False)[judged[1]], minlength=count)
    outside = np.bincount(judged[0], judged[1] < 0, minlength=count)
    place = (truth.raster >= 0) | ((truth.raster == -1) & (columns >= 0))
    iou = compute_overlaps(truth.raster[place], columns[place], trues, count)[0].max(axis=0, initial=0.0)
    full = draw_rooms(tuple(rooms), truth.floors)[0]
    both = (columns >= 0) & (full >= 0)
    shares = np.bincount(columns[both].astype(np.int64) * trues + full[both], minlength=count * trues).reshape(count, trues)
    floors = np.maximum(np.bincount(full[full >= 0], minlength=trues), 1)
    return RoomTruth(
        one=iou >= HALF,
        whole=(shares / floors).max(axis=1, initial=0.0) >= WHOLE_SHARE,
        entered=2 * visited > of_room,
        outside=2 * outside > of_room,
        judged=of_room * TRUTH_CELL**2 >= LEAST_JUDGED_AREA,
    )


def join_truths(
    a: FloorTruth, b: FloorTruth, transform: Sim3, lay: tuple[Callable[[Array], Array], Callable[[Array], Array]]
) -> FloorTruth:
    """Join the truths of two maps into that of the joined map, in the frame of a.

    A place of the joined map is moved to where it truly is as the nearest place of either map is: drift that merging has left
    does not count against the rooms of a single map, and counts no more against those of the joined one.

    Args:
        a, b: about the two maps, each in its own frame and with anchors.
        transform: true T_ab.
        lay: where the points (n, 3) of a and of b lie in the joined map.
    """
    anchors = [move(t.anchors) for move, t in zip(lay, (a, b), strict=True)]
    right = [a.anchors + a.drift, transform.apply(b.anchors + b.drift)]
    return replace(
        a,
        raster=np.where(a.raster != NOT_JUDGED, a.raster, b.raster),
        visited=a.visited | b.visited,
        anchors=np.concatenate(anchors),
        drift=np.concatenate([there - here for there, here in zip(right, anchors, strict=True)]),
    )
