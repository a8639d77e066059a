"""The command `export-embedder`: what training made, for those who only use it."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from topomerge.cli.command import Command, option
from topomerge.cli.console import output_folder, say_line
from topomerge.cli.options import output, quiet
from topomerge.embedding.weights import EMBEDDER_FILE, find_state, read_embedder_card
from topomerge.errors import InputError
from topomerge.networks.network import card_of


def export_embedder_command(args: argparse.Namespace) -> int:
    """`topomerge export-embedder`: the best embedder of a run, or what an earlier version wrote, as ONNX with its card."""
    state = find_state(args.run_folder)
    if state is None:
        card = read_embedder_card(args.run_folder)
        with output_folder(args.output) as folder:
            for file in (card.path, card_of(card.path)):
                shutil.copyfile(file, folder / file.name.replace(card.path.stem, Path(EMBEDDER_FILE).stem, 1))
    else:
        try:
            from topomerge.models.export import export_embedder
            from topomerge.models.weights import read_state
        except ModuleNotFoundError as error:
            raise InputError(f"weights of torch need {error.name}: pip install topomerge[learn]") from error
        network, about = read_state(state)
        with output_folder(args.output) as folder:
            export_embedder(network, folder, about)
    if not args.quiet:
        card = read_embedder_card(folder)
        say_line(f"{card.path.stat().st_size} bytes, {card.network.size} numbers a room -> {folder}")
    return 0


EXPORT_EMBEDDER = Command(
    "export-embedder",
    export_embedder_command,
    "write the best embedder of a training run, to be used elsewhere",
    "topomerge export-embedder runs/x -o embedder/",
    (
        option("run_folder", metavar="RUN", help="folder of a run of train.py, or its best/ or last/"),
        output("DIR", "folder for the files"),
        quiet(),
    ),
    paths=("run_folder", "output"),
    description="Write the best embedder of a run as embedder.onnx and embedder.card.json; topomerge.load_embedder reads them.",
)
