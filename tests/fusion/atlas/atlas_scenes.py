"""Parts of the analytic office in frames of their own, and a stranger: for the tests of atlases."""

from __future__ import annotations

from functools import cache

import numpy as np

from tests.fusion.plans_of import office, part
from tests.scenes import Scene
from topomerge.extraction.extract import extract
from topomerge.fusion.atlas.solve import RegistrationsByPair
from topomerge.types import Sim3, TopometricMap

PARTS = (((-9, -9), (14, 99)), ((4.6, -9), (99, 8)), ((9, -9), (99, 99)), ((-9, 5), (99, 99)))  # low, high
FRAMES = (Sim3(), Sim3(2.1, (7.0, -3.0, 0.4)), Sim3(-2.8, (-4.0, 2.0, -1.0)), Sim3(0.7, (1.0, 9.0, 2.0)))
NAMES = ("west", "south", "east", "north")
REGISTRATIONS: RegistrationsByPair = {}  # that were made before: they are the same for any order, in any file of tests


@cache
def office_map(k: int) -> TopometricMap:
    """The kth part; T_kl of two is FRAMES[k] @ FRAMES[l].inverse()."""
    points = part(office().points(), *PARTS[k])
    return extract(FRAMES[k].apply(points).astype(np.float32), name=NAMES[k])


@cache
def stranger() -> TopometricMap:
    """Another building."""
    other = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,))
    return extract(other.points(), name="stranger")


def truth(k: int, m: int) -> Sim3:
    """T_km."""
    return FRAMES[k] @ FRAMES[m].inverse()
