"""The tables of a report, as HTML into which nothing from outside can get as markup."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from topomerge.archive import convert_to_plain
from topomerge.io.listing import describe_landmarks, describe_room
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.types import LANDMARK_KINDS, TopometricMap, classify_door_state, find_room_names
from topomerge.viz.plan import format_hex_colour

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # no text on a page needs them, and names of files may hold them
SPECIAL = re.compile(r"""[&<>"']|""" + CONTROL.pattern)
VOID = frozenset(("br", "input", "meta", "col"))


class Markup(str):
    """Text that is markup already; any other string is escaped where it is put into an element."""

    __slots__ = ()


def _escape(text: str) -> str:
    if not SPECIAL.search(text):  # nearly all: numbers
        return text
    return html.escape(CONTROL.sub("\N{REPLACEMENT CHARACTER}", text))


def build_element(name: str, *content: str, **attributes: Any) -> Markup:
    """Build one element with its content.

    Args:
        name: its name.
        content: `Markup` as it is; other strings escaped.
        attributes: values are escaped. An underscore stands for a hyphen, one at the end is dropped (`class_`); None and
            False leave the attribute out, True gives it without a value.
    """
    parts = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        parts.append(key if value is True else f'{key}="{_escape(str(value))}"')
    inside = "".join(part if isinstance(part, Markup) else _escape(part) for part in content)
    if name in VOID:
        return Markup(f"<{' '.join(parts)}>")
    return Markup(f"<{' '.join(parts)}>{inside}</{name}>")


def join(parts: Iterable[str], between: str = "") -> Markup:
    """Join parts one after another; those that are no markup are escaped."""
    safe = [part if isinstance(part, Markup) else _escape(part) for part in parts]
    return Markup(between.join(safe))


def embed_json(value: Any, id: str) -> Markup:
    """Return a value for the page's script, in an element that is not run; it can't end that element before its time."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return build_element("script", Markup(text), type="application/json", id=id)


def format_room_confidence(room: Any) -> str:
    """Format the confidence of a row of ROOM_DTYPE."""
    return _format_probability(room["confidence"])


def format_edge_confidence(map: TopometricMap, edge: Any) -> str:
    """Format the confidence of a door, an opening or a flight of stairs: no more than of its two rooms."""
    return _format_probability(min(edge["confidence"], *map.rooms["confidence"][edge["rooms"]]))


def format_window_confidence(map: TopometricMap, window: Any) -> str:
    """Format the confidence of a window: no more than of the surer one of its rooms."""
    rooms = window["rooms"][window["rooms"] >= 0]
    return _format_probability(min(window["confidence"], map.rooms["confidence"][rooms].max()))


def _format_probability(odds: float) -> str:
    return f"{odds:.3f}"


SHOWN_KINDS = ("text", "tag", "object", "name")  # of landmarks; readings of radio are as many as points of a cloud
MOST_OF_ROOM, MOST_LISTED = 50, 1000  # landmarks of a room that can be found, and of a map that are listed
SHOWN_OF_ROOM, SHOWN_LETTERS = 6, 24
ROOM_WORDS = {  # of `describe_room`, and why
    "outside": "probably outdoors",
    "glimpsed": "probably only looked into, through a door or a window",
    "doubtful": "probably not a room, or only part of one",
}
Column = tuple[str, str]  # heading; "number" or "text"


def render_table(columns: Sequence[Column], rows: Iterable[Markup], caption: str) -> Markup:
    """Render a table with a heading a column, by which the page's script sorts."""
    heads = [build_element("th", name, class_=kind, scope="col") for name, kind in columns]
    body = build_element("tbody", *rows)
    return build_element(
        "table", build_element("caption", caption), build_element("thead", build_element("tr", *heads)), body, class_="sortable"
    )


def render_cell(content: str, value: float | None = None, kind: str = "number", **attributes: Any) -> Markup:
    """Render one cell; `value` is what it is sorted by where that is not its text."""
    number = None if value is None else f"{value:.6g}"
    return build_element("td", content, class_=kind, data_value=number, **attributes)


def measure(value: float, digits: int, measured: bool = True) -> Markup:
    """Return a cell with a number, or a dash where it is not known."""
    if not measured or not math.isfinite(value):
        return render_cell("–", -1.0)
    return render_cell(f"{value:.{digits}f}", float(value))


def render_room_link(key: str, room: int) -> Markup:
    """Render a room's number, which points at it in every view."""
    return build_element("a", str(room), data_room=f"{key}{room}", href="#", class_="room-link")


