"""What an atlas knows of its maps two by two: hypotheses of where one lies in the other, and how well they agree under a pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from topomerge.fusion.atlas.contradictions import LEAST_CONFLICT, Conflict, find_conflicts
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.judge import Judge
from topomerge.fusion.pose_difference import pose_difference
from topomerge.fusion.registration import fine, register
from topomerge.fusion.verify import plausibility
from topomerge.matching.match import match
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.refinement import refine, storeys_at
from topomerge.types import Array, Sim3

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
PLACE_HALF_WIDTH = 1.0  # m, of the place by which a pose is measured
SAMPLED_COLUMNS = 4000
T = TypeVar("T")


@dataclass(frozen=True)
class Check:
    """What two maps say to a pose T_ij.

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


def hypotheses(
    maps: Maps, i: int, j: int, scale: str = "fixed", same: str = "nothing", proposed: Sequence[Sim3] = ()
) -> tuple[PoseHypothesis, ...]:
    """Where map j may lie in map i, most probable first; each with its share of the probability that one of them is right.

    Args:
        proposed: poses T_ij that are tried beside those that are looked for.
    """
    poses = [*(_room_poses(maps, i, j, scale) if maps.matched else []), *proposed]
    registration = register(maps.prepared(i), maps.prepared(j), scale=scale, proposed=poses, same=same)
    if registration.transform is None or not registration.alternatives:
        return ()
    best, probability = registration.alternatives[0].score, registration.probability
    ranked = [PoseHypothesis(registration.transform, probability=probability, features=registration.features)]
    for other in registration.alternatives[1:PAIR_HYPOTHESES]:
        share = probability * float(np.exp(other.score - best))
        if share >= LEAST_PROBABILITY:
            ranked.append(replace(other, probability=min(share, 1 - probability)))
    return tuple(ranked)


def _room_poses(maps: Maps, i: int, j: int, scale: str) -> list[Sim3]:
    """Poses T_ij of matched rooms."""
    if maps.prepared(j).order < maps.prepared(i).order:
        return [pose.inverse() for pose in _room_poses(maps, j, i, scale)]
    a, b = maps[i], maps[j]
    if not len(a.rooms) or not len(b.rooms):
        return []
    descriptors = {id(a): maps.rows(i), id(b): maps.rows(j)}
    return [h.transform for h in match(a, b, lambda m: descriptors[id(m)], scale_free=scale == "free").alternatives]


class Checks:
    """Answers what a pair of maps says to a pose; poses that are one are judged once."""

    def __init__(self, maps: Maps, scaled: bool = False) -> None:
        self.maps, self.scaled = maps, scaled
        self._checks: dict[tuple[int, int], list[tuple[Sim3, Check]]] = {}
        self._fine: dict[tuple[int, int], list[tuple[Sim3, Sim3]]] = {}
        self._places: dict[tuple[int, int], list[tuple[Sim3, Array]]] = {}

    def place(self, i: int, j: int, pose: Sim3) -> Array:
        """`place` of maps i and j (i < j) under T_ij."""

        def made() -> Array:
            return place(self.maps.prepared(i).storeys, self.maps.prepared(j).storeys, pose)

        def make() -> Array:
            return self.maps.answer(("place", pose), (i, j), made)

        return _once(self._places, (i, j), pose, self.maps.middle(j), make)

    def fine(self, i: int, j: int, pose: Sim3) -> Sim3:
        """T_ij after the fine registration (i < j); as it was where a map is a slice, which has no planes."""
        if self.maps.sliced(i) or self.maps.sliced(j):
            return pose

        def made() -> Sim3:
            return fine(self.maps.prepared(i), self.maps.prepared(j), pose, self.scaled)[0]

        def make() -> Sim3:
            return self.maps.answer(("fine", pose, self.scaled), (i, j), made)

        return _once(self._fine, (i, j), pose, self.maps.middle(j), make)

    def __call__(self, i: int, j: int, pose: Sim3) -> Check:
        """What maps i and j say to T_ij."""
        if j < i:
            turned = self(j, i, pose.inverse())
            back = turned.pose.inverse()
            conflicts = tuple(c.moved(back) for c in turned.conflicts)
            return Check(back, turned.log_odds, turned.overlap, turned.features, conflicts)

        def make() -> Check:
            return self.maps.answer(("check", pose, self.scaled), (i, j), lambda: self._judged(i, j, pose))

        return _once(self._checks, (i, j), pose, self.maps.middle(j), make)

    def _judged(self, i: int, j: int, pose: Sim3) -> Check:
        a, b = self.maps.prepared(i).storeys, self.maps.prepared(j).storeys
        if not len(common_points(a, b, pose)):
            return Check(pose, 0.0, False, {})
        judge = Judge(a, b)
        moved, features = pose, judge(pose)
        for candidate in refine(a, b, [PoseHypothesis(pose, from_rooms=True)], self.scaled):
            again = judge(candidate.transform)
            if alike(candidate.transform, pose, place(a, b, pose).mean(axis=0)) and score_pose(again) > score_pose(features):
                moved, features = candidate.transform, again
        if features["free"] < OVERLAP_FLOOR and features["walls"] < OVERLAP_WALLS:
            return Check(moved, 0.0, False, features)
        conflicts = find_conflicts(a, b, moved) if excess_conflict(features) else ()
        return Check(moved, score_pose(features, conflicts), True, features, conflicts)


