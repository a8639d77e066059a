"""How sure a report is of what it shows, as `data-sure` of its elements: its slider hides what is less sure.

It hides what `topomerge.types.confident` leaves out: with a room its doors, and its windows where no room is left
beside them.
"""

from __future__ import annotations

from typing import Any

from topomerge.types import TopometricMap


def room_sureness(room: Any) -> str:
    """Of a row of ROOM_DTYPE."""
    return _text(room["confidence"])


def edge_sureness(map: TopometricMap, edge: Any) -> str:
    """Of a door, an opening or a flight of stairs: no more than of its two rooms."""
    return _text(min(edge["confidence"], *map.rooms["confidence"][edge["rooms"]]))


def window_sureness(map: TopometricMap, window: Any) -> str:
    """Of a window: no more than of the surer one of its rooms."""
    rooms = window["rooms"][window["rooms"] >= 0]
    return _text(min(window["confidence"], map.rooms["confidence"][rooms].max()))


def _text(odds: float) -> str:
    return f"{odds:.3f}"
