"""Maps two by two: hypotheses of where one lies in the other, how well they agree under a pose, and where they contradict it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from topomerge.fusion.atlas.maps import Maps
from topomerge.kernels import registration as align
from topomerge.landmarks.evidence import score_landmarks
from topomerge.matching.match import match
from topomerge.matching.poses import FREE_MARGIN, PlanFields, PoseHypothesis, pair_storeys, pose_difference, refine
from topomerge.registration.judge import Judge
from topomerge.registration.pipeline import refine_by_surfaces, register
from topomerge.registration.verify import score_plausibility
from topomerge.types import Array, Sim3, TopometricMap, are_within

PLACE_REACH = 3.0  # m: what contradicts within this of one spot is one place, about as wide as a room
LEAST_CONFLICT = 0.3  # m2 of walls on free floor of one place, below which it may be noise
SPOT = 0.5  # m, side of the squares by which the densest spot is found
ROOM_SHARE = 0.1  # of the walls of a place that stand in a room, below which the room is not named
PAIR_HYPOTHESES = 6  # of a pair at most
LEAST_PROBABILITY = 0.01  # hypotheses below are left out, but for the best
DRIFT_LIMITS = (1.0, np.radians(4.0), 0.05)  # m, rad, log scale: poses of a pair that are as near are one; drift bends maps
CHECKED_ONCE = (0.08, np.radians(0.4), 0.005)  # m, rad, log scale: poses that are as near are judged once
OVERLAP_FLOOR, OVERLAP_WALLS = 2.0, 0.3  # m2 in common, below both of which two maps do not overlap
POSE_USUAL_CONFLICT = 0.12  # share of the walls on free floor that true poses seldom exceed
CONFLICT_ODDS = 30.0  # log odds against a pose, of each share of 1 above that
# Log odds against a pose, at most, of one place at which the maps contradict each other, and of each further one: a room may have
# been altered. Of 66 right poses of simulated training pairs, 16 have such a place or two; of 81 wrong ones with more than the
# usual share, 2 have one, 13 have two, and half of them six or more.
ONE_PLACE_ODDS, FURTHER_PLACE_ODDS = 0.6, 1.5
MOST_AGAINST = 6.0  # log odds
LANDMARKS_FOR = 3.0  # log odds that landmarks may say for a pose that other maps propose
PLACE_HALF_WIDTH = 1.0  # m, of the place by which a pose is measured
SAMPLED_COLUMNS = 4000
T = TypeVar("T")


@dataclass(frozen=True)
class Conflict:
    """A place at which two maps contradict each other.

    Args:
        middle: m, on the floor, in the frame of the first map.
        area: m2 of walls that stand on free floor of the other map.
    """

    middle: tuple[float, float, float]
    area: float

    def transform(self, pose: Sim3) -> Conflict:
        """Return the same place in another frame."""
        x, y, z = pose.apply(np.array([self.middle]))[0].tolist()
        return replace(self, middle=(x, y, z))


@dataclass(frozen=True)
class Contradiction:
    """A place at which two maps that were joined contradict each other; both versions are kept.

    Args:
        maps: i and j.
        rooms: of map i and of map j, by their numbers, in which it lies.
        middle: m, in the frame of the component.
        area: m2 of walls that stand on free floor of the other map.
    """

    maps: tuple[int, int]
    rooms: tuple[tuple[int, ...], tuple[int, ...]]
    middle: tuple[float, float, float]
    area: float


def find_conflict_columns(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """Return (n, 4) place in a's frame and area (half of it, as both maps are asked) of the walls on free floor under T_ab, m and
    m2."""
    rows = [np.zeros((0, 4))]
    for v, w in pair_storeys(a, b, pose.translation[2], pose.scale):
        sides = ((w, v, pose, pose.scale**2), (v, w, pose.inverse(), 1.0))
        for n, (source, target, move, grown) in enumerate(sides):
            walls = source.walls
            moved = move.apply(np.column_stack([walls, np.zeros(len(walls))]))[:, :2]
            cells = np.floor((moved - target.plan.origin) / target.plan.edge).astype(np.int64)
            inside = are_within(cells, 0, target.plan.wall.shape)
            x, y = np.where(inside[:, None], cells, 0).T
            clash = inside & (target.kind[x, y] == align.FREE_STATE) & (target.to_any[x, y] >= FREE_MARGIN)
            at = (moved if n == 0 else walls)[clash]
            half = np.full(len(at), source.plan.edge**2 * grown / 2)
            rows.append(np.column_stack([at, np.full(len(at), v.plan.floor_guess), half]))
    return np.concatenate(rows)


def find_conflicts(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> tuple[Conflict, ...]:
    """Return places at which maps a and b contradict each other under T_ab, the largest first."""
    columns = find_conflict_columns(a, b, pose)
    found = []
    while columns[:, 3].sum() >= LEAST_CONFLICT:
        spots, owner = np.unique(np.floor(columns[:, :2] / SPOT), axis=0, return_inverse=True)
        area = np.bincount(owner.reshape(-1), weights=columns[:, 3])
        middles = (spots + 0.5) * SPOT
        near = np.linalg.norm(middles[:, None] - middles, axis=2) <= PLACE_REACH
        best = int((near @ area).argmax())
        taken = near[best][owner.reshape(-1)]
        weight = columns[taken, 3]
        if weight.sum() < LEAST_CONFLICT:
            break
        x, y, z = (columns[taken, :3] * weight[:, None]).sum(axis=0) / weight.sum()
        found.append(Conflict((float(x), float(y), float(z)), float(weight.sum())))
        columns = columns[~taken]
    return tuple(found)


def sum_places(costs: Iterable[tuple[Array, float]]) -> float:
    """Return the sum of the costs of places (3,), each place once: of those that several pairs show, the highest.

    Args:
        costs: middle of a place, m, in one frame for all, and its cost.
    """
    distinct: list[tuple[Array, float]] = []
    for middle, cost in sorted(costs, key=lambda entry: -entry[1]):
        if all(np.linalg.norm(middle - other) > PLACE_REACH for other, _ in distinct):
            distinct.append((middle, cost))
    return sum(cost for _, cost in distinct)


def locate_contradiction(
    pair: tuple[int, int], conflict: Conflict, maps: tuple[TopometricMap, TopometricMap], pose: Sim3, columns: Array, frame: Sim3
) -> Contradiction:
    """Return a conflict of two joined maps with the rooms in which it lies.

    Args:
        maps: i and j.
        pose: T_ij.
        columns: of `find_conflict_columns`.
        frame: of map i in its component.
    """
    near = columns[np.linalg.norm(columns[:, :2] - conflict.middle[:2], axis=1) <= PLACE_REACH, :3]
    rooms = find_rooms_near(maps[0], near), find_rooms_near(maps[1], pose.inverse().apply(near))
    return Contradiction(pair, rooms, conflict.transform(frame).middle, conflict.area)


def find_rooms_near(map: TopometricMap, at: Array) -> tuple[int, ...]:
    """Return rooms on whose floor places (n, 3), m, lie, or the nearest floor; those that hold a tenth of the places at least."""
    if not len(at) or not len(map.navigable):
        return ()
    distance, nearest = cKDTree(map.navigable.compute_centroids()).query(at, distance_upper_bound=PLACE_REACH)
    rooms = map.navigable_room[nearest[np.isfinite(distance)]]
    counts = np.bincount(rooms[rooms >= 0], minlength=1)
    return tuple(int(room) for room in np.flatnonzero(counts >= max(ROOM_SHARE * len(at), 1)))


def serialise_contradiction(c: Contradiction) -> dict[str, Any]:
    """Return a contradiction as plain values: numbers of both maps, rooms of each, its middle, m, and the area of the walls,
    m2."""
    return {"maps": c.maps, "rooms": c.rooms, "at": [round(v, 2) for v in c.middle], "m2": round(c.area, 2)}


@dataclass(frozen=True)
class Check:
    """The check of a pose T_ij by its two maps.

    Args:
        pose: after it was moved to where the walls meet.
        log_odds: what speaks for it (above 0) or against it; 0 where the maps hardly overlap.
        overlap: do they?
        features: of `verify.Judge`.
        conflicts: places at which they contradict each other more than true poses do.
    """

    pose: Sim3
    log_odds: float
    overlap: bool
    features: Mapping[str, float]
    conflicts: tuple[Conflict, ...] = ()


def find_hypotheses(
    maps: Maps, i: int, j: int, scale: str = "fixed", same: str = "nothing", proposed: Sequence[Sim3] = ()
) -> tuple[PoseHypothesis, ...]:
    """Find the poses of map j in map i, most probable first, each with its share of the probability of a right one.

    Args:
        proposed: poses T_ij that are tried beside those that are looked for.
    """
    poses = [*(_propose_room_poses(maps, i, j, scale) if maps.matched else []), *proposed]
    registration = register(maps.get_prepared(i), maps.get_prepared(j), scale=scale, proposed=poses, same=same)
    if registration.transform is None or not registration.alternatives:
        return ()
    best, probability = registration.alternatives[0].score, registration.probability
    ranked = [PoseHypothesis(registration.transform, probability=probability, features=registration.features)]
    for other in registration.alternatives[1:PAIR_HYPOTHESES]:
        share = probability * float(np.exp(other.score - best))
        if share >= LEAST_PROBABILITY:
            ranked.append(replace(other, probability=min(share, 1 - probability)))
    return tuple(ranked)


def _propose_room_poses(maps: Maps, i: int, j: int, scale: str) -> list[Sim3]:
    """Propose the poses T_ij of matched rooms."""
    if maps.get_prepared(j).order < maps.get_prepared(i).order:
        return [pose.inverse() for pose in _propose_room_poses(maps, j, i, scale)]
    a, b = maps[i], maps[j]
    if not len(a.rooms) or not len(b.rooms):
        return []
    descriptors = {id(a): maps.get_rows(i), id(b): maps.get_rows(j)}
    return [h.transform for h in match(a, b, lambda m: descriptors[id(m)], scale_free=scale == "free").alternatives]


class Checks:
    """Answers what a pair of maps says to a pose; poses that are one are judged once."""

    def __init__(self, maps: Maps, scaled: bool = False) -> None:
        self.maps, self.scaled = maps, scaled
        self._checks: dict[tuple[int, int], list[tuple[Sim3, Check]]] = {}
        self._fine: dict[tuple[int, int], list[tuple[Sim3, Sim3]]] = {}
        self._places: dict[tuple[int, int], list[tuple[Sim3, Array]]] = {}

    def locate_place(self, i: int, j: int, pose: Sim3) -> Array:
        """Return the place (`locate_place`) of maps i and j (i < j) under T_ij."""

        def compute() -> Array:
            return locate_place(self.maps.get_prepared(i).storeys, self.maps.get_prepared(j).storeys, pose)

        def make() -> Array:
            return self.maps.answer(("place", pose), (i, j), compute)

        return _get_or_compute(self._places, (i, j), pose, self.maps.get_middle(j), make)

    def refine_pose(self, i: int, j: int, pose: Sim3) -> Sim3:
        """Return T_ij after the fine registration (i < j); as it was where a map is a slice, which has no planes."""
        if self.maps.is_sliced(i) or self.maps.is_sliced(j):
            return pose

        def compute() -> Sim3:
            return refine_by_surfaces(self.maps.get_prepared(i), self.maps.get_prepared(j), pose, self.scaled)[0]

        def make() -> Sim3:
            return self.maps.answer(("fine", pose, self.scaled), (i, j), compute)

        return _get_or_compute(self._fine, (i, j), pose, self.maps.get_middle(j), make)

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        """Check T_ij by maps i and j."""
        if j < i:
            turned = self(j, i, pose.inverse())
            back = turned.pose.inverse()
            conflicts = tuple(c.transform(back) for c in turned.conflicts)
            return Check(back, turned.log_odds, turned.overlap, turned.features, conflicts)

        def make() -> Check:
            return self.maps.answer(("check", pose, self.scaled), (i, j), lambda: self._judge_pose(i, j, pose))

        return _get_or_compute(self._checks, (i, j), pose, self.maps.get_middle(j), make)

    def _judge_pose(self, i: int, j: int, pose: Sim3) -> Check:
        a, b = self.maps.get_prepared(i).storeys, self.maps.get_prepared(j).storeys
        if not len(sample_common_points(a, b, pose)):
            return Check(pose, 0.0, False, {})
        judge = Judge(a, b)
        moved, features = pose, judge(pose)
        for candidate in refine(a, b, [PoseHypothesis(pose, from_rooms=True)], self.scaled):
            moved_features = judge(candidate.transform)
            if is_same_pose(candidate.transform, pose, locate_place(a, b, pose).mean(axis=0)) and score_pose(
                moved_features
            ) > score_pose(features):
                moved, features = candidate.transform, moved_features
        if features["free"] < OVERLAP_FLOOR and features["walls"] < OVERLAP_WALLS:
            return Check(moved, 0.0, False, features)
        conflicts = find_conflicts(a, b, moved) if compute_excess_conflict(features) else ()
        landmarks = self._score_landmarks(i, j, moved)
        return Check(moved, score_pose(features, conflicts) + landmarks, True, features, conflicts)

    def _score_landmarks(self, i: int, j: int, pose: Sim3) -> float:
        """Return the log odds of what landmarks say of T_ij, at most as much as walls may say."""
        if not (self.maps.get_prepared(i).has_landmarks and self.maps.get_prepared(j).has_landmarks):
            return 0.0
        support = score_landmarks(self.maps[i], self.maps[j], pose).support
        return float(np.clip(support, -MOST_AGAINST, LANDMARKS_FOR))


def _get_or_compute(
    memory: dict[tuple[int, int], list[tuple[Sim3, T]]], pair: tuple[int, int], pose: Sim3, at: Array, make: Callable[[], T]
) -> T:
    """Get the value of a pair under the same pose from the memory, or compute it now."""
    entries = memory.setdefault(pair, [])
    for other, value in entries:
        if is_same_pose(pose, other, at, CHECKED_ONCE):
            return value
    entries.append((pose, make()))
    return entries[-1][1]


def compute_excess_conflict(f: Mapping[str, float]) -> float:
    """Return the share of the walls that stand on free floor of the other map, above what true poses have; 0 where it is so
    little that it may be noise."""
    return max(f["conflict_share"] - POSE_USUAL_CONFLICT, 0.0) if f["conflict"] > LEAST_CONFLICT else 0.0


def score_pose(f: Mapping[str, float], conflicts: Sequence[Conflict] | None = None) -> float:
    """Return the log odds for a pose that other maps propose. Little in common says little: only walls on free floor speak
    against it.

    Of hypotheses of simulated training pairs, nine in ten of the right ones have a plausibility above -4, one in twenty of the
    wrong ones; walls on free floor are more than `POSE_USUAL_CONFLICT` of the walls in one of twenty right ones, in three of four
    wrong ones.

    Args:
        f: features of `verify.Judge`.
        conflicts: places at which the maps contradict each other; what is scattered beside them counts as further places. If
            None, it may be everywhere.
    """
    support = float(np.clip(score_plausibility(f) + 3.0, 0.0, 3.0))
    excess = compute_excess_conflict(f)
    most = MOST_AGAINST
    if conflicts is not None:
        scattered = max(f["conflict"] - sum(c.area for c in conflicts), 0.0) / LEAST_CONFLICT
        most = min(ONE_PLACE_ODDS + FURTHER_PLACE_ODDS * max(len(conflicts) + scattered - 1, 0.0), MOST_AGAINST)
    return support - min(CONFLICT_ODDS * excess, most)


def is_same_pose(p: Sim3, q: Sim3, at: Array, limits: tuple[float, float, float] = DRIFT_LIMITS) -> bool:
    """Return whether two poses of a map are one, near a point (3,) of it."""
    return all(d <= limit for d, limit in zip(pose_difference(p, q, at), limits, strict=True))


def sample_common_points(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """Return (n, 3) points of b's floors, a sample, where both maps know something under T_ab."""
    samples = [np.zeros((0, 3))]
    for v, w in pair_storeys(a, b, pose.translation[2], pose.scale):
        rows = np.argwhere(w.plan.explored)
        rows = rows[:: max(len(rows) // SAMPLED_COLUMNS, 1)]
        at = np.column_stack([w.plan.origin + (rows + 0.5) * w.plan.edge, np.full(len(rows), w.plan.floor_guess)])
        placed = np.floor((pose.apply(at)[:, :2] - v.plan.origin) / v.plan.edge).astype(np.int64)
        inside = are_within(placed, 0, v.plan.wall.shape)
        samples.append(at[inside][v.plan.explored[tuple(placed[inside].T)]])
    return np.concatenate(samples)


def locate_place(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """Return (5, 3) points of b that stand for the place which both maps saw: its middle, and as far from it as it is wide."""
    points = sample_common_points(a, b, pose)
    if not len(points):
        points = np.append(b[0].middle, 0.0)[None]
    middle, (x, y, _) = points.mean(axis=0), np.maximum(points.std(axis=0), PLACE_HALF_WIDTH)
    spread: Array = middle + np.array([[0, 0, 0], [x, 0, 0], [-x, 0, 0], [0, y, 0], [0, -y, 0]])
    return spread
