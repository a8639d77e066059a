"""The commands of landmarks: `mark` writes them into a map by hand, `find` looks for them in maps and atlases."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.console import Command, build_option, check_inputs, print_line, print_text, warn, write_all, write_out
from topomerge.cli.options import build_json_option, build_quiet_option, collect_given, parse_whole_number
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.types import Array, Landmarks, TopometricMap

BY_HAND = "by hand"  # source of what `mark` adds
MARKED_KINDS = ("text", "tag", "name", "object")  # options of both commands
FOUND_KINDS = (*MARKED_KINDS, "radio", "use", "area")  # options of `find`


def run_mark(args: argparse.Namespace) -> int:
    """`topomerge mark`: add landmarks to a map, take them out or list them."""
    from topomerge.extraction.landmarks import add_landmarks
    from topomerge.io.landmarks import format_landmark_table
    from topomerge.io.maps import load_map, save_map

    _check_words(args)
    map = load_map(args.input)
    _check_place(args, map)
    _check_journal(args)
    if args.list:
        write_out(format_landmark_table(map.landmarks.select(_select_rows(args, map.landmarks))))
        return 0
    if args.remove:
        gone = _select_rows(args, map.landmarks)
        if not gone.any():
            raise InputError(f"{args.input}: has no such landmark; see them with `topomerge mark {args.input} --list`")
        marked, what = replace(map, landmarks=map.landmarks.select(~gone)), f"{int(gone.sum())} removed"
    else:
        added = _build_added(args)
        marked = add_landmarks(_drop_earlier(map, added, Path(args.source).name) if args.source else map, added)
        what = f"{len(added)} added"
        if hasattr(args, "at") and (marked.landmarks.table["room"][-len(added) :] < 0).all():
            warn([f"{args.input}: no room is at {','.join(f'{v:g}' for v in args.at)} (--at: m in the frame of the map)"])
    write_all([(args.input, partial(save_map, marked))])
    if not args.quiet:
        print_line(f"{what}, {len(marked.landmarks)} landmark{'s' * (len(marked.landmarks) != 1)} in all -> {args.input}")
    return 0


def _check_words(args: argparse.Namespace) -> None:
    """Find out whether the words of `mark` belong together.

    Raises:
        InputError: no.
    """
    given = collect_given(args, *MARKED_KINDS)
    place = collect_given(args, "room", "storey", "at")
    if args.list and args.remove:
        raise InputError("--list and --remove: give one of them")
    if args.list or args.source:
        if args.source and (given or place or args.remove or args.list):
            raise InputError("--from: the file says what and where; leave the other options out")
        return
    if args.remove and not (given or place):
        raise InputError("--remove: say which landmarks: give --text, --tag, --name, --object, --room, --storey or --at")
    if not args.remove and not given:
        raise InputError(f"{args.input}: say what to mark: give --text, --tag, --name or --object, or --from a file")
    if not args.remove and not place:
        raise InputError(f"{args.input}: say where it is: give --room, --at or --storey")


def _check_journal(args: argparse.Namespace) -> None:
    """Refuse numbers of rooms where a journal numbers them anew: landmarks are written into the map as it was extracted."""
    from topomerge.edits.journal import find_journal, read_journal

    journal = read_journal(find_journal(args.input))
    if hasattr(args, "room") and not args.list and journal.edits:
        raise InputError(f"--room: {journal.path} numbers the rooms of {args.input} anew; give --at, or `topomerge edit` it")


def _check_place(args: argparse.Namespace, map: TopometricMap) -> None:
    for name, count in (("room", len(map.rooms)), ("storey", len(map.storeys))):
        if getattr(args, name, 0) >= max(count, 1) or (hasattr(args, name) and not count):
            valid = f"0 to {count - 1}" if count else "none"
            raise InputError(f"{args.input}: has no {name} {getattr(args, name)} ({valid}); see them with `topomerge info`")


def _build_added(args: argparse.Namespace) -> Landmarks:
    import numpy as np

    from topomerge.io.room_names import load_landmark_source
    from topomerge.types import build_landmarks, join_landmarks

    if args.source:
        return load_landmark_source(Path(args.source))
    columns: dict[str, Any] = collect_given(args, "room", "storey")
    at = np.array(args.at) if hasattr(args, "at") else None
    parts = []
    for kind in MARKED_KINDS:
        values = getattr(args, kind, [])
        if not all(value.strip() for value in values):
            raise InputError(f"--{kind}: is empty; write the {kind}")
        parts.append(build_landmarks(kind, values, BY_HAND, None if at is None else np.tile(at, (len(values), 1)), **columns))
    return join_landmarks(parts)


def _drop_earlier(map: TopometricMap, added: Landmarks, file: str) -> TopometricMap:
    """Return the map without what a file says anew: all that came from it, and, of the sources that it names, the kinds that it
    has (an exported map has no radio). What somebody marked by hand only goes where the file repeats it."""
    import numpy as np

    own = map.landmarks
    source = np.array([*own.sources, ""])[own.table["source"]]
    again = np.isin(source, [*added.sources]) & np.isin(own.table["kind"], added.table["kind"])
    repeated = set(zip(added.table["kind"].tolist(), added.get_values().tolist(), strict=True))
    same = [row in repeated for row in zip(own.table["kind"].tolist(), own.get_values().tolist(), strict=True)]
    gone = (source == file) | (again & np.where(source == BY_HAND, np.array(same, bool), True))
    return replace(map, landmarks=own.select(~gone))


def _select_rows(args: argparse.Namespace, landmarks: Landmarks) -> Array:
    """Return (n,) bool, whether it is what the options say. All are, where none is given."""
    import numpy as np

    given = {kind: getattr(args, kind) for kind in MARKED_KINDS if hasattr(args, kind)}
    rows = np.zeros(len(landmarks), bool) if given else np.ones(len(landmarks), bool)
    for kind, patterns in given.items():
        rows |= match_values(landmarks, (kind,), patterns)
    for name, value in collect_given(args, "room", "storey").items():
        rows &= landmarks.table[name] == value
    if hasattr(args, "at"):
        rows &= np.linalg.norm(landmarks.table["position"] - args.at, axis=1) < 0.01
    return rows


def match_values(landmarks: Landmarks, kinds: Sequence[str], patterns: Sequence[str]) -> Array:
    """Return (n,) bool: is it of these kinds, and its string one of the patterns?

    Case, blanks and hyphens do not count (C-209 is c209); `*` stands for any signs, `?` for one.
    """
    import numpy as np

    parts = [_drop_blanks(pattern) for pattern in patterns]
    any_of = re.compile("|".join(re.escape(word).replace(r"\*", ".*").replace(r"\?", ".") for word in parts))
    fits = [any_of.fullmatch(_drop_blanks(value)) is not None for value in landmarks.values]
    out: Array = np.array([*fits, False], bool)[landmarks.table["value"]] & landmarks.is_kind(*kinds)
    return out


def _drop_blanks(text: str) -> str:
    return re.sub(r"[\s\u00ad\u2010-\u2015-]", "", text.casefold())


def run_find(args: argparse.Namespace) -> int:
    """`topomerge find`: landmarks of maps and atlases. Status 2: there is none."""
    given = collect_given(args, *FOUND_KINDS)
    if not given:
        raise InputError(f"{', '.join(f'--{kind}' for kind in FOUND_KINDS)}: give one; say what to look for")
    check_inputs(args.inputs)
    maps = [path for item in args.inputs for path in list_map_files(Path(item))]
    found = [entry for path in maps for entry in _iter_found(path, given)]
    if args.json:
        write_out(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    elif found:
        print_text("\n".join(_format_found(found)))
    else:
        text = ", ".join(f"{kind} {' or '.join(patterns)}" for kind, patterns in given.items())
        print_line(f"not found: {text} (in {len(maps)} map{'s' * (len(maps) != 1)})")
    return 0 if found else 2


def list_map_files(path: Path) -> list[Path]:
    """List the maps of an input of `find`: a `.tmap`, an atlas, or a folder of maps.

    Raises:
        InputError: it is none of them, or holds none.
    """
    if path.is_dir() and (path / "atlas.json").is_file():
        from topomerge.fusion.atlas.folder import read_atlas

        return [path / entry.file for entry in read_atlas(path).entries]
    files = sorted(path.glob("*.tmap")) if path.is_dir() else [path]
    if path.is_dir() and not files:
        raise InputError(f"{path}: holds no .tmap and no atlas; give maps, a folder of maps or an atlas")
    if not path.is_dir() and path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: is no map; give a .tmap (of `topomerge extract`), a folder of maps or an atlas")
    return files


def _iter_found(path: Path, given: dict[str, list[str]]) -> Iterator[dict[str, Any]]:
    from topomerge.edits.apply import load_corrected_map
    from topomerge.edits.journal import find_journal
    from topomerge.io.landmarks import serialise_landmarks
    from topomerge.io.maps import load_landmarks

    landmarks = load_corrected_map(path).landmarks if find_journal(path).exists() else load_landmarks(path)[0]
    for kind, patterns in given.items():
        kinds = ("text", "name") if kind == "text" else (kind,)
        entries = serialise_landmarks(landmarks.select(match_values(landmarks, kinds, patterns)))
        for entry in _keep_strongest(entries) if kind == "radio" else entries:
            yield {"map": str(path), **entry}


def _keep_strongest(readings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keep, of each sender and room, the strongest reading: a map may have thousands."""
    ranked = sorted(readings, key=lambda entry: entry["number"] if entry["number"] is not None else -1e9)
    return list({(entry["value"], entry["storey"], entry["room"]): entry for entry in ranked}.values())[::-1]


