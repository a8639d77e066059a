"""Two rooms and a corridor beside them, with an open door, a shut one and a niche, as points."""

from __future__ import annotations

import numpy as np

from tests.scenes import DOOR, HEIGHT, THICK, Scene, rectangle
from topomerge.extraction.extract import extract
from topomerge.types import Sim3, TopometricMap

SHUT_DOOR = 1.9  # m along the wall between the rooms


def leaf(scene: Scene, x: float, y: float, back: float) -> Scene:
    """A shut leaf, 4 cm thick, in a wall along y whose middle is at x; `back` m behind the wall's left face."""
    low = x - 0.075 + back
    scene.box(low, y - DOOR[0] / 2 + 0.01, 0.01, low + 0.04, y + DOOR[0] / 2 - 0.01, DOOR[1] - 0.02)
    return scene


def three_doors(back: float = 0.05) -> Scene:
    """4 x 5 m and 3 x 5 m side by side along x, a shut door between them at y = 1.9 and an open one at y = 4."""
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=(SHUT_DOOR, 4.0))
    return leaf(scene, 4.0, SHUT_DOOR, back)


def niche(scene: Scene) -> Scene:
    """A cupboard against the wall between the rooms, and a board on it."""
    scene.box(3.4, 0.2, 0.0, 3.9, 1.1, 1.9)
    scene.parts.append(rectangle((4.09, 2.6, 1.0), (0, 0.8, 0), (0, 0, 0.9)))
    return scene


def wide_opening(width: float) -> Scene:
    """Two rooms of 7 m, one 5 m deep and one 2.5 m, with an opening as wide around (3.5, 5), 2.3 m high."""
    first, last = 3.5 - width / 2, 3.5 + width / 2
    scene = Scene().shell(0, 0, 7, 7.5).wall((0, 5), (first, 5)).wall((last, 5), (7, 5))
    scene.parts += [rectangle((first, y, 2.3), (width, 0, 0), (0, 0, HEIGHT - 2.3)) for y in (5 - THICK / 2, 5 + THICK / 2)]
    scene.parts += [rectangle((x, 5 - THICK / 2, 0), (0, THICK, 0), (0, 0, 2.3)) for x in (first, last)]
    return scene


def extracted(points: np.ndarray, turn: float = 0.0, **more: object) -> TopometricMap:
    """The map of points that were turned about the vertical."""
    return extract(Sim3(turn).apply(points.astype(float)).astype(np.float32), **more)  # type: ignore[arg-type]
