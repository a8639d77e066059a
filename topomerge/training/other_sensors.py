"""A map's storeys from above as another sensor, walk or day would have left them: what a training sees in place of more scans.

What is seen depends on where one walks (`looked_at`), on the sensor (`as_slice`, `rough_walls`, planes and patches that are
missing), and on how it drifts (`bent`). Arrays are those of `embedding.surroundings`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.embedding.surroundings import SHEET_PLANES
from topomerge.kernels.sight import lit
from topomerge.kernels.warp import drifts, warped
from topomerge.types import Array

SEEN_AS = (  # planes that a map lacks, and how often: drawings and slices have no ceilings, and no low things
    ((), 0.65),
    (("ceiling",), 0.15),
    (("ceiling", "low"), 0.1),
    (("ceiling", "low", "high"), 0.1),
)
PATCHES, PATCH = 3, (4, 24)  # patches that nothing was seen of, at most, and pixels of a side
SENSOR_REACH = (16.0, 56.0)  # pixels, how far a sensor sees
OPAQUE = 128  # from which share of a pixel on a wall stops a ray
ENTERED = (0.3, 1.0)  # share of rooms that a walk enters; into the others it looks through a door
BEND_STEP = 32  # pixels, between two places that drift apart from each other
MOST_LOST = 0.4  # of the pixels of rough walls
WALL, LOW, HIGH, CEILING = (SHEET_PLANES.index(name) for name in ("wall", "low", "high", "ceiling"))


def looked_at(planes: Array, room: Array, anchor: Array, doors: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Planes and rooms of what a walk sees that enters some rooms and looks into the others from a door: the rest is empty.

    Args:
        planes: (H, W, len(SHEET_PLANES)) uint8; room: (H, W); anchor: (R, 2) pixels; doors: (R, n, 2) pixels, nan where none is.
    """
    entered = rng.random(len(anchor)) < rng.uniform(*ENTERED)
    through = doors[np.arange(len(anchor)), rng.integers(0, np.maximum(np.isfinite(doors[..., 0]).sum(axis=1), 1))]
    stand = np.where((entered | ~np.isfinite(through[:, 0]))[:, None], anchor, through)
    columns = np.clip(np.floor(stand).astype(np.int64), 0, np.array(room.shape) - 1)
    seen = lit(planes[..., WALL] >= OPAQUE, columns, rng.uniform(*SENSOR_REACH))
    return np.where(seen[..., None], planes, 0).astype(np.uint8), np.where(seen, room, -1).astype(room.dtype)


def as_slice(planes: Array, rng: np.random.Generator) -> Array:
    """Planes as a laser that turns in one plane sees them: what stands at its height looks like walls, the rest is not seen."""
    out = planes.copy()
    things = np.maximum(planes[..., HIGH], planes[..., LOW]) if rng.random() < 0.5 else planes[..., HIGH]
    out[..., WALL] = np.maximum(planes[..., WALL], things)
    out[..., [LOW, HIGH, CEILING]] = 0
    return out


def rough_walls(planes: Array, rng: np.random.Generator) -> Array:
    """Planes whose walls have gaps, or are a pixel thicker."""
    out, wall = planes.copy(), planes[..., WALL]
    if rng.random() < 0.5:
        out[..., WALL] = np.where(rng.random(wall.shape) < rng.uniform(0, MOST_LOST), 0, wall)
    else:
        out[..., WALL] = ndimage.maximum_filter(wall, (2, 2))
    return out


def bent(
    planes: Array, room: Array, places: tuple[Array, ...], tilt: float, zoom: float, bend: float, rng: np.random.Generator
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Planes, rooms and places of a map that is turned, stretched, and bent by drift.

    Args:
        places: (..., 2) pixels each.
        tilt: rad, counter-clockwise; zoom: factor.
        bend: pixels, standard deviation of how far places `BEND_STEP` apart move.
    """
    c, s = zoom * np.cos(tilt), zoom * np.sin(tilt)
    turn, size = np.array([[c, -s], [s, c]]), np.array(room.shape)
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size) @ turn.T
    low = np.floor(corners.min(axis=0)) - BEND_STEP // 4
    shape = (np.ceil(corners.max(axis=0)) - low).astype(np.int64) + BEND_STEP // 4
    knots = bend * rng.standard_normal((2, *(size // BEND_STEP + 2)))

    planes, room = warped(planes, room, np.linalg.inv(turn), low, shape, knots, BEND_STEP)
    moved = []
    for place in places:
        flat = place.reshape(-1, 2).astype(np.float64)
        there = np.isfinite(flat).all(axis=1)
        flat[there] = (flat[there] + drifts(knots, flat[there] / BEND_STEP)) @ turn.T - low
        moved.append(flat.reshape(place.shape).astype(place.dtype))
    return planes, room, tuple(moved)


def with_gaps(planes: Array, room: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Planes and rooms of which some planes and patches are missing."""
    planes, room = planes.copy(), room.copy()
    for name in SEEN_AS[rng.choice(len(SEEN_AS), p=[share for _, share in SEEN_AS])][0]:
        planes[..., SHEET_PLANES.index(name)] = 0
    for _ in range(rng.integers(0, PATCHES + 1)):
        size = rng.integers(*PATCH, 2)
        start = rng.integers(0, np.maximum(room.shape, 1))
        at = (slice(start[0], start[0] + size[0]), slice(start[1], start[1] + size[1]))
        planes[at], room[at] = 0, -1
    return planes, room
