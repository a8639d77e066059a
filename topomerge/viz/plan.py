"""What a plan shows, as rasters: for each storey the rooms seen from above and the walls cut at a height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from topomerge.types import Array, TopometricMap

CUT = (1.0, 1.9)  # m above the floor: what fills this band is drawn as wall, as architects cut a plan
WALL_SHARE = 0.5  # share of the band that must be occupied
MAX_PIXELS = 1500  # along an axis; cells of larger buildings are drawn together


@dataclass(frozen=True, eq=False)
class Frame:
    """Pixels over the building: pixel (i, j) covers x from low[0] + i * size."""

    low: Array  # (2,) m, in the input's frame
    size: float  # m
    shape: tuple[int, int]
    first: Array  # (2,) the cell at pixel (0, 0)
    step: int  # cells a pixel, along an axis

    @property
    def high(self) -> Array:
        """(2,) the far corner, m."""
        return self.low + np.asarray(self.shape) * self.size

    def pixels(self, cells: Array) -> Array:
        """(n, 2) pixels of (n, 3) cells."""
        return (cells[:, :2] - self.first) // self.step

    def centre(self, pixel: Array) -> Array:
        """(..., 2) middle of pixels, m."""
        return self.low + (np.asarray(pixel) + 0.5) * self.size


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """One storey from above."""

    room: Array  # (nx, ny) int32 room of each pixel, -1 none
    floor: Array  # (nx, ny) bool: something is there, of a room or not
    wall: Array  # (nx, ny) bool


def frame_of(map: TopometricMap) -> Frame:
    """Pixels over all cells of the map, as many cells each as it takes to stay below `MAX_PIXELS`."""
    cells = np.concatenate([map.grid.cells, map.navigable.cells])[:, :2]
    if not len(cells):
        cells = np.zeros((1, 2), np.int32)
    first, last = cells.min(axis=0), cells.max(axis=0)
    step = int(np.ceil((last - first + 1).max() / MAX_PIXELS))
    nx, ny = ((last - first) // step + 1).tolist()
    return Frame(map.grid.origin[:2] + first * map.grid.edge, step * map.grid.edge, (nx, ny), first, step)


def storey_plans(map: TopometricMap, frame: Frame) -> list[StoreyPlan]:
    """A plan of each storey, lowest first; one plan of everything where the map has no storeys."""
    count = max(len(map.storeys), 1)
    occupied = np.maximum(map.storey_of_cells(), 0)
    walked = np.where(map.navigable_room >= 0, map.rooms["storey"][map.navigable_room], -1) if len(map.rooms) else None
    return [_plan(map, frame, s, occupied == s, None if walked is None else walked == s) for s in range(count)]


def _plan(map: TopometricMap, frame: Frame, storey: int, of_storey: Array, walked: Array | None) -> StoreyPlan:
    cells, labels = map.grid.cells[of_storey], map.room[of_storey]
    at = frame.pixels(cells)
    floor = np.zeros(frame.shape, bool)
    floor[at[:, 0], at[:, 1]] = True
    room = np.full(frame.shape, -1, np.int32)
    inside = labels >= 0
    room[at[inside, 0], at[inside, 1]] = labels[inside]
    if walked is not None:  # where one walks is surer than what hangs over it
        x, y = frame.pixels(map.navigable.cells[walked]).T
        room[x, y] = map.navigable_room[walked]
        floor[x, y] = True
    return StoreyPlan(room, floor, _walls(map, frame, storey, cells, at))


def _walls(map: TopometricMap, frame: Frame, storey: int, cells: Array, at: Array) -> Array:
    """(nx, ny) bool: the cut of the storey, at heights above its floor."""
    if not len(cells):
        return np.zeros(frame.shape, bool)
    lowest = map.grid.origin[2] + cells[:, 2].min() * map.grid.edge
    floor = float(map.storeys["floor"][storey]) if storey < len(map.storeys) else lowest
    height = map.grid.origin[2] + (cells[:, 2] + 0.5) * map.grid.edge - floor
    cut = at[(height >= CUT[0]) & (height < CUT[1])]
    filled = np.zeros(frame.shape, np.int64)
    np.add.at(filled, (cut[:, 0], cut[:, 1]), 1)
    # A pixel of step x step cells shows a wall that is one cell wide.
    return filled >= max(WALL_SHARE * (CUT[1] - CUT[0]) / map.grid.edge * frame.step, 1)


@dataclass(frozen=True)
class Place:
    """Where the name of a room stands: well inside it, near its middle."""

    x: float  # m
    y: float
    clear: float  # m to the nearest edge of the room's area


def places(plan: StoreyPlan, frame: Frame) -> dict[int, Place]:
    """Room -> the point of its area with most space around it; of nearly equal ones the nearest to the middle."""
    of_rooms = {}
    for i, box in enumerate(ndimage.find_objects(plan.room + 1)):
        if box is None:
            continue
        mask = np.pad((plan.room[box] == i) & ~plan.wall[box], 1)
        if not mask.any():
            mask = np.pad(plan.room[box] == i, 1)
        space = ndimage.distance_transform_edt(mask)
        options = np.argwhere(space >= 0.85 * space.max())
        middle = np.argwhere(mask).mean(axis=0)
        best = options[np.argmin(((options - middle) ** 2).sum(axis=1))]
        x, y = frame.centre(best - 1 + np.array([box[0].start, box[1].start])).tolist()
        of_rooms[i] = Place(x, y, float(space[tuple(best)]) * frame.size)
    return of_rooms
