"""Stanford Large-Scale 3D Indoor Spaces (S3DIS; Armeni et al. 2016): six areas of office buildings, scanned with Matterport
cameras, as `Stanford3dDataset_v1.2` or its aligned version.

    Area_1/office_1/office_1.txt              x y z r g b, m, z up
    Area_1/office_1/Annotations/chair_1.txt   the same points, object by object

Folders of rooms become labels; the room's own table is read, or else its annotations. A stray control byte within a number, as in
Area_5/hallway_6, is passed over.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.sealed import refuse_building
from topomerge.datasets.public.sources import compute_hull, iter_part_pairs, join_rooms

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, TrueRoom

S3DIS_KINDS = {
    "conferenceRoom": "meeting",
    "hallway": "corridor",
    "WC": "toilets",
    "copyRoom": "storage",
    "openspace": "openplan",
}
LARGEST_TABLE = 1 << 30  # bytes of a table
CONTROL = bytes(set(range(32)) - set(b"\t\n\r"))


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of a pair of parts of each area.

    Raises:
        InputError: the folder holds no area.
    """
    areas = sorted(p for p in folder.iterdir() if p.is_dir() and re.fullmatch(r"Area_\d\w*", p.name))
    if not areas:
        raise InputError(f"{folder}: has no folder Area_1 ...; give the one of Stanford3dDataset_v1.2")
    yield from iter_part_pairs(areas, read_area, "s3dis")


def read_area(area: Path) -> PointCloud:
    """Read all rooms of an area. A room that can't be read is left out, with a warning; the outlines are the points' convex
    hulls.

    Raises:
        InputError: none of them can be read, or the area is sealed.
    """
    refuse_building("s3dis", area.name)
    parts, lost = [], []
    for folder in sorted(p for p in area.iterdir() if p.is_dir()):
        try:
            points = read_room(folder)
            name = folder.name
            kind = S3DIS_KINDS.get(name.rpartition("_")[0], name.rpartition("_")[0])
            floor, ceiling = np.percentile(points[:, 2], [1, 99]).tolist()
            parts.append((TrueRoom(name, compute_hull(points), floor, ceiling, 0, kind), points))
        except InputError as error:
            lost.append(str(error))
    if not parts:
        raise InputError(f"{area}: has no room that can be read" + (f" ({lost[0]})" if lost else ""))
    return replace(join_rooms(parts, area.name), warnings=tuple(lost))


def read_room(folder: Path) -> Array:
    """Read (n, 3) float64 points of a room.

    Raises:
        InputError: no table, or a damaged one.
    """
    table = folder / f"{folder.name}.txt"
    tables = [table] if table.is_file() else sorted((folder / "Annotations").glob("*.txt"))
    if not tables:
        raise InputError(f"{folder}: has neither {folder.name}.txt nor Annotations; copy it again")
    return np.concatenate([_read_table(path) for path in tables])


def _read_table(path: Path) -> Array:
    if not 0 < path.stat().st_size <= LARGEST_TABLE:
        raise InputError(f"{path}: has {path.stat().st_size} bytes; a table of points has 1 to {LARGEST_TABLE}")
    text = path.read_bytes().translate(None, delete=CONTROL)
    try:
        rows = np.loadtxt(io.BytesIO(text), np.float64, usecols=(0, 1, 2, 5), ndmin=2)[:, :3]
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: is no table of x y z r g b ({str(error)[:80]}); copy it again") from error
    if not np.isfinite(rows).all() or not len(rows):
        raise InputError(f"{path}: has a coordinate that is no number; copy it again")
    return rows
