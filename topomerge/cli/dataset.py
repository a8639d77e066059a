"""Commands `dataset` and `finetune`: one's own captures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from topomerge.cli.console import Command, build_option, print_line, print_text
from topomerge.cli.options import build_quiet_option, collect_given, parse_count, parse_positive, parse_share, parse_whole_number
from topomerge.errors import InputError


def dataset_command(args: argparse.Namespace) -> int:
    """`topomerge dataset`: check the pairs of a folder, find them by merging its captures, or take them from corrected maps."""
    return {"from-merges": _make_pairs, "from-edits": _collect_edits, "check": _check_pairs}[args.verb](args)


def _tell(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print_line(text, sys.stderr)


def _check_pairs(args: argparse.Namespace) -> int:
    from topomerge.datasets.pairs.own_pairs import check_folder

    for name, option in (("output", "-o"), ("scale", "--scale")):
        if getattr(args, name, None) is not None:
            raise InputError(f"{option}: is for dataset from-merges; dataset check writes nothing, leave it out")
    lines, wrong = check_folder(args.folder, args.cache, args.jobs, lambda text: _tell(args, text))
    print_text("\n".join(lines))
    if wrong:
        raise InputError(f"{args.folder}: captures and pairs that are wrong: {wrong}; correct what is marked WRONG above")
    return 0


def _make_pairs(args: argparse.Namespace) -> int:
    from topomerge.datasets.pairs.merged_truth import LEAST_BELIEVED, build_merged_truth

    if args.output is None:
        raise InputError("-o: dataset from-merges needs a folder to write its pairs.yaml into")
    if (Path(args.output) / "pairs.yaml").exists():
        raise InputError(f"{args.output}: holds a pairs.yaml; give another folder, or remove it")
    given = collect_given(args, "scale")
    built = build_merged_truth(args.folder, args.output, args.cache, args.jobs, log_line=lambda text: _tell(args, text), **given)
    print_text("\n".join(built.lines))
    if not built.pairs:
        raise InputError(f"{args.folder}: none of its pairs reaches {LEAST_BELIEVED} and is closed; nothing was written")
    if not args.quiet:
        counts = f"{built.pairs} pairs of {built.captures} captures in {built.buildings} building{'s' * (built.buildings != 1)}"
        print_line(f"{counts} -> {Path(args.output) / 'pairs.yaml'}")
    return 0


def _collect_edits(args: argparse.Namespace) -> int:
    from topomerge.datasets.pairs.edited_truth import build_edited_truth

    if args.output is None:
        raise InputError("-o: dataset from-edits needs a folder to write what is true into")
    if collect_given(args, "scale"):
        raise InputError("--scale: is for dataset from-merges; leave it out")
    built = build_edited_truth(args.folder, args.output)
    print_text("\n".join(built.lines))
    if not args.quiet:
        maps = f"{built.maps} corrected map{'s' * (built.maps != 1)}, {built.pairs} pair{'s' * (built.pairs != 1)}"
        print_line(f"{maps}, {built.edits / max(built.rooms, 1):.2f} edits a room -> {args.output}")
    return 0


CACHE = build_option("--cache", default="cache", metavar="DIR", help="of the maps; that of train.py (default cache)")
JOBS = build_option("--jobs", type=parse_count, default=1, metavar="N", help="processes that extract (default 1)")
DATASET = Command(
    "dataset",
    dataset_command,
    "check a folder of your own captures and pairs to train on, or find its pairs by merging",
    "topomerge dataset check my_scans/",
    (
        build_option(
            "verb",
            choices=("check", "from-merges", "from-edits"),
            help="check: print what the pairs have in common; from-merges: find the pairs of captures without truth; from-edits: "
            "take what is true from corrected maps",
        ),
        build_option(
            "folder",
            metavar="DIR",
            help="a folder with a pairs.yaml, or such a file; from-merges: or with captures; from-edits: with maps",
        ),
        build_option("-o", "--output", metavar="OUT", default=None, help="from-merges, from-edits: folder for the pairs.yaml"),
        build_option("--scale", choices=("fixed", "free"), help="from-merges, free: the captures may differ in scale"),
        CACHE,
        JOBS,
        build_quiet_option("print only the table"),
    ),
    paths=("folder", "output"),
    description="check: for each pair of the pairs.yaml of a folder (docs: Training, Your own pairs) the rooms of both maps, "
    "those that match, and the area in common; and what is wrong. Status 1: something is. from-merges: register each two "
    "captures, and write as a pairs.yaml what is believed from a probability of .99 on, closed in cycles. from-edits: write the "
    "rooms, doors and matches of maps that somebody corrected, and print how many edits a room it took.",
)


def finetune_command(args: argparse.Namespace) -> int:
    """`topomerge finetune`: train the embedder that ships on one's own pairs, and keep it if it helped."""
    from topomerge.training.finetuning import finetune, start_settings

    names = ("init_from", "epochs", "rate", "batch", "freeze", "replay", "replay_data", "seed")
    settings = start_settings(args.folder, args.cache, **collect_given(args, *names))
    verdict = finetune(settings, args.output, args.keep, args.jobs, lambda text: _tell(args, text))
    lines = verdict.format_lines()
    if verdict.helped or args.keep:
        lines[-1] += f" -> {Path(args.output) / 'embedder.onnx'}"
    else:
        lines[-1] += "; the embedder before is kept (--keep writes this one anyway)"
    print_text("\n".join(lines))
    return 0 if verdict.helped or args.keep else 2


FINETUNE = Command(
    "finetune",
    finetune_command,
    "train the embedder on a folder of your own pairs, and keep it if it helped",
    "topomerge finetune my_scans/ -o tuned/",
    (
        build_option("folder", metavar="DIR", help="a folder with a pairs.yaml, or such a file"),
        build_option("-o", "--output", required=True, metavar="OUT", default=None, help="folder for embedder.onnx and the run"),
        build_option("--from", dest="init_from", metavar="EMBEDDER", help="a run or an embedder (default: the one that ships)"),
        build_option("--epochs", type=parse_count, metavar="N", help="over the pairs (default 6)"),
        build_option("--rate", type=parse_positive, metavar="R", help="of learning (default 2e-4)"),
        build_option("--batch", type=parse_count, metavar="N", help="pairs a step (default 8)"),
        build_option("--freeze", choices=("geometry", "encoders"), help="what stays as it is"),
        build_option("--replay", type=parse_share, metavar="S", help="share of pairs from the set of --replay-data (default 0)"),
        build_option("--replay-data", dest="replay_data", metavar="SET", help="in the cache (default train_walks)"),
        build_option("--seed", type=parse_whole_number, metavar="N", help="of the training (default 0)"),
        build_option("--keep", action="store_true", default=False, help="write the embedder even if it did not help"),
        CACHE,
        JOBS,
        build_quiet_option("print only the verdict"),
    ),
    paths=("folder", "output"),
    description="Extract and split the captures of a folder (docs: Training, Fine-tuning), train from the embedder that ships, "
    "and compare both on the pairs left out. OUT is taken by --descriptor and load_embedder. Status 2: it did not help, nothing "
    "is kept.",
)
