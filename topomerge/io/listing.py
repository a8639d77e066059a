"""A map as a list of its rooms, doors and storeys: JSON for programs, tables for people.

JSON, format 1. Lengths are m, areas m², volumes m³, angles radians, times seconds, coordinates those of the input (z up);
what is not known is null. A height of 0 means that no ceiling (or lintel) was seen.

    {"format": 1, "source": "a.ply", "voxel_size": 0.1,
     "rooms": [{"id", "name" (where it has one), "storey", "centroid": [x, y, z], "area", "height", "volume",
                "bounding_box": {"min": [x, y, z], "max": [x, y, z]}, "cells",
                "completeness", "glimpsed", "confidence", "whole", "entered", "outside"}, …],
     "edges": [{"rooms": [id, id], "door": {"centre": [x, y, z], "width", "height", "direction"}, "kind",
                "open", "half", "confidence", "lower": [x, y, z], "upper": [x, y, z]}, …],
     "windows": [{"rooms": [id, id], "centre": [x, y, z], "width", "sill", "head", "direction", "confidence"}, …],
     "areas": [{"id", "room", "centroid": [x, y, z], "area"}, …], "narrows": [like edges, "areas" for "rooms"],
     "storeys": [{"id", "floor", "ceiling", "area"}, …],
     "landmarks": [{"kind", "value", "position": [x, y, z], "room", "storey", "group", "sigma", "number", "time", "confidence",
                    "source"}, …],
     "seconds": {step: s}, "parameters": {…}, "warnings": […]}

`completeness` is the share of a floor's outline at which a wall was seen; `confidence` the probability that it is a room, `whole`
that most of it was seen, `entered` that the sensor was in it, `outside` that it is out of doors; `glimpsed` rooms were probably
only looked into. `kind` is door, opening or stairs; `half`: its leaf stands half open; `direction` is that of the wall's normal
seen from above, from x towards y. The second room of a window is null where it leads out of doors; `sill` and `head` are m above
the floor.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import convert_to_plain, replace_on_success
from topomerge.io.landmarks import serialise_landmarks
from topomerge.types import EDITED, LANDMARK_KINDS, ROOM_ODDS, Landmarks, TopometricMap, find_room_names

LISTING_FORMAT = 1
EDGE_FIELDS = ("kind", "open", "half", "confidence", "lower", "upper")
DIGITS = 6  # micrometres: the digits behind are noise


def describe_room(room: Any) -> list[str]:
    """Describe a row of ROOM_DTYPE: `outside`, `glimpsed` (only looked into), `doubtful` (probably no room)."""
    notes = (("outside", room["outside"] > 0.5), ("glimpsed", room["glimpsed"]), ("doubtful", room["confidence"] < 0.5))
    return [word for word, so in notes if so]


def _convert_to_strict_json(value: Any) -> Any:
    """Return a value with numbers rounded, and null for those that JSON does not have."""
    if isinstance(value, float):
        return round(value, DIGITS) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _convert_to_strict_json(item) for key, item in value.items()}
    return [_convert_to_strict_json(item) for item in value] if isinstance(value, list) else value


def convert_map_to_json(map: TopometricMap) -> dict[str, Any]:
    """Return the map as a dictionary of plain Python values that is valid JSON; see the top of this file for its fields."""
    names = find_room_names(map.landmarks, len(map.rooms))
    rooms = [
        {
            "id": i,
            **({"name": names[i]} if names[i] else {}),
            **{name: room[name] for name in ("storey", "centroid", "area", "height", "volume")},
            "bounding_box": {"min": room["lo"], "max": room["hi"]},
            "cells": room["cells"],
            "completeness": room["completeness"],
            "glimpsed": room["glimpsed"],
            **{name: room[name] for name in ROOM_ODDS},
        }
        for i, room in enumerate(map.rooms)
    ]
    areas = [{"id": i, **{name: a[name] for name in a.dtype.names}} for i, a in enumerate(map.areas)]
    storeys = [{"id": i, **{name: s[name] for name in s.dtype.names}} for i, s in enumerate(map.storeys)]
    listing = {
        "format": LISTING_FORMAT,
        "source": map.source,
        "voxel_size": float(map.grid.edge),
        "rooms": rooms,
        "edges": [_build_edge_entry(e, "rooms") for e in map.edges],
        "windows": [_build_window_entry(w) for w in map.windows],
        "areas": areas,
        "narrows": [_build_edge_entry(e, "areas") for e in map.narrows],
        "storeys": storeys,
        "landmarks": serialise_landmarks(map.landmarks),
        "seconds": map.seconds,
        "parameters": map.parameters,
        "warnings": list(map.warnings),
    }
    strict: dict[str, Any] = _convert_to_strict_json(convert_to_plain(listing))
    return strict


def _build_edge_entry(edge: Any, ends: str) -> dict[str, Any]:
    door = {name: edge[name] for name in ("centre", "width", "height", "direction")}
    return {ends: edge["rooms"], "door": door, **{name: edge[name] for name in EDGE_FIELDS}}


def _build_window_entry(window: Any) -> dict[str, Any]:
    rooms = [room if room >= 0 else None for room in window["rooms"].tolist()]
    return {"rooms": rooms, **{name: window[name] for name in window.dtype.names if name != "rooms"}}


def format_json(listing: Mapping[str, Any]) -> str:
    """Return strict JSON with a line for each room, edge and storey, so that it can be read and compared."""
    lines = []
    for key, value in listing.items():
        text = json.dumps(value, allow_nan=False, ensure_ascii=False)
        if isinstance(value, list) and value:
            items = ",\n    ".join(json.dumps(item, allow_nan=False, ensure_ascii=False) for item in value)
            text = f"[\n    {items}\n  ]"
        lines.append(f"  {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def save_json(map: TopometricMap, path: str | Path) -> None:
    """Write `convert_map_to_json` as UTF-8.

    Raises:
        InputError: the path can't be written.
    """
    with replace_on_success(path) as temporary:
        temporary.write_text(format_json(convert_map_to_json(map)), encoding="utf-8", errors="replace")


def format_columns(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return lines of a table: right-aligned, but for the last column."""
    table = [list(header), *map(list, rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    last = len(header) - 1
    cells = [[c.rjust(w) if i < last else c for i, (c, w) in enumerate(zip(r, widths, strict=True))] for r in table]
    return ["  ".join(row).rstrip() for row in cells]


def _format_number(value: float, digits: int, unknown: bool = False) -> str:
    return "–" if unknown or not math.isfinite(value) else f"{value:.{digits}f}"


def _format_count(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 or word == 'stairs' else 's'}"


def _list_neighbours(map: TopometricMap) -> list[list[str]]:
    """List for each room the rooms that it leads to; a second door to the same one is not told again."""
    neighbours: list[dict[int, str]] = [{} for _ in map.rooms]
    for edge in map.edges:
        a, b = edge["rooms"].tolist()
        mark = f" ({edge['kind']})" if edge["kind"] in ("stairs", "ramp") else ""
        neighbours[a].setdefault(b, mark)
        neighbours[b].setdefault(a, mark)
    return [[f"{room}{rooms[room]}" for room in sorted(rooms)] for rooms in neighbours]


def _iter_room_rows(map: TopometricMap, names: Sequence[str]) -> Iterable[Sequence[str]]:
    doors = np.bincount(map.edges["rooms"].ravel(), minlength=len(map.rooms))
    for i, (room, neighbours) in enumerate(zip(map.rooms, _list_neighbours(map), strict=True)):
        yield (
            str(i),
            str(room["storey"]),
            _format_number(room["area"], 1),
            _format_number(room["height"], 2, room["height"] == 0),
            str(room["cells"]),
            str(doors[i]),
            *([names[i]] if any(names) else []),
            "  ".join([", ".join(neighbours), *describe_room(room)]),
        )


def _iter_storey_rows(map: TopometricMap) -> Iterable[Sequence[str]]:
    rooms = np.bincount(map.rooms["storey"], minlength=len(map.storeys))
    for i, storey in enumerate(map.storeys):
        floor, ceiling, area = storey["floor"], storey["ceiling"], storey["area"]
        yield str(i), _format_number(floor, 2), _format_number(ceiling, 2), _format_number(area, 1), str(rooms[i])


def describe_landmarks(landmarks: Landmarks) -> str:
    """Describe how many landmarks of which kinds there are: "3 landmarks (2 text, 1 tag)"."""
    count = np.bincount(landmarks.table["kind"], minlength=len(LANDMARK_KINDS)).tolist()
    kinds = ", ".join(f"{many:,} {kind}" for kind, many in zip(LANDMARK_KINDS, count, strict=True) if many)
    return f"{len(landmarks):,} landmark{'s' * (len(landmarks) != 1)}{f' ({kinds})' if kinds else ''}"


def format_map(map: TopometricMap) -> str:
    """Return tables of rooms, storeys and seconds for a terminal, without a line break at the end."""
    kinds = Counter(map.edges["kind"].tolist())
    counts = [_format_count(len(map.rooms), "room"), _format_count(len(map.storeys), "storey")]
    counts += [_format_count(kinds[kind], kind) for kind in ("door", "opening", "stairs")]
    counts += [_format_count(kinds["ramp"], "ramp")] if kinds["ramp"] else []
    counts += [_format_count(len(map.windows), "window")] if len(map.windows) else []
    counts += [describe_landmarks(map.landmarks)] if len(map.landmarks) else []
    edited = map.parameters.get(EDITED, 0)
    counts += [_format_count(edited, "edit")] if isinstance(edited, int) and edited else []
    names = find_room_names(map.landmarks, len(map.rooms))
    columns = ("room", "storey", "area m²", "height m", "cells", "doors", *(("name",) if any(names) else ()), "leads to")
    steps = [(f"{s:.2f}", step) for step, s in map.seconds.items()]
    steps.append((f"{sum(map.seconds.values()):.2f}", "all"))
    source = " ".join((map.source or "map").splitlines())  # names of files may hold line breaks
    return "\n".join(
        (
            f"{source}: {', '.join(counts)}; {_format_count(len(map.grid), 'cell')} of {map.grid.edge:g} m",
            "",
            *format_columns(columns, _iter_room_rows(map, names)),
            "",
            *format_columns(("storey", "floor m", "ceiling m", "area m²", "rooms"), _iter_storey_rows(map)),
            "",
            *format_columns(("seconds", "step"), steps),
        )
    )
