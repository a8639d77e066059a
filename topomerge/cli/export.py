"""The command `export`: a map in the formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from topomerge.cli.console import (
    Command,
    build_option,
    check_inputs,
    check_outputs,
    check_suffix,
    open_output_folder,
    print_line,
    warn,
    write_all,
)
from topomerge.cli.inputs import load_stored_map
from topomerge.cli.options import NO_EDITS, build_quiet_option, collect_given, parse_share, parse_whole_number
from topomerge.errors import InputError


def run_export(args: argparse.Namespace) -> int:
    """`topomerge export`: a map in the formats of other tools."""
    from topomerge.io.exports import FORMATS, parse_formats, prepare_outputs
    from topomerge.types import filter_confident

    names = parse_formats(args.to)
    options = _collect_export_options(args, names)
    source = _find_map_file(args.input)
    path, folder = _choose_output_path(args, names, source)
    if not folder:
        check_suffix(f"--to {args.to}", args.output, FORMATS[names[0]].suffixes)
    topomap = load_stored_map(source, args)
    warn(topomap.warnings)
    topomap = filter_confident(topomap, getattr(args, "min_confidence", 0.0))
    with open_output_folder(path.parent):
        files = [file for name in names for file in prepare_outputs(topomap, name, path, folder, **options)]
        check_outputs([file for file, _ in files], [source])
        write_all(files)
    if not args.quiet:
        written = " ".join(str(file) for file, _ in files)
        rooms = f"{len(topomap.rooms)} room{'s' if len(topomap.rooms) != 1 else ''}"
        print_line(f"{rooms}, {len(topomap.edges)} doors and stairs -> {written}")
    return 0


def _collect_export_options(args: argparse.Namespace, names: list[str]) -> dict[str, Any]:
    """Collect the options that only some formats know.

    Raises:
        InputError: one was given that none of the formats knows.
    """
    from topomerge.io.exports import FORMATS

    options = collect_given(args, "origin", "storey")
    frames = [name for text in collect_given(args, "frames").values() for name in text.split(",")]
    for key in options:
        able = [name for name, form in FORMATS.items() if key in form.options]
        if not set(able) & set(names):
            raise InputError(f"--{key}: means nothing for {', '.join(names)}; it is for {' and '.join(able)}")
    if set(names) <= {"tf2", "g2o"} and collect_given(args, "min_confidence"):
        raise InputError(f"--min-confidence: means nothing for {names[0]}, which holds no rooms; leave it out")
    if "origin" in options:
        from topomerge.io.exports.geojson import parse_origin

        options["origin"] = parse_origin(options["origin"])
    place = Path(args.input)
    if "g2o" in names:
        from topomerge.fusion.frames import build_map_graph, read_file_frames

        options["graph"] = build_map_graph(read_file_frames(place if place.is_dir() else place.parent))
    if "tf2" in names:
        from topomerge.io.exports.placements import read_frame_poses

        options["transforms"] = read_frame_poses(place if place.is_dir() else place.parent, frames)
    elif frames:
        raise InputError(f"--frames: means nothing for {', '.join(names)}; it is for tf2")
    return options


def _find_map_file(named: str) -> Path:
    """Return the .tmap that a user means, who may have named the folder of a merge or of an atlas."""
    path = Path(named)
    if path.is_dir():
        joined = [path / "map.tmap"] if (path / "map.tmap").is_file() else sorted(path.glob("map_*.tmap"))
        if len(joined) == 1:
            return joined[0]
        if joined:
            raise InputError(f"{path}: holds {len(joined)} joined maps; give one of {', '.join(str(p) for p in joined)}")
        refused = " (its merge was refused: merge again with --force)" if (path / "merge.json").is_file() else ""
        raise InputError(f"{path}: holds no joined map{refused}; give a .tmap, or the folder of a merge or an atlas")
    check_inputs([named])
    if path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: is no map; make one with `topomerge extract {path} -o {path.stem}.tmap`")
    return path


def _choose_output_path(args: argparse.Namespace, names: list[str], source: Path) -> tuple[Path, bool]:
    """Return where to write: a file, or (True) a folder with the stem of the names in it."""
    from topomerge.io.exports import FORMATS

    several = len(names) > 1 or FORMATS[names[0]].folder
    stem = source.parent.resolve().name if Path(args.input).is_dir() else source.stem
    if args.output is None:
        return source.parent / stem, True
    path = Path(args.output)
    if several and path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; {args.to} writes several, give the name of a folder")
    if several or path.is_dir() or args.output.endswith(("/", "\\")):
        return path / stem, True
    return path, False


EXPORT = Command(
    "export",
    run_export,
    "write a map for other tools: GIS, BIM, robots, graphs",
    "topomerge export merged/ --to geojson,indoorgml,ros -o exported/",
    (
        build_option("input", metavar="MAP", help="a .tmap, or the folder of a merge or an atlas"),
        build_option(
            "--to",
            required=True,
            metavar="FORMAT[,FORMAT]",
            default=None,
            help="graphml, geojson, indoorgml, dsg (Spark-DSG), ros (grids, keepout, Nav2 routes), rmf, "
            "rviz, tf2, g2o, ply, las, ifc",
        ),
        build_option(
            "-o",
            "--output",
            metavar="OUT",
            default=None,
            help="file, or folder for several formats, ros and rmf (default: beside the map, named after it)",
        ),
        build_option(
            "--origin",
            metavar="LAT,LON[,HEADING]",
            help="geojson: where (0, 0) of the map lies, and how far its y axis is turned clockwise from north, degrees",
        ),
        build_option(
            "--frames", metavar="NAME,NAME", help="tf2: names of the maps' frames, in their order (default: their files')"
        ),
        build_option("--storey", type=parse_whole_number, metavar="N", help="geojson, ros, rmf: only this storey"),
        build_option(
            "--min-confidence",
            type=parse_share,
            metavar="P",
            help="leave out rooms, doors, stairs and windows that are less likely than P, 0 to 1 (default 0: none)",
        ),
        NO_EDITS,
        build_quiet_option(),
    ),
    paths=("input", "output"),
    description="Write a map in the formats of other tools: rooms as polygons, doors, storeys, their graph, grids to drive by.",
)
