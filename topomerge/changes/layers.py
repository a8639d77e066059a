"""One storey of two maps on one raster: what stands, what is empty, what nobody saw, and how far off walls are that stayed.

Both maps are drawn in the axes of the frame of the old one. A place is compared only where both maps saw it: what one of them
did not see is neither new nor gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import shapely
from scipy import ndimage

from topomerge.extraction.plans.storey_plan import BODY_HEIGHTS, StoreyPlan
from topomerge.matching.poses import PlanFields, pair_storeys
from topomerge.registration.storeys import build_plans, is_extruded
from topomerge.types import Array, Placement, Sim3, TopometricMap

CHANGE_CELL = 0.05  # m
FLOOR_BAND = (-0.25, 0.25)  # m above the floor
LOW_BAND, MANY_BANDS = (0.25, 1.0), 4  # m above the floor, where furniture stands; of 0.25 m that other things fill
HIGH_BAND = (2.25, 2.5)  # m above the floor: walls reach up to there, cupboards do not
MISFIT_REACH = 0.4  # m: walls that are farther apart are not one wall that is a little off
MISFIT_WINDOW = 2.0  # m, standard deviation of the window over which misfit is averaged
WALL_RUN = 0.75  # m of wall that tell which way it runs
MISFIT_PRIOR = (0.03, 40.0)  # m, and of how many columns' weight: the misfit where few walls tell it
MISFITS = 2.0  # times the misfit, and cells, are no change
LEAST_SLACK, MOST_SLACK = 0.12, 0.6  # m
FAR = 10.0  # m, of distances where nothing stands


class PlacedMap(Protocol):
    """A transform of points (n, 3) of the new map into the frame of the old one, and back; `types.Placement` is one."""

    @property
    def pose(self) -> Sim3:
        """Its rigid part."""

    def transform_points(self, points: Array) -> Array:
        """Take points of the new map into the old one's frame."""

    def invert_points(self, points: Array) -> Array:
        """Undo that."""


@dataclass(frozen=True, eq=False)
class RelativePlacement:
    """A map in the frame of another one, where both have been placed (and bent) in a third frame."""

    old: Placement
    new: Placement

    @property
    def pose(self) -> Sim3:
        """Its rigid part."""
        return self.old.pose.inverse() @ self.new.pose

    def transform_points(self, points: Array) -> Array:
        """Take points (n, 3) m of the new map into the old one's frame."""
        return self.old.invert_points(self.new.transform_points(points))

    def invert_points(self, points: Array) -> Array:
        """Undo that."""
        return self.new.invert_points(self.old.transform_points(points))


@dataclass(frozen=True, eq=False)
class MapLayer:
    """Rasters (nx, ny) of a storey as one map shows it.

    Args:
        wall, standing, tall: bool; a wall by the rule of plans, anything at the height of a body, and what reaches `HIGH_BAND`.
        thing: bool; what stands on the floor or fills several heights: points between two surfaces hang in the air.
        filled: bool; half of the heights of a body, at least.
        free, clear: bool; empty ground under a ceiling or on a floor, and such whose floor was seen.
        room: int32 room of the map, -1 none.
        entered: float, probability that the map was made from within the room of a pixel, 0 outside rooms.
        top: m above the floor, of what stands.
        furnished: does the map show furniture at all? Drawings and slices do not.
        edge: m of a cell of the map.
    """

    wall: Array
    standing: Array
    tall: Array
    thing: Array
    filled: Array
    free: Array
    clear: Array
    room: Array
    entered: Array
    top: Array
    furnished: bool
    edge: float

    @cached_property
    def to_wall(self) -> Array:
        """(nx, ny) m to the nearest wall."""
        return measure_distance(self.wall)

    @cached_property
    def to_standing(self) -> Array:
        """(nx, ny) m to the nearest thing of any kind."""
        return measure_distance(self.standing)


