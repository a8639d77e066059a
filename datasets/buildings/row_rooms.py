"""Rooms along a corridor: a stretch of a row is cut up by the kind's deck of rooms; some rooms are several (baths, flats)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.layouts import Row
from topomerge.datasets.buildings.profiles import Deck, Range

CLOSETED = ("office", "meeting", "openplan", "classroom", "lab", "library", "living", "kitchen", "bedroom")


def fill_row(
    draft: Draft,
    row: Row,
    gap: Range,
    deck: Deck,
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
        out += _row_room(draft, row, (float(a), float(b)), kind, corridor, rng, closets)
    rooms = [r for r, _ in out]
    for left, right in pairwise(rooms):
        if {draft.rooms[left].kind, draft.rooms[right].kind} <= {
            "office",
            "meeting",
            "lab",
            "living",
            "kitchen",
        } and rng.random() < 0.12:
            draft.door(left, right, 0.85)
    return out


def _row_room(
    draft: Draft, row: Row, span: Range, kind: str, corridor: int, rng: np.random.Generator, closets: float
) -> list[tuple[int, int]]:
    """One room of a row; hotel rooms and wards have their own bath, flats are several rooms."""
    a, b = span
    outline = row.outline(a, b)
    if b - a < 1.4:
        kind = "storage"
    if kind == "flat" and b - a > 6.0:
        return _flat(draft, row, span, corridor, rng)
    if kind in ("hotel", "ward") and b - a > 3.2:
        return _ensuite(draft, row, span, kind, corridor)
    kind = {"flat": "storage"}.get(kind, kind)
    closet = _closet(draft, row, span, rng) if kind in CLOSETED and rng.random() < closets and b - a > 3.6 else None
    room = draft.room(outline if closet is None else outline.difference(draft.outlines[closet]), kind)
    if closet is not None:
        draft.door(closet, room if rng.random() < 0.5 else corridor, 0.75)
    usual = float(rng.choice([0.8, 0.85, 0.9, 0.9, 1.0, 1.0, 1.25 if kind != "storage" else 0.9]))
    usual = float(rng.choice([1.0, 1.5])) if kind == "meeting" else usual
    wide = {"classroom": 1.0, "ward": 1.2, "lab": 1.2, "openplan": 1.6, "living": 1.2}.get(kind, usual)
    opening = "opening" if kind in ("openplan", "living") and rng.random() < 0.5 else "door"
    if kind == "lounge":
        wide, opening = 2.4, "opening"
    draft.door(room, corridor, min(wide, b - a - 0.6), opening)
    if b - a > 8.5:
        draft.door(room, corridor, min(wide, 1.0))
    return [(room, corridor)]


def _closet(draft: Draft, row: Row, span: Range, rng: np.random.Generator) -> int:
    """A closet in the corner of a room, beside the corridor."""
    a, b = span
    wide, deep = np.round(rng.uniform(1.6, min(2.4, (b - a) / 2.1)), 2), np.round(rng.uniform(1.75, 2.8), 2)
    start = a if rng.random() < 0.5 else b - wide
    return draft.room(row.outline(start, start + wide, min(deep, row.depth(a) * 0.6)), "storage")


def _ensuite(draft: Draft, row: Row, span: Range, kind: str, corridor: int) -> list[tuple[int, int]]:
    """A bath beside the entrance; every second room is mirrored, so that baths lie back to back."""
    a, b = span
    mirrored = len(draft.rooms) % 4 >= 2
    wide, deep = min(2.0, b - a - 1.8), 2.2
    box = row.outline(b - wide, b, deep) if mirrored else row.outline(a, a + wide, deep)
    bath = draft.room(box, "bath")
    room = draft.room(row.outline(a, b).difference(box), kind)
    draft.door(room, corridor, 0.95 if kind == "hotel" else 1.2, at=0.5)
    draft.door(bath, room, 0.75)
    return [(room, corridor)]


def _flat(draft: Draft, row: Row, span: Range, corridor: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """A flat: a hall from the corridor; bath, kitchen and bedrooms beside it, the living room at its end."""
    a, b = span
    depth = min(row.ends)
    mirrored = bool(rng.random() < 0.5)

    def box(x0: float, y0: float, x1: float, y1: float) -> shapely.Polygon:
        u, v = (b - x1, b - x0) if mirrored else (a + x0, a + x1)
        return shapely.Polygon(np.round(row.place([[u, y0], [v, y0], [v, y1], [u, y1]]), 3))

    width, side, hall = b - a, round(float(rng.uniform(2.7, 3.4)), 2), 1.4
    bath, kitchen, back = 2.3, round(float(rng.uniform(2.6, 3.0)), 2), round(depth * float(rng.uniform(0.52, 0.6)), 2)
    entry = draft.room(box(side, 0, side + hall, back), "corridor")
    rooms = [
        draft.room(box(0, 0, side, bath), "bath"),
        draft.room(box(0, bath, side, depth), "bedroom"),
        draft.room(box(side, back, width, depth), "living"),
    ]
    right = (side + hall, width)
    if back - kitchen > 2.2 and right[1] - right[0] > 2.4:
        rooms.append(draft.room(box(right[0], 0, right[1], kitchen), "kitchen"))
        rooms.append(draft.room(box(right[0], kitchen, right[1], back), "bedroom"))
    else:
        rooms.append(draft.room(box(right[0], 0, right[1], back), "kitchen"))
    draft.door(entry, corridor, 0.9, state="", at=0.5)
    for room in rooms:
        wide = 0.75 if draft.rooms[room].kind == "bath" else 0.85
        if not draft.door(entry, room, wide):
            draft.door(rooms[2], room, wide)
    return []
