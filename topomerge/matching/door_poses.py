"""Poses that put a door of one map on a door of the other.

The middle of a room that was seen in part is off by a metre; its doors are not, and a door tells a direction, too. So each pair
of rooms that may be one, and each pair of their doors, makes a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.matching.poses import PoseArrays, joined_poses
from topomerge.matching.room_plans import RoomPlans
from topomerge.types import Array, TopometricMap

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


def doors_of(map: TopometricMap, plan: RoomPlans) -> Doors:
    """Doors and openings of a map; which side of a door a room is on is read off the floor around it."""
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


def door_poses(a: TopometricMap, b: TopometricMap, plans: tuple[RoomPlans, RoomPlans], pairs: Array, weight: Array) -> PoseArrays:
    """One pose for each two doors of each pair of rooms (P, 2), at the scale 1."""
    of = [doors_of(m, p) for m, p in zip((a, b), plans, strict=True)]
    p, q, w = _door_pairs(of[0], of[1], pairs, weight)
    yaw = snapped(of[0].into[p] - of[1].into[q], plans)
    scale = np.ones(len(p))
    return _put(of[0].centre[p], of[1].centre[q], yaw, scale, w, _lift(a, b, of[0].room[p], of[1].room[q], scale))


def middle_poses(
    a: TopometricMap, b: TopometricMap, plans: tuple[RoomPlans, RoomPlans], pairs: Array, weight: Array
) -> PoseArrays:
    """Four poses for each pair of rooms, middle on middle along the walls: for rooms without doors in common."""
    quarter = (plans[0].direction[0] - plans[1].direction[0]) + np.arange(4) * np.pi / 2
    i, j = np.repeat(pairs[:, 0], 4), np.repeat(pairs[:, 1], 4)
    yaw = np.tile(quarter, len(pairs))
    middle = (a.rooms["centroid"][i], b.rooms["centroid"][j])
    scale = np.ones(len(i))
    return _put(*middle, yaw, scale, np.repeat(weight, 4), _lift(a, b, i, j, scale))


def scaled_poses(
    a: TopometricMap,
    b: TopometricMap,
    plans: tuple[RoomPlans, RoomPlans],
    pairs: Array,
    weight: Array,
    scales: tuple[float, float] = SCALE_LIMITS,
) -> PoseArrays:
    """Poses at a scale of their own: from two doors of one room on two doors of another, the ratio of whose distances it is; and
    from single doors at the ratio of the rooms' heights.

    Args:
        scales: least and greatest.
    """
    of = [doors_of(m, p) for m, p in zip((a, b), plans, strict=True)]
    first = _two_doors(of[0], of[1], pairs, weight, scales)
    p, q, w = _door_pairs(of[0], of[1], pairs, weight, widths=np.inf)
    i, j = of[0].room[p], of[1].room[q]
    high = np.stack([a.rooms["height"][i], b.rooms["height"][j]])
    ratio = high[0] / np.maximum(high[1], 1e-3)
    fine = (high > 0).all(axis=0) & (ratio > scales[0]) & (ratio < scales[1])
    p, q, i, j, ratio = p[fine], q[fine], i[fine], j[fine], ratio[fine]
    yaw = snapped(of[0].into[p] - of[1].into[q], plans)
    second = _put(of[0].centre[p], of[1].centre[q], yaw, ratio, w[fine], _lift(a, b, i, j, ratio))
    p, q, yaw, ratio, w = first
    lift = _lift(a, b, of[0].room[p], of[1].room[q], ratio)
    third = _put(of[0].centre[p], of[1].centre[q], snapped(yaw, plans), ratio, w, lift)
    return joined_poses(second, third)


def snapped(yaw: Array, plans: tuple[RoomPlans, RoomPlans]) -> Array:
    """Yaws turned to the nearest one at which the walls of both maps are parallel, if that is near and walls are orderly."""
    if min(p.direction[1] for p in plans) < ORDERLY:
        return yaw
    base = plans[0].direction[0] - plans[1].direction[0]
    off = (yaw - base + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return np.where(abs(off) <= SNAP_ANGLE, yaw - off, yaw)


def _door_pairs(a: Doors, b: Doors, pairs: Array, weight: Array, widths: float = WIDTH_GAP) -> tuple[Array, Array, Array]:
    """Rows of the doors of a and of b that may be one, and the weight of their rooms."""
    table = np.zeros((int(max(a.room.max(initial=0), pairs[:, 0].max(initial=0))) + 1,
                      int(max(b.room.max(initial=0), pairs[:, 1].max(initial=0))) + 1))  # fmt: skip
    table[tuple(pairs.T)] = weight
    likely = table[a.room[:, None], b.room[None]]
    doors = (a.kind == "door")[:, None] & (b.kind == "door")[None]
    fits = (likely > 0) & (~doors | (abs(a.width[:, None] - b.width[None]) <= widths))
    p, q = np.nonzero(fits)
    return p, q, likely[p, q]


def _two_doors(a: Doors, b: Doors, pairs: Array, weight: Array, scales: tuple[float, float]) -> tuple[Array, ...]:
    """Two doors of one room on two of another, at a scale between these: rows of the first doors, yaw, scale, weight."""
    of_a, of_b = (
        {int(room): _spans(doors, int(room)) for room in np.unique(k)} for doors, k in ((a, pairs.T[0]), (b, pairs.T[1]))
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


def _spans(doors: Doors, room: int) -> tuple[Array, Array, Array]:
    """Rows of each two doors of a room that are apart, in either order, and the way from the first to the second, x + i y; of
    very many, some of each length."""
    own = np.flatnonzero(doors.room == room)
    first, second = (k.ravel() for k in np.meshgrid(own, own, indexing="ij"))
    way = (doors.centre[second, :2] - doors.centre[first, :2]) @ np.array([1, 1j])
    apart = np.flatnonzero(abs(way) >= DOORS_APART)
    if len(apart) > MOST_SPANS:
        by_length = apart[np.argsort(abs(way[apart]), kind="stable")]
        apart = np.sort(by_length[np.linspace(0, len(apart) - 1, MOST_SPANS).astype(int)])
    return first[apart], second[apart], way[apart]


def _put(to: Array, point: Array, yaw: Array, scale: Array, weight: Array, lift: Array) -> PoseArrays:
    """Poses that bring points (H, 3) of b onto points of a, and floors onto floors (`_lift`)."""
    c, s = scale * np.cos(yaw), scale * np.sin(yaw)
    x = to[:, 0] - (c * point[:, 0] - s * point[:, 1])
    y = to[:, 1] - (s * point[:, 0] + c * point[:, 1])
    return PoseArrays(yaw, np.stack([x, y, lift], axis=1), scale, weight)


def _lift(a: TopometricMap, b: TopometricMap, i: Array, j: Array, scale: Array) -> Array:
    """(H,) m, z of the poses that bring the floors of the storeys of rooms j of b onto those of rooms i of a."""
    floors = [m.storeys["floor"][m.rooms["storey"][rooms]] for m, rooms in ((a, i), (b, j))]
    return np.asarray(floors[0] - scale * floors[1])
