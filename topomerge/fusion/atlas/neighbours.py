"""The rooms of many maps as one table of vectors: which of them look most like those of a map, and which maps they speak for.

A room is one vector of length 1: its rows for the four quarter turns behind each other, or its plain row. A map that is looked
for is turned by each quarter turn, so that its rooms are looked up four times; each turn of a map is a claim of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from topomerge.embedding.turns import QUARTERS, Rows, TurnedRows
from topomerge.types import Array

VOTE_SHARPNESS = 25.0  # that a cosine is multiplied with: a room that is more alike by .1 gets twelve times the vote
ROOM_NEIGHBOURS = 64  # rooms of the atlas that each room votes for, at each turn
QUERIES_AT_ONCE, VECTORS_AT_ONCE = 256, 1 << 15  # that are compared at once, so that memory stays bounded: 32 MB


def vectors(rows: Rows, turns: int = 0) -> Array:
    """(R, D), or (R, 4 D) of turned rows, in single precision and of length 1: the rooms of a map that is turned so often."""
    flat = rows.flat(turns) if isinstance(rows, TurnedRows) else rows
    out: Array = (flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)).astype(np.float32)
    return out


def queries(rows: Rows) -> Array:
    """(T, R, ·) `vectors` of a map at each turn, T of 4 of turned rows and else 1."""
    return np.stack([vectors(rows, k) for k in range(QUARTERS if isinstance(rows, TurnedRows) else 1)])


def nearest(table: Array, asked: Array, count: int = ROOM_NEIGHBOURS, but: tuple[int, int] = (0, 0)) -> tuple[Array, Array]:
    """Rows of a table (N, D) that are most alike to each of (Q, D), and their cosines: (Q, n) each, n of count and N the less.

    Exact, by products of matrices; most alike first, of equal ones the first.

    Args:
        but: first and last + 1 of rows that come after all others: those of the map that is asked for.
    """
    parts = [_nearest(table, asked[k : k + QUERIES_AT_ONCE], count, but) for k in range(0, len(asked), QUERIES_AT_ONCE)]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _nearest(table: Array, asked: Array, count: int, but: tuple[int, int]) -> tuple[Array, Array]:
    rooms: Array = np.zeros((len(asked), 0), np.int64)
    cosine: Array = np.zeros((len(asked), 0), np.float32)
    for first in range(0, len(table), VECTORS_AT_ONCE):
        block = asked @ table[first : first + VECTORS_AT_ONCE].T
        block[:, max(but[0] - first, 0) : max(but[1] - first, 0)] = -2.0
        best = _highest(block, count)
        rooms = np.concatenate([rooms, best + first], axis=1)
        cosine = np.concatenate([cosine, np.take_along_axis(block, best, axis=1)], axis=1)
        best = _highest(cosine, count)
        rooms, cosine = (np.take_along_axis(values, best, axis=1) for values in (rooms, cosine))
    return rooms, cosine


def _highest(values: Array, count: int) -> Array:
    """Places of the highest values of each row, highest first."""
    if count < values.shape[1]:
        best = np.sort(np.argpartition(-values, count - 1, axis=1)[:, :count], axis=1)
    else:
        best = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    order = np.argsort(-np.take_along_axis(values, best, axis=1), axis=1, kind="stable")
    return np.take_along_axis(best, order, axis=1)


def votes(rooms: Array, cosine: Array, turns: int, owner: Array, maps: int) -> Array:
    """(maps,) of the votes of a map's rooms; each has one, shared among its neighbours by how alike they are.

    Args:
        rooms: (turns * R, n) neighbours of `queries`, one turn after the other.
        cosine: of them.
        owner: (N,) map of each row of the table; -1: of none that counts.
        maps: their number. A map gets the votes at the turn that gives it the most.
    """
    whose = owner[rooms].reshape(turns, -1, rooms.shape[1])
    weight = np.where(whose >= 0, np.exp(VOTE_SHARPNESS * (cosine.reshape(whose.shape).astype(float) - 1)), 0.0)
    share = weight / np.maximum(weight.sum(axis=(0, 2), keepdims=True), 1e-300)
    out: Array = np.max([np.bincount(w[w >= 0], s[w >= 0], maps) for w, s in zip(whose, share, strict=True)], axis=0)
    return out


def owners(counts: Sequence[int]) -> Array:
    """(N,) map of each room, of maps with so many rooms."""
    return np.repeat(np.arange(len(counts)), counts)


def most_alike(rows: Sequence[Rows], number: int) -> Iterator[tuple[int, ...]]:
    """For each map those of the others that its rooms look most like, at most `number`, most alike first; exact.

    None for a map without rooms, and none that has no room among the neighbours.
    """
    table = np.concatenate([vectors(of) for of in rows if len(of)] or [np.zeros((0, 1), np.float32)])
    counts = [len(of) for of in rows]
    owner, last = owners(counts), np.cumsum(counts).tolist()
    for k, of in enumerate(rows):
        if not counts[k]:
            yield ()
            continue
        asked = queries(of)
        rooms, cosine = nearest(table, asked.reshape(-1, asked.shape[2]), but=(last[k] - counts[k], last[k]))
        score = votes(rooms, cosine, len(asked), np.where(owner == k, -1, owner), len(rows))
        best = np.argsort(-score, kind="stable")[:number].tolist()
        yield tuple(m for m in best if score[m] > 0)
