"""Which true room an extracted room is, so that a match of two maps can be judged (method 5)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment

from topomerge.types import Array, PointCloud, TopometricMap

TRUTH_DTYPE = np.dtype(
    [
        ("room", "i4"),  # true room with the largest IoU, -1: none
        ("iou", "f4"),
        ("one", "?"),  # the two are each other's in the best one-to-one assignment
    ]
)
LEAST_IOU = 0.1  # below, an extracted room is no true room
WALL_BESIDE = 0.15  # m: points of a wall lie outside of the room's outline
SLICE_SHARE = 0.5  # of the height of the map: points that span less are a slice, which was made into walls and a floor


def room_truth(map: TopometricMap, cloud: PointCloud) -> Array:
    """(R,) TRUTH_DTYPE of each extracted room.

    The IoU counts occupied cells: those of the extracted room, and those in which most labelled points are of the true room. The
    one-to-one assignment has the largest sum of IoU; the others get the true room that they overlap most, several of them perhaps
    the same one, as when a corridor is extracted in pieces.

    Args:
        map: extracted from the cloud, in its frame.
        cloud: with `labels`, or with `rooms` whose outlines give the labels.
    """
    iou = _iou(map, cell_labels(map, cloud), len(cloud.rooms))
    out = np.zeros(len(map.rooms), TRUTH_DTYPE)
    out["room"] = -1
    if iou.size:
        best = iou.argmax(axis=1)
        value = iou[np.arange(len(iou)), best]
        i, j = linear_sum_assignment(iou, maximize=True)
        paired = iou[i, j] >= LEAST_IOU
        i, j = i[paired], j[paired]
        best[i], value[i], out["one"][i] = j, iou[i, j], True
        out["room"], out["iou"] = np.where(value >= LEAST_IOU, best, -1), value
    return out


def cell_labels(map: TopometricMap, cloud: PointCloud) -> Array:
    """(n,) int32 true room of each occupied cell: that of most of its labelled points; -1: none.

    The points of a slice lie in, or below, the walls that the extraction made of it: they label the whole column.
    Its assumed floor has no points and gets its labels from the rooms' outlines.
    """
    if cloud.labels is None:
        return _by_outline(map, cloud)
    labelled = np.flatnonzero(cloud.labels >= 0)
    label = cloud.labels[labelled].astype(np.int64)
    places = map.grid.locate(cloud.points[labelled].astype(np.float64) + cloud.shift)
    if not len(labelled) or _height(places) >= SLICE_SHARE * _height(map.grid.cells):
        return _most(map.grid.rows(places), label, len(map.grid), len(cloud.rooms))
    columns, column = np.unique(map.grid.cells[:, :2], axis=0, return_inverse=True)
    number = np.full(map.grid.shape[:2], -1)
    number[tuple(columns.T)] = np.arange(len(columns))
    inside = ((places[:, :2] >= 0) & (places[:, :2] < map.grid.shape[:2])).all(axis=1)
    walls = _most(number[tuple(places[inside, :2].T)], label[inside], len(columns), len(cloud.rooms))[column.ravel()]
    return np.where(walls >= 0, walls, _by_outline(map, cloud))


def _height(cells: Array) -> float:
    """Levels between the lowest and the highest cells, but for one in a hundred."""
    low, high = np.percentile(np.unique(cells, axis=0)[:, 2], [1, 99])
    return float(high - low)


def _most(row: Array, label: Array, count: int, rooms: int) -> Array:
    """(count,) int32 label that is commonest in each row; -1: none. Rows below 0 are left out."""
    out = np.full(count, -1, np.int32)
    pair, votes = np.unique(row[row >= 0] * max(rooms, 1) + label[row >= 0], return_counts=True)
    order = np.argsort(votes, kind="stable")  # the last one written has most votes
    cell, room = np.divmod(pair[order], max(rooms, 1))
    out[cell] = room
    return out


def _by_outline(map: TopometricMap, cloud: PointCloud) -> Array:
    places = map.grid.centroids()
    out = np.full(len(places), -1, np.int32)
    for i, room in enumerate(cloud.rooms):
        level = (places[:, 2] > room.floor - 2 * WALL_BESIDE) & (places[:, 2] < room.ceiling + 2 * WALL_BESIDE)
        shape = shapely.Polygon(room.polygon).buffer(WALL_BESIDE, join_style="mitre")
        rows = np.flatnonzero(level & (out < 0))
        out[rows[shapely.contains_xy(shape, places[rows, :2])]] = i
    return out


def _iou(map: TopometricMap, label: Array, count: int) -> Array:
    """(R, count) IoU of cells."""
    rooms = len(map.rooms)
    inside = (map.room >= 0) & (label >= 0)
    both = np.zeros((rooms, count))
    np.add.at(both, (map.room[inside], label[inside]), 1)
    extracted = np.bincount(map.room[map.room >= 0], minlength=rooms)[:, None]
    true = np.bincount(label[(label >= 0) & (map.room >= 0)], minlength=count)[None]
    return both / np.maximum(extracted + true - both, 1)


def true_matches(a: Array, b: Array, shared: Iterable[tuple[int, int]]) -> Array:
    """(M, 2) int64 extracted rooms (i of a, j of b), ascending, that are the same true room.

    Args:
        a, b: TRUTH_DTYPE of the two maps.
        shared: true rooms (of a, of b) that are one room.
    """
    pairs = [(int(i), int(j)) for s, t in shared for i in np.flatnonzero(a["room"] == s) for j in np.flatnonzero(b["room"] == t)]
    return np.array(sorted(set(pairs)), np.int64).reshape(-1, 2)
