"""Sets of matches that one transform explains, several kept alive (beyond the thesis; findings: "matching alone is not the end").

Pairs of rooms that may be one vote with their doors in the space of poses; the poses with most votes are laid over the plan of
the other map, moved so that walls meet, and ranked by walls that agree less walls that stand in what the other map saw empty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from topomerge.kernels.poses import pose_evidence
from topomerge.matching.assignment import by_overlap
from topomerge.matching.costs import best_partners
from topomerge.matching.door_poses import door_poses, middle_poses, scaled_poses
from topomerge.matching.odds import CONFLICT, FLOOR, hypothesis_probability
from topomerge.matching.poses import PoseArrays, PoseHypothesis, PoseTolerance, distinct, joined_poses
from topomerge.matching.refinement import refine
from topomerge.matching.room_plans import RoomPlans, room_plans
from topomerge.types import Array, Sim3, TopometricMap

SAME_MATCHING = PoseTolerance(0.5, float(np.radians(5)), 0.05)


@dataclass(frozen=True)
class ConsistencySettings:
    """Args:
    partners: of a room, that are tried.
    samples: of walls and of floor, of the first look at a pose and of the last.
    sigmas: m, of the agreement of walls, likewise.
    refined: poses that are moved until walls meet.
    voters: poses; votes of neighbours are not counted among more.
    overlaid: columns of floor, laid over each other to tell the rooms in common.
    storey_gap: m by which floors of one storey may differ.
    same: poses closer than this are one.
    vote_reach: m by which votes of matches by attention for one pose differ.
    least_voter: certainty of a match by attention, from which on it votes for a pose.
    shortlist: share of the best agreement, below which a hypothesis ranks after all others.
    """

    partners: int = 5
    samples: tuple[int, int] = (300, 2000)
    sigmas: tuple[float, float] = (0.25, 0.15)
    refined: int = 60
    voters: int = 20_000
    overlaid: int = 20_000
    storey_gap: float = 0.7
    same: PoseTolerance = SAME_MATCHING
    vote_reach: float = 0.7
    least_voter: float = 0.05
    shortlist: float = 0.6


CONSISTENCY = ConsistencySettings()
NEAR_SCALE = 1.16  # factor by which the scale of a pose differs from that at which rooms look most alike


class Sampled(NamedTuple):
    """What of a map is laid over the other's plan."""

    places: Array
    storey: Array
    is_wall: Array
    each: Array


def hypotheses(
    a: TopometricMap,
    b: TopometricMap,
    cost: Array,
    similarity: Array,
    scale_free: bool = False,
    number: int = 10,
    scale: float | None = None,
) -> tuple[PoseHypothesis, ...]:
    """Up to `number` ways to lay b onto a, best first.

    Args:
        cost, similarity: (R_a, R_b) of the descriptors.
        scale_free: is the scale of b unknown?
        scale: about what it is then, m, if that is known.
    """
    plans = (room_plans(a), room_plans(b))
    pairs = best_partners(cost, CONSISTENCY.partners)
    poses = candidate_poses(a, b, plans, pairs, similarity[tuple(pairs.T)] + 1e-3, scale_free, scale)
    if not len(poses):
        return ()
    poses = best_of(poses, _scores(poses, plans, 0)[:, 0] + votes(poses), plans[1].middle, CONSISTENCY.refined)
    proposed = [PoseHypothesis(poses.transform(k), from_rooms=True) for k in range(len(poses))]
    moved = refine(plans[0].fields, plans[1].fields, proposed, scale_free)
    if moved:  # else there are no walls to go by
        poses = PoseArrays.of([h.transform for h in moved])
    poses = best_of(poses, _scores(poses, plans, 1)[:, 0], plans[1].middle, number)
    return rank(poses, _scores(poses, plans, 1), plans)


