"""Maps written for other tools: a file for each format, all of them reached through `outputs`.

Nothing is imported until a format is written; formats in XML share `write_xml`.
To add one, write a module with a function (map, path) and enter it here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as xml

from topomerge.archive import replace_on_success
from topomerge.errors import InputError

if TYPE_CHECKING:
    from topomerge.types import TopometricMap

Save = Callable[[Path], None]


@dataclass(frozen=True)
class Format:
    """A format: its files' suffixes, the first one its own, and the function of a module (map, path, **options)."""

    suffixes: tuple[str, ...]
    module: str
    function: str = "save"
    folder: bool = False  # several files, named by `module.files`
    options: tuple[str, ...] = ()
    needs: tuple[str, str] | None = None  # Python package, extra


FORMATS = {
    "graphml": Format((".graphml",), "graphml"),
    "geojson": Format((".geojson", ".json"), "geojson", options=("origin", "storey")),
    "indoorgml": Format((".gml", ".indoorgml", ".xml"), "indoorgml"),
    "dsg": Format((".dsg.json", ".json"), "dsg"),
    "ros": Format((), "ros", folder=True, options=("storey",)),
    "rmf": Format((), "rmf", folder=True, options=("storey",)),
    "rviz": Format((".mcap",), "rviz", needs=("rosbags", "ros")),
    "tf2": Format((".launch.xml", ".xml"), "placements", "save_launch", options=("transforms",)),
    "g2o": Format((".g2o",), "placements", "save_graph", options=("graph",)),
    "ply": Format((".ply",), "points", "save_ply"),
    "las": Format((".las", ".laz"), "points", "save_las", needs=("laspy", "las")),
    "ifc": Format((".ifc",), "ifc", needs=("ifcopenshell", "ifc")),
}


def parse_formats(text: str) -> list[str]:
    """Parse the formats in "a,b".

    Raises:
        InputError: none, an unknown one, or one twice.
    """
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    choices = ", ".join(FORMATS)
    for name in names:
        if name not in FORMATS:
            raise InputError(f"--to {name}: is no format that can be written; choose from {choices}")
        if names.count(name) > 1:
            raise InputError(f"--to {text}: names {name} twice; once is enough")
    if not names:
        raise InputError(f"--to {text!r}: names no format; choose from {choices}")
    return names


def prepare_outputs(map: TopometricMap, name: str, path: Path, folder: bool, **options: Any) -> list[tuple[Path, Save]]:
    """Prepare the writing of a map in one format: paths, and for each the function that writes it there.

    Args:
        map: any map.
        name: a key of `FORMATS`.
        path: of the file; or the folder and the stem of the file names in it.
        folder: is it the second?
        options: what the user asked for; those that the format knows are used.

    Raises:
        InputError: a package that the format needs is missing, or the map can't be written in it.
    """
    form = FORMATS[name]
    _check_package(name, form)
    module = import_module(f"topomerge.io.exports.{form.module}")
    given = {key: value for key, value in options.items() if key in form.options}
    if form.folder:
        place, stem = (path.parent, path.name + "_") if folder else (path, "")
        files: list[tuple[Path, Save]] = module.prepare_files(map, place, stem, **given)
        return files
    save = partial(getattr(module, form.function), map, **given)
    return [(path.with_name(path.name + form.suffixes[0]) if folder else path, save)]


def save_export(map: TopometricMap, name: str, path: str | Path, min_confidence: float = 0.0, **options: Any) -> list[Path]:
    """Write a map in the format of another tool.

    Args:
        map: any map.
        name: graphml, geojson, indoorgml, dsg, ros, rmf, rviz, tf2, g2o, ply, las or ifc.
        path: the file; for ros and rmf the folder, which is made.
        min_confidence: rooms, doors, stairs and windows that are less likely are left out, 0 to 1; 0: none.
        options: `storey` (geojson, ros, rmf) a number; `origin` (geojson) "latitude,longitude" or "latitude,longitude,heading";
            `transforms` (tf2) as `topomerge.io.exports.placements.read_frame_poses` gives them; `graph` (g2o) as
            `topomerge.fusion.frames.build_map_graph` builds it.

    Returns:
        The files that were written.

    Raises:
        InputError: an unknown format, a missing package, a wrong option, or the path can't be written.
    """
    from topomerge.types import filter_confident

    if name not in FORMATS:
        raise InputError(f"{name}: is no format that can be written; choose from {', '.join(FORMATS)}")
    if isinstance(options.get("origin"), str):
        options["origin"] = import_module("topomerge.io.exports.geojson").parse_origin(options["origin"])
    unknown = ", ".join(sorted(set(options) - set(FORMATS[name].options)))
    if unknown:
        raise InputError(f"{unknown}: means nothing for {name}")
    files = prepare_outputs(filter_confident(map, min_confidence), name, Path(path), False, **options)
    if FORMATS[name].folder:
        Path(path).mkdir(parents=True, exist_ok=True)
    for place, save in files:
        save(place)
    return [place for place, _ in files]


def _check_package(name: str, form: Format) -> None:
    if form.needs is None:
        return
    package, extra = form.needs
    try:
        import_module(package)
    except ImportError as error:
        raise InputError(f"--to {name}: needs the Python package {package}: pip install 'topomerge[{extra}]'") from error


FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def replace_forbidden(value: str) -> str:
    """Return a text without the characters that XML cannot hold."""
    return FORBIDDEN.sub("\ufffd", value)


def write_xml(root: Any, path: Path) -> None:
    """Write a document, indented, in UTF-8.

    Raises:
        InputError: the path can't be written.
    """
    xml.indent(root)
    with replace_on_success(path) as temporary:
        xml.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)
