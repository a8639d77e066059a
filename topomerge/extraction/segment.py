"""Segments of storeys: floor within which the plan shows no passage to another room (beyond the thesis: docs/adr/0024).

There are too many segments rather than too few. Which of them are one room is decided once all evidence is there (`partition`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush

import numpy as np

from topomerge.extraction.completeness import measure_seen_outline
from topomerge.extraction.plans.part_rooms import PartRooms, compute_door_log_odds, find_boundary_columns, rasterise_part_rooms
from topomerge.extraction.plans.passages import (
    Pair,
    Passage,
    compute_clearance,
    compute_door_features,
    find_passages,
    joined,
    predict_door,
    segment_regions,
    sort_pair,
)
from topomerge.extraction.plans.plan import build_storey_plan, locate_columns, remove_upper_sides
from topomerge.extraction.plans.plan_network import (
    LOOKS,
    add_drawn_doors,
    compute_column_probabilities,
    load_weights,
    remove_furniture,
)
from topomerge.extraction.plans.storey_plan import ClassifiedStorey, Merge, StoreyPlan
from topomerge.extraction.scan import Scan
from topomerge.extraction.slices import is_raised
from topomerge.extraction.storeys import NOWHERE, find_storeys, measure_floor_to_ceiling
from topomerge.kernels import run_side_by_side
from topomerge.numpy_nn import sigmoid
from topomerge.types import Array, VoxelGrid, are_within

Scorer = Callable[[Array, Sequence[Passage]], Array]  # (n, 17) features and passages -> (n,) probability of a door
PLAN_CELL = 0.1  # m: finer grids are looked at with about this
THINNEST_SLAB = 0.15  # m: a thinner one parts no storeys
SAME_LEVEL = 1.0  # m between a place and the floor of the storey on which it is
SUREST_DOOR = 1e-6  # probabilities are that far from 0 and 1 at least where other maps are weighed
# Rules for small rooms that doors or walls part gained nothing beside one least size (docs/adr/0026).
LEAST_ROOM, LEAST_FLAT_ROOM = 0.3, 0.8  # m2 of floor; smaller ones are parts of a neighbour. Flat: in slices legs look like walls


@dataclass(frozen=True, eq=False)
class RasterisedStoreys:
    """The storeys seen from above.

    Args:
        grid: occupied cells, of the length of the plans' columns.
        storeys: (S,) STOREY_DTYPE.
        storey: (m,) storey of each navigable cell.
        factor: how many times longer the columns are than the navigable cells.
        numbers: storey of each plan.
        plans: without furniture.
        probabilities: (nx, ny, 5) of each plan, what probably stands in its columns.
    """

    grid: VoxelGrid
    storeys: Array
    storey: Array
    factor: int
    numbers: tuple[int, ...]
    plans: tuple[StoreyPlan, ...]
    probabilities: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class SegmentedStorey:
    """A storey cut into segments.

    Args:
        number: of the storey.
        plan: without furniture.
        classes: what probably stands in its columns.
        clearance: (nx, ny) m to the next wall.
        segment: (nx, ny) segment of each column, -1 none.
        passages: the widest of each two neighbouring segments.
    """

    number: int
    plan: StoreyPlan
    classes: ClassifiedStorey
    clearance: Array
    segment: Array
    passages: dict[Pair, Passage]

    @property
    def count(self) -> int:
        """Number of segments."""
        return int(self.segment.max(initial=-1)) + 1

    @property
    def areas(self) -> Array:
        """(n,) m2 of each segment."""
        return np.bincount(self.segment[self.segment >= 0], minlength=self.count) * self.plan.edge**2

    @property
    def completeness(self) -> Array:
        """(n,) share of each segment's outline at which a wall was seen."""
        return measure_seen_outline(self.segment, self.plan.inside, self.plan.wall, self.plan.edge)

    def locate_centre(self, passage: Passage) -> Array:
        """Return (3,) m, where a passage lies."""
        at = self.plan.origin + (np.array(passage.place) + 0.5) * self.plan.edge
        return np.append(at, self.plan.floor[passage.place])


