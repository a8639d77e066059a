"""The command `edit`: corrections of a map go into the journal beside it, decisions about a merge into that of its folder."""

from __future__ import annotations

import argparse
import getpass
import json
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.console import (
    Command,
    build_option,
    check_inputs,
    check_outputs,
    check_suffix,
    print_line,
    print_text,
    write_all,
)
from topomerge.cli.options import build_quiet_option, collect_given, parse_positive, parse_whole_number
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.edits.journal import Edit, Journal
    from topomerge.types import TopometricMap

# Options that say what to do: option -> op; one of them is given.
MAP_VERBS = {
    "split_room": "split_room",
    "join_rooms": "join_rooms",
    "add_door": "add_door",
    "delete_door": "delete_door",
    "move_door": "move_door",
    "set_door": "set_door",
    "delete_window": "delete_opening",
    "move_window": "move_opening",
    "set_window": "set_opening",
    "rename_room": "rename_room",
    "set_room": "set_room",
    "assign_area": "assign_area",
    "add_landmark": "add_landmark",
    "delete_landmark": "delete_landmark",
}
MERGE_VERBS = ("match_rooms", "accept", "reject")
VERBS = (*MAP_VERBS, *MERGE_VERBS, "undo", "redo", "list", "source")
DETAILS = {  # option -> the verbs that take it
    "line": ("split_room",),
    "to": ("move_door", "move_window"),
    "width": ("add_door", "set_door", "set_window"),
    "state": ("add_door", "set_door"),
    "sill": ("set_window",),
    "head": ("set_window",),
    "kind": ("set_room",),
    "outside": ("set_room",),
    "looked_into": ("set_room",),
}


def run_edit(args: argparse.Namespace) -> int:
    """`topomerge edit`: correct a map; the journal beside it gets a line."""
    from topomerge.edits.journal import append_edits, find_journal, read_journal

    check_inputs([args.input])
    path = Path(args.input)
    if not path.is_dir() and path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: is no map; give a .tmap, or the folder of a merge")
    verb = _find_verb(args, path)
    journal = read_journal(find_journal(path))
    edits: list[Edit] = []
    if verb == "list":
        print_text("\n".join(_format_edits(journal)))
    else:
        edits = _build_edits(args, verb, path, journal) if verb else []
        if not path.is_dir():
            _check_and_save(args, path, journal, edits)
        if edits:
            append_edits(journal.path, edits, journal.version)
    if not args.quiet and verb != "list":
        lines = journal.version + len(edits)
        done = f"{len(edits)} edit{'s' * (len(edits) != 1)}, {lines} line{'s' * (lines != 1)} in all -> {journal.path}"
        print_line(f"{args.output}: the corrected map" if args.output and not edits else done)
    return 0


def _find_verb(args: argparse.Namespace, path: Path) -> str:
    """Return the option that says what to do; empty where the corrected map is asked for only.

    Raises:
        InputError: none or several, or one that does not fit the input or the other options.
    """
    given = [name for name in VERBS if getattr(args, name, None) not in (None, False)]
    arguments = [f"--{'from' if name == 'source' else name.replace('_', '-')}" for name in given]
    if len(given) > 1:
        raise InputError(f"{arguments[0]} and {arguments[1]}: give one of them; each edit is a line of its own")
    if not given and not args.output:
        raise InputError(f"{path}: say what to do: give --split-room, --join-rooms, --add-door or another edit, or --list")
    verb = given[0] if given else ""
    for name in collect_given(args, *DETAILS):
        if verb not in DETAILS[name]:
            takers = " and ".join(f"--{taker.replace('_', '-')}" for taker in DETAILS[name])
            raise InputError(f"--{name.replace('_', '-')}: is for {takers}; leave it out")
    for name in ("line", "to"):
        if verb in DETAILS[name] and not hasattr(args, name):
            raise InputError(f"{arguments[0]}: needs --{name}")
    if path.is_dir() and (verb in MAP_VERBS or args.output):
        raise InputError(f"{path}: is the folder of a merge; give a .tmap to correct a map")
    if not path.is_dir() and verb in MERGE_VERBS:
        raise InputError(f"{arguments[0]}: is for the folder of a merge, not for a .tmap")
    return verb


