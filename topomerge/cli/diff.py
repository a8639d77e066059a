"""The command `diff`: what has changed from one map to another, or from a building model to a scan."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from topomerge.cli.console import (
    Command,
    ProgressBars,
    build_option,
    check_inputs,
    check_outputs,
    check_suffix,
    open_output_folder,
    print_line,
    print_text,
    warn,
    write_all,
    write_out,
)
from topomerge.cli.inputs import iter_input_maps
from topomerge.cli.options import (
    BELIEF_OPTIONS,
    CLOUD_OPTIONS,
    JOBS,
    build_json_option,
    build_quiet_option,
    check_cloud_options,
    collect_belief_options,
    collect_given,
    parse_share,
)
from topomerge.progress import report_steps, tell_step

if TYPE_CHECKING:
    from topomerge.changes.compare import Changes
    from topomerge.changes.layers import PlacedMap
    from topomerge.types import TopometricMap

PAGE, LISTING = "diff.html", "changes.json"


def run_diff(args: argparse.Namespace) -> int:
    """`topomerge diff`: compare two maps of one place. Status 2: they could not be aligned."""
    check_inputs([args.old, args.new])
    check_cloud_options([args.old, args.new], args)
    belief = collect_belief_options(args)
    for name, suffixes in (("geojson", (".geojson", ".json")), ("bcf", (".bcf", ".bcfzip"))):
        if getattr(args, name):
            check_suffix(f"--{name}", getattr(args, name), suffixes)
    check_outputs([path for path in (args.geojson, args.bcf) if path], [args.old, args.new])
    if args.output is None:
        return _compare(args, None, belief)
    with open_output_folder(args.output) as folder:
        check_outputs([folder / PAGE, folder / LISTING], [args.old, args.new])
        return _compare(args, folder, belief)


def _compare(args: argparse.Namespace, folder: Path | None, belief: dict[str, Any]) -> int:
    maps = [loaded.map for loaded in iter_input_maps([args.old, args.new], args)]
    old, new = (replace(m, source=path) for m, path in zip(maps, (args.old, args.new), strict=True))
    placement, reason = _align(old, new, args, belief)
    if placement is None:
        if args.json:
            from topomerge.io.listing import format_json

            write_out(format_json({"status": "not aligned", "reason": reason}))
        print_line(f"topomerge: {reason}", sys.stderr)
        return 2
    with ProgressBars(enabled=not args.quiet) as bars, report_steps(bars.start_task("compare")):
        tell_step(0.0, "walls, doors, rooms and furniture")
        changes = _find_changes(old, new, placement, args)
    files = _list_files(changes, args, folder)
    write_all(files)
    if args.json:
        from topomerge.changes.files import serialise_changes
        from topomerge.io.listing import format_json

        write_out(format_json({"status": "compared", "reason": reason, **serialise_changes(changes)}))
    elif not args.quiet:
        from topomerge.changes.files import format_changes

        print_text(format_changes(changes))
        print_line(" ".join(("->", *(str(path) for path, _ in files))) if files else reason)
    return 0


def _align(
    old: TopometricMap, new: TopometricMap, args: argparse.Namespace, belief: dict[str, Any]
) -> tuple[PlacedMap | None, str]:
    """Return where the new map lies in the old one's frame, None where that is not believed, and why."""
    if args.aligned:
        from topomerge.types import Placement, Sim3

        return Placement(Sim3()), "compared as given: both are of one frame (--aligned)"
    from topomerge.changes.compare import align_maps

    with ProgressBars(enabled=not args.quiet) as bars, report_steps(bars.start_task("align")):
        placement, reason, warnings = align_maps(old, new, **belief)
    warn(warnings)
    return placement, reason


def _find_changes(old: TopometricMap, new: TopometricMap, placement: PlacedMap, args: argparse.Namespace) -> Changes:
    choices = collect_given(args, "least")
    if Path(args.old).suffix.lower() == ".ifc":
        from topomerge.changes.model import compare_with_model
        from topomerge.io.ifc import read_elements

        return compare_with_model(read_elements(Path(args.old)), old, new, placement, **choices)
    from topomerge.changes.compare import compare_maps

    return compare_maps(old, new, placement, **choices)


def _list_files(
    changes: Changes, args: argparse.Namespace, folder: Path | None
) -> list[tuple[str | Path, Callable[[Path], None]]]:
    """List where to write, and what writes it."""
    from topomerge.changes.files import save_bcf, save_geojson, save_json

    files: list[tuple[str | Path, Callable[[Path], None]]] = []
    if folder is not None:
        from topomerge.viz.pair_reports import save_changes_report

        files += [(folder / PAGE, partial(save_changes_report, changes)), (folder / LISTING, partial(save_json, changes))]
    if args.geojson:
        files.append((args.geojson, partial(save_geojson, changes)))
    if args.bcf:
        files.append((args.bcf, partial(save_bcf, changes)))
    return files


DIFF = Command(
    "diff",
    run_diff,
    "find what has changed between two maps, or between a building model and a scan",
    "topomerge diff last_year.tmap today.laz -o changes/",
    (
        build_option(
            "old", metavar="OLD", help="a .tmap, or a cloud, a building model or a plan, from which a map is extracted first"
        ),
        build_option("new", metavar="NEW", help="the other one, likewise"),
        build_option("-o", "--output", metavar="DIR", default=None, help=f"folder for {PAGE} (plans with a swipe) and {LISTING}"),
        build_json_option(),
        build_option("--geojson", metavar="C.geojson", default=None, help="also write the changes for a GIS"),
        build_option("--bcf", metavar="C.bcf", default=None, help="also write the changes as topics for a BIM viewer (BCF 3.0)"),
        build_option("--aligned", action="store_true", default=False, help="both are of one frame already: do not align them"),
        build_option(
            "--least", type=parse_share, metavar="P", help="leave out changes that are less probable, 0 to 1 (default 0.5)"
        ),
        *BELIEF_OPTIONS,
        *CLOUD_OPTIONS,
        JOBS,
        build_quiet_option("print nothing but warnings and a refusal"),
    ),
    paths=("old", "new", "output", "geojson", "bcf"),
    description="Find walls, doors, rooms and furniture that are new, gone or altered, by what both maps saw. "
    "Of a building model (.ifc, given first) also each wall, column, slab and door: seen, seen elsewhere, or not there.",
)
