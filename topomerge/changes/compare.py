"""Compare two maps of one place: walls, doors, rooms and furniture that are new, gone or altered, by what both maps saw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from topomerge.blas import limit_blas_threads
from topomerge.changes.doors import DoorChange, DoorReader, find_door_changes, find_door_corrections
from topomerge.changes.elements import find_furniture_changes, find_wall_changes
from topomerge.changes.layers import CHANGE_CELL, PlacedMap, RelativePlacement, StoreyLayers, build_storey_layers
from topomerge.changes.rooms import RoomChange, find_room_changes, find_room_corrections
from topomerge.errors import InputError
from topomerge.fusion.inputs import check_different, is_same_scan
from topomerge.fusion.pipeline import MergeConfig, place_pair
from topomerge.types import Array, Placement, Sim3, TopometricMap

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
    """What has changed from an old map to a new one.

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
    """What was corrected in one of two maps of one scan: the walls and the furniture are the same."""
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


def select_kinds(changes: Changes, kinds: Sequence[str]) -> Changes:
    """Select the changes of some kinds."""
    return replace(changes, changes=tuple(c for c in changes.changes if c.kind in kinds))