def _format_found(found: Sequence[dict[str, Any]]) -> list[str]:
    rows = [("map", "kind", "value", "storey", "room", "place")]
    for entry in found:
        place = "–" if entry["position"] is None else " ".join(f"{v:.2f}" for v in entry["position"])
        numbers = ["–" if entry[name] is None else str(entry[name]) for name in ("storey", "room")]
        strength = f" ({entry['number']:g} dBm)" if entry["kind"] == "radio" and entry["number"] is not None else ""
        rows.append((entry["map"], entry["kind"], entry["value"] + strength, *numbers, place))  # type: ignore[arg-type]
    widths = [max(len(row[c]) for row in rows) for c in range(5)]
    return ["  ".join((*(word.ljust(wide) for word, wide in zip(row, widths, strict=False)), row[5])) for row in rows]


def _parse_place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = float("nan")
    if not all(abs(value) <= 1e9 for value in (x, y, z)):
        raise argparse.ArgumentTypeError(f"must be X,Y,Z in metres, as 3.2,-1,1.5, not {text!r}")
    return x, y, z


def _build_value_options(verb: str, kinds: Sequence[str]) -> tuple[Any, ...]:
    what = {
        "text": "a text, as of a door sign",
        "tag": "a tag, as tag36h11:7",
        "name": "the name of a room",
        "object": "an object",
        "radio": "an access point by its address: its strongest reading in each room",
        "use": "what rooms are for, as office",
        "area": "an area that rooms are part of, as ward A",
    }
    return tuple(build_option(f"--{k}", action="append", metavar="VALUE", help=f"{verb} {what[k]}") for k in kinds)