def _format_edits(journal: Journal) -> list[str]:
    """Return lines about the edits of a journal; those that were taken back are marked."""
    from topomerge.edits.journal import select_effective

    held = {id(edit) for edit in select_effective(journal.edits)}
    lines = []
    for number, edit in enumerate(journal.edits, 1):
        mark = " " if id(edit) in held else "-"
        lines.append(f"{number:4} {mark} {edit.time} {edit.by} {edit.op} {json.dumps(dict(edit.values), ensure_ascii=False)}")
    return lines or ["no edits"]


def _build_edits(args: argparse.Namespace, verb: str, path: Path, journal: Journal) -> list[Edit]:
    """Build the edits that the options ask for."""
    from topomerge.edits.journal import build_edit, build_redo, build_undo, read_journal

    by = getattr(args, "by", None)
    if by is None:
        by = ""
        with suppress(Exception):  # no name is known in some containers
            by = getpass.getuser()
    if verb in ("undo", "redo"):
        try:
            return [(build_undo if verb == "undo" else build_redo)(journal.edits, by)]
        except InputError as error:
            raise InputError(f"{journal.path}: {error}") from error
    if verb == "source":
        known = {edit.id for edit in journal.edits}
        return [edit for edit in read_journal(_require_file(args.source)).edits if edit.id not in known]
    if path.is_dir():
        return _build_merge_edits(args, verb, path, by)
    try:
        return [build_edit(MAP_VERBS[verb], by, **_collect_values(args, verb, path, journal))]
    except InputError as error:
        raise InputError(f"--{verb.replace('_', '-')}: {error}") from error


def _require_file(name: str) -> Path:
    if not Path(name).is_file():
        raise InputError(f"{name}: no such file; give a journal of edits")
    return Path(name)


def _collect_values(args: argparse.Namespace, verb: str, path: Path, journal: Journal) -> dict[str, Any]:
    """Collect the fields of an edit of a map: numbers of rooms, doors and windows become places."""
    map = _load(path, journal, ())
    given = getattr(args, verb)
    values: dict[str, Any] = {**collect_given(args, "width", "sill", "head", "kind", "outside", "looked_into")}
    if hasattr(args, "state"):
        values["open"] = args.state
    if hasattr(args, "line"):
        values["line"] = args.line
    if hasattr(args, "to"):
        values["to"] = _find_place(map, args.to, args)
    if verb in ("split_room", "set_room"):
        values["at"] = _find_room(map, given, path)
    elif verb == "join_rooms":
        values["at"] = [_find_room(map, room, path) for room in given]
    elif verb == "rename_room":
        values |= {"at": _find_room(map, given[0], path), "name": given[1]}
    elif verb == "assign_area":
        values |= {"at": [_find_room(map, room, path) for room in given[0].split(",")], "area": given[1]}
    elif verb == "add_landmark":
        values |= {"kind": given[0], "value": given[1], "at": _find_place(map, _parse_numbers(given[2]), args)}
    elif verb in ("add_door", "delete_landmark"):
        values["at"] = _find_place(map, given, args)
    else:
        values["at"] = _find_row(map, given, verb, args)
    return values


def _load(path: Path, journal: Journal, edits: Sequence[Edit]) -> TopometricMap:
    from topomerge.edits.apply import correct_map, load_corrected_map

    map = load_corrected_map(path, 0)
    return correct_map(map, type(journal)(journal.path, (*journal.edits, *edits)))


def _find_room(map: TopometricMap, number: Any, path: Path) -> list[float]:
    """Return a place in the room of a number."""
    from topomerge.edits.draft import find_room_place

    if not str(number).strip().isdecimal() or int(number) >= len(map.rooms):
        valid = f"0 to {len(map.rooms) - 1}" if len(map.rooms) else "none"
        raise InputError(f"{path} has no room {number} ({valid}); see them with `topomerge info`")
    place: list[float] = find_room_place(map, int(number)).round(3).tolist()
    return place


