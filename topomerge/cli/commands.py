"""The commands of the command line. To add one, write a function and enter it in `COMMANDS`.

Heavy modules are imported inside the functions, so that `--help` needs none of them.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import topomerge
from topomerge.cli.atlas import atlas_verb
from topomerge.cli.command import Command, count, option, output, quiet
from topomerge.cli.console import Bars, check_inputs, check_outputs, output_folder, say, warn, write_all
from topomerge.cli.export import EXPORT, VIEW
from topomerge.cli.export_embedder import EXPORT_EMBEDDER
from topomerge.errors import InputError

FIGURE_FORMATS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


def _above_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0, not {text!r}")
    return value


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 1, not {text!r}")
    return value


def _given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    return {name: getattr(args, name) for name in names if hasattr(args, name)}


READING = (
    option(
        "--up",
        choices=("z", "y", "x", "-z", "-y", "-x"),
        help="axis of the input that points up (default z, for glTF y); -y: it points down",
    ),
    option("--unit", choices=("m", "cm", "mm", "ft", "in"), help="unit of the input (default m)"),
    option("--scale", type=_above_zero, metavar="S", help="multiply coordinates by this (default 1)"),
    option("--resolution", type=_above_zero, metavar="R", help="m a pixel, of a plain image of a floor plan"),
    option("--extrude", type=_above_zero, metavar="H", help="m of wall height for 2D maps (default 2.5)"),
    option("--ceiling", action="store_true", help="close 2D maps with a ceiling"),
    option("--spacing", type=_above_zero, metavar="D", help="m between points on surfaces of meshes, models and 2D maps"),
    option("--doors", action="store_true", help="keep the door leaves of building models: a leaf is modelled shut"),
)


def extract_command(args: argparse.Namespace) -> int:
    """`topomerge extract`: points in, map out."""
    outputs = _outputs(args)
    check_outputs([path for path, _ in outputs], [args.input])
    with Bars(enabled=not args.quiet) as bars:
        from topomerge.extraction.extract import extract
        from topomerge.io.points import read_chunks

        reading = _given(args, "up", "unit", "scale", "resolution", "extrude", "ceiling", "spacing", "doors")
        chunks = read_chunks(args.input, **reading, progress=bars.task("read"))
        choices = _given(args, "voxel_size", "preset")
        found = extract(chunks, **choices, name=args.input, progress=bars.task("extract"))
        write_all([(path, partial(getattr(topomerge, writer), found)) for path, writer in outputs])
    warn(found.warnings)
    if not args.quiet:
        from topomerge.io.listing import map_to_text

        say(map_to_text(found))
    return 0


def _outputs(args: argparse.Namespace) -> list[tuple[str, str]]:
    """Where to write, and the name of topomerge's function (map, path) that writes it."""
    if args.figure and Path(args.figure).suffix.lower() not in FIGURE_FORMATS:
        raise InputError(f"{args.figure}: unknown kind of figure; end the name with one of {' '.join(FIGURE_FORMATS)}")
    writers = {"output": "save_map", "json": "save_json", "ply": "save_rooms_ply", "figure": "save_figure"}
    writers["report"] = "save_report"
    return [(getattr(args, name), writer) for name, writer in writers.items() if getattr(args, name)]


def info_command(args: argparse.Namespace) -> int:
    """`topomerge info`: what a map holds."""
    from topomerge.io.listing import json_text, map_to_json, map_to_text
    from topomerge.io.maps import load_map

    found = load_map(args.input)
    warn(found.warnings)
    if args.json:
        sys.stdout.write(json_text(map_to_json(found)))
    else:
        say(map_to_text(found))
    return 0


def simulate_command(args: argparse.Namespace) -> int:
    """`topomerge simulate`: clouds of a building that is known, with the truth."""
    choices = _given(args, "seed", "storeys", "overlap", "rooms", "hard")
    if hasattr(args, "sensors"):
        choices["sensors"] = tuple(name.strip() for name in args.sensors.split(",") if name.strip())
    with output_folder(args.output) as folder:
        check_outputs([folder / "truth.json"])
        from topomerge.datasets.pairs.simulate import outputs, simulate

        building, made, frame = simulate(args.building, **choices, scale=args.scale == "free")
        files = outputs(building, made, frame, folder)
        write_all(files)
    if not args.quiet:
        print(f"{building.name}: {len(building.rooms)} rooms -> {' '.join(str(path) for path, _ in files)}")
    return 0


def completion_command(args: argparse.Namespace) -> int:
    """`topomerge completion`: a script for the shell."""
    from topomerge.cli.completion import script

    sys.stdout.write(script(args.shell, COMMANDS))
    return 0


def embed_command(args: argparse.Namespace) -> int:
    """`topomerge embed`: a row of numbers for each room."""
    check_outputs([args.output], [args.input])
    from topomerge.embedding.embedders import embedder

    describe = embedder(args.descriptor, args.k)
    rows = describe(_map_from(args.input, args))
    import numpy as np

    def save(path: Path) -> None:
        with path.open("wb") as file:  # np.save would add .npy to another name
            np.save(file, rows, allow_pickle=False)

    write_all([(args.output, save)])
    if not args.quiet:
        print(f"{len(rows)} rooms, {rows.shape[1]} numbers each -> {args.output}")
    return 0


