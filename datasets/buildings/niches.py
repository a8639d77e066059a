"""Recesses in walls: where a heater, a hydrant or a shelf stands. They are as deep as what lies behind allows and begin above the
floor: one of a door's size is what a shut leaf in its wall looks like."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from topomerge.datasets.buildings.openings import Hole
from topomerge.datasets.buildings.spaces import Space, footprint
from topomerge.datasets.core.building import NICHE_DTYPE
from topomerge.datasets.core.solids import Prism

from topomerge.types import Array

LONG_WALL = 1.4  # m, from which on a wall may have a niche
NICHE_WIDTHS, NICHE_DEPTHS = (0.35, 1.3), (0.04, 0.4)  # m, at least, at most
NICHE_BOTTOMS, NICHE_HEIGHTS = (0.3, 1.1), (0.4, 1.2)  # m
BEHIND_NICHE = 0.05  # m of wall that stay behind it
NICHE_MOUTH = 0.02  # m by which its free space begins before the face, so that it is one with the room's
CORNER = 0.1  # m between a niche and the end of its wall


def wall_niches(
    spaces: Sequence[Space], holes: Sequence[Hole], share: float, rng: np.random.Generator
) -> tuple[list[Prism], Array]:
    """Free space of the niches, and (N,) NICHE_DTYPE.

    Args:
        share: of the longer walls that have one; 0: nothing is drawn from `rng`.
    """
    hollows: list[Prism] = []
    rows: list[tuple[object, ...]] = []
    if share <= 0:
        return hollows, np.array(rows, NICHE_DTYPE)
    for k in sorted({s.storey for s in spaces}):
        here = [s for s in spaces if s.storey == k]
        solid = footprint([s.shape for s in here]).difference(shapely.union_all([s.shape for s in here]))
        solid = solid.difference(shapely.union_all([h.box.buffer(CORNER) for h in holes if h.storey == k]))
        for space in (s for s in here if s.room >= 0):
            ring = np.asarray(shapely.orient_polygons(space.shape).exterior.coords)
            for start, end in pairwise(ring):
                length = float(np.hypot(*(end - start)))
                if length >= LONG_WALL and rng.random() < share:
                    made = _niche(start, (end - start) / length, length, space, solid, rng)
                    if made is not None:
                        hollows.append(made[0])
                        rows.append(made[1])
                        solid = solid.difference(made[0].polygon.buffer(CORNER))
    return hollows, np.array(rows, NICHE_DTYPE)


def _niche(
    start: Array, along: Array, length: float, space: Space, solid: shapely.Geometry, rng: np.random.Generator
) -> tuple[Prism, tuple[object, ...]] | None:
    """One in the wall that runs from a corner along the room, which lies to its left; None where the wall is too thin.

    Args:
        solid: what is wall, without what other openings and niches need.
    """
    width = float(rng.uniform(NICHE_WIDTHS[0], min(NICHE_WIDTHS[1], length - 2 * CORNER)))
    deepest = float(np.exp(rng.uniform(*np.log(NICHE_DEPTHS))))
    first = start + along * float(rng.uniform(CORNER, length - CORNER - width))
    out = np.array([along[1], -along[0]])
    high = space.ceiling - space.floor - space.plan.slope - CORNER
    bottom = float(rng.uniform(*NICHE_BOTTOMS))
    top = min(bottom + float(rng.uniform(*NICHE_HEIGHTS)), high)
    for depth in deepest * np.array([1.0, 0.6, 0.35]):
        corners = [first, first + along * width, first + along * width + out * depth, first + out * depth]
        behind = shapely.Polygon([*corners[:2], *(c + out * BEHIND_NICHE for c in corners[2:])])
        if depth >= NICHE_DEPTHS[0] and solid.buffer(1e-6).contains(behind):
            shape = shapely.Polygon([c - out * NICHE_MOUTH for c in corners[:2]] + corners[2:])
            centre = (*(np.mean(corners, axis=0)).tolist(), space.floor)
            direction = float(np.arctan2(out[1], out[0]))
            return Prism(shape, space.floor + bottom, space.floor + top), (centre, width, float(depth), direction, bottom, top)
    return None
