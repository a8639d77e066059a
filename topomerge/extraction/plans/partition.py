"""Which regions of a storey are one room: merged, best first, until only doors part them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np

from topomerge.extraction.plans.passages import Passage, features
from topomerge.types import Array

Judge = Callable[[Array], Array]  # (n, 17) features -> (n,) probability that a door parts the two
Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Partition:
    """Regions gathered into areas and rooms.

    Args:
        room: (n,) int64 room of each region, named by one of its regions.
        area: (n,) int64 area of each region, likewise; an area belongs to one room.
        probability: that a door parts two neighbouring rooms.
    """

    room: Array
    area: Array
    probability: dict[Pair, float]


def merge_regions(
    region: Array,
    clearance: Array,
    passages: dict[Pair, Passage],
    edge: float,
    judge: Judge,
    door: float,
    narrow: float,
    least: float,
) -> Partition:
    """Merge neighbouring regions, the least likely door first; each merger changes what the next ones are judged by.

    Args:
        region: (nx, ny) region of each column, -1 none.
        clearance: (nx, ny) m.
        passages: between the regions.
        edge: of a column, m.
        judge: what is a door.
        door: probability from which on two rooms stay apart.
        narrow: the lower one from which on two areas of a room do.
        least: m2, smaller rooms are given to the neighbour from which the least likely door parts them.
    """
    links = _Links(region, clearance, passages, edge, judge)
    area: Array | None = None
    while links.scores:
        pair = links.weakest()
        if area is None and links.scores[pair] > narrow:
            area = links.into.copy()
        if links.scores[pair] > door:
            break
        links.merge(pair)
    area = links.into.copy() if area is None else area
    small = {int(r) for r in np.unique(links.into) if links.area[r] < least}
    while small:
        near = [p for p in links.scores if p[0] in small or p[1] in small]
        if not near:
            break
        pair = min(near, key=lambda p: (links.scores[p], p))
        links.merge(pair)
        small = {r for r in small - {pair[1]} if links.area[r] < least}
    return Partition(links.into, area, dict(links.scores))


class _Links:
    """Rooms in the making and how likely doors part them."""

    def __init__(self, region: Array, clearance: Array, passages: dict[Pair, Passage], edge: float, judge: Judge) -> None:
        count = int(region.max(initial=-1)) + 1
        known = region >= 0
        self.into = np.arange(count)
        self.area = np.bincount(region[known], minlength=count) * edge**2
        self.peak = np.zeros(count)
        np.maximum.at(self.peak, region[known], clearance[known])
        self.passages = dict(passages)
        self.judge = judge
        self.scores: dict[Pair, float] = {}
        self.queue: list[tuple[float, Pair]] = []  # holds outdated scores, too
        self.beside: list[set[int]] = [set() for _ in range(count)]
        for a, b in passages:
            self.beside[a].add(b)
            self.beside[b].add(a)
        self._score(sorted(passages))

    def _score(self, pairs: list[Pair]) -> None:
        if pairs:
            x = [
                features(self.passages[p], (self.peak[p[0]], self.peak[p[1]]), (self.area[p[0]], self.area[p[1]])) for p in pairs
            ]
            for pair, score in zip(pairs, self.judge(np.array(x)).tolist(), strict=True):
                self.scores[pair] = score
                heappush(self.queue, (score, pair))

    def weakest(self) -> Pair:
        """The pair that the least likely door parts; there must be one."""
        while self.scores.get(self.queue[0][1]) != self.queue[0][0]:
            heappop(self.queue)
        return self.queue[0][1]

    def merge(self, pair: Pair) -> None:
        """The second becomes part of the first."""
        keep, gone = pair
        del self.passages[pair], self.scores[pair]
        self.into[self.into == gone] = keep
        self.peak[keep] = max(self.peak[keep], self.peak[gone])
        self.area[keep] += self.area[gone]
        self.beside[keep].discard(gone)
        for other in self.beside[gone] - {keep}:
            old, new = _pair(gone, other), _pair(keep, other)
            self.beside[other].discard(gone)
            self.beside[other].add(keep)
            self.beside[keep].add(other)
            passage = self.passages.pop(old)
            del self.scores[old]
            if new not in self.passages or passage.width > self.passages[new].width:
                self.passages[new] = passage
        self._score(sorted(_pair(keep, other) for other in self.beside[keep]))


def _pair(a: int, b: int) -> Pair:
    return (a, b) if a < b else (b, a)
