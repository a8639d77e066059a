"""Find sets of matches that one transform explains (beyond seeds)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.kernels.registration import measure_pose_evidence
from topomerge.matching.assignment import match_by_overlap, select_best_partners
from topomerge.matching.poses import PoseArrays, PoseHypothesis, PoseTolerance, concatenate_poses, find_distinct_poses, refine
from topomerge.matching.room_plans import RoomPlans, build_room_plans
from topomerge.types import Array, Sim3, TopometricMap, is_mostly_unseen

CONFLICT = 2.0  # weight of a metre that disagrees against one that agrees
FLOOR = 0.1  # m of wall that a m2 of floor in common is worth
SCRAP = 0.5  # m2
ODDS_LENGTHS = {"hypothesis": 4, "match": 5}
HYPOTHESIS, MATCH = (
    "hypothesis",
    "match",
)  # weights of `compute_hypothesis_features`, against "none", and of `compute_match_features`


def load_odds_weights(model: str) -> Array:
    """Return (4,) or (5,) weights of one of both models.

    Raises:
        InputError: `odds.json` holds none of that length.
    """
    weights = np.array(read_weights_json("topomerge.matching", "odds.json").get(model, ()), float)
    if weights.shape != (ODDS_LENGTHS[model],) or not np.isfinite(weights).all():
        raise InputError(f"odds.json: {model} must be {ODDS_LENGTHS[model]} numbers: run train.py task=match_odds export=package")
    return weights


def compute_hypothesis_features(evidence: Array) -> Array:
    """Return (H, 4) what the odds of a hypothesis depend on: 1, the amount of evidence, the share that conflicts, and the score,
    from metres that agree, metres that conflict and m2 of floor in common (H, 3)."""
    agree, conflict, floor = evidence.T
    score = agree - CONFLICT * conflict + FLOOR * floor
    return np.stack([np.ones(len(agree)), np.log1p(agree), conflict / (agree + 3), score / 10], axis=1)


def compute_hypothesis_probability(evidence: Array) -> Array:
    """Return (H,) that each is the right one; with "none of them" they sum to 1."""
    odds = np.exp(np.clip(compute_hypothesis_features(evidence) @ load_odds_weights(HYPOTHESIS), -50, 50))
    out: Array = odds / (odds.sum() + 1)
    return out


def compute_match_features(a: TopometricMap, b: TopometricMap, rooms: Array, fit: Array) -> Array:
    """Return (M, 5) 1, how well two rooms fit, log m2 of the smaller one, how many of both are mostly unseen, and whether one of
    both is in several matches.

    Args:
        rooms, fit: (M, 2), (M,) of `consistency.find_matches`.
    """
    i, j = rooms.T
    smaller = np.maximum(np.minimum(a.rooms["area"][i], b.rooms["area"][j]), SCRAP)
    unseen = is_mostly_unseen(a.rooms)[i].astype(float) + is_mostly_unseen(b.rooms)[j]
    several = (np.bincount(i, minlength=1)[i] > 1) | (np.bincount(j, minlength=1)[j] > 1)
    return np.stack([np.ones(len(fit)), fit, np.log(smaller), unseen, several], axis=1)


def compute_match_probability(a: TopometricMap, b: TopometricMap, rooms: Array, fit: Array) -> Array:
    """Return (M,) that rooms which share floor under the right transform are one: scraps, glimpses and pieces of a room seldom
    are."""
    out: Array = 1 / (1 + np.exp(-compute_match_features(a, b, rooms, fit) @ load_odds_weights(MATCH)))
    return out


SNAP_ANGLE = np.radians(12)  # a door's direction is that of the walls if it is within this
ORDERLY = 0.3  # share of walls that keep to two directions, from which on they are trusted
INTO_ROOM = (0.35, 0.6, 0.9)  # m from a door's middle into its rooms
WIDTH_GAP = 0.7  # m by which the widths of one door may differ
SCALE_LIMITS = (0.4, 2.5)  # least and greatest that is tried
MOST_SPANS = 600  # two doors of a room, of a corridor with many
DOORS_APART = 0.5  # m, two doors of a room must be farther apart to tell the scale


@dataclass(frozen=True, eq=False)
class Doors:
    """Doors as seen from the room they lead out of: one row for each door and room (D)."""

    room: Array
    centre: Array  # (D, 3)
    into: Array  # (D,) direction into the room, rad
    width: Array
    kind: Array


def collect_doors(map: TopometricMap, plan: RoomPlans) -> Doors:
    """Return doors and openings of a map; which side of a door a room is on is read off the floor around it."""
    edges = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    room = np.concatenate([edges["rooms"][:, 0], edges["rooms"][:, 1]]).astype(np.int64)
    both = np.concatenate([edges, edges])
    normal = np.stack([np.cos(both["direction"]), np.sin(both["direction"])], axis=1)
    votes = np.einsum("nd,nd->n", map.rooms["centroid"][room, :2] - both["centre"][:, :2], normal)
    votes = np.sign(votes) * 0.5
    storey = map.rooms["storey"][room]
    for step in INTO_ROOM:
        for side in (1, -1):
            cell = np.floor((both["centre"][:, :2] + side * step * normal - plan.origin) / plan.edge).astype(int)
            cell = np.clip(cell, 0, np.array(plan.label.shape[1:]) - 1)
            votes += side * (plan.label[storey, cell[:, 0], cell[:, 1]] == room)
    into = both["direction"] + np.where(votes >= 0, 0.0, np.pi)
    return Doors(room, both["centre"].astype(float), into, both["width"].astype(float), both["kind"])


def propose_door_poses(
    a: TopometricMap, b: TopometricMap, plans: tuple[RoomPlans, RoomPlans], pairs: Array, weight: Array
) -> PoseArrays:
    """Return one pose for each two doors of each pair of rooms (P, 2), at the scale 1."""
    of = [collect_doors(m, p) for m, p in zip((a, b), plans, strict=True)]
    p, q, w = _pair_doors(of[0], of[1], pairs, weight)
    yaw = snap_yaws(of[0].into[p] - of[1].into[q], plans)
    scale = np.ones(len(p))
    return _build_poses(of[0].centre[p], of[1].centre[q], yaw, scale, w, _compute_lift(a, b, of[0].room[p], of[1].room[q], scale))


def propose_middle_poses(
    a: TopometricMap, b: TopometricMap, plans: tuple[RoomPlans, RoomPlans], pairs: Array, weight: Array
) -> PoseArrays:
    """Propose four poses for each pair of rooms, middle on middle along the walls: for rooms without doors in common."""
    quarter = (plans[0].direction[0] - plans[1].direction[0]) + np.arange(4) * np.pi / 2
    i, j = np.repeat(pairs[:, 0], 4), np.repeat(pairs[:, 1], 4)
    yaw = np.tile(quarter, len(pairs))
    middle = (a.rooms["centroid"][i], b.rooms["centroid"][j])
    scale = np.ones(len(i))
    return _build_poses(*middle, yaw, scale, np.repeat(weight, 4), _compute_lift(a, b, i, j, scale))


def propose_scaled_poses(
    a: TopometricMap,
    b: TopometricMap,
    plans: tuple[RoomPlans, RoomPlans],
    pairs: Array,
    weight: Array,
    scales: tuple[float, float] = SCALE_LIMITS,
) -> PoseArrays:
    """Propose poses at a scale of their own: from two doors of one room on two doors of another, the ratio of whose distances it
    is; and from single doors at the ratio of the rooms' heights.

    Args:
        scales: least and greatest.
    """
    of = [collect_doors(m, p) for m, p in zip((a, b), plans, strict=True)]
    first = _pair_door_spans(of[0], of[1], pairs, weight, scales)
    p, q, w = _pair_doors(of[0], of[1], pairs, weight, widths=np.inf)
    i, j = of[0].room[p], of[1].room[q]
    high = np.stack([a.rooms["height"][i], b.rooms["height"][j]])
    ratio = high[0] / np.maximum(high[1], 1e-3)
    fine = (high > 0).all(axis=0) & (ratio > scales[0]) & (ratio < scales[1])
    p, q, i, j, ratio = p[fine], q[fine], i[fine], j[fine], ratio[fine]
    yaw = snap_yaws(of[0].into[p] - of[1].into[q], plans)
    second = _build_poses(of[0].centre[p], of[1].centre[q], yaw, ratio, w[fine], _compute_lift(a, b, i, j, ratio))
    p, q, yaw, ratio, w = first
    lift = _compute_lift(a, b, of[0].room[p], of[1].room[q], ratio)
    third = _build_poses(of[0].centre[p], of[1].centre[q], snap_yaws(yaw, plans), ratio, w, lift)
    return concatenate_poses(second, third)


def snap_yaws(yaw: Array, plans: tuple[RoomPlans, RoomPlans]) -> Array:
    """Return the yaws turned to the nearest one at which the walls of both maps are parallel, if that is near and walls are
    orderly."""
    if min(p.direction[1] for p in plans) < ORDERLY:
        return yaw
    base = plans[0].direction[0] - plans[1].direction[0]
    off = (yaw - base + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return np.where(abs(off) <= SNAP_ANGLE, yaw - off, yaw)


def _pair_doors(a: Doors, b: Doors, pairs: Array, weight: Array, widths: float = WIDTH_GAP) -> tuple[Array, Array, Array]:
    """Return the rows of the doors of a and of b that may be one, and the weight of their rooms."""
    table = np.zeros((int(max(a.room.max(initial=0), pairs[:, 0].max(initial=0))) + 1,
                      int(max(b.room.max(initial=0), pairs[:, 1].max(initial=0))) + 1))  # fmt: skip
    table[tuple(pairs.T)] = weight
    likely = table[a.room[:, None], b.room[None]]
    doors = (a.kind == "door")[:, None] & (b.kind == "door")[None]
    fits = (likely > 0) & (~doors | (abs(a.width[:, None] - b.width[None]) <= widths))
    p, q = np.nonzero(fits)
    return p, q, likely[p, q]


def _pair_door_spans(a: Doors, b: Doors, pairs: Array, weight: Array, scales: tuple[float, float]) -> tuple[Array, ...]:
    """Pair two doors of one room with two of another, at a scale between these: rows of the first doors, yaw, scale, weight."""
    of_a, of_b = (
        {int(room): _measure_spans(doors, int(room)) for room in np.unique(k)} for doors, k in ((a, pairs.T[0]), (b, pairs.T[1]))
    )
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), *np.zeros((3, 0)))]
    for (i, j), w in zip(pairs.tolist(), weight.tolist(), strict=True):
        (p, p2, u), (q, q2, v) = of_a[i], of_b[j]
        ratio = abs(u)[:, None] / abs(v)[None]
        one, other = np.nonzero((ratio > scales[0]) & (ratio < scales[1]))
        yaw = np.angle(u[one] / v[other])
        turns = np.stack([a.into[p[one]] - b.into[q[other]], a.into[p2[one]] - b.into[q2[other]]]) - yaw
        fits = (abs((turns + np.pi) % (2 * np.pi) - np.pi) < 2 * SNAP_ANGLE).all(axis=0)
        one, other, yaw = one[fits], other[fits], yaw[fits]
        parts.append((p[one], q[other], yaw, ratio[one, other], np.full(len(one), w)))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def _measure_spans(doors: Doors, room: int) -> tuple[Array, Array, Array]:
    """Return the rows of each two doors of a room that are apart, in either order, and the way from the first to the second, x +
    i y; of very many, some of each length."""
    own = np.flatnonzero(doors.room == room)
    first, second = (k.ravel() for k in np.meshgrid(own, own, indexing="ij"))
    way = (doors.centre[second, :2] - doors.centre[first, :2]) @ np.array([1, 1j])
    apart = np.flatnonzero(abs(way) >= DOORS_APART)
    if len(apart) > MOST_SPANS:
        by_length = apart[np.argsort(abs(way[apart]), kind="stable")]
        apart = np.sort(by_length[np.linspace(0, len(apart) - 1, MOST_SPANS).astype(int)])
    return first[apart], second[apart], way[apart]


def _build_poses(to: Array, point: Array, yaw: Array, scale: Array, weight: Array, lift: Array) -> PoseArrays:
    """Build the poses that bring points (H, 3) of b onto points of a, and floors onto floors (`_lift`)."""
    c, s = scale * np.cos(yaw), scale * np.sin(yaw)
    x = to[:, 0] - (c * point[:, 0] - s * point[:, 1])
    y = to[:, 1] - (s * point[:, 0] + c * point[:, 1])
    return PoseArrays(yaw, np.stack([x, y, lift], axis=1), scale, weight)


def _compute_lift(a: TopometricMap, b: TopometricMap, i: Array, j: Array, scale: Array) -> Array:
    """Return (H,) m, z of the poses that bring the floors of the storeys of rooms j of b onto those of rooms i of a."""
    floors = [m.storeys["floor"][m.rooms["storey"][rooms]] for m, rooms in ((a, i), (b, j))]
    return np.asarray(floors[0] - scale * floors[1])


SAME_MATCHING = PoseTolerance(0.5, float(np.radians(5)), 0.05)


@dataclass(frozen=True)
class ConsistencySettings:
    """Settings of finding matches that one transform explains.

    Args:
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
    """Samples of a map that are laid over the other's plan."""

    places: Array
    storey: Array
    is_wall: Array
    each: Array


