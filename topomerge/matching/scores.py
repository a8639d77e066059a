"""How good a similarity of rooms, or a matching of them, is where the truth is known."""

from __future__ import annotations

import numpy as np

from topomerge.matching.assignment import assign
from topomerge.types import Array

TWIN_SIZE = 0.15  # rooms whose area, length and width differ by no more than this share are near-identical


def partner_ranks(similarity: Array, matches: Array) -> tuple[Array, Array]:
    """For each room of a that has a partner: which one it is, and the rank, from 1, of its best partner among all rooms of b.

    Ties count half of those that are as similar, so that a constant is as good as chance.

    Args:
        similarity: (R_a, R_b), larger is more alike.
        matches: (M, 2) rooms that are one true room; a room may have several partners.

    Returns:
        (n,) int64 rooms of a, ascending; (n,) float64 ranks.
    """
    rooms = np.unique(matches[:, 0]).astype(np.int64)
    ranks = np.zeros(len(rooms))
    for k, i in enumerate(rooms):
        partners = matches[matches[:, 0] == i, 1]
        best = similarity[i, partners].max()
        others = np.delete(similarity[i], partners)
        ranks[k] = 1 + (others > best).sum() + (others == best).sum() / 2
    return rooms, ranks


def has_twin(sizes: Array, matches: Array, rooms: Array) -> Array:
    """(n,) bool: is there another room in b that is nearly the same as the partner of a room of a?

    Args:
        sizes: (R_b, 3) area (m2), length and width (m) of the rooms of b: columns 0, 3 and 4 of a graph's `x`.
        matches: (M, 2).
        rooms: (n,) of a, each with a partner.
    """
    out = np.zeros(len(rooms), bool)
    logs = np.log(np.maximum(np.asarray(sizes, float), 1e-3))
    alike = (np.abs(logs[:, None] - logs[None]) <= np.log1p(TWIN_SIZE)).all(axis=2)
    for k, i in enumerate(rooms):
        partners = matches[matches[:, 0] == i, 1]
        others = np.ones(len(sizes), bool)
        others[partners] = False
        out[k] = alike[partners][:, others].any()
    return out


def certainty(rows: Array, columns: Array) -> Array:
    """(R_a, R_b) geometric mean of the probabilities that j is i's partner and i is j's.

    Args:
        rows: (R_a, R_b + 1) probabilities of the partner of each room of a; the last: none.
        columns: (R_b, R_a + 1) likewise.
    """
    out: Array = np.sqrt(rows[:, :-1] * columns[:, :-1].T)
    return out


def assign_certain(certain: Array, least: float) -> Array:
    """(M, 2) one-to-one pairs of the largest sum of certainty, each at least `least`; the other rooms stay alone."""
    return assign(1 - certain, 1 - least)


def pair_counts(pairs: Array, matches: Array) -> tuple[int, int, int, int]:
    """Numbers of pairs, of right ones, of rooms of a and b that have a partner, and of those that got a right one.

    Precision is the second over the first, recall the fourth over the third.
    """
    true = {(int(i), int(j)) for i, j in matches}
    right = [(int(i), int(j)) for i, j in pairs if (int(i), int(j)) in true]
    wanted = sum(len(np.unique(matches[:, k])) for k in (0, 1))
    got = sum(len({pair[k] for pair in right}) for k in (0, 1))
    return len(pairs), len(right), wanted, got
