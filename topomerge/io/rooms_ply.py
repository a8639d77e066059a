"""The occupied cells of a map as coloured points, for viewers and other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from topomerge.io.atomic import replacing
from topomerge.io.palette import NO_ROOM, room_colours
from topomerge.types import Array, TopometricMap

FLOAT32_FAR = 1e4  # m: beyond, float32 rounds by a millimetre and, soon after, by centimetres


def _vertices(map: TopometricMap) -> Array:
    points = map.grid.centroids()
    real = "<f8" if len(points) and np.abs(points).max() > FLOAT32_FAR else "<f4"
    layout = [("x", real), ("y", real), ("z", real), ("room", "<i4"), ("storey", "<i4")]
    layout += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(points), layout)
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    vertices["room"], vertices["storey"] = map.room, map.storey_of_cells()
    colours = np.concatenate([room_colours(map), np.array([NO_ROOM], np.uint8)])[map.room]  # -1: the last row
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    return vertices


def save_rooms_ply(map: TopometricMap, path: str | Path) -> None:
    """Write one vertex for each occupied cell: binary, little endian.

    Properties: x y z, the centre of the cell in the input's frame, m (float; double beyond 10 km, where float would lose
    centimetres); int room (-1: none); int storey; red green blue by room.

    Raises:
        InputError: the path can't be written.
    """
    vertices = _vertices(map)
    types = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
    assert vertices.dtype.names is not None
    properties = [f"property {types[vertices.dtype[name].str[1:]]} {name}" for name in vertices.dtype.names]
    head = ["ply", "format binary_little_endian 1.0", "comment topomerge rooms, metres, z up"]
    head += [f"element vertex {len(vertices)}", *properties, "end_header"]
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
