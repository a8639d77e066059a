"""Flats of two rooms as points, and their maps: what differs between two of them is known to the centimetre."""

from __future__ import annotations

from functools import cache

import numpy as np

from tests.scenes import Scene
from topomerge.extraction.extract import extract
from topomerge.types import Sim3, TopometricMap

Box = tuple[float, float, float, float, float, float]
WIDE, DEEP, LAST = 8.0, 5.0, 13.0  # m: the first room, both rooms, and the end of the second one
TABLE: Box = (2.0, 1.0, 0.0, 3.2, 1.8, 0.8)
CABIN = 2.2  # m, its sides
MOVED: Box = (5.0, 3.0, 0.0, 6.2, 3.8, 0.8)
PARTITION = 4.0  # m


def flat(
    *, wall: bool = False, walled_up: bool = False, box: Box | None = None, half: bool = False, cabin: bool = False
) -> np.ndarray:
    """(n, 3) points of a room of 8 x 5 m, a door of 0.9 m in its wall at x = 8.075, and a room behind it.

    Args:
        wall: a wall with a door across the first room, at x = 4.
        walled_up: there is no door between the rooms.
        box: furniture x0, y0, z0, x1, y1, z1.
        cabin: two walls with a door part a corner of the first room from it.
        half: only the second room was seen, and the last 2 m of the first one.
    """
    scene = Scene()
    scene.floor(0, 0, WIDE, DEEP).floor(0, 0, WIDE, DEEP, z=2.7)
    scene.floor(WIDE + 0.15, 0, LAST, DEEP).floor(WIDE + 0.15, 0, LAST, DEEP, z=2.7)
    scene.wall((0, 0), (LAST, 0)).wall((0, DEEP), (LAST, DEEP)).wall((0, 0), (0, DEEP)).wall((LAST, 0), (LAST, DEEP))
    scene.wall((WIDE + 0.075, 0), (WIDE + 0.075, DEEP), doors=() if walled_up else (2.0,))
    if not walled_up:
        scene.floor(WIDE - 0.05, 1.55, WIDE + 0.2, 2.45)
    if wall:
        scene.wall((PARTITION, 0), (PARTITION, DEEP), doors=(2.5,))
    if cabin:
        scene.wall((CABIN, 0), (CABIN, CABIN), doors=(1.1,)).wall((0, CABIN), (CABIN, CABIN))
    if box is not None:
        scene.box(*box)
    points = np.concatenate(scene.parts)
    return points[points[:, 0] > WIDE - 2.0] if half else points


@cache
def flat_map(frame: Sim3 | None = None, noise: float = 0.0, **choices: object) -> TopometricMap:
    """The map of a flat, in another frame, with noise of so many m."""
    points = flat(**choices)  # type: ignore[arg-type]
    points = points + np.random.default_rng(3).normal(0, noise, points.shape) if noise else points
    return extract(points if frame is None else frame.apply(points))
