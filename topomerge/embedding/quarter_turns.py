"""Rows of rooms that depend on how a map is turned: one for each quarter turn, and the turn that two maps have to each other.

An embedder gives (R, D), or `TurnedRows`. Those of two maps are compared at one quarter turn for the whole pair: that at which
most rooms that look alike are moved by the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from topomerge.embedding.graph import count_columns
from topomerge.embedding.surroundings import CROP_SHAPES, rotate_crops
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, Array, TopometricMap

QUARTERS = 4
FACTS = count_columns("x") + 2
SHARPNESS = 6.0  # that cosines are multiplied with before rooms choose partners; chosen, as those below, on validation pairs
PARTNERS = 4  # pairs of rooms that vote, times the number of rooms
WAYS_ALIKE = 0.5  # m, standard deviation of how far rooms that are one are moved
ONE_PLACE = 1.0  # m, that of the middles of one room in two maps, of which one may have looked into it only


@dataclass(frozen=True, eq=False)
class TurnedRows:
    """What rooms look like in a map that is turned by 0 to 3 quarter turns, counter-clockwise seen from above.

    Args:
        rows: (R, 4, D) of length 1 each.
        places: (R, 2) m, middles of the rooms; both in the direction of the map's walls (`sheets.Sheet.turn`).
        embedder: hash of the weights that made them, where there is one.
        facts: (R, FACTS) what a matcher of two maps reads besides (`compute_room_features`), where there is one.
    """

    rows: Array
    places: Array
    embedder: str = ""
    facts: Array | None = None

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the rows."""
        return self.rows.shape

    def flatten(self, turns: int = 0) -> Array:
        """Return (R, 4 D) of length 1: the rows of the map turned so often, behind each other."""
        count, _, size = self.rows.shape
        out: Array = np.roll(self.rows, -turns, axis=1).reshape(count, QUARTERS * size) / np.sqrt(QUARTERS)
        return out


Rows = Array | TurnedRows


def compute_room_features(x: Array, dustbin: Array, heights: Array) -> Array:
    """(R, FACTS) the numbers of rooms (`schema`) as logarithms, the logits of having no partner (R,), and heights (R,) m."""
    out: Array = np.column_stack([np.sign(x) * np.log1p(np.abs(x)), dustbin, heights]).astype(np.float64)
    return out


def get_rows(rows: Rows) -> Array:
    """(R, D), or (R, 4, D) of rows for quarter turns."""
    return rows.rows if isinstance(rows, TurnedRows) else rows


def align_rows(a: Rows, b: Rows) -> tuple[Array, Array]:
    """Rows (R_a, D), (R_b, D) of two maps, of which the second one is turned so that it stands as the first one does.

    All four turns of both maps have a say in how alike two rooms are. Plain rows stay as they are.
    """
    if not isinstance(a, TurnedRows) or not isinstance(b, TurnedRows):
        return np.asarray(a), np.asarray(b)
    return a.flatten(), b.flatten(estimate_quarter_turns(a, b))


def estimate_quarter_turns(a: TurnedRows, b: TurnedRows) -> int:
    """Quarter turns by which b is to be turned (`estimate_relative_position`)."""
    return estimate_relative_position(a, b)[0]


def estimate_relative_position(a: TurnedRows, b: TurnedRows) -> tuple[int, complex]:
    """Quarter turns by which b is to be turned, and the way that its rooms are moved by then, m: those on which the most votes
    agree. Each two rooms vote for the way between them, the more the more alike they are, and the less alike others are to
    them."""
    if not len(a) or not len(b):
        return 0, 0j
    flat, x, y = a.flatten(), _convert_to_complex(a.places), _convert_to_complex(b.places)
    voted = [_find_most_votes(flat @ b.flatten(k).T, x, y * 1j**k) for k in range(QUARTERS)]
    best = int(np.argmax([votes for votes, _ in voted]))
    return best, voted[best][1]


def score_common_motion(a: TurnedRows, b: TurnedRows, quarters: int, way: complex) -> Array:
    """Return (R_a, R_b) from 0 to 1: is a room of b, turned and moved (`estimate_relative_position`), where a room of a is?"""
    off = _convert_to_complex(a.places)[:, None] - _convert_to_complex(b.places)[None] * 1j**quarters - way
    out: Array = np.exp(-(np.abs(off) ** 2) / (2 * ONE_PLACE**2))
    return out