def _find_place(map: TopometricMap, numbers: Sequence[float], args: argparse.Namespace) -> list[float]:
    """Return X,Y on the floor of the storey that is asked for, or X,Y,Z."""
    if len(numbers) == 3:
        return list(numbers)
    storey = getattr(args, "storey", 0)
    if len(numbers) != 2 or storey >= len(map.storeys):
        raise InputError(f"give X,Y or X,Y,Z in m, and a storey from 0 to {len(map.storeys) - 1}")
    return [*numbers, float(map.storeys["floor"][storey])]


def _find_row(map: TopometricMap, given: Sequence[float], verb: str, args: argparse.Namespace) -> list[float]:
    """Return where the door or the window of a number is, or the place that was given."""
    if len(given) != 1:
        return _find_place(map, given, args)
    table, what = (map.windows, "window") if verb.endswith("window") else (map.edges, "door")
    if given[0] != int(given[0]) or not 0 <= given[0] < len(table):
        valid = f"0 to {len(table) - 1}" if len(table) else "none"
        raise InputError(f"there is no {what} {given[0]:g} ({valid}); see them with `topomerge info --json`")
    place: list[float] = table["centre"][int(given[0])].tolist()
    return place


def _build_merge_edits(args: argparse.Namespace, verb: str, path: Path, by: str) -> list[Edit]:
    """Build a decision about two maps of a merge."""
    from topomerge.edits.journal import build_edit
    from topomerge.fusion.decisions import build_acceptance, build_matches, list_sources

    if verb == "match_rooms":
        pair = _parse_pair(args.match_rooms[0])
        return build_matches(path, pair, [_parse_pair(text, "=", "A=B") for text in args.match_rooms[1].split(",")], by)
    pair = _parse_pair(getattr(args, verb))
    if verb == "accept":
        return [build_acceptance(path, pair, by)]
    return [build_edit("reject_merge", by, maps=pair, sources=list_sources(path, pair))]


def _parse_pair(text: str, sign: str = ",", form: str = "I,J") -> list[int]:
    parts = [part.strip() for part in text.split(sign)]
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise InputError(f"{text}: give two numbers as {form}")
    return [int(part) for part in parts]


def _check_and_save(args: argparse.Namespace, path: Path, journal: Journal, edits: Sequence[Edit]) -> None:
    """Try the edits out, and write the corrected map where it is asked for.

    Raises:
        InputError: an edit does not apply.
    """
    from topomerge.edits.apply import apply_edits, load_corrected_map, require_applied
    from topomerge.io.maps import save_map

    if args.output:
        check_suffix("-o", args.output, (".tmap",))
        check_outputs([args.output], [args.input])
    edited = apply_edits(load_corrected_map(path, 0), [*journal.edits, *edits])
    try:
        require_applied(edited, edits)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if args.output:
        write_all([(args.output, partial(save_map, edited.map))])


