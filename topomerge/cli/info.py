"""The command `info`: what a map holds."""

from __future__ import annotations

import argparse

from topomerge.cli.command import Command, option
from topomerge.cli.console import say, warn, write_out
from topomerge.cli.options import json_option


def info_command(args: argparse.Namespace) -> int:
    """`topomerge info`: print the rooms, storeys, doors and times of a map, as tables or as JSON."""
    from topomerge.io.listing import json_text, map_to_json, map_to_text
    from topomerge.io.maps import load_map

    topomap = load_map(args.input)
    warn(topomap.warnings)
    if args.json:
        write_out(json_text(map_to_json(topomap)))
    else:
        say(map_to_text(topomap))
    return 0


INFO = Command(
    "info",
    info_command,
    "print what a map holds",
    "topomerge info a.tmap",
    (option("input", metavar="A.tmap", help="a map that `topomerge extract` wrote"), json_option()),
    paths=("input",),
    description="Print the rooms, storeys, doors and times of a map.",
)
