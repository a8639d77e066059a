"""Storeys with corridors: profiles of kinds, corridors, rows of rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft, snap
from topomerge.datasets.core.solids import build_rotation

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

    def transform_points(self, points: Array | list[list[float]]) -> Array:
        """Transform metres along and left of the row into metres of the building."""
        return np.asarray(points, float) @ build_rotation(self.heading) + np.asarray(self.start)

    def build_outline(self, a: float, b: float, depth: float | None = None) -> shapely.Polygon:
        """Build the strip between two distances along the row."""
        near, far = (depth or self.interpolate_depth(a)), (depth or self.interpolate_depth(b))
        return shapely.Polygon(np.round(self.transform_points(np.array([[a, 0], [b, 0], [b, far], [a, near]])), 3))

    def interpolate_depth(self, at: float) -> float:
        """Return depth at a distance along the row, m."""
        return self.ends[0] + (self.ends[1] - self.ends[0]) * at / self.length

    def list_gaps(self) -> list[tuple[float, float]]:
        """List stretches between the cores."""
        stops = [0.0, *(v for c in self.cores for v in (c.start, c.start + c.width)), self.length]
        return [(a, b) for a, b in zip(stops[::2], stops[1::2], strict=True) if b - a > 0.5]


@dataclass(eq=False)
class Layout:
    """Corridors, as outlines with their kind, the pairs of them that meet, and the rows."""

    corridors: list[shapely.Polygon] = field(default_factory=list)
    joints: list[tuple[int, int]] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    ends: list[shapely.Polygon] = field(default_factory=list)  # lounges at a corridor's end, of corridor 0

    def list_obstacles(self, row: int) -> list[shapely.Polygon]:
        """List everything that a core which reaches out of a row must not meet."""
        rows = [r.build_outline(0, r.length) for i, r in enumerate(self.rows) if i != row]
        cores = [r.build_outline(c.start, c.start + c.width, c.depth) for r in self.rows for c in r.cores]
        return [*self.corridors, *self.ends, *rows, *cores]


@dataclass(frozen=True)
class Size:
    """Sizes that a layout is drawn from: metres of the main corridor, of the rows on its two sides, and of its width."""

    length: float
    near: float
    far: float
    corridor: float
    curved: bool = False


def make_layout(shape: str, size: Size, rng: np.random.Generator) -> Layout:
    """Make corridors and rows of a shape of `SHAPES`."""
    if shape == "ring":
        return _draw_ring(size, rng)
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
        _add_wing(layout, x, w, d, round(float(rng.uniform(0.5, 0.8)) * size.length, 2))
    if size.curved and slant == 1.0:
        round_end = shapely.Point(length, w / 2).buffer(rng.uniform(3.0, 4.5), 6)
        layout.ends.append(round_end.intersection(shapely.box(length, -9, length + 9, w + 9)))
    return layout


def _add_wing(layout: Layout, x: float, w: float, d: float, length: float) -> None:
    """Add a side corridor that leaves the main one at x, with rooms on both sides."""
    number = len(layout.corridors)
    layout.corridors.append(shapely.box(x, w, x + w, w + d + length))
    layout.joints.append((0, number))
    layout.rows.append(Row((x, w + d), np.pi / 2, length, (d, d), number))
    layout.rows.append(Row((x + w, w + d + length), -np.pi / 2, length, (d, d), number))


def _draw_ring(size: Size, rng: np.random.Generator) -> Layout:
    """Draw a corridor around a core of one or two rows, in two halves that doors part; rooms on its outside."""
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
    """Draw the corridors into a draft; return the room of each corridor.

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
    rooms = {i: draft.add_room(outlines[i].simplify(1e-3), kind) for i in sorted(set(owner))}
    for a, b in layout.joints:
        if owner[a] != owner[b]:
            width = min(1.6, _measure_width(outlines[b]) - 0.5)
            pieces = shapely.get_parts(shapely.line_merge(outlines[a].intersection(outlines[b])))
            for piece in (p for p in pieces if p.geom_type == "LineString" and p.length > 1.2):
                draft.cut(piece, min(width, piece.length - 0.45), "door", 0.5)
    for end in layout.ends:
        lounge = draft.add_room(end, "lobby")
        draft.add_door(rooms[owner[0]], lounge, min(1.2, _measure_width(outlines[0]) - 0.55), at=0.5)
    return [rooms[o] for o in owner]


