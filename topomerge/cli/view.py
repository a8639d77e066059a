"""The command `view`: the report of a map, a merge or an atlas in the browser."""

from __future__ import annotations

import argparse
import sys
import tempfile
from functools import partial
from pathlib import Path

from topomerge.cli.command import Command, option
from topomerge.cli.console import PAGE_SUFFIXES, check_inputs, check_outputs, check_suffix, printing, say, write_all
from topomerge.cli.options import count
from topomerge.errors import InputError


def view_command(args: argparse.Namespace) -> int:
    """`topomerge view`: a report in the browser."""
    if args.serve is None:
        page = _page(args)
        if args.open:
            _show(page.resolve().as_uri(), str(page))
        else:
            say(str(page))
        return 0
    from topomerge.viz.serve import serve

    with tempfile.TemporaryDirectory(prefix="topomerge-") as scratch:
        serve(_page(args, scratch), args.serve, _show if args.open else _print_address)
    return 0


def _print_address(address: str) -> None:
    with printing():
        print(address, flush=True)


def _page(args: argparse.Namespace, scratch: str | None = None) -> Path:
    """The report to show; that of a map is made first."""
    path = Path(args.input)
    if path.is_dir():
        page = path / "report.html"
        if page.is_file() and args.output is None:
            return page
        if not (path / "map.tmap").is_file():
            raise InputError(f"{path}: holds no report.html; give the folder of a merge or an atlas, a .tmap or an .html")
        path = path / "map.tmap"
    check_inputs([str(path)])
    if path.suffix.lower() in PAGE_SUFFIXES:
        if args.output is not None:
            raise InputError(f"{args.output}: -o is for the report of a .tmap, and {path} is a page already; leave it out")
        return path
    if path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: can't be shown; give a .tmap (of `topomerge extract`), the folder of a merge or an .html")
    from topomerge.io.maps import load_map
    from topomerge.viz.report import save_report

    topomap = load_map(path)
    if args.output is not None:
        place = Path(args.output)
    else:  # a browser reads it after this program has ended: only what is served is deleted
        place = Path(scratch or tempfile.mkdtemp(prefix="topomerge-")) / f"{path.stem}.html"
    check_outputs([place], [path])
    check_suffix("-o", str(place), PAGE_SUFFIXES)
    write_all([(place, partial(save_report, topomap))])
    return place


def _show(address: str, name: str = "") -> None:
    """Open an address in the browser, and say where it is for those who have none."""
    import webbrowser

    _print_address(name or address)
    try:
        opened = webbrowser.open(address)
    except (webbrowser.Error, OSError):
        opened = False
    if not opened:
        print("topomerge: no browser could be opened here; open this in one", file=sys.stderr)


def _port(text: str) -> int:
    number = count(text)
    if number > 65535:
        raise argparse.ArgumentTypeError(f"must be a port from 0 to 65535, not {text}")
    return number


VIEW = Command(
    "view",
    view_command,
    "show a report in the browser",
    "topomerge view merged/",
    (
        option("input", metavar="PATH", help="folder of a merge or an atlas, a .tmap (a report is made of it) or an .html"),
        option("-o", "--output", metavar="A.html", default=None, help="keep the report of a .tmap here"),
        option("--no-open", dest="open", action="store_false", default=True, help="only print where the report is"),
        option(
            "--serve",
            nargs="?",
            const=0,
            default=None,
            type=_port,
            metavar="PORT",
            help="serve it on this machine until Ctrl-C (default: any free port)",
        ),
    ),
    paths=("input", "output"),
    description="Show the report of a merge, an atlas or a map in the browser.",
)
