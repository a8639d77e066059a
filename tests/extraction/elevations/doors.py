"""Two rooms with an open door between them, and what else there may be in their wall: shut, double and sliding doors, niches,
boards and wide openings, as points."""

from __future__ import annotations

import numpy as np

from tests.scenes import DOOR, HEIGHT, THICK, Scene, rectangle, two_rooms
from topomerge.extraction.extract import extract
from topomerge.types import Sim3, TopometricMap

SHUT_DOOR, AJAR_DOOR = 1.9, 4.5  # m along the wall between the rooms


def leaf(scene: Scene, x: float, y: float, back: float) -> Scene:
    """A shut leaf, 4 cm thick, in a wall along y whose middle is at x; `back` m behind the wall's left face."""
    low = x - 0.075 + back
    scene.box(low, y - DOOR[0] / 2 + 0.01, 0.01, low + 0.04, y + DOOR[0] / 2 - 0.01, DOOR[1] - 0.02)
    return scene


def three_doors(back: float = 0.05) -> Scene:
    """4 x 5 m and 3 x 5 m side by side along x, a shut door between them at y = 1.9 and an open one at y = 4."""
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=(SHUT_DOOR, 4.0))
    return leaf(scene, 4.0, SHUT_DOOR, back)


def ajar_door(angle: float) -> Scene:
    """4 x 8 m and 3 x 8 m side by side: a shut door, one whose leaf is opened by `angle` (rad) into the right room, and an open
    one at y = 7."""
    scene = Scene().shell(0, 0, 7, 8).wall((4, 0), (4, 8), doors=(SHUT_DOOR, AJAR_DOOR, 7.0))
    hinge, reach = np.array([4.055, AJAR_DOOR - DOOR[0] / 2 + 0.01]), DOOR[0] - 0.02
    along, across = (reach * np.sin(angle), reach * np.cos(angle), 0), (0.04 * np.cos(angle), -0.04 * np.sin(angle), 0)
    for shift in (np.zeros(2), np.array(across[:2])):
        scene.parts.append(rectangle((*(hinge + shift), 0.01), along, (0, 0, DOOR[1] - 0.02)))
    for shift in (np.zeros(2), np.array(along[:2])):
        scene.parts.append(rectangle((*(hinge + shift), 0.01), across, (0, 0, DOOR[1] - 0.02)))
    return leaf(scene, 4.0, SHUT_DOOR, 0.05)


def flush_door(doors: tuple[float, ...] = (SHUT_DOOR, 4.0)) -> np.ndarray:
    """Two rooms; in the wall between them the first door is shut by a leaf as thick as the wall, the others are open."""
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=doors)
    half = DOOR[0] / 2 - 0.005
    scene.box(4 - THICK / 2, doors[0] - half, 0.005, 4 + THICK / 2, doors[0] + half, DOOR[1] - 0.005)
    return scene.points()


def niche(depth: float, width: float, bottom: float, top: float, behind: float) -> Scene:
    """Two rooms, an open door between them at y = 4, and a niche at y = 1.9 in the left face of their wall, with `behind` m of
    wall behind it."""
    thick = depth + behind
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=(4.0,), thick=thick)
    x, y, high = 4 - thick / 2, SHUT_DOOR - width / 2, top - bottom
    low, past = (x - 1e-6, y, bottom), (x + 1e-6, y + width, top)
    scene.parts = [p[((p < low) | (p > past)).any(axis=1)] for p in scene.parts]
    scene.parts.append(rectangle((x + depth, y, bottom), (0, width, 0), (0, 0, high)))
    scene.parts += [rectangle((x, y + k, bottom), (depth, 0, 0), (0, 0, high)) for k in (0, width)]
    scene.parts += [rectangle((x, y, z), (depth, 0, 0), (0, width, 0)) for z in (bottom, top)]
    return scene


def double_door(width: float, is_open: bool) -> Scene:
    """Two rooms of 7 x 5 m and a door of two leaves around (3.5, 5)."""
    scene, first, last = wide_opening(width, deep=5.0, top=2.1), 3.5 - width / 2, 3.5 + width / 2
    if is_open:
        for x in (first + 0.01, last - 0.05):
            scene.box(x, 5 + THICK / 2, 0.01, x + 0.04, 5 + THICK / 2 + width / 2, 2.08)
    else:
        for x in (first + 0.01, 3.5 + 0.005):
            scene.box(x, 4.97, 0.01, x + width / 2 - 0.015, 5.01, 2.08)
    return scene


def sliding_door(cover: float) -> Scene:
    """Two rooms and a door at (4, 2); its leaf hangs along the wall, and covers so many metres of it."""
    scene, stop = two_rooms(), 2 - DOOR[0] / 2 + cover
    scene.box(4.09, stop - DOOR[0] - 0.05, 0.01, 4.13, stop, 2.1)
    return scene


def cupboard_and_board(scene: Scene) -> Scene:
    """A cupboard against the wall between the rooms, and a board on it."""
    scene.box(3.4, 0.2, 0.0, 3.9, 1.1, 1.9)
    scene.parts.append(rectangle((4.09, 2.6, 1.0), (0, 0.8, 0), (0, 0, 0.9)))
    return scene


def wide_opening(width: float, deep: float = 2.5, top: float = 2.3) -> Scene:
    """Two rooms of 7 m, one 5 m deep and one `deep` m, with an opening as wide around (3.5, 5), `top` m high."""
    first, last = 3.5 - width / 2, 3.5 + width / 2
    scene = Scene().shell(0, 0, 7, 5 + deep).wall((0, 5), (first, 5)).wall((last, 5), (7, 5))
    scene.parts += [rectangle((first, y, top), (width, 0, 0), (0, 0, HEIGHT - top)) for y in (5 - THICK / 2, 5 + THICK / 2)]
    scene.parts += [rectangle((x, 5 - THICK / 2, 0), (0, THICK, 0), (0, 0, top)) for x in (first, last)]
    return scene


def extracted(points: np.ndarray, turn: float = 0.0, **more: object) -> TopometricMap:
    """The map of points that were turned about the vertical."""
    return extract(Sim3(turn).apply(points.astype(float)).astype(np.float32), **more)  # type: ignore[arg-type]
