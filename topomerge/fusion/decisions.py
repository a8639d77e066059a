"""Decisions of a user about a merge: maps that belong together or not, and where they lie, in the journal of its folder. A map
that somebody lays, or rooms that somebody matches, end where the walls meet."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.apply import RefusedEdit, load_corrected_map
from topomerge.edits.draft import find_room_place
from topomerge.edits.journal import MERGE_OPS, Edit, build_edit, select_effective
from topomerge.errors import InputError
from topomerge.extraction.attributes import find_rooms_at
from topomerge.matching.poses import PoseHypothesis, pose_difference, refine, wrap_yaw
from topomerge.registration.pipeline import Registration, refine_by_surfaces, register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.registration.search import find_yaw_candidates
from topomerge.types import LEVELLED, Array, Sim3, TopometricMap, convert_pose_to_maps, parse_levelling

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
    """Return the directions, rad, in which the walls of both maps are parallel, of those near a yaw."""
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
    """Return the pose that turns by a yaw and takes one place (2,) m to another."""
    turned = Sim3(yaw).apply(np.array([[*place, 0.0]]))[0]
    return Sim3(yaw, (float(target[0] - turned[0]), float(target[1] - turned[1]), height))


def _measure_sides(map: TopometricMap, room: int, yaw: float) -> Array:
    """Return (3, 2) m, where the floor of a room begins, has its middle and ends along x and y, after the map was turned."""
    cells = map.navigable.compute_centroids(map.navigable.cells[map.navigable_room == room])
    places = Sim3(yaw).apply(cells)[:, :2]
    low, high = places.min(axis=0), places.max(axis=0)
    return np.stack([low, (low + high) / 2, high])


Pair = tuple[int, int]


@dataclass(frozen=True)
class Decisions:
    """Decisions about pairs of maps.

    Args:
        poses: of maps i < j -> T_ij that is fixed, or None where they do not belong together.
        refused: lines that do not apply.
    """

    poses: Mapping[Pair, Sim3 | None] = field(default_factory=dict)
    refused: tuple[RefusedEdit, ...] = ()


def find_decisions(maps: Sequence[TopometricMap], edits: Iterable[Edit]) -> Decisions:
    """Find what the journal of a merge says of its maps; of two lines about one pair the later one holds.

    Matched rooms and maps that were moved by hand are registered by the walls that are near.

    Args:
        maps: in the order of the merge, with their sources.
        edits: of the journal.
    """
    edits = list(edits)
    poses: dict[Pair, Sim3 | None] = {}
    matched: dict[Pair, list[tuple[int, int]]] = {}
    refused = []
    for edit in select_effective(edits):
        try:
            pair = _find_pair(maps, edit)
            if edit.op == "match_rooms":
                matched.setdefault(pair, []).append(_find_rooms(maps, pair, edit))
                if len(matched[pair]) > 1:
                    poses[pair] = place_by_hand(maps[pair[0]], maps[pair[1]], matched[pair]).pose
            elif edit.op == "reject_merge":
                poses[pair] = None
                matched.pop(pair, None)
            else:
                pose = Sim3.from_matrix(np.array(edit.values["matrix"], float))
                snap = edit.op == "place_map"
                poses[pair] = place_by_hand(maps[pair[0]], maps[pair[1]], pose).pose if snap else pose
        except InputError as error:
            refused.append(RefusedEdit(edit, edits.index(edit) + 1, str(error)))
    for pair, rooms in matched.items():
        if len(rooms) < 2 and pair not in poses:
            last = next(e for e in reversed(edits) if e.op == "match_rooms" and tuple(e.values["maps"]) == pair)
            refused.append(RefusedEdit(last, edits.index(last) + 1, "one matched pair of rooms fixes no pose; match another one"))
    return Decisions(poses, tuple(refused))


def _find_pair(maps: Sequence[TopometricMap], edit: Edit) -> Pair:
    if edit.op not in MERGE_OPS:
        raise InputError("it is for a map, not for the folder of a merge")
    i, j = edit.values.get("maps") or (0, edit.values["map"])
    if not i < j < len(maps):
        raise InputError(f"there are no maps {i} and {j}, but {len(maps)}")
    for k, source in zip((i, j), edit.values.get("sources", ()), strict=False):
        if Path(source).name != Path(maps[k].source).name:
            raise InputError(f"map {k} was {source}, and is {maps[k].source} now")
    return i, j


def _find_rooms(maps: Sequence[TopometricMap], pair: Pair, edit: Edit) -> tuple[int, int]:
    rooms = []
    for k, place in zip(pair, edit.values["at"], strict=True):
        room = int(find_rooms_at(maps[k], np.array([place], float))[0])
        if room < 0:
            raise InputError(f"map {k} has no room at ({', '.join(f'{v:.2f}' for v in place)})")
        rooms.append(room)
    return rooms[0], rooms[1]


def read_merge_listing(folder: str | Path) -> Mapping[str, Any]:
    """Read the merge.json of a folder.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = Path(folder) / "merge.json"
    try:
        listing = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(listing["maps"], list) or not isinstance(listing["transforms"], dict):
            raise ValueError("no maps")
        return listing  # type: ignore[no-any-return]
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; give the folder of a merge") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: damaged; merge again") from error


def list_sources(folder: str | Path, pair: Sequence[int]) -> list[str]:
    """List the files of two maps of a merge.

    Raises:
        InputError: the merge has no such maps.
    """
    maps = read_merge_listing(folder)["maps"]
    if not pair[0] < pair[1] < len(maps):
        raise InputError(f"{folder}: has no maps {pair[0]} and {pair[1]} in this order; it has 0 to {len(maps) - 1}")
    return [str(maps[k]["source"]) for k in pair]


def build_acceptance(folder: str | Path, pair: Sequence[int], by: str = "") -> Edit:
    """Build the edit that fixes the pose of two maps as merge.json has it.

    Raises:
        InputError: it has none.
    """
    sources, listing = list_sources(folder, pair), read_merge_listing(folder)
    poses = []
    for k in pair:
        if k and str(k) not in listing["transforms"]:
            raise InputError(f"{folder}: merge.json has no transform of map {k}; merge with --force first, or match rooms")
        matrix = np.array(listing["transforms"][str(k)]["matrix"], float) if k else np.eye(4)
        own, first = (parse_levelling(listing["maps"][n].get(LEVELLED, np.eye(4).tolist())) for n in (k, 0))
        poses.append(Sim3.from_matrix(convert_pose_to_maps(matrix, own, first)))
    pose = poses[0].inverse() @ poses[1]
    return build_edit("accept_merge", by, maps=list(pair), matrix=pose.matrix, sources=sources)


def build_matches(folder: str | Path, pair: Sequence[int], rooms: Sequence[Sequence[int]], by: str = "") -> list[Edit]:
    """Build the edits that say which rooms of two maps of a merge are the same.

    Args:
        rooms: pairs of numbers.

    Raises:
        InputError: a map is no .tmap, or has no such room; or the rooms fix no pose.
    """
    sources = list_sources(folder, pair)
    if clouds := [source for source in sources if Path(source).suffix.lower() != ".tmap"]:
        raise InputError(f"{clouds[0]}: has no numbers of rooms; extract it, and merge the .tmap")
    maps = [load_corrected_map(source) for source in sources]
    place_by_hand(prepare(maps[0]), prepare(maps[1]), [(int(i), int(j)) for i, j in rooms])  # says what is wrong
    places = [[find_room_place(map, room).round(3).tolist() for map, room in zip(maps, two, strict=True)] for two in rooms]
    return [build_edit("match_rooms", by, maps=list(pair), at=at, sources=sources) for at in places]
