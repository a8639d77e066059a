"""The rigid pieces that a map is bent by: rooms, large ones cut, and what joins neighbouring ones (method 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.matching.poses import PlanFields
from topomerge.registration.storeys import find_slices, is_extruded
from topomerge.types import Array, TopometricMap, VoxelGrid, are_within

# Blocks, not rooms alone: corridors and halls bend within themselves, and maps without rooms must bend, too (docs/adr/0014).
PIECE_SIZE = 5.0  # m, of a piece along a main direction; rooms up to `WHOLE_SIZE` are not cut
WHOLE_SIZE = 7.5
ROOM_WALL_REACH = 0.6  # m around a room's floor: the walls there are its walls
LEAST_WALLS = 8  # columns of walls, without which a piece can't be registered and gets none
STOREY_LENGTH = 10.0  # m of walk from a storey to the next one
SOFTER = 2.0  # times the fitted drift of a sensor: rooms that drifted within themselves are no rigid pieces (validation pairs)


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of a map, in its own frame.

    Args:
        anchors: (n, 2) m, the middle of each one's walls.
        storey: (n,) int, place of its storey in the map.
        room: (n,) int32, -1 where the map has no rooms.
        walls: (w, 2) m, columns of walls; of all storeys.
        faces: (w, 2) towards empty space, 0 unknown.
        tall: (w,) bool, higher than furniture.
        owner: (w,) piece of each.
        joints: (j, 2) neighbouring pieces.
        lengths: (j,) m of walk between them.
    """

    anchors: Array
    storey: Array
    room: Array
    walls: Array
    faces: Array
    tall: Array
    owner: Array
    joints: Array
    lengths: Array

    def __len__(self) -> int:
        return len(self.anchors)


def build_pieces(storeys: Sequence[PlanFields], map: TopometricMap | None = None) -> Pieces:
    """Return the pieces of a map's storeys: its rooms, in parts of some metres where they are large; of a map without rooms
    blocks along its main direction."""
    parts = []
    for number, fields in enumerate(storeys):
        if len(fields.walls) < LEAST_WALLS:
            continue
        rooms = None if map is None else _find_wall_rooms(fields, map)
        parts.append(_build_storey_pieces(fields, number, rooms))
    return _stack_pieces(parts)


def _build_storey_pieces(fields: PlanFields, number: int, rooms: Array | None) -> Pieces:
    walls = fields.walls
    main = fields.main_direction
    turned = walls @ np.array([[np.cos(main), -np.sin(main)], [np.sin(main), np.cos(main)]])
    room = np.full(len(walls), -1, np.int32) if rooms is None else rooms
    block = np.zeros((len(walls), 2), np.int64)
    for r in np.unique(room):
        rows = np.flatnonzero(room == r)
        low, span = turned[rows].min(axis=0), np.ptp(turned[rows], axis=0)
        whole = WHOLE_SIZE if r >= 0 else PIECE_SIZE
        count = np.where(span <= whole, 1, np.ceil(span / PIECE_SIZE))
        block[rows] = np.minimum((turned[rows] - low) / np.maximum(span, 1e-6) * count, count - 1).astype(np.int64)
    blocks = block.max(axis=0) + 1
    _, owner = np.unique(((room.astype(np.int64) + 1) * blocks[0] + block[:, 0]) * blocks[1] + block[:, 1], return_inverse=True)
    owner = _merge_small_pieces(walls, owner)
    many = int(owner.max()) + 1
    count = np.bincount(owner, minlength=many)
    anchors = np.column_stack([np.bincount(owner, walls[:, k], many) / count for k in (0, 1)])
    first = np.full(many, len(owner))
    np.minimum.at(first, owner, np.arange(len(owner)))
    faces = fields.face[fields.plan.wall].astype(np.float64)
    joints, lengths = _find_joints(walls, owner, anchors)
    return Pieces(anchors, np.full(many, number), room[first], walls, faces, fields.tall, owner, joints, lengths)


def _merge_small_pieces(walls: Array, owner: Array) -> Array:
    """Return the owners without pieces of fewer than `LEAST_WALLS` columns, whose walls go to the nearest other piece."""
    count = np.bincount(owner)
    small = count[owner] < LEAST_WALLS
    if small.any() and not small.all():
        owner = owner.copy()
        owner[small] = owner[~small][cKDTree(walls[~small]).query(walls[small])[1]]
    return np.unique(owner, return_inverse=True)[1]


def _find_joints(walls: Array, owner: Array, anchors: Array) -> tuple[Array, Array]:
    """Return the pieces whose walls come near each other, and how far their middles lie apart, m."""
    near = cKDTree(walls).query_pairs(1.0, output_type="ndarray")
    ends = owner[near]
    ends = ends[ends[:, 0] != ends[:, 1]]
    pairs, many = np.unique(ends.min(axis=1) * len(anchors) + ends.max(axis=1), return_counts=True)
    joints = np.column_stack(np.divmod(pairs[many >= 3], len(anchors)))
    joints = np.concatenate([joints, _find_bridges(joints, anchors)])
    return joints, np.linalg.norm(anchors[joints[:, 0]] - anchors[joints[:, 1]], axis=1)


