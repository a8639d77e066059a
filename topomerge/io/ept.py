"""Entwine point tiles (EPT): `ept.json`, a hierarchy in JSON files, and a file of points for each node of an octree.

Nodes are LAZ (laszip), packed rows (binary), or packed rows under Zstandard. They are read one at a time, coarse ones first.
Source: https://entwine.io/en/latest/entwine-point-tile.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.las import read_las_node
from topomerge.io.piece import (
    LARGEST_NODE,
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

EPT_KIND = "an EPT point cloud"
KEY = re.compile(r"\d{1,2}(-\d{1,13}){3}")  # level, x, y, z
ROOT_KEY = "0-0-0-0"
NODE_SUFFIXES = {"laszip": "laz", "binary": "bin", "zstandard": "zst"}
NUMBER_KINDS = {"signed": "i", "unsigned": "u", "float": "f"}


@dataclass(frozen=True)
class EptLayout:
    """The layout that `ept.json` states: how nodes are stored, what lies in a row and how its X, Y, Z become coordinates."""

    suffix: str
    layout: np.dtype[Any]
    scale: Array
    offset: Array
    spacing: float  # of the points of the root, in the file's unit
    points: int


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the points of all nodes, or of those that are coarse enough for `spacing`."""
    folder = path if path.is_dir() else path.parent
    tiles = _read_layout(folder / "ept.json")
    done = 0
    for key, count in _iter_nodes(folder / "ept-hierarchy", compute_deepest_level(tiles.spacing, options)):
        node = folder / "ept-data" / f"{key}.{tiles.suffix}"
        for piece in _read_node(node, tiles, count, options):
            done += len(piece.points)
            yield replace(piece, done=done / max(tiles.points, 1))


def _read_layout(file: Path) -> EptLayout:
    values = load_json(file, EPT_KIND)
    stored = str(values.get("dataType"))
    if stored not in NODE_SUFFIXES or values.get("hierarchyType", "json") != "json":
        what = f"points as {stored!r} and a hierarchy as {values.get('hierarchyType')!r}"
        raise InputError(f"{file}: has {what}"[:300] + f"; only {', '.join(NODE_SUFFIXES)} and json are read")
    try:
        bounds = np.array(values["bounds"], float).reshape(2, 3)
        schema = {str(field["name"]).lower(): field for field in values["schema"]}
        layout = np.dtype([(name, f"<{NUMBER_KINDS[field['type']]}{int(field['size'])}") for name, field in schema.items()])
        scale, offset = (np.array([float(schema[a].get(n, d)) for a in "xyz"]) for n, d in (("scale", 1.0), ("offset", 0.0)))
        spacing = (float(bounds[1, 0]) - float(bounds[0, 0])) / max(float(values.get("span", 128)), 1.0)
        points = int(values.get("points", 0))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise build_damage_error(file, EPT_KIND, f"its bounds or schema: {error}") from error
    if not (np.isfinite(bounds).all() and np.isfinite([scale, offset]).all() and scale.all()):
        raise build_damage_error(file, EPT_KIND, "its bounds, scale or offset are not finite numbers")
    return EptLayout(NODE_SUFFIXES[stored], layout, scale, offset, spacing, points)


def _iter_nodes(folder: Path, deepest: int) -> Iterator[tuple[str, int]]:
    """Yield the key and number of points of each node that has some. Files of the hierarchy are read when their turn comes."""
    pages, seen = [ROOT_KEY], {ROOT_KEY}
    while pages:
        page = pages.pop()
        file = folder / f"{page}.json"
        for key, count in load_json(file, EPT_KIND).items():
            if not KEY.fullmatch(key) or not isinstance(count, int) or count < -1 or int(key.split("-")[0]) > MOST_LEVELS:
                raise build_damage_error(file, EPT_KIND, f"the node {key[:40]!r} with {str(count)[:20]} points")
            if int(key.split("-")[0]) > deepest:
                continue
            if count > 0:
                yield key, count
            elif count == -1:
                if key in seen:
                    raise build_damage_error(file, EPT_KIND, f"the hierarchy of {key} is named twice")
                seen.add(key)
                pages.append(key)


def _read_node(node: Path, tiles: EptLayout, count: int, options: ReadOptions) -> Iterator[Piece]:
    if tiles.suffix == "laz":
        yield from read_las_node(node, count, options)
        return
    check_node(node)
    room = min(count * tiles.layout.itemsize, LARGEST_NODE)
    if tiles.suffix == "bin" and node.stat().st_size > room:
        raise _build_length_error(node, count)
    data = _decompress_node(node, room) if tiles.suffix == "zst" else node.read_bytes()
    if len(data) > room:
        raise _build_length_error(node, count)
    rows = decode_rows(node, data, tiles.layout, count)
    xyz = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    yield Piece(xyz * tiles.scale + tiles.offset, decode_colors(rows))


def _build_length_error(node: Path, count: int) -> InputError:
    return build_damage_error(node, EPT_KIND, f"more than the {count:,} points that its hierarchy promises")


def _decompress_node(node: Path, room: int) -> bytes:
    """Return the bytes of a file under Zstandard, one more than there is room for at most."""
    try:
        from compression import zstd  # type: ignore[import-not-found]
    except ImportError:
        try:
            from backports import zstd
        except ImportError as error:
            raise InputError(
                f"{node}: is packed by Zstandard, and that needs Python 3.14 or: pip install backports.zstd"
            ) from error
    try:
        data: bytes = zstd.ZstdDecompressor().decompress(node.read_bytes(), max_length=room + 1)
    except zstd.ZstdError as error:
        raise build_damage_error(node, EPT_KIND, error) from error
    return data
