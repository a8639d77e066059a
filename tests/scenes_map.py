"""Maps made by hand, with known rooms and doors: for what reads, writes and draws maps."""

from __future__ import annotations

import numpy as np

from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, Array, TopometricMap, VoxelGrid

EDGE = 0.1
HEIGHT = 30  # cells from floor to floor
Box = tuple[int, int, int, int]  # x0, x1, y0, y1 of a room's inside, in cells, the upper ends left out


def boxes(pairs: int, width: int = 40, depth: int = 50, corridor: int = 18) -> list[Box]:
    """A corridor (the last box) between two rows of `pairs` rooms each."""
    found = []
    for i in range(pairs):
        x = 1 + i * (width + 1)
        found += [(x, x + width, 1, 1 + depth), (x, x + width, depth + corridor + 3, 2 * depth + corridor + 3)]
    return [*found, (1, pairs * (width + 1), depth + 2, depth + 2 + corridor)]


def _walls(layout: list[Box]) -> tuple[Array, Array]:
    """(nx, ny) room on each floor cell, -1 in walls; and the doors (k, 4): room, corridor, x, y."""
    plan = np.full((max(b[1] for b in layout) + 1, max(b[3] for b in layout) + 1), -1)
    for i, (x0, x1, y0, y1) in enumerate(layout):
        plan[x0:x1, y0:y1] = i
    hall = layout[-1]
    doors = []
    for i, (x0, x1, y0, _) in enumerate(layout[:-1]):
        x, y = (x0 + x1) // 2, hall[2] - 1 if y0 < hall[2] else hall[3]
        plan[x - 5 : x + 5, y] = len(layout) - 1
        doors.append((i, len(layout) - 1, x, y))
    return plan, np.array(doors)


def building(pairs: int = 1, storeys: int = 1, origin: tuple[float, float, float] = (2.0, -3.0, 0.5)) -> TopometricMap:
    """`storeys` floors of a corridor between two rows of rooms; the corridors are joined by stairs."""
    layout = boxes(pairs)
    plan, doors = _walls(layout)
    shape = (*plan.shape, storeys * HEIGHT + 1)
    solid = np.full(shape, False)
    solid[:, :, ::HEIGHT] = True
    solid[plan < 0] = True
    label = np.full(shape, -1)
    walk, walk_label = [], []
    for s in range(storeys):
        room = np.where(plan >= 0, plan + s * len(layout), -1)
        label[:, :, s * HEIGHT : (s + 1) * HEIGHT] = room[:, :, None]
        x, y = np.nonzero(plan >= 0)
        walk.append(np.stack([x, y, np.full(len(x), s * HEIGHT + 1)], axis=1))
        walk_label.append(room[x, y])
    cells = np.argwhere(solid).astype(np.int32)
    at = np.array(origin)
    grid = VoxelGrid.from_cells(cells, at, EDGE, shape, {"count": np.arange(len(cells)) % 7 + 1})
    paths = np.concatenate(walk)
    navigable = VoxelGrid.from_cells(paths, at, EDGE, shape, {"room": np.concatenate(walk_label)})
    room = label[tuple(grid.cells.T)].astype(np.int32)
    rooms = _rooms(layout, storeys, at, np.bincount(room[room >= 0], minlength=storeys * len(layout)))
    return TopometricMap(
        grid=grid,
        room=room,
        navigable=VoxelGrid(navigable.cells, at, EDGE, shape),
        navigable_room=navigable.properties["room"].astype(np.int32),
        rooms=rooms,
        edges=_edges(len(layout), doors, storeys, at, rooms),
        storeys=_storeys(rooms, storeys, at),
        source="building.ply",
        parameters={"voxel_size": EDGE, "preset": "default", "nothing": float("nan"), "kernel": [1, 2]},
        seconds={"read and voxelise": 0.25, "rooms": 0.5},
        warnings=("only a test",),
    )


