"""The commands `export` and `view`: maps for other tools, and reports for eyes."""

from __future__ import annotations

import argparse
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from topomerge.cli.command import Command, count, option, quiet
from topomerge.cli.console import check_inputs, check_outputs, output_folder, warn, write_all
from topomerge.errors import InputError

PAGES = (".html", ".htm")


def export_command(args: argparse.Namespace) -> int:
    """`topomerge export`: a map in the formats of other tools."""
    from topomerge.io.exports import formats, outputs
    from topomerge.io.maps import load_map

    names = formats(args.to)
    options = _export_options(args, names)
    source = _map_file(args.input)
    path, folder = _place(args, names, source)
    found = load_map(source)
    warn(found.warnings)
    with output_folder(path.parent):
        files = [file for name in names for file in outputs(found, name, path, folder, **options)]
        check_outputs([file for file, _ in files], [source])
        write_all(files)
    if not args.quiet:
        print(f"{len(found.rooms)} rooms, {len(found.edges)} doors and stairs -> {' '.join(str(file) for file, _ in files)}")
    return 0


def _export_options(args: argparse.Namespace, names: list[str]) -> dict[str, Any]:
    """The options that only some formats know.

    Raises:
        InputError: one was given that none of the formats knows.
    """
    from topomerge.io.exports import FORMATS

    options = {key: getattr(args, key) for key in ("origin", "storey") if hasattr(args, key)}
    for key in options:
        able = [name for name, form in FORMATS.items() if key in form.options]
        if not set(able) & set(names):
            raise InputError(f"--{key}: means nothing for {', '.join(names)}; it is for {' and '.join(able)}")
    if "origin" in options:
        from topomerge.io.exports.geojson import parse_origin

        options["origin"] = parse_origin(options["origin"])
    return options


def _map_file(given: str) -> Path:
    """The .tmap that a user means, who may have named the folder of a merge or of an atlas."""
    path = Path(given)
    if path.is_dir():
        joined = [path / "map.tmap"] if (path / "map.tmap").is_file() else sorted(path.glob("map_*.tmap"))
        if len(joined) == 1:
            return joined[0]
        if joined:
            raise InputError(f"{path}: holds {len(joined)} joined maps; give one of {', '.join(str(p) for p in joined)}")
        refused = " (its merge was refused: merge again with --force)" if (path / "merge.json").is_file() else ""
        raise InputError(f"{path}: holds no joined map{refused}; give a .tmap, or the folder of a merge or an atlas")
    check_inputs([given])
    if path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: is no map; make one with `topomerge extract {path} -o {path.stem}.tmap`")
    return path


def _place(args: argparse.Namespace, names: list[str], source: Path) -> tuple[Path, bool]:
    """Where to write: a file, or (True) a folder with the stem of the names in it."""
    from topomerge.io.exports import FORMATS

    several = len(names) > 1 or FORMATS[names[0]].folder
    stem = source.parent.resolve().name if Path(args.input).is_dir() else source.stem
    if args.output is None:
        return source.parent / stem, True
    path = Path(args.output)
    if several and path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; {args.to} writes several, give the name of a folder")
    if several or path.is_dir() or args.output.endswith(("/", "\\")):
        return path / stem, True
    return path, False


def view_command(args: argparse.Namespace) -> int:
    """`topomerge view`: a report in the browser."""
    if args.serve is None:
        page = _page(args)
        if args.open:
            _show(page.resolve().as_uri(), str(page))
        else:
            print(page)
        return 0
    from topomerge.viz.serve import serve

    with tempfile.TemporaryDirectory(prefix="topomerge-") as scratch:
        serve(_page(args, scratch), args.serve, _show if args.open else _tell)
    return 0


def _tell(address: str) -> None:
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
    if path.suffix.lower() in PAGES:
        if args.output is not None:
            raise InputError(f"{args.output}: -o is for the report of a .tmap, and {path} is a page already; leave it out")
        return path
    if path.suffix.lower() != ".tmap":
        raise InputError(f"{path}: can't be shown; give a .tmap (of `topomerge extract`), the folder of a merge or an .html")
    from topomerge.io.maps import load_map
    from topomerge.viz.report import save_report

    found = load_map(path)
    if args.output is not None:
        place = Path(args.output)
    else:  # a browser reads it after this program has ended: only what is served is deleted
        place = Path(scratch or tempfile.mkdtemp(prefix="topomerge-")) / f"{path.stem}.html"
    check_outputs([place], [path])
    write_all([(place, partial(save_report, found))])
    return place


def _show(address: str, name: str = "") -> None:
    """Open an address in the browser, and say where it is for those who have none."""
    import webbrowser

    _tell(name or address)
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


EXPORT = Command(
    "export",
    export_command,
    "write a map for other tools: GIS, BIM, robots, graphs",
    "topomerge export merged/ --to geojson,indoorgml,ros -o exported/",
    (
        option("input", metavar="MAP", help="a .tmap, or the folder of a merge or an atlas"),
        option(
            "--to",
            required=True,
            metavar="FORMAT[,FORMAT]",
            default=None,
            help="graphml, geojson, indoorgml, dsg (Spark-DSG), ros (map_server grids, Nav2 routes), ply, las, ifc",
        ),
        option(
            "-o",
            "--output",
            metavar="OUT",
            default=None,
            help="file, or folder for several formats and for ros (default: beside the map, named after it)",
        ),
        option(
            "--origin",
            metavar="LAT,LON[,HEADING]",
            help="geojson: where (0, 0) of the map lies, and how far its y axis is turned clockwise from north, degrees",
        ),
        option("--storey", type=count, metavar="N", help="geojson, ros: only this storey"),
        quiet(),
    ),
    paths=("input", "output"),
    description="Write a map in the formats of other tools: rooms as polygons, doors, storeys, their graph, grids to drive by.",
)

VIEW = Command(
    "view",
    view_command,
    "show a report in the browser",
    "topomerge view merged/",
    (
        option("input", metavar="PATH", help="folder of a merge or an atlas, a .tmap (its report is made) or an .html"),
        option("-o", "--output", metavar="A.html", default=None, help="of a .tmap: keep the report here"),
        option("--no-open", dest="open", action="store_false", default=True, help="only print where it is"),
        option(
            "--serve",
            nargs="?",
            const=0,
            default=None,
            type=_port,
            metavar="PORT",
            help="serve it to this machine only, until Ctrl-C (default: any free port)",
        ),
    ),
    paths=("input", "output"),
    description="Show the report of a merge, an atlas or a map in the browser.",
)
