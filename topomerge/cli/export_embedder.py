"""The command `export-embedder`: what training made, for those who only use it."""

from __future__ import annotations

import argparse

from topomerge.cli.command import Command, option
from topomerge.cli.console import output_folder, say_line
from topomerge.cli.options import output, quiet
from topomerge.errors import InputError


def export_embedder_command(args: argparse.Namespace) -> int:
    """`topomerge export-embedder`: the best embedder of a run, as safetensors and JSON, and as ONNX."""
    try:
        from topomerge.models.weights import read_embedder, save_embedder
    except ModuleNotFoundError as error:
        raise InputError(f"a learned embedder needs {error.name}: pip install topomerge[learn]") from error
    network, about = read_embedder(args.run_folder)
    with output_folder(args.output) as folder:
        save_embedder(network, folder, about)
        if args.onnx:
            from topomerge.models.export import export_embedder

            export_embedder(network, folder / "embedder.onnx")
    if not args.quiet:
        count = sum(p.numel() for p in network.parameters())
        say_line(f"{count} weights, {network.network.size} numbers a room -> {folder}")
    return 0


EXPORT_EMBEDDER = Command(
    "export-embedder",
    export_embedder_command,
    "write the best embedder of a training run, to be used elsewhere",
    "topomerge export-embedder runs/x -o embedder/",
    (
        option("run_folder", metavar="RUN", help="folder of a run of train.py, or its best/ or last/"),
        output("DIR", "folder for the files"),
        option("--onnx", action="store_true", default=False, help="also write embedder.onnx, for any number of rooms and doors"),
        quiet(),
    ),
    paths=("run_folder", "output"),
    description="Write the best embedder of a run as embedder.safetensors and embedder.json; topomerge.load_embedder reads them.",
)