def _parse_numbers(text: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(abs(value) <= 1e9 for value in numbers):
        raise argparse.ArgumentTypeError(f"must be numbers in m with commas between, as 3.2,-1, not {text!r}")
    return numbers


def _parse_line(text: str) -> list[list[float]]:
    numbers = _parse_numbers(text)
    if len(numbers) < 4 or len(numbers) % 2:
        raise argparse.ArgumentTypeError(f"must be X,Y,X,Y in m, two places or more, not {text!r}")
    return [numbers[k : k + 2] for k in range(0, len(numbers), 2)]


def _parse_yes(text: str) -> bool:
    if text not in ("yes", "no"):
        raise argparse.ArgumentTypeError(f"must be yes or no, not {text!r}")
    return text == "yes"


def _split_words(text: str) -> list[str]:
    return text.split(",")


EDIT = Command(
    "edit",
    run_edit,
    "correct the rooms and doors of a map; nothing is lost, all can be undone",
    "topomerge edit a.tmap --split-room 3 --line 4,0,4,6",
    (
        build_option(
            "input", metavar="A.tmap", help="the map, which stays as it is: A.edits.jsonl beside it gets a line; or a merge"
        ),
        build_option("--split-room", metavar="N", default=None, help="cut room N along --line"),
        build_option("--line", type=_parse_line, metavar="X,Y,X,Y", help="from wall to wall, m; may have more places"),
        build_option("--join-rooms", type=_split_words, metavar="N,N", default=None, help="make these rooms one"),
        build_option("--add-door", type=_parse_numbers, metavar="X,Y", default=None, help="a door in the wall at this place"),
        build_option("--delete-door", type=_parse_numbers, metavar="D", default=None, help="door D, or the one at X,Y"),
        build_option("--move-door", type=_parse_numbers, metavar="D", default=None, help="door D, or the one at X,Y, to --to"),
        build_option("--set-door", type=_parse_numbers, metavar="D", default=None, help="its --width, --open or --shut"),
        build_option("--to", type=_parse_numbers, metavar="X,Y", help="where a door or a window is"),
        build_option("--width", type=parse_positive, metavar="W", help="of a door or a window, m"),
        build_option("--open", dest="state", action="store_const", const=True, help="the door is open"),
        build_option("--shut", dest="state", action="store_const", const=False, help="the door is shut"),
        build_option("--delete-window", type=_parse_numbers, metavar="W", default=None, help="window W, or the one at X,Y"),
        build_option(
            "--move-window", type=_parse_numbers, metavar="W", default=None, help="window W, or the one at X,Y, to --to"
        ),
        build_option("--set-window", type=_parse_numbers, metavar="W", default=None, help="its --width, --sill or --head"),
        build_option("--sill", type=float, metavar="H", help="where a window begins, m above the floor"),
        build_option("--head", type=float, metavar="H", help="where a window ends, m above the floor"),
        build_option("--rename-room", nargs=2, metavar=("N", "NAME"), default=None, help="an empty name: none"),
        build_option("--set-room", metavar="N", default=None, help="its --kind, --outside or --looked-into"),
        build_option("--kind", metavar="KIND", help="what a room is for, as office"),
        build_option("--outside", type=_parse_yes, metavar="yes|no", help="does it lie out of doors?"),
        build_option("--looked-into", type=_parse_yes, metavar="yes|no", help="was it only looked into?"),
        build_option("--assign-area", nargs=2, metavar=("N,N", "AREA"), default=None, help="rooms of an area, as a ward"),
        build_option(
            "--add-landmark",
            nargs=3,
            metavar=("KIND", "VALUE", "X,Y,Z"),
            default=None,
            help="a text, tag or object at a place",
        ),
        build_option("--delete-landmark", type=_parse_numbers, metavar="X,Y,Z", default=None, help="the nearest one"),
        build_option("--storey", type=parse_whole_number, metavar="S", help="of places X,Y (default 0, the lowest)"),
        build_option("--undo", action="store_true", default=False, help="take back the last edit"),
        build_option("--redo", action="store_true", default=False, help="restore the edit that was taken back last"),
        build_option("--list", action="store_true", default=False, help="print the edits; a dash marks those taken back"),
        build_option("--from", dest="source", metavar="J.jsonl", default=None, help="append the edits of another journal"),
        build_option(
            "--match-rooms", nargs=2, metavar=("I,J", "A=B,A=B"), default=None, help="rooms A of map I are rooms B of map J"
        ),
        build_option("--accept", metavar="I,J", default=None, help="of a merge: map J lies where merge.json says"),
        build_option("--reject", metavar="I,J", default=None, help="of a merge: the maps do not belong together"),
        build_option("--by", metavar="NAME", help="who edits (default: the user)"),
        build_option("-o", "--output", metavar="B.tmap", default=None, help="also write the corrected map"),
        build_quiet_option(),
    ),
    paths=("input", "source", "output"),
    description="Correct a map: the journal beside it gets a line, and all commands read the map with its corrections. Numbers "
    "of rooms are those of `topomerge info`. Of the folder of a merge: decide, then merge again into it.",
)