def _find_bridges(joints: Array, anchors: Array) -> Array:
    """Return the joints that connect what is in several parts: each to the nearest piece of another part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    new: list[list[int]] = []
    while True:
        ends = np.array([*joints.tolist(), *new], np.int64).reshape(-1, 2)
        graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(len(anchors),) * 2)
        parts, label = connected_components(graph, directed=False)
        if parts == 1:
            return np.array(new, np.int64).reshape(-1, 2)
        smallest = np.bincount(label).argmin()
        inside, outside = np.flatnonzero(label == smallest), np.flatnonzero(label != smallest)
        distance, nearest = cKDTree(anchors[outside]).query(anchors[inside])
        k = int(distance.argmin())
        new.append([int(inside[k]), int(outside[nearest[k]])])


def _find_wall_rooms(fields: PlanFields, map: TopometricMap) -> Array:
    """Return (w,) int32 room whose floor is nearest to each wall column of a storey, -1 where none is within
    `ROOM_WALL_REACH`."""
    plan, labels = fields.plan, np.full(fields.plan.wall.shape, -1, np.int32)
    inside = map.navigable_room >= 0
    places = map.navigable.compute_centroids(map.navigable.cells[inside])
    rooms = map.navigable_room[inside]
    level = plan.floor_guess
    here = np.abs(places[:, 2] - level) < 1.5
    columns = np.floor((places[here, :2] - plan.origin) / plan.edge).astype(np.int64)
    within = are_within(columns, 0, labels.shape)
    labels[tuple(columns[within].T)] = rooms[here][within]
    if not (labels >= 0).any():
        return np.full(int(plan.wall.sum()), -1, np.int32)
    distance, nearest = ndimage.distance_transform_edt(labels < 0, return_indices=True)
    nearest_room = labels[tuple(nearest)]
    out: Array = np.where(distance * plan.edge <= ROOM_WALL_REACH, nearest_room, -1)[plan.wall].astype(np.int32)
    return out


def _stack_pieces(parts: Sequence[Pieces]) -> Pieces:
    """Stack the pieces of all storeys, each joined with the nearest one of the storey below."""
    if not parts:
        none = np.zeros(0, np.int64)
        flat = np.zeros((0, 2))
        return Pieces(flat, none, none, flat, flat, none.astype(bool), none, flat.astype(np.int64), np.zeros(0))
    first = np.cumsum([0, *(len(p) for p in parts)])
    joints, lengths = [p.joints + n for p, n in zip(parts, first, strict=False)], [p.lengths for p in parts]
    for k in range(1, len(parts)):
        gap, below = cKDTree(parts[k - 1].anchors).query(parts[k].anchors)
        joints.append(np.column_stack([first[k] + np.arange(len(parts[k])), first[k - 1] + below]))
        lengths.append(STOREY_LENGTH + gap)
    rows = ("anchors", "storey", "room", "walls", "faces", "tall")
    whole = {name: np.concatenate([getattr(p, name) for p in parts]) for name in rows}
    owner = np.concatenate([p.owner + n for p, n in zip(parts, first, strict=False)])
    return Pieces(**whole, owner=owner, joints=np.concatenate(joints), lengths=np.concatenate(lengths))


@dataclass(frozen=True)
class Drift:
    """Standard deviation of shifts, m, and of turns, rad, over a walk of one metre; they grow with the square root of the walk.
    0: the map does not bend."""

    shift: float
    turn: float

    @property
    def rigid(self) -> bool:
        """Does the map not bend at all?"""
        return self.shift <= 0


def get_sensor_drift(sensor: str, fitted: bool = False) -> Drift:
    """Return the drift that joints of a sensor's maps are as stiff as; `fitted`: as it was fitted.

    Raises:
        InputError: none that is listed in `drift.json`.
    """
    sensors = _load_fitted_drifts()
    if sensor not in sensors:
        raise InputError(f"sensor must be one of {', '.join(sorted(sensors))}, not {sensor!r}")
    softer = 1.0 if sensor == "unknown" or fitted else SOFTER
    return Drift(softer * float(sensors[sensor]["shift"]), softer * float(sensors[sensor]["turn"]))


def _load_fitted_drifts() -> dict[str, Any]:
    return read_weights_json("topomerge.registration.bend", "drift.json")


def detect_sensor(map: TopometricMap | VoxelGrid) -> str:
    """Return the sensor of a map: the one that its parameters name; else a drawing or a slice where it looks like one, or
    unknown. A name that nobody fitted a drift to says nothing."""
    named = map.parameters.get("sensor") if isinstance(map, TopometricMap) else None
    if isinstance(named, str) and named in _load_fitted_drifts():
        return named
    grid = map.grid if isinstance(map, TopometricMap) else map
    if is_extruded(grid):
        return "raised"
    return "laser2d" if find_slices(grid) else "unknown"


def select_drifts(sensors: Sequence[str]) -> list[Drift]:
    """Return the drift of each of several maps. One that was raised from lines is taken for a drawing, which does not bend, among
    maps that were measured in space; among maps of lines alone, nobody knows which ones were measured.

    Raises:
        InputError: a sensor that is not in `drift.json`.
    """
    flat = all(s == "raised" for s in sensors)
    return [get_sensor_drift(("unknown" if flat else "drawing") if s == "raised" else s) for s in sensors]
