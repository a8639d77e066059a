"""What the kinds of procedural buildings are drawn from: their rooms, sizes, corridors and stairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Range = tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """What a kind of building is drawn from; lengths in metres.

    Args:
        rooms: deck of row rooms on the ground floor; a kind's share is how often it is named.
        upper: deck of the other storeys, empty: the same.
        cores: kinds that every storey has at one place.
        same: all row rooms of a kind have one width, as in hotels and hospitals.
    """

    shapes: tuple[str, ...]
    length: Range
    depth: Range
    corridor: Range
    rooms: tuple[str, ...]
    upper: tuple[str, ...] = ()
    cores: tuple[str, ...] = ("toilets",)
    stairs: tuple[str, ...] = ("dogleg", "dogleg", "straight", "spiral")
    height: Range = (3.1, 3.6)
    same: bool = False
    lift: bool = True


PROFILES = {
    "office": Profile(
        ("single", "double", "double", "ring", "L", "T", "U", "comb"), (24, 42), (4.8, 6.4), (1.6, 2.2),
        ("office",) * 6 + ("meeting", "storage", "office", "kitchen"),
    ),
    "openplan": Profile(
        ("ring", "double", "double"), (28, 40), (6.5, 9.0), (1.6, 2.2), ("openplan", "openplan", "meeting", "office")
    ),
    "apartment": Profile(
        ("double", "single", "L"), (18, 32), (8.6, 9.8), (1.4, 1.8), ("flat",), cores=(), height=(2.8, 3.0), stairs=("dogleg",)
    ),
    "hotel": Profile(
        ("double", "double", "L", "U", "T"), (30, 48), (6.4, 7.2), (1.5, 1.9), ("hotel",), cores=("storage",), same=True,
        height=(2.9, 3.2), stairs=("dogleg", "straight"),
    ),
    "hospital": Profile(
        ("double", "ring", "T", "comb"), (32, 50), (6.2, 7.0), (2.2, 3.0), ("ward",) * 7 + ("office", "storage"),
        cores=("nurses", "toilets", "storage"), same=True, stairs=("dogleg", "dogleg", "ramp"),
    ),
    "school": Profile(
        ("single", "double", "L", "U", "T"), (34, 52), (7.0, 8.0), (2.4, 3.0),
        ("classroom",) * 7 + ("office", "cloakroom", "storage", "library"), cores=("hall", "toilets"), height=(3.4, 3.9),
    ),
    "lab": Profile(
        ("double", "ring", "L"), (28, 44), (6.0, 7.5), (1.8, 2.4), ("lab", "lab", "lab", "office", "office", "storage"),
        height=(3.4, 3.9),
    ),
    "house": Profile(
        ("double",), (7.5, 10.5), (3.5, 4.6), (1.4, 1.9), ("living", "kitchen", "bath", "office"),
        upper=("bedroom", "bedroom", "bath", "bedroom"), cores=(), height=(2.8, 3.0), stairs=("dogleg", "spiral"), lift=False,
    ),
}  # fmt: skip
BUILDING_KINDS = tuple(PROFILES)
CORE_WIDTHS: dict[str, Range] = {
    "office": (2.6, 4.6), "meeting": (4.0, 9.0), "storage": (1.9, 3.0), "kitchen": (2.8, 4.0), "openplan": (9.0, 16.0),
    "flat": (7.6, 9.4), "hotel": (3.5, 4.1), "ward": (3.8, 4.6), "classroom": (7.2, 9.4), "library": (9.0, 13.0),
    "cloakroom": (3.0, 4.5), "lab": (5.4, 9.5), "living": (4.2, 6.5), "bath": (2.0, 2.6), "bedroom": (2.9, 4.4),
    "toilets": (3.0, 4.5), "nurses": (4.5, 6.5), "hall": (12.0, 16.0), "lounge": (4.5, 8.0), "atrium": (7.0, 10.0),
    "lift": (2.1, 2.5),
}  # fmt: skip
INNER = ("lounge", "storage", "meeting", "kitchen", "lounge", "storage", "toilets")  # what lies in a building's middle
MERGED = {"office", "meeting", "storage", "openplan", "lab", "library", "lounge"}  # rooms that may be as wide as two
DARK = {"storage", "lift", "bath", "toilets", "corridor", "void"}  # no windows, or small ones


class Deck:
    """Kinds of rooms in a shuffled order, dealt again when all are out, so that shares hold even in small buildings.

    Half of all buildings have a module of 1.2 or 1.5 m that all widths are multiples of. `spread` is that of the difficulty.
    """

    def __init__(self, kinds: Sequence[str], style: int | None, rng: np.random.Generator, spread: float = 0.0) -> None:
        self.kinds, self.rng, self.spread = kinds, rng, spread
        self.left: list[str] = []
        self.module = float(rng.choice([0.0, 0.0, 1.2, 1.5]))
        fixed = np.random.default_rng(style)
        self.widths = {} if style is None else {k: float(fixed.uniform(*CORE_WIDTHS[k])) for k in sorted(set(kinds))}

    def _width(self, kind: str) -> float:
        """m; some rooms are as wide as two, as where a wall was left out."""
        width = float(self.rng.uniform(*CORE_WIDTHS[kind]))
        wide = kind in MERGED and self.rng.random() < self.spread
        return width * float(self.rng.uniform(1.4, 2.2)) if wide else width

    def draw(self, most: float) -> tuple[str, float]:
        """The next kind that fits into a width, and its own width; an office or a store where none fits."""
        for _ in range(2 * len(self.kinds)):
            self.left = self.left or self.rng.permutation(np.array(self.kinds)).tolist()
            kind = self.left.pop()
            if CORE_WIDTHS[kind][0] * 0.85 <= most:
                width = self.widths.get(kind) or self._width(kind)
                return kind, max(round(width / self.module), 2) * self.module if self.module else width
        return ("storage" if most < 2.8 or "flat" in self.kinds else "office"), most
