"""The graph of a map's rooms as arrays, and the schema of its columns."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap, fold_text, is_mostly_unseen, select_lowest_of_column

if TYPE_CHECKING:
    from torch_geometric.data import Data


POINTS_PER_ROOM = 512  # that stand for a room
EDGE_KINDS = ("door", "opening", "stairs")  # of edges
ROOM_FEATURES = (
    "area",  # m2
    "height",  # m; 0: no ceiling seen
    "volume",  # m3
    "length",  # m, along the first principal axis seen from above: the side of a rectangle of the same spread
    "width",  # m, along the second
    "elongation",  # width / length
    "fill",  # area / (length * width): 1 for a rectangle
    "floor_spread",  # m, standard deviation of the floor's height: stairs, ramps
    "degree",  # rooms that one can walk to
    "doors",
    "openings",
    "stairs",
    "door_width",  # m, mean over doors and openings; 0: none
    "reach",  # m, from the middle to the farthest door; 0: none
    "completeness",  # share of the outline that was seen
    "glimpsed",  # 0 or 1
)
EDGE_FEATURES = (
    "width",  # m
    "height",  # m; 0: nothing seen above
    *EDGE_KINDS,  # one of them is 1
    "distance",  # m, between the middles of the rooms, seen from above
    "climb",  # m, from floor to floor
    "from_middle",  # m, from the first room's middle to the door, seen from above
    "to_middle",  # m, from the door to the second room's middle
    "turn_sin",  # of the turn at the door, walking from middle to middle; to the left is positive
    "turn_cos",
)
DOOR_FEATURES = (
    "distance",  # m, between two doors of a room, seen from above
    "angle_sin",  # of the angle at the room's middle from the first door to the second, counter-clockwise
    "angle_cos",
)
LAYOUT_FEATURES = (
    "distance",  # m, between two doors nearby, seen from above
    "climb",  # m
    "angle_sin",  # of the angle from the way out of the room to the way to the other door, counter-clockwise
    "angle_cos",
    "same",  # 1: both lead out of one room
)
WAY_FEATURES = (  # in the direction of the walls, in which crops are turned, too
    "room_x",  # m, from the middle of the first room to that of the second
    "room_y",
    "door_x",  # m, to the door between them
    "door_y",
)
THESIS_FEATURES = (
    "points",  # log of 1 + m2: occupied cells times the area of a cell's face
    "planarity",  # (s2 - s3) / s1 of the singular values s
    "box_volume",  # log of 1 + m3, of the smallest upright box
    "height",  # m, of that box
    "projection",  # log of 1 + m2, of the cells seen from above
    "spread",  # m, mean distance to the centroid
    "eigenvalues",  # smallest over largest eigenvalue of the covariance
    "smallest",  # m, smallest singular value over the root of the number of cells
    "s3_s12",  # s3 / (s1 + s2)
    "s2_s1",  # s2 / s1, not s1 / s2: that of a line is not finite
    "verticality",  # of the first principal axis: 0 level, 1 upright
    "roughness",  # m, mean distance to the plane of the 32 nearest cells
)
LANDMARK_TEXTS, LANDMARK_CLASSES = 128, 32  # columns that n-grams of characters and classes of objects are hashed into
LANDMARK_MASKS = ("texts", "objects")  # 1: the room has any; 0: the other columns of the kind say nothing
LANDMARK_FEATURES = (
    *LANDMARK_MASKS,
    *(f"text_{k}" for k in range(LANDMARK_TEXTS)),  # of its signs, tags and names, of length 1
    *(f"class_{k}" for k in range(LANDMARK_CLASSES)),  # of its objects, of length 1
)
SPECTRUM_FEATURES = tuple(f"eigenvalue_{k}" for k in range(1, 33))  # 1/m2, ascending
TABLES = {  # tensor of the graph -> its columns
    "x": ROOM_FEATURES,
    "edge_attr": EDGE_FEATURES,
    "door_attr": DOOR_FEATURES,
    "near_attr": LAYOUT_FEATURES,
    "edge_way": WAY_FEATURES,
    "engineered": THESIS_FEATURES,
    "shapedna": SPECTRUM_FEATURES,
    "landmarks": LANDMARK_FEATURES,
}
LENGTH_POWERS = {  # tensor -> column -> power of a length in its unit: how it grows when a map does
    "x": {
        "area": 2, "height": 1, "volume": 3, "length": 1, "width": 1, "floor_spread": 1, "door_width": 1, "reach": 1,
    },
    "edge_attr": {"width": 1, "height": 1, "distance": 1, "climb": 1, "from_middle": 1, "to_middle": 1},
    "door_attr": {"distance": 1},
}  # fmt: skip


def count_columns(tensor: str) -> int:
    """Return number of columns of a tensor of the graph."""
    return len(TABLES[tensor])


def find_column(tensor: str, feature: str) -> int:
    """Return the place of a feature among the columns of a tensor."""
    return TABLES[tensor].index(feature)


def find_columns_of_power(tensor: str, power: int) -> list[int]:
    """Return columns whose unit is this power of a length, ascending."""
    powers = LENGTH_POWERS[tensor]
    return [k for k, feature in enumerate(TABLES[tensor]) if powers.get(feature) == power]


GRAPH_FORMAT = 1  # of `build_graph_arrays`; part of the name of whatever is cached


def build_graph(map: TopometricMap, points_per_room: int = POINTS_PER_ROOM) -> Data:
    """Return a map as a `torch_geometric.data.Data` with the tensors above. The same map gives the same tensors.

    Raises:
        InputError: `points_per_room` is below 1.
    """
    return convert_to_tensors(build_graph_arrays(map, points_per_room))


def convert_to_tensors(arrays: Mapping[str, Array]) -> Data:
    """Convert the arrays of `build_graph_arrays` to tensors."""
    import torch
    from torch_geometric.data import Data

    # Copies: of a map with one room, views of its table count as contiguous with steps that torch refuses.
    values: dict[str, Any] = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}
    return Data(**values, num_nodes=len(arrays["x"]))


def build_graph_arrays(map: TopometricMap, points_per_room: int = POINTS_PER_ROOM) -> dict[str, Array]:
    """Return the arrays of the graph, by name (see the top of this file); `landmarks` of a map that has any.

    Raises:
        InputError: `points_per_room` is below 1.
    """
    if points_per_room < 1:
        raise InputError(f"points per room must be 1 or more, not {points_per_room}")
    ends = map.open_edges["rooms"].astype(np.int64).reshape(-1, 2)
    index = np.concatenate([ends, ends[:, ::-1]]).T.copy()
    doors = np.concatenate([map.open_edges, map.open_edges])
    floors, spread, sides = _measure_floors(map)
    pairs = _find_door_pairs(index[0])
    signs = {"landmarks": compute_landmark_features(map)} if len(map.landmarks) else {}
    return {
        "x": _compute_room_features(map, index, doors, spread, sides),
        "room_points": _sample_room_points(map, floors, points_per_room),
        "edge_index": index,
        "edge_attr": _compute_edge_features(map.rooms["centroid"], index, doors, floors),
        "door_index": pairs,
        "door_attr": _compute_door_features(map.rooms["centroid"], index, doors, pairs),
        "storey": map.rooms["storey"].astype(np.int64),
        "pos": np.ascontiguousarray(map.rooms["centroid"]),
        "edge_pos": np.ascontiguousarray(doors["centre"]),
        **signs,
    }


MOST_SIGNS = 64  # landmarks of a room and kind that are looked at, the surest first
GRAMS = (2, 3)  # characters of an n-gram, with a mark at both ends of the string


@lru_cache(maxsize=65536)
def hash_text(text: str) -> tuple[tuple[int, float], ...]:
    """Hash the n-grams of a text, folded as readers confuse its characters, so that a misread one is still like it.

    Returns:
        Column among `LANDMARK_TEXTS` and what is added there, of each n-gram; none of a text without letters and digits.
    """
    folded = fold_text(text)
    marked = f"^{folded}$"
    grams = [marked[k : k + n] for n in GRAMS for k in range(len(marked) - n + 1)] if folded else []
    codes = [zlib.crc32(gram.encode()) for gram in grams]
    return tuple(((code >> 1) % LANDMARK_TEXTS, (1 - 2 * (code & 1)) / len(codes) ** 0.5) for code in codes)


def hash_landmarks(rooms: int, texts: Iterable[tuple[int, str, float]], objects: Iterable[tuple[int, str, float]]) -> Array:
    """Hash what stands in rooms: (rooms, len(LANDMARK_FEATURES)) float32, 0 of a room without any.

    Args:
        texts: room, text and how sure it is of each; objects: room, class and how sure it is.
    """
    parts = np.zeros((rooms, LANDMARK_TEXTS)), np.zeros((rooms, LANDMARK_CLASSES))
    for room, text, sure in texts:
        for column, value in hash_text(text):
            parts[0][room, column] += sure * value
    for room, name, sure in objects:
        parts[1][room, zlib.crc32(name.strip().casefold().encode()) % LANDMARK_CLASSES] += sure
    lengths = [np.linalg.norm(part, axis=1, keepdims=True) for part in parts]
    scaled = [part / np.where(length > 0, length, 1.0) for part, length in zip(parts, lengths, strict=True)]
    return np.concatenate([*(length > 0 for length in lengths), *scaled], axis=1).astype(np.float32)


def compute_landmark_features(map: TopometricMap) -> Array:
    """Compute what the landmarks of each room say, the surest `MOST_SIGNS` of each kind: as `hash_landmarks`."""
    table, columns = map.landmarks.table, []
    for kinds in (("text", "tag", "name"), ("object",)):
        rows = np.flatnonzero(map.landmarks.is_kind(*kinds) & (table["room"] >= 0))
        rows = rows[np.lexsort((rows, -table["confidence"][rows], table["room"][rows]))]
        rows = rows[np.arange(len(rows)) - np.searchsorted(table["room"][rows], table["room"][rows]) < MOST_SIGNS]
        room, value, sure = (table[name][rows].tolist() for name in ("room", "value", "confidence"))
        columns.append([(r, map.landmarks.values[v], c) for r, v, c in zip(room, value, sure, strict=True)])
    return hash_landmarks(len(map.rooms), *columns)


def rescale_graph(arrays: Mapping[str, Array], scale: float) -> dict[str, Array]:
    """Return the arrays of the graph of a map whose unit is so many m long."""
    out = dict(arrays)
    for name in LENGTH_POWERS.keys() & out.keys():
        factor = np.ones(out[name].shape[1])
        for power in (1, 2, 3):
            factor[find_columns_of_power(name, power)] = scale**power
        out[name] = (out[name] * factor).astype(out[name].dtype)
    return out | {name: out[name] * scale for name in ("room_points", "pos", "edge_pos")}


def _group_rows(labels: Array, count: int) -> list[Array]:
    """Return the rows of each label 0..count-1, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count + 1)))[1:-1]