def propose_hypotheses(
    a: TopometricMap,
    b: TopometricMap,
    cost: Array,
    similarity: Array,
    scale_free: bool = False,
    number: int = 10,
    scale: float | None = None,
) -> tuple[PoseHypothesis, ...]:
    """Return up to `number` ways to lay b onto a, best first.

    Args:
        cost, similarity: (R_a, R_b) of the descriptors.
        scale_free: is the scale of b unknown?
        scale: about what it is then, m, if that is known.
    """
    plans = (build_room_plans(a), build_room_plans(b))
    pairs = select_best_partners(cost, CONSISTENCY.partners)
    # From rooms alone, not the search of walls: only so do descriptors reach a merge (docs/adr/0010).
    poses = propose_candidate_poses(a, b, plans, pairs, similarity[tuple(pairs.T)] + 1e-3, scale_free, scale)
    if not len(poses):
        return ()
    poses = select_best_poses(
        poses, _score_poses(poses, plans, 0)[:, 0] + count_votes(poses), plans[1].middle, CONSISTENCY.refined
    )
    proposed = [PoseHypothesis(poses.get_transform(k), from_rooms=True) for k in range(len(poses))]
    moved = refine(plans[0].fields, plans[1].fields, proposed, scale_free)
    if moved:  # else there are no walls to go by
        poses = PoseArrays.from_transforms([h.transform for h in moved])
    poses = select_best_poses(poses, _score_poses(poses, plans, 1)[:, 0], plans[1].middle, number)
    return rank(poses, _score_poses(poses, plans, 1), plans)


