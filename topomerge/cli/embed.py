"""The command `embed`: a row of numbers for each room."""

from __future__ import annotations

import argparse
from pathlib import Path

from topomerge.cli.command import Command, option
from topomerge.cli.console import check_outputs, check_suffix, say_line, write_all
from topomerge.cli.options import (
    CLOUD_OPTIONS,
    CONTEXT_STEPS,
    DESCRIPTOR,
    check_cloud_options,
    check_descriptor,
    map_from,
    output,
    quiet,
)


def embed_command(args: argparse.Namespace) -> int:
    """`topomerge embed`: describe each room of a map; write a NumPy array (rooms, numbers), or (rooms, 4, numbers)."""
    check_outputs([args.output], [args.input])
    check_suffix("-o", args.output, (".npy",))
    check_cloud_options([args.input], args)
    check_descriptor(args)
    from topomerge.embedding.embedders import embedder
    from topomerge.embedding.turns import numbers

    describe = embedder(args.descriptor, args.k)
    rows = numbers(describe(map_from(args.input, args)))
    import numpy as np

    def save(path: Path) -> None:
        with path.open("wb") as file:  # np.save would add .npy to a name in capitals
            np.save(file, rows, allow_pickle=False)

    write_all([(args.output, save)])
    if not args.quiet:
        rooms = f"{len(rows)} room{'s' if len(rows) != 1 else ''}"
        say_line(f"{rooms}, {' x '.join(map(str, rows.shape[1:]))} numbers each -> {args.output}")
    return 0


EMBED = Command(
    "embed",
    embed_command,
    "describe each room of a map by numbers",
    "topomerge embed a.tmap --descriptor shapedna --k 1 -o a.npy",
    (
        option("input", metavar="A", help="a .tmap, or a cloud, from which a map is extracted first"),
        output("A.npy", "NumPy array with a row for each room, or one for each of its quarter turns"),
        DESCRIPTOR,
        CONTEXT_STEPS,
        *CLOUD_OPTIONS,
        quiet(),
    ),
    paths=("input", "output"),
    description="Describe each room of a map by numbers: rooms that look alike get rows that are close.",
)
