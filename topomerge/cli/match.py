"""The command `match`: which rooms of two maps are the same."""

from __future__ import annotations

import argparse

from topomerge.cli.command import Command, option
from topomerge.cli.console import PAGE_SUFFIXES, check_inputs, check_outputs, check_suffix, warn, write_out
from topomerge.cli.options import (
    CLOUD_OPTIONS,
    CONTEXT_STEPS,
    DESCRIPTOR,
    check_cloud_options,
    check_descriptor,
    json_option,
    map_from,
)
from topomerge.errors import InputError


def match_command(args: argparse.Namespace) -> int:
    """`topomerge match`: print the matches of rooms with their probabilities, as tables or as JSON."""
    from topomerge.fusion.match_belief import believed_matches
    from topomerge.io.listing import json_text
    from topomerge.matching.listing import matching_to_json, matching_to_text
    from topomerge.matching.match import check, match

    check_inputs([args.a, args.b])
    check_cloud_options([args.a, args.b], args)
    if args.method != "thesis":  # which has a descriptor and a context of its own
        check_descriptor(args)
    if args.method == "attention" and args.descriptor != "learned":
        raise InputError("--method attention needs the embedder that ships; take --method consistent")
    if args.report:
        check_outputs([args.report], [args.a, args.b])
        check_suffix("--report", args.report, PAGE_SUFFIXES)
    a, b = map_from(args.a, args), map_from(args.b, args)
    check(a, b)
    alone = [path for path, topomap in ((args.a, a), (args.b, b)) if len(topomap.rooms) == 1]
    warn(f"{path}: has one room: only its shape and doors can be compared" for path in alone)
    matching = match(a, b, args.descriptor, args.method, k=args.k, scale_free=args.scale_of_b == "free")
    matching = believed_matches(matching, a, b, args.method)
    if args.report:
        from topomerge.viz.match_report import save_match_report

        save_match_report(matching, a, b, args.report)
    write_out(json_text(matching_to_json(matching, a, b)) if args.json else matching_to_text(matching, a, b) + "\n")
    return 0


MATCH = Command(
    "match",
    match_command,
    "find the rooms that two maps have in common",
    "topomerge match a.tmap b.tmap --json",
    (
        option("a", metavar="A", help="a .tmap, or a cloud, from which a map is extracted first"),
        option("b", metavar="B", help="the other map, likewise"),
        json_option(),
        option(
            "--report",
            metavar="M.html",
            default=None,
            help="also write plans and what is around each match as a web page",
        ),
        option(
            "--method",
            choices=("consistent", "attention", "growing", "assignment", "thesis"),
            default="consistent",
            help="consistent (default): sets of matches that one transform explains; attention: a network that sees both maps; "
            "the others are simpler",
        ),
        option("--scale", dest="scale_of_b", choices=("free", "known"), default="known", help="free: the scale of b is unknown"),
        DESCRIPTOR,
        CONTEXT_STEPS,
        *CLOUD_OPTIONS,
    ),
    paths=("a", "b", "report"),
    description="Print which rooms of two maps are the same, with probabilities, and the transforms that would make them so.",
)
