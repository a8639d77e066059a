"""The commands that open a page in the browser: view and studio."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from functools import partial
from pathlib import Path

from topomerge.cli.console import (
    PAGE_SUFFIXES,
    Command,
    build_option,
    check_inputs,
    check_outputs,
    check_suffix,
    find_signal,
    guard_printing,
    print_text,
    warn,
    write_all,
)
from topomerge.cli.inputs import load_stored_map
from topomerge.cli.options import NO_EDITS, parse_whole_number
from topomerge.errors import InputError

PASSWORD_VARIABLE = "TOPOMERGE_STUDIO_PASSWORD"
LEAST_PASSWORD = 8  # characters
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def run_view(args: argparse.Namespace) -> int:
    """`topomerge view`: a report in the browser."""
    if args.serve is None:
        page = _prepare_page(args)
        if args.open:
            _show(page.resolve().as_uri(), str(page))
        else:
            print_text(str(page))
        return 0
    from topomerge.viz.report_server import serve

    with tempfile.TemporaryDirectory(prefix="topomerge-") as scratch:
        serve(_prepare_page(args, scratch), args.serve, _show if args.open else _print_address)
    return 0


def _print_address(address: str) -> None:
    with guard_printing():
        print(address, flush=True)


def _prepare_page(args: argparse.Namespace, scratch: str | None = None) -> Path:
    """Return the report to show; make that of a map first."""
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
    from topomerge.viz.report import save_report

    topomap = load_stored_map(path, args)
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


def _parse_port(text: str) -> int:
    number = parse_whole_number(text)
    if number > 65535:
        raise argparse.ArgumentTypeError(f"must be a port from 0 to 65535, not {text}")
    return number


VIEW = Command(
    "view",
    run_view,
    "show a report in the browser",
    "topomerge view merged/",
    (
        build_option("input", metavar="PATH", help="folder of a merge or an atlas, a .tmap (a report is made of it) or an .html"),
        build_option("-o", "--output", metavar="A.html", default=None, help="keep the report of a .tmap here"),
        build_option("--no-open", dest="open", action="store_false", default=True, help="only print where the report is"),
        build_option(
            "--serve",
            nargs="?",
            const=0,
            default=None,
            type=_parse_port,
            metavar="PORT",
            help="serve it on this machine until Ctrl-C (default: any free port)",
        ),
        NO_EDITS,
    ),
    paths=("input", "output"),
    description="Show the report of a merge, an atlas or a map in the browser.",
)


def run_studio(args: argparse.Namespace) -> int:
    """`topomerge studio`: a server for one folder, until Ctrl-C."""
    host = getattr(args, "host", LOOPBACK[0])
    password = _find_password(args, host)
    try:
        from topomerge.studio.guard import Access
        from topomerge.studio.server import Studio, serve_studio
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise InputError(f"topomerge studio needs {error.name}: pip install 'topomerge[studio]'") from error
    studio = Studio(args.folder, Access(host, password))
    try:
        serve_studio(studio, args.port, _show if args.open else _print_address)
    except (KeyboardInterrupt, Exception) as stop:
        if not isinstance(find_signal(stop), KeyboardInterrupt):
            raise
    return 0


def _find_password(args: argparse.Namespace, host: str) -> str:
    """Return the password that the page asks for; "" where only this machine can reach it.

    Raises:
        InputError: others could reach it, and there is none, or it is too short.
    """
    given = getattr(args, "password", None)
    if host not in LOOPBACK:
        warn([f"--host {host}: other machines can reach the folder, without encryption: use it in a network that you trust"])
        given = given or os.environ.get(PASSWORD_VARIABLE) or _ask_password()
    if given is not None and len(given) < LEAST_PASSWORD and (given or host not in LOOPBACK):
        raise InputError(f"--password: give one of {LEAST_PASSWORD} characters or more, or set {PASSWORD_VARIABLE}")
    return given or ""


def _ask_password() -> str:
    if not sys.stdin or not sys.stdin.isatty():
        raise InputError(f"--host: needs a password, as other machines can reach the page; set {PASSWORD_VARIABLE}")
    import getpass

    return getpass.getpass("Password for the page: ")


STUDIO = Command(
    "studio",
    run_studio,
    "look at the maps of a folder, correct and merge them, in the browser",
    "topomerge studio folder/",
    (
        build_option("folder", metavar="DIR", help="folder that holds maps and scans; an atlas is one, too"),
        build_option(
            "--port", type=_parse_port, default=0, metavar="PORT", help="serve it at this port (default: any that is free)"
        ),
        build_option("--no-browser", dest="open", action="store_false", default=True, help="only print the address"),
        build_option(
            "--host", metavar="ADDRESS", help="let other machines reach it at this address of this one; asks for a password"
        ),
        build_option(
            "--password",
            metavar="WORDS",
            help="password of the page (others may see it in the list of processes: rather set TOPOMERGE_STUDIO_PASSWORD)",
        ),
    ),
    paths=("folder",),
    description="Serve a page on this machine until Ctrl-C: maps, scans and merges of a folder, with tools that correct rooms "
    "and doors, match maps by hand and merge them. Corrections are kept in a journal beside each map.",
)
