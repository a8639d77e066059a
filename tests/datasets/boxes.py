"""Plans small enough to be reckoned by hand."""

from __future__ import annotations

import numpy as np
from topomerge.datasets.core.building import Difficulty, Flight, Opening, Plan, PlanRoom

BARE = Difficulty(  # nothing but the shell
    lintels=1, ceiling_spread=0, furniture=0, clutter=0, windows=1, glass=0, open=1, half=0, lamps=0, beams=0, columns=0,
    slopes=0, ducts=0,
)  # fmt: skip


def room(name: str, x0: float, y0: float, x1: float, y1: float, kind: str = "office", **more: float) -> PlanRoom:
    """A rectangular room."""
    return PlanRoom(name, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float), kind, **more)


def one_room() -> Plan:
    """4 by 5 m, 2.7 m high, with a window of 2 m2 and a door to the outside of 0.9 by 2.1 m."""
    holes = (
        Opening("window", (1.0, -0.15), (3.0, -0.15), 0.3, bottom=0.9, top=1.9),
        Opening("door", (4.15, 2.0), (4.15, 2.9), 0.3, top=2.1),
    )
    return Plan((room("a", 0, 0, 4, 5),), openings=holes)


def two_rooms(**door: float | str) -> Plan:
    """4 by 5 and 3.8 by 5 m, with a wall of 0.2 m and a door of 0.9 m between them."""
    hole = Opening("door", (4.1, 2.0), (4.1, 2.9), 0.2, **({"top": 2.1} | door))  # type: ignore[arg-type]
    return Plan((room("a", 0, 0, 4, 5), room("b", 4.2, 0, 8, 5)), openings=(hole,))


def tower(kind: str, storeys: int = 2, width: float = 1.3, length: float = 5.04, height: float = 3.2) -> list[Plan]:
    """A room with a stair, above a room of the same plan; the flights lie along its right wall."""
    hall = room("hall", 0, 0, 4, 22 if kind == "ramp" else 9, "stairs")
    flight = Flight(kind, (0.5, 1.5), np.pi / 2, width, length)
    return [Plan((hall,), flights=(flight,) if k + 1 < storeys else (), height=height) for k in range(storeys)]
