"""The command `atlas`: many maps in one folder, to which maps are added, from which they are taken away, and in which a place is
found."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.command import Command, option
from topomerge.cli.console import check_inputs, say, say_line, warn, write_out
from topomerge.cli.options import (
    ATLAS_OPTIONS,
    CLOUD_OPTIONS,
    at_least_one,
    atlas_choices,
    check_cloud_options,
    json_option,
    map_from,
    quiet,
)
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.fusion.atlas.partners import Workers
    from topomerge.fusion.atlas.result import AtlasResult


ROOMS_SHOWN = 8  # pairs of rooms of a map that `find` prints
FIND_COLUMNS = """\
Listed by fit, best first, then by share. fit: log odds that the new map lies there; other buildings mostly have less than 0.
share: each room of the new map has one vote, which goes to the rooms that look most like it; those of this map got this share.
rooms: pairs that look most like each other among the rooms of both maps, even if they look little alike.
`topomerge merge` tells whether it is the same place."""


def atlas_command(args: argparse.Namespace) -> int:
    """`topomerge atlas add|remove|list|find DIR …`. Status 2 of the first two: no maps are connected."""
    if args.verb in ("add", "find"):
        return _add(args) if args.verb == "add" else _find(args)
    return _remove(args) if args.verb == "remove" else _list(args)


def _add(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.folder import check_folder
    from topomerge.fusion.atlas.store import add
    from topomerge.viz.atlas_report import atlas_html

    if not args.items:
        raise InputError(f"{args.folder}: name the maps or clouds to add: topomerge atlas add {args.folder} MAP ...")
    check_folder(args.folder)
    choices, workers = atlas_choices(args), _workers(args)
    check_inputs(args.items)
    check_cloud_options(args.items, args)
    maps = ((Path(path).stem, replace(map_from(path, args), source=path)) for path in args.items)  # one in memory at a time
    return _report(add(args.folder, maps, atlas_html, workers, **choices), args)


def _workers(args: argparse.Namespace) -> Workers | None:
    """Who registers pairs: None is this process."""
    from topomerge.fusion.atlas.partners import cluster, processes

    if args.cluster and args.jobs > 1:
        raise InputError("--cluster and --jobs: give one of them; the workers of a cluster are its own")
    return cluster(args.cluster) if args.cluster else processes(args.jobs) if args.jobs > 1 else None


def _remove(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.folder import read_atlas
    from topomerge.fusion.atlas.store import remove
    from topomerge.viz.atlas_report import atlas_html

    if not args.items:
        names = ", ".join(e.name for e in read_atlas(args.folder).entries)
        raise InputError(f"{args.folder}: name the maps to take out; it holds {names or 'none'}")
    return _report(remove(args.folder, args.items, atlas_html), args)


def _find(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.find import find

    if len(args.items) != 1:
        raise InputError(f"{args.folder}: name the one map or cloud to look for: topomerge atlas find {args.folder} MAP")
    check_inputs(args.items)
    check_cloud_options(args.items, args)
    sightings = find(args.folder, map_from(args.items[0], args), args.first)
    if args.json:
        write_out(json.dumps([asdict(s) for s in sightings], indent=1, ensure_ascii=False) + "\n")
        return 0
    rows = [("map", "fit", "share", "rooms (new map = atlas map)")]
    for s in sightings:
        rooms = ", ".join(f"{i} = {j}" for i, j, _ in s.rooms[:ROOMS_SHOWN]) or "none similar"
        rows.append((s.name, "" if s.fit is None else f"{s.fit:+.1f}", f"{s.share:.2f}", rooms))
    widths = [max(len(row[c]) for row in rows) for c in range(3)]
    say("\n".join("  ".join((*(f"{word:<{wide}}" for word, wide in zip(row, widths, strict=False)), row[3])) for row in rows))
    if not args.quiet:
        say(f"\n{FIND_COLUMNS}")
    return 0


def _report(result: AtlasResult, args: argparse.Namespace) -> int:
    """Say what came out, and return the exit status."""
    warn(result.warnings)
    if not args.quiet:
        say_line(f"{result.words()} -> {args.folder}")
    elif result.alone and len(result.names) > 1:
        say_line(f"topomerge: {result.words()}", sys.stderr)
    return 2 if result.status == "abstained" else 0


def _list(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.folder import read_atlas

    if args.items:
        raise InputError(f"{args.items[0]}: list takes the folder only")
    listing = read_atlas(args.folder).listing or {}
    if args.json:
        write_out(json.dumps(listing, indent=1, ensure_ascii=False) + "\n")
        return 0
    try:
        table = _table(listing)
    except (KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"[:120]
        raise InputError(f"{args.folder}: its atlas.json is damaged ({reason}); make the atlas again from its maps") from error
    say(f"{args.folder}: {table}")
    return 0


def _table(listing: Mapping[str, Any]) -> str:
    """What atlas.json lists, as text."""
    rows = [("map", "rooms", "storeys", "where", "source")]
    joined_in = {k: n for n, c in enumerate(listing["components"]) for k in c["maps"] if len(c["maps"]) > 1}
    for k, m in enumerate(listing["maps"]):
        place = f"map_{joined_in[k]}.tmap" if k in joined_in else "apart"
        rows.append((str(m["name"]), str(m["rooms"]), str(m["storeys"]), place, " ".join(str(m["source"]).splitlines())))
    widths = [max(len(row[c]) for row in rows) for c in range(4)]
    lines = ["  ".join([*(text.ljust(w) for text, w in zip(row, widths, strict=False)), row[-1]]).rstrip() for row in rows]
    return "\n".join([str(listing["reason"]), *lines])


ATLAS = Command(
    "atlas",
    atlas_command,
    "keep many maps together: add, remove, list, find",
    "topomerge atlas add house/ ground.ply cellar.tmap attic.las",
    (
        option(
            "verb",
            choices=("add", "remove", "list", "find"),
            help="add maps (a new folder becomes an atlas), remove or list them, or find which of them a new map shows",
        ),
        option("folder", metavar="DIR", help="the atlas"),
        option("items", nargs="*", metavar="MAP", help="add, find: clouds or .tmap; remove: names as `list` prints them"),
        option("--first", type=at_least_one, default=5, metavar="N", help="find: how many maps to name (default 5)"),
        option("--jobs", type=at_least_one, default=1, metavar="N", help="add: register pairs in N processes (default 1)"),
        option("--cluster", default="", metavar="ADDRESS", help="add: register pairs on a Dask cluster, e.g. tcp://host:8786"),
        *ATLAS_OPTIONS,
        *CLOUD_OPTIONS,
        json_option("list: print atlas.json; find: print maps and rooms as JSON"),
        quiet("print nothing but warnings and what stands apart; find: only the table"),
    ),
    paths=("folder", "items"),
    description="Keep many maps together: those that belong to each other are joined, the others stay apart and are named. "
    "Status 2: nothing is connected. find names the maps and rooms that a new map shows, most likely first; merge tells whether "
    "it is so.",
)