def match_command(args: argparse.Namespace) -> int:
    """`topomerge match`: which rooms of two maps are the same."""
    from topomerge.io.listing import json_text
    from topomerge.matching.listing import matching_to_json, matching_to_text
    from topomerge.matching.match import check, match

    check_inputs([args.a, args.b])
    a, b = _map_from(args.a, args), _map_from(args.b, args)
    check(a, b)
    alone = [path for path, m in ((args.a, a), (args.b, b)) if len(m.rooms) == 1]
    warn(f"{path}: has one room: only its shape and doors can be compared" for path in alone)
    found = match(a, b, args.descriptor, args.method, k=args.k, scale_free=args.scale_of_b == "free")
    sys.stdout.write(json_text(matching_to_json(found, a, b)) if args.json else matching_to_text(found, a, b) + "\n")
    return 0


def merge_command(args: argparse.Namespace) -> int:
    """`topomerge merge`: maps in, one map out, or an honest refusal."""
    if len(args.inputs) < 2:
        raise InputError(f"{args.inputs[0]}: merge takes two maps or more, 1 given; give another one")
    check_inputs(args.inputs)
    with output_folder(args.output) as folder:
        check_outputs([folder / name for name in ("merge.json", "report.html", "merged.ply", "map.tmap")], args.inputs)
        try:
            return _merge(args, folder)
        except OSError as error:
            raise InputError(f"{folder}: can't be written ({error.strerror or error}); give another place") from error


def _merge(args: argparse.Namespace, folder: Path) -> int:
    from dataclasses import replace
    from time import perf_counter

    maps, read, extracted = [], 0.0, 0.0
    for path in args.inputs:
        began = perf_counter()
        try:
            found = _map_from(path, args)
        except InputError as error:
            raise InputError(str(error) if path in str(error) else f"{path}: {error}") from error
        took = perf_counter() - began
        steps = 0.0  # of a .tmap, all is reading
        if Path(path).suffix.lower() != ".tmap":
            steps = min(sum(s for step, s in found.seconds.items() if not step.startswith("read")), took)
        read, extracted = read + took - steps, extracted + steps
        maps.append(replace(found, source=path))
    choices = _given(args, "force", "threshold")
    result = topomerge.merge(maps, scale=args.scale_of_b, embedder=args.descriptor, poses=args.poses, **choices)
    result = replace(result, seconds={**result.seconds, "read": read, "extract": extracted})
    warn(result.warnings)
    result.save(folder)
    if not args.quiet:
        joined = f"; {len(result.matches)} matches, {len(result.map.rooms)} rooms in all" if result.map else ""
        say(f"{result.reason}{joined} -> {folder}")
    elif not result.merged:
        say(f"topomerge: {result.reason}", sys.stderr)
    return 0 if result.merged else 2


def _map_from(path: str, args: argparse.Namespace) -> Any:
    """The map in a .tmap, or the one that is extracted from anything else."""
    from topomerge.io.maps import load_map

    if Path(path).suffix.lower() == ".tmap":
        found = load_map(path)
    else:
        from topomerge.extraction.extract import extract
        from topomerge.io.points import read_chunks

        with Bars(enabled=not getattr(args, "quiet", False)) as bars:
            chunks = read_chunks(path, **_given(args, "up", "unit"), progress=bars.task("read"))
            found = extract(chunks, **_given(args, "voxel_size"), name=path, progress=bars.task("extract"))
    warn(found.warnings)
    return found


MAPS = (
    option(
        "--descriptor",
        default="learned",
        metavar="NAME",
        help="learned (default: the embedder that ships), engineered, shapedna, feather, or the folder of a trained embedder",
    ),
    option("--k", type=count, default=0, metavar="K", help="steps of context around each room (default 0)"),
    option("--voxel-size", type=_above_zero, metavar="E", help="edge length of a cell where a cloud is given, m (default 0.1)"),
    *(o for o in READING if o[0][0] in ("--up", "--unit")),
)

