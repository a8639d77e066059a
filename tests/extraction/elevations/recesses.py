"""A room with a niche in one wall and a cupboard against another, at known places, and a plain room beside it."""

from __future__ import annotations

import numpy as np

from tests.scenes import Scene, rectangle, two_rooms

NICHE = (0.4, 1.4, 0.2, 0.8, 1.8)  # m: from, to along x in the wall y = 5; depth, bottom, top
CUPBOARD = (2.2, 3.4, 0.4, 1.8)  # m: from, to along y at the wall x = 0; depth, top


def niche_and_cupboard() -> np.ndarray:
    """Points of `two_rooms` with `NICHE` and `CUPBOARD` in the room to the left; the niche's wall was not seen from outside."""
    scene = two_rooms()
    first, last, depth, bottom, top = NICHE
    low, past = np.array([first, 5 - 1e-6, bottom]), np.array([last, 5 + 1e-6, top])
    scene.parts = [p[((p < low) | (p > past)).any(axis=1)] for p in scene.parts]
    scene.parts = [p[~((p[:, 1] > 5.1) & (p[:, 0] > -0.2) & (p[:, 0] < 7.2))] for p in scene.parts]
    scene.parts.append(rectangle((first, 5 + depth, bottom), (last - first, 0, 0), (0, 0, top - bottom)))
    scene.parts += [rectangle((x, 5, bottom), (0, depth, 0), (0, 0, top - bottom)) for x in (first, last)]
    scene.parts += [rectangle((first, 5, z), (last - first, 0, 0), (0, depth, 0)) for z in (bottom, top)]
    return cupboard(scene).points(0.003)


def cupboard(scene: Scene) -> Scene:
    """`CUPBOARD`, what it hides of wall and floor left out."""
    first, last, depth, top = CUPBOARD
    low, past = np.array([-1e-6, first, -1e-6]), np.array([depth - 1e-6, last, top - 1e-6])
    scene.parts = [p[((p < low) | (p > past)).any(axis=1)] for p in scene.parts]
    scene.parts.append(rectangle((depth, first, 0), (0, last - first, 0), (0, 0, top)))
    scene.parts += [rectangle((0, y, 0), (depth, 0, 0), (0, 0, top)) for y in (first, last)]
    scene.parts.append(rectangle((0, first, top), (depth, 0, 0), (0, last - first, 0)))
    return scene
