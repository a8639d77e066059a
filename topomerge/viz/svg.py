"""The plan of a map as SVG: one drawing a storey, all of one size, whose parts a page can style and point at.

Units are centimetres on the paper (`sheet.py`), y down. Sizes that must not grow with the drawing (text,
thin lines) are in steps of `--unit`, the centimetres that one pixel of the screen measures: the page's script sets it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from topomerge.io.palette import room_colours
from topomerge.types import Array, TopometricMap
from topomerge.viz.markup import Markup, element
from topomerge.viz.outline import room_outlines, seen_outline, wall_outline
from topomerge.viz.plan import Place, StoreyPlan, places
from topomerge.viz.scene import hex_colour
from topomerge.viz.sheet import Sheet
from topomerge.viz.sureness import edge_sureness, room_sureness, window_sureness

SCREEN = (840, 560)  # pixels that the drawing is expected to have: the page's script knows better
PLAN_MARGIN = 0.04  # of the longer side, around the building
SHORTEST_FLIGHT = 0.5  # m: stairs whose ends are nearer to each other, seen from above, are drawn as a sign


def plan_svgs(map: TopometricMap, sheet: Sheet, plans: Sequence[StoreyPlan], colours: Array | None = None) -> list[Markup]:
    """The plan of each storey, lowest first.

    Args:
        map: any map.
        sheet: the paper, and `plans`, the plan of each storey: both from `lay_out`.
        colours: (R, 3) uint8 of the rooms; neighbours differ if None.

    Returns:
        `<svg class="plan" data-storey=…>` elements. Rooms, their labels and their nodes in the graph carry `data-room`, and all
        that is not certain `data-sure`.
    """
    colours = room_colours(map) if colours is None else colours
    named = [places(plan, sheet.frame) for plan in plans]
    everywhere = {room: place for of_storey in named for room, place in of_storey.items()}
    drawings = []
    for storey, plan in enumerate(plans):
        outlines = room_outlines(plan, sheet)
        layers = [
            element("path", class_="seen", d=seen_outline(plan, sheet)),
            _layer("rooms", [_room(map, sheet, i, d, hex_colour(colours[i])) for i, d in outlines.items()]),
            element("path", class_="wall", d=wall_outline(plan, sheet), fill_rule="evenodd"),
            _layer("windows", _windows(map, sheet, storey)),
            _layer("areas", _narrows(map, sheet, storey)),
            _layer("graph", _graph(map, sheet, storey, everywhere)),
            _layer("doors", _doors(map, sheet, storey)),
            _layer("labels", [_label(map, sheet, i, place) for i, place in sorted(named[storey].items())]),
        ]
        drawings.append(drawing(map, sheet, storey, layers))
    return drawings


def _layer(name: str, parts: list[Markup]) -> Markup:
    return element("g", *parts, class_=name)


def drawing(map: TopometricMap, sheet: Sheet, storey: int, layers: list[Markup]) -> Markup:
    """One `<svg class="plan">` of what its layers hold, with scale bar and axes, that the page's script can zoom."""
    width, height = sheet.size
    margin = round(PLAN_MARGIN * max(width, height)) + 30
    unit = max((width + 2 * margin) / SCREEN[0], (height + 2 * margin) / SCREEN[1])
    hatch = f"hatch-{sheet.key}{storey}"
    stripe = element("line", x1=0, y1=0, x2=0, y2=24)
    pattern = element("pattern", stripe, id=hatch, width=24, height=24, patternUnits="userSpaceOnUse",
                      patternTransform="rotate(45)", class_="hatch")  # fmt: skip
    glimpsed = np.flatnonzero(map.rooms["glimpsed"] & (map.rooms["storey"] == storey)) if len(map.rooms) else ()
    style = f"--unit:{unit:.3f};" + (f"--hatch:url(#{hatch})" if len(glimpsed) else "")
    return element(
        "svg",
        element("defs", pattern),
        *layers,
        _scale_bar(height, margin, unit),
        _axes(sheet, margin, unit),
        class_="plan",
        viewBox=f"{-margin} {-margin} {width + 2 * margin} {height + 2 * margin + round(26 * unit)}",
        data_storey=storey,
        data_back=" ".join(f"{value:.8g}" for value in sheet.back),
        style=style,
        role="img",
        aria_label=f"Plan of storey {storey}",
    )


