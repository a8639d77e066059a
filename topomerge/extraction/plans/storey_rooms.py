"""One storey: from its plan to its rooms, parted where a door probably is (beyond the thesis: docs/adr/0004)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from topomerge.extraction.ceilings import NOWHERE
from topomerge.extraction.classified_storey import ClassifiedStorey
from topomerge.extraction.plans.door_classifier import door_probability
from topomerge.extraction.plans.inner_doors import INNER_DOOR_DTYPE, inner_columns, inner_log_odds
from topomerge.extraction.plans.part_rooms import PartRooms, door_log_odds, laid_rooms, parted_columns
from topomerge.extraction.plans.partition import Pair, Partition, merge_regions
from topomerge.extraction.plans.passages import clearance_of, find_passages, regions_of
from topomerge.extraction.plans.plan import columns_of, storey_plan
from topomerge.extraction.plans.plan_network import column_probabilities, weights, without_furniture
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.plans.upper_sides import without_upper_sides
from topomerge.types import Array, VoxelGrid

ROOM_LEAST_AREA = 0.8, 0.3  # m2 of floor that was seen; the second where doors surely part it
ROOM_LEAST_HALF_WIDTH = 0.2  # m: what is nowhere wider is the edge of a facade or of a slab
FLAT_LEAST_AREA, FLAT_LEAST_HALF_WIDTH = (0.8, 0.8), 0.35  # in slices, where legs look like walls


class OtherSigns(NamedTuple):
    """What speaks for where rooms part beside a plan itself.

    Args:
        parts: rooms of the maps that these cells were joined of.
        doors: (D,) INNER_DOOR_DTYPE, doors that walls show inside of what was one room.
        flat: is it a slice, in which nothing tells walls from what else stands about?
        crossed: cells that the sensor looked through, where that is known.
        raised: is it a robot's grid or a drawing, whose walls were all raised alike?
        places: (n, 3) m, where the sensor was.
        looked_at: what `look_at` gave of each storey, where these cells were cut before.
    """

    parts: Sequence[PartRooms] = ()
    doors: Array = np.zeros(0, INNER_DOOR_DTYPE)
    flat: bool = False
    crossed: VoxelGrid | None = None
    raised: bool = False
    looked_at: Sequence[tuple[StoreyPlan, Array]] = ()
    places: Array = NOWHERE


NO_SIGNS = OtherSigns()


@dataclass(frozen=True, eq=False)
class StoreyRooms:
    """A storey cut into rooms and areas, both numbered from 0 in the storey.

    Args:
        number: of the storey.
        plan: the storey seen from above, without furniture.
        classes: what probably stands in its columns.
        room, area: (nx, ny) of each column, -1 none.
        room_of_area: (A,).
        door_probability: that a door parts two neighbouring rooms.
    """

    number: int
    plan: StoreyPlan
    classes: ClassifiedStorey
    room: Array
    area: Array
    room_of_area: Array
    door_probability: dict[Pair, float]


def look_at(
    grid: VoxelGrid, navigable: VoxelGrid, storey: Array, k: int, others: OtherSigns = NO_SIGNS
) -> tuple[StoreyPlan, Array]:
    """The plan of storey `k` without furniture, and what probably stands in each of its columns (nx, ny, 5)."""
    plan = storey_plan(grid, navigable, storey, k, others.crossed)
    probability = column_probabilities(plan, weights(others.raised))
    return without_furniture(plan, probability), probability


def cut_storey(
    grid: VoxelGrid, looked_at: tuple[StoreyPlan, Array], k: int, door: float, narrow: float, others: OtherSigns = NO_SIGNS
) -> StoreyRooms:
    """Cut storey `k` into rooms: regions between all narrowings, merged until only likely doors part them.

    Args:
        grid: occupied cells.
        looked_at: what `look_at` gave.
        door, narrow: probabilities of a door from which on a narrowing parts rooms, and areas of a room.
        others: what else speaks for where rooms part.
    """
    plan, probability = looked_at
    clearance = clearance_of(plan)
    laid = laid_rooms(plan, others.parts)
    parted = inner_columns(plan, others.doors)
    region = regions_of(plan, probability, parted | parted_columns(laid) if laid else parted)
    if k > 0:
        region = without_upper_sides(grid, plan, region, others.places)
    passages = find_passages(plan, clearance, region, probability)
    by_parts, by_walls = door_log_odds(region, plan.edge, passages, laid), inner_log_odds(plan, passages, others.doors)
    passages = {pair: replace(passage, log_odds=by_parts[pair] + by_walls[pair]) for pair, passage in passages.items()}
    least = FLAT_LEAST_AREA if others.flat else ROOM_LEAST_AREA
    partition = merge_regions(region, clearance, passages, plan.edge, door_probability, door, narrow, least)
    wide = FLAT_LEAST_HALF_WIDTH if others.flat else ROOM_LEAST_HALF_WIDTH
    low, base = columns_of(plan, grid)
    corner = grid.origin + np.append(low, np.median(base)) * plan.edge
    classes = ClassifiedStorey(probability, corner[:2], plan.edge, float(corner[2]))
    return StoreyRooms(k, plan, classes, *_numbered(partition, region, clearance, plan.edge, (least[1], wide)))


def _numbered(
    partition: Partition, region: Array, clearance: Array, edge: float, least: tuple[float, float]
) -> tuple[Array, Array, Array, dict[Pair, float]]:
    """Room and area of each column, room of each area and the probabilities of doors, of rooms that are large enough:
    `least` m2, and somewhere as far from walls, m."""
    in_region = region >= 0
    room = partition.room[region[in_region]]
    size = np.bincount(room, minlength=len(partition.room)) * edge**2
    widest = np.zeros(len(size))
    np.maximum.at(widest, room, clearance[in_region])
    large = np.flatnonzero((size >= least[0]) & (widest >= least[1]))
    number = np.full(len(size) + 1, -1)
    number[large] = np.arange(len(large))
    room_of_region = np.append(number[partition.room], -1)
    areas, area_of_region = np.unique(np.where(room_of_region[:-1] >= 0, partition.area, -1), return_inverse=True)
    if len(areas) and areas[0] < 0:
        areas, area_of_region = areas[1:], area_of_region - 1
    doors = {}
    for pair, probability in partition.door_probability.items():
        a, b = number[list(pair)].tolist()
        if a >= 0 and b >= 0:
            doors[min(a, b), max(a, b)] = probability
    return room_of_region[region], np.append(area_of_region, -1)[region], room_of_region[areas], doors
