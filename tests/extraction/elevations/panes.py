"""Two rooms with windows at known places: in two outer walls, and in the wall between the rooms."""

from __future__ import annotations

import numpy as np

from tests.scenes import THICK, Scene, rectangle, two_rooms

SILL, HEAD = 0.9, 2.1  # m
WINDOWS = np.array([(2.0, -THICK / 2, 1.4), (4.0, 3.9, 1.2), (7.0 + THICK / 2, 2.6, 1.2)]) + (0.013, 0.017, 0.0)  # x, y, width


def pane(scene: Scene, low: tuple[float, float], high: tuple[float, float]) -> Scene:
    """A hole in a wall, a box from above, with its reveal; what was in it goes."""
    (x0, y0), (x1, y1) = low, high
    inside = (np.array([x0, y0, SILL]) - 1e-6, np.array([x1, y1, HEAD]) + 1e-6)
    scene.parts = [p[((p < inside[0]) | (p > inside[1])).any(axis=1)] for p in scene.parts]
    for z in (SILL, HEAD):
        scene.parts.append(rectangle((x0, y0, z), (x1 - x0, 0, 0), (0, y1 - y0, 0)))
    ends = ((x0, y0), (x1, y0)) if x1 - x0 > y1 - y0 else ((x0, y0), (x0, y1))
    across = (0, y1 - y0, 0) if x1 - x0 > y1 - y0 else (x1 - x0, 0, 0)
    for x, y in ends:
        scene.parts.append(rectangle((x, y, SILL), across, (0, 0, HEAD - SILL)))
    return scene


def three_windows() -> np.ndarray:
    """Points of `two_rooms` with `WINDOWS`."""
    t = THICK
    scene = pane(two_rooms(), (1.3, -t), (2.7, 0.0))
    scene = pane(scene, (4 - t / 2, 3.3), (4 + t / 2, 4.5))
    return pane(scene, (7.0, 2.0), (7.0 + t, 3.2)).points()
