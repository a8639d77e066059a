"""The command `extract`: points in, map out."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import topomerge
from topomerge.cli.command import Command, option
from topomerge.cli.console import PAGE_SUFFIXES, Bars, check_outputs, check_suffix, say, warn, write_all
from topomerge.cli.options import ONE_FRAME, UNIT, UP, above_zero, given, output, quiet
from topomerge.errors import InputError

OTHER_OUTPUTS = "--json, --ply, --figure, --report"
FIGURE_FORMATS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


def extract_command(args: argparse.Namespace) -> int:
    """`topomerge extract`: find the rooms, doors and storeys of a cloud; write the map and whatever else was asked for."""
    outputs = _outputs(args)
    check_outputs([path for path, _ in outputs], [args.input, *given(args, "poses").values()])
    if Path(args.output).suffix.lower() != ".tmap":  # no other command would take it for a map
        raise InputError(f"{args.output}: -o names the map; end its name with .tmap (for other files there are {OTHER_OUTPUTS})")
    with Bars(enabled=not args.quiet) as bars:
        from topomerge.extraction.extract import extract
        from topomerge.io.points import read_chunks

        reading = given(
            args, "up", "unit", "scale", "resolution", "extrude", "ceiling", "spacing", "doors", "poses", "topic", "one_frame"
        )
        chunks = read_chunks(args.input, **reading, progress=bars.task("read"))
        choices = given(args, "voxel_size", "preset")
        topomap = extract(chunks, **choices, name=args.input, progress=bars.task("extract"))
        write_all([(path, partial(getattr(topomerge, writer), topomap)) for path, writer in outputs])
    warn(topomap.warnings)
    if not args.quiet:
        from topomerge.io.listing import map_to_text

        say(map_to_text(topomap))
    return 0


def _outputs(args: argparse.Namespace) -> list[tuple[str, str]]:
    """Where to write, and the name of topomerge's function (map, path) that writes it."""
    if args.figure and Path(args.figure).suffix.lower() not in FIGURE_FORMATS:
        raise InputError(f"{args.figure}: unknown kind of figure; end the name with one of {' '.join(FIGURE_FORMATS)}")
    for name, suffixes in (("ply", (".ply",)), ("report", PAGE_SUFFIXES)):
        if getattr(args, name):
            check_suffix(f"--{name}", getattr(args, name), suffixes)
    writers = {"output": "save_map", "json": "save_json", "ply": "save_rooms_ply", "figure": "save_figure"}
    writers["report"] = "save_report"
    return [(getattr(args, name), writer) for name, writer in writers.items() if getattr(args, name)]


EXTRACT = Command(
    "extract",
    extract_command,
    "find the rooms, doors and storeys of one partial map",
    "topomerge extract scan.ply -o a.tmap --json a.json --ply a_rooms.ply --figure a.png",
    (
        option("input", metavar="SCAN", help="point cloud, folder of scans, ROS bag, mesh, building model, OctoMap or 2D map"),
        output("A.tmap", "map to write"),
        option("--json", metavar="A.json", default=None, help="also write rooms, doors and storeys as JSON"),
        option("--ply", metavar="A.ply", default=None, help="also write the occupied cells with their room as PLY"),
        option("--figure", metavar="A.png", default=None, help="also draw the plan of each storey"),
        option("--report", metavar="A.html", default=None, help="also write plans, tables and a 3D view as one web page"),
        option("--voxel-size", type=above_zero, metavar="E", help="edge length of a cell, m (default 0.1)"),
        option("--preset", choices=("default", "thesis"), help="default, or the parameters of the thesis"),
        UP,
        UNIT,
        ONE_FRAME,
        option("--scale", type=above_zero, metavar="S", help="multiply coordinates by this (default 1)"),
        option("--resolution", type=above_zero, metavar="R", help="m per pixel of a plain image of a floor plan"),
        option("--extrude", type=above_zero, metavar="H", help="m of wall height for 2D maps (default 2.5)"),
        option("--ceiling", action="store_true", help="close 2D maps with a ceiling"),
        option(
            "--spacing",
            type=above_zero,
            metavar="D",
            help="m between points on surfaces of meshes, models and 2D maps, or at the finest level of an octree",
        ),
        option("--doors", action="store_true", help="keep the door leaves of building models, where doors are modelled shut"),
        option(
            "--poses",
            metavar="TRAJECTORY",
            help="where scans were taken: a KITTI or TUM file, or a topic of the bag (default: a trajectory beside the scans; "
            "in a bag tf, then odometry)",
        ),
        option("--topic", metavar="NAME", help="topic to read, where a bag has points of several sensors, or maps as well"),
        quiet("no table, no progress; only warnings"),
    ),
    paths=("input", "output", "json", "ply", "figure", "report", "poses"),
    description="Find the rooms, doors and storeys of one partial map, and print a table of them.",
    one_input="extract takes one scan; `topomerge merge` takes several",
)
