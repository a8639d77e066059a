"""Matterport3D (Chang et al. 2017): 90 houses, reconstructed from panoramas and cut into regions on levels.

    <house>/house_segmentations/<house>.house     lines of text: H (counts), L (levels), R (regions), S (surfaces), V (corners)
    <house>/house_segmentations/<house>.ply       mesh, m, z up
    <house>/region_segmentations/region0.ply ...  the same mesh, region by region

Regions become rooms, levels storeys. Without the regions' meshes, a point of the house belongs to the region whose prism has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.flat_maps import find_rooms
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.public.sources import POINT_SPACING, iter_part_pairs, join_rooms

from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array, PointCloud, TrueRoom

REGION_KINDS = {
    "a": "bath", "b": "bedroom", "c": "closet", "d": "dining", "e": "lobby", "f": "living", "g": "garage", "h": "corridor",
    "i": "library", "j": "laundry", "k": "kitchen", "l": "living", "m": "meeting", "n": "lounge", "o": "office", "p": "outside",
    "r": "games", "s": "stairs", "t": "toilets", "u": "storage", "v": "tv", "w": "gym", "x": "outside", "y": "outside",
    "B": "bar", "C": "classroom", "D": "dining", "S": "spa",
}  # fmt: skip
JUNK = ("Z",)  # reflections and stray points
LARGEST_HOUSE = 100 << 20  # bytes of a .house file


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of a pair of parts of each house.

    Raises:
        InputError: the folder holds no house.
    """
    houses = sorted(p.parent.parent for p in folder.glob("*/house_segmentations/*.house"))
    if not houses:
        raise InputError(f"{folder}: has no */house_segmentations/*.house; give the folder of the houses (scans)")
    yield from iter_part_pairs(houses, read_house, "matterport")


def read_house(folder: Path) -> PointCloud:
    """Read the points of a house, labelled with their rooms; junk and what is outside of every region are left out.

    Raises:
        InputError: a file is missing, damaged or cut short.
    """
    files = folder / "house_segmentations"
    rooms = read_regions(files / f"{folder.name}.house")
    meshes = {i: folder / "region_segmentations" / f"region{i}.ply" for i in rooms}
    if any(path.is_file() for path in meshes.values()):
        parts = [(room, _read_points(meshes[i])) for i, room in rooms.items()]
    else:
        points = _read_points(files / f"{folder.name}.ply")
        labels = _find_rooms(points, list(rooms.values()))
        parts = [(room, points[labels == k]) for k, room in enumerate(rooms.values())]
    parts = [(room, points) for room, points in parts if len(points)]
    if not parts:
        raise InputError(f"{folder}: no point lies in a region; are mesh and .house of one version?")
    return join_rooms(parts, folder.name)


def read_regions(path: Path) -> dict[int, TrueRoom]:
    """Read region -> room, from a .house file; the outline is that of the region's first surface, or else its box.

    Raises:
        InputError: missing, damaged, or with fewer regions than its first line says.
    """
    if not path.is_file() or path.stat().st_size > LARGEST_HOUSE:
        raise InputError(f"{path}: no such file, or far too large; copy it again")
    lines = [line.split() for line in path.read_text(encoding="latin-1").splitlines()]
    try:
        head = next(w for w in lines if w[:1] == ["H"])
        regions = {int(w[1]): w for w in lines if w[:1] == ["R"]}
        surfaces = {int(w[1]): int(w[2]) for w in lines if w[:1] == ["S"]}
        corners: dict[int, list[list[float]]] = {}
        for w in lines:
            if w[:1] == ["V"]:
                corners.setdefault(int(w[2]), []).append([float(v) for v in w[4:6]])
        if len(regions) != int(head[10]):
            raise InputError(f"{path}: has {len(regions)} regions and promises {head[10]}; it is cut short, copy it again")
        outlines = {region: corners[s] for s, region in sorted(surfaces.items(), reverse=True) if len(corners.get(s, ())) > 2}
        return {i: _build_room(w, outlines.get(i)) for i, w in sorted(regions.items()) if w[5] not in JUNK}
    except (StopIteration, IndexError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is no .house file, or damaged ({error}); copy it again") from error


def _build_room(columns: list[str], outline: list[list[float]] | None) -> TrueRoom:
    x0, y0, z0, x1, y1, z1 = (float(v) for v in columns[9:15])
    polygon = np.array(outline or [[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return TrueRoom(f"region{columns[1]}", polygon, z0, z1, int(columns[2]), REGION_KINDS.get(columns[5], ""))


def _read_points(path: Path) -> Array:
    if not path.is_file():
        raise InputError(f"{path}: no such file; copy the house again")
    cloud = read_points(path, spacing=POINT_SPACING)
    return cloud.points.astype(np.float64) + cloud.shift


def _find_rooms(points: Array, rooms: list[TrueRoom]) -> Array:
    """Return (n,) room whose prism holds a point, -1: none."""
    out = np.full(len(points), -1)
    for storey in sorted({room.storey for room in rooms}):
        here = [k for k, room in enumerate(rooms) if room.storey == storey]
        low, high = min(rooms[k].floor for k in here) - 0.1, max(rooms[k].ceiling for k in here) + 0.1
        rows = np.flatnonzero((points[:, 2] >= low) & (points[:, 2] <= high) & (out < 0))
        nearest = find_rooms(points[rows, :2], [rooms[k] for k in here])
        out[rows] = np.where(nearest >= 0, np.array(here)[nearest], -1)
    return out
