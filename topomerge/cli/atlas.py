"""Commands `atlas` and `watch`: maps that come in one by one."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.console import (
    Command,
    build_option,
    check_inputs,
    check_outputs,
    find_signal,
    format_failure,
    guard_printing,
    print_line,
    print_text,
    warn,
    write_out,
)
from topomerge.cli.inputs import iter_input_maps, load_input_map
from topomerge.cli.options import (
    ATLAS_OPTIONS,
    CLOUD_OPTIONS,
    NO_EDITS,
    SELECTIVE,
    build_json_option,
    build_output_option,
    build_quiet_option,
    check_cloud_options,
    collect_atlas_options,
    collect_given,
    parse_count,
    parse_positive,
)
from topomerge.errors import InputError
from topomerge.progress import Stopwatch

if TYPE_CHECKING:
    from topomerge.fusion.atlas.partners import Workers
    from topomerge.fusion.atlas.result import AtlasResult
    from topomerge.fusion.atlas.watch import FolderWatcher, Reader
    from topomerge.types import TopometricMap
    from topomerge.viz.rerun_log import RerunLog


ROOMS_SHOWN = 8  # pairs of rooms of a map that `find` prints
FIND_COLUMNS = """\
Listed by fit, best first, then by share. fit: log odds that the new map lies there; other buildings mostly have less than 0.
share: each room of the new map has one vote, which goes to the rooms that look most like it; those of this map got this share.
rooms: pairs that look most like each other among the rooms of both maps, even if they look little alike.
landmarks (where maps share any): rare strings that both hold, radio counted as such; each counts as 3.9 of fit.
`topomerge merge` tells whether it is the same place."""


def run_atlas(args: argparse.Namespace) -> int:
    """`topomerge atlas add|remove|list|find DIR …`. Status 2 of the first two: no maps are connected."""
    if args.verb in ("add", "find"):
        return _add(args) if args.verb == "add" else _find(args)
    return {"remove": _remove, "list": _list, "update": _update}[args.verb](args)


def _add(args: argparse.Namespace) -> int:
    if not args.items:
        raise InputError(f"{args.folder}: name the maps or clouds to add: topomerge atlas add {args.folder} MAP ...")
    check_inputs(args.items)
    from topomerge.fusion.atlas.folder import read_folder
    from topomerge.fusion.atlas.store import add
    from topomerge.viz.atlas_report import render_atlas_html

    read_folder(args.folder)
    choices, workers = collect_atlas_options(args), _build_workers(args)
    check_cloud_options(args.items, args)
    with closing(iter_input_maps(args.items, args)) as loaded:  # few are in memory at a time
        maps = ((Path(path).stem, replace(one.map, source=path)) for path, one in zip(args.items, loaded, strict=True))
        return _report_result(add(args.folder, maps, render_atlas_html, workers, **choices), args)


def _build_workers(args: argparse.Namespace) -> Workers | None:
    """Return who registers pairs: None is this process."""
    from topomerge.fusion.atlas.partners import connect_cluster, start_processes

    jobs = getattr(args, "jobs", 1)
    if args.cluster and jobs > 1:
        raise InputError("--cluster and --jobs: give one of them; the workers of a cluster are its own")
    return connect_cluster(args.cluster) if args.cluster else start_processes(jobs) if jobs > 1 else None


def _remove(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.folder import read_atlas
    from topomerge.fusion.atlas.store import remove
    from topomerge.viz.atlas_report import render_atlas_html

    if not args.items:
        names = ", ".join(e.name for e in read_atlas(args.folder).entries)
        raise InputError(f"{args.folder}: name the maps to take out; it holds {names or 'none'}")
    return _report_result(remove(args.folder, args.items, render_atlas_html), args)


def _update(args: argparse.Namespace) -> int:
    from topomerge.fusion.atlas.store import update
    from topomerge.viz.atlas_report import render_atlas_html

    if args.items:
        raise InputError(f"{args.items[0]}: update takes the folder only")
    return _report_result(update(args.folder, render_atlas_html), args)


def _find(args: argparse.Namespace) -> int:
    if len(args.items) != 1:
        raise InputError(f"{args.folder}: name the one map or cloud to look for: topomerge atlas find {args.folder} MAP")
    check_inputs(args.items)
    check_cloud_options(args.items, args)
    scan = load_input_map(args.items[0], args)
    from topomerge.fusion.atlas.find import find

    sightings = find(args.folder, scan, args.first)
    if args.json:
        write_out(json.dumps([asdict(s) for s in sightings], indent=1, ensure_ascii=False) + "\n")
        return 0
    some = any(s.landmarks for s in sightings)
    rows = [("map", "fit", "share", *["landmarks"] * some, "rooms (new map = atlas map)")]
    for s in sightings:
        rooms = ", ".join(f"{i} = {j}" for i, j, _ in s.rooms[:ROOMS_SHOWN]) or "none similar"
        fit = "" if s.fit is None else f"{s.fit:+.1f}"
        rows.append((s.name, fit, f"{s.share:.2f}", *[f"{s.landmarks:.1f}"] * some, rooms))
    widths = [max(len(row[c]) for row in rows) for c in range(3 + some)]
    print_text(
        "\n".join("  ".join((*(f"{word:<{wide}}" for word, wide in zip(row, widths, strict=False)), row[-1])) for row in rows)
    )
    if not args.quiet:
        print_text(f"\n{FIND_COLUMNS}")
    return 0


def _report_result(result: AtlasResult, args: argparse.Namespace) -> int:
    """Say what came out, and return the exit status."""
    warn(result.warnings)
    if not args.quiet:
        print_line(f"{result.format_summary()} -> {args.folder}")
    elif result.alone and len(result.names) > 1:
        print_line(f"topomerge: {result.format_summary()}", sys.stderr)
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
        table = _format_listing(listing)
    except (KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"[:120]
        raise InputError(f"{args.folder}: its atlas.json is damaged ({reason}); make the atlas again from its maps") from error
    print_text(f"{args.folder}: {table}")
    return 0


def _format_listing(listing: Mapping[str, Any]) -> str:
    """Format the listing of atlas.json as text."""
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
    run_atlas,
    "keep many maps together: add, remove, list, find, update",
    "topomerge atlas add house/ ground.ply cellar.tmap attic.las",
    (
        build_option(
            "verb",
            choices=("add", "remove", "list", "find", "update"),
            help="add maps (a new folder becomes an atlas), remove or list them, find which of them a new map shows, or update "
            "what was put together with the edits in maps/",
        ),
        build_option("folder", metavar="DIR", help="the atlas"),
        build_option("items", nargs="*", metavar="MAP", help="add, find: clouds or .tmap; remove: names as `list` prints them"),
        build_option("--first", type=parse_count, default=5, metavar="N", help="find: how many maps to name (default 5)"),
        build_option(
            "--jobs",
            type=parse_count,
            metavar="N",
            help="add: register pairs in N processes (default 1), and extract at most N large clouds at once (default: what "
            "cores and memory allow)",
        ),
        build_option(
            "--cluster", default="", metavar="ADDRESS", help="add: register pairs on a Dask cluster, e.g. tcp://host:8786"
        ),
        *ATLAS_OPTIONS,
        NO_EDITS,
        *CLOUD_OPTIONS,
        build_json_option("list: print atlas.json; find: print maps and rooms as JSON"),
        build_quiet_option("print nothing but warnings and what stands apart; find: only the table"),
    ),
    paths=("folder", "items"),
    description="Keep many maps together: those that belong to each other are joined, the others stay apart and are named. "
    "Status 2: nothing is connected. find names the maps and rooms that a new map shows, most likely first; merge tells whether "
    "it is so.",
)


EVERY, SETTLE = 2.0, 2.0  # s


def run_watch(args: argparse.Namespace) -> int:
    """`topomerge watch`: until Ctrl-C, or with --once until all that is there is in the atlas."""
    clock = Stopwatch()
    watch: FolderWatcher | None = None
    try:
        watch = _build_monitor(args)
        busy = True
        while busy or not args.once:
            busy = watch.update()
            if busy or not args.once:
                time.sleep(args.every)
    except (KeyboardInterrupt, Exception) as stop:
        if not isinstance(find_signal(stop), KeyboardInterrupt):
            raise
        done = "nothing was read yet" if watch is None else _format_summary(watch)
        print_text(f"stopped after {clock.elapsed:.0f} s: {done}")
        return 130 if args.once else 0
    if not args.quiet:
        print_line(_format_summary(watch))
    return 0


def _build_monitor(args: argparse.Namespace) -> FolderWatcher:
    """Build the watcher of the folder, which reports what it does."""
    from topomerge.fusion.atlas.watch import FolderWatcher
    from topomerge.viz.atlas_report import render_atlas_html

    def tell(line: str, is_warning: bool) -> None:
        if is_warning:
            warn([line])
        elif not args.quiet:
            print_line(line)
            with guard_printing():
                sys.stdout.flush()

    log = _open_rerun_log(args)

    def report(result: AtlasResult, joined: Mapping[int, TopometricMap], title: str, **words: Any) -> str:
        if log is not None and "component" not in words:  # once, with the page of all
            log.log(result, joined)
        return render_atlas_html(result, joined, title, **words)

    return FolderWatcher(
        Path(args.folder),
        Path(args.output),
        _build_reader(args),
        report,
        tell,
        settle=args.settle,
        replacing=args.replace == "longer",
        settings=collect_atlas_options(args),
        warm=not args.once,
    )


def _open_rerun_log(args: argparse.Namespace) -> RerunLog | None:
    if not hasattr(args, "rerun"):
        return None
    from topomerge.viz.rerun_log import RerunLog

    if args.rerun is not None:
        check_outputs([args.rerun])
    return RerunLog(args.rerun)


def _format_summary(watch: FolderWatcher) -> str:
    from topomerge.fusion.atlas.folder import read_folder

    counts, held = watch.counts, len(read_folder(watch.atlas).entries)
    parts = [f"{counts[what]} {what}" for what in ("added", "replaced", "unreadable") if counts[what]] or ["nothing new"]
    return f"{', '.join(parts)}; {watch.atlas} holds {held} map{'s' * (held != 1)}"


def _build_reader(args: argparse.Namespace) -> Reader:
    from topomerge.fusion.atlas.watch import Reader

    def read(path: Path) -> TopometricMap:
        return replace(load_input_map(str(path), args), source=str(path))

    def failure(error: Exception, path: Path) -> str | None:
        return None if find_signal(error) is not None else f"{format_failure(error, [str(path)])}; it is skipped until it changes"

    names = ("voxel_size", "up", "unit", "sensor", *SELECTIVE)
    return Reader(read, json.dumps(collect_given(args, *names), sort_keys=True), failure)


WATCH = Command(
    "watch",
    run_watch,
    "put scans and maps that appear in a folder into an atlas",
    "topomerge watch scans/ -o site/",
    (
        build_option("folder", metavar="DIR", help="folder to watch: each file, or folder of scans, directly in it is one map"),
        build_output_option("ATLAS", "the atlas; a new folder becomes one"),
        build_option("--once", action="store_true", default=False, help="stop when everything in the folder is in the atlas"),
        build_option("--every", type=parse_positive, default=EVERY, metavar="S", help="seconds between two looks (default 2)"),
        build_option(
            "--settle",
            type=parse_positive,
            default=SETTLE,
            metavar="S",
            help="a file is complete after so many seconds without a change (default 2)",
        ),
        build_option(
            "--replace",
            choices=("longer", "never"),
            default="longer",
            help="longer (default): a changed file replaces its earlier map if it has most of that map's rooms; never: both stay",
        ),
        *ATLAS_OPTIONS,
        *CLOUD_OPTIONS,
        build_option(
            "--rerun",
            nargs="?",
            metavar="A.rrd",
            help="log cells, rooms, graph and links to Rerun: into a file, or without a name to a viewer that is opened",
        ),
        build_quiet_option("print nothing but warnings"),
    ),
    paths=("folder", "output", "rerun"),
    description="Watch a folder: scans and maps that appear in it, or change, become maps of an atlas. It may be stopped at any "
    "moment (Ctrl-C) and started again; report.html of the atlas loads itself anew in an open browser. A file that can't be "
    "read is named once, and tried again when it changes.",
)