def _measure_floors(map: TopometricMap) -> tuple[Array, Array, Array]:
    """Measure the height (m) of each room's floor and its standard deviation, and the (R, 2) sides of the rectangle with its
    spread."""
    count = len(map.rooms)
    heights, spread, sides = np.zeros(count), np.zeros(count), np.zeros((count, 2))
    rows = select_lowest_of_column(map.navigable)
    places = map.navigable.compute_centroids(map.navigable.cells[rows])
    body = float(map.parameters.get("body_width", 0.0))  # the strip along the walls is not navigable
    for r, group in enumerate(_group_rows(map.navigable_room[rows], count)):
        floor = places[group]
        if len(floor):
            heights[r], spread[r] = np.median(floor[:, 2]), floor[:, 2].std()
            values = np.linalg.eigvalsh(np.cov(floor[:, :2].T, bias=True).reshape(2, 2))[::-1]
            sides[r] = np.sqrt(12 * np.maximum(values, 0) + map.grid.edge**2) + body
    return heights, spread, sides


def _compute_room_features(map: TopometricMap, index: Array, doors: Array, spread: Array, sides: Array) -> Array:
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
        rooms["completeness"], is_mostly_unseen(rooms),
    ]  # fmt: skip
    return np.stack(columns, axis=1).astype(np.float32)


