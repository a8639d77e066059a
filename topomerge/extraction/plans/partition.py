"""Which regions of a storey are one room: merged, best first, until only doors part them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np

from topomerge.extraction.plans.passages import Passage, door_features
from topomerge.numpy_nn import sigmoid
from topomerge.types import Array

DoorClassifier = Callable[[Array], Array]  # (n, 17) features -> (n,) probability that a door parts the two
Pair = tuple[int, int]
SURE_PARTED = 0.8  # probability of a door from which on what is small, but not tiny, stays a room: toilets and stores
SUREST_DOOR = 1e-6  # probabilities are that far from 0 and 1 at least where other maps are weighed


@dataclass(frozen=True, eq=False)
class Partition:
    """Regions gathered into areas and rooms.

    Args:
        room: (n,) int64 room of each region, named by one of its regions.
        area: (n,) int64 area of each region, likewise; an area belongs to one room.
        door_probability: that a door parts two neighbouring rooms.
    """

    room: Array
    area: Array
    door_probability: dict[Pair, float]


def merge_regions(
    region: Array,
    clearance: Array,
    passages: dict[Pair, Passage],
    edge: float,
    classify: DoorClassifier,
    door: float,
    narrow: float,
    least_area: tuple[float, float],
) -> Partition:
    """Merge neighbouring regions, the least likely door first; each merger changes the features of the next ones.

    Args:
        region: (nx, ny) region of each column, -1 none.
        clearance: (nx, ny) m.
        passages: between the regions.
        edge: of a column, m.
        classify: tells doors from narrowings of a room.
        door: probability from which on two rooms stay apart.
        narrow: the lower one from which on two areas of a room do.
        least_area: m2, smaller rooms are given to the neighbour from which the least likely door parts them, and those above the
            second only where that door is less likely than `SURE_PARTED`.
    """
    rooms = _GrowingRooms(region, clearance, passages, edge, classify)
    area: Array | None = None
    while rooms.door_probability:
        pair = rooms.weakest()
        if area is None and rooms.door_probability[pair] > narrow:
            area = rooms.of_region.copy()
        if rooms.door_probability[pair] > door:
            break
        rooms.merge(pair)
    area = rooms.of_region.copy() if area is None else area
    small = {int(r) for r in np.unique(rooms.of_region) if rooms.area[r] < least_area[0]}
    while small:
        near = [(p, min(rooms.area[r] for r in p)) for p in rooms.door_probability if p[0] in small or p[1] in small]
        near = [(p, size) for p, size in near if size < least_area[1] or rooms.door_probability[p] < SURE_PARTED]
        if not near:
            break
        pair = min((p for p, _ in near), key=lambda p: (rooms.door_probability[p], p))
        rooms.merge(pair)
        small = {r for r in small - {pair[1]} if rooms.area[r] < least_area[0]}
    return Partition(rooms.of_region, area, dict(rooms.door_probability))


class _GrowingRooms:
    """Rooms that grow by merging and how likely doors part them; a room is named by one of its regions."""

    def __init__(
        self, region: Array, clearance: Array, passages: dict[Pair, Passage], edge: float, classify: DoorClassifier
    ) -> None:
        count = int(region.max(initial=-1)) + 1
        in_region = region >= 0
        self.of_region = np.arange(count)
        self.area = np.bincount(region[in_region], minlength=count) * edge**2
        self.peak = np.zeros(count)
        np.maximum.at(self.peak, region[in_region], clearance[in_region])
        self.passages = dict(passages)
        self.classify = classify
        self.door_probability: dict[Pair, float] = {}
        self.queue: list[tuple[float, Pair]] = []  # holds outdated probabilities, too
        self.neighbours: list[set[int]] = [set() for _ in range(count)]
        for a, b in passages:
            self.neighbours[a].add(b)
            self.neighbours[b].add(a)
        self._score(sorted(passages))

    def _score(self, pairs: list[Pair]) -> None:
        if pairs:
            x = np.array([door_features(self.passages[p], self.peak[list(p)], self.area[list(p)]) for p in pairs])
            for pair, probability in zip(pairs, self._probability(pairs, x).tolist(), strict=True):
                self.door_probability[pair] = probability
                heappush(self.queue, (probability, pair))

    def _probability(self, pairs: list[Pair], x: Array) -> Array:
        """(n,) of doors, from their features (n, 17) and what other maps say of them."""
        probability = self.classify(x)
        added = np.array([self.passages[pair].log_odds for pair in pairs])
        sure = np.clip(probability, SUREST_DOOR, 1 - SUREST_DOOR)
        return np.where(added == 0, probability, sigmoid(np.log(sure / (1 - sure)) + added))

    def weakest(self) -> Pair:
        """The pair that the least likely door parts; there must be one."""
        while self.door_probability.get(self.queue[0][1]) != self.queue[0][0]:
            heappop(self.queue)
        return self.queue[0][1]

    def merge(self, pair: Pair) -> None:
        """The second becomes part of the first."""
        room, absorbed = pair
        del self.passages[pair], self.door_probability[pair]
        self.of_region[self.of_region == absorbed] = room
        self.peak[room] = max(self.peak[room], self.peak[absorbed])
        self.area[room] += self.area[absorbed]
        self.neighbours[room].discard(absorbed)
        for other in self.neighbours[absorbed] - {room}:
            old, new = pair_of(absorbed, other), pair_of(room, other)
            self.neighbours[other].discard(absorbed)
            self.neighbours[other].add(room)
            self.neighbours[room].add(other)
            passage = self.passages.pop(old)
            del self.door_probability[old]
            if new not in self.passages or passage.width > self.passages[new].width:
                self.passages[new] = passage
        self._score(sorted(pair_of(room, other) for other in self.neighbours[room]))


def pair_of(a: int, b: int) -> Pair:
    """Two rooms, the smaller number first."""
    return (a, b) if a < b else (b, a)
