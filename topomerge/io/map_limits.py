"""What a file of a map may declare: a damaged one must not take the memory or the time of a building that there is not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.io.archive import Head
from topomerge.types import Array, VoxelGrid

# The largest buildings have about 1,000 rooms, the tallest 163 storeys.
ROOM_LIMIT, STOREY_LIMIT = 5_000, 200
ROOM_COLUMNS, TOTAL_COLUMNS = 50_000_000, 100_000_000  # of the grid, in the rectangle around a room's floor, and around each
CONNECTION_LIMIT = 30_000  # of edges, areas, narrows and windows each, however many rooms there are
EDGES_PER_ROOM, AREAS_PER_ROOM, WINDOWS_PER_ROOM = 20, 20, 100  # on average
ABOUT_LIMIT = 1 << 24  # bytes of what a map says about itself
PROPERTY_WIDTH = 64  # numbers of one property in a cell
CELL_ARRAYS = {"grid": ("room", "provenance"), "navigable": ("navigable_room", "navigable_area"), "free": ()}  # a row for each


def require_sane_counts(heads: Mapping[str, Head]) -> None:
    """Refuses what the arrays of a map declare, before any of them is unpacked: tables longer than the cells can fill, and rows
    of cells that there are not.

    Raises:
        KeyError: an array is missing.
        ValueError: more rooms, edges, storeys, areas, narrows or windows than a building has; more or fewer rows of a property
            than cells; words that no map says.
    """
    rooms, areas = heads["rooms"].size, heads["areas"].size
    cells = heads["room"].size + heads["navigable_room"].size
    limits = {
        "rooms": (ROOM_LIMIT, ""),
        "storeys": (STOREY_LIMIT, ""),
        "edges": (min(EDGES_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} a room)"),
        "areas": (min(AREAS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({AREAS_PER_ROOM} a room)"),
        "narrows": (min(EDGES_PER_ROOM * areas, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} an area)"),
        "windows": (min(WINDOWS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({WINDOWS_PER_ROOM} a room)"),
    }
    for name, (limit, share) in limits.items():
        words = share if limit < CONNECTION_LIMIT else ""
        if name in heads and heads[name].size > limit:
            raise ValueError(f"declares {heads[name].size:,} {name}, more than {limit:,}{words}")
    if rooms > cells:
        raise ValueError(f"declares {rooms:,} rooms and has only {cells:,} cells")
    if heads["about"].size * heads["about"].dtype.itemsize > ABOUT_LIMIT:
        raise ValueError(f"says more than {ABOUT_LIMIT >> 20} MB about itself")
    _require_rows(heads)


def _require_rows(heads: Mapping[str, Head]) -> None:
    """Refuses arrays that have not one row for each cell, or more numbers in one than any property has."""
    for grid, of_cells in CELL_ARRAYS.items():
        if f"{grid}_cells" not in heads:
            continue
        count = heads[f"{grid}_cells"].size
        named = [name for name in heads if name in of_cells or name.startswith(f"{grid}_property.")]
        for name in named:
            shape = heads[name].shape
            if shape[:1] != (count,):
                raise ValueError(f"{name} has the shape {shape} for {count:,} cells")
            if heads[name].size > PROPERTY_WIDTH * count:
                raise ValueError(f"{name} has {heads[name].size // max(count, 1):,} numbers a cell, more than {PROPERTY_WIDTH}")


def require_compact_rooms(navigable: VoxelGrid, room: Array, rooms: int) -> None:
    """Refuses rooms whose floor is strewn over the map: what draws a room goes through the rectangle around it.

    Raises:
        ValueError: the rectangles have more columns than those of a building.
    """
    inside = (room >= 0) & (room < rooms)
    low, high = np.full((rooms, 2), np.iinfo(np.int64).max), np.full((rooms, 2), -1)
    columns = navigable.cells[inside, :2].astype(np.int64)
    np.minimum.at(low, room[inside], columns)
    np.maximum.at(high, room[inside], columns)
    sizes = np.where(high[:, 0] >= 0, np.prod(np.where(high >= 0, high - low + 1, 0), axis=1, dtype=np.float64), 0.0)
    if sizes.max(initial=0) > ROOM_COLUMNS or sizes.sum() > TOTAL_COLUMNS:
        raise ValueError(f"has rooms that span {sizes.sum():.2g} columns of cells, the largest {sizes.max():.2g}")
