"""Landmarks of a file -> landmarks of its map: the storey and the room of each (beyond the thesis).

A sign or a tag beside a door belongs to the room that the door leads to: of the two rooms of the nearest door to the one with
fewer doors, as corridors have many; of two alike to the one on the other side. All else is in the room on whose floor it stands,
or whose floor is nearest.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.topology import LEVEL_KINDS
from topomerge.io.landmarks import find_landmark_file, read_landmark_file
from topomerge.io.maps import load_map
from topomerge.types import (
    Array,
    Landmarks,
    TopometricMap,
    clean_landmarks,
    join_landmarks,
    transform_landmarks,
    transform_points,
)

ROOM_REACH = 1.5  # m between a landmark and the floor of its room, seen from above
DOOR_REACH = 1.5  # m between a sign and the middle of its door, seen from above
BELOW_FLOOR = 0.5  # m by which a landmark may lie below the floor of its storey
AT_DOORS = ("text", "tag")  # kinds that hang beside doors


def assign_landmarks(map: TopometricMap, landmarks: Landmarks) -> Landmarks:
    """Return landmarks with the storey and the room of each, as far as they can be told.

    What a landmark says of itself stays, unless the map has no such room or storey. Of a room that is known the storey is known.

    Args:
        map: any map.
        landmarks: in its frame.
    """
    table = landmarks.table.copy()
    for column, count in (("room", len(map.rooms)), ("storey", len(map.storeys))):
        table[column][table[column] >= count] = -1
    known = np.isfinite(table["position"]).all(axis=1)
    in_room = table["room"] >= 0
    table["storey"][in_room] = map.rooms["storey"][table["room"][in_room]]
    lost = known & (table["storey"] < 0)
    if len(map.storeys) and lost.any():
        above = np.searchsorted(map.storeys["floor"] - BELOW_FLOOR, table["position"][lost, 2], side="right") - 1
        table["storey"][lost] = np.maximum(above, 0)
    open_rows = known & ~in_room & (table["storey"] >= 0)
    for storey in np.unique(table["storey"][open_rows]).tolist():
        rows = np.flatnonzero(open_rows & (table["storey"] == storey))
        table["room"][rows] = _find_nearest_rooms(map, storey, table["position"][rows, :2])
        rows = rows[landmarks.is_kind(*AT_DOORS)[rows]]
        table["room"][rows] = find_rooms_of_doors(map, storey, table["position"][rows, :2], table["room"][rows])
    return replace(landmarks, table=table)


def _find_nearest_rooms(map: TopometricMap, storey: int, places: Array) -> Array:
    """Return (n,) room of a storey whose floor is nearest to places (n, 2), -1 where none is within reach."""
    own = np.append(map.rooms["storey"] == storey, False)[map.navigable_room]
    if not own.any():
        return np.full(len(places), -1)
    floor = map.navigable.compute_centroids(map.navigable.cells[own])[:, :2]
    far, nearest = cKDTree(floor).query(places, distance_upper_bound=ROOM_REACH)
    return np.where(np.isfinite(far), np.append(map.navigable_room[own], -1)[nearest], -1)


def find_rooms_of_doors(map: TopometricMap, storey: int, places: Array, here: Array) -> Array:
    """Return (n,) room to which the door beside each place (n, 2) leads; the room where it is, `here`, where no door is within
    reach."""
    level = np.isin(map.edges["kind"], LEVEL_KINDS)
    doors = map.edges[level & (map.rooms["storey"][map.edges["rooms"]] == storey).all(axis=1)]
    if not len(doors) or not len(places):
        return here
    count = np.bincount(map.edges["rooms"][level].ravel(), minlength=len(map.rooms))
    far, nearest = cKDTree(doors["centre"][:, :2]).query(places, distance_upper_bound=DOOR_REACH)
    at_door = np.isfinite(far)
    rooms = doors["rooms"][np.where(at_door, nearest, 0)]
    less = count[rooms[:, 0]] - count[rooms[:, 1]]
    other = np.where(here == rooms[:, 0], rooms[:, 1], np.where(here == rooms[:, 1], rooms[:, 0], here))
    behind = np.where(less < 0, rooms[:, 0], np.where(less > 0, rooms[:, 1], other))
    return np.where(at_door, behind, here)


def add_landmarks(map: TopometricMap, landmarks: Landmarks) -> TopometricMap:
    """Return the map with more landmarks, each with its storey and room; a warning counts those of rooms that it does not have.

    Args:
        landmarks: in the frame of the map, as a file says them.
    """
    if not len(landmarks):
        return map
    cleaned = clean_landmarks(landmarks)
    absent = int((cleaned.table["room"] >= len(map.rooms)).sum())
    text = f"{absent} landmark{'s' * (absent != 1)} of rooms that the map does not have ({len(map.rooms)} rooms, from 0)"
    joined = join_landmarks([map.landmarks, assign_landmarks(map, cleaned)])
    return replace(map, landmarks=joined, warnings=(*map.warnings, text) if absent else map.warnings)


def load_map_with_landmarks(path: str | Path) -> TopometricMap:
    """Read a `.tmap` with the landmarks in the file beside it, unless it has those already: it was extracted with them.

    Raises:
        InputError: one of both can't be read.
    """
    map, companion = load_map(path), find_landmark_file(Path(path))
    if companion is None or companion.name in map.landmarks.sources:
        return map
    return add_landmarks(map, transform_landmarks(read_landmark_file(companion), lambda p: transform_points(map.levelling, p)))
