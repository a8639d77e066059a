"""Where furniture stands: along walls, in rows or freely, clear of doors, so that one can still walk through."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from topomerge.datasets.buildings.furniture import BY_WALL, FURNITURE_OF, IN_MIDDLE, IN_ROWS, Item, footprints, make_item
from topomerge.datasets.core.solids import rotation

from topomerge.types import Array

PLACES_TRIED = 10
ROW_SHIFT, ASKEW, ROW_GAPS = (
    0.06,
    0.03,
    0.08,
)  # m and rad (standard deviations) and share by which rows of furniture are irregular
HALF_BODY = 0.28  # m, half of what a person needs to pass
ANYHOW = ("clutter", "person", "armchair", "plant")  # stand at any angle
UNFURNISHED = ("stairs", "lift", "void")


@dataclass(eq=False)
class Floor:
    """A room while it is being furnished: its outline (counter-clockwise), what is taken, and its clear height in metres."""

    shape: shapely.Polygon
    taken: list[shapely.Polygon]
    rng: np.random.Generator
    height: float = 2.5

    def __post_init__(self) -> None:
        shapely.prepare(self.shape)
        ring = np.asarray(self.shape.exterior.coords)
        self.corners, steps = ring[:-1], np.diff(ring, axis=0)
        self.lengths = np.hypot(steps[:, 0], steps[:, 1])
        self.along = steps / self.lengths[:, None]

    def put(self, item: Item, where: str) -> Item | None:
        """The item at a place that is free, or None when none was found."""
        at, yaw = self._by_wall(item) if where == BY_WALL else self._in_middle(item)
        yaw = yaw + self._askew(item)
        free = np.flatnonzero(self.fits(at, yaw, item))
        return self._place(item, at[free[0]], float(yaw[free[0]])) if len(free) else None

    def _askew(self, item: Item) -> float:
        """rad by which a thing is not parallel to the walls; what is fitted stands straight."""
        return float(self.rng.normal(0, ASKEW)) if item.movable else 0.0

    def fits(self, at: Array, yaw: Array, item: Item) -> Array:
        """(n,) bool: does the item lie within the room and clear of everything, at each place?"""
        outlines = shapely.polygons(footprints(at, yaw, item.size))
        inside = shapely.contains(self.shape, outlines)
        if self.taken:
            inside[inside] = ~shapely.intersects(outlines[inside][:, None], self.taken).any(axis=1)
        return inside

    def _place(self, item: Item, at: Array, yaw: float) -> Item:
        item = replace(item, at=at, yaw=yaw)
        self.taken.append(item.outline.buffer(0.02, join_style="mitre"))
        return item

    def _by_wall(self, item: Item) -> tuple[Array, Array]:
        """Places with the back to a wall; half of them in corners, as people put things."""
        width, depth = item.size[:2]
        weight = np.maximum(self.lengths - width, 0) + 1e-9
        wall = self.rng.choice(len(weight), PLACES_TRIED, p=weight / weight.sum())
        along, spare = self.along[wall], np.maximum(self.lengths[wall] - width, 0.0)
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
        free = self.rng.uniform(0, 1, PLACES_TRIED) * spare
        corner = np.where(self.rng.random(PLACES_TRIED) < 0.5, 0.04, spare - 0.04)
        offset = np.where(self.rng.random(PLACES_TRIED) < 0.5, corner, free) + width / 2
        gap = 0.05 + self.rng.exponential(0.03, PLACES_TRIED) if item.movable else np.full(PLACES_TRIED, 0.03)
        at = self.corners[wall] + along * offset[:, None] + inward * (depth / 2 + gap)[:, None]
        return at, np.arctan2(-inward[:, 1], -inward[:, 0]) - np.pi / 2

    def _in_middle(self, item: Item) -> tuple[Array, Array]:
        low, high = np.array(self.shape.bounds).reshape(2, 2)
        turn = self.rng.uniform(0, 4, PLACES_TRIED) if item.kind in ANYHOW else self.rng.integers(4, size=PLACES_TRIED)
        return self.rng.uniform(low, high, (PLACES_TRIED, 2)), self.bearing() + turn * np.pi / 2

    def bearing(self) -> float:
        """rad, direction of the longest wall."""
        x, y = self.along[np.argmax(self.lengths)]
        return float(np.arctan2(y, x))

    def rows(self, kind: str, count: int) -> list[Item]:
        """Up to `count` items of one make on a grid in the room's middle, with aisles."""
        item, yaw = make_item(kind, self.rng), self.bearing()
        turned = self.corners @ rotation(-yaw)
        low, high = turned.min(axis=0) + 0.7, turned.max(axis=0) - 0.7
        size, aisle = np.array(item.size[:2]), self.rng.uniform(0.5, 0.9, 2)
        xs, ys = (np.arange(low[k] + size[k] / 2, high[k] - size[k] / 2 + 1e-6, size[k] + aisle[k]) for k in (0, 1))
        spots = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2) @ rotation(yaw)
        spots = spots + self.rng.normal(0, ROW_SHIFT, spots.shape)
        yaws = yaw + self.rng.normal(0, ASKEW, len(spots))
        free = self.fits(spots, yaws, item) & (self.rng.random(len(spots)) > ROW_GAPS) if len(spots) else np.zeros(0, bool)
        return [self._place(item, spot, float(y)) for spot, y in zip(spots[free][:count], yaws[free][:count], strict=True)]


def furnish(floor: Floor, kind: str, density: float, clutter: float, doors: Array) -> list[Item]:
    """Things for a room of a kind.

    Args:
        floor: the room, with what is taken already (door swings, stairs, columns).
        kind: of the room; an unknown one gets the furniture of an office.
        density: 1 is usual.
        clutter: things on the floor of 10 m2.
        doors: (d, 2) where the doors are; all must stay reachable from each other.
    """
    if kind in UNFURNISHED:
        return []
    area, rng = floor.shape.area, floor.rng
    out: list[Item | None] = []
    for name, where, least, every in FURNITURE_OF.get(kind, FURNITURE_OF["office"]):
        count = (least + (area / every if every else 0.0)) * density
        number = int(count) + int(rng.random() < count % 1)
        if where == IN_ROWS:
            out += floor.rows(name, number)
        else:
            out += [floor.put(make_item(name, rng), where) for _ in range(number)]
    strewn = int(rng.poisson(clutter * area / 10))
    out += [floor.put(make_item("clutter", rng), IN_MIDDLE) for _ in range(strewn)]
    items = [item for item in out if item is not None and item.size[2] < floor.height]
    while items and not passable(floor.shape, items, doors):
        items = items[: len(items) * 2 // 3]
    return items


def passable(shape: shapely.Polygon, items: list[Item], doors: Array) -> bool:
    """Can a person get from every door to every other one, and some way into the room?"""
    if not len(doors):
        return True
    standing = [footprints(i.at[None], np.array([i.yaw]), i.size) for i in items if i.kind != "board"]
    blocked = shapely.union_all(shapely.polygons(np.concatenate(standing)) if standing else []).buffer(HALF_BODY, 2)
    parts = shapely.get_parts(shape.buffer(0.1, 2).buffer(-0.1 - HALF_BODY * 0.9, 2).difference(blocked))
    near = shapely.distance(parts[:, None], shapely.points(doors)[None]) < 0.45
    return bool((near.all(axis=1) & (shapely.area(parts) > 0.15 * shape.area * (shape.area > 8))).any())
