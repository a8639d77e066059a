"""The door between geometry and learning: a topometric map as a graph of tensors.

Everything that a network may learn from is independent of the map's frame: lengths, counts and turns seen from above (gravity is
known, so the sense of a turn is, too). Where rooms and doors lie in the map's frame is kept beside it, for matching and fusion.

| tensor | shape | content |
|---|---|---|
| `x` | (R, F) float32 | `schema.ROOM_FEATURES` |
| `room_points` | (R, P, 3) float32 | centres of occupied cells, m, about the room's middle; z = 0 is its floor |
| `edge_index` | (2, 2E) int64 | from room, to room: every edge of the map in both directions |
| `edge_attr` | (2E, G) float32 | `schema.EDGE_FEATURES`, seen from the first room |
| `door_index` | (2, K) int64 | two different edges (columns of `edge_index`) that leave one room |
| `door_attr` | (K, 3) float32 | `schema.DOOR_FEATURES` |
| `storey` | (R,) int64 | of the rooms; the number depends on what the map saw, so it is no feature |
| `pos`, `edge_pos` | (R, 3), (2E, 3) float64 | middle of each room and door in the frame of the input, m |

Torch is imported inside the functions that return tensors: whoever only caches `graph_arrays` needs none.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from topomerge.embedding.schema import EDGE_KINDS, LENGTH_POWERS, POINTS_PER_ROOM, columns_of_power
from topomerge.errors import InputError
from topomerge.extraction.storeys import lowest_of_column
from topomerge.types import Array, TopometricMap, mostly_unseen

if TYPE_CHECKING:
    from torch_geometric.data import Data

GRAPH_FORMAT = 1  # of `graph_arrays`; part of the name of whatever is cached


def to_graph(map: TopometricMap, points_per_room: int = POINTS_PER_ROOM) -> Data:
    """A map as a `torch_geometric.data.Data` with the tensors above. The same map gives the same tensors.

    Raises:
        InputError: `points_per_room` is below 1.
    """
    return from_arrays(graph_arrays(map, points_per_room))


def from_arrays(arrays: Mapping[str, Array]) -> Data:
    """What `graph_arrays` gave, as tensors."""
    import torch
    from torch_geometric.data import Data

    # Copies: of a map with one room, views of its table count as contiguous with steps that torch refuses.
    values: dict[str, Any] = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}
    return Data(**values, num_nodes=len(arrays["x"]))


def graph_arrays(map: TopometricMap, points_per_room: int = POINTS_PER_ROOM) -> dict[str, Array]:
    """The arrays of the graph, by name (see the top of this file).

    Raises:
        InputError: `points_per_room` is below 1.
    """
    if points_per_room < 1:
        raise InputError(f"points per room must be 1 or more, not {points_per_room}")
    ends = map.open_edges["rooms"].astype(np.int64).reshape(-1, 2)
    index = np.concatenate([ends, ends[:, ::-1]]).T.copy()
    doors = np.concatenate([map.open_edges, map.open_edges])
    floors, spread, sides = _floors(map)
    pairs = _door_pairs(index[0])
    return {
        "x": _room_features(map, index, doors, spread, sides),
        "room_points": _room_points(map, floors, points_per_room),
        "edge_index": index,
        "edge_attr": _edge_features(map.rooms["centroid"], index, doors, floors),
        "door_index": pairs,
        "door_attr": _door_features(map.rooms["centroid"], index, doors, pairs),
        "storey": map.rooms["storey"].astype(np.int64),
        "pos": np.ascontiguousarray(map.rooms["centroid"]),
        "edge_pos": np.ascontiguousarray(doors["centre"]),
    }


def resized(arrays: Mapping[str, Array], scale: float) -> dict[str, Array]:
    """The arrays of the graph of a map whose unit is so many m long."""
    out = dict(arrays)
    for name in LENGTH_POWERS.keys() & out.keys():
        factor = np.ones(out[name].shape[1])
        for power in (1, 2, 3):
            factor[columns_of_power(name, power)] = scale**power
        out[name] = (out[name] * factor).astype(out[name].dtype)
    return out | {name: out[name] * scale for name in ("room_points", "pos", "edge_pos")}


def _groups(labels: Array, count: int) -> list[Array]:
    """Rows of each label 0..count-1, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count + 1)))[1:-1]


