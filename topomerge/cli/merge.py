"""The command `merge`: maps in, one map out, or an honest refusal."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import topomerge
from topomerge.cli.command import Command, option
from topomerge.cli.console import check_inputs, check_outputs, output_folder, say_line, warn
from topomerge.cli.merge_points import point_files, points_written, with_points
from topomerge.cli.options import (
    BELIEF_OPTIONS,
    CLOUD_OPTIONS,
    DESCRIPTOR,
    about,
    belief_choices,
    check_cloud_options,
    check_descriptor,
    given,
    map_from,
    output,
    quiet,
)
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.types import TopometricMap

MERGE_OUTPUTS = ("merge.json", "report.html", "merged.ply", "map.tmap")


def merge_command(args: argparse.Namespace) -> int:
    """`topomerge merge`: bring two maps or more together. Status 2: the merge is not believed."""
    if len(args.inputs) < 2:
        instead = "a folder is one map; name the files in it" if Path(args.inputs[0]).is_dir() else "give another one"
        raise InputError(f"{args.inputs[0]}: merge takes two maps or more, 1 given; {instead}")
    check_inputs(args.inputs)
    with output_folder(args.output) as folder:
        files = point_files(args.inputs, folder) if args.points else {}
        check_outputs([*(folder / name for name in MERGE_OUTPUTS), *files.values()], args.inputs)
        try:
            return _merge(args, folder, files)
        except OSError as error:
            raise InputError(f"{folder}: can't be written ({error.strerror or error}); give another place") from error


def _merge(args: argparse.Namespace, folder: Path, files: Mapping[int, Path]) -> int:
    belief = belief_choices(args)
    _check_choices(args)
    maps, read_seconds, extract_seconds = [], 0.0, 0.0
    for path in args.inputs:
        topomap, read, extract = _timed_map(path, args)
        maps.append(topomap)
        read_seconds, extract_seconds = read_seconds + read, extract_seconds + extract
    choices = given(args, "force", "rigid")
    result = topomerge.merge(maps, scale=args.scale_of_b, embedder=args.descriptor, poses=args.poses, **choices, **belief)
    result = replace(result, seconds={**result.seconds, "read": read_seconds, "extract": extract_seconds})
    warn(result.warnings)
    result = with_points(result, files)
    with points_written(result, folder, args):
        result.save(folder)
    if not args.quiet:
        joined = f"; {len(result.matches)} matches, {len(result.map.rooms)} rooms in all" if result.map else ""
        joined = "; no points are written" if args.points and not result.placements else joined
        say_line(f"{result.reason}{joined} -> {folder}")
    elif not result.merged:
        say_line(f"topomerge: {result.reason}", sys.stderr)
    return 0 if result.merged else 2


def _check_choices(args: argparse.Namespace) -> None:
    """Find out before the work starts whether it can be done as it is asked for.

    Raises:
        InputError: the line begins with the option.
    """
    from topomerge.fusion.inputs import check_poses
    from topomerge.registration.surfaces import check_open3d

    check_cloud_options(args.inputs, args)
    check_descriptor(args)
    with about("--poses"):
        check_poses(args.poses, len(args.inputs), args.scale_of_b)
        if args.poses == "surfaces":
            check_open3d()


def _timed_map(path: str, args: argparse.Namespace) -> tuple[TopometricMap, float, float]:
    """The map that a path names, and the seconds of reading and of extracting it; of a .tmap, all is reading."""
    began = perf_counter()
    topomap = map_from(path, args)
    seconds, extracting = perf_counter() - began, 0.0
    if Path(path).suffix.lower() != ".tmap":
        extracting = min(sum(s for step, s in topomap.seconds.items() if not step.startswith("read")), seconds)
    return replace(topomap, source=path), seconds - extracting, extracting


MERGE = Command(
    "merge",
    merge_command,
    "bring maps together, or say why not",
    "topomerge merge a.ply b.laz -o merged/",
    (
        option("inputs", nargs="+", metavar="MAP", help="two or more clouds or .tmap files, in any mix"),
        output("DIR", "folder for merge.json, merged.ply, map.tmap, report.html"),
        option(
            "--scale",
            dest="scale_of_b",
            choices=("fixed", "free"),
            default="fixed",
            help="free: the scales of all maps but the first are unknown",
        ),
        option(
            "--poses",
            choices=("search", "rooms", "surfaces"),
            default="search",
            help="rooms: from matched rooms alone, without a search of walls; surfaces: from the surfaces of each matched pair "
            "of rooms, as in the thesis (two maps; surfaces: of one scale)",
        ),
        option("--rigid", action="store_true", help="do not bend the maps to remove their drift"),
        option(
            "--points",
            action="store_true",
            default=False,
            help="also write the input points in the joined frame, bent like their maps: A_merged.las, .laz or .ply",
        ),
        option("--force", action="store_true", help="write the best merge even if it is not trusted (the exit status stays 2)"),
        *BELIEF_OPTIONS,
        DESCRIPTOR,
        *CLOUD_OPTIONS,
        quiet("print nothing but warnings and a refusal"),
    ),
    paths=("inputs", "output"),
    description="Bring maps together: status 0 and a joined map, or status 2 and the reason why it is not believed. Of more "
    "than two, those that belong to the first are joined, and the others are named.",
)
