"""How maps were bent, on their plans: outlines as they were and bent, an arrow for each piece, and a small table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.types import Array, Deformation, Placement
from topomerge.viz.markup import Markup, element, join
from topomerge.viz.sheet import Sheet
from topomerge.viz.tables import room_link

LONGEST_EDGE = 200.0  # cm of an outline, that are drawn straight also where they are bent
CUT_HEIGHT = 1.0  # m above the floor, where the plan shows how the map is bent
LEAST_ARROW = 0.001  # m: shorter moves have no arrow
MOST_ARROWS = 400  # on one storey, the longest
ARROW_SHARE = 0.1  # of the paper's longer side, that the longest arrows reach at most, and
LONGEST_ARROW = 500.0  # cm
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500)  # by which arrows are drawn too long


@dataclass(frozen=True, eq=False)
class PieceShifts:
    """Where the pieces of a map are and by how much they are moved, in the map's own frame.

    Args:
        anchor: (n, 2) m.
        shift: (n, 2) m, with what neighbouring pieces blend into it.
        turn: (n,) rad.
        room: (n,) of each piece, -1 none.
        storey: (n,).
    """

    anchor: Array
    shift: Array
    turn: Array
    room: Array
    storey: Array

    @classmethod
    def of(cls, bend: Deformation | None) -> PieceShifts:
        """Of no piece where the map is rigid."""
        if bend is None:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64))
        places = np.column_stack([bend.anchors, bend.floors[bend.storey] + CUT_HEIGHT])
        return cls(bend.anchors, (bend.apply(places) - places)[:, :2], bend.moves[:, 2], bend.room, bend.storey)

    @property
    def length(self) -> Array:
        """(n,) m."""
        out: Array = np.hypot(*self.shift.T)
        return out


def arrow_factor(shifts: Iterable[PieceShifts], sheet: Sheet) -> int:
    """By how much the arrows are drawn too long: a round number with which the longest are well seen and none is in the way."""
    longest = 100 * max((float(s.length.max(initial=0.0)) for s in shifts), default=0.0)
    room = min(ARROW_SHARE * max(sheet.size), LONGEST_ARROW)
    return max((f for f in FACTORS if f * longest <= room), default=1)


def arrows(name: str, shifts: PieceShifts, storey: int, sheet: Sheet, factor: int) -> Markup:
    """An arrow from where each piece of a storey was, `factor` times as long as its move; the true length in a tooltip."""
    rows = np.flatnonzero((shifts.storey == storey) & (shifts.length >= LEAST_ARROW))
    rows = np.sort(rows[np.argsort(-shifts.length[rows], kind="stable")[:MOST_ARROWS]])
    start, end = sheet.cm(shifts.anchor[rows]), sheet.cm(shifts.anchor[rows] + factor * shifts.shift[rows])
    parts = []
    for k, (x, y), (u, v) in zip(rows.tolist(), start.tolist(), end.tolist(), strict=True):
        room = f", room {shifts.room[k]}" if shifts.room[k] >= 0 else ""
        words = f"{name}{room}: moved by {centimetres(shifts.length[k])}, turned by {np.degrees(shifts.turn[k]):.2f}°"
        shaft = element("path", class_="shaft", d=_arrow(x, y, u, v))
        dot = element("circle", cx=x, cy=y)
        parts.append(element("g", element("title", words), element("path", class_="near", d=f"M{x} {y}L{u} {v}"), dot, shaft))
    return element("g", *parts, class_="bend-arrows")


def _arrow(x: int, y: int, u: int, v: int) -> str:
    """A line to (u, v) with a head, which is a third of it long, 10 to 40 cm."""
    length = max(float(np.hypot(u - x, v - y)), 1.0)
    head = min(max(length / 3, 10.0), 40.0)
    a, b = (u - x) / length * head, (v - y) / length * head
    left, right = (u - a - b / 2, v - b + a / 2), (u - a + b / 2, v - b - a / 2)
    return f"M{x} {y}L{u} {v}M{left[0]:.0f} {left[1]:.0f}L{u} {v}L{right[0]:.0f} {right[1]:.0f}"


def bent_path(d: str, sheet: Sheet, bend: Deformation, height: float) -> tuple[str, str]:
    """An outline as it was and as it is bent, with as many corners: what is between the two is between their numbers.

    Args:
        d: of closed rings, as `outline.trace` gives them.
        sheet: the paper of the map.
        bend: of the map.
        height: m, at which the plan is cut.
    """
    rigid, bent = [], []
    for ring in d.split("z")[:-1]:
        numbers = np.array(ring[1:].replace("l", " ").split(), np.int64).reshape(-1, 2)
        places = _finer(np.cumsum(numbers, axis=0))
        points = np.column_stack([sheet.metres(places), np.full(len(places), height)])
        rigid.append(_closed(places))
        bent.append(_closed(sheet.cm(bend.apply(points))))
    return "".join(rigid), "".join(bent)


def _finer(corners: Array) -> Array:
    """(n, 2) int64 cm, of a ring none of whose edges is longer than `LONGEST_EDGE`."""
    edges = np.roll(corners, -1, axis=0) - corners
    parts = np.maximum(np.ceil(np.hypot(*edges.T) / LONGEST_EDGE), 1).astype(np.int64)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = (np.arange(len(first)) - first) / np.repeat(parts, parts)
    out: Array = np.rint(np.repeat(corners, parts, axis=0) + share[:, None] * np.repeat(edges, parts, axis=0)).astype(np.int64)
    return out


def _closed(places: Array) -> str:
    (x, y), steps = places[0].tolist(), np.diff(places, axis=0).tolist()
    return f"M{x} {y}l{' '.join(f'{u} {v}' for u, v in steps)}z"


def bend_controls() -> Markup:
    """The slider from rigid to bent, and the switch of the arrows."""
    words = "From rigid to bent"
    slider = element("input", type="range", min="0", max="1", step="0.01", value="1", data_bend=True, aria_label=words)
    bar = element("div", "rigid", slider, "bent", class_="blend bend")
    box = element("label", element("input", type="checkbox", checked=True, data_layer="bends"), " arrows")
    return join([bar, element("div", box, class_="layers")])


def bend_words(count: int, factor: int) -> str:
    """What the arrows and the slider of `count` bent maps show."""
    maps = "the maps were" if count > 1 else "the map was"
    drawn = f"drawn {factor} times as long as the move" if factor > 1 else "drawn as long as the move"
    point = "point at one for its true length" if factor > 1 else "point at one for its length"
    return f"Arrows show where {maps} bent and by how much, {drawn}; {point}. The second slider bends the outlines."


def bend_table(placements: Sequence[Placement], names: Sequence[str], keys: Sequence[str | None]) -> Markup:
    """Largest and median shift of each map, and where the largest is.

    Args:
        placements: of the maps.
        names: what the page calls them.
        keys: what stands before the numbers of their rooms on the page; None where it has no plan of them.
    """
    heads = ("map", "largest shift", "median shift", "largest turn", "largest shift in")
    head = element("thead", element("tr", *(element("th", name, class_="text", scope="col") for name in heads)))
    rows = [
        element("tr", *(element("td", text, class_="text") for text in _row(PieceShifts.of(place.bend), name, key)))
        for place, name, key in zip(placements, names, keys, strict=True)
    ]
    table = element("table", element("caption", "How the maps were bent"), head, element("tbody", *rows))
    return element("div", table, class_="scroller")


def _row(shifts: PieceShifts, name: str, key: str | None) -> Iterator[str]:
    yield name
    if not len(shifts.length):
        yield from ("rigid", "–", "–", "–")
        return
    yield centimetres(float(shifts.length.max()))
    yield centimetres(float(np.median(shifts.length)))
    yield f"{np.degrees(np.abs(shifts.turn).max()):.2f}°"
    farthest = int(shifts.length.argmax())
    room, storey = int(shifts.room[farthest]), f"storey {shifts.storey[farthest]}"
    if room < 0:
        yield storey
    else:
        yield join(["room ", str(room) if key is None else room_link(key, room), f", {storey}"])


def centimetres(metres: float) -> str:
    """A length as text."""
    return f"{100 * metres:.1f} cm" if metres < 0.1 else f"{100 * metres:.0f} cm"