def _measure_width(outline: shapely.Polygon) -> float:
    return float(2 * outline.area / outline.length * 1.02)


Range = tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """Distributions that a kind of building is drawn from; lengths in metres.

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


class RoomDeck:
    """Kinds of rooms in a shuffled order, dealt again when all are out, so that shares hold even in small buildings.

    Half of all buildings have a module of 1.2 or 1.5 m that all widths are multiples of. `spread` is that of the difficulty.
    """

    def __init__(self, kinds: Sequence[str], style: int | None, rng: np.random.Generator, spread: float = 0.0) -> None:
        self.kinds, self.rng, self.spread = kinds, rng, spread
        self.left: list[str] = []
        self.module = float(rng.choice([0.0, 0.0, 1.2, 1.5]))
        fixed = np.random.default_rng(style)
        self.widths = {} if style is None else {k: float(fixed.uniform(*CORE_WIDTHS[k])) for k in sorted(set(kinds))}

    def _sample_width(self, kind: str) -> float:
        """Sample a width, m; some rooms are as wide as two, as where a wall was left out."""
        width = float(self.rng.uniform(*CORE_WIDTHS[kind]))
        wide = kind in MERGED and self.rng.random() < self.spread
        return width * float(self.rng.uniform(1.4, 2.2)) if wide else width

    def draw(self, most: float) -> tuple[str, float]:
        """Draw the next kind that fits into a width, and its own width; an office or a store where none fits."""
        for _ in range(2 * len(self.kinds)):
            self.left = self.left or self.rng.permutation(np.array(self.kinds)).tolist()
            kind = self.left.pop()
            if CORE_WIDTHS[kind][0] * 0.85 <= most:
                width = self.widths.get(kind) or self._sample_width(kind)
                return kind, max(round(width / self.module), 2) * self.module if self.module else width
        return ("storage" if most < 2.8 or "flat" in self.kinds else "office"), most


CLOSETED = ("office", "meeting", "openplan", "classroom", "lab", "library", "living", "kitchen", "bedroom")


def fill_row(
    draft: Draft,
    row: Row,
    gap: Range,
    deck: RoomDeck,
    corridor: int,
    rng: np.random.Generator,
    closets: float,
) -> list[tuple[int, int]]:
    """Cut a stretch of a row into rooms, each with a door to the corridor."""
    kinds: list[str] = []
    drawn: list[Any] = []
    length = gap[1] - gap[0]
    while sum(drawn) < length:
        kind, width = deck.draw(length)
        if drawn and sum(drawn) + width / 2 > length:  # better stretch the others than squeeze this one in
            break
        kinds.append(kind)
        drawn.append(width)
    ends = np.cumsum(drawn)
    cuts = np.round(gap[0] + np.concatenate([[0.0], ends]) * length / ends[-1], 2)
    cuts[-1] = gap[1]
    out = []
    for kind, a, b in zip(kinds, cuts[:-1], cuts[1:], strict=False):
        out += _add_row_room(draft, row, (float(a), float(b)), kind, corridor, rng, closets)
    rooms = [r for r, _ in out]
    for left, right in pairwise(rooms):
        if {draft.rooms[left].kind, draft.rooms[right].kind} <= {
            "office",
            "meeting",
            "lab",
            "living",
            "kitchen",
        } and rng.random() < 0.12:
            draft.add_door(left, right, 0.85)
    return out


def _add_row_room(
    draft: Draft, row: Row, span: Range, kind: str, corridor: int, rng: np.random.Generator, closets: float
) -> list[tuple[int, int]]:
    """Add one room of a row; hotel rooms and wards have their own bath, flats are several rooms."""
    a, b = span
    outline = row.build_outline(a, b)
    if b - a < 1.4:
        kind = "storage"
    if kind == "flat" and b - a > 6.0:
        return _add_flat(draft, row, span, corridor, rng)
    if kind in ("hotel", "ward") and b - a > 3.2:
        return _add_ensuite(draft, row, span, kind, corridor)
    kind = {"flat": "storage"}.get(kind, kind)
    closet = _add_closet(draft, row, span, rng) if kind in CLOSETED and rng.random() < closets and b - a > 3.6 else None
    room = draft.add_room(outline if closet is None else outline.difference(draft.outlines[closet]), kind)
    if closet is not None:
        draft.add_door(closet, room if rng.random() < 0.5 else corridor, 0.75)
    usual = float(rng.choice([0.8, 0.85, 0.9, 0.9, 1.0, 1.0, 1.25 if kind != "storage" else 0.9]))
    usual = float(rng.choice([1.0, 1.5])) if kind == "meeting" else usual
    wide = {"classroom": 1.0, "ward": 1.2, "lab": 1.2, "openplan": 1.6, "living": 1.2}.get(kind, usual)
    opening = "opening" if kind in ("openplan", "living") and rng.random() < 0.5 else "door"
    if kind == "lounge":
        wide, opening = 2.4, "opening"
    draft.add_door(room, corridor, min(wide, b - a - 0.6), opening)
    if b - a > 8.5:
        draft.add_door(room, corridor, min(wide, 1.0))
    return [(room, corridor)]


def _add_closet(draft: Draft, row: Row, span: Range, rng: np.random.Generator) -> int:
    """Add a closet in the corner of a room, beside the corridor."""
    a, b = span
    wide, deep = np.round(rng.uniform(1.6, min(2.4, (b - a) / 2.1)), 2), np.round(rng.uniform(1.75, 2.8), 2)
    start = a if rng.random() < 0.5 else b - wide
    return draft.add_room(row.build_outline(start, start + wide, min(deep, row.interpolate_depth(a) * 0.6)), "storage")


def _add_ensuite(draft: Draft, row: Row, span: Range, kind: str, corridor: int) -> list[tuple[int, int]]:
    """Add a bath beside the entrance; every second room is mirrored, so that baths lie back to back."""
    a, b = span
    mirrored = len(draft.rooms) % 4 >= 2
    wide, deep = min(2.0, b - a - 1.8), 2.2
    box = row.build_outline(b - wide, b, deep) if mirrored else row.build_outline(a, a + wide, deep)
    bath = draft.add_room(box, "bath")
    room = draft.add_room(row.build_outline(a, b).difference(box), kind)
    draft.add_door(room, corridor, 0.95 if kind == "hotel" else 1.2, at=0.5)
    draft.add_door(bath, room, 0.75)
    return [(room, corridor)]


def _add_flat(draft: Draft, row: Row, span: Range, corridor: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Add a flat: a hall from the corridor; bath, kitchen and bedrooms beside it, the living room at its end."""
    a, b = span
    depth = min(row.ends)
    mirrored = bool(rng.random() < 0.5)

    def box(x0: float, y0: float, x1: float, y1: float) -> shapely.Polygon:
        u, v = (b - x1, b - x0) if mirrored else (a + x0, a + x1)
        return shapely.Polygon(np.round(row.transform_points([[u, y0], [v, y0], [v, y1], [u, y1]]), 3))

    width, side, hall = b - a, round(float(rng.uniform(2.7, 3.4)), 2), 1.4
    bath, kitchen, back = 2.3, round(float(rng.uniform(2.6, 3.0)), 2), round(depth * float(rng.uniform(0.52, 0.6)), 2)
    entry = draft.add_room(box(side, 0, side + hall, back), "corridor")
    rooms = [
        draft.add_room(box(0, 0, side, bath), "bath"),
        draft.add_room(box(0, bath, side, depth), "bedroom"),
        draft.add_room(box(side, back, width, depth), "living"),
    ]
    right = (side + hall, width)
    if back - kitchen > 2.2 and right[1] - right[0] > 2.4:
        rooms.append(draft.add_room(box(right[0], 0, right[1], kitchen), "kitchen"))
        rooms.append(draft.add_room(box(right[0], kitchen, right[1], back), "bedroom"))
    else:
        rooms.append(draft.add_room(box(right[0], 0, right[1], back), "kitchen"))
    draft.add_door(entry, corridor, 0.9, state="", at=0.5)
    for room in rooms:
        wide = 0.75 if draft.rooms[room].kind == "bath" else 0.85
        if not draft.add_door(entry, room, wide):
            draft.add_door(rooms[2], room, wide)
    return []