COMMANDS = (
    Command(
        "extract",
        extract_command,
        "find the rooms, doors and storeys of one partial map",
        "topomerge extract scan.ply -o a.tmap --json a.json --ply a_rooms.ply --figure a.png",
        (
            option("input", metavar="SCAN", help="point cloud, mesh, building model, OctoMap or 2D map"),
            output("A.tmap", "the map to write"),
            option("--json", metavar="A.json", default=None, help="also write rooms, doors and storeys as JSON"),
            option("--ply", metavar="A.ply", default=None, help="also write the occupied cells with their room as PLY"),
            option("--figure", metavar="A.png", default=None, help="also draw the plan of each storey"),
            option("--report", metavar="A.html", default=None, help="also write plans, tables and a 3D view as one web page"),
            option("--voxel-size", type=_above_zero, metavar="E", help="edge length of a cell, m (default 0.1)"),
            option("--preset", choices=("default", "thesis"), help="parameters: ours (default) or those of the thesis"),
            *READING,
            quiet("no table, no progress; only warnings"),
        ),
        paths=("input", "output", "json", "ply", "figure", "report"),
        description="Find the rooms, doors and storeys of one partial map, and print a table of them.",
    ),
    Command(
        "info",
        info_command,
        "print what a map holds",
        "topomerge info a.tmap",
        (
            option("input", metavar="A.tmap", help="a map that `topomerge extract` wrote"),
            option("--json", action="store_true", default=False, help="print JSON instead of tables"),
        ),
        paths=("input",),
        description="Print the rooms, storeys, doors and times of a map.",
    ),
    Command(
        "embed",
        embed_command,
        "describe each room of a map by numbers",
        "topomerge embed a.tmap --descriptor shapedna --k 1 -o a.npy",
        (
            option("input", metavar="A", help="a .tmap, or a cloud, which is extracted first"),
            output("A.npy", "NumPy array, a row for each room"),
            *MAPS,
            quiet(),
        ),
        paths=("input", "output"),
        description="Describe each room of a map by numbers: rooms that look alike get rows that are close.",
    ),
    Command(
        "match",
        match_command,
        "find the rooms that two maps have in common",
        "topomerge match a.tmap b.tmap --json",
        (
            option("a", metavar="A", help="a .tmap, or a cloud, which is extracted first"),
            option("b", metavar="B", help="the other one"),
            option("--json", action="store_true", default=False, help="print JSON instead of tables"),
            option(
                "--method",
                choices=("consistent", "growing", "assignment", "thesis"),
                default="consistent",
                help="sets of matches that one transform explains (default), or simpler ways",
            ),
            option(
                "--scale", dest="scale_of_b", choices=("free", "known"), default="known", help="free: the scale of b is unknown"
            ),
            *MAPS,
        ),
        paths=("a", "b"),
        description="Print which rooms of two maps are the same, with probabilities, and the transforms that would make them so.",
    ),
    Command(
        "merge",
        merge_command,
        "bring maps together, or say why not",
        "topomerge merge a.ply b.laz -o merged/",
        (
            option("inputs", nargs="+", metavar="MAP", help="clouds or .tmap, two or more, in any mix"),
            output("DIR", "folder for merge.json, merged.ply, map.tmap, report.html"),
            option(
                "--scale",
                dest="scale_of_b",
                choices=("fixed", "free"),
                default="fixed",
                help="free: those of all but the first are unknown",
            ),
            option(
                "--poses",
                choices=("search", "rooms"),
                default="search",
                help="rooms: only of matched rooms by their surfaces, as the thesis does; two maps",
            ),
            option("--force", action="store_true", help="write the best merge even if it is not believed (status 2 stays)"),
            option("--threshold", type=_share, metavar="P", help="probability from which a merge is believed (default 0.8)"),
            *(o for o in MAPS if o[0][0] != "--k"),
            quiet("print nothing but warnings and a refusal"),
        ),
        paths=("inputs", "output"),
        description="Bring maps together: status 0 and a joined map, or status 2 and the reason why it is not believed. Of more "
        "than two, those that belong to the first are joined, and the others are named.",
    ),
    Command(
        "simulate",
        simulate_command,
        "make one or two partial maps of a building that is known exactly",
        "topomerge simulate --building office --seed 7 --sensors tls,depth --overlap 0.4 -o pair/",
        (
            option("--building", required=True, metavar="KIND", default=None, help="office, hotel, house, school, ..."),
            option("--seed", type=count, metavar="N", help="another number, another building (default 7)"),
            option("--storeys", type=count, metavar="N", help="1 to 8 (default 1)"),
            option(
                "--sensors", metavar="A,B", help="tls lidar depth mono laser2d tablet; one gives one cloud (default tls,depth)"
            ),
            option("--overlap", type=float, metavar="S", help="share of the rooms that both maps visit (default 0.4)"),
            option("--rooms", type=count, metavar="N", help="of each map, at most (default 15; all, of a single cloud)"),
            option("--scale", choices=("free", "known"), default="known", help="free: the scale of b is unknown"),
            option("--hard", choices=("other-building", "other-storey", "twin-wing"), help="b is of a place that looks like a's"),
            output("DIR", "folder for a.ply, b.ply, truth.json, plan.png"),
            quiet(),
        ),
        paths=("output",),
        description="Make partial maps of a building from a seed: clouds in random frames, the truth about them, and a picture.",
    ),
    Command(
        "completion",
        completion_command,
        "print a script that completes commands and options in your shell",
        "topomerge completion bash >> ~/.bashrc",
        (option("shell", choices=("bash", "zsh", "fish"), help="the shell that is to learn it"),),
        description="Print a script with which the Tab key completes commands, options and their values: for bash to go into "
        "~/.bashrc, for zsh into ~/.zshrc, for fish into ~/.config/fish/completions/topomerge.fish.",
    ),
    atlas_verb(_map_from, tuple(o for o in MAPS if o[0][0] not in ("--descriptor", "--k")), _share),
    EXPORT,
    EXPORT_EMBEDDER,
    VIEW,
)
