"""The command line: parse, run one command, and turn every failure into one line and an exit status.

Nothing heavy is imported here: `topomerge --help` must not wait for NumPy. To add a command, write a file like the others of
this folder and enter it in `COMMANDS`; what it needs of the package it imports inside its functions.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

from topomerge import __version__
from topomerge.cli.atlas import ATLAS
from topomerge.cli.command import Command
from topomerge.cli.completion import COMPLETION
from topomerge.cli.console import PrintError, check_memory_limit, failure_line, printing, signal_behind
from topomerge.cli.dataset import DATASET
from topomerge.cli.embed import EMBED
from topomerge.cli.export import EXPORT
from topomerge.cli.export_embedder import EXPORT_EMBEDDER
from topomerge.cli.extract import EXTRACT
from topomerge.cli.info import INFO
from topomerge.cli.match import MATCH
from topomerge.cli.merge import MERGE
from topomerge.cli.signals import leave_on_signals
from topomerge.cli.simulate import SIMULATE
from topomerge.cli.view import VIEW
from topomerge.cli.watch import WATCH
from topomerge.errors import printable

COMMANDS = (EXTRACT, INFO, EMBED, MATCH, MERGE, SIMULATE, COMPLETION, ATLAS, WATCH, EXPORT, EXPORT_EMBEDDER, VIEW, DATASET)

EXIT_STATUSES = """\
exit status:
  0    done
  1    bad input or a wrong command line: one line on stderr says which file and why; no output is written
  2    no trustworthy merge: the reason is printed and stands in merge.json
  130  interrupted
  141  what read the output went away (`| head`)
  143  terminated
Set TOPOMERGE_DEBUG=1, or give -v twice, to see the traceback of a failure."""

SIGNED_OPTIONS = ("--origin", "--up")  # their value may start with a dash


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, with status 1: 2 is reserved for "no trustworthy merge"."""

    def error(self, message: str) -> NoReturn:
        self.exit(1, printable(f"{self.prog}: {message} (see {self.prog} --help)\n"))


def build_parser() -> argparse.ArgumentParser:
    """The parser of every command."""
    parser = _Parser(
        prog="topomerge",
        description="Rooms, doors and storeys out of partial indoor maps, matched and merged across sensors.",
        epilog=f"example:\n  topomerge extract scan.ply -o a.tmap --figure a.png\n\n{EXIT_STATUSES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"topomerge {__version__}")
    parser.set_defaults(run=None, paths=(), one_input="", commands=COMMANDS)
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
    parser.set_defaults(run=command.run, paths=command.paths, one_input=command.one_input)


def _named_paths(args: argparse.Namespace) -> tuple[list[str], list[str]]:
    """The files that the user named, the input first; and the output."""
    values = {name: getattr(args, name) for name in args.paths if getattr(args, name, None)}
    output = values.pop("output", None)
    paths = [str(path) for value in values.values() for path in (value if isinstance(value, list) else [value])]
    return paths, [] if output is None else [str(output)]


def _empty_name(args: argparse.Namespace) -> str:
    """For which file an empty name was given, if for one; that is what a script's unset variable leaves, and pathlib would take
    it for the current folder."""
    values = {name: getattr(args, name, None) for name in args.paths}
    return next((name for name, value in values.items() if value == "" or (isinstance(value, list) and "" in value)), "")


def _joined(words: Sequence[str]) -> list[str]:
    """`--origin -33.9,151.2` as `--origin=-33.9,151.2`: argparse takes a value that starts with a dash for another option."""
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
    """The interpreter flushes stdout once more at exit: give it a place where that succeeds."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _show_log(verbose: int, debug: bool) -> None:
    """Show what this package logs; what libraries log or warn of, in words of theirs, only to those who look for a fault."""
    if not logging.getLogger().handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("topomerge: %(message)s"))
        if not debug:
            handler.addFilter(logging.Filter("topomerge"))
        logging.getLogger().addHandler(handler)
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.getLogger("topomerge").setLevel(level)
    if not debug and not sys.warnoptions:
        warnings.simplefilter("ignore")


def _run(args: argparse.Namespace) -> int:
    debug = args.verbose > 1 or os.environ.get("TOPOMERGE_DEBUG", "") not in ("", "0")
    _show_log(args.verbose, debug)
    try:
        check_memory_limit()
        status = int(args.run(args))
        with printing():
            sys.stdout.flush()
        return status
    except BrokenPipeError:
        _drop_output()
        return 141
    except (KeyboardInterrupt, Exception) as error:
        signalled = signal_behind(error)
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
        print(printable(f"topomerge: {failure_line(error, *_named_paths(args))}"), file=sys.stderr)
        return 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: the words after `topomerge`; those of the process by default.

    Returns:
        The exit status, see `EXIT_STATUSES`.
    """
    if argv is None:
        leave_on_signals()
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without m² must not end the work
    parser = build_parser()
    try:
        args, unknown = parser.parse_known_args(_joined(sys.argv[1:] if argv is None else argv))
        if unknown:
            one_input = "" if unknown[0].startswith("-") or not args.one_input else f": {args.one_input}"
            parser.error(f"unrecognized arguments: {' '.join(unknown)}{one_input}")
        if empty := _empty_name(args):
            parser.error(f"the name given for {empty} is empty; give the name of a file or folder")
        if args.run is None:
            parser.print_help(sys.stderr)
            return 1
        return _run(args)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1 if stop.code else 0
