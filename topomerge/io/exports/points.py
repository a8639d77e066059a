"""The occupied cells as coloured points: PLY, and LAS 1.4 or LAZ with the number of their room and storey as extra dimensions."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.io.rooms_ply import NO_ROOM, assign_room_colours, save_rooms_ply
from topomerge.types import TopometricMap

SCALE = 0.001  # m
NO_DATE = date(1970, 1, 1)  # of creation: the same map gives the same bytes


def save_ply(map: TopometricMap, path: Path) -> None:
    """Write the PLY that `extract --ply` and `merge` write."""
    save_rooms_ply(map, path)


def save_las(map: TopometricMap, path: Path) -> None:
    """Write one point for each occupied cell, at its centre; compressed where the name ends in .laz.

    Extra dimensions `room` (-1: none) and `storey`, both int32; colours by room, in 16 bits.

    Raises:
        InputError: the path can't be written.
    """
    import laspy

    points = map.grid.compute_centroids()
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.generating_software = "topomerge"
    header.creation_date = NO_DATE
    header.scales = np.full(3, SCALE)
    header.offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    for name in ("room", "storey"):
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.int32))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.room, las.storey = map.room, map.find_cell_storeys()
    colours = np.concatenate([assign_room_colours(map), np.array([NO_ROOM], np.uint8)])[map.room].astype(np.uint16) * 257
    las.red, las.green, las.blue = colours.T
    with replace_on_success(path) as temporary, temporary.open("wb") as file:
        las.write(file, do_compress=path.suffix.lower() == ".laz")