@dataclass(frozen=True, eq=False)
class StoreyLayers:
    """One storey of both maps on one raster; pixel (0, 0) begins at `low`.

    Args:
        low: (2,) m, in the axes of the raster.
        axes: (2, 2) rows are the raster's axes in the old map's frame.
        floor: m, height of the floor in the old map's frame.
        storeys: number of the storey in the old and in the new map.
        old, new: what the maps show.
        slack: (nx, ny) m: what is off by less is no change (the noise of cells, registration and drift).
    """

    low: Array
    axes: Array
    floor: float
    storeys: tuple[int, int]
    old: MapLayer
    new: MapLayer
    slack: Array

    @property
    def both(self) -> Array:
        """(nx, ny) bool: what both maps saw."""
        out: Array = (self.old.free | self.old.standing) & (self.new.free | self.new.standing)
        return out

    def compute_points(self, pixels: Array) -> Array:
        """Compute (n, 3) m in the old map's frame of pixels (n, 2), on the floor."""
        flat = (self.low + (np.asarray(pixels, np.float64) + 0.5) * CHANGE_CELL) @ self.axes
        return np.column_stack([flat, np.full(len(flat), self.floor)])

    def compute_pixels(self, points: Array) -> Array:
        """Compute (n, 2) int64 pixels of points (n, 2+) m in the old map's frame; they may lie outside."""
        flat = np.asarray(points, np.float64)[:, :2] @ self.axes.T
        return np.floor((flat - self.low) / CHANGE_CELL).astype(np.int64)

    def sample(self, raster: Array, points: Array, outside: float = 0) -> Array:
        """Sample a raster at points (n, 2+) m in the old map's frame."""
        at = self.compute_pixels(points)
        inside = np.asarray(((at >= 0) & (at < raster.shape)).all(axis=1))
        i, j = np.where(inside[:, None], at, 0).T
        out: Array = np.where(inside, raster[i, j], outside)
        return out

    def rasterise(self, shape: shapely.Polygon) -> Array:
        """Draw (nx, ny) bool of a polygon in m in the old map's frame."""
        out = np.zeros(self.slack.shape, bool)
        corners = self.compute_pixels(np.asarray(shape.exterior.coords))
        low, high = corners.min(axis=0).clip(0), (corners.max(axis=0) + 1).clip(0)
        index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1)
        index = index.reshape(-1, 2)
        index = index[(index < out.shape).all(axis=1)]
        if len(index) and len(corners) > 3:
            out[tuple(index[shapely.contains_xy(shapely.Polygon(corners), *index.T.astype(float))].T)] = True
        return out


def measure_distance(mask: Array) -> Array:
    """Return (nx, ny) float32 m to the nearest pixel of a mask."""
    if not mask.any():
        return np.full(mask.shape, FAR, np.float32)
    return (ndimage.distance_transform_edt(~mask) * CHANGE_CELL).astype(np.float32)


def build_storey_layers(old: TopometricMap, new: TopometricMap, placement: PlacedMap) -> list[StoreyLayers]:
    """Draw the storeys that both maps have on common rasters, lowest first.

    Args:
        old, new: any maps.
        placement: takes the new map into the frame of the old one.

    Raises:
        InputError: an empty map.
    """
    plans = [[PlanFields(p) for p in build_plans(m)] for m in (old, new)]
    pose = placement.pose
    pairs = pair_storeys(plans[0], plans[1], pose.translation[2], pose.scale)
    furnished = [not is_extruded(m.grid) and not any(f.plan.sliced for f in p) for m, p in zip((old, new), plans, strict=True)]
    out = []
    for v, w in pairs:
        low, size, axes = _find_common_box(v, w.plan, placement)
        if (size < 2).any():
            continue
        index = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij"), axis=-1).reshape(-1, 2)
        places = (low + (index + 0.5) * CHANGE_CELL) @ axes
        height = np.full(len(places), v.plan.floor_guess)
        placed = placement.invert_points(np.column_stack([places, height]))
        shape, observed = (int(size[0]), int(size[1])), v.plan.observed & w.plan.observed
        a = _draw_map(old, v.plan, places, shape, observed, furnished[0])
        b = _draw_map(new, w.plan, placed[:, :2], shape, observed, furnished[1])
        storeys = _find_storey(old, v.plan.floor_guess), _find_storey(new, w.plan.floor_guess)
        slack = estimate_slack(a, b, pose.scale)
        out.append(StoreyLayers(low, axes, float(v.plan.floor_guess), storeys, a, b, slack))
    return out


def _find_storey(map: TopometricMap, floor: float) -> int:
    return int(np.abs(map.storeys["floor"] - floor).argmin()) if len(map.storeys) else 0


def _find_common_box(v: PlanFields, other: StoreyPlan, placement: PlacedMap) -> tuple[Array, Array, Array]:
    """Return the lower corner, m, size, pixels, and axes of the box that both plans reach into, along the walls of the old
    one."""
    main = v.main_direction
    axes = np.array([[np.cos(main), np.sin(main)], [-np.sin(main), np.cos(main)]])
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    first = v.plan.origin + corners * np.array(v.plan.wall.shape) * v.plan.edge
    flat = other.origin + corners * np.array(other.wall.shape) * other.edge
    second = placement.transform_points(np.column_stack([flat, np.full(4, other.floor_guess)]))[:, :2]
    spans = [(at @ axes.T).min(axis=0) for at in (first, second)], [(at @ axes.T).max(axis=0) for at in (first, second)]
    low = np.floor(np.max(spans[0], axis=0) / CHANGE_CELL) * CHANGE_CELL
    size = np.ceil((np.min(spans[1], axis=0) - low) / CHANGE_CELL).astype(int)
    return low, np.maximum(size, 0), axes


