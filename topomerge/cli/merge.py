"""Commands `merge` and `match`: two maps or more."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import topomerge
from topomerge.cli.console import (
    PAGE_SUFFIXES,
    Command,
    ProgressBars,
    build_option,
    check_inputs,
    check_outputs,
    check_suffix,
    open_output_folder,
    print_line,
    warn,
    write_out,
)
from topomerge.cli.inputs import InputMaps, iter_input_maps
from topomerge.cli.move import plan_merge, save_plan
from topomerge.cli.options import (
    BELIEF_OPTIONS,
    CLOUD_OPTIONS,
    CONTEXT_STEPS,
    DESCRIPTOR,
    JOBS,
    NO_EDITS,
    build_json_option,
    build_output_option,
    build_quiet_option,
    check_cloud_options,
    check_descriptor,
    collect_belief_options,
    collect_given,
    collect_reading_options,
    is_map,
    name_option_in_errors,
)
from topomerge.errors import InputError
from topomerge.progress import report_steps, tell_step

if TYPE_CHECKING:
    import numpy as np

    from topomerge.cli.inputs import LoadedMap
    from topomerge.fusion.result import MergeResult
    from topomerge.registration.prepared import Prepared
    from topomerge.types import Sim3, TopometricMap


def choose_point_files(inputs: Sequence[str], folder: Path) -> dict[int, Path]:
    """Map the number of an input to the file for its points; a number stands in the name where two inputs are called alike. Of
    maps, which have none, there is none."""
    from topomerge.io.transformed_points import choose_suffix

    files: dict[int, Path] = {}
    taken: set[str] = set()
    for k, source in enumerate(map(Path, inputs)):
        if source.suffix.lower() == ".tmap":
            continue
        names = (f"{source.stem}{f'_{n}' if n > 1 else ''}_merged{choose_suffix(source)}" for n in range(1, len(inputs) + 1))
        name = next(name for name in names if name.lower() not in taken)  # some file systems take A for a
        taken.add(name.lower())
        files[k] = folder / name
    return files


def add_point_files(result: MergeResult, files: Mapping[int, Path]) -> MergeResult:
    """Return the result that names the files of its points."""
    return replace(result, points={k: path.name for k, path in files.items() if k in result.placements})


@contextmanager
def write_points(result: MergeResult, folder: Path, args: argparse.Namespace) -> Iterator[None]:
    """Write the points of each input that the result names beside their places, and rename them on success, when what else
    belongs to the merge is written; those of an earlier merge in the folder are replaced or removed."""
    from topomerge.archive import replace_on_success

    earlier = _find_earlier_points(folder, args.inputs)
    with ExitStack() as stack:
        for k, name in result.points.items():
            _write(result, k, stack.enter_context(replace_on_success(folder / name)), args)
        for k, source in enumerate(args.inputs if args.points and result.placements else ()):
            if is_map(source):
                warn([f"{source}: is a map, which has no points; give the scan that it was made of for --points"])
            elif k not in result.placements:
                warn([f"{source}: stands apart, its points are not written"])
        written = {folder / name for name in result.points.values()}
        for path in [*(earlier - written), *(path.resolve() for path in written)]:
            path.unlink(missing_ok=True)  # a kill leaves no points of another merge beside this one
        yield


def _find_earlier_points(folder: Path, inputs: Sequence[str]) -> set[Path]:
    """Return the files of points that the merge in a folder names, but for those that are inputs now."""
    try:
        names = json.loads((folder / "merge.json").read_text(encoding="utf-8"))["points"].values()
        names = [name for name in names if re.fullmatch(r"[^/\\]*_merged\.(las|laz|ply)", name)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return set()  # no merge, or one that is damaged or older
    taken = {Path(path).resolve() for path in inputs}
    return {path for path in (folder / name for name in names) if path.is_file() and path.resolve() not in taken}


def _write(result: MergeResult, k: int, path: Path, args: argparse.Namespace) -> None:
    from topomerge.io.transformed_points import save_transformed_points
    from topomerge.types import Sim3, is_level, transform_points

    place, levelling = result.placements[k], result.maps[k].levelling
    options = collect_reading_options(args.inputs[k], args)
    with ProgressBars(enabled=not args.quiet) as bars:
        own_frame, progress = place.pose == Sim3() and is_level(levelling), bars.start_task("points")

        def move(points: np.ndarray) -> np.ndarray:
            moved: np.ndarray = place.transform_points(points if is_level(levelling) else transform_points(levelling, points))
            return moved

        done = save_transformed_points(
            args.inputs[k], path, move, _compute_middle(result, k), same_frame=own_frame, progress=progress, **options
        )
    if done.beyond:
        warn([f"{args.inputs[k]}: {done.beyond:,} points are too far from all others for LAS and are left out"])
    if not args.quiet:
        print_line(f"{done.written:,} points of {args.inputs[k]} -> {path.name}")


def _compute_middle(result: MergeResult, k: int) -> np.ndarray:
    """Compute the middle (3,), m, of map k in the joined frame."""
    low, high = result.maps[k].grid.bounds
    middle: np.ndarray = result.placements[k].pose.apply((low + high)[None] / 2)[0]
    return middle


MERGE_MODULES = ("topomerge.fusion.pipeline", "topomerge.viz.merge_report")
MERGE_OUTPUTS = ("merge.json", "report.html", "merged.ply", "map.tmap")


def run_merge(args: argparse.Namespace) -> int:
    """`topomerge merge`: bring two maps or more together. Status 2: the merge is not believed."""
    if len(args.inputs) < 2:
        instead = "a folder is one map; name the files in it" if Path(args.inputs[0]).is_dir() else "give another one"
        raise InputError(f"{args.inputs[0]}: merge takes two maps or more, 1 given; {instead}")
    check_inputs(args.inputs)
    with InputMaps(args.inputs, args, MERGE_MODULES, len(args.inputs) == 2) as inputs, open_output_folder(args.output) as folder:
        files = choose_point_files(args.inputs, folder) if args.points else {}
        check_outputs([*(folder / name for name in MERGE_OUTPUTS), *files.values()], args.inputs)
        try:
            return _merge(args, inputs, folder, files)
        except OSError as error:
            raise InputError(f"{folder}: can't be written ({error.strerror or error}); give another place") from error


def _merge(args: argparse.Namespace, inputs: InputMaps, folder: Path, files: Mapping[int, Path]) -> int:
    belief = collect_belief_options(args)
    _check_choices(args)
    loaded = list(inputs)
    maps = [replace(one.map, source=path) for one, path in zip(loaded, args.inputs, strict=True)]
    choices = collect_given(args, "force", "rigid")
    poses = _read_decisions(maps, folder, args) or args.poses
    with ProgressBars(enabled=not args.quiet) as bars, report_steps(bars.start_task("merge")):
        result = topomerge.merge(
            _take_prepared(loaded, maps), scale=args.scale_of_b, embedder=args.descriptor, poses=poses, **choices, **belief
        )
        tell_step(1.0, "write the files")
    seconds = {"read": sum(one.read_seconds for one in loaded), "extract": sum(one.extract_seconds for one in loaded)}
    result = replace(result, seconds={**result.seconds, **seconds})
    warn(result.warnings)
    result = add_point_files(result, files)
    plan, doubt = plan_merge(result, args, folder) if args.native else ([], None)
    check_outputs([path for path, _, _ in plan], args.inputs)
    with write_points(result, folder, args):
        result.save(folder)
    save_plan(plan, doubt, args.quiet)
    if not args.quiet:
        joined = f"; {len(result.matches)} matches, {len(result.map.rooms)} rooms in all" if result.map else ""
        joined = "; no points are written" if args.points and not result.placements else joined
        print_line(f"{result.reason}{joined} -> {folder}")
    elif not result.merged:
        print_line(f"topomerge: {result.reason}", sys.stderr)
    return 0 if result.merged else 2


def _take_prepared(loaded: Sequence[LoadedMap], maps: Sequence[TopometricMap]) -> list[TopometricMap | Prepared]:
    """Return the maps, those of which everything is drawn with that."""
    from topomerge.registration.prepared import unpack_prepared

    return [map if one.parts is None else unpack_prepared(one.parts, map) for one, map in zip(loaded, maps, strict=True)]


def _read_decisions(
    maps: Sequence[TopometricMap], folder: Path, args: argparse.Namespace
) -> Mapping[tuple[int, int], Sim3 | None]:
    """Read the decisions about an earlier merge into the folder; lines that do not apply are reported."""
    from topomerge.edits.journal import find_journal, read_journal

    journal = read_journal(find_journal(folder))
    if getattr(args, "edits", None) == 0 or not journal.edits:
        return {}
    from topomerge.fusion.decisions import find_decisions

    if args.poses != "search":
        reason = f"{journal.path} says what was decided by hand; leave --poses out, or give --no-edits"
        raise InputError(f"--poses {args.poses}: {reason}")
    decisions = find_decisions(maps, journal.edits)
    warn([*journal.warnings, *(f"{journal.path}: {refused}" for refused in decisions.refused)])
    return decisions.poses


def _check_choices(args: argparse.Namespace) -> None:
    """Find out before the work starts whether it can be done as it is asked for.

    Raises:
        InputError: the line begins with the option.
    """
    check_cloud_options(args.inputs, args)
    check_descriptor(args)
    if args.poses == "search":
        return
    from topomerge.fusion.inputs import check_poses
    from topomerge.registration.surfaces import check_open3d

    with name_option_in_errors("--poses"):
        check_poses(args.poses, len(args.inputs), args.scale_of_b)
        if args.poses == "surfaces":
            check_open3d()


MERGE = Command(
    "merge",
    run_merge,
    "bring maps together, or say why not",
    "topomerge merge a.ply b.laz -o merged/",
    (
        build_option("inputs", nargs="+", metavar="MAP", help="two or more clouds or .tmap files, in any mix"),
        build_output_option("DIR", "folder for merge.json, merged.ply, map.tmap, report.html"),
        build_option(
            "--scale",
            dest="scale_of_b",
            choices=("fixed", "free"),
            default="fixed",
            help="free: the scales of all maps but the first are unknown",
        ),
        build_option(
            "--poses",
            choices=("search", "rooms", "surfaces"),
            default="search",
            help="rooms: from matched rooms alone, without a search of walls; surfaces: from the surfaces of each matched pair "
            "of rooms, as in the thesis (two maps; surfaces: of one scale)",
        ),
        build_option("--rigid", action="store_true", help="do not bend the maps to remove their drift"),
        build_option(
            "--points",
            action="store_true",
            default=False,
            help="also write the input points in the joined frame, bent like their maps: A_merged.las, .laz or .ply",
        ),
        build_option(
            "--native",
            action="store_true",
            default=False,
            help="also write the inputs again in their own formats with the new poses, joined where the format can hold several: "
            "RTAB-Map, g2o, Cartographer, slam_toolbox, Spark-DSG, USDZ, Valetudo, E57, LAS, PLY, PCD, trajectories",
        ),
        build_option(
            "--force", action="store_true", help="write the best merge even if it is not trusted (the exit status stays 2)"
        ),
        *BELIEF_OPTIONS,
        DESCRIPTOR,
        NO_EDITS,
        *CLOUD_OPTIONS,
        JOBS,
        build_quiet_option("print nothing but warnings and a refusal"),
    ),
    paths=("inputs", "output"),
    description="Bring maps together: status 0 and a joined map, or status 2 and the reason why it is not believed. Of more "
    "than two, those that belong to the first are joined, and the others are named.",
)


def run_match(args: argparse.Namespace) -> int:
    """`topomerge match`: print the matches of rooms with their probabilities, as tables or as JSON."""
    check_inputs([args.a, args.b])
    check_cloud_options([args.a, args.b], args)
    if args.method != "thesis":  # which has a descriptor and a context of its own
        check_descriptor(args)
    if args.method == "attention" and args.descriptor != "learned":
        raise InputError("--method attention needs the embedder that ships; take --method consistent")
    if args.report:
        check_outputs([args.report], [args.a, args.b])
        check_suffix("--report", args.report, PAGE_SUFFIXES)
    a, b = (loaded.map for loaded in iter_input_maps([args.a, args.b], args))
    from topomerge.fusion.match_belief import update_match_probabilities
    from topomerge.io.listing import format_json
    from topomerge.matching.match import check, format_matching, match, serialise_matching

    check(a, b)
    alone = [path for path, topomap in ((args.a, a), (args.b, b)) if len(topomap.rooms) == 1]
    warn(f"{path}: has one room: only its shape and doors can be compared" for path in alone)
    matching = match(a, b, args.descriptor, args.method, k=args.k, scale_free=args.scale_of_b == "free")
    matching = update_match_probabilities(matching, a, b, args.method)
    if args.report:
        from topomerge.viz.pair_reports import save_match_report

        save_match_report(matching, a, b, args.report)
    write_out(format_json(serialise_matching(matching, a, b)) if args.json else format_matching(matching, a, b) + "\n")
    return 0


MATCH = Command(
    "match",
    run_match,
    "find the rooms that two maps have in common",
    "topomerge match a.tmap b.tmap --json",
    (
        build_option("a", metavar="A", help="a .tmap, or a cloud, from which a map is extracted first"),
        build_option("b", metavar="B", help="the other map, likewise"),
        build_json_option(),
        build_option(
            "--report",
            metavar="M.html",
            default=None,
            help="also write plans and what is around each match as a web page",
        ),
        build_option(
            "--method",
            choices=("consistent", "attention", "growing", "assignment", "thesis"),
            default="consistent",
            help="consistent (default): sets of matches that one transform explains; attention: a network that sees both maps; "
            "the others are simpler",
        ),
        build_option(
            "--scale", dest="scale_of_b", choices=("free", "known"), default="known", help="free: the scale of b is unknown"
        ),
        DESCRIPTOR,
        CONTEXT_STEPS,
        NO_EDITS,
        *CLOUD_OPTIONS,
        JOBS,
    ),
    paths=("a", "b", "report"),
    description="Print which rooms of two maps are the same, with probabilities, and the transforms that would make them so.",
)
