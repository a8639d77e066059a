"""How well the rooms, doors and storeys of a map agree with the truth, or with another map.

Everything here works on label arrays: one integer per place (cell or column of the floor), 0 and above for a room, -1 for
none. `datasets.simulation.floor_truth` makes such arrays from maps and from what is true about a scan.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from topomerge.types import Array

HALF = 0.5  # IoU from which a room counts as found
SAME = 0.1  # IoU from which two rooms correspond, for the edges of the graph
PLAN, PLAN_HEIGHT = 0.5, 1.0  # m between a true door and the one found
LEVEL = 0.5  # m between a true floor and the one found
OFF_STOREY = 1.4  # m: half of the lowest storey: what is off by more lies nearer to another floor


@dataclass(frozen=True)
class RoomScores:
    """Agreement of found rooms with true ones (`score_rooms`); means are over the true rooms, nan where there are none."""

    iou: float
    precision: float
    recall: float
    mcc: float
    each: Array  # (T,) IoU of each true room with the room assigned to it
    each_mcc: Array  # (T,)
    assigned: Array  # (T,) int64 found room, -1 none


@dataclass(frozen=True)
class Scores:
    """Precision and recall; nan where nothing was found, or nothing is true."""

    precision: float
    recall: float
    true: int
    extracted: int
    right: int

    @staticmethod
    def from_counts(right: int, true: int, extracted: int) -> Scores:
        """Compute scores from the numbers of right, true and found ones."""
        return Scores(_compute_ratio(right, extracted), _compute_ratio(right, true), true, extracted, right)


def _compute_ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")


def count_contingency(true: Array, extracted: Array, trues: int, extracted_rooms: int) -> Array:
    """Count (trues, extracted_rooms) int64: places that have true room i and found room j.

    Args:
        true, extracted: (n,) labels of the same places, -1 none.
    """
    both = (true >= 0) & (extracted >= 0)
    pair = true[both].astype(np.int64) * extracted_rooms + extracted[both]
    return np.bincount(pair, minlength=trues * extracted_rooms).reshape(trues, extracted_rooms)


def compute_overlaps(true: Array, extracted: Array, trues: int, extracted_rooms: int) -> tuple[Array, Array]:
    """Compute the IoU and Matthews correlation (trues, extracted_rooms) of the mask of each true room against the mask of each
    found one.

    The correlation is over all places given, 0 where one of the masks is empty or full.
    """
    both = count_contingency(true, extracted, trues, extracted_rooms).astype(float)
    of_true = np.bincount(true[true >= 0], minlength=trues).astype(float)[:, None]
    of_extracted = np.bincount(extracted[extracted >= 0], minlength=extracted_rooms).astype(float)[None]
    total = float(len(true))
    iou = both / np.maximum(of_true + of_extracted - both, 1)
    spread = of_true * (total - of_true) * of_extracted * (total - of_extracted)
    mcc = (both * total - of_true * of_extracted) / np.sqrt(np.maximum(spread, 1))
    return iou, np.where(spread > 0, mcc, 0.0)


def assign(iou: Array) -> Array:
    """Return (T,) int64: the found room of each true one in the one-to-one assignment with the largest sum of IoU; -1: none that
    overlaps it."""
    out = np.full(len(iou), -1, np.int64)
    if iou.size:
        i, j = linear_sum_assignment(iou, maximize=True)
        overlapping = iou[i, j] > 0
        out[i[overlapping]] = j[overlapping]
    return out


def score_rooms(true: Array, extracted: Array, trues: int, counted: Array, expected: Array | None = None) -> RoomScores:
    """Score the rooms found against true ones.

    Mean IoU: of the one-to-one assignment, over all expected true rooms; one that got no room counts 0. Precision and recall:
    found rooms that count and expected true rooms that are assigned to each other with an IoU of at least 0.5. MCC: Matthews
    correlation of the mask of a true room against the mask assigned to it, over all places, 0 where none is, averaged over
    the rooms (MAORIS: Mielle et al., "A method to segment maps from different modalities using free space layout", ICRA 2018).

    Args:
        true, extracted: (n,) labels of all places: those of true rooms and those that the map says are of a room.
        trues: number of true rooms.
        counted: (F,) bool, found rooms that are wrong if they are no true room.
        expected: (trues,) bool, true rooms that should have been found; None: all.
    """
    expected = np.ones(trues, bool) if expected is None else expected
    iou, mcc = compute_overlaps(true, extracted, trues, len(counted))
    iou[~expected] = 0
    assigned = assign(iou)
    rows, taken = np.arange(trues), np.maximum(assigned, 0)
    each, each_mcc = np.zeros(trues), np.zeros(trues)
    if iou.size:
        each = np.where(assigned >= 0, iou[rows, taken], 0.0)
        each_mcc = np.where(assigned >= 0, mcc[rows, taken], 0.0)
    good = each >= HALF
    right = set(assigned[good].tolist())
    claims = len(right | set(np.flatnonzero(counted).tolist()))
    count = int(expected.sum())
    return RoomScores(
        iou=_compute_ratio(float(each.sum()), count),
        precision=_compute_ratio(int(good.sum()), claims),
        recall=_compute_ratio(int(good.sum()), count),
        mcc=_compute_ratio(float(each_mcc[expected].sum()), count),
        each=each,
        each_mcc=each_mcc,
        assigned=assigned,
    )


def match_places(true: Array, extracted: Array, plan: float = PLAN, height: float = PLAN_HEIGHT) -> Array:
    """Return (m, 2) int64 pairs (true, extracted) of places within `plan` metres from above and `height` metres in height, one to
    one: as many as possible, and then the nearest.

    Args:
        true, extracted: (n, 3), m.
    """
    if not len(true) or not len(extracted):
        return np.zeros((0, 2), np.int64)
    apart = cdist(true[:, :2], extracted[:, :2])
    fits = (apart <= plan) & (cdist(true[:, 2:], extracted[:, 2:]) <= height)
    i, j = linear_sum_assignment(np.where(fits, apart, 1e3))
    return np.stack([i, j], axis=1)[fits[i, j]].astype(np.int64)


def score_doors(true: Array, extracted: Array, counted: Array, others: Array | None = None) -> Scores:
    """Score the doors found against true ones, one to one, by where they are (`match_places`).

    Args:
        true: (n, 3) centres of the doors that should be found, m.
        extracted: (m, 3) centres of those of the map.
        counted: (m,) bool, those that are wrong if there is no door; a right one always counts.
        others: (k, 3) centres of doors that need not be found: one found there is neither right nor wrong.
    """
    pairs = match_places(true, extracted)
    left = np.setdiff1d(np.flatnonzero(counted), pairs[:, 1])
    if others is not None and len(left):
        left = np.delete(left, match_places(others, extracted[left])[:, 1])
    return Scores.from_counts(len(pairs), len(true), len(pairs) + len(left))


def score_edges(true: Iterable[Iterable[int]], extracted: Array, assigned: Array, counted: Array) -> Scores:
    """Score connected pairs of rooms found against the true ones, each pair once however many doors it has.

    Args:
        true: pairs of true rooms.
        extracted: (e, 2) pairs of found rooms.
        assigned: (T,) the found room of each true one, -1 none.
        counted: (F,) bool, found rooms that are wrong if they are no true room; pairs with another one are left out.
    """
    requested = {frozenset(map(int, pair)) for pair in true}
    of = np.full(len(counted), -1)
    of[assigned[assigned >= 0]] = np.flatnonzero(assigned >= 0)
    got, false = set(), set()
    for a, b in np.asarray(extracted).reshape(-1, 2).tolist():
        pair = frozenset((int(of[a]), int(of[b])))
        if of[a] >= 0 and of[b] >= 0:
            got.add(pair)
        elif counted[a] and counted[b]:
            false.add(frozenset((a, b)))
    return Scores.from_counts(len(requested & got), len(requested), len(got) + len(false))


def is_storeys_right(true: Array, extracted: Array, within: float = LEVEL) -> bool:
    """Return whether there are as many storeys as there should be, each floor within `within` metres."""
    return len(true) == len(extracted) and bool((np.abs(np.sort(true) - np.sort(extracted)) <= within).all())


def is_on_storey(vertical: float) -> bool:
    """Return whether a pose with this vertical error, m, puts a slice or a drawing on its own storey.

    They tell no height, so that registration takes it from the floors: a slice is laid 0.3 m above one, a drawing on one. On the
    right floor that is within half a metre; another floor is a storey's height off.
    """
    return abs(vertical) < OFF_STOREY


def is_pose_right(error: Sequence[float], flat: bool, limits: tuple[float, float]) -> bool:
    """Return whether a pose is right.

    Args:
        error: horizontal and vertical, m, and of the yaw, degrees.
        flat: one of the maps is a slice or a drawing, which has no height of its own: the distance is the horizontal one, and
            the pose must be `is_on_storey`.
        limits: m, degrees.
    """
    far = error[0] if flat else float(np.hypot(error[0], error[1]))
    return far < limits[0] and error[2] < limits[1] and (not flat or is_on_storey(error[1]))
