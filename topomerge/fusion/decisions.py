"""Decisions of a user about a merge, in the journal of its folder: maps that belong together or not, and where they lie."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.apply import RefusedEdit, load_corrected_map
from topomerge.edits.draft import find_room_place
from topomerge.edits.journal import MERGE_OPS, Edit, build_edit, select_effective
from topomerge.errors import InputError
from topomerge.extraction.attributes import find_rooms_at
from topomerge.registration.by_hand import place_by_hand
from topomerge.registration.prepared import prepare
from topomerge.types import LEVELLED, Sim3, TopometricMap, convert_pose_to_maps, parse_levelling

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
