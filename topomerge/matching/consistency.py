"""Sets of matches that one transform explains, several kept alive (beyond the thesis; findings: "matching alone is not the end").

Pairs of rooms that may be one vote with their doors in the space of poses; the poses with most votes are laid over the plan of
the other map, moved so that walls meet, and ranked by walls that agree less walls that stand in what the other map saw empty.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from topomerge.kernels.poses import pose_evidence
from topomerge.matching.assignment import by_overlap
from topomerge.matching.costs import best_partners
from topomerge.matching.door_poses import door_poses, middle_poses, scaled_poses
from topomerge.matching.odds import CONFLICT, FLOOR, hypothesis_probability
from topomerge.matching.poses import PoseArrays, PoseHypothesis, joined_poses
from topomerge.matching.topdown import TopDown, top_down
from topomerge.types import Array, Sim3, TopometricMap

CANDIDATES = 5  # partners of a room
COARSE, FINE = 300, 2000  # samples of walls and of floor
SIGMAS = (0.25, 0.15)  # m, of agreement: of the first look and of the last
REFINED = 60  # poses that are moved until walls meet
COLUMNS = 20_000  # of floor, laid over each other to find the rooms in common
TRIMS = (0.8, 0.6, 0.45, 0.35, 0.3, 0.3)  # m, walls farther apart do not count, round by round
MANY = 20_000  # poses: neighbours are not looked for among more
FEWEST = 10  # walls that meet; fewer move nothing
STOREY = 0.7  # m by which floors of one storey may differ
SAME = (0.5, np.radians(5), 0.05)  # m, rad, share: poses closer than this are one
SHORTLIST = 0.6  # of the best agreement


class Sampled(NamedTuple):
    """What of a map is laid over the other's plan."""

    places: Array
    storey: Array
    is_wall: Array
    each: Array


def hypotheses(
    a: TopometricMap, b: TopometricMap, cost: Array, similarity: Array, scale_free: bool = False, number: int = 10
) -> tuple[PoseHypothesis, ...]:
    """Up to `number` ways to lay b onto a, best first.

    Args:
        cost, similarity: (R_a, R_b) of the descriptors.
        scale_free: is the scale of b unknown?
    """
    plans = (top_down(a), top_down(b))
    pairs = best_partners(cost, CANDIDATES)
    weight = similarity[tuple(pairs.T)] + 1e-3
    poses = candidate_poses(a, b, plans, pairs, weight, scale_free)
    if not len(poses.yaw):
        return ()
    coarse = _scores(poses, plans, COARSE, SIGMAS[0])[:, 0] + votes(poses)
    poses = refined(poses.take(distinct(poses, coarse, REFINED)), plans, scale_free)
    evidence = _scores(poses, plans, FINE, SIGMAS[1])
    kept = distinct(poses, evidence[:, 0], number)
    return rank(poses.take(kept), evidence[kept], plans)


def candidate_poses(
    a: TopometricMap, b: TopometricMap, plans: tuple[TopDown, TopDown], pairs: Array, weight: Array, scale_free: bool
) -> PoseArrays:
    """Poses of all doors of all pairs, and of middles of the rooms."""
    if scale_free:
        return joined_poses(door_poses(a, b, plans, pairs, weight), scaled_poses(a, b, plans, pairs, weight))
    return joined_poses(door_poses(a, b, plans, pairs, weight), middle_poses(a, b, plans, pairs, 0.2 * weight))


def votes(poses: PoseArrays) -> Array:
    """(H,) logarithm of 1 + the weight of all poses that lay the map within 1 m and 10 degrees of each."""
    turn = 6 * np.stack([np.cos(poses.yaw), np.sin(poses.yaw), 3 * np.log(poses.scale)], axis=1)  # 10 degrees are 1 m
    place = np.concatenate([poses.shift, turn], axis=1)
    if len(place) > MANY:
        return np.log1p(poses.weight)
    near = cKDTree(place).query_ball_point(place, 1.0, return_sorted=False)
    return np.log1p(np.array([poses.weight[n].sum() for n in near]))


def _scores(poses: PoseArrays, plans: tuple[TopDown, TopDown], samples: int, sigma: float) -> Array:
    """(H, 4) score, m of walls that agree, m that conflict, m2 of floor in common; the mean of b on a and of a on b."""
    out = np.zeros((len(poses.yaw), 3))
    size = np.sqrt(poses.scale)  # of a length in the middle of both maps
    back = poses.inverse()
    for which, (to, some) in enumerate((plans, plans[::-1])):
        s = Sampled(*some.samples(samples))
        p = poses if which == 0 else back
        matrix = np.stack([p.scale * np.cos(p.yaw), p.scale * np.sin(p.yaw), p.shift[:, 0], p.shift[:, 1]], axis=1)
        storeys = storey_map(p, to.floors, some.floors)
        found = pose_evidence(matrix, storeys, s.places, s.storey, s.is_wall, to.distance, to.floor, to.origin, to.edge, sigma)
        unit = (size if which == 0 else 1 / size) * some.edge
        out[:, 0] += 0.5 * found[:, 0] * s.each[0] * unit / 2  # walls are about two columns thick
        out[:, 1] += 0.5 * found[:, 1] * s.each[0] * unit / 2
        out[:, 2] += 0.5 * found[:, 2] * s.each[1] * unit**2
    score = out[:, 0] - CONFLICT * out[:, 1] + FLOOR * out[:, 2]
    return np.concatenate([score[:, None], out], axis=1)


