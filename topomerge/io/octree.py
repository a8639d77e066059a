"""What point clouds in octrees of files share: their JSON, the level that is fine enough, and nodes of packed rows.

A node holds points of its own, which no other node has; all nodes together are the cloud.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.options import ReadOptions
from topomerge.io.piece import bytes8, cut_short, damaged

LARGEST_JSON = 1 << 28  # bytes: a page of a hierarchy of ten million nodes
MOST_LEVELS = 40  # of an octree: a millimetre of a million kilometres
LARGEST_NODE = 1 << 30  # bytes; usual ones have a few million
COLOR_NAMES = ("red", "green", "blue")


def load_json(path: Path, kind: str) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: there is no such file, or no object in it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file, and it belongs to {kind}; copy the whole folder again")
    if path.stat().st_size > LARGEST_JSON:
        raise InputError(f"{path}: has {path.stat().st_size:,} bytes, too many for a part of {kind}; copy it again")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"a part of {kind}", error) from error
    if not isinstance(values, dict):
        raise damaged(path, f"a part of {kind}", "it holds no object")
    return values


def deepest_level(root_spacing: float, options: ReadOptions) -> int:
    """The level whose points are as close as `options.spacing` asks for; levels halve the distance. Not asked for: all levels."""
    if options.spacing is None or not root_spacing > 0:
        return sys.maxsize
    ratio = root_spacing * options.factor / options.spacing
    return max(0, math.ceil(math.log2(ratio) - 1e-9)) if 0 < ratio < math.inf else sys.maxsize


def check_node(path: Path) -> None:
    """Raises an InputError where a node has no file, or an absurdly large one."""
    if not path.is_file():
        raise InputError(f"{path}: no such file, but the hierarchy names it; copy the whole folder again")
    if path.stat().st_size > LARGEST_NODE:
        raise InputError(f"{path}: has {path.stat().st_size:,} bytes, too many for a node of an octree; convert the cloud again")


def packed_rows(path: Path, data: bytes, layout: np.dtype[Any], promised: int) -> np.ndarray[Any, Any]:
    """The rows of a node of packed points.

    Raises:
        InputError: its bytes are not those of whole points, or fewer than the hierarchy promises.
    """
    count = len(data) // layout.itemsize
    if len(data) % layout.itemsize or count < promised:
        raise cut_short(path, count, promised)
    return np.frombuffer(data, layout)


def packed_colors(rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
    """(n, 3) uint8 of the fields red, green and blue; None where the rows lack one."""
    if not set(COLOR_NAMES) <= set(rows.dtype.names or ()):
        return None
    return bytes8(np.stack([rows[name] for name in COLOR_NAMES], axis=1))
