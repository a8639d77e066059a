"""The command `dataset`: what a folder of one's own captures and pairs is good for."""

from __future__ import annotations

import argparse
import sys

from topomerge.cli.command import Command, option
from topomerge.cli.console import say, say_line
from topomerge.cli.options import at_least_one, quiet
from topomerge.errors import InputError


def dataset_command(args: argparse.Namespace) -> int:
    """`topomerge dataset check`: print what the pairs of a folder have in common, and what is wrong with them."""
    from topomerge.datasets.pairs.own_pairs import check_folder

    def tell(text: str) -> None:
        if not args.quiet:
            say_line(text, sys.stderr)

    lines, wrong = check_folder(args.folder, args.cache, args.jobs, tell)
    say("\n".join(lines))
    if wrong:
        raise InputError(f"{args.folder}: captures and pairs that are wrong: {wrong}; correct what is marked WRONG above")
    return 0


DATASET = Command(
    "dataset",
    dataset_command,
    "check a folder of your own captures and pairs, to train and to evaluate on",
    "topomerge dataset check my_scans/",
    (
        option("verb", choices=("check",), help="extract the captures, and print what the pairs have in common"),
        option("folder", metavar="DIR", help="a folder with a pairs.yaml, or such a file"),
        option("--cache", default="cache", metavar="DIR", help="of the maps; that of train.py (default cache)"),
        option("--jobs", type=at_least_one, default=1, metavar="N", help="processes (default 1)"),
        quiet("print only the table"),
    ),
    paths=("folder",),
    description="Check the pairs.yaml of a folder of captures (docs: Training, Your own pairs): for each pair the rooms of both "
    "maps, those that match, and the area in common; and what is wrong. Status 1: something is.",
)
