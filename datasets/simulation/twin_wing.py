"""Another wing with nearly the same plan: the building again, its ends longer or shorter, half of the time mirrored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from topomerge.datasets.core.building import Building

from topomerge.types import Array

END_SHARE = (0.15, 0.35)  # share of the building's length that an end takes
END_STRETCH = (0.1, 0.3)  # by which an end is longer, or shorter
SLOPE_STEP = 1e-3  # m, step of the slope of the map

Place = Callable[[Array], Array]


def make_twin_wing(building: Building, rng: np.random.Generator | int = 0) -> Building:
    """Make a wing that is hard to tell from the building: the same rooms, in the same order, in nearly the same places.

    Along its longer side, one of its ends or both are stretched or shrunk by `END_STRETCH`, with all that stands in them: end
    walls move by metres, doors with them. Half of the twins are mirrored, too.

    Args:
        rng: generator or seed.
    """
    rng = np.random.default_rng(rng)
    corners = np.concatenate([room.polygon for room in building.rooms])
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    knots = np.array(
        [low[axis], *(rng.uniform(*END_SHARE, 2) * (1, -1) * (high - low)[axis] + (low[axis], high[axis])), high[axis]]
    )
    factors = np.exp(rng.choice([-1, 1], 2) * np.log1p(rng.uniform(*END_STRETCH, 2)))
    if rng.random() < 0.5:
        factors[int(rng.integers(2))] = 1.0
    mirrored = bool(rng.random() < 0.5)
    return stretch_building(building, axis, _build_piecewise_map(knots, (float(factors[0]), 1.0, float(factors[1]))), mirrored)


def _build_piecewise_map(knots: Array, slopes: tuple[float, float, float]) -> Place:
    """Continuous map of a coordinate with a slope before, between and after the two inner knots."""

    def place(x: Array) -> Array:
        middle = np.clip(x, knots[1], knots[2])
        return np.asarray(middle + slopes[0] * np.minimum(x - knots[1], 0) + slopes[2] * np.maximum(x - knots[2], 0))

    return place


def stretch_building(building: Building, axis: int, place: Place, mirrored: bool = False) -> Building:
    """Return the building with one horizontal coordinate mapped by an increasing function, then perhaps mirrored (x -> -x)."""

    def move(points: Array) -> Array:
        out = np.array(points, np.float64)
        out[..., axis] = place(out[..., axis])
        if mirrored:
            out[..., 0] *= -1
        return out

    def slope(points: Array) -> Array:
        x = np.asarray(points, np.float64)[..., axis]
        return (place(x + SLOPE_STEP) - place(x - SLOPE_STEP)) / (2 * SLOPE_STEP)

    turn = -1 if mirrored else 1
    doors, stairs, things = building.doors.copy(), building.stairs.copy(), building.things.copy()
    across = np.stack([np.cos(doors["direction"]), np.sin(doors["direction"])], axis=1)  # of the wall
    along = np.abs(across[:, 1 - axis])  # share of the wall's own direction that the map stretches
    factor = slope(doors["centre"])
    doors["width"] *= np.hypot(along * factor, across[:, axis])
    doors["thickness"] *= np.hypot(across[:, axis] * factor, along)
    doors["direction"] = (turn * doors["direction"]) % np.pi
    doors["centre"] = move(doors["centre"])
    for name in ("lower", "upper", "path"):
        stairs[name] = move(stairs[name])
    footprint = move(stairs["footprint"])
    stairs["footprint"] = footprint[:, ::-1] if mirrored else footprint
    heading = np.stack([np.cos(things["yaw"]), np.sin(things["yaw"])], axis=1)
    factor = slope(things["centre"])
    things["size"][:, 0] *= np.hypot(heading[:, axis] * factor, heading[:, 1 - axis])
    things["size"][:, 1] *= np.hypot(heading[:, 1 - axis] * factor, heading[:, axis])
    things["centre"], things["pivot"] = move(things["centre"]), move(things["pivot"])
    things["yaw"] = np.pi * mirrored + turn * things["yaw"]
    return replace(
        building,
        vertices=move(building.vertices).astype(np.float32),
        triangles=building.triangles[:, ::turn].copy(),
        rooms=tuple(replace(room, polygon=move(room.polygon)[::turn].copy()) for room in building.rooms),
        doors=doors,
        stairs=stairs,
        things=things,
    )
