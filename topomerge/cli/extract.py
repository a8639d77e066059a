"""The commands of one map: extract, info, embed, and the export of an embedder."""

from __future__ import annotations

import argparse
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import topomerge
from topomerge.cli.console import (
    PAGE_SUFFIXES,
    Command,
    ProgressBars,
    build_option,
    check_outputs,
    check_suffix,
    open_output_folder,
    print_line,
    print_text,
    warn,
    write_all,
    write_out,
)
from topomerge.cli.inputs import load_input_map, load_stored_map
from topomerge.cli.options import (
    CLOUD_OPTIONS,
    CONTEXT_STEPS,
    DESCRIPTOR,
    NO_EDITS,
    READING_NAMES,
    READING_OPTIONS,
    build_json_option,
    build_output_option,
    build_quiet_option,
    check_cloud_options,
    check_descriptor,
    collect_given,
    parse_positive,
)
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.types import TopometricMap

OTHER_OUTPUTS = "--json, --ply, --figure, --report"
FIGURE_FORMATS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


def run_extract(args: argparse.Namespace) -> int:
    """`topomerge extract`: find the rooms, doors and storeys of a cloud; write the map and whatever else was asked for."""
    outputs = _list_outputs(args)
    check_outputs([path for path, _ in outputs], [args.input, *collect_given(args, "poses").values()])
    if Path(args.output).suffix.lower() != ".tmap":  # no other command would take it for a map
        raise InputError(f"{args.output}: -o names the map; end its name with .tmap (for other files there are {OTHER_OUTPUTS})")
    with ProgressBars(enabled=not args.quiet) as bars:
        from topomerge.io.points import read_chunks

        chunks = read_chunks(args.input, **collect_given(args, *READING_NAMES), progress=bars.start_task("read"))
        from topomerge.extraction.extract import extract  # after the file was opened: what is wrong with it is told at once

        choices = collect_given(args, "voxel_size", "preset")
        extracted = extract(chunks, **choices, name=args.input, progress=bars.start_task("extract"))
        topomap = _replay_journal(extracted, args)
        maps = [extracted, *[topomap] * (len(outputs) - 1)]  # the .tmap is the extraction: its journal stays beside it
        write_all([(path, partial(getattr(topomerge, writer), map)) for (path, writer), map in zip(outputs, maps, strict=True)])
    warn(topomap.warnings)
    if not args.quiet:
        from topomerge.io.listing import format_map

        print_text(format_map(topomap))
    return 0


def _replay_journal(extracted: TopometricMap, args: argparse.Namespace) -> TopometricMap:
    """Apply to the map the corrections of an earlier extraction to the same file."""
    from topomerge.edits.apply import correct_map
    from topomerge.edits.journal import find_journal, read_journal

    return correct_map(extracted, read_journal(find_journal(args.output)), getattr(args, "edits", None))


def _list_outputs(args: argparse.Namespace) -> list[tuple[str, str]]:
    """List where to write, and the name of topomerge's function (map, path) that writes it."""
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
    run_extract,
    "find the rooms, doors and storeys of one partial map",
    "topomerge extract scan.ply -o a.tmap --json a.json --ply a_rooms.ply --figure a.png",
    (
        build_option(
            "input", metavar="SCAN", help="point cloud, folder of scans, ROS bag, mesh, building model, OctoMap or 2D map"
        ),
        build_output_option("A.tmap", "map to write"),
        build_option("--json", metavar="A.json", default=None, help="also write rooms, doors and storeys as JSON"),
        build_option("--ply", metavar="A.ply", default=None, help="also write the occupied cells with their room as PLY"),
        build_option("--figure", metavar="A.png", default=None, help="also draw the plan of each storey"),
        build_option("--report", metavar="A.html", default=None, help="also write plans, tables and a 3D view as one web page"),
        build_option("--voxel-size", type=parse_positive, metavar="E", help="edge length of a cell, m (default 0.1)"),
        build_option("--preset", choices=("default", "thesis"), help="default, or the parameters of the thesis"),
        *READING_OPTIONS,
        NO_EDITS,
        build_quiet_option("no table, no progress; only warnings"),
    ),
    paths=("input", "output", "json", "ply", "figure", "report", "poses"),
    description="Find the rooms, doors and storeys of one partial map, and print a table of them.",
    one_input="extract takes one scan; `topomerge merge` takes several",
)


