"""Gates Dell Complex, UT Austin: robot grids of floors 1-4 (UTexas BWI) and line maps of the same floors (UT-AMRL), and three
partial grids.

The line maps' relation to the grids is not published. It was measured: first turned and moved by hand, then refined by
`sources.fit_walls` (all changes were below 0.3° and 0.1 m) and looked at as overlay. Walls agree to a decimetre or two; the grid
of floor 4 is bent and misses them by up to 2 m in its north-east, floor 1's was put together from two maps.
Floors 1 and 3 contain the partial grids pixel by pixel, moved by whole pixels: 1n and 1s are its two wings, 3ne the north of 3.
Rooms are those of BWI, also for the line maps, which have none.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import yaml
from scipy import ndimage
from topomerge.datasets.pairs.flat_maps import WALL_HEIGHT, FlatMap, build_flat_pair, build_from_masks, read_flat, transform_room
from topomerge.datasets.pairs.pairs import Pair

from topomerge.errors import InputError
from topomerge.io import grid
from topomerge.types import Array, Sim3, TrueRoom

LINES_FOLDER = "utexas_amrl_vectormaps"  # beside the folder of the grids
INTO_LINES = {  # BWI grid -> AMRL line map
    "1": Sim3(np.radians(179.818), (-14.694, 3.939, 0.0)),
    "2": Sim3(np.radians(-179.909), (-14.118, 2.608, 0.0)),
    "3": Sim3(np.radians(-179.434), (-14.026, 9.348, 0.0)),
    "4": Sim3(np.radians(179.677), (-13.801, 9.239, 0.0)),
}
INTO_WHOLE = {  # partial grid -> grid of the floor
    "1n": ("1", Sim3(0.0, (0.1, 0.1, 0.0))),
    "1s": ("1", Sim3(0.0, (-10.25, 62.25, 0.0))),
    "3ne": ("3", Sim3(0.0, (0.1, 0.1, 0.0))),
}
UTEXAS_CELL = 0.05  # m, of the raster that line maps are drawn into
FRONT_GAP = 5.0  # m; narrower gaps in the outer walls don't lead outside (glass is not in the line maps)
LINES_MARGIN = 2 * FRONT_GAP  # m around a line map
WALL_CAVITY = 0.2  # m; what is narrower lies within a wall
LARGEST_LINE_MAP, UTEXAS_CELLS = 50 << 20, 50_000_000


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the names and makers of four pairs of a grid and a line map, and three of a grid and a part of it."""
    read = cache(partial(_read_grid, folder))
    for seed, floor in enumerate(INTO_LINES):
        yield f"gdc{floor}-lines", partial(_load_lines_pair, read, folder.parent / LINES_FOLDER, floor, seed)
    for seed, part in enumerate(INTO_WHOLE, len(INTO_LINES)):
        yield f"gdc{INTO_WHOLE[part][0]}-{part}", partial(_load_part_pair, read, part, seed)


def _load_lines_pair(read: Callable[[str], FlatMap], lines: Path, floor: str, seed: int) -> Pair:
    b = read_lines(lines / f"GDC{floor}" / f"GDC{floor}.vectormap.json")
    return _build_pair(f"gdc{floor}-lines", read(floor), b, INTO_LINES[floor].inverse(), "drawing", seed)


def _load_part_pair(read: Callable[[str], FlatMap], part: str, seed: int) -> Pair:
    floor, truth = INTO_WHOLE[part]
    return _build_pair(f"gdc{floor}-{part}", read(floor), read(part), truth, "laser2d", seed)


def _build_pair(name: str, a: FlatMap, b: FlatMap, truth: Sim3, sensor: str, seed: int) -> Pair:
    """Return a pair whose second map has the rooms of the first."""
    b = replace(b, rooms=tuple(transform_room(room, truth.inverse()) for room in a.rooms))
    return build_flat_pair(name, a, b, truth, ("laser2d", sensor), "utexas", "gdc", seed)


