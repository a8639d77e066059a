"""What is true about the floor of a scan, what a map says about it, and how well the two agree.

Places are the columns of a raster, one a storey, of the true rooms' floors: those columns of true rooms that the scan saw
(within `SCAN_NEAR` of a point of that storey), and columns outside of all true rooms and their walls that the map says are of a
room. The map's word for a column is the room of the navigable cell there, or of the nearest one within `WORD_SPREAD`, so that
neither the strip along a wall, where no body fits, nor a turned raster counts against anyone; further from where one can stand,
the room of most of the occupied cells between floor and ceiling (furniture belongs to a room), or of the nearest such within
`WORD_SPREAD`. In rooms that were not visited, and outside, only the navigable cells themselves speak. Drift that the simulator
put into a scan is taken out of the map first: a map can't be better than its points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from topomerge.datasets.core.building import Building
from topomerge.datasets.simulation.floors import fill

from topomerge.metrics import SAME, RoomScores, Scores, score_doors, score_edges, score_rooms, storeys_right
from topomerge.types import Array, Sim3, TopometricMap, TrueRoom

TRUTH_CELL = 0.1  # m, of the raster
WORD_SPREAD = 0.3  # m
SCAN_NEAR = 0.2  # m
WALL_ZONE = 0.4  # m about true rooms where the map may say anything: walls, and the doorways in them
FLOOR_BELOW, FLOOR_ABOVE = 0.6, 1.6  # m about a floor at which one stands on it
LEAST_SEEN_AREA = 0.5  # m2 that a scan must have seen of a room for it to be expected
TRUTH_MARGIN = 2.0  # m around the rooms
OUTSIDE_ROOMS, NOT_JUDGED = -1, -2  # true labels: of no true room but judged; not judged


@dataclass(frozen=True, eq=False)
class Truth:
    """What is true about a scan, in the frame of its building.

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

    def place(self, points: Array) -> Array:
        """(n, 3) points of the scan in the frame of the building, without the drift."""
        points = np.asarray(points, np.float64)
        if len(self.anchors) and len(points):
            points = points + self.drift[cKDTree(self.anchors).query(points)[1]]
        return points @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def columns(self, places: Array) -> tuple[Array, Array]:
        """(n, 2) rows and columns of places in the building's frame, and which of them are on the raster."""
        ij = np.floor((places[:, 1::-1] - self.origin[::-1]) / TRUTH_CELL).astype(np.int64)
        inside: Array = np.all((ij >= 0) & (ij < self.raster.shape[1:]), axis=1)
        return ij, inside


def truth_of(
    building: Building,
    visited: Array,
    points: Array,
    anchors: Array | None = None,
    drift: Array | None = None,
    complete: bool = True,
) -> Truth:
    """What is true about a scan that is in the frame of its building (`in_frame` for another one).

    Args:
        visited: (T,) bool.
        points: (n, 3) of the scan.
        anchors, drift: as of `Truth`; None: the scan has no drift.
    """
    floors, none = building.storeys["floor"], np.zeros((0, 3))
    raster, origin = draw_rooms(building.rooms, floors)
    truth = Truth(
        raster=raster,
        origin=origin,
        visited=visited,
        floors=floors,
        height=building.storeys["ceiling"] - floors,
        doors=np.column_stack([building.doors["rooms"], building.doors["centre"]]).astype(float).reshape(-1, 5),
        edges=building.edges(),
        matrix=np.eye(4),
        anchors=none if anchors is None else anchors,
        drift=none if drift is None else drift,
        complete=np.array(complete),
    )
    return judged(truth, points)


def in_frame(truth: Truth, frame: Sim3) -> Truth:
    """The truth about a scan after it was moved by a frame."""
    turn = Sim3(frame.yaw).matrix[:3, :3] * frame.scale
    matrix = truth.matrix @ frame.inverse().matrix
    return replace(truth, matrix=matrix, anchors=frame.apply(truth.anchors), drift=truth.drift @ turn.T)


def draw_rooms(rooms: tuple[TrueRoom, ...], floors: Array) -> tuple[Array, Array]:
    """(L, rows, columns) int32 raster of the rooms' floors, -1 elsewhere, and its origin (m)."""
    corners = np.concatenate([r.polygon for r in rooms])
    origin = corners.min(axis=0) - TRUTH_MARGIN
    columns, rows = np.ceil((corners.max(axis=0) + TRUTH_MARGIN - origin) / TRUTH_CELL).astype(int).tolist()
    raster = np.full((len(floors), rows, columns), OUTSIDE_ROOMS, np.int32)
    for i, room in enumerate(rooms):
        storey = int(np.argmin(np.abs(floors - room.floor)))
        fill(raster[storey], (room.polygon - origin) / TRUTH_CELL, i)
    return raster, origin


def judged(truth: Truth, points: Array) -> Truth:
    """The truth without the columns that are not judged: walls, and what the scan has not seen.

    Args:
        points: (n, 3) of the scan.
    """
    places = truth.place(points)
    out = truth.raster.copy()
    ij, inside = truth.columns(places)
    for k, floor in enumerate(truth.floors):
        level = inside & (places[:, 2] > floor - 0.3) & (places[:, 2] < floor + truth.height[k] + 0.3)
        seen = np.zeros(out.shape[1:], bool)
        seen[ij[level, 0], ij[level, 1]] = True
        near = ndimage.distance_transform_edt(~seen) * TRUTH_CELL <= SCAN_NEAR if seen.any() else seen
        of_room = out[k] >= 0
        walls = ~of_room & (ndimage.distance_transform_edt(~of_room) * TRUTH_CELL <= WALL_ZONE)
        out[k][walls | (of_room & ~near) | (~of_room & ~truth.complete)] = NOT_JUDGED
    return replace(truth, raster=out)


