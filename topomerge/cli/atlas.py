"""The command `atlas`: many maps that are kept together, to which maps are added and from which they are taken away."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from topomerge.cli.command import Argument, Command, option, quiet
from topomerge.cli.console import check_inputs, say, warn
from topomerge.errors import InputError

Read = Callable[[str, argparse.Namespace], Any]  # path, options -> map


def atlas_command(args: argparse.Namespace, read: Read) -> int:
    """`topomerge atlas add|remove|list DIR …`.

    Args:
        read: gives the map that a path names, with the options of the command.
    """
    if args.verb == "add":
        return _add(args, read)
    return _remove(args) if args.verb == "remove" else _list(args)


def _add(args: argparse.Namespace, read: Read) -> int:
    from topomerge.fusion.atlas.store import add, check_folder

    if not args.items:
        raise InputError(f"{args.folder}: name the maps or clouds to add: topomerge atlas add {args.folder} MAP ...")
    check_folder(args.folder)
    check_inputs(args.items)
    maps = []
    for path in args.items:
        try:
            found = read(path, args)
        except InputError as error:
            raise InputError(str(error) if path in str(error) else f"{path}: {error}") from error
        maps.append((Path(path).stem, replace(found, source=path)))
    settings = {name: getattr(args, name) for name in ("scale", "threshold", "embedder") if hasattr(args, name)}
    return _told(add(args.folder, maps, **settings), args)


def _remove(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.store import read_atlas, remove

    if not args.items:
        held = ", ".join(e.name for e in read_atlas(args.folder).entries)
        raise InputError(f"{args.folder}: name the maps to take out; it holds {held or 'none'}")
    return _told(remove(args.folder, args.items), args)


def _told(found: Any, args: argparse.Namespace) -> int:
    """Say what came out; status 2 where nothing is connected."""
    warn(found.warnings)
    refused = found.status == "abstained"
    if not args.quiet:
        say(f"{found.words()} -> {args.folder}")
    elif found.alone and len(found.names) > 1:
        say(f"topomerge: {found.words()}", sys.stderr)
    return 2 if refused else 0


def _list(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.store import read_atlas

    if args.items:
        raise InputError(f"{args.items[0]}: list takes the folder only")
    told = read_atlas(args.folder).listing or {}
    if args.json:
        sys.stdout.write(json.dumps(told, indent=1, ensure_ascii=False) + "\n")
        return 0
    try:
        table = _table(told)
    except (KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"[:120]
        raise InputError(f"{args.folder}: its atlas.json is damaged ({reason}); make the atlas again from its maps") from error
    say(f"{args.folder}: {table}")
    return 0


def _table(told: Mapping[str, Any]) -> str:
    """What atlas.json tells, as text."""
    rows = [("map", "rooms", "storeys", "where", "source")]
    where = {k: n for n, c in enumerate(told["components"]) for k in c["maps"] if len(c["maps"]) > 1}
    for k, m in enumerate(told["maps"]):
        place = f"map_{where[k]}.tmap" if k in where else "apart"
        rows.append((str(m["name"]), str(m["rooms"]), str(m["storeys"]), place, str(m["source"])))
    widths = [max(len(row[c]) for row in rows) for c in range(4)]
    lines = ["  ".join([*(text.ljust(w) for text, w in zip(row, widths, strict=False)), row[-1]]).rstrip() for row in rows]
    return "\n".join([str(told["reason"]), *lines])


def atlas_verb(read: Read, reading: tuple[Argument, ...], share: Callable[[str], float]) -> Command:
    """The command.

    Args:
        read: see `atlas_command`.
        reading: options of clouds that are added.
        share: the `type` of a probability.
    """
    words = "let matched rooms propose places, too; takes twice as long (default: geometry only)"
    return Command(
        "atlas",
        partial(atlas_command, read=read),
        "keep many maps together: add, remove, list",
        "topomerge atlas add house/ ground.ply cellar.tmap attic.las",
        (
            option("verb", choices=("add", "remove", "list"), help="add maps (a new folder becomes an atlas), remove or list"),
            option("folder", metavar="DIR", help="the atlas"),
            option("items", nargs="*", metavar="MAP", help="of add: clouds or .tmap; of remove: names, as `list` prints them"),
            option("--scale", choices=("fixed", "free"), help="free: the scales of the maps differ (default fixed)"),
            option("--threshold", type=share, metavar="P", help="probability from which a link is believed (default 0.8)"),
            option("--descriptor", dest="embedder", choices=("learned", "engineered", "shapedna", "feather"), help=words),
            *reading,
            option("--json", action="store_true", default=False, help="of list: print atlas.json"),
            quiet("print nothing but warnings and what stands apart"),
        ),
        paths=("folder", "items"),
        description="Keep many maps together: those that belong to each other are joined, the others stay apart and are named. "
        "Status 2: nothing is connected.",
    )