def best_of(poses: PoseArrays, score: Array, point: Array, number: int) -> PoseArrays:
    """Up to `number` poses of the highest score (H,), best first, none like a better one at a point (3,) of b."""
    poses = poses.take(np.argsort(-score, kind="stable"))
    return poses.take(distinct(poses, point, CONSISTENCY.same, number))


def candidate_poses(
    a: TopometricMap,
    b: TopometricMap,
    plans: tuple[RoomPlans, RoomPlans],
    pairs: Array,
    weight: Array,
    scale_free: bool,
    scale: float | None = None,
) -> PoseArrays:
    """Poses of all doors of all pairs, and of middles of the rooms; of unknown scale those about a scale, if there is one."""
    if not scale_free:
        return joined_poses(door_poses(a, b, plans, pairs, weight), middle_poses(a, b, plans, pairs, 0.2 * weight))
    if scale is None:
        return joined_poses(door_poses(a, b, plans, pairs, weight), scaled_poses(a, b, plans, pairs, weight))
    return scaled_poses(a, b, plans, pairs, weight, (scale / NEAR_SCALE, scale * NEAR_SCALE))


def voted_pose(a: TopometricMap, b: TopometricMap, certain: Array, scale: float | None = None) -> Sim3 | None:
    """The pose T_ab that most doors and middles of matched rooms vote for, with no look at walls; None where none match.

    Args:
        certain: (R_a, R_b) how sure each match is; each votes with that.
        scale: about that of b, m, if it is not a metre; the pose has its own.
    """
    pairs = np.argwhere(certain > CONSISTENCY.least_voter)
    if not len(pairs):
        return None
    plans = (room_plans(a), room_plans(b))
    poses = candidate_poses(a, b, plans, pairs, certain[tuple(pairs.T)], scale is not None, scale)
    if not len(poses):
        return None
    at = np.column_stack([poses.places(plans[1].middle), 6 * np.cos(poses.yaw), 6 * np.sin(poses.yaw)])  # 10 degrees are 1 m
    near = cKDTree(at).query_ball_point(at, CONSISTENCY.vote_reach, return_sorted=True)
    best = int(np.argmax([poses.weight[n].sum() for n in near]))
    off = np.average(at[near[best], :3], axis=0, weights=poses.weight[near[best]]) - at[best, :3]
    pose = poses.transform(best)
    x, y, z = (off + pose.translation).tolist()
    return replace(pose, translation=(x, y, z))


def votes(poses: PoseArrays) -> Array:
    """(H,) logarithm of 1 + the weight of all poses that lay the map within 1 m and 10 degrees of each."""
    turn = 6 * np.stack([np.cos(poses.yaw), np.sin(poses.yaw), 3 * np.log(poses.scale)], axis=1)  # 10 degrees are 1 m
    place = np.concatenate([poses.shift, turn], axis=1)
    if len(place) > CONSISTENCY.voters:
        return np.log1p(poses.weight)
    near = cKDTree(place).query_ball_point(place, 1.0, return_sorted=False)
    return np.log1p(np.array([poses.weight[n].sum() for n in near]))


def _scores(poses: PoseArrays, plans: tuple[RoomPlans, RoomPlans], look: int) -> Array:
    """(H, 4) score, m of walls that agree, m that conflict, m2 of floor in common; the mean of b on a and of a on b.

    Args:
        look: 0 the first one, 1 the last one, with more samples.
    """
    out = np.zeros((len(poses.yaw), 3))
    size = np.sqrt(poses.scale)  # of a length in the middle of both maps
    back = poses.inverse()
    sigma = CONSISTENCY.sigmas[look]
    for which, (to, moved) in enumerate((plans, plans[::-1])):
        s = Sampled(*moved.samples(CONSISTENCY.samples[look]))
        p = poses if which == 0 else back
        matrix = np.stack([p.scale * np.cos(p.yaw), p.scale * np.sin(p.yaw), p.shift[:, 0], p.shift[:, 1]], axis=1)
        storeys = storey_map(p, to.floors, moved.floors)
        counts = pose_evidence(matrix, storeys, s.places, s.storey, s.is_wall, to.distance, to.floor, to.origin, to.edge, sigma)
        unit = (size if which == 0 else 1 / size) * moved.edge
        out[:, 0] += 0.5 * counts[:, 0] * s.each[0] * unit / 2  # walls are about two columns thick
        out[:, 1] += 0.5 * counts[:, 1] * s.each[0] * unit / 2
        out[:, 2] += 0.5 * counts[:, 2] * s.each[1] * unit**2
    score = out[:, 0] - CONFLICT * out[:, 1] + FLOOR * out[:, 2]
    return np.concatenate([score[:, None], out], axis=1)