def render_share_bar(share: float) -> Markup:
    """Render a share as a percentage and a bar."""
    full = min(max(float(share), 0.0), 1.0)
    bar = build_element("span", build_element("i", style=f"width:{100 * full:.0f}%"), class_="bar")
    return join([bar, f"{100 * full:.0f} %"])


def shorten(value: str) -> str:
    """Shorten a text to what fits on a plan."""
    return value if len(value) <= SHOWN_LETTERS else value[: SHOWN_LETTERS - 1] + "…"


def fold_words(values: Iterable[str]) -> str:
    """Fold texts to what the page's search compares: small letters, a line each."""
    return "\n".join(value.lower() for value in values)


def list_room_landmarks(map: TopometricMap) -> list[list[str]]:
    """List for each room the strings of its landmarks, each once: its name first, then the surest."""
    found: list[dict[str, None]] = [{name: None} if name else {} for name in find_room_names(map.landmarks, len(map.rooms))]
    table = map.landmarks.table
    rows = np.flatnonzero(map.landmarks.is_kind(*SHOWN_KINDS) & (table["room"] >= 0))
    rows = rows[np.argsort(-table["confidence"][rows], kind="stable")]
    for room, value in zip(table["room"][rows].tolist(), table["value"][rows].tolist(), strict=True):
        if len(found[room]) < MOST_OF_ROOM:
            found[room][map.landmarks.values[value]] = None
    return [list(values) for values in found]


def render_landmarks(map: TopometricMap, key: str = "") -> list[Markup]:
    """Render the list of a map's landmarks, folded; nothing where it has none."""
    table = map.landmarks.table
    rows = np.flatnonzero(map.landmarks.is_kind(*SHOWN_KINDS))
    if not len(rows):
        return []
    names = (("kind", "text"), ("value", "text"), ("room", "number"), ("storey", "number"), ("x m", "number"), ("y m", "number"))
    lines = []
    for row in table[np.sort(rows[np.argsort(-table["confidence"][rows], kind="stable")[:MOST_LISTED]])]:
        value, room = map.landmarks.values[row["value"]], int(row["room"])
        cells = [
            render_cell(LANDMARK_KINDS[row["kind"]], kind="text"),
            render_cell(value, kind="text"),
            render_cell(render_room_link(key, room) if room >= 0 else "–", room),
            render_cell(str(row["storey"]) if row["storey"] >= 0 else "–", int(row["storey"])),
            *(measure(v, 2) for v in row["position"][:2].tolist()),
            render_cell(f"{100 * row['confidence']:.0f} %", float(row["confidence"])),
            render_cell(map.landmarks.sources[row["source"]], kind="text"),
        ]
        lines.append(build_element("tr", *cells, data_words=fold_words([value])))
    listed = render_table([*names, ("confidence", "number"), ("source", "text")], lines, "Landmarks")
    text = f"{describe_landmarks(map.landmarks)}{f', the surest {MOST_LISTED}' if len(rows) > MOST_LISTED else ''}"
    frame = build_element("div", listed, class_="scroller", tabindex=0)
    return [build_element("details", build_element("summary", text), frame, class_="more")]


def render_rooms_table(map: TopometricMap, key: str = "", only: Iterable[int] | None = None) -> Markup:
    """Render all rooms, or some of them; rows carry `data-room`, `data-storey` and `data-sure`."""
    names = ("area m²", "height m", "seen", "entered", "confidence", "doors")
    marks, several_storeys = list_room_landmarks(map), len(map.storeys) > 1
    columns = [("room", "number"), *([("storey", "number")] if several_storeys else [])]
    columns += [("landmarks", "text")] if any(marks) else []
    columns += [*((name, "number") for name in names), ("leads to", "text")]
    colours = assign_room_colours(map)
    doors = np.bincount(map.edges["rooms"].ravel(), minlength=len(map.rooms))
    rows = []
    neighbours = _list_neighbours(map)
    for i in range(len(map.rooms)) if only is None else only:
        room, beside = map.rooms[i], neighbours[i]
        swatch = build_element("span", class_="swatch glimpsed" if room["glimpsed"] else "swatch",
                         style=f"background-color:{format_hex_colour(colours[i])}")  # fmt: skip
        seen = render_share_bar(room["completeness"])
        text = [build_element("em", word, title=ROOM_WORDS[word]) for word in describe_room(room)]
        leads = join([*text, *(render_room_link(key, other) for other in beside)], " ")
        cells = [
            render_cell(join([swatch, str(i)]), i),
            *([render_cell(str(room["storey"]), int(room["storey"]))] if several_storeys else []),
            *([render_cell(_join_shown(marks[i]), kind="text")] if any(marks) else []),
            measure(room["area"], 1),
            measure(room["height"], 2, room["height"] > 0),
            render_cell(seen, float(room["completeness"])),
            *(render_cell(f"{100 * room[name]:.0f} %", float(room[name])) for name in ("entered", "confidence")),
            render_cell(str(doors[i]), int(doors[i])),
            render_cell(leads, kind="text"),
        ]
        place = {"data_room": f"{key}{i}", "data_storey": int(room["storey"]), "data_sure": format_room_confidence(room)}
        place |= {"data_words": fold_words([str(i), *marks[i]])} if any(marks) else {}
        rows.append(build_element("tr", *cells, **place, tabindex=0))
    return render_table(columns, rows, "Rooms")


