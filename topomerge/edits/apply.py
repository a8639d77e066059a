"""The map that edits make: each op of the journal on a draft of the map, and which lines no longer apply."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.draft import Draft, EditError, format_place
from topomerge.edits.journal import MAP_OPS, TAKE_BACK, Edit, Journal, find_journal, read_journal, select_effective
from topomerge.errors import InputError
from topomerge.extraction.attributes import USUAL_WIDTH
from topomerge.extraction.landmarks import AT_DOORS, load_map_with_landmarks
from topomerge.extraction.topology import DOOR_MOST_WIDTH, SAME_DOOR_DISTANCE
from topomerge.types import EDGE_DTYPE, EDITED, LANDMARK_KINDS, Array, TopometricMap, build_landmarks, join_landmarks

BY_HAND = "by hand"  # source of landmarks that edits add
OF_ROOMS = ("name", "use", "area")  # kinds that are said of a room
SIDE_REACH, SIDE_STEP = 1.2, 0.05  # m on both sides of a door within which its rooms are looked for
WAYS = np.radians(np.arange(0, 180, 7.5))  # directions in which they are
LANDMARK_REACH = 1.0  # m between a landmark and where it is said to be
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RefusedEdit:
    """A line that does not apply to a map.

    Args:
        edit: the line.
        line: its number in the list of edits, from 1.
        reason: a sentence.
    """

    edit: Edit
    line: int
    reason: str

    def __str__(self) -> str:
        return f"edit {self.line} ({self.edit.op}) no longer applies: {self.reason}"


@dataclass(frozen=True, eq=False)
class EditedMap:
    """A map as somebody corrected it.

    Args:
        map: with the edits that apply; the map that was given where none does.
        applied: those edits.
        refused: lines that do not apply.
    """

    map: TopometricMap
    applied: tuple[Edit, ...] = ()
    refused: tuple[RefusedEdit, ...] = ()


def apply_edits(map: TopometricMap, edits: Iterable[Edit]) -> EditedMap:
    """Apply edits to a map, which stays as it is.

    Rooms that edits make are numbered on; of rooms that are joined the smallest number stays. Applying some edits and then others
    gives what applying all at once gives, unless the later ones take earlier ones back.

    Args:
        map: as it was extracted, or with earlier edits.
        edits: of its journal, with those that take others back.
    """
    edits = list(edits)
    line = {id(edit): number for number, edit in enumerate(edits, 1)}
    known = {edit.id for edit in edits}
    refused = [
        RefusedEdit(edit, line[id(edit)], f"there is no edit {edit.values['edit']} to {edit.op}")
        for edit in edits
        if edit.op in TAKE_BACK and edit.values["edit"] not in known
    ]
    draft, applied = Draft(map), []
    for edit in select_effective(edits):
        if edit.op not in MAP_OPS:
            refused.append(RefusedEdit(edit, line[id(edit)], "it is for the folder of a merge, not for a map"))
            continue
        try:
            APPLIERS[edit.op](draft, **{name: _convert_value(value) for name, value in edit.values.items()})
            applied.append(edit)
        except EditError as error:
            refused.append(RefusedEdit(edit, line[id(edit)], str(error)))
    refused.sort(key=lambda one: one.line)
    if not applied:
        return EditedMap(map, (), tuple(refused))
    before = map.parameters.get(EDITED, 0)
    count = (before if isinstance(before, int) else 0) + len(applied)
    edited = replace(draft.build_map(), parameters={**map.parameters, EDITED: count})
    return EditedMap(edited, tuple(applied), tuple(refused))


def load_corrected_map(path: str | Path, lines: int | None = None) -> TopometricMap:
    """Read a `.tmap` with the landmarks and the journal beside it.

    Warnings of the map say which lines of the journal do not apply.

    Args:
        path: of the map.
        lines: how many of the journal are applied; None: all, 0: the map as it was extracted.

    Raises:
        InputError: one of the files can't be read.
    """
    map = load_map_with_landmarks(path)
    return map if lines == 0 else correct_map(map, read_journal(find_journal(path)), lines)


def correct_map(map: TopometricMap, journal: Journal, lines: int | None = None) -> TopometricMap:
    """Apply a journal, or its first lines; warnings of the map say what does not apply."""
    done = apply_edits(map, journal.edits[:lines])
    messages = (*journal.warnings, *(f"{journal.path}: {refused}" for refused in done.refused))
    return replace(done.map, warnings=(*done.map.warnings, *messages)) if messages else done.map


def _convert_value(value: Any) -> Any:
    """Return places as arrays, all else as it is."""
    return np.array(value, float) if isinstance(value, list) else value


# Rooms.


def _split_room(draft: Draft, at: Array, line: Array) -> None:
    draft.split_room(draft.find_room(at), line)


def _join_rooms(draft: Draft, at: Array) -> None:
    draft.join_rooms(draft.find_rooms(at))


def _rename_room(draft: Draft, at: Array, name: str) -> None:
    _mark_room(draft, draft.find_room(at), at, "name", name)


def _set_room(
    draft: Draft, at: Array, kind: str | None = None, outside: bool | None = None, looked_into: bool | None = None
) -> None:
    room = draft.find_room(at)
    if kind is not None:
        _mark_room(draft, room, at, "use", kind)
    if outside is not None:
        draft.rooms["outside"][room] = float(outside)
    if looked_into is not None:
        draft.rooms["glimpsed"][room], draft.rooms["entered"][room] = looked_into, float(not looked_into)


def _assign_area(draft: Draft, at: Array, area: str) -> None:
    places = dict(zip((draft.find_room(place) for place in at), at, strict=True))
    for room, place in places.items():
        _mark_room(draft, room, place, "area", area)


def _mark_room(draft: Draft, room: int, at: Array, kind: str, value: str) -> None:
    """Say one thing of a room instead of what was said before; an empty value says nothing."""
    old = draft.landmarks.is_kind(kind) & (draft.landmarks.table["room"] == room)
    draft.landmarks = draft.landmarks.select(~old)
    if value:
        storey = int(draft.rooms["storey"][room])
        mark = build_landmarks(kind, [value], BY_HAND, at[None], room=room, storey=storey)
        draft.landmarks = join_landmarks([draft.landmarks, mark])


# Doors.


def _add_door(
    draft: Draft, at: Array, width: float | None = None, open: bool | None = None, between: Array | None = None
) -> None:
    pair, direction, floor = _find_sides(draft, at, between)
    existing = [
        k
        for k in np.flatnonzero((np.sort(draft.edges["rooms"], axis=1) == pair).all(axis=1)).tolist()
        if np.hypot(*(draft.edges["centre"][k] - at)[:2]) <= SAME_DOOR_DISTANCE
    ]
    if existing:
        row = existing[0]
    else:
        row = len(draft.edges)
        draft.edges = np.append(draft.edges, np.zeros(1, EDGE_DTYPE))
        draft.edges["rooms"][row], draft.edges["direction"][row] = pair, direction
        draft.edges["width"][row], draft.edges["open"][row] = USUAL_WIDTH, True
        _place_door(draft, row, np.array([*at[:2], floor]))
    _change_door(draft, row, width, open)


def _find_sides(draft: Draft, at: Array, between: Array | None = None) -> tuple[tuple[int, int], float, float]:
    """Return the two rooms of a door, the smaller number first, the direction between them, rad, and the height of its floor.

    Args:
        between: (2, 3) m, places in these rooms where they are told.
    """
    rooms = None if between is None else draft.find_rooms(between)
    if rooms is not None and len(rooms) < 2:
        raise EditError(f"both places lie in room {rooms[0]}: a door leads from one room into another")
    steps = np.arange(SIDE_STEP, SIDE_REACH + SIDE_STEP / 2, SIDE_STEP)
    rows = draft.find_floor(at, SIDE_REACH)
    if not len(rows):
        raise EditError(f"there is no room at {format_place(at)}")
    floor = float(draft.navigable.compute_centroids(draft.navigable.cells[rows[:1]])[0, 2])
    found = []
    for way in WAYS.tolist():
        sides = []
        for sign in (1.0, -1.0):
            line = np.array([*at[:2], floor]) + sign * steps[:, None] * (np.cos(way), np.sin(way), 0.0)
            sides.append(_find_rooms_along(draft, line, rooms))
        (a, i), (b, j) = sides
        if a >= 0 and b >= 0 and a != b:
            found.append((i + j, abs(i - j), way, min(a, b), max(a, b)))
    if not found and rooms is not None:
        ends = [draft.rooms["centroid"][r][:2] for r in rooms]
        return (rooms[0], rooms[1]), float(np.arctan2(*(ends[1] - ends[0])[::-1]) % np.pi), floor
    if not found:
        room = int(draft.floor_room[rows[0]])
        raise EditError(
            f"both sides of {format_place(at)} are room {room}: split it first, or say between which rooms the door is"
        )
    best = min(found)
    alike = [way for total, _, way, a, b in found if total <= best[0] + 2 and (a, b) == best[3:]]
    mean = np.angle(np.exp(2j * np.array(alike)).sum()) / 2
    return (best[3], best[4]), round(float(mean), 9) % np.pi, floor


def _find_rooms_along(draft: Draft, line: Array, among: list[int] | None) -> tuple[int, int]:
    """Return the first room that a line (n, 3) m comes to, of some rooms or of all, and after how many steps; -1 none."""
    cells = draft.navigable.locate(line)
    room = np.full(len(line), -1, np.int64)
    for up in (0, 1, -1, 2, -2):
        rows = draft.navigable.find_rows(cells + (0, 0, up))
        room = np.where((room < 0) & (rows >= 0), draft.floor_room[np.maximum(rows, 0)], room)
    requested = room >= 0 if among is None else np.isin(room, among)
    return (int(room[requested.argmax()]), int(requested.argmax())) if requested.any() else (-1, len(line))


def _place_door(draft: Draft, row: int, place: Array) -> None:
    """Put a door at a place; it is then certain."""
    for name in ("centre", "lower", "upper"):
        draft.edges[name][row] = place
    draft.edges["confidence"][row] = 1.0


def _change_door(draft: Draft, row: int, width: float | None, open: bool | None) -> None:
    edge = draft.edges[row : row + 1]
    if width is not None:
        edge["width"] = width
    if open is not None:
        edge["open"], edge["half"] = open, False
    edge["confidence"] = 1.0
    a, b = draft.rooms["storey"][edge["rooms"][0]]
    if a == b and edge["kind"][0] != "ramp":
        edge["kind"] = "door" if edge["width"][0] <= DOOR_MOST_WIDTH else "opening"
    elif not edge["kind"][0]:
        edge["kind"] = "stairs"


def _delete_door(draft: Draft, at: Array) -> None:
    draft.edges = np.delete(draft.edges, draft.find_edge(at))


def _move_door(draft: Draft, at: Array, to: Array, between: Array | None = None) -> None:
    row = draft.find_edge(at)
    pair, direction, floor = _find_sides(draft, to, between)
    draft.edges["rooms"][row], draft.edges["direction"][row] = pair, direction
    _place_door(draft, row, np.array([*to[:2], floor]))


def _set_door(draft: Draft, at: Array, width: float | None = None, open: bool | None = None) -> None:
    _change_door(draft, draft.find_edge(at), width, open)


# Windows, the openings of walls.


def _move_opening(draft: Draft, at: Array, to: Array) -> None:
    row = draft.find_window(at)
    inside = draft.find_floor(to, SIDE_REACH)
    if not len(inside):
        raise EditError(f"there is no room at {format_place(to)}")
    room = int(draft.floor_room[inside[0]])
    if room not in draft.windows["rooms"][row]:
        draft.windows["rooms"][row] = room, -1
    draft.windows["centre"][row, :2] = to[:2]
    draft.windows["confidence"][row] = 1.0


def _set_opening(
    draft: Draft, at: Array, width: float | None = None, sill: float | None = None, head: float | None = None
) -> None:
    window = draft.windows[(row := draft.find_window(at)) : row + 1]
    given = {"width": width, "sill": sill, "head": head}
    new = {name: float(window[name][0]) if value is None else value for name, value in given.items()}
    if new["head"] <= new["sill"]:
        raise EditError(f"a window from {new['sill']:.2f} to {new['head']:.2f} m above the floor is not high")
    for name, value in new.items():
        window[name] = value
    window["confidence"] = 1.0


def _delete_opening(draft: Draft, at: Array) -> None:
    draft.windows = np.delete(draft.windows, draft.find_window(at))


# Landmarks.


def _add_landmark(draft: Draft, at: Array, kind: str, value: str) -> None:
    if kind in OF_ROOMS:
        _mark_room(draft, draft.find_room(at), at, kind, value)
        return
    room, storey = draft.find_mark_room(at, kind in AT_DOORS)
    mark = build_landmarks(kind, [value], BY_HAND, at[None], room=room, storey=storey)
    draft.landmarks = join_landmarks([draft.landmarks, mark])


def _delete_landmark(draft: Draft, at: Array, kind: str | None = None, value: str | None = None) -> None:
    table = draft.landmarks.table
    fits = np.ones(len(table), bool) if kind is None else table["kind"] == LANDMARK_KINDS.index(kind)
    if value is not None:
        fits &= draft.landmarks.get_values() == value
    far = np.hypot(*(table["position"] - at)[:, :2].T)
    near = np.where(fits & (far <= LANDMARK_REACH), far, np.inf)
    if not np.isfinite(near).any():
        raise EditError(f"there is no {kind or 'landmark'}{f' {value!r}' if value else ''} at {format_place(at)}")
    keep = np.ones(len(table), bool)
    keep[near.argmin()] = False
    draft.landmarks = draft.landmarks.select(keep)


APPLIERS: dict[str, Callable[..., None]] = {
    "split_room": _split_room,
    "join_rooms": _join_rooms,
    "add_door": _add_door,
    "delete_door": _delete_door,
    "move_door": _move_door,
    "set_door": _set_door,
    "move_opening": _move_opening,
    "set_opening": _set_opening,
    "delete_opening": _delete_opening,
    "rename_room": _rename_room,
    "set_room": _set_room,
    "assign_area": _assign_area,
    "add_landmark": _add_landmark,
    "delete_landmark": _delete_landmark,
}


def require_applied(edited: EditedMap, edits: Iterable[Edit]) -> None:
    """Refuse edits of now that do not apply.

    Raises:
        InputError: the first of them.
    """
    now = {edit.id for edit in edits}
    for refused in edited.refused:
        if refused.edit.id in now:
            raise InputError(f"{refused.edit.op}: {refused.reason}")
