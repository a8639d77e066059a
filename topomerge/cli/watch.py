"""The command `watch`: scans and maps that appear in a folder become maps of an atlas."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.command import Command, option
from topomerge.cli.console import check_outputs, failure_line, printing, say, say_line, signal_behind, warn
from topomerge.cli.options import (
    ATLAS_OPTIONS,
    CLOUD_OPTIONS,
    above_zero,
    atlas_choices,
    given,
    map_from,
    output,
    quiet,
)

if TYPE_CHECKING:
    from topomerge.fusion.atlas.result import AtlasResult
    from topomerge.fusion.atlas.watch import Reader, Watch
    from topomerge.types import TopometricMap
    from topomerge.viz.rerun_log import RerunLog

EVERY, SETTLE = 2.0, 2.0  # s


def watch_command(args: argparse.Namespace) -> int:
    """`topomerge watch`: until Ctrl-C, or with --once until all that is there is in the atlas."""
    began = time.monotonic()
    watch: Watch | None = None
    try:
        watch = _watch(args)
        busy = True
        while busy or not args.once:
            busy = watch.look()
            if busy or not args.once:
                time.sleep(args.every)
    except (KeyboardInterrupt, Exception) as stop:
        if not isinstance(signal_behind(stop), KeyboardInterrupt):
            raise
        done = "nothing was read yet" if watch is None else _summary(watch)
        say(f"stopped after {time.monotonic() - began:.0f} s: {done}")
        return 130 if args.once else 0
    if not args.quiet:
        say_line(_summary(watch))
    return 0


def _watch(args: argparse.Namespace) -> Watch:
    """What looks into the folder, and tells what it does."""
    from topomerge.fusion.atlas.watch import Watch
    from topomerge.viz.atlas_report import atlas_html

    def tell(line: str, is_warning: bool) -> None:
        if is_warning:
            warn([line])
        elif not args.quiet:
            say_line(line)
            with printing():
                sys.stdout.flush()

    log = _rerun_log(args)

    def report(result: AtlasResult, joined: Mapping[int, TopometricMap], title: str, **words: Any) -> str:
        if log is not None and "component" not in words:  # once, with the page of all
            log.log(result, joined)
        return atlas_html(result, joined, title, **words)

    return Watch(
        Path(args.folder),
        Path(args.output),
        _reader(args),
        report,
        tell,
        settle=args.settle,
        replacing=args.replace == "longer",
        settings=atlas_choices(args),
        warm=not args.once,
    )


def _rerun_log(args: argparse.Namespace) -> RerunLog | None:
    if not hasattr(args, "rerun"):
        return None
    from topomerge.viz.rerun_log import RerunLog

    if args.rerun is not None:
        check_outputs([args.rerun])
    return RerunLog(args.rerun)


def _summary(watch: Watch) -> str:
    from topomerge.fusion.atlas.folder import check_folder

    counts, held = watch.counts, len(check_folder(watch.atlas).entries)
    parts = [f"{counts[what]} {what}" for what in ("added", "replaced", "unreadable") if counts[what]] or ["nothing new"]
    return f"{', '.join(parts)}; {watch.atlas} holds {held} map{'s' * (held != 1)}"


def _reader(args: argparse.Namespace) -> Reader:
    from topomerge.fusion.atlas.watch import Reader

    def read(path: Path) -> TopometricMap:
        return replace(map_from(str(path), args), source=str(path))

    def failure(error: Exception, path: Path) -> str | None:
        return None if signal_behind(error) is not None else f"{failure_line(error, [str(path)])}; it is skipped until it changes"

    names = ("voxel_size", "up", "unit", "one_frame", "sensor")
    return Reader(read, json.dumps(given(args, *names), sort_keys=True), failure)


WATCH = Command(
    "watch",
    watch_command,
    "put scans and maps that appear in a folder into an atlas",
    "topomerge watch scans/ -o site/",
    (
        option("folder", metavar="DIR", help="folder to watch: each file, or folder of scans, directly in it is one map"),
        output("ATLAS", "the atlas; a new folder becomes one"),
        option("--once", action="store_true", default=False, help="stop when everything in the folder is in the atlas"),
        option("--every", type=above_zero, default=EVERY, metavar="S", help="seconds between two looks (default 2)"),
        option(
            "--settle",
            type=above_zero,
            default=SETTLE,
            metavar="S",
            help="a file is complete after so many seconds without a change (default 2)",
        ),
        option(
            "--replace",
            choices=("longer", "never"),
            default="longer",
            help="longer (default): a changed file replaces its earlier map if it has most of that map's rooms; never: both stay",
        ),
        *ATLAS_OPTIONS,
        *CLOUD_OPTIONS,
        option(
            "--rerun",
            nargs="?",
            metavar="A.rrd",
            help="log cells, rooms, graph and links to Rerun: into a file, or without a name to a viewer that is opened",
        ),
        quiet("print nothing but warnings"),
    ),
    paths=("folder", "output", "rerun"),
    description="Watch a folder: scans and maps that appear in it, or change, become maps of an atlas. It may be stopped at any "
    "moment (Ctrl-C) and started again; report.html of the atlas loads itself anew in an open browser. A file that can't be "
    "read is named once, and tried again when it changes.",
)