def storey_map(poses: PoseArrays, to: Array, floors: Array) -> Array:
    """(H, S_b) storey of `to` that each storey of `floors` falls on, -1 none."""
    height = poses.scale[:, None] * floors[None] + poses.shift[:, 2:]
    off = abs(height[:, :, None] - to[None, None])
    best = off.argmin(axis=2)
    return np.where(np.take_along_axis(off, best[:, :, None], 2)[:, :, 0] <= STOREY, best, -1).astype(np.int64)


def distinct(poses: PoseArrays, score: Array, number: int) -> Array:
    """Up to `number` rows, best first, none like a better one."""
    kept: list[int] = []
    for i in np.argsort(-score, kind="stable").tolist():
        k = np.array(kept, int)
        far = np.linalg.norm(poses.shift[k] - poses.shift[i], axis=1) > SAME[0]
        turned = abs((poses.yaw[k] - poses.yaw[i] + np.pi) % (2 * np.pi) - np.pi) > SAME[1]
        other = abs(np.log(poses.scale[k] / poses.scale[i])) > SAME[2]
        if (far | turned | other).all():
            kept.append(i)
            if len(kept) == number:
                break
    return np.array(kept, int)


def refined(poses: PoseArrays, plans: tuple[TopDown, TopDown], scale_free: bool) -> PoseArrays:
    """Poses moved so that walls of b come to lie on walls of a: point to nearest wall, in rounds that trust less and less."""
    places, storey, is_wall, _ = plans[1].samples(FINE)
    places, storey = places[is_wall], storey[is_wall]
    storeys = storey_map(poses, plans[0].floors, plans[1].floors)
    points = places[:, 0] + 1j * places[:, 1]
    turn = poses.scale * np.exp(1j * poses.yaw)  # complex numbers: u -> turn * u + move
    move = poses.shift[:, 0] + 1j * poses.shift[:, 1]
    for h in range(len(turn)):
        for trim in TRIMS:
            at = turn[h] * points + move[h]
            target, away = plans[0].nearest_wall(np.stack([at.real, at.imag], axis=1), storeys[h][storey])
            near = away < trim
            if near.sum() < FEWEST:
                break
            to = target[near, 0] + 1j * target[near, 1]
            p, q = at[near] - at[near].mean(), to - to.mean()
            fit = np.vdot(p, q)
            if abs(fit) < 1e-9:  # all walls that meet lie in one place: no turn fits better than another
                break
            step = fit / np.vdot(p, p) if scale_free else fit / abs(fit)
            move[h] = step * (move[h] - at[near].mean()) + to.mean()
            turn[h] *= step
    shift = np.stack([move.real, move.imag, poses.shift[:, 2]], axis=1)
    return PoseArrays(np.angle(turn), shift, np.abs(turn), poses.weight)


def rank(poses: PoseArrays, evidence: Array, plans: tuple[TopDown, TopDown]) -> tuple[PoseHypothesis, ...]:
    """Hypotheses with their matches: those that reach 0.6 of the best agreement first, by score."""
    agree = evidence[:, 1] + FLOOR * evidence[:, 3]
    short = agree >= SHORTLIST * agree.max()
    order = np.lexsort((-evidence[:, 0], ~short))
    chance = hypothesis_probability(evidence[:, 1:])
    ranked = []
    for h in order.tolist():
        pose = poses.transform(h)
        rooms, fit = matches_under(pose, plans, storey_map(poses.take(np.array([h])), plans[0].floors, plans[1].floors)[0])
        features = dict(zip(("agree_m", "conflict_m", "floor_m2"), evidence[h, 1:].round(3).tolist(), strict=True))
        ranked.append(PoseHypothesis(pose, float(evidence[h, 0]), float(chance[h]), features, True, rooms, fit))
    return tuple(ranked)


def matches_under(transform: Sim3, plans: tuple[TopDown, TopDown], storeys: Array) -> tuple[Array, Array]:
    """(M, 2) rooms whose footprints meet under a transform and (M,) how well they fit (see `by_overlap`)."""
    a, b = plans
    storey, x, y = np.nonzero(b.footprint >= 0)
    every = max(len(x) // COLUMNS, 1)
    storey, x, y = storey[::every], x[::every], y[::every]
    room = b.footprint[storey, x, y]
    places = b.origin + (np.stack([x, y], axis=1) + 0.5) * b.edge
    at = transform.apply(np.concatenate([places, np.zeros((len(places), 1))], axis=1))[:, :2]
    cell = np.floor((at - a.origin) / a.edge).astype(int)
    on = storeys[storey]
    inside = (cell >= 0).all(axis=1) & (cell < a.footprint.shape[1:]).all(axis=1) & (on >= 0)
    other = a.footprint[on[inside], cell[inside, 0], cell[inside, 1]]
    hit = other >= 0
    common = np.zeros((len(a.areas), len(b.areas)))
    np.add.at(common, (other[hit], room[inside][hit]), every * (transform.scale * b.edge) ** 2)
    return by_overlap(common, a.areas, b.areas * transform.scale**2)
