"""How much of a room was seen: the share of its outline that ends at a wall, not at the edge of what is known."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.extraction.convolution import Kernel, is_any_at
from topomerge.types import Array, VoxelGrid, select_lowest_of_column

STEP_HEIGHT = 0.3  # m: floor beside a cell may be this much higher or lower
WALL_SIGHT = (0.3, 1.5)  # m above the floor: where a wall has to be seen
PLAN_WALL_REACH = 0.15  # m: between a floor and its wall in a plan
WALL_DISTANCE = 0.25  # m beyond the body's half width


def measure_seen_outline(room: Array, inside: Array, wall: Array, edge: float) -> Array:
    """Return (R,) share of each room's outline beside which a wall stands, from the plan of a storey.

    Args:
        room: (nx, ny) room of each column, -1 none.
        inside: (nx, ny) bool, open columns; those of another room are no end: the floor goes on.
        wall: (nx, ny) bool.
        edge: of a column, m.
    """
    count = int(room.max(initial=-1)) + 1
    reach = max(round(PLAN_WALL_REACH / edge), 1)
    near = ndimage.binary_dilation(wall, np.ones((2 * reach + 1, 2 * reach + 1)))
    outline = (room >= 0) & ndimage.binary_dilation(~inside)
    total = np.bincount(room[outline], minlength=count)
    seen = np.bincount(room[outline & near], minlength=count)
    return np.where(total > 0, seen / np.maximum(total, 1), 1.0)


def measure_completeness(grid: VoxelGrid, navigable: VoxelGrid, label: Array, count: int, body: float) -> Array:
    """Return (count,) share of each room's outline at which a wall was seen; 1 for a room without an end of its own.

    The outline are the floor cells beside which nobody can stand. A door to another room is no end: the floor goes on.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        label: (m,) room of each of its cells, -1 none.
        count: number of rooms.
        body: width (m) of the body that the navigable volume was made for.
    """
    floor = select_lowest_of_column(navigable)
    floor = floor[label[floor] >= 0]
    cells = navigable.cells[floor].astype(np.int64)
    step = int(STEP_HEIGHT / grid.edge)
    end = np.zeros(len(floor), bool)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        goes_on = np.zeros(len(floor), bool)
        for dz in range(-step, step + 1):
            goes_on |= navigable.contains(cells + (dx, dy, dz))
        end |= ~goes_on
    walled = is_any_at(grid, cells[end], _build_wall_kernel(grid.edge, body))
    room = label[floor][end]
    total = np.bincount(room, minlength=count)
    seen = np.bincount(room, walled, minlength=count)
    return np.where(total > 0, seen / np.maximum(total, 1), 1.0)


def _build_wall_kernel(edge: float, body: float) -> Kernel:
    """Build the kernel of where the wall beside the outline of a floor may stand."""
    reach = int(np.ceil((body / 2 + WALL_DISTANCE) / edge))
    steps = np.arange(-reach, reach + 1)
    heights = np.arange(int(WALL_SIGHT[0] / edge), int(WALL_SIGHT[1] / edge) + 1)
    return Kernel.from_offsets(np.stack(np.meshgrid(steps, steps, heights, indexing="ij"), -1).reshape(-1, 3))