def select_best_poses(poses: PoseArrays, score: Array, point: Array, number: int) -> PoseArrays:
    """Return up to `number` poses of the highest score (H,), best first, none like a better one at a point (3,) of b."""
    poses = poses.take(np.argsort(-score, kind="stable"))
    return poses.take(find_distinct_poses(poses, point, CONSISTENCY.same, number))


def propose_candidate_poses(
    a: TopometricMap,
    b: TopometricMap,
    plans: tuple[RoomPlans, RoomPlans],
    pairs: Array,
    weight: Array,
    scale_free: bool,
    scale: float | None = None,
) -> PoseArrays:
    """Propose poses of all doors of all pairs, and of middles of the rooms; of unknown scale those about a scale, if there is
    one."""
    if not scale_free:
        return concatenate_poses(
            propose_door_poses(a, b, plans, pairs, weight), propose_middle_poses(a, b, plans, pairs, 0.2 * weight)
        )
    if scale is None:
        return concatenate_poses(propose_door_poses(a, b, plans, pairs, weight), propose_scaled_poses(a, b, plans, pairs, weight))
    return propose_scaled_poses(a, b, plans, pairs, weight, (scale / NEAR_SCALE, scale * NEAR_SCALE))


def find_voted_pose(a: TopometricMap, b: TopometricMap, certain: Array, scale: float | None = None) -> Sim3 | None:
    """Return the pose T_ab that most doors and middles of matched rooms vote for, with no look at walls; None where none match.

    Args:
        certain: (R_a, R_b) how sure each match is; each votes with that.
        scale: about that of b, m, if it is not a metre; the pose has its own.
    """
    pairs = np.argwhere(certain > CONSISTENCY.least_voter)
    if not len(pairs):
        return None
    plans = (build_room_plans(a), build_room_plans(b))
    poses = propose_candidate_poses(a, b, plans, pairs, certain[tuple(pairs.T)], scale is not None, scale)
    if not len(poses):
        return None
    at = np.column_stack([poses.place_point(plans[1].middle), 6 * np.cos(poses.yaw), 6 * np.sin(poses.yaw)])  # 10 degrees are 1 m
    near = cKDTree(at).query_ball_point(at, CONSISTENCY.vote_reach, return_sorted=True)
    best = int(np.argmax([poses.weight[n].sum() for n in near]))
    off = np.average(at[near[best], :3], axis=0, weights=poses.weight[near[best]]) - at[best, :3]
    pose = poses.get_transform(best)
    x, y, z = (off + pose.translation).tolist()
    return replace(pose, translation=(x, y, z))