def _read_grid(folder: Path, name: str) -> FlatMap:
    """Return the grid of a floor, with the rooms of BWI where it has them."""
    path = folder / "maps" / "real" / name
    flat = read_flat(path / f"{name}.yaml")
    return replace(flat, rooms=_read_rooms(path / "locations.yaml", path / f"{name}.yaml")) if name in INTO_LINES else flat


def _read_rooms(path: Path, plan: Path) -> tuple[TrueRoom, ...]:
    """Read the rooms of a floor: their outlines are given in pixels from the map's upper left corner.

    Raises:
        InputError: missing or damaged file.
    """
    about = grid.read_yaml(plan)
    height = len(grid.read_image(about.image)[0])
    try:
        listed = yaml.safe_load(path.read_bytes())
        outlines = [np.array(p, float).reshape(-1, 2) for p in listed["polygons"]]
        named = list(zip(listed["locations"], outlines, strict=True))
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: has no list of locations with their polygons ({error}); copy it again") from error
    corner = np.array(about.origin[:2])
    metres = [(n, np.column_stack([p[:, 0], height - p[:, 1]]) * about.resolution + corner) for n, p in named if len(p) > 2]
    return tuple(TrueRoom(str(name), polygon[::-1], 0.0, WALL_HEIGHT) for name, polygon in metres)


def read_lines(path: Path) -> FlatMap:
    """Read a line map of UT-AMRL: walls as drawn, and the floor that they enclose.

    Raises:
        InputError: missing, damaged, or of an absurd size.
    """
    if not path.is_file() or path.stat().st_size > LARGEST_LINE_MAP:
        raise InputError(f"{path}: no such file, or far too large; check the folder")
    try:
        listed = json.loads(path.read_bytes())
        lines = np.array([[[s[p]["x"], s[p]["y"]] for p in ("p0", "p1")] for s in listed], float).reshape(-1, 2, 2)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: is not a line map, a list of {{p0: {{x, y}}, p1: {{x, y}}}} ({error})") from error
    low, high = lines.min(axis=(0, 1), initial=np.inf) - LINES_MARGIN, lines.max(axis=(0, 1), initial=-np.inf) + LINES_MARGIN
    if not len(lines) or not np.prod((high - low) / UTEXAS_CELL) < UTEXAS_CELLS:
        raise InputError(f"{path}: has no lines, or spans more than a building; copy it again")
    walls = _rasterize_lines(lines, low, high)
    return build_from_masks(
        walls[::-1], _find_floor(walls)[::-1], UTEXAS_CELL, (*low.tolist(), 0.0), rays=False, source=path.name
    )


def _rasterize_lines(lines: Array, low: Array, high: Array) -> Array:
    """Return (h, w) bool, lowest row first: cells on a line."""
    columns, rows = np.ceil((high - low) / UTEXAS_CELL).astype(int) + 1
    count = (np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) / UTEXAS_CELL * 2).astype(int) + 2
    t = np.concatenate([np.linspace(0, 1, n) for n in count])[:, None]
    points = np.repeat(lines[:, 0], count, axis=0) * (1 - t) + np.repeat(lines[:, 1], count, axis=0) * t
    cells = np.floor((points - low) / UTEXAS_CELL).astype(int)
    walls = np.zeros((int(rows), int(columns)), bool)
    walls[cells[:, 1], cells[:, 0]] = True
    return walls


def _find_floor(walls: Array) -> Array:
    """Return (h, w) bool: what lies between walls, without the cavities in them."""
    far = ndimage.distance_transform_edt(~walls) * UTEXAS_CELL
    closed = ndimage.binary_fill_holes(far <= FRONT_GAP / 2)
    inside = ndimage.distance_transform_edt(closed) * UTEXAS_CELL > FRONT_GAP / 2
    wide = (
        ndimage.distance_transform_edt(far <= WALL_CAVITY) * UTEXAS_CELL <= WALL_CAVITY
    )  # an opening: narrow gaps vanish, corners stay
    floor: Array = inside & ~walls & wide & ndimage.binary_propagation(inside & (far > WALL_CAVITY), mask=~walls)
    return floor
