"""Maps in JSON: of vacuum robots (`valetudo.py`), scene graphs with their mesh (`scene_graph.py`). What is in it tells which."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io import scene_graph, valetudo
from topomerge.io.options import ReadOptions
from topomerge.io.piece import Piece, damaged

LARGEST_MAP_JSON = 1 << 28  # bytes: the mesh of a floor of 3,000 m2 in faces of 10 cm


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """What the reader of the map hands over, in metres.

    Raises:
        InputError: it is no JSON, or of neither kind.
    """
    about = what_is_in(path)
    if valetudo.is_robot_map(about):
        yield from valetudo.pieces(path, about, options)
    elif scene_graph.is_scene_graph(about):
        yield from scene_graph.pieces(path, about, options)
    else:
        kinds = "a map of Valetudo nor a scene graph of Spark-DSG"
        raise InputError(f"{path}: is neither {kinds}, the JSON that can be read; give the scan or the map that it tells of")


def what_is_in(path: Path) -> Any:
    """The value of a file of JSON.

    Raises:
        InputError: it is none, or too large.
    """
    if path.stat().st_size > LARGEST_MAP_JSON:
        most = f"more than {LARGEST_MAP_JSON >> 20} MB, too many for a map in JSON"
        raise InputError(f"{path}: has {most}; give the scan that it was made of")
    try:
        return json.loads(path.read_bytes())
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise damaged(path, "a map in JSON", error) from error
