"""Could anybody tell two look-alikes apart, from what both maps show?

The two places are laid on each other at each pose at which they look alike (`lookalike_places`), as they really stand and not as
sensors see them; only columns that both maps show count, and only poses that show at least half as much as the one that shows
most. Amounts (`differences`), of which each by itself tells:

- ``walls``, m: walls of one inside the free floor of the other, `WALL_INSIDE` or more from its walls (what drift moves is no
  difference). `WALLS_TELL` or more tell: a door at another place of a wall is about that. So a mirrored outline tells, unless the
  outline is symmetrical.
- ``fitted``, m2: fixtures (baths, kitchens, columns) of one on the other's clear floor, `THING_APART` or more from what stands
  there. `FITTED_TELLS` or more tell: nobody moves a bath.
- ``furniture``, share of the furniture of both that stands on the other's clear floor. `FURNITURE_TELLS` or more, of
  `LEAST_FURNITURE` or more in all, tell: two ordinary days in one room (`Difficulty`: a fifth of the things moved, a tenth gone)
  differ by less 19 times in 20 (median .12), rooms furnished anew by more 3 times in 4 (median .40). Clutter, people, door leaves
  and things of less than `SMALLEST_THING` do not count, nor things that lie below what a sensor shows.

A pair is tellable if every one of its poses is: the right answer to one that is not is to abstain. Its amounts are those of the
pose at which it differs least.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from topomerge.datasets.buildings.furniture import footprints
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.solids import rotation
from topomerge.datasets.simulation.floors import fill
from topomerge.datasets.simulation.sensors import get_sensor

from topomerge.types import Array, Sim3

RULE_CELL = 0.1  # m
WALL_INSIDE, THING_APART = 0.3, 0.3  # m
WALLS_TELL, FITTED_TELLS, FURNITURE_TELLS, LEAST_FURNITURE = 1.0, 0.5, 0.3, 1.5  # m, m2, share, m2
SMALLEST_THING = 0.2  # m2 of its footprint
SHOWN_ABOVE = 0.2  # m by which a thing must reach into what a sensor shows
PASSING = ("leaf", "clutter", "person", "plant", "armchair")  # things that tell nothing
MARGIN = 1.0  # m around the rooms
COMPARABLE = 0.5  # share of the largest area that both show, from which on a pose counts


@dataclass(frozen=True, eq=False)
class Shown:
    """A place as it stood when it was scanned, and what the map shows of it.

    Args:
        building: after `session`.
        seen: (n, 2) columns, m, of which the map knows anything, in the building's coordinates.
        sensor: its name.
    """

    building: Building
    seen: Array
    sensor: str


@dataclass(frozen=True, eq=False)
class _Canvas:
    """Rasters (rows, columns) of one place in a frame: floor with doorways, columns that are shown, furniture, fixtures."""

    floor: Array
    shown: Array
    movable: Array
    fitted: Array
    walls: Array  # (n, 2) row and column of points along the outlines


def differences(a: Shown, b: Shown, pose: Sim3) -> dict[str, float]:
    """Amounts by which two places differ when b's coordinates are mapped into a's; ``common``: m2 that both maps show."""
    corners = np.concatenate([r.polygon for r in a.building.rooms])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    shape = tuple(np.ceil((high - low)[::-1] / RULE_CELL).astype(int).tolist())
    lowest = max(get_sensor(s.sensor).lowest for s in (a, b)) + SHOWN_ABOVE
    first, second = (_canvas(s, t, low, shape, lowest) for s, t in ((a, Sim3()), (b, pose)))
    both = first.shown & second.shown
    walls = fitted = stray = standing = 0.0
    for one, other in ((first, second), (second, first)):
        inside = ndimage.distance_transform_edt(other.floor) * RULE_CELL >= WALL_INSIDE
        rows, columns = one.walls.T
        walls += float((inside & both)[rows, columns].sum()) * RULE_CELL
        clear = other.floor & both & (ndimage.distance_transform_edt(~(other.movable | other.fitted)) * RULE_CELL > THING_APART)
        fitted += float((one.fitted & clear).sum()) * RULE_CELL**2
        stray += float((one.movable & clear).sum()) * RULE_CELL**2
        standing += float((one.movable & other.floor & both).sum()) * RULE_CELL**2
    share = stray / standing if standing >= LEAST_FURNITURE else 0.0
    common = float((both & first.floor & second.floor).sum()) * RULE_CELL**2
    rounded = {"walls": walls, "fitted": fitted, "furniture": share, "standing": standing, "common": common}
    return {name: round(value, 2) for name, value in rounded.items()}


def tells(amount: Mapping[str, float]) -> bool:
    """Do the amounts of one pose tell the places apart?"""
    return strength(amount) >= 1.0


def strength(amount: Mapping[str, float]) -> float:
    """The largest amount in units of what tells."""
    return max(amount["walls"] / WALLS_TELL, amount["fitted"] / FITTED_TELLS, amount["furniture"] / FURNITURE_TELLS)


def judged_poses(a: Shown, b: Shown, poses: Sequence[Sim3]) -> tuple[bool, dict[str, Any], Sim3 | None]:
    """Is the pair tellable; the amounts of the pose at which it differs least, and that pose. Without one that both maps show
    anything of, nothing is alike: tellable, no amounts."""
    rows = [(differences(a, b, pose), pose) for pose in poses]
    most = max((r["common"] for r, _ in rows), default=0.0)
    alike = [(r, p) for r, p in rows if r["common"] >= COMPARABLE * most and r["common"] > 0]
    if not alike:
        return True, {}, None
    amount, pose = min(alike, key=lambda k: strength(k[0]))
    return tells(amount), amount, pose


def _canvas(shown: Shown, pose: Sim3, low: Array, shape: tuple[int, ...], lowest: float) -> _Canvas:
    building = shown.building

    def cells(points: Array) -> Array:
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        return (pose.apply(np.pad(flat, ((0, 0), (0, 1))))[:, :2] - low) / RULE_CELL

    def drawn(polygons: Sequence[Array]) -> Array:
        out = np.zeros(shape, bool)
        for polygon in polygons:
            fill(out, cells(polygon), 1)
        return out

    doorways = [_doorway(d) for d in building.doors]
    rooms = [r.polygon for r in building.rooms]
    edges = np.concatenate([_along(p) for p in rooms])
    openings, outline = drawn(doorways), np.floor(cells(edges)[:, ::-1]).astype(np.int64)
    outline = outline[((outline >= 0) & (outline < shape)).all(axis=1)]
    openings = ndimage.binary_dilation(openings, iterations=1)
    outline = outline[~openings[tuple(outline.T)]]
    seen = np.zeros(shape, bool)
    at = np.floor(cells(shown.seen)[:, ::-1]).astype(np.int64)
    at = at[((at >= 0) & (at < shape)).all(axis=1)]
    seen[tuple(at.T)] = True
    things = building.things[~np.isin(building.things["kind"], PASSING)]
    floors = np.array([r.floor for r in building.rooms])[things["room"]] if len(things) else np.zeros(0)
    top = things["centre"][:, 2] + things["size"][:, 2] / 2 - floors
    things = things[(things["size"][:, 0] * things["size"][:, 1] >= SMALLEST_THING) & (top >= lowest)]
    boxes = [footprints(t["centre"][None, :2], t["yaw"][None], t["size"].tolist())[0] for t in things]
    movable, fitted = ([p for p, t in zip(boxes, things, strict=True) if t["movable"] == m] for m in (True, False))
    floor = drawn([*rooms, *doorways])
    return _Canvas(floor, ndimage.binary_dilation(seen, np.ones((5, 5))), drawn(movable), drawn(fitted), outline)


def _doorway(door: Array) -> Array:
    """(4, 2) floor of a doorway."""
    half = np.array([door["thickness"] / 2 + 0.05, door["width"] / 2])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return np.asarray(corners @ rotation(float(door["direction"])) + door["centre"][:2])


def _along(polygon: Array) -> Array:
    """(n, 2) points along a closed outline, a cell apart."""
    ends = np.roll(polygon, -1, axis=0)
    pieces = []
    for p, q in zip(polygon, ends, strict=True):
        steps = max(round(float(np.hypot(*(q - p))) / RULE_CELL), 1)
        pieces.append(p + (np.arange(steps) + 0.5)[:, None] / steps * (q - p))
    return np.concatenate(pieces)