def rasterise_storeys(scan: Scan, navigable: VoxelGrid, standing_height: float, looks: int = LOOKS) -> RasterisedStoreys:
    """Detect the storeys and draw each of them once, with what probably stands in its columns.

    Args:
        navigable: the navigable volume.
        standing_height: m, whatever is lower than this above the floor is no ceiling.
        looks: of the network at each plan.
    """
    grid = scan.grid
    storeys, storey = find_storeys(navigable, measure_floor_to_ceiling(grid, navigable, standing_height))
    factor = max(round(PLAN_CELL / grid.edge), 1)
    coarse, floor, of_coarse = _coarsen(grid, navigable, storey, factor)
    numbers = [k for k in range(len(storeys)) if (of_coarse == k).any() and not _is_upper_side(storeys[k], storeys[:k])]
    # Robots' grids and drawings have weights of their own: those of scans err more on real ones (docs/adr/0005).
    raised = not scan.flat and is_raised(grid)  # with a floor that was assumed, a scan of the upper half of rooms is none
    plans, probabilities = [], []
    # The looks of the network share the threads by themselves.
    for plan in run_side_by_side(lambda k: build_storey_plan(coarse, floor, of_coarse, k, scan.crossed), numbers):
        probability = compute_column_probabilities(plan, load_weights(raised), looks)
        if scan.drawn_doors is not None:
            probability = add_drawn_doors(plan, probability, scan.drawn_doors)
        plans.append(remove_furniture(plan, probability))
        probabilities.append(probability)
    return RasterisedStoreys(coarse, storeys, storey, factor, tuple(numbers), tuple(plans), tuple(probabilities))


def segment_storey(
    rasters: RasterisedStoreys, i: int, narrow: float, parts: Sequence[PartRooms] = (), places: Array = NOWHERE
) -> SegmentedStorey:
    """Cut the `i`-th plan at all narrowings, and merge what surely no door parts.

    Args:
        narrow: probability of a door, by the plan, up to which regions are merged.
        parts: rooms of the maps that the cells were joined of: segments end where these do.
        places: (n, 3) m, where the sensor was.
    """
    plan, probability, k = rasters.plans[i], rasters.probabilities[i], rasters.numbers[i]
    clearance, placed = compute_clearance(plan), rasterise_part_rooms(plan, parts)
    region = segment_regions(plan, probability, find_boundary_columns(placed) if placed else None)
    # The lowest storey has none below it whose ceiling could look like its floor.
    if k > 0:
        region = remove_upper_sides(rasters.grid, plan, region, places)
    passages = find_passages(plan, clearance, region, probability)
    if placed:
        odds = compute_door_log_odds(region, plan.edge, passages, placed)
        passages = {pair: replace(passage, log_odds=odds[pair]) for pair, passage in passages.items()}
    growing = GrowingRooms(region, clearance, passages, plan.edge, score_by_plan)
    # By the plan alone: walls are unrolled along the segments that this leaves (docs/adr/0024).
    while growing.door_probability and growing.door_probability[pair := growing.weakest()] <= narrow:
        growing.merge(pair)
    names = np.unique(growing.of_region[region[region >= 0]])
    number = np.full(len(growing.of_region) + 1, -1)
    number[names] = np.arange(len(names))
    segment = number[np.append(growing.of_region, -1)[region]]
    passages = {(int(number[a]), int(number[b])): passage for (a, b), passage in growing.passages.items()}
    low, base = locate_columns(plan, rasters.grid)
    corner = rasters.grid.origin + np.append(low, np.median(base)) * plan.edge
    classes = ClassifiedStorey(probability, corner[:2], plan.edge, float(corner[2]))
    return SegmentedStorey(k, plan, classes, clearance, segment, passages)


def find_segments(storeys: Sequence[SegmentedStorey], places: Array) -> Array:
    """Find the (n,) int64 segment on whose floor each place (n, 3) m lies, numbered on from storey to storey, -1 none."""
    out, nearest = np.full(len(places), -1, np.int64), np.full(len(places), np.inf)
    first = 0
    for storey in storeys:
        plan = storey.plan
        at = np.floor((places[:, :2] - plan.origin) / plan.edge).astype(np.int64)
        inside = np.flatnonzero(are_within(at, 0, plan.wall.shape))
        column = tuple(at[inside].T)
        above = places[inside, 2] - plan.floor[column]
        own = (np.abs(above) < SAME_LEVEL) & (np.abs(above) < nearest[inside])
        here = storey.segment[column]
        nearest[inside[own]] = np.abs(above[own])
        out[inside[own]] = np.where(here[own] >= 0, here[own] + first, -1)
        first += storey.count
    return out


