"""Storeys with corridors: where the corridors run, where rooms lie along them, and where stairs and lifts go.

A layout is drawn twice: once for the whole building (corridors and cores, the same on every storey) and once a storey (how the
rows between the cores are cut into rooms).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft, snap
from topomerge.datasets.core.solids import rotation

from topomerge.types import Array

LARGEST_CORRIDOR = 140.0  # m2; larger corridors are parted by fire doors
SHAPES = ("single", "double", "ring", "L", "T", "U", "comb")


@dataclass(frozen=True, eq=False)
class Core:
    """A stretch of a row that is the same on all storeys: `kind` stairs, lift, atrium, toilets, ...

    Args:
        start, width: m along its row.
        depth: m from the corridor.
        flight: kind of stairs in it.
    """

    kind: str
    start: float
    width: float
    depth: float
    flight: str = ""


@dataclass(frozen=True, eq=False)
class Row:
    """A strip of rooms beside a corridor: from `start`, along `heading`, rooms to the left of it.

    Args:
        ends: depth at its start and end; they differ where the outer wall is slanted.
        corridor: index of the corridor that it opens to.
        inner: its back is no outer wall: no place for rooms that need daylight.
        behind: index of the corridor at its back, to which lounges open, too; -1: none.
    """

    start: tuple[float, float]
    heading: float
    length: float
    ends: tuple[float, float]
    corridor: int
    inner: bool = False
    behind: int = -1
    cores: tuple[Core, ...] = ()

    def place(self, points: Array | list[list[float]]) -> Array:
        """From metres along and left of the row to metres of the building."""
        return np.asarray(points, float) @ rotation(self.heading) + np.asarray(self.start)

    def outline(self, a: float, b: float, depth: float | None = None) -> shapely.Polygon:
        """The strip between two distances along the row."""
        near, far = (depth or self.depth(a)), (depth or self.depth(b))
        return shapely.Polygon(np.round(self.place(np.array([[a, 0], [b, 0], [b, far], [a, near]])), 3))

    def depth(self, at: float) -> float:
        """Depth at a distance along the row, m."""
        return self.ends[0] + (self.ends[1] - self.ends[0]) * at / self.length

    def gaps(self) -> list[tuple[float, float]]:
        """Stretches between the cores."""
        stops = [0.0, *(v for c in self.cores for v in (c.start, c.start + c.width)), self.length]
        return [(a, b) for a, b in zip(stops[::2], stops[1::2], strict=True) if b - a > 0.5]


@dataclass(eq=False)
class Layout:
    """Corridors, as outlines with their kind, the pairs of them that meet, and the rows."""

    corridors: list[shapely.Polygon] = field(default_factory=list)
    joints: list[tuple[int, int]] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    ends: list[shapely.Polygon] = field(default_factory=list)  # lounges at a corridor's end, of corridor 0

    def taken(self, row: int) -> list[shapely.Polygon]:
        """Everything that a core which reaches out of a row must not meet."""
        rows = [r.outline(0, r.length) for i, r in enumerate(self.rows) if i != row]
        cores = [r.outline(c.start, c.start + c.width, c.depth) for r in self.rows for c in r.cores]
        return [*self.corridors, *self.ends, *rows, *cores]


@dataclass(frozen=True)
class Size:
    """What a layout is drawn from: metres of the main corridor, of the rows on its two sides, and of its width."""

    length: float
    near: float
    far: float
    corridor: float
    curved: bool = False


def make_layout(shape: str, size: Size, rng: np.random.Generator) -> Layout:
    """Corridors and rows of a shape of `SHAPES`."""
    if shape == "ring":
        return _ring(size, rng)
    w, d, length = size.corridor, size.far, size.length
    span = w + 2 * d
    wings = {"L": [length - d - w], "T": [(length - w) / 2], "U": [d, length - d - w]}.get(shape, [])
    if shape in ("U", "comb"):
        length = max(length, (2 if shape == "U" else 3) * (span + 5.0) - 5.0)
        step = (length - span) / (1 if shape == "U" else 2)
        wings = [d + i * step for i in range(2 if shape == "U" else 3)]
    wings, length = [round(x, 2) for x in wings], round(length, 2)
    layout = Layout([shapely.box(0, 0, length, w)])
    slant = float(rng.uniform(1.2, 1.5)) if size.curved and rng.random() < 0.5 else 1.0
    layout.rows.append(Row((length, 0.0), np.pi, length, (size.near * slant, size.near), 0))
    stops = [0.0, *(v for x in wings for v in (x, x + w)), length]
    if shape != "single":
        for a, b in zip(stops[::2], stops[1::2], strict=True):
            layout.rows.append(Row((a, w), 0.0, b - a, (d, d), 0))
    for x in wings:
        _wing(layout, x, w, d, round(float(rng.uniform(0.5, 0.8)) * size.length, 2))
    if size.curved and slant == 1.0:
        round_end = shapely.Point(length, w / 2).buffer(rng.uniform(3.0, 4.5), 6)
        layout.ends.append(round_end.intersection(shapely.box(length, -9, length + 9, w + 9)))
    return layout


def _wing(layout: Layout, x: float, w: float, d: float, length: float) -> None:
    """A side corridor that leaves the main one at x, with rooms on both sides."""
    number = len(layout.corridors)
    layout.corridors.append(shapely.box(x, w, x + w, w + d + length))
    layout.joints.append((0, number))
    layout.rows.append(Row((x, w + d), np.pi / 2, length, (d, d), number))
    layout.rows.append(Row((x + w, w + d + length), -np.pi / 2, length, (d, d), number))


def _ring(size: Size, rng: np.random.Generator) -> Layout:
    """A corridor around a core of one or two rows, in two halves that doors part; rooms on its outside."""
    w, d = size.corridor, size.near
    back_to_back = bool(rng.random() < 0.5)
    deep = round(float(rng.uniform(4.0, 5.0)), 2)
    long, wide = round(max(size.length - 2 * d, 16.0), 2), round(2 * w + (1 + back_to_back) * deep, 2)
    low = shapely.box(0, 0, long - w, w).union(shapely.box(0, 0, w, wide))
    high = shapely.box(w, wide - w, long, wide).union(shapely.box(long - w, 0, long, wide))
    layout = Layout([low, high], [(0, 1)])
    layout.rows += [
        Row((long - w, 0.0), np.pi, long - w, (d, d), 0),
        Row((w, wide), 0.0, long - w, (d, d), 1),
        Row((0.0, 0.0), np.pi / 2, wide, (size.far, size.far), 0),
        Row((long, wide), -np.pi / 2, wide, (size.far, size.far), 1),
        Row((w, w), 0.0, long - 2 * w, (deep, deep), 0, True, -1 if back_to_back else 1),
    ]
    if back_to_back:
        layout.rows.append(Row((long - w, wide - w), np.pi, long - 2 * w, (deep, deep), 1, True))
    return layout


def draw(layout: Layout, draft: Draft, kind: str = "corridor", merge: bool = False) -> list[int]:
    """Draw the corridors into a draft; returns the room of each corridor.

    Args:
        merge: make one room of corridors that meet, instead of parting them by doors.
    """
    outlines = [snap(c) for c in layout.corridors]
    owner = list(range(len(outlines)))
    if merge:
        for a, b in layout.joints:
            union = outlines[a].union(outlines[b])
            if union.geom_type == "Polygon" and not union.interiors and union.area < LARGEST_CORRIDOR:
                outlines[a], owner[b] = union, a
    rooms = {i: draft.room(outlines[i].simplify(1e-3), kind) for i in sorted(set(owner))}
    for a, b in layout.joints:
        if owner[a] != owner[b]:
            width = min(1.6, _width(outlines[b]) - 0.5)
            pieces = shapely.get_parts(shapely.line_merge(outlines[a].intersection(outlines[b])))
            for piece in (p for p in pieces if p.geom_type == "LineString" and p.length > 1.2):
                draft.cut(piece, min(width, piece.length - 0.45), "door", 0.5)
    for end in layout.ends:
        lounge = draft.room(end, "lobby")
        draft.door(rooms[owner[0]], lounge, min(1.2, _width(outlines[0]) - 0.55), at=0.5)
    return [rooms[o] for o in owner]


def _width(outline: shapely.Polygon) -> float:
    return float(2 * outline.area / outline.length * 1.02)