def _floors(map: TopometricMap) -> tuple[Array, Array, Array]:
    """Height (m) of each room's floor and its standard deviation; (R, 2) sides of the rectangle with its spread."""
    count = len(map.rooms)
    heights, spread, sides = np.zeros(count), np.zeros(count), np.zeros((count, 2))
    rows = lowest_of_column(map.navigable)
    places = map.navigable.centroids(map.navigable.cells[rows])
    body = float(map.parameters.get("body_width", 0.0))  # the strip along the walls is not navigable
    for r, group in enumerate(_groups(map.navigable_room[rows], count)):
        floor = places[group]
        if len(floor):
            heights[r], spread[r] = np.median(floor[:, 2]), floor[:, 2].std()
            values = np.linalg.eigvalsh(np.cov(floor[:, :2].T, bias=True).reshape(2, 2))[::-1]
            sides[r] = np.sqrt(12 * np.maximum(values, 0) + map.grid.edge**2) + body
    return heights, spread, sides


def _room_features(map: TopometricMap, index: Array, doors: Array, spread: Array, sides: Array) -> Array:
    rooms, count = map.rooms, len(map.rooms)
    of_kind = [np.bincount(index[0][doors["kind"] == kind], minlength=count) for kind in EDGE_KINDS]
    degree = np.bincount(np.unique(index, axis=1)[0], minlength=count)
    flat = doors["kind"] != "stairs"
    widths = np.bincount(index[0][flat], doors["width"][flat], count)
    reach = np.zeros(count)
    np.maximum.at(reach, index[0], np.linalg.norm((doors["centre"] - rooms["centroid"][index[0]])[:, :2], axis=1))
    box = np.maximum(sides.prod(axis=1), 1e-6)
    columns = [
        rooms["area"], rooms["height"], rooms["volume"], sides[:, 0], sides[:, 1], sides[:, 1] / np.maximum(sides[:, 0], 1e-6),
        rooms["area"] / box, spread, degree, *of_kind, widths / np.maximum(of_kind[0] + of_kind[1], 1), reach,
        rooms["completeness"], mostly_unseen(rooms),
    ]  # fmt: skip
    return np.stack(columns, axis=1).astype(np.float32)


def _room_points(map: TopometricMap, floors: Array, number: int) -> Array:
    """Cells of each room spread evenly over their Morton order; a room of fewer cells repeats them."""
    out = np.zeros((len(map.rooms), number, 3), np.float32)
    for r, rows in enumerate(_groups(map.room, len(map.rooms))):
        cells = map.grid.cells[rows] if len(rows) else map.navigable.cells[map.navigable_room == r]
        if len(cells):
            chosen = np.arange(number) % len(cells) if len(cells) < number else np.arange(number) * len(cells) // number
            middle = [*map.rooms["centroid"][r, :2], floors[r]]
            out[r] = map.grid.centroids(cells[chosen]) - middle
    return out


def _edge_features(middle: Array, index: Array, doors: Array, floors: Array) -> Array:
    source, target = index
    way_in = (doors["centre"] - middle[source])[:, :2]
    way_out = (middle[target] - doors["centre"])[:, :2]
    kinds = [doors["kind"] == kind for kind in EDGE_KINDS]
    straight = np.linalg.norm(way_in + way_out, axis=1)
    lengths = [np.linalg.norm(way, axis=1) for way in (way_in, way_out)]
    climb = floors[target] - floors[source]
    columns = [doors["width"], doors["height"], *kinds, straight, climb, *lengths, *_angle(way_in, way_out)]
    return np.stack(columns, axis=1).astype(np.float32)


def _door_pairs(source: Array) -> Array:
    """(2, K) every two edges that leave the same room, in both orders."""
    if not len(source):
        return np.zeros((2, 0), np.int64)
    groups = _groups(source, int(source.max()) + 1)
    pairs = [np.stack(np.meshgrid(g, g, indexing="ij")).reshape(2, -1) for g in groups]
    joined = np.concatenate(pairs, axis=1)
    return np.ascontiguousarray(joined[:, joined[0] != joined[1]], np.int64)


def _door_features(middle: Array, index: Array, doors: Array, pairs: Array) -> Array:
    first, second = doors["centre"][pairs[0]], doors["centre"][pairs[1]]
    at = middle[index[0][pairs[0]]]
    distance = np.linalg.norm((second - first)[:, :2], axis=1)
    return np.stack([distance, *_angle((first - at)[:, :2], (second - at)[:, :2])], axis=1).astype(np.float32)


def _angle(a: Array, b: Array) -> tuple[Array, Array]:
    """Sine and cosine of the angle from a to b, counter-clockwise; 0 and 1 where one of them has no length."""
    product = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    fine = product > 1e-9
    safe = np.where(fine, product, 1.0)
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / safe
    return np.where(fine, sine, 0.0), np.where(fine, (a * b).sum(axis=1) / safe, 1.0)
