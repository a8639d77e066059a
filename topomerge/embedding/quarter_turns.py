"""Rows of rooms that depend on how a map is turned: one for each quarter turn; and how two maps may be turned to each other.

An embedder gives (R, D), or `TurnedRows`. Those of two maps are compared under each turn at which directions of their walls
coincide. None is chosen: each has a probability, and how alike two rooms are is the mean over all turns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from topomerge.embedding.graph import count_columns
from topomerge.embedding.surroundings import CROP_SHAPES, rotate_crops
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, Array, TopometricMap

# Rows for each turn: a mean over turns could not tell a corridor with rooms to its left from one with rooms to its right
# (docs/adr/0016).
QUARTERS = 4
FACTS = count_columns("x") + 2
LIKENESS, EVEN = 20.0, 0.65  # log odds that rooms are one grow so fast with the cosine of their rows, and are even at this one
PARTNERED = 0.5  # probability that a room has a partner
WAYS_ALIKE = 0.5  # m, standard deviation of how far rooms that are one are moved; chosen, as those above, by validation pairs
ONE_PLACE = 1.0  # m, standard deviation between the middles of one room in two maps, of which one may have looked into it only
PARTNERS, MOST_PAIRS = 4, 2000  # pairs of rooms that are taken, the most alike ones: times the number of rooms, and at most
CREDIBLE = 0.9  # turns fit, of which the likeliest have this probability together
SAME_YAW = np.radians(10.0)  # turns that differ by less are one


@dataclass(frozen=True, eq=False)
class TurnedRows:
    """Descriptors of rooms in a map that is turned by 0 to 3 quarter turns, counter-clockwise seen from above.

    Args:
        rows: (R, 4, D) of length 1 each.
        places: (R, 2) m, middles of the rooms; both in the direction of the map's walls (`sheets.Sheet.turn`).
        embedder: hash of the weights that made them, where there is one.
        facts: (R, FACTS) what a matcher of two maps reads besides (`compute_room_features`), where there is one.
        direction: rad, of the walls in the map's frame.
        others: the same in other directions that walls have.
    """

    rows: Array
    places: Array
    embedder: str = ""
    facts: Array | None = None
    direction: float = 0.0
    others: tuple[TurnedRows, ...] = ()

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
    """Return (R, FACTS) the numbers of rooms (`schema`) as logarithms, the logits of having no partner (R,), and heights (R,)
    m."""
    out: Array = np.column_stack([np.sign(x) * np.log1p(np.abs(x)), dustbin, heights]).astype(np.float64)
    return out


def get_rows(rows: Rows) -> Array:
    """Return (R, D), or (R, 4, D) of rows for quarter turns."""
    return rows.rows if isinstance(rows, TurnedRows) else rows


@dataclass(frozen=True, eq=False)
class Turn:
    """A way to turn b so that it stands as a does.

    Args:
        a, b: rows of both maps in those directions of walls that coincide.
        quarters: quarter turns by which b is turned beyond that, counter-clockwise.
        shift: x + i y, m, by which most rooms of b are moved then.
        probability: that it is the true one, if one is.
    """

    a: TurnedRows
    b: TurnedRows
    quarters: int
    shift: complex = 0j
    probability: float = 1.0

    @property
    def yaw(self) -> float:
        """rad, by which the frame of b is turned."""
        return self.a.direction - self.b.direction + self.quarters * np.pi / 2

    @cached_property
    def cosine(self) -> Array:
        """(R_a, R_b) how alike rooms are; all four turns of both maps have a say in it."""
        out: Array = self.a.flatten() @ self.b.flatten(self.quarters).T
        return out

    @property
    def displacements(self) -> Array:
        """(R_a, R_b) x + i y, m, from each room of b, as it is turned, to each of a."""
        out: Array = _convert_to_complex(self.a.places)[:, None] - _convert_to_complex(self.b.places)[None] * 1j**self.quarters
        return out

    @property
    def coincidence(self) -> Array:
        """(R_a, R_b) from 0 to 1: is a room of b, turned and moved, where a room of a is?"""
        out: Array = np.exp(-(np.abs(self.displacements - self.shift) ** 2) / (2 * ONE_PLACE**2))
        return out


class YawProbability(NamedTuple):
    """How likely a yaw of b in a is, rad in (-pi, pi]."""

    yaw: float
    probability: float


def estimate_turns(a: TurnedRows, b: TurnedRows) -> tuple[Turn, ...]:
    """Return all turns at which directions of walls coincide, with their probabilities, which sum to 1.

    The evidence of a turn is the mean over shifts of b of the likelihood of all rooms: each has a partner or none, and its
    partner is as alike as rooms are that are one, and lies where the shift brings it.
    """
    turns = [Turn(v, w, k) for v in (a, *a.others) for w in (b, *b.others) for k in range(QUARTERS)]
    if not len(a) or not len(b):
        return tuple(replace(turn, probability=1 / len(turns)) for turn in turns)
    scored = [_score_turn(turn) for turn in turns]
    turns = [replace(turn, shift=shift) for turn, (_, shift) in zip(turns, scored, strict=True)]
    # No turn is chosen: at the one with most votes a wrong choice lost every room of the pair (docs/adr/0016).
    shares = compute_shares(np.array([evidence for evidence, _ in scored]))
    return tuple(replace(turn, probability=float(share)) for turn, share in zip(turns, shares, strict=True))


def compute_shares(log_evidence: Array) -> Array:
    """Return probabilities (T,) of hypotheses of which one is true, from the logarithms of their evidence."""
    weight = np.exp(log_evidence - log_evidence.max())
    out: Array = weight / weight.sum()
    return out


def _score_turn(turn: Turn) -> tuple[float, complex]:
    """Return the logarithm of the evidence of a turn, and the shift that explains most of it."""
    cosine, shifts = turn.cosine, turn.displacements
    most = min(PARTNERS * sum(cosine.shape), MOST_PAIRS, cosine.size)
    rooms = np.unravel_index(np.argpartition(-cosine, most - 1, axis=None)[:most], cosine.shape)
    way, odds = shifts[rooms], np.exp(LIKENESS * (cosine[rooms] - EVEN))
    near = np.exp(-(np.abs(way[:, None] - way[None]) ** 2) / (2 * WAYS_ALIKE**2)) * odds
    log_likelihood = np.zeros(most)  # of the shift that each pair of rooms says
    for side, count in zip(rooms, cosine.shape, strict=True):
        of_room = near @ (side[:, None] == np.arange(count))
        log_likelihood += np.log1p(PARTNERED * (of_room - 1)).sum(axis=1) / 2  # each pair has two rooms, and counts once
    best = int(log_likelihood.argmax())
    evidence = log_likelihood[best] + np.log(np.exp(log_likelihood - log_likelihood[best]).sum())
    return float(evidence), complex(near[best] @ way / near[best].sum())


def compute_similarity(a: Rows, b: Rows) -> Array:
    """Return (R_a, R_b) cosines of rows of length 1; where these depend on turns, the mean over all turns of b
    (`estimate_turns`)."""
    if not isinstance(a, TurnedRows) or not isinstance(b, TurnedRows):
        plain: Array = np.asarray(a) @ np.asarray(b).T
        return plain
    return average_turns(estimate_turns(a, b), lambda turn: turn.cosine)


def average_turns(turns: Sequence[Turn], measure: Callable[[Turn], Array]) -> Array:
    """Return the mean over turns, each as likely as it is, of (R_a, R_b) values."""
    out: Array = np.sum([turn.probability * measure(turn) for turn in turns], axis=0)
    return out


def merge_yaws(found: Sequence[tuple[float, float]]) -> tuple[YawProbability, ...]:
    """Return yaws with their probabilities, likeliest first; those of nearly the same yaw are one."""
    merged: list[YawProbability] = []
    for yaw, probability in sorted(found, key=lambda one: -one[1]):
        near = [k for k, one in enumerate(merged) if is_same_yaw(one.yaw, yaw)]
        if near:
            merged[near[0]] = merged[near[0]]._replace(probability=merged[near[0]].probability + probability)
        else:
            merged.append(YawProbability(_wrap_angle(yaw), probability))
    return tuple(sorted(merged, key=lambda one: -one.probability))


def select_credible(yaws: Sequence[YawProbability]) -> tuple[YawProbability, ...]:
    """Return the fewest yaws, likeliest first, that have the probability `CREDIBLE` together; yaws as of `merge_yaws`."""
    before = np.cumsum([0.0, *(one.probability for one in yaws)])
    return tuple(one for one, sum_before in zip(yaws, before, strict=False) if sum_before < CREDIBLE)


def is_same_yaw(a: float, b: float) -> bool:
    """Return whether two yaws, rad, are nearly the same."""
    return abs(_wrap_angle(a - b)) < SAME_YAW


def _wrap_angle(angle: float) -> float:
    return float(-((-angle + np.pi) % (2 * np.pi) - np.pi))


def _convert_to_complex(places: Array) -> Array:
    out: Array = places @ np.array([1, 1j])
    return out


def rotate_graph(graph: Mapping[str, Array], turns: int) -> dict[str, Array]:
    """Return the arrays of a map turned by so many quarter turns."""
    out = dict(graph)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = rotate_crops(part, out[part], turns)
    if "edge_way" in out:
        directions = _convert_to_complex(out["edge_way"].reshape(len(out["edge_way"]), 2, 2)) * 1j**turns
        out["edge_way"] = np.stack([directions.real, directions.imag], axis=2).reshape(len(directions), 4).astype(np.float32)
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
    neighbours: list[set[int]] = [set() for _ in range(count)]
    for a, b in map.edges["rooms"].tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    neighbourhoods = []
    for room in range(count):
        reached, border = {room}, {room}
        for _ in range(steps):
            border = {n for r in border for n in neighbours[r]} - reached
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