def storey_map(poses: PoseArrays, to: Array, floors: Array) -> Array:
    """(H, S_b) storey of `to` that each storey of `floors` falls on, -1 none."""
    height = poses.scale[:, None] * floors[None] + poses.shift[:, 2:]
    off = abs(height[:, :, None] - to[None, None])
    best = off.argmin(axis=2)
    return np.where(np.take_along_axis(off, best[:, :, None], 2)[:, :, 0] <= CONSISTENCY.storey_gap, best, -1).astype(np.int64)


def rank(poses: PoseArrays, evidence: Array, plans: tuple[RoomPlans, RoomPlans]) -> tuple[PoseHypothesis, ...]:
    """Hypotheses with their matches: those that reach 0.6 of the best agreement first, by score."""
    agree = evidence[:, 1] + FLOOR * evidence[:, 3]
    short = agree >= CONSISTENCY.shortlist * agree.max()
    order = np.lexsort((-evidence[:, 0], ~short))
    chance = hypothesis_probability(evidence[:, 1:])
    ranked = []
    for h in order.tolist():
        pose = poses.transform(h)
        rooms, fit = matches_under(pose, plans)
        features = dict(zip(("agree_m", "conflict_m", "floor_m2"), evidence[h, 1:].round(3).tolist(), strict=True))
        ranked.append(PoseHypothesis(pose, float(evidence[h, 0]), float(chance[h]), features, True, rooms, fit))
    return tuple(ranked)


def matches_under(
    transform: Sim3, plans: tuple[RoomPlans, RoomPlans], lay: Callable[[Array], Array] | None = None
) -> tuple[Array, Array]:
    """(M, 2) rooms whose footprints meet under a transform T_ab and (M,) how well they fit (see `by_overlap`).

    Args:
        lay: where the points (n, 3) of b lie in a, if not exactly where the transform puts them.
    """
    return by_overlap(common_floor(transform, plans, lay), plans[0].areas, plans[1].areas * transform.scale**2)


def common_floor(transform: Sim3, plans: tuple[RoomPlans, RoomPlans], lay: Callable[[Array], Array] | None = None) -> Array:
    """(R_a, R_b) m2 in a of the floor that each room of a shares with each of b under a transform T_ab.

    Args:
        lay: as of `matches_under`.
    """
    a, b = plans
    storeys = storey_map(PoseArrays.of([transform]), a.floors, b.floors)[0]
    storey, x, y = np.nonzero(b.footprint >= 0)
    step = max(len(x) // CONSISTENCY.overlaid, 1)
    storey, x, y = storey[::step], x[::step], y[::step]
    room = b.footprint[storey, x, y]
    places = b.origin + (np.stack([x, y], axis=1) + 0.5) * b.edge
    at = (lay or transform.apply)(np.column_stack([places, b.floors[storey]]))[:, :2]
    cell = np.floor((at - a.origin) / a.edge).astype(int)
    on = storeys[storey]
    inside = (cell >= 0).all(axis=1) & (cell < a.footprint.shape[1:]).all(axis=1) & (on >= 0)
    other = a.footprint[on[inside], cell[inside, 0], cell[inside, 1]]
    hit = other >= 0
    common = np.zeros((len(a.areas), len(b.areas)))
    np.add.at(common, (other[hit], room[inside][hit]), step * (transform.scale * b.edge) ** 2)
    return common
