"""Two maps under a pose -> squares of both from above, one on the other: what the evidence of a place is read from.

Floor that both maps saw is cut into tiles; the square of a tile is wider than it and is laid on the middle of what both saw of
it, so that a wall between two tiles is whole in one of them. Both maps are drawn in the axes of the first one's walls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.refinement import storeys_at
from topomerge.types import Array, Sim3

CROP_PIXEL = 0.1  # m
SIDE = 64  # pixels of a square
TILE = 48  # pixels of a tile
LEAST_SEEN = 2.0  # m2 of a tile that both maps saw; less says nothing
CEILINGS = (1.5, 0.02)  # m: the lowest ceiling that is told, and the step in which it is
PARTS = ("wall", "free", "clutter", "low", "middle", "high", "hanging", "ceiling")  # bits of the first byte of a pixel
ROOFED = 1 << PARTS.index("free") | 1 << PARTS.index("ceiling")  # bits of free floor under a ceiling
HEIGHTS = ((0.25, 0.75), (0.75, 1.5), (1.5, 2.0))  # m above the floor: low, middle, high
CROP_ARRAYS = ("parts", "ceiling", "looked", "middle", "area")
LOOKED = 5  # numbers that say what a map looked at: a slice?, the three heights, ceilings


@dataclass(frozen=True, eq=False)
class Crops:
    """Squares of two maps, k of them.

    Args:
        parts: (k, 2, SIDE, SIDE) uint8, bits named `PARTS`; of the first map and of the second one.
        ceiling: (k, 2, SIDE, SIDE) uint8, height of the ceiling above the floor in steps (`CEILINGS`), 0 where none was seen;
            those of the second map raised to those of the first one (`levelled`).
        looked: (k, 2, LOOKED) float32 of 0 and 1: what the maps looked at.
        middle: (k, 3) m, of the squares, in the first map's frame, on its floor.
        area: (k,) m2 of the tile that both maps saw.
    """

    parts: Array
    ceiling: Array
    looked: Array
    middle: Array
    area: Array

    @staticmethod
    def none() -> Crops:
        """No squares."""
        empty = np.zeros((0, 2, SIDE, SIDE), np.uint8)
        return Crops(empty, empty, np.zeros((0, 2, LOOKED), np.float32), np.zeros((0, 3)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.area)


def crops(a: Sequence[PlanFields], b: Sequence[PlanFields], pose: Sim3) -> Crops:
    """The squares of the storeys of two maps that lie on one level under a pose T_ab."""
    rows = [_of_storeys(v, w, pose) for v, w in storeys_at(a, b, pose.translation[2], pose.scale)]
    rows = [r for r in rows if len(r)]
    return Crops(*(np.concatenate([getattr(r, n) for r in rows]) for n in CROP_ARRAYS)) if rows else Crops.none()


def _of_storeys(v: PlanFields, w: PlanFields, pose: Sim3) -> Crops:
    main = v.main_direction
    axes = np.array([[np.cos(main), np.sin(main)], [-np.sin(main), np.cos(main)]])  # rows: the axes of the raster in a's frame
    low, size = _common_box(v.plan, w.plan, pose, axes)
    if (size < 1).any():
        return Crops.none()
    index = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij"), axis=-1)
    places = (low + (index + 0.5) * CROP_PIXEL) @ axes  # in a's frame
    back = pose.inverse()
    flat = places.reshape(-1, 2)
    there = back.apply(np.column_stack([flat, np.zeros(len(flat))]))[:, :2].reshape(places.shape)
    drawn = (_drawn(v, places, 1.0), _drawn(w, there, pose.scale))
    seen = np.asarray((drawn[0][0] & 7 > 0) & (drawn[1][0] & 7 > 0))
    middle, area = _tiles(seen)
    if not len(area):
        return Crops.none()
    drawn = (drawn[0], (drawn[1][0], levelled(drawn[1], drawn[0])))
    parts, ceiling = (np.stack([_cut(d[k], middle) for d in drawn], axis=1) for k in (0, 1))
    at = np.column_stack([(low + (middle + 0.5) * CROP_PIXEL) @ axes, np.full(len(middle), v.plan.floor_guess)])
    looked = np.stack([_looked(v.plan), _looked(w.plan)]).astype(np.float32)
    return Crops(parts, ceiling, np.repeat(looked[None], len(area), axis=0), at, area)


def _common_box(a: StoreyPlan, b: StoreyPlan, pose: Sim3, axes: Array) -> tuple[Array, Array]:
    """Lower corner, m in the raster's axes, and size, pixels, of the box that both plans reach into."""
    lows, highs = [], []
    for plan, move in ((a, Sim3()), (b, pose)):
        span = np.array(plan.wall.shape) * plan.edge
        corners = plan.origin + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * span
        at = move.apply(np.column_stack([corners, np.zeros(4)]))[:, :2] @ axes.T
        lows.append(at.min(axis=0))
        highs.append(at.max(axis=0))
    low = np.floor(np.max(lows, axis=0) / CROP_PIXEL) * CROP_PIXEL
    return low, np.ceil((np.min(highs, axis=0) - low) / CROP_PIXEL).astype(int)


