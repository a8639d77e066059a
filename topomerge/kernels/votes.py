"""What pairs of rooms vote for: the compiled loop behind `matching.room_matcher.agreement`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def summed_votes(way, rise, room, chance, voted, voters, widths, level_gap):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums (len(voted), len(widths)) float64 of the chances of the voters whose way is near that of each pair, by how near it is:
    the weight of a voter falls from 1 to 0 at a width (biweight). None votes for a pair that shares a room with it.

    Args:
        way: (n, 2) float64 m from one map to the other by each pair of rooms; rise: (n,) float64 m, likewise upwards.
        room: (n, 2) int64 the two rooms of each pair.
        chance: (n,) float64 how likely each pair is.
        voted, voters: int64 pairs that are voted for, and those that vote.
        widths: float64 m.
        level_gap: m, from which on two ways lead to different storeys.
    """
    out = np.zeros((len(voted), len(widths)))
    for i in range(len(voted)):
        p = voted[i]
        for q in voters:
            if room[p, 0] == room[q, 0] or room[p, 1] == room[q, 1] or not abs(rise[p] - rise[q]) < level_gap:
                continue
            x, y = way[p, 0] - way[q, 0], way[p, 1] - way[q, 1]
            apart = x * x + y * y
            for k in range(len(widths)):
                near = 1 - apart / widths[k] ** 2
                if near > 0:
                    out[i, k] += near * near * chance[q]
    return out
