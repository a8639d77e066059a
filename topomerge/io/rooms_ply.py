"""Write rooms as a coloured PLY file."""

from __future__ import annotations

import heapq
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.types import Array, TopometricMap

LIGHT = ("77AADD", "EE8866", "EEDD88", "FFAABB", "44BB99", "BBCC33", "99DDFF", "AAAA00")
NO_ROOM = (150, 150, 150)
WALL_BETWEEN = 0.4  # m: rooms with this much wall between them stand side by side


def _build_palette() -> Array:
    """Return (16, 3) uint8: the scheme, then the same darkened for maps that need more than eight."""
    light = np.array([[int(code[i : i + 2], 16) for i in (0, 2, 4)] for code in LIGHT], np.float64)
    return np.concatenate([light, light * 0.62]).round().astype(np.uint8)


PALETTE = _build_palette()


def find_adjacent_rooms(map: TopometricMap) -> Array:
    """Find (k, 2) int64 pairs of rooms, ascending, that a door joins or that only a wall's thickness parts, on one storey."""
    pairs = [np.sort(map.edges["rooms"].astype(np.int64), axis=1)]
    pairs += [_find_touching_rooms(map, axis) for axis in (0, 1)]
    both = np.concatenate(pairs)
    return np.unique(both[both[:, 0] != both[:, 1]], axis=0).reshape(-1, 2)


def _find_touching_rooms(map: TopometricMap, axis: int) -> Array:
    """Return the pairs of rooms that follow each other along an axis, seen from above, no further apart than `GAP`."""
    inside = map.navigable_room >= 0
    room = map.navigable_room[inside].astype(np.int64)
    along, across = map.navigable.cells[inside][:, (axis, 1 - axis)].T.astype(np.int64)
    length, width = (int(size) + 1 for size in np.array(map.navigable.shape)[[axis, 1 - axis]])
    line = map.rooms["storey"][room].astype(np.int64) * width + across
    columns = np.sort((line * length + along) * len(map.rooms) + room)  # one number a cell sorts several times as fast
    line_along, room = np.divmod(columns, max(len(map.rooms), 1))
    line, along = np.divmod(line_along, length)
    near = (np.diff(along) <= WALL_BETWEEN / map.grid.edge + 1) & (np.diff(line) == 0)
    return np.sort(np.stack([room[:-1], room[1:]], axis=1)[near], axis=1).reshape(-1, 2)


def assign_colour_numbers(rooms: int, pairs: Array) -> Array:
    """Return (rooms,) int64 number in `PALETTE` of each room: greedy, the most constrained room first (Brélaz 1979).

    Of the colours that a room may have it takes the one that is used least, so that a plan is not all in two colours.
    """
    around: list[set[int]] = [set() for _ in range(rooms)]
    for a, b in pairs.tolist():
        around[a].add(b)
        around[b].add(a)
    number = np.full(rooms, -1)
    used = np.zeros(len(PALETTE), np.int64)
    taken: list[set[int]] = [set() for _ in range(rooms)]
    queue = [(0, -len(around[i]), i) for i in range(rooms)]
    heapq.heapify(queue)
    while queue:
        constraints, _, room = heapq.heappop(queue)
        if number[room] >= 0 or -constraints < len(taken[room]):
            continue  # it has its colour, or stands in the queue again with more constraints
        allowed = [c for c in range(len(LIGHT)) if c not in taken[room]]
        allowed = allowed or [c for c in range(len(PALETTE)) if c not in taken[room]] or list(range(len(PALETTE)))
        number[room] = min(allowed, key=lambda c: (used[c], c))
        used[number[room]] += 1
        for other in around[room]:
            if int(number[room]) not in taken[other]:
                taken[other].add(int(number[room]))
                heapq.heappush(queue, (-len(taken[other]), -len(around[other]), other))
    return number


_colours: WeakKeyDictionary[TopometricMap, Array] = WeakKeyDictionary()


def assign_room_colours(map: TopometricMap) -> Array:
    """Return (R, 3) uint8 red, green, blue of each room, found once for a map. The same map gives the same colours."""
    if map not in _colours:
        _colours[map] = PALETTE[assign_colour_numbers(len(map.rooms), find_adjacent_rooms(map))].reshape(-1, 3)
        _colours[map].flags.writeable = False  # all who ask share it
    return _colours[map]


FLOAT32_FAR = 1e4  # m: beyond, float32 rounds by a millimetre and, soon after, by centimetres


def _build_vertices(map: TopometricMap) -> Array:
    points = map.grid.compute_centroids()
    real = "<f8" if len(points) and np.abs(points).max() > FLOAT32_FAR else "<f4"
    layout = [("x", real), ("y", real), ("z", real), ("room", "<i4"), ("storey", "<i4")]
    layout += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(points), layout)
    for axis, name in enumerate("xyz"):
        vertices[name] = points[:, axis]
    vertices["room"], vertices["storey"] = map.room, map.find_cell_storeys()
    colours = np.concatenate([assign_room_colours(map), np.array([NO_ROOM], np.uint8)])[map.room]  # -1: the last row
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    return vertices


def save_rooms_ply(map: TopometricMap, path: str | Path) -> None:
    """Write one vertex for each occupied cell: binary, little endian.

    Properties: x y z, the centre of the cell in the input's frame, m (float; double beyond 10 km, where float would lose
    centimetres); int room (-1: none); int storey; red green blue by room.

    Raises:
        InputError: the path can't be written.
    """
    vertices = _build_vertices(map)
    types = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
    assert vertices.dtype.names is not None
    properties = [f"property {types[vertices.dtype[name].str[1:]]} {name}" for name in vertices.dtype.names]
    head = ["ply", "format binary_little_endian 1.0", "comment topomerge rooms, metres, z up"]
    head += [f"element vertex {len(vertices)}", *properties, "end_header"]
    with replace_on_success(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