def score_by_plan(x: Array, passages: Sequence[Passage]) -> Array:
    """Return (n,) probability of a door in each passage by the plan, and by what the maps say that were joined.

    Args:
        x: (n, 17) `DOOR_FEATURES` of the sides as they have grown.
    """
    plan, rule_odds = predict_door(x), np.array([passage.log_odds for passage in passages])
    return np.where(rule_odds == 0, plan, sigmoid(log_odds(plan) + rule_odds))


def log_odds(probability: Array) -> Array:
    """Return (n,) of probabilities, which are taken for no surer than `SUREST_DOOR`."""
    sure = np.clip(probability, SUREST_DOOR, 1 - SUREST_DOOR)
    return np.log(sure / (1 - sure))


def _coarsen(grid: VoxelGrid, navigable: VoxelGrid, storey: Array, factor: int) -> tuple[VoxelGrid, VoxelGrid, Array]:
    """Return both grids with cells `factor` times as long, and the storey of each navigable one: the lowest of those in it."""
    if factor == 1:
        return grid, navigable, storey
    coarse = navigable.coarsen(factor)
    coarse_storey = np.full(len(coarse), np.iinfo(np.int32).max, np.int32)
    np.minimum.at(coarse_storey, coarse.find_rows(navigable.cells // factor), storey)
    return grid.coarsen(factor), coarse, coarse_storey


def _is_upper_side(top: Array, below: Array) -> bool:
    """Return whether a storey with nothing above it is the ceiling of one below. A floor lies a slab above that."""
    return bool(np.isnan(top["ceiling"]) and (np.abs(below["ceiling"] - top["floor"]) < THINNEST_SLAB).any())


class GrowingRooms:
    """Rooms that grow by merging and how likely doors part them; a room is named by one of its regions."""

    def __init__(self, region: Array, clearance: Array, passages: dict[Pair, Passage], edge: float, score: Scorer) -> None:
        count = int(region.max(initial=-1)) + 1
        in_region = region >= 0
        self.of_region = np.arange(count)
        self.area = np.bincount(region[in_region], minlength=count) * edge**2
        self.peak = np.zeros(count)
        np.maximum.at(self.peak, region[in_region], clearance[in_region])
        self.passages = dict(passages)
        self.score = score
        self.door_probability: dict[Pair, float] = {}
        self.queue: list[tuple[float, Pair]] = []  # holds outdated probabilities, too
        self.neighbours: list[set[int]] = [set() for _ in range(count)]
        for a, b in passages:
            self.neighbours[a].add(b)
            self.neighbours[b].add(a)
        self._score(sorted(passages))

    def _score(self, pairs: list[Pair]) -> None:
        if pairs:
            x = np.array([compute_door_features(self.passages[p], self.peak[list(p)], self.area[list(p)]) for p in pairs])
            for pair, probability in zip(pairs, self.score(x, [self.passages[p] for p in pairs]).tolist(), strict=True):
                self.door_probability[pair] = probability
                heappush(self.queue, (probability, pair))

    def weakest(self) -> Pair:
        """Return the pair that the least likely door parts; there must be one."""
        while self.door_probability.get(self.queue[0][1]) != self.queue[0][0]:
            heappop(self.queue)
        return self.queue[0][1]

    def merge(self, pair: Pair) -> None:
        """Make the second part of the first."""
        room, absorbed = pair
        del self.passages[pair], self.door_probability[pair]
        self.of_region[self.of_region == absorbed] = room
        self.peak[room] = max(self.peak[room], self.peak[absorbed])
        self.area[room] += self.area[absorbed]
        self.neighbours[room].discard(absorbed)
        for other in self.neighbours[absorbed] - {room}:
            old, new = sort_pair(absorbed, other), sort_pair(room, other)
            self.neighbours[other].discard(absorbed)
            self.neighbours[other].add(room)
            self.neighbours[room].add(other)
            passage = self.passages.pop(old)
            del self.door_probability[old]
            known = self.passages.get(new)
            self.passages[new] = passage if known is None else joined(passage, known)
        # The merger changed width and area of one side, by which its other doors are judged (docs/adr/0004).
        self._score(sorted(sort_pair(room, other) for other in self.neighbours[room]))


@dataclass(frozen=True, eq=False)
class PartitionedStorey:
    """A storey cut into rooms and areas, both numbered from 0 in the storey; an area is a segment.

    Args:
        number: of the storey.
        plan: the storey seen from above, without furniture.
        classes: what probably stands in its columns.
        room, area: (nx, ny) of each column, -1 none.
        room_of_area: (A,).
        room_of_segment: (n,) -1 none.
        door_probability: that a door parts two neighbouring rooms.
        merges: of areas into rooms, in their order: one area of each side, and the probability of a door between the two sides.
    """

    number: int
    plan: StoreyPlan
    classes: ClassifiedStorey
    room: Array
    area: Array
    room_of_area: Array
    room_of_segment: Array
    door_probability: dict[Pair, float]
    merges: tuple[Merge, ...]


def partition_rooms(storey: SegmentedStorey, score: Scorer, door: float, least: float = LEAST_ROOM) -> PartitionedStorey:
    """Merge the segments of a storey, the least likely door first, until only likely doors part them: this cuts the rooms, once.

    Args:
        score: tells doors from narrowings of a room, by all evidence.
        door: probability from which on two rooms stay apart.
        least: m2, what is smaller is given to a neighbour; without one it is of no room.
    """
    segment, edge = storey.segment, storey.plan.edge
    rooms = GrowingRooms(segment, storey.clearance, storey.passages, edge, score)
    merges: list[Merge] = []
    while rooms.door_probability and rooms.door_probability[pair := rooms.weakest()] <= door:
        # Kept, as a lower cut of the same tree gives the zones (docs/adr/0047).
        merges.append((*pair, rooms.door_probability[pair]))
        rooms.merge(pair)
    # Part of the cut: as a step after it, rooms of flats were lost (recall .862 to .807, docs/adr/0024).
    while (small := find_too_small(rooms, least)) is not None:
        merges.append((*small, rooms.door_probability[small]))
        rooms.merge(small)
    large = np.unique(rooms.of_region)
    large = large[rooms.area[large] >= least]
    number = np.full(len(rooms.of_region) + 1, -1)
    number[large] = np.arange(len(large))
    room_of_segment = number[rooms.of_region]
    kept = np.flatnonzero(room_of_segment >= 0)
    area_of_segment = np.full(len(room_of_segment) + 1, -1)
    area_of_segment[kept] = np.arange(len(kept))
    doors = {}
    for (a, b), probability in rooms.door_probability.items():
        if number[a] >= 0 and number[b] >= 0:
            doors[sort_pair(int(number[a]), int(number[b]))] = probability
    return PartitionedStorey(
        storey.number,
        storey.plan,
        storey.classes,
        np.append(room_of_segment, -1)[segment],
        area_of_segment[segment],
        room_of_segment[kept],
        room_of_segment,
        doors,
        tuple((int(area_of_segment[a]), int(area_of_segment[b]), p) for a, b, p in merges if area_of_segment[a] >= 0),
    )


def find_too_small(rooms: GrowingRooms, least: float) -> Pair | None:
    """Find the least surely parted two rooms of which one is smaller than `least` m2; None: none is."""
    found = [(p, pair) for pair, p in rooms.door_probability.items() if min(rooms.area[list(pair)]) < least]
    return min(found)[1] if found else None


def find_rooms_of_segments(storeys: Sequence[PartitionedStorey], numbers: Array) -> Array:
    """Return (n,) room of the map of each segment of all storeys, -1 none.

    Args:
        numbers: (R,) of the rooms that have a floor, as they are numbered on from storey to storey
        (`topology.select_rooms_with_floor`).
    """
    of, first = [], 0
    for storey in storeys:
        of.append(np.where(storey.room_of_segment >= 0, storey.room_of_segment + first, -1))
        first += int(storey.room.max(initial=-1)) + 1
    number = np.full(first + 1, -1)
    number[numbers] = np.arange(len(numbers))
    out: Array = number[np.concatenate([np.zeros(0, np.int64), *of])]
    return out