def _join_shown(values: Sequence[str]) -> str:
    return ", ".join([*map(shorten, values[:SHOWN_OF_ROOM]), *(["…"] if len(values) > SHOWN_OF_ROOM else [])])


def _list_neighbours(map: TopometricMap) -> list[list[int]]:
    neighbours: list[set[int]] = [set() for _ in map.rooms]
    for a, b in map.edges["rooms"].tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    return [sorted(rooms) for rooms in neighbours]


def render_doors_table(map: TopometricMap, key: str = "") -> Markup:
    """Render all doors, openings, stairs and ramps; rows carry `data-edge` and `data-sure`."""
    texts, numbers = ("kind", "between", "storey", "state"), ("width m", "height m", "confidence", "x m", "y m")
    columns = [("no.", "number"), *((name, "text") for name in texts), *((name, "number") for name in numbers)]
    rows = []
    for i, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        storeys = sorted(set(map.rooms["storey"][[a, b]].tolist()))
        way = edge["kind"] in ("door", "opening")
        cells = [
            render_cell(str(i), i),
            render_cell(str(edge["kind"]), kind="text"),
            render_cell(join([render_room_link(key, a), render_room_link(key, b)], " – "), a, kind="text"),
            render_cell(" – ".join(format_texts(storeys)), storeys[0], kind="text"),
            render_cell(classify_door_state(edge) if way else "", kind="text"),
            measure(edge["width"], 2),
            measure(edge["height"], 2, edge["height"] > 0),
            render_cell(f"{100 * edge['confidence']:.0f} %", float(edge["confidence"])),
            measure(edge["centre"][0], 2),
            measure(edge["centre"][1], 2),
        ]
        place = {
            "data_edge": f"{key}{i}",
            "data_storey": " ".join(format_texts(storeys)),
            "data_sure": format_edge_confidence(map, edge),
        }
        rows.append(build_element("tr", *cells, **place, tabindex=0))
    return render_table(columns, rows, "Doors, openings and stairs")


def format_texts(values: Iterable[Any]) -> list[str]:
    """Format each value as text."""
    return [str(value) for value in values]


def render_storeys_table(map: TopometricMap) -> Markup:
    """Render floor, ceiling, area and number of rooms of each storey."""
    columns = [("storey", "number"), ("floor m", "number"), ("ceiling m", "number"), ("area m²", "number"), ("rooms", "number")]
    count = np.bincount(map.rooms["storey"], minlength=len(map.storeys))
    rows = []
    for i, storey in enumerate(map.storeys):
        numbers = [measure(storey["floor"], 2), measure(storey["ceiling"], 2), measure(storey["area"], 1)]
        rows.append(build_element("tr", render_cell(str(i), i), *numbers, render_cell(str(count[i]))))
    return render_table(columns, rows, "Storeys")


def render_properties(values: Mapping[str, Any], caption: str) -> Markup:
    """Render names and values, such as the parameters of a map."""
    rows = [
        build_element("tr", build_element("th", str(name), scope="row"), build_element("td", _format_value(value)))
        for name, value in values.items()
    ]
    return build_element("table", build_element("caption", caption), build_element("tbody", *rows), class_="facts")


def _format_value(value: Any) -> str:
    value = convert_to_plain(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_format_value(item) for item in value)
    return str(value)


def render_seconds_table(map: TopometricMap) -> Markup:
    """Render seconds of each step, with a bar by their share."""
    total = sum(map.seconds.values())
    rows = []
    for step, s in map.seconds.items():
        share = render_cell(render_share_bar(s / total if total else 0), kind="share")
        rows.append(build_element("tr", build_element("th", str(step), scope="row"), render_cell(f"{s:.2f}"), share))
    rows.append(
        build_element(
            "tr", build_element("th", "all", scope="row"), render_cell(f"{total:.2f}"), build_element("td"), class_="total"
        )
    )
    return build_element("table", build_element("caption", "Seconds"), build_element("tbody", *rows), class_="facts")
