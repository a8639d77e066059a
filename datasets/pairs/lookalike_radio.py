"""Radio readings at look-alikes: the two places of a pair in one world, with access points, walls and floors between them.

Places with the same walls are put where such places are: on two storeys, in two wings or rooms of one row, or in two buildings
that hear nothing of each other (`draw_relation`). Readings are a switch, as signs are: the arrays of the pair stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.lookalike_places import LOOKALIKES, LookalikePlaces
from topomerge.datasets.pairs.lookalikes import RELATION_OF, LookalikeItem
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.simulation.floor_truth import rasterize_floors
from topomerge.datasets.simulation.radio import (
    HELD,
    RADIO_CELL,
    RADIO_STREAM,
    RadioPlan,
    RadioSettings,
    build_radio_plans,
    place_access_points,
    simulate_readings,
)

from topomerge.types import Array, Landmarks

WIFI = RadioSettings(density=1.5)  # as on the real storeys of the table of radio
TRACK_GAP = 2.0  # m between scans
STOREY_HEIGHT = 3.5  # m from floor to floor
HIGHEST = 4  # storeys that the second place may be above, one fewer than this
GAP = (2.0, 30.0)  # m between two wings
SEEDS = 64  # of access points that an item has
ROOMS_APART = 6  # rooms of a row that the second one may be further on, one fewer than this


@dataclass(frozen=True, eq=False)
class RadioWorld:
    """Where two places are.

    Args:
        plans: of the storeys on which anything is.
        level: of b; that of a is 0.
        shift: (2,) m, from the coordinates of b's building to those of the plans; those of a are the same.
        joined: does b hear the access points of a?
    """

    plans: tuple[RadioPlan, ...]
    level: int = 0
    shift: tuple[float, float] = (0.0, 0.0)
    joined: bool = True


def draw_relation(item: LookalikeItem, places: LookalikePlaces, rng: np.random.Generator) -> str:
    """Draw where the second place is: "" where both are in one frame, or "storey", "wing", "row" or "building"."""
    return "" if places.same else str(rng.choice(RELATION_OF[item.kind]))


def build_world(buildings: tuple[Building, Building], relation: str, rng: np.random.Generator) -> RadioWorld:
    """Put two places of one storey each into a world."""
    first, second = (build_radio_plans(building)[0] for building in buildings)
    if relation in ("", "building"):
        return RadioWorld((first,) if not relation else (second,), joined=not relation)
    if relation == "storey":
        level = int(rng.integers(1, HIGHEST))
        between = [replace(first, floor=first.floor + STOREY_HEIGHT * k, level=k) for k in range(level)]
        return RadioWorld((*between, replace(second, floor=first.floor + STOREY_HEIGHT * level, level=level)), level)
    wide = float(np.ptp(first.free[:, 0])) + 1.0
    if relation == "row":
        steps, apart = int(rng.integers(1, ROOMS_APART)), round(wide + 0.2, 1)
    else:
        steps, apart = 1, round(wide + float(rng.uniform(*GAP)), 1)
    blocks = [(first, k * apart) for k in range(steps)] + [(second, steps * apart)]
    return RadioWorld((join_plans(blocks),), shift=(steps * apart, 0.0))


def join_plans(blocks: Sequence[tuple[RadioPlan, float]]) -> RadioPlan:
    """Join plans of one storey, each moved along x by so many metres, in whole cells; what lies between them is wall."""
    low = np.min([plan.origin + (x, 0.0) for plan, x in blocks], axis=0)
    corners = [np.round((plan.origin + (x, 0.0) - low) / RADIO_CELL).astype(int)[::-1] for plan, x in blocks]
    shape = np.max([c + plan.wall.shape for c, (plan, _) in zip(corners, blocks, strict=True)], axis=0)
    wall = np.ones(shape.tolist(), bool)
    for (row, column), (plan, _) in zip(corners, blocks, strict=True):
        rows, columns = plan.wall.shape
        wall[row : row + rows, column : column + columns] &= plan.wall
    free = np.concatenate([plan.free + (x, 0.0) for plan, x in blocks])
    return RadioPlan(wall, free, low, blocks[0][0].floor, blocks[0][0].level)


def find_track(building: Building, rooms: Array) -> Array:
    """Find (n, 2) m, places `TRACK_GAP` apart in the rooms of the lowest storey that were visited."""
    floors = rasterize_floors(building, RADIO_CELL)
    cells = np.argwhere(np.isin(floors.room[0], rooms))
    places = floors.origin + (cells[:, ::-1] + 0.5) * RADIO_CELL
    block = np.floor(places / TRACK_GAP)
    middle = np.hypot(*(places - (block + 0.5) * TRACK_GAP).T)
    order = np.lexsort((middle, block[:, 1], block[:, 0]))
    first = np.unique(block[order], axis=0, return_index=True)[1]
    return np.asarray(places[order][first])


@dataclass(frozen=True)
class RadioPair:
    """The readings of two phones, each in the frame of its map; "" or how the second place lies to the first one."""

    readings: tuple[Landmarks, Landmarks]
    relation: str


def simulate_lookalike_radio(
    item: LookalikeItem, places: LookalikePlaces, settings: RadioSettings = WIFI, draw: int = 0
) -> RadioPair:
    """Simulate what two phones hear at the places of an item, each in the frame of its map (`build_lookalike_arrays`).

    Args:
        places: of the item (`sample_places`).
        draw: number of the world, of which an item may have several.
    """
    buildings, visited = places.buildings, places.visited
    kind = LOOKALIKES.index(item.kind)
    frames = draw_frames(2, item.scaled, np.random.default_rng([item.seed, item.number, kind]))
    rng = np.random.default_rng([item.seed, item.number, kind, RADIO_STREAM, 2 + draw, int(item.again)])
    if item.again:
        buildings, visited, places = (buildings[0],) * 2, (visited[0],) * 2, replace(places, same=True)
    relation = draw_relation(item, places, rng)
    world = build_world(buildings, relation, rng)
    own = world if world.joined else RadioWorld((build_radio_plans(buildings[0])[0],)), world
    of_phones = []
    for session, (building, rooms, frame) in enumerate(zip(buildings, visited, frames, strict=True)):
        plans, shift = own[session].plans, np.array(world.shift if session else (0.0, 0.0))
        points = place_access_points(plans, settings, SEEDS * item.seed + 2 * draw + (session if not world.joined else 0))
        track = find_track(building, rooms) + shift
        readings = simulate_readings(plans, points, track, world.level if session else 0, settings, session)
        at = readings.table["position"] - (*shift, 0.0)
        at[:, 2] = float(building.storeys["floor"][0]) + HELD
        readings.table["position"] = frame.apply(at)
        readings.table["sigma"] *= frame.scale
        of_phones.append(readings)
    return RadioPair((of_phones[0], of_phones[1]), relation)
