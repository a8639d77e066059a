"""Maps that may come into one frame, set by set: what is far apart in an atlas is worked on by itself."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Of = TypeVar("Of")


def sets_of_maps(
    count: int, joining: Collection[tuple[int, int]], of_pairs: Mapping[tuple[int, int], Of]
) -> Iterator[tuple[tuple[int, ...], dict[tuple[int, int], Of]]]:
    """Sets of maps that pairs join, directly or by others, each with what there is of the pairs within it.

    Args:
        count: of the maps.
        joining: pairs of maps, by their numbers.
        of_pairs: pair -> anything.
    """
    pairs = np.array(sorted(joining), np.int64).reshape(-1, 2)
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    owner = connected_components(links, directed=False)[1].tolist()
    members: dict[int, list[int]] = {}
    within: dict[int, dict[tuple[int, int], Of]] = {}
    for k in range(count):
        members.setdefault(owner[k], []).append(k)
    for (i, j), of in of_pairs.items():
        if owner[i] == owner[j]:
            within.setdefault(owner[i], {})[i, j] = of
    for n, maps in members.items():
        yield tuple(maps), within.get(n, {})