def count_votes(poses: PoseArrays) -> Array:
    """Return (H,) logarithm of 1 + the weight of all poses that lay the map within 1 m and 10 degrees of each."""
    turn = 6 * np.stack([np.cos(poses.yaw), np.sin(poses.yaw), 3 * np.log(poses.scale)], axis=1)  # 10 degrees are 1 m
    place = np.concatenate([poses.shift, turn], axis=1)
    if len(place) > CONSISTENCY.voters:
        return np.log1p(poses.weight)
    near = cKDTree(place).query_ball_point(place, 1.0, return_sorted=False)
    return np.log1p(np.array([poses.weight[n].sum() for n in near]))


def _score_poses(poses: PoseArrays, plans: tuple[RoomPlans, RoomPlans], look: int) -> Array:
    """Return (H, 4) score, m of walls that agree, m that conflict, m2 of floor in common; the mean of b on a and of a on b.

    Args:
        look: 0 the first one, 1 the last one, with more samples.
    """
    out = np.zeros((len(poses.yaw), 3))
    size = np.sqrt(poses.scale)  # of a length in the middle of both maps
    back = poses.inverse()
    sigma = CONSISTENCY.sigmas[look]
    for which, (to, moved) in enumerate((plans, plans[::-1])):
        s = Sampled(*moved.sample_columns(CONSISTENCY.samples[look]))
        p = poses if which == 0 else back
        matrix = np.stack([p.scale * np.cos(p.yaw), p.scale * np.sin(p.yaw), p.shift[:, 0], p.shift[:, 1]], axis=1)
        storeys = map_storeys(p, to.floors, moved.floors)
        counts = measure_pose_evidence(
            matrix, storeys, s.places, s.storey, s.is_wall, to.distance, to.floor, to.origin, to.edge, sigma
        )
        unit = (size if which == 0 else 1 / size) * moved.edge
        out[:, 0] += 0.5 * counts[:, 0] * s.each[0] * unit / 2  # walls are about two columns thick
        out[:, 1] += 0.5 * counts[:, 1] * s.each[0] * unit / 2
        out[:, 2] += 0.5 * counts[:, 2] * s.each[1] * unit**2
    score = out[:, 0] - CONFLICT * out[:, 1] + FLOOR * out[:, 2]
    return np.concatenate([score[:, None], out], axis=1)


