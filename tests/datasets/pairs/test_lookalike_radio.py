"""What phones hear at look-alikes: the places of a pair lie where they should, and the same item gives the same bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.lookalike_places import LookalikePlaces
from topomerge.datasets.pairs.lookalike_radio import STOREY_HEIGHT, WIFI, build_world, find_track, simulate_lookalike_radio
from topomerge.datasets.pairs.lookalikes import LookalikeItem
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.simulation.radio import build_radio_plans

from topomerge.types import Sim3

HOUSE = make_building("apartment", 3)
ROOMS = np.arange(len(HOUSE.rooms))
EXACT = replace(WIFI, density=2.5, shadow=0.0, noise=0.0, gain=0.0, missed=0.0, moved=0.0, sensitivity=-120.0)


def simulate(kind: str, again: bool = False, draw: int = 0):
    """What is heard in the house twice, or in two that have its walls."""
    item = LookalikeItem(kind, 0, 3, "same", ("tls", "tls"), False, again)
    places = LookalikePlaces((HOUSE, HOUSE), (ROOMS, ROOMS), (Sim3(),))
    return simulate_lookalike_radio(item, places, EXACT, draw), draw_frames(2, False, np.random.default_rng([3, 0, KINDS[kind]]))


KINDS = {"storeys": 5, "same-room": 2, "mirror": 3}


def average_strength(readings) -> dict[str, float]:
    """Mean strength of each address, dBm."""
    values, number = np.array(readings.get_values()), readings.table["number"]
    return {str(name): float(number[values == name].mean()) for name in np.unique(values)}


@pytest.mark.parametrize("relation", ["storey", "wing", "row"])
def test_the_second_place_lies_beside_or_above_the_first(relation: str) -> None:
    world = build_world((HOUSE, HOUSE), relation, np.random.default_rng(0))
    plan = build_radio_plans(HOUSE)[0]
    if relation == "storey":
        assert [p.level for p in world.plans] == list(range(world.level + 1)) and world.shift == (0.0, 0.0)
        assert world.plans[-1].floor == plan.floor + STOREY_HEIGHT * world.level
        return
    (joined,) = world.plans
    assert world.shift[0] > np.ptp(plan.free[:, 0])
    low = np.round((plan.origin - joined.origin) / 0.1).astype(int)
    for shift in (0.0, world.shift[0]):  # the rooms of both are as they were
        column = low[0] + round(shift / 0.1)
        rows, columns = plan.wall.shape
        assert np.array_equal(joined.wall[low[1] : low[1] + rows, column : column + columns], plan.wall)


def test_one_place_is_heard_alike_twice_and_another_storey_is_not() -> None:
    again, frames = simulate("storeys", True)
    one, two = (average_strength(of) for of in again.readings)
    assert again.relation == "" and one == pytest.approx(two, abs=1.5) and len(one) > 3  # the weakest readings are missed
    track = find_track(HOUSE, ROOMS)
    for frame, of in zip(frames, again.readings, strict=True):
        back = frame.inverse().apply(of.table["position"])[:, :2]
        assert max(np.abs(track - place).sum(axis=1).min() for place in back[::50]) < 1e-6
    other, _ = simulate("storeys")
    first, second = (average_strength(of) for of in other.readings)
    assert other.relation == "storey"
    assert max(abs(first[name] - second[name]) for name in first.keys() & second.keys()) > 10


@pytest.mark.longer
def test_the_same_item_gives_the_same_bytes_and_another_draw_others() -> None:
    first, repeated, drawn = (simulate("same-room", draw=draw)[0] for draw in (0, 0, 1))
    for a, b in zip(first.readings, repeated.readings, strict=True):
        assert a.table.tobytes() == b.table.tobytes() and a.values == b.values
    assert first.relation == "row" and drawn.readings[0].values != first.readings[0].values


def test_another_building_hears_other_access_points() -> None:
    apart = next(pair for pair, _ in (simulate("mirror", draw=k) for k in range(20)) if pair.relation == "building")
    names = [set(of.get_values()) for of in apart.readings]
    assert names[0] and names[1] and not names[0] & names[1]
