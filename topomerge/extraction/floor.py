"""The floors of a map cut into rooms: what rooms of plans and rooms of views become before the graph is made (seeds 2.7)."""

from __future__ import annotations

from dataclasses import dataclass, field

from topomerge.extraction.classified_storey import ClassifiedStorey
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array, VoxelGrid


@dataclass(frozen=True, eq=False)
class Floor:
    """The floors of all storeys, cut into rooms.

    Args:
        cells: the navigable volume, and the floor under furniture where rooms have such. Its property `standing` (bool) tells
            where a body fits; absent, it fits everywhere.
        storeys: (S,) STOREY_DTYPE.
        storey, room, area: (m,) int32 of each cell, -1 none.
        room_of_area: (A,) int32.
        label: (n,) int32 room of each occupied cell of the grid, -1 none.
        body_width: m, how much wider than its cells a passage is: where they tell where a body's middle may be, the body's width.
        door_probability: that a door parts two rooms, where it was judged.
        completeness: (R,) share of each room's outline at which a wall was seen, where the plans tell it.
        classified_storeys: what probably stands in the columns of the storeys' plans.
        plans: these plans, without furniture.
        chosen_parameters: of the extraction, that a step chose by itself.
    """

    cells: VoxelGrid
    storeys: Array
    storey: Array
    room: Array
    area: Array
    room_of_area: Array
    label: Array
    body_width: float = 0.0
    door_probability: dict[tuple[int, int], float] = field(default_factory=dict)
    completeness: Array | None = None
    classified_storeys: tuple[ClassifiedStorey, ...] = ()
    plans: tuple[StoreyPlan, ...] = ()
    chosen_parameters: dict[str, float] = field(default_factory=dict)
