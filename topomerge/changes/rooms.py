"""Rooms that are new or gone, were split, joined, or grew: only where a wall that is new or gone says so, as maps cut rooms
differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage

from topomerge.changes.elements import WallChange
from topomerge.changes.layers import CHANGE_CELL, StoreyLayers
from topomerge.types import Array

PART_AREA, PART_SHARE = 1.5, 0.12  # m2, and of a room's area: what is less is no part of it
WITHIN = 0.6  # of a wall's length that lies within a room
GROWN_AREA, GROWN_SHARE = 1.0, 0.1  # m2, and of a room's area
WALL_BESIDE = 0.5  # m from the ground that a room won
SEEN_SHARE, ITS_OWN = 0.6, 0.5  # shares of a room that the other map saw, and of another room in it that it then was before
ENCLOSED, BORDER = 0.35, 0.4  # share of a room's border that walls are which are new or gone; m around it, where they stand


@dataclass(frozen=True, eq=False)
class RoomChange:
    """A room, or several, that are not as they were: numbers of the rooms in the old and in the new map; `area` m2 changed."""

    kind: str
    outline: Array
    area: float
    probability: float
    evidence: dict[str, float]
    old: tuple[int, ...]
    new: tuple[int, ...]


def find_room_changes(layers: StoreyLayers, walls: Sequence[WallChange]) -> list[RoomChange]:
    """Find the rooms that changed on a storey.

    Args:
        layers: of the storey.
        walls: those that changed.
    """
    old, new = layers.old.room, layers.new.room
    split = _find_splits(layers, old, new, [w for w in walls if w.kind == "wall new"])
    joined = _find_splits(layers, new, old, [w for w in walls if w.kind == "wall gone"])
    found = [RoomChange("room split", o, area, p, e, (whole,), parts) for whole, parts, o, area, p, e in split]
    found += [RoomChange("room joined", o, area, p, e, parts, (whole,)) for whole, parts, o, area, p, e in joined]
    told = {r for c in found for r in c.old}, {r for c in found for r in c.new}
    own = _find_enclosed(layers, new, old, [w for w in walls if w.kind == "wall new"], told[1])
    found += [RoomChange("room new", outline, area, p, e, (), (room,)) for room, outline, area, p, e in own]
    own = _find_enclosed(layers, old, new, [w for w in walls if w.kind == "wall gone"], told[0])
    found += [RoomChange("room gone", outline, area, p, e, (room,), ()) for room, outline, area, p, e in own]
    told = {r for c in found for r in c.old}, {r for c in found for r in c.new}
    return found + _find_grown(layers, walls, told)


def find_room_corrections(layers: StoreyLayers) -> list[RoomChange]:
    """Find the rooms of two maps of one scan that somebody cut or joined; all of them are certain."""
    found = []
    for kind, whole, parts in (
        ("room split", layers.old.room, layers.new.room),
        ("room joined", layers.new.room, layers.old.room),
    ):
        both = (whole >= 0) & (parts >= 0)
        shared = np.zeros((int(whole.max()) + 1, int(parts.max()) + 1))
        np.add.at(shared, (whole[both], parts[both]), CHANGE_CELL**2)
        own = shared > WITHIN * np.bincount(parts[parts >= 0], minlength=shared.shape[1]) * CHANGE_CELL**2
        for room in np.flatnonzero(own.sum(axis=1) > 1).tolist():
            pieces = tuple(np.flatnonzero(own[room]).tolist())
            mask, area = whole == room, float(np.sort(shared[room, list(pieces)])[-2])
            sides = ((room,), pieces) if kind == "room split" else (pieces, (room,))
            found.append(RoomChange(kind, _trace_box(layers, mask), area, 1.0, {"corrected": 1.0}, *sides))
    return found


Split = tuple[int, tuple[int, ...], Array, float, float, dict[str, float]]


def _find_splits(layers: StoreyLayers, whole: Array, parts: Array, walls: Sequence[WallChange]) -> list[Split]:
    """Rooms of one map that are several of the other one, and a wall stands within them that the first one has not."""
    found: dict[int, Split] = {}
    for wall in walls:
        ends = wall.ends
        line = ends[0] + np.linspace(0.05, 0.95, 19)[:, None] * (ends[1] - ends[0])
        rooms = layers.sample(whole, line, -1).astype(int)
        counts = np.bincount(rooms[rooms >= 0], minlength=1)
        room = int(counts.argmax())
        if counts[room] < WITHIN * len(line):
            continue
        area = float((whole == room).sum()) * CHANGE_CELL**2
        inside = parts[(whole == room) & (parts >= 0)]
        number, times = np.unique(inside, return_counts=True)
        large = times * CHANGE_CELL**2 >= max(PART_AREA, PART_SHARE * area)
        if large.sum() < 2:
            continue
        small = float(np.sort(times[large] * CHANGE_CELL**2)[-2])
        sides = _find_sides(layers, parts, ends)
        if len(sides) < 2 or not sides <= {int(n) for n in number[large]}:
            continue
        outline = _trace_box(layers, (whole == room))
        evidence = {"wall": wall.probability, "m2": area, "part_m2": small}
        if room not in found or found[room][4] < wall.probability:
            found[room] = room, tuple(number[large].astype(int).tolist()), outline, small, wall.probability, evidence
    return list(found.values())


def _find_enclosed(
    layers: StoreyLayers, own: Array, other: Array, walls: Sequence[WallChange], told: set[int]
) -> list[tuple[int, Array, float, float, dict[str, float]]]:
    """Rooms of one map whose ground the other one saw and in which none of its rooms lies, and whose border walls make that only
    the first one has: room, outline, m2, probability and evidence."""
    if not walls:
        return []
    found, sizes = [], np.bincount(other[other >= 0], minlength=1)
    close = [(wall.probability, layers.rasterise(shapely.Polygon(wall.outline).buffer(BORDER))) for wall in walls]
    seen = (layers.new if own is layers.old.room else layers.old).free
    for room in np.setdiff1d(np.unique(own[own >= 0]), sorted(told)).tolist():
        mask = own == room
        area, share = float(mask.sum()) * CHANGE_CELL**2, float((mask & seen).sum() / mask.sum())
        inside = other[mask & (other >= 0)]
        shares = np.bincount(inside, minlength=len(sizes)) / np.maximum(sizes, 1)
        if area < PART_AREA or share < SEEN_SHARE or shares.max() >= ITS_OWN:
            continue
        border = mask & ~ndimage.binary_erosion(mask)
        made = np.max([np.where(border & near, probability, 0.0) for probability, near in close], axis=0)
        enclosed = float((made > 0).sum() / border.sum())
        if enclosed < ENCLOSED:
            continue
        probability = float(made[made > 0].mean())
        evidence = {"wall": probability, "m2": area, "seen": share, "enclosed": enclosed}
        found.append((room, _trace_box(layers, mask), area, probability * share, evidence))
    return found


def _find_sides(layers: StoreyLayers, parts: Array, ends: Array) -> set[int]:
    """Rooms on the two sides of a wall; one where it parts nothing."""
    along = (ends[1] - ends[0]) / max(float(np.hypot(*(ends[1] - ends[0]))), 1e-9)
    across = np.array([-along[1], along[0]])
    line = ends[0] + np.linspace(0.1, 0.9, 9)[:, None] * (ends[1] - ends[0])
    sides = set()
    for sign in (-1, 1):
        rooms = layers.sample(parts, line + sign * 0.5 * across, -1).astype(int)
        rooms = rooms[rooms >= 0]
        if len(rooms):
            sides.add(int(np.bincount(rooms).argmax()))
    return sides


def _trace_box(layers: StoreyLayers, mask: Array) -> Array:
    """(4, 2) m of the rectangle around a mask, in the axes of the raster."""
    pixels = np.argwhere(mask)
    low, high = pixels.min(axis=0) - 0.5, pixels.max(axis=0) + 0.5
    return layers.compute_points(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))[:, :2]


def _find_grown(layers: StoreyLayers, walls: Sequence[WallChange], told: tuple[set[int], set[int]]) -> list[RoomChange]:
    """Rooms that won or lost ground to their neighbours because a wall between them was moved."""
    old, new, both = layers.old.room, layers.new.room, layers.both
    if not walls or not (old >= 0).any() or not (new >= 0).any():
        return []
    shared = both & (old >= 0) & (new >= 0)
    table = np.zeros((int(old.max()) + 1, int(new.max()) + 1))
    np.add.at(table, (old[shared], new[shared]), CHANGE_CELL**2)
    tree = shapely.STRtree([shapely.Polygon(w.outline) for w in walls])
    found = []
    for r, n in enumerate(table.argmax(axis=1).tolist()):
        if r in told[0] or n in told[1] or table[r, n] == 0 or int(table[:, n].argmax()) != r:
            continue
        won, lost = both & (new == n) & (old != r), both & (old == r) & (new != n) & (new >= 0)
        mask = won if won.sum() > lost.sum() else lost
        area, whole = float(mask.sum()) * CHANGE_CELL**2, float((old == r).sum()) * CHANGE_CELL**2
        gain = float(won.sum()) - float(lost.sum())
        if area < max(GROWN_AREA, GROWN_SHARE * whole) or abs(gain) * CHANGE_CELL**2 < GROWN_AREA:
            continue
        outline = _trace_box(layers, mask)
        near = [walls[k] for k in tree.query(shapely.Polygon(outline), "dwithin", WALL_BESIDE)]
        kinds = {w.kind for w in near if w.probability >= 0.5 and w.length**2 >= 0.25 * area}
        if len(kinds) < 2:  # a wall that was moved is gone here and new there
            continue
        probability = min(max(w.probability for w in near if w.kind == kind) for kind in kinds)
        kind = "room grown" if gain > 0 else "room shrunk"
        found.append(RoomChange(kind, outline, area, probability, {"m2": whole, "changed_m2": area}, (r,), (n,)))
    return found
