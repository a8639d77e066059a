"""Maps made by hand, turned, scaled and with a room less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.scenes_map import building
from topomerge.types import Sim3, TopometricMap, VoxelGrid


def turned(map: TopometricMap, shift: tuple[float, float, float], scale: float = 1.0) -> tuple[TopometricMap, Sim3]:
    """The map turned by 90 degrees, moved and made larger; and T_ab, which brings it back."""
    width, edge = map.grid.shape[1] * map.grid.edge, map.grid.edge
    low = map.grid.origin
    turn = Sim3(np.pi / 2, (0.0, 0.0, 0.0), scale)
    corner = turn.apply(low[None])[0]
    x, y, z = np.array(shift) - corner + np.array([width * scale, 0.0, 0.0])
    there = Sim3(np.pi / 2, (float(x), float(y), float(z)), scale)

    def of(grid: VoxelGrid) -> tuple[VoxelGrid, np.ndarray]:
        c = grid.cells
        cells = np.stack([grid.shape[1] - 1 - c[:, 1], c[:, 0], c[:, 2]], axis=1)
        shape = (grid.shape[1], grid.shape[0], grid.shape[2])
        new = VoxelGrid.from_cells(cells, np.array(shift), edge * scale, shape, {"row": np.arange(len(cells))})
        return VoxelGrid(new.cells, new.origin, new.edge, new.shape), new.properties["row"]

    (grid, rows), (navigable, walked) = of(map.grid), of(map.navigable)
    rooms, edges, storeys = map.rooms.copy(), map.edges.copy(), map.storeys.copy()
    rooms["centroid"], edges["centre"] = there.apply(rooms["centroid"]), there.apply(edges["centre"])
    edges["direction"] = (edges["direction"] + np.pi / 2) % np.pi
    edges["width"] *= scale
    rooms["height"], rooms["area"] = rooms["height"] * scale, rooms["area"] * scale**2
    for name in ("floor", "ceiling"):
        storeys[name] = storeys[name] * scale + there.translation[2]
    other = replace(
        map, grid=grid, room=map.room[rows], navigable=navigable, navigable_room=map.navigable_room[walked],
        navigable_area=None, rooms=rooms, edges=edges, storeys=storeys, source="other.ply",
    )  # fmt: skip
    return other, there.inverse()


def uneven() -> TopometricMap:
    """Four rooms: of the fifth only the walls are there, so that the rooms have no symmetry."""
    return without(building(2), 3)


def without(map: TopometricMap, room: int) -> TopometricMap:
    """The map without one of its rooms."""
    new = np.arange(len(map.rooms)) - (np.arange(len(map.rooms)) > room)
    new[room] = -1
    labels = [np.where(r >= 0, new[r], -1).astype(np.int32) for r in (map.room, map.navigable_room)]
    edges = map.edges[(map.edges["rooms"] != room).all(axis=1)].copy()
    edges["rooms"] = new[edges["rooms"]]
    return replace(map, room=labels[0], navigable_room=labels[1], rooms=np.delete(map.rooms, room), edges=edges)
