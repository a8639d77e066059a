"""The command line: parse, run one command, and turn every failure into one line and an exit status.

Nothing heavy is imported here: `topomerge --help` must not wait for NumPy. To add a command, write a file like the others of
this folder and enter it in `COMMANDS`; what it needs of the package it imports inside its functions.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from topomerge import __version__
from topomerge.cli.atlas import ATLAS, WATCH
from topomerge.cli.completion import COMPLETION
from topomerge.cli.console import (
    Command,
    PrintError,
    build_option,
    check_memory_limit,
    check_outputs,
    exit_on_signals,
    find_signal,
    format_failure,
    guard_printing,
    open_output_folder,
    postpone_imports,
    print_line,
    show_log,
    write_all,
)
from topomerge.cli.dataset import DATASET, FINETUNE
from topomerge.cli.diff import DIFF
from topomerge.cli.edit import EDIT
from topomerge.cli.export import EXPORT
from topomerge.cli.extract import EMBED, EXPORT_EMBEDDER, EXTRACT, INFO
from topomerge.cli.landmarks import FIND, MARK
from topomerge.cli.locate import BRIDGE, LOCATE, SERVE
from topomerge.cli.merge import MATCH, MERGE
from topomerge.cli.move import MOVE
from topomerge.cli.options import build_output_option, build_quiet_option, collect_given, parse_whole_number
from topomerge.cli.view import STUDIO, VIEW
from topomerge.errors import InputError, make_printable

OBJECTS_MADE = 30_000  # before Python looks for garbage: imports make 400,000, and none is garbage (2 % of a merge's time)
KINDS_OF_BUILDINGS = ("office", "openplan", "apartment", "hotel", "hospital", "school", "lab", "house")  # of datasets/buildings


def run_simulate(args: argparse.Namespace) -> int:
    """`topomerge simulate`: scan a building of a seed; write the clouds, the truth and a picture into a folder."""
    choices = collect_given(args, "seed", "storeys", "overlap", "rooms", "hard")
    if hasattr(args, "sensors"):
        choices["sensors"] = tuple(name.strip() for name in args.sensors.split(",") if name.strip())
    kinds = [kind.strip() for kind in args.landmarks.split(",") if kind.strip()] or ["signs"] * bool(args.signs)
    with open_output_folder(args.output) as folder:
        check_outputs([folder / "truth.json"])
        from topomerge.datasets.pairs.simulate import SIMULATED_LANDMARKS, prepare_outputs, simulate_maps

        if wrong := [kind for kind in kinds if kind not in SIMULATED_LANDMARKS]:
            raise InputError(f"--landmarks {wrong[0]}: is none that is simulated; choose from {', '.join(SIMULATED_LANDMARKS)}")
        building, sessions, frame = simulate_maps(args.building, **choices, scale=args.scale == "free")
        files = prepare_outputs(building, sessions, frame, folder, kinds, args.signs or "good")
        write_all(files)
    if not args.quiet:
        rooms = f"the building {building.name} has {len(building.rooms)} rooms"
        print_line(f"{rooms} -> {' '.join(str(path) for path, _ in files)}")
    return 0


SIMULATE = Command(
    "simulate",
    run_simulate,
    "make one or two partial maps of a building that is known exactly",
    "topomerge simulate --building office --seed 7 --sensors tls,depth --overlap 0.4 -o pair/",
    (
        build_option(
            "--building",
            required=True,
            choices=KINDS_OF_BUILDINGS,
            metavar="KIND",
            default=None,
            help=", ".join(KINDS_OF_BUILDINGS),
        ),
        build_option("--seed", type=parse_whole_number, metavar="N", help="each number makes another building (default 7)"),
        build_option("--storeys", type=parse_whole_number, metavar="N", help="1 to 8 (default 1)"),
        build_option(
            "--sensors", metavar="A,B", help="tls lidar depth mono laser2d tablet; one gives one cloud (default tls,depth)"
        ),
        build_option("--overlap", type=float, metavar="S", help="share of the rooms that both maps visit (default 0.4)"),
        build_option(
            "--rooms",
            type=parse_whole_number,
            metavar="N",
            help="rooms of each map, at most (default 15; a single cloud has all)",
        ),
        build_option("--scale", choices=("free", "known"), default="known", help="free: the scale of b is unknown"),
        build_option(
            "--hard", choices=("other-building", "other-storey", "twin-wing"), help="b shows a place that looks like that of a"
        ),
        build_option(
            "--signs",
            choices=("good", "poor"),
            default=None,
            help="how well signs and tags are read: nearly all, or half of them, misread; alone: --landmarks signs",
        ),
        build_option(
            "--landmarks", metavar="A,B", default="", help="signs tags wifi: also tables of them beside the clouds (default none)"
        ),
        build_output_option("DIR", "folder for a.ply, b.ply, truth.json, plan.png"),
        build_quiet_option(),
    ),
    paths=("output",),
    description="Make partial maps of a building from a seed: clouds in random frames, the truth about them, and a picture.",
)


COMMANDS = (
    EXTRACT,
    INFO,
    EDIT,
    MARK,
    FIND,
    EMBED,
    MATCH,
    MERGE,
    MOVE,
    DIFF,
    SIMULATE,
    COMPLETION,
    ATLAS,
    WATCH,
    LOCATE,
    SERVE,
    BRIDGE,
    EXPORT,
    EXPORT_EMBEDDER,
    VIEW,
    STUDIO,
    DATASET,
    FINETUNE,
)
EXIT_STATUSES = """\
exit status:
  0    done
  1    bad input or a wrong command line: one line on stderr says which file and why; no output is written
  2    no trustworthy merge: the reason is printed and stands in merge.json; of finetune: it did not help;
       of find: nothing was found; of diff: the maps could not be aligned;
       of locate: not here, or it can't be told
  130  interrupted
  141  what read the output went away (`| head`)
  143  terminated
