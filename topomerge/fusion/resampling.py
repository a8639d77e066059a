"""Cells of a moved, perhaps bent map on the lattice of another one.

A cell of the lattice is occupied where its middle lies in a cell of the moved map, and where the middle of a cell of the moved
map lies in it. So no cell is lost, and a turned or bent floor or wall gets no holes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from topomerge.fusion.bend.deformation import BETWEEN_STOREYS, Deformation
from topomerge.kernels import morton
from topomerge.types import Array, Sim3, VoxelGrid

RESAMPLED_AT_ONCE = 200_000  # cells
CODE_OFFSET = 1 << 20  # cells are counted from there, as Morton codes hold no negative ones


@dataclass(frozen=True, eq=False)
class Laying:
    """How a map is laid into the frame of another one: bent in its own, then posed.

    Args:
        pose: of the map in the other frame.
        bend: None: rigid.
    """

    pose: Sim3
    bend: Deformation | None = None

    @staticmethod
    def of(pose: Sim3, bend: Deformation | None) -> Laying:
        """Bent only where the deformation moves anything."""
        return Laying(pose, bend if bend is not None and len(bend) and bend.moves.any() else None)

    def apply(self, points: Array) -> Array:
        """Points (n, 3) of the map in the other frame."""
        return self.pose.apply(points if self.bend is None else self.bend.apply(points))

    def undo(self, points: Array) -> Array:
        """The places (n, 3) of the map that are laid on points (n, 3) of the other frame."""
        back = self.pose.inverse().apply(points)
        return back if self.bend is None else self.bend.undo(back)

    def undo_near(self, points: Array, places: Array, laid: Array) -> Array:
        """`undo` of points within a cell of places whose images `laid` are at hand: one step of the fixed point from there, and
        one more, leave less than a hundredth of a cell."""
        back = self.pose.inverse()
        at = back.apply(points)
        if self.bend is None:
            return at
        shift = back.apply(laid)[:, :2] - places[:, :2]
        guess = at.copy()
        guess[:, :2] -= shift
        out: Array = guess + at - self.bend.apply(guess)
        return out

    @property
    def stretch(self) -> float:
        """By what factor a length in the plane grows at most, the scale of the pose apart."""
        steep = [0.0]
        for field in self.bend.fields if self.bend is not None else ():
            if field is not None:
                steep += [float(np.linalg.norm(np.diff(field.shifts, axis=k), axis=-1).max()) / field.step for k in (0, 1)]
        return 1.0 + float(np.hypot(*sorted(steep)[-2:])) if len(steep) > 1 else 1.0

    def slant(self, edge: float) -> float:
        """m in the plane by which the ends of a cell as high as `edge` part from its middle, between storeys that move apart."""
        if self.bend is None or len(self.bend.floors) < 2:
            return 0.0
        farthest = max(float(np.linalg.norm(f.shifts, axis=-1).max()) for f in self.bend.fields if f is not None)
        return 2 * farthest * min(edge / (2 * BETWEEN_STOREYS), 1.0)


def resampled(grid: VoxelGrid, laying: Laying | Sim3, origin: Array, edge: float) -> tuple[Array, Array]:
    """Cells (n, 3) int64 of a lattice that the moved cells of a grid fill, and the row (n,) of one that does.

    Args:
        laying: of the grid in the frame of the lattice.
        origin: (3,) m, corner of the lattice's cell (0, 0, 0); cells may be negative.
        edge: of the lattice's cells, m.
    """
    laying = Laying(laying) if isinstance(laying, Sim3) else laying
    offset = (grid.origin - origin) / edge
    aligned = abs(grid.edge - edge) < 1e-9 and np.allclose(offset, np.round(offset), atol=1e-6)
    if aligned and laying.bend is None and laying.pose == Sim3():
        return grid.cells + np.round(offset).astype(np.int64), np.arange(len(grid))
    blocks = list(_resampled_blocks(grid, laying, origin, edge))
    if not blocks:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    cells = np.concatenate([c for c, _ in blocks])
    rows = np.concatenate([r for _, r in blocks])
    _, first = np.unique(encoded(cells), return_index=True)
    return cells[first], rows[first]


def _resampled_blocks(grid: VoxelGrid, laying: Laying, origin: Array, edge: float) -> Iterator[tuple[Array, Array]]:
    """`resampled` of some cells at a time; cells may come twice."""
    ratio = laying.pose.scale * grid.edge / edge
    wide = ratio * laying.stretch * np.sqrt(0.5) + laying.pose.scale * laying.slant(grid.edge) / edge
    wide, tall = int(wide + 0.5), int(ratio / 2 + 0.5)  # how far a cell reaches from the one its middle is in
    flat = range(-wide, wide + 1)
    around = np.array(list(product(flat, flat, range(-tall, tall + 1))))
    for start in range(0, len(grid), RESAMPLED_AT_ONCE):
        places = grid.centroids(grid.cells[start : start + RESAMPLED_AT_ONCE])
        middles = laying.apply(places)
        holding = np.floor((middles - origin) / edge).astype(np.int64)  # the cells that the middles lie in
        cells = (holding[:, None] + around).reshape(-1, 3)
        first = np.unique(encoded(cells), return_index=True)[1]
        cells, near = cells[first], first // len(around)
        at = laying.undo_near(origin + (cells + 0.5) * edge, places[near], middles[near])
        rows = grid.rows(grid.locate(at))
        yield cells[rows >= 0], rows[rows >= 0]
        yield holding, np.arange(start, start + len(holding))


def encoded(cells: Array) -> Array:
    """(n,) uint64, one code for each cell within a million of the origin."""
    return morton.encode((cells + CODE_OFFSET).astype(np.int32))


def decoded(codes: Array) -> Array:
    """(n, 3) int64, the cells of `encoded`."""
    cells: Array = morton.decode(codes).astype(np.int64) - CODE_OFFSET
    return cells