def _sample_room_points(map: TopometricMap, floors: Array, number: int) -> Array:
    """Sample the cells of each room evenly over their Morton order; a room of fewer cells repeats them."""
    out = np.zeros((len(map.rooms), number, 3), np.float32)
    for r, rows in enumerate(_group_rows(map.room, len(map.rooms))):
        cells = map.grid.cells[rows] if len(rows) else map.navigable.cells[map.navigable_room == r]
        if len(cells):
            chosen = np.arange(number) % len(cells) if len(cells) < number else np.arange(number) * len(cells) // number
            middle = [*map.rooms["centroid"][r, :2], floors[r]]
            out[r] = map.grid.compute_centroids(cells[chosen]) - middle
    return out


def _compute_edge_features(middle: Array, index: Array, doors: Array, floors: Array) -> Array:
    source, target = index
    way_in = (doors["centre"] - middle[source])[:, :2]
    way_out = (middle[target] - doors["centre"])[:, :2]
    kinds = [doors["kind"] == kind for kind in EDGE_KINDS]
    straight = np.linalg.norm(way_in + way_out, axis=1)
    lengths = [np.linalg.norm(way, axis=1) for way in (way_in, way_out)]
    climb = floors[target] - floors[source]
    columns = [doors["width"], doors["height"], *kinds, straight, climb, *lengths, *_compute_angle(way_in, way_out)]
    return np.stack(columns, axis=1).astype(np.float32)