def _find_most_votes(cosine: Array, x: Array, y: Array) -> tuple[float, complex]:
    weight = np.exp(SHARPNESS * (cosine - 1))
    vote = weight / np.sqrt(weight.sum(axis=1, keepdims=True) * weight.sum(axis=0))
    most = min(PARTNERS * (len(x) + len(y)), vote.size)
    first, second = np.unravel_index(np.argpartition(-vote, most - 1, axis=None)[:most], vote.shape)
    way = x[first] - y[second]
    near = np.exp(-(np.abs(way[:, None] - way[None]) ** 2) / (2 * WAYS_ALIKE**2)) * vote[first, second]
    total = near.sum(axis=1)
    best = int(total.argmax())
    return float(total[best]), complex(near[best] @ way / total[best])


def _convert_to_complex(places: Array) -> Array:
    out: Array = places @ np.array([1, 1j])
    return out


def rotate_graph(graph: Mapping[str, Array], turns: int) -> dict[str, Array]:
    """Return the arrays of a map turned by so many quarter turns."""
    out = dict(graph)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = rotate_crops(part, out[part], turns)
    if "edge_way" in out:
        ways = _convert_to_complex(out["edge_way"].reshape(len(out["edge_way"]), 2, 2)) * 1j**turns
        out["edge_way"] = np.stack([ways.real, ways.imag], axis=2).reshape(len(ways), 4).astype(np.float32)
    return out


def compute_edge_positions(graph: Mapping[str, Array]) -> Array:
    """Return (2E, 4) `schema.WAY_FEATURES` of a graph with `pos`, `edge_pos` and the `turn` of its storeys."""
    first, second = np.asarray(graph["edge_index"])
    rooms, doors = (rotate_to_walls(graph, name) for name in ("pos", "edge_pos"))
    return np.concatenate([rooms[second] - rooms[first], doors - rooms[first]], axis=1).astype(np.float32)


def rotate_to_walls(graph: Mapping[str, Array], name: str = "pos") -> Array:
    """Return (n, 2) m, places of a graph in the direction of the walls of its lowest storey."""
    turn = float(graph["turn"][0]) if len(graph["turn"]) else 0.0
    c, s = np.cos(turn), np.sin(turn)
    out: Array = np.asarray(graph[name], float)[:, :2] @ np.array([[c, -s], [s, c]])
    return out


Descriptor = Callable[[TopometricMap], Rows]  # -> (R, D) float64, a row for each room; or one for each quarter turn of it


def group_rows(labels: Array, count: int) -> list[Array]:
    """Return rows of each label 0..count-1, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(count + 1)))[1:-1]


def collect_room_cells(map: TopometricMap) -> list[Array]:
    """Return (n, 3) int32 occupied cells of each room; its navigable ones where it has no other."""
    walk = group_rows(map.navigable_room, len(map.rooms))
    seen = group_rows(map.room, len(map.rooms))
    return [map.grid.cells[s] if len(s) else map.navigable.cells[w] for s, w in zip(seen, walk, strict=True)]


def find_neighbours(map: TopometricMap, steps: int = 1) -> list[Array]:
    """Return ascending rooms within `steps` doors or stairs of each room, the room itself among them."""
    count = len(map.rooms)
    beside: list[set[int]] = [set() for _ in range(count)]
    for a, b in map.edges["rooms"].tolist():
        beside[a].add(b)
        beside[b].add(a)
    neighbourhoods = []
    for room in range(count):
        reached, border = {room}, {room}
        for _ in range(steps):
            border = {n for r in border for n in beside[r]} - reached
            reached |= border
        neighbourhoods.append(np.array(sorted(reached)))
    return neighbourhoods


def join_rooms(map: TopometricMap, members: Array) -> TopometricMap:
    """Return a map whose only room is the union of the given ones; the doors that lead out of them are lost."""
    occupied = np.flatnonzero(np.isin(map.room, members))
    walk = np.flatnonzero(np.isin(map.navigable_room, members))
    rows = map.rooms[members]
    share = rows["area"] / max(rows["area"].sum(), 1e-9)
    room = np.zeros(1, ROOM_DTYPE)
    for name in ("area", "volume", "cells"):
        room[name] = rows[name].sum()
    for name in ("height", "completeness"):
        room[name] = (rows[name] * share).sum()
    room["centroid"] = (rows["centroid"] * share[:, None]).sum(axis=0)
    room["lo"], room["hi"] = rows["lo"].min(axis=0), rows["hi"].max(axis=0)
    room["storey"] = rows["storey"].min()
    return replace(
        map,
        grid=map.grid.select_cells(occupied),
        room=np.zeros(len(occupied), np.int32),
        navigable=map.navigable.select_cells(walk),
        navigable_room=np.zeros(len(walk), np.int32),
        rooms=room,
        edges=np.zeros(0, EDGE_DTYPE),
        areas=map.areas[:0],
        navigable_area=None,
        narrows=np.zeros(0, EDGE_DTYPE),
        windows=map.windows[:0],
        free=None,
        provenance=None,
    )
