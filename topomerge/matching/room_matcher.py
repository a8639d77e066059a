"""Which rooms of two maps are one: a small network that looks at both maps at once, in NumPy.

Each room starts as what it looks like (its rows, `embedding.turns`), then looks at the rooms of its own map and at those of the
other one (attention within and across; Lindenberger et al. 2023, LightGlue). Both maps are turned into the direction of their
walls, so that the way from one room to another is told without any common frame. Rooms that are one are all moved by one way
from one map to the other: how much of the matching so far agrees with the way of a pair is shown to each layer. Trained by
``train.py task=room_matcher`` with the rows of the embedder that ships, and for no others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from topomerge import numpy_nn as nn
from topomerge.embedding.turns import FACTS, QUARTERS, Rows, TurnedRows, quarters_between
from topomerge.errors import InputError
from topomerge.io.weight_files import weights_file
from topomerge.kernels.votes import summed_votes
from topomerge.types import Array

MATCHER_FILE = "room_matcher.npz"
ATTENTION_HEADS = 4
RINGS = np.array([0.0, 2.0, 4.0, 7.0, 11.0, 16.0, 24.0])  # m: how far another room is
RING_WIDTH = (0.5, 0.3)  # m, and share of the ring's distance
WAY_SOFT = 3.0  # m, at which half of the way to a room is told by its direction
CLIMB_UNIT = 3.0  # m
WAY_FACTS = 2 + len(RINGS) + 1
AGREEMENT = (1.5, 5.0)  # m by which ways that agree differ at most
VOTE_UNIT = 3.0  # votes are logarithms of 1 + so many times their sum
LEVEL_GAP = 0.8  # m: storeys of ways that agree differ by less
VOTERS = 3  # pairs of rooms that vote, times the number of rooms of both maps,
MOST_VOTERS = 2000  # and at most
MOST_VOTED = 20_000  # pairs of rooms that are voted for, the likeliest ones
FIRST_SHARPNESS = 25.0  # that cosines are multiplied with for the first votes
LIKENESS_SCALE = 10.0  # that likeness is multiplied with, times what is learned
UNUSUAL = 4.0  # standard deviations by which a fact differs from what is usual, at most
ROWS_AT_ONCE = 64  # rooms


@dataclass(frozen=True, eq=False)
class RoomsSeen:
    """What the network sees of the rooms of a map.

    Args:
        rows: (R, 4 D) of length 1, of the map as it is turned (`TurnedRows.flat`).
        places: (R, 2) m, middles of the rooms in the direction of the walls.
        heights: (R,) m.
        facts: (R, FACTS).
    """

    rows: Array
    places: Array
    heights: Array
    facts: Array


@dataclass(frozen=True, eq=False)
class RoomOdds:
    """Which room of the other map is each room?

    Args:
        rows: (R_a, R_b + 1) probability of each partner of each room of a, in the last place none.
        columns: (R_b, R_a + 1) likewise of the rooms of b.
        quarters: quarter turns by which b stands in a.
    """

    rows: Array
    columns: Array
    quarters: int = 0

    @property
    def certainty(self) -> Array:
        """(R_a, R_b) geometric mean of the probabilities that j is i's partner and i is j's."""
        out: Array = np.sqrt(self.rows[:, :-1] * self.columns[:, :-1].T)
        return out

    @property
    def sureness(self) -> float:
        """Sum of the squares of all certainties: one sure match tells more than several doubtful ones."""
        return float((self.certainty**2).sum())


def room_odds(a: Rows, b: Rows, likeliest: bool = False) -> tuple[RoomOdds, ...]:
    """Partners of the rooms of two maps at each of four quarter turns of the second one; none where the rows are not those of the
    embedder that the network was trained with, or a map has no rooms. Which map is given first changes nothing.

    Args:
        likeliest: only at the turn that rows vote for (`turns.quarters_between`).

    Raises:
        InputError: the network is damaged.
    """
    weights = matcher_weights()
    for rows in (a, b):
        if not isinstance(rows, TurnedRows) or not len(rows) or rows.facts is None or rows.embedder != embedder_of(weights):
            return ()
    assert isinstance(a, TurnedRows) and isinstance(b, TurnedRows)
    if _order(b) < _order(a):  # rows are read as they are turned: the second map as the first one stands
        swapped = [RoomOdds(o.columns, o.rows, -o.quarters % QUARTERS) for o in room_odds(b, a, likeliest)]
        return tuple(sorted(swapped, key=lambda turned: turned.quarters))
    if likeliest:
        k = quarters_between(a, b)
        return (replace(odds_of(rooms_seen(a), rooms_seen(b, k), weights), quarters=k),)
    return every_turn(rooms_seen(a), [rooms_seen(b, k) for k in range(QUARTERS)], weights)


def _order(rows: TurnedRows) -> tuple[int, float]:
    """That of two maps, whichever is given first."""
    assert rows.facts is not None
    return len(rows), float(rows.facts.sum())


def certainty_of_turns(odds: Sequence[RoomOdds]) -> Array:
    """(R_a, R_b) certainty of pairs over all turns, each as likely as it is sure of itself."""
    sure = np.array([turned.sureness for turned in odds])
    share = np.exp(sure - sure.max())
    out: Array = np.tensordot(share / share.sum(), [turned.certainty for turned in odds], axes=1)
    return out


def rooms_seen(rows: TurnedRows, quarters: int = 0) -> RoomsSeen:
    """A map that is turned by so many quarter turns.

    Args:
        rows: with facts.
    """
    assert rows.facts is not None
    turned = (rows.places @ np.array([1, 1j])) * 1j**quarters
    places = np.stack([turned.real, turned.imag], axis=1)
    return RoomsSeen(rows.flat(quarters), places - places.mean(axis=0), rows.facts[:, -1], rows.facts)


def every_turn(a: RoomsSeen, turned: Sequence[RoomsSeen], w: Mapping[str, Array]) -> tuple[RoomOdds, ...]:
    """The network on a map and another one in each of its quarter turns."""
    return tuple(replace(odds_of(a, b, w), quarters=k) for k, b in enumerate(turned))


def odds_of(a: RoomsSeen, b: RoomsSeen, w: Mapping[str, Array]) -> RoomOdds:
    """The network on two maps as they are turned. `models.room_matcher.RoomMatcher` is the same in torch."""
    cosine = a.rows @ b.rows.T
    facts = [np.clip((m.facts - w["usual"]) / w["spread"], -UNUSUAL, UNUSUAL) for m in (a, b)]
    states = [
        nn.linear(m.rows, w["rows.w"], w["rows.b"]) + nn.linear(f, w["facts.w"], w["facts.b"])
        for m, f in zip((a, b), facts, strict=True)
    ]
    likely = np.sqrt(nn.softmax(FIRST_SHARPNESS * cosine) * nn.softmax(FIRST_SHARPNESS * cosine.T).T)
    rows, columns = _partners(0, states, cosine, agreement(likely, a, b), w)
    layer = 1
    while f"{layer}.query.w" in w:
        agreed = agreement(np.sqrt(rows[:, :-1] * columns[:, :-1].T), a, b)
        states = [_within(f"{layer}", state, m, w) for state, m in zip(states, (a, b), strict=True)]
        states = _across(f"{layer}", states, agreed, w)
        states = [state + _each(f"{layer}", state, w) for state in states]
        rows, columns = _partners(layer, states, cosine, agreed, w)
        layer += 1
    return RoomOdds(rows, columns)


def ways(places: Array, heights: Array, start: int = 0, stop: int | None = None) -> Array:
    """(n, R, WAY_FACTS) from the rooms `start` to `stop` of a map to each of its rooms: direction, distance in rings, climb."""
    off = places[None] - places[start:stop, None]
    far = np.linalg.norm(off, axis=2)[..., None]
    ring = np.exp(-(((far - RINGS) / (RING_WIDTH[0] + RING_WIDTH[1] * RINGS)) ** 2))
    climb = np.clip((heights[None] - heights[start:stop, None]) / CLIMB_UNIT, -2, 2)[..., None]
    return np.concatenate([off / (far + WAY_SOFT), ring, climb], axis=2)


def agreement(likely: Array, a: RoomsSeen, b: RoomsSeen) -> Array:
    """(R_a, R_b, 2) how much of a matching agrees with each pair of rooms on the way from one map to the other.

    Args:
        likely: (R_a, R_b) how likely each pair is.
    """
    n, m = likely.shape
    out = np.zeros((n * m, len(AGREEMENT)))
    way = (a.places[:, None] - b.places[None]).reshape(-1, 2).astype(np.float64)
    rise = (a.heights[:, None] - b.heights[None]).ravel().astype(np.float64)
    order = np.argsort(-likely, axis=None, kind="stable")
    voters, voted = order[: min(VOTERS * (n + m), MOST_VOTERS)], np.sort(order[:MOST_VOTED])
    room = np.stack(np.divmod(np.arange(n * m), m), axis=1)
    chance = likely.ravel().astype(np.float64)
    out[voted] = np.log1p(VOTE_UNIT * summed_votes(way, rise, room, chance, voted, voters, np.array(AGREEMENT), LEVEL_GAP))
    return out.reshape(n, m, len(AGREEMENT))


def _partners(layer: int, states: list[Array], cosine: Array, votes: Array, w: Mapping[str, Array]) -> tuple[Array, Array]:
    """Probabilities (R_a, R_b + 1) and (R_b, R_a + 1) after a layer."""
    heads = [nn.linear(state, w[f"{layer}.head.w"], w[f"{layer}.head.b"]) for state in states]
    a, b = (h / np.maximum(np.linalg.norm(h, axis=1, keepdims=True), 1e-12) for h in heads)
    logits = LIKENESS_SCALE * w["sharpness"] * (a @ b.T) + LIKENESS_SCALE * w["likeness"] * (cosine - 1)
    logits = logits + nn.linear(votes, w[f"{layer}.agree.w"], w[f"{layer}.agree.b"])[..., 0]
    alone = [nn.linear(state, w[f"{layer}.alone.w"], w[f"{layer}.alone.b"]) for state in states]
    return nn.softmax(np.concatenate([logits, alone[0]], axis=1)), nn.softmax(np.concatenate([logits.T, alone[1]], axis=1))


def _within(name: str, state: Array, rooms: RoomsSeen, w: Mapping[str, Array]) -> Array:
    """Each room looks at all rooms of its own map, and at the ways to them."""
    count, width = state.shape
    size = width // ATTENTION_HEADS
    normed = nn.layer_norm(state, w[f"{name}.norm_within.w"], w[f"{name}.norm_within.b"])
    query, key, value = np.split(nn.linear(normed, w[f"{name}.within.w"], w[f"{name}.within.b"]), 3, axis=1)
    query, key = query.reshape(count, ATTENTION_HEADS, size), key.reshape(count, ATTENTION_HEADS, size)
    out = np.empty_like(state)
    for start in range(0, count, ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        way = ways(rooms.places, rooms.heights, start, start + ROWS_AT_ONCE)
        way = nn.relu(nn.linear(way, w[f"{name}.way_in.w"], w[f"{name}.way_in.b"]))
        way = nn.linear(way, w[f"{name}.way_out.w"], w[f"{name}.way_out.b"])
        score = np.einsum("ihd,jhd->ijh", query[rows], key) / np.sqrt(size) + way[..., :ATTENTION_HEADS]
        share = nn.softmax(score.transpose(0, 2, 1))
        seen = (value[None] + way[..., ATTENTION_HEADS:]).reshape(-1, count, ATTENTION_HEADS, size)
        out[rows] = np.einsum("ihj,ijhd->ihd", share, seen).reshape(-1, width)
    return state + nn.linear(out, w[f"{name}.join_within.w"], w[f"{name}.join_within.b"])


def _across(name: str, states: list[Array], votes: Array, w: Mapping[str, Array]) -> list[Array]:
    """Each room looks at the rooms of the other map, those first whose way is agreed upon."""
    width = states[0].shape[1]
    size = width // ATTENTION_HEADS
    normed = [nn.layer_norm(s, w[f"{name}.norm_across.w"], w[f"{name}.norm_across.b"]) for s in states]
    query = [nn.linear(s, w[f"{name}.query.w"], w[f"{name}.query.b"]).reshape(-1, ATTENTION_HEADS, size) for s in normed]
    value = [nn.linear(s, w[f"{name}.value.w"], w[f"{name}.value.b"]).reshape(-1, ATTENTION_HEADS, size) for s in normed]
    score = np.einsum("ihd,jhd->hij", *query) / np.sqrt(size)
    score = score + nn.linear(votes, w[f"{name}.votes.w"], w[f"{name}.votes.b"]).transpose(2, 0, 1)
    seen = (
        np.einsum("hij,jhd->ihd", nn.softmax(score), value[1]),
        np.einsum("hji,ihd->jhd", nn.softmax(score.transpose(0, 2, 1)), value[0]),
    )
    join = w[f"{name}.join_across.w"], w[f"{name}.join_across.b"]
    return [state + nn.linear(other.reshape(-1, width), *join) for state, other in zip(states, seen, strict=True)]


def _each(name: str, state: Array, w: Mapping[str, Array]) -> Array:
    normed = nn.layer_norm(state, w[f"{name}.norm_each.w"], w[f"{name}.norm_each.b"])
    hidden = nn.relu(nn.linear(normed, w[f"{name}.each_in.w"], w[f"{name}.each_in.b"]))
    return nn.linear(hidden, w[f"{name}.each_out.w"], w[f"{name}.each_out.b"])


def matcher_weights() -> dict[str, Array]:
    """The weights that ship, or those in their place (`io.weight_files`)."""
    return read_matcher(weights_file("topomerge.matching", MATCHER_FILE))


def embedder_of(weights: Mapping[str, Array]) -> str:
    """Hash of the embedder whose rows the network takes."""
    return str(weights["embedder"].astype(np.uint8).tobytes().decode())


@lru_cache(maxsize=4)
def read_matcher(path: Path) -> dict[str, Array]:
    """Weights as float64 by their names.

    Raises:
        InputError: another file, or a damaged one.
    """
    advice = "install topomerge again"
    try:
        with np.load(path, allow_pickle=False) as file:
            weights = {name: file[name].astype(np.float64) for name in file.files}
    except Exception as error:  # zip, header and data each have their own errors
        raise InputError(f"{path}: is no network that matches rooms ({error}); {advice}") from error
    one = {name: np.zeros((1, *w.shape[:1])) for name, w in weights.items() if name.endswith(".w") and w.ndim == 2}
    missing = {"rows.w", "facts.w", "usual", "spread", "sharpness", "likeness", "embedder", "0.head.w"} - set(weights)
    if missing or not one or not all(np.isfinite(w).all() for w in weights.values()):
        raise InputError(f"{path}: is no network that matches rooms (layer {min(missing, default='of no number')}); {advice}")
    seen = RoomsSeen(one["rows.w"] * 0 + 1, np.zeros((1, 2)), np.zeros(1), np.zeros((1, FACTS)))
    try:
        odds_of(seen, seen, weights)
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: is no network that matches rooms ({error}); {advice}") from error
    return weights