def _find_door_pairs(source: Array) -> Array:
    """Return (2, K) every two edges that leave the same room, in both orders."""
    if not len(source):
        return np.zeros((2, 0), np.int64)
    groups = _group_rows(source, int(source.max()) + 1)
    pairs = [np.stack(np.meshgrid(g, g, indexing="ij")).reshape(2, -1) for g in groups]
    joined = np.concatenate(pairs, axis=1)
    return np.ascontiguousarray(joined[:, joined[0] != joined[1]], np.int64)


def _compute_door_features(middle: Array, index: Array, doors: Array, pairs: Array) -> Array:
    first, second = doors["centre"][pairs[0]], doors["centre"][pairs[1]]
    at = middle[index[0][pairs[0]]]
    distance = np.linalg.norm((second - first)[:, :2], axis=1)
    return np.stack([distance, *_compute_angle((first - at)[:, :2], (second - at)[:, :2])], axis=1).astype(np.float32)


def _compute_angle(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the sine and cosine of the angle from a to b, counter-clockwise; 0 and 1 where one of them has no length."""
    product = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    fine = product > 1e-9
    safe = np.where(fine, product, 1.0)
    sine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / safe
    return np.where(fine, sine, 0.0), np.where(fine, (a * b).sum(axis=1) / safe, 1.0)


STOREY_CLIMB = 2.0  # m at most, between the middles of rooms of one storey
DISTANCE, CLIMB, TURN_COS = (find_column("edge_attr", feature) for feature in ("distance", "climb", "turn_cos"))
KIND_COLUMNS = [find_column("edge_attr", kind) for kind in EDGE_KINDS]


def add_proximity_edges(graph: Mapping[str, Array], reach: float) -> dict[str, Array]:
    """Return `edge_index`, `edge_attr` and `edge_pos` with an edge between any two rooms of a storey whose middles are at most
    `reach` (m, seen from above) apart.

    Its features are the distance and the climb; it is of no kind. Ways back stay half of all edges behind the ways there.
    """
    pos = np.asarray(graph["pos"], float)
    away = np.linalg.norm(pos[:, None, :2] - pos[None, :, :2], axis=2)
    first, second = np.nonzero(np.triu((away <= reach) & (abs(pos[:, None, 2] - pos[None, :, 2]) <= STOREY_CLIMB), 1))
    features = np.zeros((len(first), count_columns("edge_attr")), np.float32)
    features[:, DISTANCE], features[:, CLIMB], features[:, TURN_COS] = away[first, second], pos[second, 2] - pos[first, 2], 1.0
    back = features.copy()
    back[:, CLIMB] *= -1
    middle = (pos[first] + pos[second]) / 2
    index, attr, places = (np.asarray(graph[name]) for name in ("edge_index", "edge_attr", "edge_pos"))
    half = index.shape[1] // 2
    directions = np.concatenate([index[:, :half], [first, second], index[:, half:], [second, first]], axis=1)
    return {
        "edge_index": directions.astype(np.int64),
        "edge_attr": np.concatenate([attr[:half], features, attr[half:], back]).astype(np.float32),
        "edge_pos": np.concatenate([places[:half], middle, places[half:], middle]),
    }


def is_door_edge(graph: Mapping[str, Array]) -> Array:
    """Return (2E,) bool: which edges are doors, openings or stairs."""
    return np.asarray(np.asarray(graph["edge_attr"])[:, KIND_COLUMNS].any(axis=1))
