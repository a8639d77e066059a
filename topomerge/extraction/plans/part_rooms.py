"""Votes of the maps that a joined map was made of on its narrowings: is there a door, or one room on both sides (docs/adr/0020)?

Walls of two maps that do not quite meet, and a slice among scans, make narrowings where no map has any, and hide doors that one
of them has. What each map had for one room, and what for two, is weighed with what the joined plan shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.passages import Pair, Passage
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array, are_within

# 1.5 and 6 in its place were no better on twenty pairs (rooms' IoU .887 and .883 for .891: docs/adr/0020).
LOG_ODDS = 3.0  # of a door, by a map that is sure of two rooms; of none, by one that is sure of one room
GLIMPSED = 0.3  # as sure of a room that was only looked into: its outline may be that of what could be seen
SIDE_REACH = 1.5  # m around a narrowing, in which its sides are looked at
LEAST_COLUMNS = 5  # of a side, with a room of the part
SPREAD = 0.25  # m: a column takes the room of floor that is so near
SAME_STOREY = 1.2  # m


@dataclass(frozen=True, eq=False)
class PartRooms:
    """The rooms of one of the maps that were joined, as they lie in the joined one.

    Args:
        places: (k, 3) m, floor of the rooms.
        room: (k,) int64 of each place.
        entered: (R,) probability that somebody was in each room.
        area: m2 of each place.
    """

    places: Array
    room: Array
    entered: Array
    area: float


class PlacedRooms(NamedTuple):
    """A part's rooms in the columns of a storey, (nx, ny), -1 none, and of each room (R,) 0..1 how sure the part is of it."""

    room: Array
    certainty: Array


def rasterise_part_rooms(plan: StoreyPlan, parts: Sequence[PartRooms]) -> list[PlacedRooms]:
    """Return the rooms of parts in the columns of a storey."""
    return [PlacedRooms(_find_column_rooms(plan, part), np.where(part.entered < 0.5, GLIMPSED, 1.0)) for part in parts]


def find_boundary_columns(rooms: Sequence[PlacedRooms]) -> Array:
    """Return (nx, ny) bool: where rooms of a part meet that somebody was in. Regions end there even if the cells show nothing."""
    out = np.zeros(rooms[0].room.shape, bool)
    for room, certainty in rooms:
        sure = np.where(np.append(certainty == 1, False)[room], room, -1)
        highest, lowest = ndimage.maximum_filter(sure, 3), ndimage.minimum_filter(np.where(sure < 0, len(certainty), sure), 3)
        # An open leaf or moved furniture may hide the narrowing; log odds decide whether regions stay apart (docs/adr/0020).
        out |= (sure >= 0) & (highest != lowest)
    return out


def compute_door_log_odds(
    region: Array, edge: float, passages: Mapping[Pair, Passage], rooms: Sequence[PlacedRooms]
) -> dict[Pair, float]:
    """Compute the log odds of a door in each passage by all parts: below 0, they have one room on both sides; 0 where none knows
    both sides.

    Args:
        region: (nx, ny) region of each column, -1 none.
        edge: m, of a column.
        passages: between the regions.
    """
    reach = int(SIDE_REACH / edge)
    out = {}
    for (a, b), passage in passages.items():
        x, y = passage.place
        box = slice(max(x - reach, 0), x + reach + 1), slice(max(y - reach, 0), y + reach + 1)
        sides = region[box] == a, region[box] == b
        out[a, b] = LOG_ODDS * sum(_score_separation(room[box], certainty, sides) for room, certainty in rooms)
    return out


def _score_separation(room: Array, certainty: Array, sides: tuple[Array, Array]) -> float:
    """Return whether a part has one room on both sides, or two: -1..1.

    Args:
        room: (nx, ny) its rooms, -1 none.
        certainty: (R,) 0..1 how sure it is of each of them.
        sides: (nx, ny) bool each.
    """
    shares, sure = [], 1.0
    for side in sides:
        rooms = room[side]
        rooms = rooms[rooms >= 0]
        if len(rooms) < LEAST_COLUMNS:
            return 0.0
        share = np.bincount(rooms, minlength=len(certainty)) / len(rooms)
        sure = min(sure, float(share @ certainty)) * len(rooms) / float(side.sum())
        shares.append(share)
    return sure * (1 - 2 * float(shares[0] @ shares[1]))


def _find_column_rooms(plan: StoreyPlan, part: PartRooms) -> Array:
    """Return (nx, ny) room of a part in each column of a storey, -1 none."""
    at = np.floor((part.places[:, :2] - plan.origin) / plan.edge).astype(np.int64)
    here = np.flatnonzero(are_within(at, 0, plan.wall.shape))
    here = here[np.abs(part.places[here, 2] - plan.floor[tuple(at[here].T)]) < SAME_STOREY]
    out = np.full(plan.wall.shape, -1, np.int64)
    here = here[np.argsort(-part.places[here, 2], kind="stable")]  # the lowest is written last
    out[tuple(at[here].T)] = part.room[here]
    if not len(here):
        return out
    far, nearest = ndimage.distance_transform_edt(out < 0, return_indices=True)
    return np.where(far * plan.edge <= SPREAD, out[tuple(nearest)], -1)