def _scale_bar(height: int, margin: int, unit: float) -> Markup:
    """A bar of a round length below the drawing; the page's script makes another when the drawing is zoomed."""
    lengths = [m * 10**k for k in range(-2, 6) for m in (1, 2, 5)]
    length = max((s for s in lengths if 100 * s <= 160 * unit), default=lengths[0])
    bar = element("path", d=f"M0 0v{6 * unit:.0f}h{100 * length:.0f}v{-6 * unit:.0f}")
    text = element("text", f"{length:g} m", x=round(100 * length + 6 * unit), y=round(6 * unit))
    return element("g", bar, text, class_="scale", transform=f"translate(0 {height + margin})")


def _axes(sheet: Sheet, margin: int, unit: float) -> Markup:
    """The directions of the input's x and y, in the lower right corner."""
    width, height = sheet.size
    parts = []
    for name, angle in (("x", sheet.turn), ("y", sheet.turn + math.pi / 2)):
        u, v = math.cos(angle), -math.sin(angle)
        parts.append(element("path", d=f"M0 0L{20 * u:.1f} {20 * v:.1f}"))
        parts.append(element("text", name, x=round(28 * u, 1), y=round(28 * v, 1)))
    mark = element("g", *parts, transform=f"scale({unit:.3f})")
    return element("g", mark, class_="axes", transform=f"translate({width + margin - round(40 * unit)} {height + margin})")


def _room(map: TopometricMap, sheet: Sheet, room: int, path: str, colour: str) -> Markup:
    about = map.rooms[room]
    kind = "room glimpsed" if about["glimpsed"] else "room"
    words = f"Room {room}, {about['area']:.1f} m²"
    drawn = {"d": path, "fill_rule": "evenodd", "data_sure": room_sureness(about)}
    shape = element("path", class_=kind, **drawn, fill=colour, data_room=sheet.id(room), aria_label=words)
    if not about["glimpsed"]:
        return shape
    return Markup(shape + element("path", class_="over", **drawn))


def _label(map: TopometricMap, sheet: Sheet, room: int, place: Place) -> Markup:
    """Number and area; the page's script hides what has no room."""
    x, y = sheet.at((place.x, place.y))
    number = element("text", str(room), class_="number")
    area = element("text", f"{map.rooms['area'][room]:.1f} m²", class_="size")
    clear = round(100 * place.clear)
    about = {"data_room": sheet.id(room), "data_clear": clear, "data_sure": room_sureness(map.rooms[room])}
    return element("g", number, area, class_="label", transform=f"translate({x} {y})", **about)


