"""What a file of a map may declare: a damaged one must not take the memory or the time of a building that there is not."""

from __future__ import annotations

import numpy as np

from topomerge.types import Array, VoxelGrid

# The largest buildings have about 1,000 rooms, the tallest 163 storeys.
ROOM_LIMIT, STOREY_LIMIT = 5_000, 200
ROOM_COLUMNS, TOTAL_COLUMNS = 50_000_000, 100_000_000  # of the grid, in the rectangle around a room's floor, and around each
CONNECTION_LIMIT = 30_000  # of edges, areas, narrows, windows and fixtures each, however many rooms there are
EDGES_PER_ROOM, AREAS_PER_ROOM, WINDOWS_PER_ROOM, FIXTURES_PER_ROOM = 20, 20, 100, 100  # on average


def require_sane_counts(arrays: dict[str, Array]) -> None:
    """Refuses tables longer than the cells of the map can fill, before anything is done for each of their rows.

    Raises:
        ValueError: more rooms, edges, storeys, areas, narrows, windows or fixtures than a building has.
    """
    rooms, areas = arrays["rooms"].size, arrays["areas"].size
    cells = arrays["room"].size + arrays["navigable_room"].size
    limits = {
        "rooms": (ROOM_LIMIT, ""),
        "storeys": (STOREY_LIMIT, ""),
        "edges": (min(EDGES_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} a room)"),
        "areas": (min(AREAS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({AREAS_PER_ROOM} a room)"),
        "narrows": (min(EDGES_PER_ROOM * areas, CONNECTION_LIMIT), f" ({EDGES_PER_ROOM} an area)"),
        "windows": (min(WINDOWS_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({WINDOWS_PER_ROOM} a room)"),
        "fixtures": (min(FIXTURES_PER_ROOM * rooms, CONNECTION_LIMIT), f" ({FIXTURES_PER_ROOM} a room)"),
    }
    for name, (limit, share) in limits.items():
        words = share if limit < CONNECTION_LIMIT else ""
        if name in arrays and arrays[name].size > limit:
            raise ValueError(f"declares {arrays[name].size:,} {name}, more than {limit:,}{words}")
    if rooms > cells:
        raise ValueError(f"declares {rooms:,} rooms and has only {cells:,} cells")


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
