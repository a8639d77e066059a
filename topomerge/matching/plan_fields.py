"""What poses are judged by: distances, faces and directions, drawn from the plan of a storey when they are first needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.kernels import align
from topomerge.types import Array

FREE_MARGIN = 0.25  # m that free ground keeps from anything standing
DISTANCE_CAP = 1.0  # m, of the distance fields
HEAD_HEIGHT = 2.0  # m above the floor
CEILING_SLACK = 0.15  # m below a ceiling that still are it
LINTEL_REACH = 0.5  # m from walls: nearer, what is above a head is part of the wall
TALL_HEIGHTS = (2.0, 2.5)  # m above the floor: little furniture is that high
DIRECTION_STEP = 0.5  # degrees, of the direction profile


@dataclass(frozen=True, eq=False)
class PlanFields:
    """A plan with what poses are judged by; made once a plan."""

    plan: StoreyPlan

    @cached_property
    def kind(self) -> Array:
        """(nx, ny) uint8: 0 unknown, 1 wall, 2 free, 3 clutter."""
        p = self.plan
        return (align.WALL_STATE * p.wall + align.FREE_STATE * p.free + align.CLUTTER_STATE * p.clutter).astype(np.uint8)

    @cached_property
    def to_wall(self) -> Array:
        """(nx, ny) float32 m to the nearest wall, at most `DISTANCE_CAP`."""
        return distance_to(self.plan.wall, self.plan.edge)

    @cached_property
    def field(self) -> tuple[Array, Array]:
        """`to_wall` with a rim of `DISTANCE_CAP`, and its corner, m: poses are drawn back from beyond the outer walls, too."""
        rim = int(np.ceil(DISTANCE_CAP / self.plan.edge))
        return distance_to(np.pad(self.plan.wall, rim), self.plan.edge), self.plan.origin - rim * self.plan.edge

    @cached_property
    def to_any(self) -> Array:
        """(nx, ny) float32 m to anything that stands."""
        return distance_to(self.plan.wall | self.plan.clutter, self.plan.edge)

    @cached_property
    def core(self) -> Array:
        """(nx, ny) bool: free ground `FREE_MARGIN` from anything that stands."""
        return self.plan.free & (self.to_any >= FREE_MARGIN)

    @cached_property
    def face(self) -> Array:
        """(nx, ny, 2) float32 unit vector towards empty space; 0 where both sides of a wall were seen, or none."""
        blurred = ndimage.gaussian_filter(self.plan.free.astype(np.float32), 0.25 / self.plan.edge)
        slope = np.stack(np.gradient(blurred), axis=-1)
        length = np.linalg.norm(slope, axis=-1, keepdims=True)
        return np.where(length > 0.02, slope / np.maximum(length, 1e-6), 0.0).astype(np.float32)

    @cached_property
    def walls(self) -> Array:
        """(n, 2) m."""
        return self.plan.points(self.plan.wall)

    @cached_property
    def directions(self) -> Array:
        """(n,) rad in [0, pi): of the wall that each column of `walls` belongs to."""
        image = ndimage.gaussian_filter(self.plan.wall.astype(np.float32), 0.15 / self.plan.edge)
        x, y = np.gradient(image)
        double = (x + 1j * y) ** 2
        smooth = [ndimage.gaussian_filter(part, 0.3 / self.plan.edge)[self.plan.wall] for part in (double.imag, double.real)]
        out: Array = (np.arctan2(*smooth) / 2 + np.pi / 2) % np.pi
        return out

    @cached_property
    def tall(self) -> Array:
        """(n,) bool: is the wall higher than furniture? All are where the map did not look that high."""
        mask = self.plan.profile.dtype.type(self.plan.bands.mask(*TALL_HEIGHTS))
        tall: Array = (self.plan.profile[self.plan.wall] & mask) == mask
        return tall if tall.mean() > 0.25 else np.ones_like(tall)

    @cached_property
    def hung(self) -> Array:
        """(nx, ny) uint8: 2 where something hangs below the ceiling and above a head, 1 where nothing does, 0 where no ceiling
        was seen or a wall or the lintel of a door is near."""
        p = self.plan
        step, below = p.bands.step, p.bands.below
        ceiling = np.nan_to_num(p.ceiling_height, nan=-1e3) - CEILING_SLACK - p.floor_height
        top = np.floor((ceiling + below * step) / step)  # the first band that may be the ceiling's
        head = round(HEAD_HEIGHT / step) + below
        seen = np.isfinite(p.ceiling) & p.free & (top > head) & (self.to_wall >= LINTEL_REACH)
        under = np.left_shift(np.uint32(1), np.clip(top, 0, 31).astype(np.uint32)) - np.uint32(1)
        hanging = (p.profile & under & ~np.uint32((1 << head) - 1)) > 0
        out: Array = (seen * (1 + hanging)).astype(np.uint8)
        return out

    @cached_property
    def middle(self) -> Array:
        """(2,) m, of the walls."""
        return self.walls.mean(axis=0) if len(self.walls) else self.plan.points(self.plan.explored).mean(axis=0)

    @cached_property
    def profile(self) -> Array:
        """(360,) how sharply the walls line up along each direction, in steps of half a degree over half a turn."""
        return direction_profile(self.walls, self.plan.edge)

    @property
    def main_direction(self) -> float:
        """rad in [0, pi): the direction along which the walls line up most sharply."""
        return float(np.radians(float(self.profile.argmax()) * DIRECTION_STEP))


def distance_to(mask: Array, edge: float) -> Array:
    """(nx, ny) float32 m from the middle of each column to the nearest masked one, at most `DISTANCE_CAP`."""
    import edt

    if not mask.any():
        return np.full(mask.shape, DISTANCE_CAP, np.float32)
    return np.minimum(edt.edt(~mask, anisotropy=(edge, edge)), DISTANCE_CAP).astype(np.float32)


def direction_profile(walls: Array, edge: float, most: int = 6000) -> Array:
    """(360,) float64: for each direction in steps of 0.5 degrees, how much the walls' projection across it is heaped up."""
    if not len(walls):
        return np.zeros(int(180 / DIRECTION_STEP))
    rng = np.random.default_rng(0)
    points = walls if len(walls) <= most else walls[rng.permutation(len(walls))[:most]]
    points = points - points.mean(axis=0) + rng.uniform(-edge / 2, edge / 2, points.shape)  # else the raster lines up at 0 and 90
    angles = np.radians(np.arange(0, 180, DIRECTION_STEP))
    across = points @ np.stack([-np.sin(angles), np.cos(angles)])
    rows = np.floor(across / 0.2).astype(np.int64)
    rows -= rows.min()
    width = int(rows.max()) + 1
    flat = (rows + np.arange(len(angles)) * width).ravel()
    heaps = np.bincount(flat, minlength=len(angles) * width).reshape(len(angles), width).astype(float)
    sharp: Array = (heaps**2).sum(axis=1) / len(points)
    return np.clip(sharp - np.median(sharp), 0, None)
