"""Rows of rooms that depend on how a map is turned: one for each quarter turn, and the turn that two maps have to each other.

An embedder gives (R, D), or `TurnedRows`. Those of two maps are compared at one quarter turn for the whole pair: that at which
most rooms that look alike are moved by the same way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from topomerge.embedding.schema import width
from topomerge.embedding.surroundings import CROP_SHAPES, quarter_turned_crops
from topomerge.types import Array

QUARTERS = 4
FACTS = width("x") + 2
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
        facts: (R, FACTS) what a matcher of two maps reads besides (`room_facts`), where there is one.
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

    def flat(self, turns: int = 0) -> Array:
        """(R, 4 D) of length 1: the rows of the map turned so often, behind each other."""
        count, _, size = self.rows.shape
        out: Array = np.roll(self.rows, -turns, axis=1).reshape(count, QUARTERS * size) / np.sqrt(QUARTERS)
        return out


Rows = Array | TurnedRows


def room_facts(x: Array, dustbin: Array, heights: Array) -> Array:
    """(R, FACTS) the numbers of rooms (`schema`) as logarithms, the logits of having no partner (R,), and heights (R,) m."""
    out: Array = np.column_stack([np.sign(x) * np.log1p(np.abs(x)), dustbin, heights]).astype(np.float64)
    return out


def numbers(rows: Rows) -> Array:
    """(R, D), or (R, 4, D) of rows for quarter turns."""
    return rows.rows if isinstance(rows, TurnedRows) else rows


def aligned(a: Rows, b: Rows) -> tuple[Array, Array]:
    """Rows (R_a, D), (R_b, D) of two maps, of which the second one is turned so that it stands as the first one does.

    All four turns of both maps have a say in how alike two rooms are. Plain rows stay as they are.
    """
    if not isinstance(a, TurnedRows) or not isinstance(b, TurnedRows):
        return np.asarray(a), np.asarray(b)
    return a.flat(), b.flat(quarters_between(a, b))


def quarters_between(a: TurnedRows, b: TurnedRows) -> int:
    """Quarter turns by which b is to be turned (`way_between`)."""
    return way_between(a, b)[0]


def way_between(a: TurnedRows, b: TurnedRows) -> tuple[int, complex]:
    """Quarter turns by which b is to be turned, and the way that its rooms are moved by then, m: those on which the most votes
    agree. Each two rooms vote for the way between them, the more the more alike they are, and the less alike others are to
    them."""
    if not len(a) or not len(b):
        return 0, 0j
    flat, x, y = a.flat(), _complex(a.places), _complex(b.places)
    voted = [_most_votes(flat @ b.flat(k).T, x, y * 1j**k) for k in range(QUARTERS)]
    best = int(np.argmax([votes for votes, _ in voted]))
    return best, voted[best][1]


def moved_alike(a: TurnedRows, b: TurnedRows, quarters: int, way: complex) -> Array:
    """(R_a, R_b) from 0 to 1: is a room of b, turned and moved (`way_between`), where a room of a is?"""
    off = _complex(a.places)[:, None] - _complex(b.places)[None] * 1j**quarters - way
    out: Array = np.exp(-(np.abs(off) ** 2) / (2 * ONE_PLACE**2))
    return out


def _most_votes(cosine: Array, x: Array, y: Array) -> tuple[float, complex]:
    weight = np.exp(SHARPNESS * (cosine - 1))
    vote = weight / np.sqrt(weight.sum(axis=1, keepdims=True) * weight.sum(axis=0))
    most = min(PARTNERS * (len(x) + len(y)), vote.size)
    first, second = np.unravel_index(np.argpartition(-vote, most - 1, axis=None)[:most], vote.shape)
    way = x[first] - y[second]
    near = np.exp(-(np.abs(way[:, None] - way[None]) ** 2) / (2 * WAYS_ALIKE**2)) * vote[first, second]
    total = near.sum(axis=1)
    best = int(total.argmax())
    return float(total[best]), complex(near[best] @ way / total[best])


def _complex(places: Array) -> Array:
    out: Array = places @ np.array([1, 1j])
    return out


def quarter_turned(graph: Mapping[str, Array], turns: int) -> dict[str, Array]:
    """The arrays of a map turned by so many quarter turns."""
    out = dict(graph)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = quarter_turned_crops(part, out[part], turns)
    if "edge_way" in out:
        ways = _complex(out["edge_way"].reshape(len(out["edge_way"]), 2, 2)) * 1j**turns
        out["edge_way"] = np.stack([ways.real, ways.imag], axis=2).reshape(len(ways), 4).astype(np.float32)
    return out


def edge_ways(graph: Mapping[str, Array]) -> Array:
    """(2E, 4) `schema.WAY_FEATURES` of a graph with `pos`, `edge_pos` and the `turn` of its storeys."""
    first, second = np.asarray(graph["edge_index"])
    rooms, doors = (along_walls(graph, name) for name in ("pos", "edge_pos"))
    return np.concatenate([rooms[second] - rooms[first], doors - rooms[first]], axis=1).astype(np.float32)


def along_walls(graph: Mapping[str, Array], name: str = "pos") -> Array:
    """(n, 2) m, places of a graph in the direction of the walls of its lowest storey."""
    turn = float(graph["turn"][0]) if len(graph["turn"]) else 0.0
    c, s = np.cos(turn), np.sin(turn)
    out: Array = np.asarray(graph[name], float)[:, :2] @ np.array([[c, -s], [s, c]])
    return out
