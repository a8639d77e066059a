"""Three maps of the analytic office, of which two meet in one room only; somebody built walls in it between the two."""

from __future__ import annotations

import numpy as np

import topomerge as tm
from tests.fusion.plans_of import office
from topomerge.types import Sim3, TopometricMap

ROOM = ((5.9, 7.9), (12.6, 14.2))  # low and high corner, m: the room in which west and east meet
WEST = (((-1.0, -1.0), (6.6, 14.2)), ROOM)
EAST = (((12.0, -1.0), (25.0, 14.2)), ROOM)
SOUTH = (((-1.0, -1.0), (25.0, 8.1)),)
FRAMES = {"west": Sim3(), "south": Sim3(2.1, (7.0, -3.0, 0.4)), "east": Sim3(-2.8, (-4.0, 2.0, -1.0))}
BUILT = (  # ends of walls, m
    ((7.6, 8.0), (7.6, 12.5)), ((7.6, 10.9), (12.5, 10.9)), ((9.3, 10.9), (9.3, 14.0)), ((10.9, 8.0), (10.9, 12.7)),
    ((9.3, 8.0), (9.3, 9.8)), ((6.0, 12.5), (7.6, 12.5)),
)  # fmt: skip


def office_parts(walls: int) -> dict[str, TopometricMap]:
    """Maps by their names, each in its frame; when the east was mapped, so many of `BUILT` stood."""
    before, after = office(), office()
    for ends in BUILT[:walls]:
        after.wall(*ends)
    parts = {"west": (before, WEST), "south": (before, SOUTH), "east": (after, EAST)}
    return {name: tm.extract(FRAMES[name].apply(_within(*of)).astype(np.float32), name=name) for name, of in parts.items()}


def _within(scene, rectangles) -> np.ndarray:  # type: ignore[no-untyped-def]
    points = scene.points()
    inside = np.zeros(len(points), bool)
    for low, high in rectangles:
        inside |= ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    return points[inside]