def map_storeys(poses: PoseArrays, to: Array, floors: Array) -> Array:
    """Return (H, S_b) storey of `to` that each storey of `floors` falls on, -1 none."""
    height = poses.scale[:, None] * floors[None] + poses.shift[:, 2:]
    off = abs(height[:, :, None] - to[None, None])
    best = off.argmin(axis=2)
    return np.where(np.take_along_axis(off, best[:, :, None], 2)[:, :, 0] <= CONSISTENCY.storey_gap, best, -1).astype(np.int64)


def rank(poses: PoseArrays, evidence: Array, plans: tuple[RoomPlans, RoomPlans]) -> tuple[PoseHypothesis, ...]:
    """Return hypotheses with their matches: those that reach 0.6 of the best agreement first, by score."""
    agree = evidence[:, 1] + FLOOR * evidence[:, 3]
    short = agree >= CONSISTENCY.shortlist * agree.max()
    order = np.lexsort((-evidence[:, 0], ~short))
    probability = compute_hypothesis_probability(evidence[:, 1:])
    ranked = []
    for h in order.tolist():
        pose = poses.get_transform(h)
        rooms, fit = find_matches(pose, plans)
        features = dict(zip(("agree_m", "conflict_m", "floor_m2"), evidence[h, 1:].round(3).tolist(), strict=True))
        ranked.append(PoseHypothesis(pose, float(evidence[h, 0]), float(probability[h]), features, True, rooms, fit))
    return tuple(ranked)


def find_matches(
    transform: Sim3, plans: tuple[RoomPlans, RoomPlans], lay: Callable[[Array], Array] | None = None
) -> tuple[Array, Array]:
    """Return (M, 2) rooms whose footprints meet under a transform T_ab and (M,) how well they fit (see `match_by_overlap`).

    Args:
        lay: where the points (n, 3) of b lie in a, if not exactly where the transform puts them.
    """
    return match_by_overlap(measure_common_floor(transform, plans, lay), plans[0].areas, plans[1].areas * transform.scale**2)


def measure_common_floor(
    transform: Sim3, plans: tuple[RoomPlans, RoomPlans], lay: Callable[[Array], Array] | None = None
) -> Array:
    """Return (R_a, R_b) m2 in a of the floor that each room of a shares with each of b under a transform T_ab.

    Args:
        lay: as of `find_matches`.
    """
    a, b = plans
    storeys = map_storeys(PoseArrays.from_transforms([transform]), a.floors, b.floors)[0]
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