def _rooms(layout: list[Box], storeys: int, at: Array, cells: Array) -> Array:
    rooms = np.zeros(len(layout) * storeys, ROOM_DTYPE)
    for i in range(len(rooms)):
        s, (x0, x1, y0, y1) = i // len(layout), layout[i % len(layout)]
        low, high = at + np.array([x0, y0, s * HEIGHT]) * EDGE, at + np.array([x1, y1, (s + 1) * HEIGHT]) * EDGE
        area, height = (x1 - x0) * (y1 - y0) * EDGE**2, (HEIGHT - 1) * EDGE
        seen = (0.3 if i == 0 else 1.0, i == 0, 0.9, 0.8, 0.2 if i == 0 else 0.95, 0.05)  # glimpsed, and the odds behind
        rooms[i] = (s, (low + high) / 2, area, height, area * height, low, high, cells[i], *seen)
    return rooms


def _edges(rooms_a_storey: int, doors: Array, storeys: int, at: Array, rooms: Array) -> Array:
    edges = np.zeros((len(doors) + 1) * storeys - 1, EDGE_DTYPE)
    k = 0
    for s in range(storeys):
        for a, b, x, y in doors:
            centre = at + (np.array([x, y + 0.5, s * HEIGHT + 1])) * EDGE
            kind = "opening" if a % 3 == 2 else "door"
            ends = (a + s * rooms_a_storey, b + s * rooms_a_storey)
            edges[k] = (ends, centre, 1.0, 2.0, np.pi / 2, kind, True, False, 1.0, centre, centre)
            k += 1
        if s:
            hall = (s + 1) * rooms_a_storey - 1
            edges[k] = ((hall - rooms_a_storey, hall), rooms["centroid"][hall], 1.2, 2.0, 0.0, "stairs", True, False, 1.0, 0, 0)
            edges["centre"][k, 0] += 3
            k += 1
    return edges


def _storeys(rooms: Array, storeys: int, at: Array) -> Array:
    table = np.zeros(storeys, STOREY_DTYPE)
    for s in range(storeys):
        floor = at[2] + (s * HEIGHT + 1) * EDGE
        ceiling = np.nan if s == storeys - 1 else floor + (HEIGHT - 1) * EDGE
        table[s] = (floor, ceiling, rooms["area"][rooms["storey"] == s].sum())
    return table


def same(a: TopometricMap, b: TopometricMap) -> bool:
    """Are two maps equal in everything?"""
    grids = [(a.grid, b.grid), (a.navigable, b.navigable)]
    if a.free is not None and b.free is not None:
        grids.append((a.free, b.free))
    arrays = [(a.room, b.room), (a.navigable_room, b.navigable_room), (a.edges, b.edges)]
    arrays += [(a.rooms, b.rooms), (a.storeys, b.storeys)]
    if a.provenance is not None and b.provenance is not None:
        arrays.append((a.provenance, b.provenance))
    arrays += [(a.landmarks.table, b.landmarks.table)]
    words = [repr((m.source, dict(m.parameters), list(m.seconds.items()), m.warnings)) for m in (a, b)]
    words = [f"{said} {m.landmarks.values} {m.landmarks.sources}" for said, m in zip(words, (a, b), strict=True)]
    return (
        all(_same_grid(x, y) for x, y in grids)
        and all(x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in arrays)
        and words[0] == words[1]
        and (a.free is None) == (b.free is None)
        and (a.provenance is None) == (b.provenance is None)
    )


def _same_grid(a: VoxelGrid, b: VoxelGrid) -> bool:
    return (
        a.cells.tobytes() == b.cells.tobytes()
        and a.origin.tobytes() == b.origin.tobytes()
        and (a.edge, a.shape, set(a.properties)) == (b.edge, b.shape, set(b.properties))
        and all(np.array_equal(a.properties[k], b.properties[k]) for k in a.properties)
    )
