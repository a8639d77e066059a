"""Potree 1.x (1.4 to 1.8): `cloud.js`, a hierarchy, and a file of points for each node of an octree.

Nodes are packed rows (whole numbers times `scale` from the lower corner of the node's cube), LAS or LAZ. They are read one at a
time. Version 1.4 lists its nodes in `cloud.js`; later ones in files of five bytes a node: which children, how many points.
Source: https://github.com/potree/potree/blob/1.8/docs/potree-file-format.md
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.las import read_las_node
from topomerge.io.piece import (
    MOST_LEVELS,
    Piece,
    ReadOptions,
    build_damage_error,
    check_node,
    compute_deepest_level,
    decode_colors,
    decode_rows,
    load_json,
)
from topomerge.types import Array

POTREE_KIND = "a Potree 1.x point cloud"
VERSIONS = (4, 8)  # of 1.x, first and last
NODE_NAME = re.compile(r"r[0-7]*")
HRC_ENTRY = struct.Struct("<BI")  # of a hierarchy: which children, how many points
ATTRIBUTE_BYTES = {
    **{"POSITION_CARTESIAN": 12, "COLOR_PACKED": 4, "RGBA_PACKED": 4, "RGBA": 4, "RGB_PACKED": 3, "NORMAL_FLOATS": 12},
    **{"NORMAL": 12, "NORMAL_SPHEREMAPPED": 2, "NORMAL_OCT16": 2, "FILLER_1B": 1, "INTENSITY": 2, "CLASSIFICATION": 1},
    **{"RETURN_NUMBER": 1, "NUMBER_OF_RETURNS": 1, "SOURCE_ID": 2, "INDICES": 4, "SPACING": 4, "GPS_TIME": 8},
}
COLORS = ("COLOR_PACKED", "RGBA_PACKED", "RGBA", "RGB_PACKED")
FILES = {"LAS": "las", "LAZ": "laz"}


@dataclass(frozen=True)
class Octree:
    """The layout that `cloud.js` states: the folder of nodes, how many levels lie in one file, the cube of the root, and a
    point's row."""

    folder: Path
    step: int  # 0: the nodes are listed
    listed: tuple[tuple[str, int], ...]
    low: Array
    edge: float
    scale: float
    spacing: float
    points: int
    suffix: str
    layout: np.dtype[Any] | None


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the points of all nodes, or of those that are coarse enough for `spacing`."""
    folder = path if path.is_dir() else path.parent
    octree = _read_octree(folder / "cloud.js")
    done = 0
    for name, count in _iter_nodes(octree, compute_deepest_level(octree.spacing, options)):
        for piece in _read_node(octree, name, count, options):
            done += len(piece.points)
            yield replace(piece, done=done / max(octree.points, done, 1))


def _read_octree(file: Path) -> Octree:
    values = load_json(file, POTREE_KIND)
    version = str(values.get("version", "none"))
    if not re.fullmatch(r"1\.\d{1,3}(\.\d+)?", version) or not VERSIONS[0] <= int(version.split(".")[1]) <= VERSIONS[1]:
        able = " to ".join(f"1.{v}" for v in VERSIONS)
        raise InputError(f"{file}: is of version {version[:20]} of Potree, only {able} are read; convert the cloud again")
    try:
        box = values["boundingBox"]
        low, high = (np.array([float(box[f"{end}{axis}"]) for axis in "xyz"]) for end in "lu")
        listed = tuple((str(name), int(count)) for name, count in values.get("hierarchy", ()))
        step = 0 if listed else int(values["hierarchyStepSize"])
        spacing, scale, points = float(values["spacing"]), float(values.get("scale", 1.0)), int(values.get("points", 0))
        inside = PurePosixPath(str(values.get("octreeDir", "data")))
        suffix, layout = _parse_attributes(file, values["pointAttributes"])
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise build_damage_error(file, POTREE_KIND, f"{type(error).__name__}: {error}") from error
    with np.errstate(over="ignore", invalid="ignore"):  # what is too wide is refused below
        edge = float((high - low).max())
    if not (np.isfinite([*low, *high, edge, scale]).all() and edge > 0 and scale > 0 and (listed or step > 0)):
        raise build_damage_error(file, POTREE_KIND, "its bounding box, scale or hierarchyStepSize can't be used")
    if inside.is_absolute() or ".." in inside.parts:
        raise InputError(f"{file}: has its points outside of its folder ({str(inside)[:100]}); put them beside it")
    return Octree(file.parent / inside, step, listed, low, edge, scale, spacing, points, suffix, layout)


def _parse_attributes(file: Path, attributes: Any) -> tuple[str, np.dtype[Any] | None]:
    """Return the suffix of nodes, and the layout of their rows where they are packed."""
    if isinstance(attributes, str) and attributes in FILES:
        return FILES[attributes], None
    fields: list[tuple[Any, ...]] = []
    for number, attribute in enumerate(attributes if isinstance(attributes, list) else [attributes]):
        name = str(attribute["name"] if isinstance(attribute, dict) else attribute)
        size = int(attribute["size"]) if isinstance(attribute, dict) else ATTRIBUTE_BYTES.get(name, 0)
        if not 0 < size <= 1024:
            raise InputError(f"{file}: has points with {name[:40]!r}, whose size is not known; convert the cloud to LAZ nodes")
        if name.upper() == "POSITION_CARTESIAN" and size == 12:
            fields.append(("place", "<u4", 3))
        elif name.upper() in COLORS and size >= 3 and not any(f[0] == "red" for f in fields):
            fields += [(color, "u1") for color in ("red", "green", "blue")]
            fields += [("alpha", f"V{size - 3}")] if size > 3 else []
        else:
            fields.append((f"other {number}", f"V{size}"))
    layout = np.dtype(fields)
    if "place" not in (layout.names or ()):
        raise InputError(f"{file}: has points without POSITION_CARTESIAN; convert the cloud again")
    return "bin", layout


def _iter_nodes(octree: Octree, deepest: int) -> Iterator[tuple[str, int]]:
    """Yield the name and number of points of each node; a file of the hierarchy is read when its turn comes."""
    if octree.listed:
        if len(dict(octree.listed)) < len(octree.listed):
            raise build_damage_error(octree.folder, POTREE_KIND, "a node is listed twice")
        for name, count in octree.listed:
            if not NODE_NAME.fullmatch(name) or len(name) - 1 > MOST_LEVELS or count < 0:
                raise build_damage_error(octree.folder, POTREE_KIND, f"a node {name[:40]!r} with {count} points")
            if len(name) - 1 <= deepest and count:
                yield name, count
        return
    roots = ["r"]
    while roots:
        root = roots.pop()
        for name, count, more in _iter_hierarchy(octree, root):
            if len(name) - 1 > deepest:
                break  # breadth first: the rest is as deep
            if more:
                roots.append(name)
            elif count:
                yield name, count


def _iter_hierarchy(octree: Octree, root: str) -> Iterator[tuple[str, int, bool]]:
    """Yield the name, number of points, and whether it has a file of its own, of each node in a file of the hierarchy, by
    level."""
    file = _build_node_path(octree, root).with_suffix(".hrc")
    check_node(file)
    data = file.read_bytes()
    entries = HRC_ENTRY.iter_unpack(data[: len(data) // HRC_ENTRY.size * HRC_ENTRY.size])
    names = [root]
    while names:
        deeper = []
        for name in names:
            entry = next(entries, None)
            if entry is None:
                raise InputError(f"{file}: ends before the node {name}; it is cut short, copy it again")
            children, count = entry
            last = name != root and (len(name) - 1) % octree.step == 0
            yield name, count, last and children != 0
            deeper += [] if last else [f"{name}{k}" for k in range(8) if children >> k & 1]
        if deeper and len(deeper[0]) - 1 > MOST_LEVELS:
            raise build_damage_error(file, POTREE_KIND, f"more than {MOST_LEVELS} levels")
        names = deeper


def _build_node_path(octree: Octree, name: str) -> Path:
    """Return where the files of a node lie, without a suffix."""
    if octree.listed:
        return octree.folder / name
    parts = [name[1 + k * octree.step : 1 + (k + 1) * octree.step] for k in range((len(name) - 1) // octree.step)]
    return octree.folder.joinpath("r", *parts, name)


def _read_node(octree: Octree, name: str, count: int, options: ReadOptions) -> Iterator[Piece]:
    file = _build_node_path(octree, name).with_suffix(f".{octree.suffix}")
    if octree.layout is None:
        yield from read_las_node(file, count, options)
        return
    check_node(file)
    rows = decode_rows(file, file.read_bytes(), octree.layout, count)
    yield Piece(rows["place"].astype(np.float64) * octree.scale + _compute_corner(octree, name), decode_colors(rows))


def _compute_corner(octree: Octree, name: str) -> Array:
    """Return (3,) lower corner of a node's cube: each figure of its name halves the cube, x by 4, y by 2, z by 1."""
    corner, edge = octree.low.copy(), octree.edge
    for figure in name[1:]:
        edge /= 2
        corner += edge * np.array([int(figure) >> 2 & 1, int(figure) >> 1 & 1, int(figure) & 1])
    return corner
