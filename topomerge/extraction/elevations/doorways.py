"""Doorways seen on walls: stretches that the network of elevations takes for an open or a shut door (beyond the thesis).

A wall between two rooms has a face on either side; what is seen on both is one doorway, in the middle of the wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from topomerge.extraction.elevations.elevation import (
    ACROSS,
    ALONG,
    BANDS,
    PLACES,
    WALL_CLASSES,
    Elevations,
    compute_place_probabilities,
    weights,
)
from topomerge.kernels import run_side_by_side
from topomerge.networks.network import Run
from topomerge.types import Array

DOOR_CHANCE, LIKELY_DOOR = 0.35, 0.5  # probability of a door of every place of a doorway, and of one of them
LEAST_WIDTH = 0.45  # m
# Floor that goes on where nothing was seen is no door (docs/adr/0018).
SEEN_AROUND, LEAST_ELEMENTS = 10, 12  # places to both sides of a doorway, and elements with points that its wall has there
LEAF_BANDS = slice(2, 10)  # 0.3 to 1.9 m
# The network cannot tell a set-back leaf from a niche with a decimetre of wall behind it (docs/adr/0018).
SURFACE_FILL, EMPTY_FILL, THICKEST_LEAF = 0.3, 0.1, 0.08  # of the elements of a surface, and between two; m between them
HALF_WALL = 0.06  # m from the face of a wall to its middle, where one face was seen only
SAME_DOORWAY = 0.45  # m between what two faces show of one doorway
STOOD = 0.12  # m from the middle of a cell of a floor: a place this near is on it
DOORWAY_LEVEL = 0.5  # m between their floors
STRAIGHT = 0.95  # cosine between two parts of one opening
OPEN, SHUT, HALF_OPEN = (WALL_CLASSES.index(name) for name in ("open", "shut", "half"))
DOORWAY_DTYPE = np.dtype(
    [
        ("rooms", "i4", 2),  # that see it, the second -1 where one does
        ("centre", "f8", 3),  # on the floor, in the map's frame
        ("out", "f8", 2),  # unit, away from the first room
        ("width", "f8"),  # m
        ("probability", "f8"),  # of a door, the highest along it
        ("mean", "f8"),  # and on average
        ("open", "f8"),  # share of that which speaks for one that is open or half open
        ("half", "f8"),  # and for one whose leaf stands half open
        ("faces", "i4"),  # on which it was seen
    ]
)


@dataclass(frozen=True, eq=False)
class StoreyWalls:
    """The walls of all storeys.

    Args:
        elevations: their faces, unrolled.
        classes: (n / 2, 7) of `classify_places`.
        doors: (n / 2, 3) of `compute_door_probabilities`.
        doorways: (D,) DOORWAY_DTYPE with the segments, or rooms, on both sides.
    """

    elevations: Elevations
    classes: Array
    doors: Array
    doorways: Array


def classify_places(walls: Elevations) -> Array:
    """Return (n / 2, 7) float32 probability of each of `WALL_CLASSES` in each place along all strips, each read from both its
    ends."""
    bounds = list(iter_strip_bounds(walls))
    network = weights() if bounds else None  # once, before threads ask for it
    parts = run_side_by_side(lambda ends: read_both_ways(walls.strips[slice(*ends)], network), bounds)
    return np.concatenate([np.zeros((0, len(WALL_CLASSES)), np.float32), *parts])


def read_both_ways(strip: Array, network: Run | None = None) -> Array:
    """Return (n / 2, 7) float32 probability of each of `WALL_CLASSES`: a mirrored wall has the same doors, so two readings are
    averaged.

    Args:
        strip: (n, 32, 17), n even.
        network: that ships, if None.
    """
    one, mirrored = compute_place_probabilities(np.stack([strip, strip[::-1]]), network)
    mean: Array = (one + mirrored[::-1]) / np.float32(2)
    return mean


def compute_door_probabilities(walls: Elevations, classes: Array) -> Array:
    """Return (n / 2, 3) float32 probability of an open, a shut and a half-open door in each place, of those of all classes."""
    parts = [classes[low // PLACES : high // PLACES, [OPEN, SHUT, HALF_OPEN]] for low, high in iter_strip_bounds(walls)]
    return np.concatenate([np.zeros((0, 3), np.float32), *parts])


def iter_strip_bounds(walls: Elevations) -> Iterator[tuple[int, int]]:
    """Yield the first element of each strip and that after its last."""
    return zip(walls.first[:-1].tolist(), walls.first[1:].tolist(), strict=True)


def detect_doorways(walls: Elevations, doors: Array, before: Array | None = None) -> Array:
    """Return (D,) DOORWAY_DTYPE, each once however many faces show it.

    Args:
        doors: (n / 2, 3) of `compute_door_probabilities`.
        before: (n / 2, k) room on whose floor each of k spots before a place lies, -1 none: a strip goes on past its face, where
            the next room may lie before it. None: the room of the face everywhere.
    """
    rows = []
    for face, (low, high) in zip(walls.faces, iter_strip_bounds(walls), strict=True):
        each = doors[low // PLACES : high // PLACES]
        for start, stop in _iter_runs(each.sum(axis=1)):
            shut = 2 * each[start:stop, 1].sum() > each[start:stop].sum()
            if not _is_seen(walls.strips[low:high], start, stop) or (shut and _is_thick(walls.strips[low:high], start, stop)):
                continue
            room = int(face["room"])
            if before is not None:
                room = _find_most_common(before[low // PLACES + start : low // PLACES + stop], room)
            rows.append(_build_doorway(face, room, each, start, stop))
    return _merge_faces(np.array(rows, DOORWAY_DTYPE))


def _find_most_common(rooms: Array, otherwise: int) -> int:
    """Return the room that occurs most often, `otherwise` where it is one of these or there is none (-1)."""
    counts = np.bincount(rooms[rooms >= 0].astype(np.int64), minlength=otherwise + 1)
    if otherwise < 0:
        return int(counts.argmax()) if len(counts) else -1
    return otherwise if counts[otherwise] == counts.max() else int(counts.argmax())


def merge_openings(doorways: Array) -> tuple[Array, Array]:
    """Return doorways (D,) DOORWAY_DTYPE without those that are parts of one wide opening, and the width (D,) m of the surest
    part.

    Of an opening wider than doors are, a wall shows where it begins and where it ends: two doorways of the same two rooms that
    meet end to end.
    """
    rooms = np.sort(doorways["rooms"], axis=1)
    along = np.column_stack([-doorways["out"][:, 1], doorways["out"][:, 0]])
    apart = doorways["centre"][None] - doorways["centre"][:, None]
    # Not two doorways with floor between them, however far apart: that joined two doors in a wall of glass (docs/adr/0018).
    gap = np.abs((apart[..., :2] * along[:, None]).sum(axis=2)) - (doorways["width"][:, None] + doorways["width"]) / 2
    off = np.abs((apart[..., :2] * doorways["out"][:, None]).sum(axis=2))
    meet = (gap < SAME_DOORWAY) & (off < SAME_DOORWAY) & (np.abs(along @ along.T) > STRAIGHT)
    meet &= (rooms[:, None] == rooms).all(axis=2) & (np.abs(apart[..., 2]) < DOORWAY_LEVEL)
    count, part = connected_components(meet, directed=False)
    whole = [doorways[part == k] for k in range(count)]
    out = np.array([tuple(_join_parts(parts)) for parts in whole], DOORWAY_DTYPE)
    return out, np.array([parts["width"][parts["probability"].argmax()] for parts in whole], float)


def _join_parts(parts: Array) -> Array:
    """Return the opening from the first end of its parts to the last one."""
    out = parts[parts["probability"].argmax()].copy()
    along = np.array([-out["out"][1], out["out"][0]])
    at = (parts["centre"] - out["centre"])[:, :2] @ along
    first, last = (at - parts["width"] / 2).min(), (at + parts["width"] / 2).max()
    if len(parts) > 1:
        out["centre"][:2] += along * (first + last) / 2
        out["width"] = last - first
    return out


def _iter_runs(probability: Array) -> Iterator[tuple[int, int]]:
    """Yield the first place and that after the last one of every stretch that is probably a door."""
    likely = np.flatnonzero(np.diff(np.concatenate([[0], probability > DOOR_CHANCE, [0]]).astype(np.int8)))
    for start, stop in likely.reshape(-1, 2).tolist():
        if (stop - start) * PLACES * ALONG >= LEAST_WIDTH and probability[start:stop].max() >= LIKELY_DOOR:
            yield start, stop


def _is_seen(strip: Array, start: int, stop: int) -> bool:
    """Return whether the wall shows around a stretch. Where there are hardly any points, floor that goes on is no doorway."""
    around = strip[max(start - SEEN_AROUND, 0) * PLACES : (stop + SEEN_AROUND) * PLACES, :, :BANDS]
    return int(np.count_nonzero(around)) >= LEAST_ELEMENTS


def _is_thick(strip: Array, start: int, stop: int) -> bool:
    """Return whether two surfaces show in a stretch, farther apart than those of a leaf, and nothing between them. Then a wall is
    there: a niche of a door's size looks like a set-back leaf."""
    inner = (stop - start) // 4
    across = strip[(start + inner) * PLACES : (stop - inner) * PLACES, :, LEAF_BANDS].mean(axis=(0, 2))
    ends = np.flatnonzero(np.diff(np.concatenate([[0], across > SURFACE_FILL, [0]])))
    gaps = ends[1:-1].reshape(-1, 2).tolist()
    return any((b - a) * ACROSS >= THICKEST_LEAF and across[a:b].max() < EMPTY_FILL for a, b in gaps)