def _once(
    memory: dict[tuple[int, int], list[tuple[Sim3, T]]], pair: tuple[int, int], pose: Sim3, at: Array, make: Callable[[], T]
) -> T:
    """What was made for a pair under a pose that is the same, or what is made now."""
    entries = memory.setdefault(pair, [])
    for other, value in entries:
        if alike(pose, other, at, CHECKED_ONCE):
            return value
    entries.append((pose, make()))
    return entries[-1][1]


def excess_conflict(f: Mapping[str, float]) -> float:
    """Share of the walls that stand on free floor of the other map, above what true poses have; 0 where it is so little that it
    may be noise."""
    return max(f["conflict_share"] - POSE_USUAL_CONFLICT, 0.0) if f["conflict"] > LEAST_CONFLICT else 0.0


def score_pose(f: Mapping[str, float], conflicts: Sequence[Conflict] | None = None) -> float:
    """Log odds for a pose that other maps propose. Little in common says little: only walls on free floor speak against it.

    Of hypotheses of simulated training pairs, nine in ten of the right ones have a plausibility above -4, one in twenty of the
    wrong ones; walls on free floor are more than `POSE_USUAL_CONFLICT` of the walls in one of twenty right ones, in three of four
    wrong ones.

    Args:
        f: features of `verify.Judge`.
        conflicts: places at which the maps contradict each other; what is scattered beside them counts as further places. If
            None, it may be everywhere.
    """
    support = float(np.clip(plausibility(f) + 3.0, 0.0, 3.0))
    excess = excess_conflict(f)
    most = MOST_AGAINST
    if conflicts is not None:
        scattered = max(f["conflict"] - sum(c.area for c in conflicts), 0.0) / LEAST_CONFLICT
        most = min(ONE_PLACE_ODDS + FURTHER_PLACE_ODDS * max(len(conflicts) + scattered - 1, 0.0), MOST_AGAINST)
    return support - min(CONFLICT_ODDS * excess, most)


def alike(p: Sim3, q: Sim3, at: Array, limits: tuple[float, float, float] = DRIFT_LIMITS) -> bool:
    """Are two poses of a map one, near a point (3,) of it?"""
    return all(d <= limit for d, limit in zip(pose_difference(p, q, at), limits, strict=True))


def common_points(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """(n, 3) points of b's floors, a sample, where both maps know something under T_ab."""
    samples = [np.zeros((0, 3))]
    for v, w in storeys_at(a, b, pose.translation[2], pose.scale):
        rows = np.argwhere(w.plan.explored)
        rows = rows[:: max(len(rows) // SAMPLED_COLUMNS, 1)]
        at = np.column_stack([w.plan.origin + (rows + 0.5) * w.plan.edge, np.full(len(rows), w.plan.floor_guess)])
        there = np.floor((pose.apply(at)[:, :2] - v.plan.origin) / v.plan.edge).astype(np.int64)
        inside = ((there >= 0) & (there < v.plan.wall.shape)).all(axis=1)
        samples.append(at[inside][v.plan.explored[tuple(there[inside].T)]])
    return np.concatenate(samples)


def place(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Array:
    """(5, 3) points of b that stand for the place which both maps saw: its middle, and as far from it as it is wide."""
    points = common_points(a, b, pose)
    if not len(points):
        points = np.append(b[0].middle, 0.0)[None]
    middle, (x, y, _) = points.mean(axis=0), np.maximum(points.std(axis=0), PLACE_HALF_WIDTH)
    spread: Array = middle + np.array([[0, 0, 0], [x, 0, 0], [-x, 0, 0], [0, y, 0], [0, -y, 0]])
    return spread