def run_info(args: argparse.Namespace) -> int:
    """`topomerge info`: print the rooms, storeys, doors and times of a map, as tables or as JSON."""
    topomap = load_stored_map(args.input, args)
    from topomerge.io.listing import convert_map_to_json, format_json, format_map

    warn(topomap.warnings)
    if args.json:
        write_out(format_json(convert_map_to_json(topomap)))
    else:
        print_text(format_map(topomap))
    return 0


INFO = Command(
    "info",
    run_info,
    "print what a map holds",
    "topomerge info a.tmap",
    (build_option("input", metavar="A.tmap", help="a map that `topomerge extract` wrote"), NO_EDITS, build_json_option()),
    paths=("input",),
    description="Print the rooms, storeys, doors and times of a map.",
)


def run_embed(args: argparse.Namespace) -> int:
    """`topomerge embed`: describe each room of a map; write a NumPy array (rooms, numbers), or (rooms, 4, numbers)."""
    check_outputs([args.output], [args.input])
    check_suffix("-o", args.output, (".npy",))
    check_cloud_options([args.input], args)
    check_descriptor(args)
    topomap = load_input_map(args.input, args)
    from topomerge.embedding.learned import build_embedder
    from topomerge.embedding.quarter_turns import get_rows

    describe = build_embedder(args.descriptor, args.k)
    rows = get_rows(describe(topomap))
    import numpy as np

    def save(path: Path) -> None:
        with path.open("wb") as file:  # np.save would add .npy to a name in capitals
            np.save(file, rows, allow_pickle=False)

    write_all([(args.output, save)])
    if not args.quiet:
        rooms = f"{len(rows)} room{'s' if len(rows) != 1 else ''}"
        print_line(f"{rooms}, {' x '.join(map(str, rows.shape[1:]))} numbers each -> {args.output}")
    return 0


EMBED = Command(
    "embed",
    run_embed,
    "describe each room of a map by numbers",
    "topomerge embed a.tmap --descriptor shapedna --k 1 -o a.npy",
    (
        build_option("input", metavar="A", help="a .tmap, or a cloud, from which a map is extracted first"),
        build_output_option("A.npy", "NumPy array with a row for each room, or one for each of its quarter turns"),
        DESCRIPTOR,
        CONTEXT_STEPS,
        NO_EDITS,
        *CLOUD_OPTIONS,
        build_quiet_option(),
    ),
    paths=("input", "output"),
    description="Describe each room of a map by numbers: rooms that look alike get rows that are close.",
)


def run_export_embedder(args: argparse.Namespace) -> int:
    """`topomerge export-embedder`: the best embedder of a run, or what an earlier version wrote, as ONNX with its card."""
    from topomerge.embedding.learned import EMBEDDER_FILE, find_state, read_embedder_card
    from topomerge.networks.network import card_of

    state = find_state(args.run_folder)
    if state is None:
        card = read_embedder_card(args.run_folder)
        with open_output_folder(args.output) as folder:
            for file in (card.path, card_of(card.path)):
                shutil.copyfile(file, folder / file.name.replace(card.path.stem, Path(EMBEDDER_FILE).stem, 1))
    else:
        try:
            from topomerge.models.export import export_embedder
            from topomerge.models.weights import read_state
        except ModuleNotFoundError as error:
            raise InputError(f"weights of torch need {error.name}: pip install topomerge[learn]") from error
        network, about = read_state(state)
        with open_output_folder(args.output) as folder:
            export_embedder(network, folder, about)
    if not args.quiet:
        card = read_embedder_card(folder)
        print_line(f"{card.path.stat().st_size} bytes, {card.network.size} numbers a room -> {folder}")
    return 0


EXPORT_EMBEDDER = Command(
    "export-embedder",
    run_export_embedder,
    "write the best embedder of a training run, to be used elsewhere",
    "topomerge export-embedder runs/x -o embedder/",
    (
        build_option("run_folder", metavar="RUN", help="folder of a run of train.py, or its best/ or last/"),
        build_output_option("DIR", "folder for the files"),
        build_quiet_option(),
    ),
    paths=("run_folder", "output"),
    description="Write the best embedder of a run as embedder.onnx and embedder.card.json; topomerge.load_embedder reads them.",
)