def _drawn(fields: PlanFields, places: Array, scale: float) -> tuple[Array, Array]:
    """Bytes of parts and of ceilings of a plan at places (..., 2), m in its frame; its heights grow by `scale`."""
    p = fields.plan
    cells = np.floor((places - p.origin) / p.edge).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < p.wall.shape)).all(axis=-1))
    i, j = np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0)
    layers = [p.wall, p.free, p.clutter, *(p.occupied(*h) for h in HEIGHTS), fields.hung == 2, np.isfinite(p.ceiling)]
    packed = np.bitwise_or.reduce([layer.astype(np.uint8) << k for k, layer in enumerate(layers)])
    steps = np.clip(np.nan_to_num((scale * p.ceiling - CEILINGS[0]) / CEILINGS[1], nan=-1.0) + 1, 0, 255).astype(np.uint8)
    return np.where(inside, packed[i, j], 0).astype(np.uint8), np.where(inside, steps[i, j], 0).astype(np.uint8)


def levelled(layers: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Bytes of the ceilings of a map, raised by the median of what the other one's are above them on floor that is free in both:
    in the storey below another one, what a map takes for the ceiling may be the floor above."""
    both = (layers[0] & other[0] & ROOFED) == ROOFED
    if not both.any():
        return layers[1]
    lift = int(np.median(other[1][both].astype(int) - layers[1][both]))
    return np.where(layers[1] > 0, np.clip(layers[1].astype(int) + lift, 1, 255), 0).astype(np.uint8)


def _tiles(seen: Array) -> tuple[Array, Array]:
    """Middles (k, 2), pixels, of what both maps saw of each tile, and how much that is, m2; those of enough of it only."""
    at = np.argwhere(seen)
    across = seen.shape[1] // TILE + 1
    tile = at[:, 0] // TILE * across + at[:, 1] // TILE
    count = np.bincount(tile, minlength=1)
    many = np.flatnonzero(count * CROP_PIXEL**2 >= LEAST_SEEN)
    middle = np.column_stack([np.bincount(tile, at[:, k], minlength=1)[many] / count[many] for k in (0, 1)])
    return np.round(middle).astype(int), count[many] * CROP_PIXEL**2


def _cut(layer: Array, middle: Array) -> Array:
    """(k, SIDE, SIDE) of a layer around middles (k, 2), pixels; 0 beyond its border."""
    padded = np.pad(layer, SIDE // 2)
    return np.stack([padded[i : i + SIDE, j : j + SIDE] for i, j in middle])


def _looked(plan: StoreyPlan) -> Array:
    """(LOOKED,) is the plan a slice, at which of `HEIGHTS` did the map look, and did it see ceilings?"""
    heights = [plan.observed & plan.bands.mask(*h) != 0 for h in HEIGHTS]
    return np.array([plan.sliced, *heights, np.isfinite(plan.ceiling).any()], float)