Set TOPOMERGE_DEBUG=1, or give -v twice, to see the traceback of a failure."""
SIGNED_OPTIONS = (
    "--origin",
    "--up",
    "--at",
    "--to",
    "--line",
    "--add-door",
    "--delete-landmark",
    "--sill",
)  # their value may start with a dash


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, with status 1: 2 is reserved for "no trustworthy merge"."""

    def error(self, message: str) -> NoReturn:
        self.exit(1, make_printable(f"{self.prog}: {message} (see {self.prog} --help)\n"))


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of every command."""
    parser = _Parser(
        prog="topomerge",
        description="Rooms, doors and storeys out of partial indoor maps, matched and merged across sensors.",
        epilog=f"example:\n  topomerge extract scan.ply -o a.tmap --figure a.png\n\n{EXIT_STATUSES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"topomerge {__version__}")
    parser.set_defaults(run=None, paths=(), one_input="", several="", commands=COMMANDS, prog=parser.prog)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for command in COMMANDS:
        _add(commands, command)
    return parser


def _add(commands: Any, command: Command) -> None:
    parser = commands.add_parser(
        command.name,
        help=command.summary,
        description=command.description or command.summary,
        epilog=f"example:\n  {command.example}\n\n{EXIT_STATUSES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    for flags, settings in command.arguments:
        parser.add_argument(*flags, **settings)
    parser.add_argument("-v", "--verbose", action="count", default=0, help="print more; twice: also tracebacks")
    several = next((flags[0] for flags, settings in command.arguments if settings.get("nargs") in ("*", "+")), "")
    about = {"run": command.run, "paths": command.paths, "one_input": command.one_input, "several": several}
    parser.set_defaults(**about, prog=parser.prog)


def _collect_paths(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Collect the files that the user named, the input first; and the output."""
    values = {name: getattr(args, name) for name in args.paths if getattr(args, name, None)}
    output = values.pop("output", None)
    paths = [str(path) for value in values.values() for path in (value if isinstance(value, list) else [value])]
    return paths, [] if output is None else [str(output)]


def _find_empty_name(args: argparse.Namespace) -> str:
    """Return for which file an empty name was given, if for one; that is what a script's unset variable leaves, and pathlib would
    take it for the current folder."""
    values = {name: getattr(args, name, None) for name in args.paths}
    return next((name for name, value in values.items() if value == "" or (isinstance(value, list) and "" in value)), "")


def _join_signed_values(words: Sequence[str]) -> list[str]:
    """Write `--origin -33.9,151.2` as `--origin=-33.9,151.2`: argparse takes a value that starts with a dash for another
    option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in SIGNED_OPTIONS and word.startswith("-"):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _open_closed_streams() -> None:
    """Give a stream that the caller closed (`>&-`) a place to go: else what is printed fails, or goes to the other stream."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _drop_output() -> None:
    """Give the interpreter, which flushes stdout once more at exit, a place where that succeeds."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(args: argparse.Namespace) -> int:
    debug = args.verbose > 1 or os.environ.get("TOPOMERGE_DEBUG", "") not in ("", "0")
    show_log(args.verbose, debug)
    try:
        check_memory_limit()
        status = int(args.run(args))
        with guard_printing():
            sys.stdout.flush()
        return status
    except BrokenPipeError:
        _drop_output()
        return 141
    except (KeyboardInterrupt, Exception) as error:
        signalled = find_signal(error)
        if isinstance(signalled, SystemExit):
            raise signalled from None
        if signalled is not None:
            print("topomerge: interrupted", file=sys.stderr)
            return 130
        if debug:
            traceback.print_exc()
        if isinstance(error, PrintError):
            _drop_output()
            print(f"topomerge: {error}", file=sys.stderr)
            return 1
        print(make_printable(f"topomerge: {format_failure(error, *_collect_paths(args))}"), file=sys.stderr)
        return 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: the words after `topomerge`; those of the process by default.

    Returns:
        The exit status, see `EXIT_STATUSES`.
    """
    if argv is None:
        gc.set_threshold(OBJECTS_MADE)
        exit_on_signals()
        postpone_imports()
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without m² must not end the work
    parser = build_parser()
    try:
        args, unknown = parser.parse_known_args(_join_signed_values(sys.argv[1:] if argv is None else argv))
        if unknown and args.several and not any(word.startswith("-") for word in unknown):
            setattr(args, args.several, [*getattr(args, args.several), *unknown])  # files behind the options
        elif unknown:
            one_input = "" if unknown[0].startswith("-") or not args.one_input else f": {args.one_input}"
            parser.prog = args.prog  # so that the help of the command is named
            parser.error(f"unrecognized arguments: {' '.join(unknown)}{one_input}")
        if empty := _find_empty_name(args):
            parser.error(f"the name given for {empty} is empty; give the name of a file or folder")
        if args.run is None:
            parser.print_help(sys.stderr)
            return 1
        return _run(args)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1 if stop.code else 0