def _draw_map(
    map: TopometricMap, plan: StoreyPlan, places: Array, shape: tuple[int, int], observed: int, furnished: bool
) -> MapLayer:
    """Look a map's plan up at places (n, 2) m in its frame; only heights that both maps looked at count."""
    cells = np.floor((places - plan.origin) / plan.edge).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < plan.wall.shape)).all(axis=1))
    i, j = np.where(inside[:, None], cells, 0).T
    mask = plan.profile.dtype.type(observed)
    bodies = max((observed & plan.bands.build_mask(*BODY_HEIGHTS)).bit_count(), 1)
    body = plan.profile & mask & plan.profile.dtype.type(plan.bands.build_mask(*BODY_HEIGHTS))
    standing = (body != 0) | plan.wall
    floor = plan.is_occupied(*FLOOR_BAND)
    high = plan.is_occupied(*HIGH_BAND) | (plan.ceiling < HIGH_BAND[1]) | plan.sliced  # a slice does not tell
    free = plan.inside & ~standing
    top = np.where(body != 0, (np.floor(np.log2(np.maximum(body, 1))) + 1 - plan.bands.below) * plan.bands.step, 0.0)

    def lookup(raster: Array, nothing: float = 0) -> Array:
        out: Array = np.where(inside, raster[i, j], nothing).reshape(shape)
        return out

    many = np.bitwise_count(body)
    low = plan.profile & mask & plan.profile.dtype.type(plan.bands.build_mask(*LOW_BAND))
    thing, filled = standing & ((low != 0) | (many >= MANY_BANDS)), plan.wall | (many >= bodies / 2)
    named = {"wall": plan.wall, "standing": standing, "tall": plan.wall & high, "thing": thing, "filled": filled}
    named |= {"free": free, "clear": free & floor}
    bits = {name: lookup(raster).astype(bool) for name, raster in named.items()}
    room = lookup(_draw_rooms(map, plan), -1).astype(np.int32)
    entered = np.append(map.rooms["entered"], 0.0)[room]
    return MapLayer(**bits, room=room, entered=entered, top=lookup(top), furnished=furnished, edge=float(map.grid.edge))


def _draw_rooms(map: TopometricMap, plan: StoreyPlan) -> Array:
    """Return (nx, ny) room of each column of a plan by the map's navigable cells, -1 none; small gaps are filled."""
    room = np.full(plan.wall.shape, -1, np.int32)
    at = map.navigable.compute_centroids()
    near = (np.abs(at[:, 2] - plan.floor_guess) < 1.2) & (map.navigable_room >= 0)
    cells = np.floor((at[near, :2] - plan.origin) / plan.edge).astype(np.int64)
    inside = ((cells >= 0) & (cells < room.shape)).all(axis=1)
    room[tuple(cells[inside].T)] = map.navigable_room[near][inside]
    if not inside.any():
        return room
    gap, nearest = ndimage.distance_transform_edt(room < 0, return_indices=True)
    filled: Array = np.where((gap * plan.edge < 0.3) & ~plan.wall, room[tuple(nearest)], -1)
    return filled


def estimate_slack(old: MapLayer, new: MapLayer, scale: float = 1.0) -> Array:
    """Estimate (nx, ny) m by which things may be off that have not moved: half a cell of either map, and `MISFITS` times the
    misfit of the walls around, which registration and drift have left."""
    prior, weight = MISFIT_PRIOR
    window = MISFIT_WINDOW / CHANGE_CELL
    cells = 2 * np.pi * window**2  # the sum of a Gaussian window is its mean times so many pixels
    misfits = []
    for axis in (0, 1):  # walls tell how far off they are across, and nothing along
        total, count = (np.full(old.wall.shape, v) for v in (weight * prior, weight))
        for one, other in ((old, new), (new, old)):
            near = one.wall & (other.to_wall < MISFIT_REACH) & _runs_along(one.wall, axis)
            off = np.where(near, np.maximum(other.to_wall - CHANGE_CELL, 0.0), 0.0)
            total += cells * ndimage.gaussian_filter(off.astype(np.float64), window, truncate=2.0)
            count += cells * ndimage.gaussian_filter(near.astype(np.float64), window, truncate=2.0)
        misfits.append(total / count)
    noise = (old.edge + scale * new.edge) / 2
    return np.clip(noise + MISFITS * np.maximum(*misfits), LEAST_SLACK, MOST_SLACK)


def _runs_along(wall: Array, axis: int) -> Array:
    """Return (nx, ny) bool: does the wall of a pixel run along an axis rather than across it?"""
    long = round(WALL_RUN / CHANGE_CELL)
    along, across = (ndimage.uniform_filter1d(wall.astype(np.float32), long, axis=k) for k in (axis, 1 - axis))
    return np.asarray(along > across)


def list_runs(seen: Sequence[bool] | Array) -> list[tuple[int, int]]:
    """List (first, last + 1) of each run of true values."""
    change = np.flatnonzero(np.diff(np.pad(np.asarray(seen, np.int8), 1)))
    return [(int(a), int(b)) for a, b in change.reshape(-1, 2)]