def _ends(edge: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    """The two jambs of a door, seen from above, m."""
    x, y = edge["centre"][:2].tolist()
    half = max(float(edge["width"]), 0.2) / 2
    u, v = -math.sin(edge["direction"]) * half, math.cos(edge["direction"]) * half
    return (x - u, y - v), (x + u, y + v)


def _line(sheet: Sheet, a: Any, b: Any, **attributes: Any) -> Markup:
    (x1, y1), (x2, y2) = sheet.at(a), sheet.at(b)
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def _doors(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    parts = []
    labelled: set[int] = set()  # rooms above or below that a word names already
    for i, edge in enumerate(map.edges):
        rooms = [room for room in edge["rooms"].tolist() if map.rooms["storey"][room] == storey]
        if not rooms:
            continue
        if edge["kind"] in ("stairs", "ramp"):
            parts.append(_stairs(map, sheet, storey, i, labelled))
            continue
        state = f"door {edge['kind']} {'open' if edge['open'] else 'shut'}"
        lines = [_line(sheet, *_ends(edge), class_=name) for name in ("gap", "leaf")]
        parts.append(element("g", *lines, class_=state, **_edge_data(map, sheet, i)))
    return parts


def _edge_data(map: TopometricMap, sheet: Sheet, i: int) -> dict[str, str]:
    return {"data_edge": f"{sheet.key}{i}", "data_sure": edge_sureness(map, map.edges[i])}


def _stairs(map: TopometricMap, sheet: Sheet, storey: int, i: int, labelled: set[int]) -> Markup:
    """Treads from the lower to the upper end with an arrow up, and a word where they lead, once for each room."""
    edge = map.edges[i]
    a, b = edge["rooms"].tolist()
    other = b if map.rooms["storey"][a] == storey else a
    level = int(map.rooms["storey"][other])
    parts: list[Markup] = []
    spot = edge["centre"]
    if np.hypot(*(edge["upper"] - edge["lower"])[:2]) >= SHORTEST_FLIGHT:
        parts = _flight(sheet.at(edge["lower"]), sheet.at(edge["upper"]), float(edge["width"]), edge["kind"] == "stairs")
        spot = (edge["lower"] + edge["upper"]) / 2
    words = [] if parts else [element("path", class_="sign", d="M-6 5L0 -6L6 5z")]
    if other not in labelled:
        labelled.add(other)
        words.append(element("text", f"{'up ' if level > storey else 'down ' if level < storey else ''}to {other}"))
    x, y = sheet.at(spot)
    place = element("g", *words, class_="to", transform=f"translate({x} {y})")
    return element("g", *parts, place, class_=f"door {edge['kind']}", **_edge_data(map, sheet, i))


def _flight(lower: tuple[int, int], upper: tuple[int, int], width: float, treads: bool) -> list[Markup]:
    """An arrow up and, across it, treads 30 cm apart."""
    (x, y), (x2, y2) = lower, upper
    length = math.hypot(x2 - x, y2 - y)
    u, v = (x2 - x) / length, (y2 - y) / length
    half = 50 * max(width, 0.6)

    def at(along: float, across: float) -> str:
        return f"{x + u * along - v * across:.0f} {y + v * along + u * across:.0f}"

    lines = "".join(f"M{at(s, -half)}L{at(s, half)}" for s in range(0, int(length) + 1, 30)) if treads else ""
    arrow = f"M{at(0, 0)}L{at(length, 0)}M{at(length - 30, -18)}L{at(length, 0)}L{at(length - 30, 18)}"
    return [element("path", class_="tread", d=lines), element("path", class_="flight", d=arrow)]


def _graph(map: TopometricMap, sheet: Sheet, storey: int, named: dict[int, Place]) -> list[Markup]:
    """Lines from room to door to room; of stairs the half that lies on this storey."""
    parts = []
    for edge in map.edges:
        rooms = [room for room in edge["rooms"].tolist() if room in named and map.rooms["storey"][room] == storey]
        if not rooms:
            continue
        spots = [sheet.at((named[room].x, named[room].y)) for room in rooms]
        spots.insert(1, sheet.at(edge["centre"]))
        path = "M" + "L".join(f"{x} {y}" for x, y in spots)
        parts.append(element("path", class_=f"link {edge['kind']}", d=path, data_sure=edge_sureness(map, edge)))
    for room, place in sorted(named.items()):
        if map.rooms["storey"][room] == storey:
            x, y = sheet.at((place.x, place.y))
            about = {"data_room": sheet.id(room), "data_sure": room_sureness(map.rooms[room])}
            parts.append(element("circle", class_="node", cx=x, cy=y, **about))
    return parts


def _narrows(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    """Where rooms narrow: thin dashed lines between their areas."""
    if not len(map.narrows):
        return []
    rooms = map.rooms[map.areas["room"][map.narrows["rooms"][:, 0]]]
    shown = [(edge, room) for edge, room in zip(map.narrows, rooms, strict=True) if room["storey"] == storey]
    return [_line(sheet, *_ends(edge), class_="narrow", data_sure=room_sureness(room)) for edge, room in shown]


def _windows(map: TopometricMap, sheet: Sheet, storey: int) -> list[Markup]:
    """Thin double lines in a gap of the wall, as in floor plans."""
    on_storey = map.rooms["storey"][map.windows["rooms"][:, 0]] == storey
    parts = []
    for window in map.windows[on_storey]:
        lines = [_line(sheet, *_ends(window), class_=name) for name in ("gap", "frame", "pane")]
        parts.append(element("g", *lines, class_="window", data_sure=window_sureness(map, window)))
    return parts
