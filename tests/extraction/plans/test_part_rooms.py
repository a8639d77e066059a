"""What the maps that were joined say of narrowings: by hand on two rooms with a door, and in the rooms that come out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests import scenes
from tests.extraction.segments import find_rooms_of_segments
from topomerge.extraction.extract import cut_rooms, extract
from topomerge.extraction.navigable import compute_navigable_volume
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.part_rooms import (
    GLIMPSED,
    LOG_ODDS,
    PartRooms,
    compute_door_log_odds,
    find_boundary_columns,
    rasterise_part_rooms,
)
from topomerge.extraction.plans.passages import compute_clearance, find_passages, segment_regions
from topomerge.extraction.plans.plan import build_storey_plan
from topomerge.extraction.plans.plan_network import compute_column_probabilities
from topomerge.extraction.scan import Scan
from topomerge.extraction.segment import score_by_plan
from topomerge.extraction.storeys import find_storeys, measure_floor_to_ceiling
from topomerge.extraction.voxels import voxelise
from topomerge.progress import Stopwatch

DOOR_X = 4.0  # m, of the wall with the door between the two rooms


@pytest.fixture(scope="module")
def grid():
    return voxelise(scenes.two_rooms().points(0.005), 0.1, [])


@pytest.fixture(scope="module")
def cut(grid):
    """Plan, regions, clearance and passages of two rooms, and the pair that the door joins."""
    _, navigable = compute_navigable_volume(Scan(grid), PRESETS["default"])
    _, storey = find_storeys(navigable, measure_floor_to_ceiling(grid, navigable, 1.75))
    plan = build_storey_plan(grid, navigable, storey, 0)
    clearance, probability = compute_clearance(plan), compute_column_probabilities(plan)
    region = segment_regions(plan, probability)
    passages = find_passages(plan, clearance, region, probability)
    x = {pair: plan.origin[0] + (p.place[0] + 0.5) * plan.edge for pair, p in passages.items()}
    (door,) = [pair for pair in passages if abs(x[pair] - DOOR_X) < 0.3]
    return plan, region, clearance, passages, door


def part(cut, room_of_x, entered=(0.9, 0.9), up=0.0, share=slice(None)) -> PartRooms:
    """A part with floor in all columns where one can stand, its rooms told by x."""
    plan = cut[0]
    columns = np.argwhere(plan.inside)[share]
    places = np.column_stack([plan.origin + (columns + 0.5) * plan.edge, plan.floor[tuple(columns.T)] + up])
    return PartRooms(places, room_of_x(places[:, 0]), np.array(entered), plan.edge**2)


def one(x):
    return np.zeros(len(x), np.int64)


def two(x):
    return (x > DOOR_X).astype(np.int64)


def at_the_door(cut, *parts) -> float:
    plan, region, _, passages, door = cut
    return compute_door_log_odds(region, plan.edge, passages, rasterise_part_rooms(plan, parts))[door]


def test_one_room_speaks_against_a_door_and_two_for_it(cut):
    assert at_the_door(cut, part(cut, one)) == -LOG_ODDS
    assert at_the_door(cut, part(cut, two)) == pytest.approx(LOG_ODDS, rel=0.1)
    assert at_the_door(cut, part(cut, two), part(cut, one)) == pytest.approx(0.0, abs=0.1 * LOG_ODDS)
    assert at_the_door(cut, part(cut, two), part(cut, two)) == 2 * at_the_door(cut, part(cut, two))


def test_what_a_map_is_less_sure_of_counts_less(cut):
    assert at_the_door(cut, part(cut, one, (0.4, 0.9))) == -GLIMPSED * LOG_ODDS
    assert at_the_door(cut, part(cut, two, (0.9, 0.4))) == pytest.approx(GLIMPSED * LOG_ODDS, rel=0.1)
    thinned = part(cut, one, share=slice(None, None, 200))  # far apart: between them nothing is known
    assert -LOG_ODDS < at_the_door(cut, thinned) <= 0.0


def test_a_side_that_was_not_seen_and_another_storey_say_nothing(cut):
    left = part(cut, one)
    only = left.places[:, 0] < DOOR_X - 0.3
    assert at_the_door(cut, replace(left, places=left.places[only], room=left.room[only])) == 0.0
    assert at_the_door(cut, part(cut, one, up=3.0)) == 0.0 == at_the_door(cut)
    far = replace(left, places=left.places + (100.0, 0.0, 0.0))
    assert at_the_door(cut, far) == 0.0 == at_the_door(cut, PartRooms(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0), 0.01))


def rooms_of(cut, log_odds) -> int:
    plan, region, clearance, passages, _ = cut
    weighed = {pair: replace(passage, log_odds=log_odds.get(pair, 0.0)) for pair, passage in passages.items()}
    room = find_rooms_of_segments(region, clearance, weighed, score_by_plan, edge=plan.edge)
    sizes = np.bincount(region[region >= 0])
    return len(np.unique(room[sizes * plan.edge**2 > 1]))


def test_log_odds_stay_with_their_passage_while_rooms_merge(cut):
    """Enough of them close the door, none of a passage elsewhere does."""
    door, passages = cut[4], cut[3]
    assert rooms_of(cut, {}) == 2
    assert rooms_of(cut, dict.fromkeys(passages, 0.0)) == 2
    assert rooms_of(cut, {door: -50.0}) == 1
    assert rooms_of(cut, {pair: -50.0 for pair in passages if pair != door}) == 2


def test_rooms_that_a_map_parts_stay_apart(grid):
    """A map parts the larger room by a line that nothing shows: not where no narrowing is. It has both rooms as one: its single
    word does not outweigh a clear door, four of one mind do."""
    scan, navigable = compute_navigable_volume(Scan(grid), PRESETS["default"])
    floor = extract(grid).navigable.compute_centroids()

    def count_rooms(*parts: PartRooms) -> int:
        return len(cut_rooms(scan, navigable, PRESETS["default"], Stopwatch(), parts)[0].completeness)

    whole = PartRooms(floor, np.zeros(len(floor), np.int64), np.ones(1), 0.01)
    line = PartRooms(floor, (floor[:, 0] > 2.0).astype(np.int64), np.ones(2), 0.01)
    assert count_rooms() == count_rooms(line) == 2
    assert count_rooms(whole, whole, whole, whole) == 1


def test_regions_end_where_rooms_of_a_part_meet(cut):
    """At a line that nothing shows, if somebody was in both rooms; a part of one room ends nothing."""
    plan = cut[0]
    columns = find_boundary_columns(rasterise_part_rooms(plan, [part(cut, lambda x: (x > 2.0).astype(np.int64))]))
    x = plan.origin[0] + (np.argwhere(columns)[:, 0] + 0.5) * plan.edge
    assert columns.any() and np.abs(x - 2.0).max() <= 0.4
    unsure = part(cut, lambda x: (x > 2.0).astype(np.int64), (0.9, 0.4))
    for silent in (part(cut, one), part(cut, two, (0.4, 0.4)), unsure):
        assert not find_boundary_columns(rasterise_part_rooms(plan, [silent])).any()
    probability = compute_column_probabilities(plan)
    more = segment_regions(plan, probability, columns)
    assert ((more >= 0) == (cut[1] >= 0)).all() and more.max() > cut[1].max()
