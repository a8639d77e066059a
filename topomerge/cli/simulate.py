"""The command `simulate`: clouds of a building that is known exactly, with the truth about them."""

from __future__ import annotations

import argparse

from topomerge.cli.command import Command, option
from topomerge.cli.console import check_outputs, output_folder, say_line, write_all
from topomerge.cli.options import count, given, output, quiet

KINDS_OF_BUILDINGS = ("office", "openplan", "apartment", "hotel", "hospital", "school", "lab", "house")  # of datasets/buildings


def simulate_command(args: argparse.Namespace) -> int:
    """`topomerge simulate`: scan a building of a seed; write the clouds, the truth and a picture into a folder."""
    choices = given(args, "seed", "storeys", "overlap", "rooms", "hard")
    if hasattr(args, "sensors"):
        choices["sensors"] = tuple(name.strip() for name in args.sensors.split(",") if name.strip())
    with output_folder(args.output) as folder:
        check_outputs([folder / "truth.json"])
        from topomerge.datasets.pairs.simulate import outputs, simulate

        building, sessions, frame = simulate(args.building, **choices, scale=args.scale == "free")
        files = outputs(building, sessions, frame, folder)
        write_all(files)
    if not args.quiet:
        rooms = f"the building {building.name} has {len(building.rooms)} rooms"
        say_line(f"{rooms} -> {' '.join(str(path) for path, _ in files)}")
    return 0


SIMULATE = Command(
    "simulate",
    simulate_command,
    "make one or two partial maps of a building that is known exactly",
    "topomerge simulate --building office --seed 7 --sensors tls,depth --overlap 0.4 -o pair/",
    (
        option(
            "--building",
            required=True,
            choices=KINDS_OF_BUILDINGS,
            metavar="KIND",
            default=None,
            help=", ".join(KINDS_OF_BUILDINGS),
        ),
        option("--seed", type=count, metavar="N", help="each number makes another building (default 7)"),
        option("--storeys", type=count, metavar="N", help="1 to 8 (default 1)"),
        option("--sensors", metavar="A,B", help="tls lidar depth mono laser2d tablet; one gives one cloud (default tls,depth)"),
        option("--overlap", type=float, metavar="S", help="share of the rooms that both maps visit (default 0.4)"),
        option("--rooms", type=count, metavar="N", help="rooms of each map, at most (default 15; a single cloud has all)"),
        option("--scale", choices=("free", "known"), default="known", help="free: the scale of b is unknown"),
        option(
            "--hard", choices=("other-building", "other-storey", "twin-wing"), help="b shows a place that looks like that of a"
        ),
        output("DIR", "folder for a.ply, b.ply, truth.json, plan.png"),
        quiet(),
    ),
    paths=("output",),
    description="Make partial maps of a building from a seed: clouds in random frames, the truth about them, and a picture.",
)