def _build_doorway(face: Array, room: int, doors: Array, start: int, stop: int) -> tuple[object, ...]:
    """Build the row of DOORWAY_DTYPE of one stretch of a face, with the room before it."""
    step = PLACES * ALONG
    probability = doors[start:stop].sum(axis=1)
    at = (np.average(np.arange(start, stop), weights=probability) + 0.5) * step
    middle = face["start"] + at * face["along"] + HALF_WALL * face["out"]
    width = float(probability.sum()) * step
    wide, _, half = (doors[start:stop].sum(axis=0) / probability.sum()).tolist()
    place = (*middle.tolist(), float(face["floor"]))
    return (room, -1), place, face["out"], width, float(probability.max()), float(probability.mean()), wide + half, half, 1


def _merge_faces(rows: Array) -> Array:
    """Merge the rows of several faces of one doorway into one, the likeliest first."""
    if len(rows) < 2:
        return rows
    from scipy.cluster.hierarchy import fcluster, linkage  # here: maps that are only merged need none of it

    place = np.column_stack([rows["centre"][:, :2], rows["centre"][:, 2] * (SAME_DOORWAY / DOORWAY_LEVEL)])
    of = fcluster(linkage(place, "average"), SAME_DOORWAY, "distance")
    out = np.array([_merge_rows(rows[of == k]) for k in np.unique(of)], DOORWAY_DTYPE)
    return out[np.argsort(-out["probability"], kind="stable")]


def _merge_rows(rows: Array) -> Array:
    """Merge several rows into one, by their probabilities; the other room is the likeliest that sees it from the other side."""
    rows = rows[np.argsort(-rows["probability"], kind="stable")]
    out, weight = rows[0].copy(), rows["probability"]
    opposite = (rows["out"] @ out["out"] < 0) & (rows["rooms"][:, 0] != out["rooms"][0])
    sides = [rows[0], rows[np.flatnonzero(opposite)[0]]] if opposite.any() else [rows[0]]
    if opposite.any():
        out["rooms"][1] = sides[1]["rooms"][0]
    out["centre"] = np.mean([side["centre"] for side in sides], axis=0)
    out["width"] = float(np.mean([side["width"] for side in sides]))
    out["open"], out["half"] = (np.average(rows[name], weights=weight) for name in ("open", "half"))
    out["mean"] = rows["mean"].max()
    out["faces"] = len(rows)
    return out
