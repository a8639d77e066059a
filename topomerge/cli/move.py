"""The command `move`, and `merge --native`: files of other programs, written again with the poses of a merge."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from topomerge.cli.console import (
    Command,
    build_option,
    check_outputs,
    open_output_folder,
    print_line,
    warn,
)
from topomerge.cli.options import build_output_option, build_quiet_option, collect_reading_options
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.fusion.result import MergeResult
    from topomerge.io.native import Doubt, Format, Source

Plan = list[tuple[Path, "Format", list["Source"]]]


def run_move(args: argparse.Namespace) -> int:
    """`topomerge move`: write files of other programs with the poses of a merge."""
    from topomerge.fusion.frames import read_file_frames
    from topomerge.io.native import Source, plan_outputs

    frames = {frame.number: frame for frame in read_file_frames(Path(args.merged))}
    named = _parse_files(args.files, frames) or {k: f.source for k, f in frames.items() if f.source and f.motion is not None}
    if not named:
        raise InputError(f"{args.merged}: names no files; give those of its maps, as 0=a.db 1=b.db")
    sources, doubts = [], []
    for k, name in named.items():
        frame = frames[k]
        if frame.motion is None:
            raise InputError(f"{name}: map {k} stands apart, so that it has no pose; leave it out")
        sources.append(Source(_find_file(name), frame.motion))
        doubts.append(frame.doubt)
    if len({frames[k].into for k in named if frames[k].motion is not None}) > 1:
        raise InputError(
            f"{args.merged}: the maps {', '.join(map(str, named))} are not in one frame; give those of one joined map"
        )
    with open_output_folder(args.output) as folder:
        plan = plan_outputs(sources, folder)
        check_outputs([path for path, _, _ in plan], [source.path for source in sources])
        save_plan(plan, max(doubts, key=lambda doubt: doubt.place), args.quiet)
    return 0


def _parse_files(words: Sequence[str], frames: Mapping[int, object]) -> dict[int, str]:
    """Map the number of a map to its file, of words like ``1=b.db``; those without a number are counted from 0."""
    named: dict[int, str] = {}
    for place, word in enumerate(words):
        number = re.match(r"(\d{1,6})=(.+)", word)
        k, name = (int(number[1]), number[2]) if number else (place, word)
        if k not in frames:
            raise InputError(f"{word}: there is no map {k}, only {', '.join(map(str, sorted(frames)))}; name it as NUMBER=FILE")
        if k in named:
            raise InputError(f"{word}: map {k} has two files; run the command once for each")
        named[k] = name
    return named


def _find_file(name: str, how: str = "as NUMBER=FILE") -> Path:
    """Return the file to write again: of a folder of scans its trajectory.

    Args:
        how: another file is named, for messages.

    Raises:
        InputError: a map, or a folder without a trajectory.
    """
    path = Path(name)
    if path.suffix.lower() == ".tmap":
        raise InputError(f"{path}: is a map; name the file that it was made of, {how}")
    if not path.is_dir():
        return path
    from topomerge.io.scan_folder import find_scans, find_trajectory

    found = find_trajectory(path, find_scans(path)[0].parent)
    if found is None:
        raise InputError(f"{path}: is a folder without a trajectory; name the file with its poses, {how}")
    return found


def plan_merge(result: MergeResult, args: argparse.Namespace, folder: Path) -> tuple[Plan, Doubt | None]:
    """Plan what `merge --native` writes; an input that can't be written again is left out with a warning."""
    from topomerge.fusion.frames import LEAST_DOUBT, TURN_DOUBT, build_file_motion, convert_motion
    from topomerge.io.native import Doubt, Source, find_format, plan_outputs, refuse_scale
    from topomerge.io.piece import read_options

    sources = []
    for k, placement in result.placements.items():
        name = args.inputs[k]
        try:
            path = _find_file(name, f"by `topomerge move {folder} {k}=FILE -o moved`")
            form = find_format(path)
            if form is None:
                raise InputError(f"{name}: has no form in which it could be written again; take its points by --points")
            motion = build_file_motion(placement, result.maps[k].levelling, result.maps[0].levelling)
            options = read_options(path, collect_reading_options(name, args))
            source = Source(path, convert_motion(motion, options))
            refuse_scale(source, form)
            sources.append(source)
        except InputError as error:
            text = str(error)
            warn([text if text.startswith(name) else f"{name}: {text}"])
    rmse = result.registration.features.get("rmse", float("nan")) if result.registration else float("nan")
    doubt = Doubt(max(rmse, LEAST_DOUBT), TURN_DOUBT) if rmse == rmse else None
    return (plan_outputs(sources, folder) if sources else []), doubt


def save_plan(plan: Plan, doubt: Doubt | None, quiet: bool) -> None:
    """Write the files of a plan and say what is in them."""
    from topomerge.io.native import save_joined

    for path, form, sources in plan:
        tally = save_joined(form, sources, path, doubt)
        warn(tally.warnings)
        if not quiet:
            print_line(f"{' + '.join(str(source.path) for source in sources)}: {tally.describe()} -> {path}")


MOVE = Command(
    "move",
    run_move,
    "write files of other programs with the poses of a merge",
    "topomerge move merged/ -o moved/",
    (
        build_option("merged", metavar="MERGED", help="the folder of a merge or an atlas, or a pose graph (.g2o) of its maps"),
        build_option(
            "files",
            nargs="*",
            metavar="[N=]FILE",
            help="files in the frames of its maps, by the numbers of these (default: the files that were merged)",
        ),
        build_output_option("DIR", "folder for joined.db, joined.g2o and so on, and for A_moved.e57 of what is not joined"),
        build_quiet_option(),
    ),
    paths=("merged", "files", "output"),
    description="Write files of other programs again, in their own format, with the poses of a merge: databases of RTAB-Map, "
    "pose graphs, states of Cartographer, scene graphs, USDZ and maps of vacuum robots joined, scans and trajectories moved. No "
    "source is changed.",
)
