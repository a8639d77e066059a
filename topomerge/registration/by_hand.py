"""Maps that somebody brings together by hand: rooms that are said to be the same, or a map that was moved, give a pose near which
the walls are registered."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.errors import InputError
from topomerge.matching.poses import PoseHypothesis, pose_difference, refine, wrap_yaw
from topomerge.registration.pipeline import Registration, refine_by_surfaces, register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.registration.search import find_yaw_candidates
from topomerge.types import Array, Sim3, TopometricMap

SNAP_SHIFT, SNAP_YAW = 3.0, np.radians(25.0)  # m at the middle of the map, rad: walls that are farther are not snapped to
LEAST_APART = 0.5  # m between the middles of matched rooms, below which they fix no direction
TRIED = 4  # poses that are looked at closely
SPREAD = 1.2  # m, about a pose by hand, from which walls are looked for
YAW_STEPS = np.radians((0.0, -6.0, 6.0))  # about the direction that the rooms say


@dataclass(frozen=True, eq=False)
class HandPlacement:
    """Where somebody put a map, after it has snapped to the walls.

    Args:
        pose: T_ab.
        start: the pose before.
        rmse: root mean square distance of the surfaces, m; nan where they do not meet, or where a map is a slice.
        probability: that the pose is right, by the judge of all merges; 0 where no walls are near.
        snapped: did walls near the start move it?
        registration: the evidence under the pose, of maps that stay rigid; None where there is none.
    """

    pose: Sim3
    start: Sim3
    rmse: float
    probability: float
    snapped: bool
    registration: Registration | None = None


def place_by_hand(
    a: TopometricMap | Prepared, b: TopometricMap | Prepared, start: Sim3 | Sequence[tuple[int, int]]
) -> HandPlacement:
    """Register map b to map a near where somebody put it.

    Args:
        a, b: maps, or what `prepare` made of them.
        start: a pose T_ab, or two or more pairs of rooms (of a, of b) that are the same.

    Raises:
        InputError: rooms that do not exist or fix no pose, or an empty map.
    """
    a, b = (m if isinstance(m, Prepared) else prepare(m) for m in (a, b))
    poses = _list_poses_near(a, b, start) if isinstance(start, Sim3) else estimate_matched_poses(a, b, start)
    moved = refine(a.storeys, b.storeys, [PoseHypothesis(pose, from_rooms=True) for pose in poses])
    near = [h.transform for h in moved if _is_near(h.transform, poses[0], b.middle)]
    if near:
        found = register(a, b, proposed=near[:TRIED], searched=False, rigid=True)
        if found.transform is not None and _is_near(found.transform, poses[0], b.middle):
            rmse = found.features.get("rmse", float("nan"))
            return HandPlacement(found.transform, poses[0], rmse, found.probability, True, found)
    pose, rmse = refine_by_surfaces(a, b, poses[0])
    return HandPlacement(pose, poses[0], rmse, 0.0, bool(np.isfinite(rmse)))


def _list_poses_near(a: Prepared, b: Prepared, start: Sim3) -> list[Sim3]:
    """Return a pose, and others about it in the directions of the walls, turned about the middle of map b and shifted."""
    middle = b.middle
    target = start.apply(middle[None])[0]
    poses = [start]
    for yaw in (start.yaw, *_find_near_yaws(a, b, start.yaw)):
        for x, y in itertools.product((0.0, -SPREAD, SPREAD), repeat=2):
            turned = replace(start, yaw=yaw, translation=(0.0, 0.0, 0.0)).apply(middle[None])[0]
            poses.append(replace(start, yaw=yaw, translation=tuple((target - turned + (x, y, 0.0)).tolist())))
    return poses


def _find_near_yaws(a: Prepared, b: Prepared, yaw: float) -> list[float]:
    """Directions, rad, in which the walls of both maps are parallel, of those near a yaw."""
    walls = find_yaw_candidates(a.storeys[0].profile, b.storeys[0].profile) if a.storeys and b.storeys else []
    return [y for y in walls if abs(wrap_yaw(y - yaw)) <= SNAP_YAW]


def _is_near(pose: Sim3, start: Sim3, middle: Array) -> bool:
    shift, turn, _ = pose_difference(pose, start, middle)
    return bool(shift <= SNAP_SHIFT and abs(turn) <= SNAP_YAW)


def estimate_matched_poses(
    a: TopometricMap | Prepared, b: TopometricMap | Prepared, pairs: Sequence[tuple[int, int]]
) -> list[Sim3]:
    """Estimate poses T_ab of rooms that are the same in both maps.

    The first one lays the middles of the rooms on each other. Of rooms that one map shows in part the middles differ; the others
    lay sides of the rooms' outlines on each other, in the directions of the walls.

    Args:
        a, b: maps, or what `prepare` made of them.
        pairs: two or more, each a room of a and one of b.

    Raises:
        InputError: rooms that do not exist, or that fix no pose.
    """
    one, other = (_get_map(m) for m in (a, b))
    pairs = sorted({(int(i), int(j)) for i, j in pairs})
    for map, rooms in ((one, [i for i, _ in pairs]), (other, [j for _, j in pairs])):
        for room in rooms:
            if not 0 <= room < len(map.rooms):
                raise InputError(
                    f"{map.source or 'map'}: has no room {room} (0 to {len(map.rooms) - 1}); match rooms that it has"
                )
    if len({i for i, _ in pairs}) < 2 or len({j for _, j in pairs}) < 2:
        raise InputError(f"{len(pairs)} matched pair{'s' * (len(pairs) != 1)} of rooms fix no pose; match two rooms or more")
    p, q = one.rooms["centroid"][[i for i, _ in pairs]], other.rooms["centroid"][[j for _, j in pairs]]
    p_middle, q_middle = p.mean(axis=0), q.mean(axis=0)
    if min(np.hypot(*(middles - at)[:, :2].T).max() for middles, at in ((p, p_middle), (q, q_middle))) < LEAST_APART / 2:
        raise InputError("the matched rooms lie on each other and fix no direction; match rooms that are apart")
    u, v = (q - q_middle)[:, :2], (p - p_middle)[:, :2]
    yaw = float(np.arctan2((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum(), (u * v).sum()))
    height = float(np.median(p[:, 2] - q[:, 2]))
    first = _lay_on(yaw, q_middle[:2], p_middle[:2], height)
    if not (isinstance(a, Prepared) and isinstance(b, Prepared)):
        return [first]
    yaws = _find_near_yaws(a, b, yaw) or [float(yaw + step) for step in YAW_STEPS]
    poses = [first]
    for turned in yaws:
        sides = np.stack([_measure_sides(other, j, turned) for _, j in pairs])
        fixed = np.stack([_measure_sides(one, i, 0.0) for i, _ in pairs])
        shift = np.median(fixed - sides, axis=0)  # (3, 2): lower, middle and upper sides, along x and y
        for x, y in itertools.product(range(3), range(3)):
            poses.append(Sim3(float(wrap_yaw(turned)), (float(shift[x, 0]), float(shift[y, 1]), height)))
    return poses


def _get_map(map: TopometricMap | Prepared) -> TopometricMap:
    loaded = map.load() if isinstance(map, Prepared) else map
    if not isinstance(loaded, TopometricMap):
        raise InputError("matched rooms need maps with rooms; give topometric maps")
    return loaded


def _lay_on(yaw: float, place: Array, target: Array, height: float) -> Sim3:
    """The pose that turns by a yaw and takes one place (2,) m to another."""
    turned = Sim3(yaw).apply(np.array([[*place, 0.0]]))[0]
    return Sim3(yaw, (float(target[0] - turned[0]), float(target[1] - turned[1]), height))


def _measure_sides(map: TopometricMap, room: int, yaw: float) -> Array:
    """Return (3, 2) m, where the floor of a room begins, has its middle and ends along x and y, after the map was turned."""
    cells = map.navigable.compute_centroids(map.navigable.cells[map.navigable_room == room])
    places = Sim3(yaw).apply(cells)[:, :2]
    low, high = places.min(axis=0), places.max(axis=0)
    return np.stack([low, (low + high) / 2, high])
