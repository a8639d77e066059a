"""Compare two maps of one place: walls, doors, rooms and furniture that are new, gone or altered, by what both maps saw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from scipy import ndimage

from topomerge.blas import limit_blas_threads
from topomerge.changes.doors import DoorChange, DoorReader, find_door_changes, find_door_corrections
from topomerge.changes.elements import WallChange, find_furniture_changes, find_wall_changes
from topomerge.changes.layers import CHANGE_CELL, PlacedMap, RelativePlacement, StoreyLayers, build_storey_layers
from topomerge.errors import InputError
from topomerge.fusion.inputs import check_different, is_same_scan
from topomerge.fusion.pipeline import MergeConfig, place_pair
from topomerge.types import Array, Placement, Sim3, TopometricMap

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
    reported = {r for c in found for r in c.old}, {r for c in found for r in c.new}
    own = _find_enclosed(layers, new, old, [w for w in walls if w.kind == "wall new"], reported[1])
    found += [RoomChange("room new", outline, area, p, e, (), (room,)) for room, outline, area, p, e in own]
    own = _find_enclosed(layers, old, new, [w for w in walls if w.kind == "wall gone"], reported[0])
    found += [RoomChange("room gone", outline, area, p, e, (room,), ()) for room, outline, area, p, e in own]
    reported = {r for c in found for r in c.old}, {r for c in found for r in c.new}
    return found + _find_grown(layers, walls, reported)


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
    """Return the rooms of one map that are several of the other one, and a wall stands within them that the first one has not."""
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
    layers: StoreyLayers, own: Array, other: Array, walls: Sequence[WallChange], reported: set[int]
) -> list[tuple[int, Array, float, float, dict[str, float]]]:
    """Return the rooms of one map whose ground the other one saw and in which none of its rooms lies, and whose border walls make
    that only the first one has: room, outline, m2, probability and evidence."""
    if not walls:
        return []
    found, sizes = [], np.bincount(other[other >= 0], minlength=1)
    close = [(wall.probability, layers.rasterise(shapely.Polygon(wall.outline).buffer(BORDER))) for wall in walls]
    seen = (layers.new if own is layers.old.room else layers.old).free
    for room in np.setdiff1d(np.unique(own[own >= 0]), sorted(reported)).tolist():
        mask = own == room
        area, share = float(mask.sum()) * CHANGE_CELL**2, float((mask & seen).sum() / mask.sum())
        inside = other[mask & (other >= 0)]
        shares = np.bincount(inside, minlength=len(sizes)) / np.maximum(sizes, 1)
        if area < PART_AREA or share < SEEN_SHARE or shares.max() >= ITS_OWN:
            continue
        border = mask & ~ndimage.binary_erosion(mask)
        enclosing = np.max([np.where(border & near, probability, 0.0) for probability, near in close], axis=0)
        enclosed = float((enclosing > 0).sum() / border.sum())
        if enclosed < ENCLOSED:
            continue
        probability = float(enclosing[enclosing > 0].mean())
        evidence = {"wall": probability, "m2": area, "seen": share, "enclosed": enclosed}
        found.append((room, _trace_box(layers, mask), area, probability * share, evidence))
    return found


def _find_sides(layers: StoreyLayers, parts: Array, ends: Array) -> set[int]:
    """Return the rooms on the two sides of a wall; one where it parts nothing."""
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
    """Return (4, 2) m of the rectangle around a mask, in the axes of the raster."""
    pixels = np.argwhere(mask)
    low, high = pixels.min(axis=0) - 0.5, pixels.max(axis=0) + 0.5
    return layers.compute_points(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]))[:, :2]


def _find_grown(layers: StoreyLayers, walls: Sequence[WallChange], reported: tuple[set[int], set[int]]) -> list[RoomChange]:
    """Return the rooms that won or lost ground to their neighbours because a wall between them was moved."""
    old, new, both = layers.old.room, layers.new.room, layers.both
    if not walls or not (old >= 0).any() or not (new >= 0).any():
        return []
    shared = both & (old >= 0) & (new >= 0)
    table = np.zeros((int(old.max()) + 1, int(new.max()) + 1))
    np.add.at(table, (old[shared], new[shared]), CHANGE_CELL**2)
    tree = shapely.STRtree([shapely.Polygon(w.outline) for w in walls])
    found = []
    for r, n in enumerate(table.argmax(axis=1).tolist()):
        if r in reported[0] or n in reported[1] or table[r, n] == 0 or int(table[:, n].argmax()) != r:
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


LEAST_PROBABILITY = 0.5
KINDS = (
    "wall new", "wall gone",
    "door new", "door gone", "door opened", "door shut", "door bricked up",
    "room split", "room joined", "room grown", "room shrunk", "room new", "room gone",
    "furniture new", "furniture gone", "furniture moved",
    "element elsewhere", "element missing",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Change:
    """One thing that is not as it was.

    Args:
        kind: one of `KINDS`.
        storey: of the old map.
        place: (3,) m, its middle on the floor, in the frame of the old map.
        shape: (n, 2) m, its outline from above (closed, n > 2) or its line (n = 2).
        extent: m: length of a wall, width of a door, longest side of furniture; of a room the square root of the area that
            changed.
        probability: that it is so and of this kind.
        evidence: name -> number, what the probability was made of.
        old, new: numbers of the doors or rooms that it is about in the old and in the new map; empty where it is about none.
        from_place: (3,) m, where moved furniture stood; None of all others.
        guid: of an element of a building model; empty of all others.
        name: of that element.
    """

    kind: str
    storey: int
    place: Array
    shape: Array
    extent: float
    probability: float
    evidence: dict[str, float] = field(default_factory=dict)
    old: tuple[int, ...] = ()
    new: tuple[int, ...] = ()
    from_place: Array | None = None
    guid: str = ""
    name: str = ""

    @property
    def element(self) -> str:
        """wall, door, room, furniture, or element of a building model."""
        return self.kind.split(" ")[0]


@dataclass(frozen=True, eq=False)
class Changes:
    """Changes from an old map to a new one.

    Args:
        changes: by storey, kind and falling probability.
        placement: of the new map in the frame of the old one.
        compared: m2 of each storey of the old map that both maps saw.
        slack: m, by which things may be off that count as unchanged: the median over the walls of both.
        old, new: the maps.
        elements: rows of a building model that was compared (`model.ElementRow`); empty where none was.
    """

    changes: tuple[Change, ...]
    placement: PlacedMap
    compared: dict[int, float]
    slack: float
    old: TopometricMap
    new: TopometricMap
    elements: tuple[Any, ...] = ()

    def __len__(self) -> int:
        return len(self.changes)

    def count_kinds(self) -> dict[str, int]:
        """Count the changes of each kind there is, in the order of `KINDS`."""
        kinds = [c.kind for c in self.changes]
        return {kind: kinds.count(kind) for kind in KINDS if kind in kinds}


def align_maps(old: TopometricMap, new: TopometricMap, **choices: Any) -> tuple[PlacedMap | None, str, tuple[str, ...]]:
    """Align two maps as `merge` does; two of one scan, corrected differently, lie as they are.

    Args:
        old, new: any maps.
        choices: keywords of `merge`: threshold, same, scale, rigid.

    Returns:
        Where the new map lies in the frame of the old one, None where that is not believed; why, in words; and warnings.

    Raises:
        InputError: as `merge`; both are one map.
    """
    if is_same_scan(old, new):
        if all(np.array_equal(getattr(old, name), getattr(new, name)) for name in ("navigable_room", "rooms", "edges")):
            check_different(old, new)
        return Placement(Sim3()), "aligned: both are of one scan; what was corrected is compared", ()
    result = place_pair((old, new), MergeConfig(**choices))
    placements = result.placements if result.merged else {}
    if 1 not in placements:
        return None, result.reason.replace("not merged", "not aligned", 1), result.warnings
    return RelativePlacement(placements[0], placements[1]), result.reason.replace("merged", "aligned", 1), result.warnings


@limit_blas_threads
def compare_maps(
    old: TopometricMap, new: TopometricMap, placement: PlacedMap | None = None, least: float = LEAST_PROBABILITY
) -> Changes:
    """Find what has changed between two maps of one place. Nothing is said of what only one of them saw. Of two maps of one scan
    what was corrected is compared: rooms and doors.

    Args:
        old, new: any maps.
        placement: takes the new map into the frame of the old one, as `MergeResult.placements` has it; None: one frame.
        least: changes that are less probable are left out.

    Raises:
        InputError: an empty map, or maps that share no storey.
    """
    placement = Placement(Sim3()) if placement is None else placement
    layers = build_storey_layers(old, new, placement)
    if not layers:
        raise InputError(f"{new.source or 'the new map'}: shares no storey with {old.source or 'the old one'}; align the maps")
    reader = DoorReader(old, new, placement)
    find = _find_corrections if is_same_scan(old, new) and _is_in_place(placement) else _find_storey_changes
    found = [change for storey in layers for change in find(storey, reader)]
    selected = [c for c in found if c.probability >= least]
    selected.sort(key=lambda c: (c.storey, KINDS.index(c.kind), -c.probability, *c.place.tolist()))
    compared: dict[int, float] = {}
    for s in layers:
        compared[s.storeys[0]] = compared.get(s.storeys[0], 0.0) + float(s.both.sum()) * CHANGE_CELL**2
    slack = np.concatenate([s.slack[s.old.wall & s.new.wall] for s in layers])
    return Changes(tuple(selected), placement, compared, float(np.median(slack)) if len(slack) else float("nan"), old, new)


def _find_storey_changes(layers: StoreyLayers, reader: DoorReader) -> Iterator[Change]:
    walls = find_wall_changes(layers, reader.list_places(layers))
    doors = find_door_changes(layers, reader, walls)
    for wall in walls:
        yield _build_change(layers, wall.kind, wall.outline, wall.length, wall.probability, wall.evidence)
    yield from (_build_door_change(layers, door) for door in doors)
    yield from (_build_room_change(layers, room) for room in find_room_changes(layers, walls))
    for thing in find_furniture_changes(layers, walls, reader.list_places(layers)):
        change = _build_change(layers, thing.kind, thing.outline, thing.length, thing.probability, thing.evidence)
        start = None if thing.start is None else np.append(thing.start, layers.floor)
        yield replace(change, from_place=start)


def _find_corrections(layers: StoreyLayers, reader: DoorReader) -> Iterator[Change]:
    """Find doors and rooms that were corrected in one of two maps of one scan: the walls and the furniture are the same."""
    yield from (_build_door_change(layers, door) for door in find_door_corrections(layers, reader))
    yield from (_build_room_change(layers, room) for room in find_room_corrections(layers))


def _is_in_place(placement: PlacedMap) -> bool:
    return bool(np.allclose(placement.pose.matrix, np.eye(4), atol=1e-6))


def _build_door_change(layers: StoreyLayers, door: DoorChange) -> Change:
    half = 0.5 * door.width * np.array([-np.sin(door.direction), np.cos(door.direction)])
    line = np.array([door.centre - half, door.centre + half])
    change = _build_change(layers, door.kind, line, door.width, door.probability, door.evidence)
    return replace(change, old=tuple(k for k in (door.old,) if k >= 0), new=tuple(k for k in (door.new,) if k >= 0))


def _build_room_change(layers: StoreyLayers, room: RoomChange) -> Change:
    change = _build_change(layers, room.kind, room.outline, float(np.sqrt(room.area)), room.probability, room.evidence)
    return replace(change, old=room.old, new=room.new)


def _build_change(
    layers: StoreyLayers, kind: str, shape: Array, extent: float, probability: float, evidence: dict[str, float]
) -> Change:
    middle = (shape.min(axis=0) + shape.max(axis=0)) / 2 if len(shape) > 2 else shape.mean(axis=0)
    place = np.append(middle, layers.floor)
    rounded = {name: round(float(value), 3) for name, value in evidence.items()}
    return Change(kind, layers.storeys[0], place, shape, round(extent, 3), round(float(probability), 4), rounded)
