"""The tables of a report: rooms, doors, storeys, parameters and seconds, as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from topomerge.io.listing import plain, room_words
from topomerge.io.palette import room_colours
from topomerge.types import TopometricMap, door_state
from topomerge.viz.markup import Markup, element, join
from topomerge.viz.scene import hex_colour
from topomerge.viz.sureness import edge_sureness, room_sureness

ROOM_WORDS = {  # of `room_words`, and why
    "outside": "probably outdoors",
    "glimpsed": "probably only looked into, through a door or a window",
    "doubtful": "probably not a room, or only part of one",
}
Column = tuple[str, str]  # heading; "number" or "text"


def table(columns: Sequence[Column], rows: Iterable[Markup], caption: str) -> Markup:
    """A table with a heading a column, by which the page's script sorts."""
    heads = [element("th", name, class_=kind, scope="col") for name, kind in columns]
    body = element("tbody", *rows)
    return element("table", element("caption", caption), element("thead", element("tr", *heads)), body, class_="sortable")


def cell(content: str, value: float | None = None, kind: str = "number", **attributes: Any) -> Markup:
    """One cell; `value` is what it is sorted by where that is not its text."""
    number = None if value is None else f"{value:.6g}"
    return element("td", content, class_=kind, data_value=number, **attributes)


def measure(value: float, digits: int, measured: bool = True) -> Markup:
    """A cell with a number, or a dash where it is not known."""
    if not measured or not math.isfinite(value):
        return cell("–", -1.0)
    return cell(f"{value:.{digits}f}", float(value))


def room_link(key: str, room: int) -> Markup:
    """A room's number, which points at it in every view."""
    return element("a", str(room), data_room=f"{key}{room}", href="#", class_="room-link")


def share_bar(share: float) -> Markup:
    """A share as a percentage and a bar."""
    full = min(max(float(share), 0.0), 1.0)
    bar = element("span", element("i", style=f"width:{100 * full:.0f}%"), class_="bar")
    return join([bar, f"{100 * full:.0f} %"])


def rooms_table(map: TopometricMap, key: str = "", only: Iterable[int] | None = None) -> Markup:
    """All rooms, or some of them; rows carry `data-room`, `data-storey` and `data-sure`."""
    names = ("room", "storey", "area m²", "height m", "seen", "entered", "confidence", "doors")
    columns = [*((name, "number") for name in names), ("leads to", "text")]
    several_storeys = len(map.storeys) > 1
    columns = [column for column in columns if several_storeys or column[0] != "storey"]
    colours = room_colours(map)
    doors = np.bincount(map.edges["rooms"].ravel(), minlength=len(map.rooms))
    rows = []
    neighbours = _neighbours(map)
    for i in range(len(map.rooms)) if only is None else only:
        room, beside = map.rooms[i], neighbours[i]
        swatch = element("span", class_="swatch glimpsed" if room["glimpsed"] else "swatch",
                         style=f"background-color:{hex_colour(colours[i])}")  # fmt: skip
        seen = share_bar(room["completeness"])
        words = [element("em", word, title=ROOM_WORDS[word]) for word in room_words(room)]
        leads = join([*words, *(room_link(key, other) for other in beside)], " ")
        cells = [
            cell(join([swatch, str(i)]), i),
            *([cell(str(room["storey"]), int(room["storey"]))] if several_storeys else []),
            measure(room["area"], 1),
            measure(room["height"], 2, room["height"] > 0),
            cell(seen, float(room["completeness"])),
            *(cell(f"{100 * room[name]:.0f} %", float(room[name])) for name in ("entered", "confidence")),
            cell(str(doors[i]), int(doors[i])),
            cell(leads, kind="text"),
        ]
        place = {"data_room": f"{key}{i}", "data_storey": int(room["storey"]), "data_sure": room_sureness(room)}
        rows.append(element("tr", *cells, **place, tabindex=0))
    return table(columns, rows, "Rooms")


def _neighbours(map: TopometricMap) -> list[list[int]]:
    beside: list[set[int]] = [set() for _ in map.rooms]
    for a, b in map.edges["rooms"].tolist():
        beside[a].add(b)
        beside[b].add(a)
    return [sorted(rooms) for rooms in beside]


def doors_table(map: TopometricMap, key: str = "") -> Markup:
    """All doors, openings, stairs and ramps; rows carry `data-edge` and `data-sure`."""
    words, numbers = ("kind", "between", "storey", "state"), ("width m", "height m", "confidence", "x m", "y m")
    columns = [("no.", "number"), *((name, "text") for name in words), *((name, "number") for name in numbers)]
    rows = []
    for i, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        storeys = sorted(set(map.rooms["storey"][[a, b]].tolist()))
        way = edge["kind"] in ("door", "opening")
        cells = [
            cell(str(i), i),
            cell(str(edge["kind"]), kind="text"),
            cell(join([room_link(key, a), room_link(key, b)], " – "), a, kind="text"),
            cell(" – ".join(texts(storeys)), storeys[0], kind="text"),
            cell(door_state(edge) if way else "", kind="text"),
            measure(edge["width"], 2),
            measure(edge["height"], 2, edge["height"] > 0),
            cell(f"{100 * edge['confidence']:.0f} %", float(edge["confidence"])),
            measure(edge["centre"][0], 2),
            measure(edge["centre"][1], 2),
        ]
        place = {"data_edge": f"{key}{i}", "data_storey": " ".join(texts(storeys)), "data_sure": edge_sureness(map, edge)}
        rows.append(element("tr", *cells, **place, tabindex=0))
    return table(columns, rows, "Doors, openings and stairs")


def texts(values: Iterable[Any]) -> list[str]:
    """Each value as text."""
    return [str(value) for value in values]


def storeys_table(map: TopometricMap) -> Markup:
    """Floor, ceiling, area and number of rooms of each storey."""
    columns = [("storey", "number"), ("floor m", "number"), ("ceiling m", "number"), ("area m²", "number"), ("rooms", "number")]
    count = np.bincount(map.rooms["storey"], minlength=len(map.storeys))
    rows = []
    for i, storey in enumerate(map.storeys):
        numbers = [measure(storey["floor"], 2), measure(storey["ceiling"], 2), measure(storey["area"], 1)]
        rows.append(element("tr", cell(str(i), i), *numbers, cell(str(count[i]))))
    return table(columns, rows, "Storeys")


def facts(values: Mapping[str, Any], caption: str) -> Markup:
    """Names and values, such as the parameters of a map."""
    rows = [element("tr", element("th", str(name), scope="row"), element("td", _text(value))) for name, value in values.items()]
    return element("table", element("caption", caption), element("tbody", *rows), class_="facts")


def _text(value: Any) -> str:
    value = plain(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return str(value)


def seconds_table(map: TopometricMap) -> Markup:
    """Seconds of each step, with a bar by their share."""
    total = sum(map.seconds.values())
    rows = []
    for step, s in map.seconds.items():
        share = cell(share_bar(s / total if total else 0), kind="share")
        rows.append(element("tr", element("th", str(step), scope="row"), cell(f"{s:.2f}"), share))
    rows.append(element("tr", element("th", "all", scope="row"), cell(f"{total:.2f}"), element("td"), class_="total"))
    return element("table", element("caption", "Seconds"), element("tbody", *rows), class_="facts")