def said(map: TopometricMap, truth: Truth) -> Array:
    """(L, rows, columns) int32: the map's room of each column, -1 none."""
    out = np.full(truth.raster.shape, -1, np.int32)
    walk, solid = map.navigable_room >= 0, map.room >= 0
    walked = truth.place(map.navigable.centroids()[walk]), map.navigable_room[walk]
    filled = truth.place(map.grid.centroids()[solid]), map.room[solid]
    for k, floor in enumerate(truth.floors):
        z = walked[0][:, 2] - floor
        level = (z > -FLOOR_BELOW) & (z < min(FLOOR_ABOVE, truth.height[k]))
        where, room = walked[0][level], walked[1][level]
        order = np.argsort(-np.abs(where[:, 2] - floor), kind="stable")  # the nearest to the floor is written last
        ij, inside = truth.columns(where[order])
        stood = np.full(out.shape[1:], -1, np.int32)
        stood[ij[inside, 0], ij[inside, 1]] = room[order][inside]
        z = filled[0][:, 2] - floor
        level = (z > -0.3) & (z < truth.height[k] + 0.3)
        over = _most(truth, filled[0][level], filled[1][level])
        out[k] = column_words(truth, k, stood, over)
    return out


def column_words(truth: Truth, storey: int, stood: Array, over: Array) -> Array:
    """(rows, columns) int32 the room that a map says for each column of a storey, -1 none.

    Args:
        stood: (rows, columns) rooms of the columns where one can stand, -1 elsewhere.
        over: (rows, columns) rooms of what stands between floor and ceiling, -1 none.
    """
    floor_of = np.append(truth.visited, False)[truth.raster[storey]] & (truth.raster[storey] >= 0)
    wide = np.where(floor_of, _spread(stood, WORD_SPREAD), _spread(stood, TRUTH_CELL))  # a turned raster has holes
    wide = np.where(wide >= 0, wide, np.where(floor_of, over, -1))
    return np.where(floor_of, _spread(wide, WORD_SPREAD), wide)


def _spread(labels: Array, reach: float) -> Array:
    """Labels, with those of the nearest labelled column within `reach` m where there are none."""
    if not (labels >= 0).any():
        return labels
    far, (i, j) = ndimage.distance_transform_edt(labels < 0, return_indices=True)
    return np.where(far * TRUTH_CELL <= reach, labels[i, j], -1)


def _most(truth: Truth, places: Array, room: Array) -> Array:
    """(rows, columns) int32 the commonest room of each column, -1 none."""
    out = np.full(truth.raster.shape[1:], -1, np.int32)
    ij, inside = truth.columns(places)
    if inside.any():
        count, columns = int(room.max()) + 1, truth.raster.shape[2]
        key = (ij[inside, 0] * columns + ij[inside, 1]) * count + room[inside]
        key, votes = np.unique(key, return_counts=True)
        key = key[np.argsort(votes, kind="stable")]
        out.ravel()[key // count] = key % count
    return out


@dataclass(frozen=True)
class Verdict:
    """All scores of a map; see `metrics` for the definitions."""

    rooms: RoomScores
    doors: Scores
    edges: Scores
    storeys: bool
    true_rooms: int
    found_rooms: int  # that count
    true_storeys: int
    found_storeys: int


def judge(map: TopometricMap, truth: Truth, columns: Array | None = None) -> Verdict:
    """Score a map.

    Expected are the visited rooms of which the scan saw `LEAST_SEEN_AREA`. Rooms that the map calls glimpsed or outside and that
    lie mostly outside of those are not held against it, and no more are doors that lead to one, or that are where a true door
    leads out of the visited rooms.

    Args:
        columns: `said(map, truth)` where it is known already.
    """
    columns = said(map, truth) if columns is None else columns
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
    wanted = ((ends >= 0) & np.append(expected, False)[ends]).all(axis=1)
    edges = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    at = truth.place(edges["centre"])
    serious = counted[edges["rooms"]].all(axis=1)
    doors = score_doors(truth.doors[wanted, 2:], at, serious, truth.doors[~wanted, 2:])
    pairs = truth.edges[expected[truth.edges].all(axis=1)] if len(truth.edges) else truth.edges
    assigned = np.where(rooms.each >= SAME, rooms.assigned, -1)
    floors = truth.floors[[bool(np.isin(level, np.flatnonzero(expected)).any()) for level in truth.raster]]
    return Verdict(
        rooms=rooms,
        doors=doors,
        edges=score_edges(pairs.tolist(), map.edges["rooms"], assigned, counted),
        storeys=storeys_right(floors, _levels(map, truth)),
        true_rooms=int(expected.sum()),
        found_rooms=int(counted.sum()),
        true_storeys=len(floors),
        found_storeys=len(map.storeys),
    )


def _levels(map: TopometricMap, truth: Truth) -> Array:
    """Heights of the map's storeys in the building's frame, m."""
    return map.storeys["floor"] * truth.matrix[2, 2] + truth.matrix[2, 3]