MARK = Command(
    "mark",
    run_mark,
    "write door signs, tags, names and objects into a map by hand",
    'topomerge mark a.tmap --room 7 --text "2.113"',
    (
        build_option("input", metavar="A.tmap", help="the map, which is changed"),
        *_build_value_options("mark (with --remove, --list: only)", MARKED_KINDS),
        build_option(
            "--room", type=parse_whole_number, metavar="N", help="the room whose door it is at, in which it is, or its name"
        ),
        build_option("--at", type=_parse_place, metavar="X,Y,Z", help="where it is, m in the frame of the map"),
        build_option("--storey", type=parse_whole_number, metavar="N", help="where neither room nor place are known"),
        build_option(
            "--from",
            dest="source",
            default=None,
            metavar="FILE",
            help="take landmarks and names of rooms from a table (.csv), JSON, GeoJSON, IndoorGML, a scene graph, or anything "
            "else that extract reads",
        ),
        build_option("--remove", action="store_true", default=False, help="take out what the other options say"),
        build_option("--list", action="store_true", default=False, help="print them as a table that can lie beside a scan"),
        build_quiet_option(),
    ),
    paths=("input", "source"),
    description="Write landmarks into a map: they tell places apart that look alike. Values may be given several times. With "
    "--remove and --list, `*` and `?` in a value stand for any signs.",
)
FIND = Command(
    "find",
    run_find,
    "find a door sign, a tag, a name, an object or an access point in maps",
    'topomerge find --text "2.113" atlas/',
    (
        build_option("inputs", nargs="+", metavar="MAP", help="maps (.tmap), folders of maps, atlases"),
        *_build_value_options("find", FOUND_KINDS),
        build_json_option("print JSON instead of a table"),
    ),
    paths=("inputs",),
    description="Find landmarks: map, storey, room and place of each. Case, blanks and hyphens do not count; `*` and `?` stand "
    "for any signs. --text also finds names of rooms. Status 2: nothing was found.",
)
