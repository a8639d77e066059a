"""Doorways out of probabilities along walls, and doors of plans and walls weighed together: answers known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases import list_longer
from tests.extraction.elevations.doors import SHUT_DOOR, cupboard_and_board, extracted, three_doors, wide_opening
from tests.scenes import two_rooms
from tests.training.tiny import two_doors
from topomerge.extraction.elevations.doorways import (
    DOORWAY_DTYPE,
    HALF_OPEN,
    OPEN,
    SHUT,
    detect_doorways,
    merge_openings,
    read_both_ways,
)
from topomerge.extraction.elevations.elevation import ALONG, FACE_DTYPE, STRIP_CHANNELS, WALL_CLASSES, Elevations
from topomerge.extraction.elevations.wall_doors import SOURCES, WALL_DOOR_FEATURES, DoorCandidates, compute_door_probability
from topomerge.training.wall_doors import find_candidates_of_map
from topomerge.types import Sim3, classify_door_state

STEP = 2 * ALONG


def face(room=0, start=(0.0, 0.0), along=(1.0, 0.0), out=(0.0, 1.0), length=6.0, floor=0.0):
    return np.array([(room, start, along, out, length, floor)], FACE_DTYPE)


def walls(*faces):
    sizes = [2 * round(f["length"][0] / STEP) for f in faces]
    strips = np.full((sum(sizes), 32, STRIP_CHANNELS), 0.5, np.float32)
    return Elevations(np.concatenate(faces), np.concatenate([[0], np.cumsum(sizes)]), strips)


def chances(length, *doors):
    """(n, 3) where doors (start, stop, open, shut, half open) stand in probabilities along `length` m."""
    out = np.zeros((round(length / STEP), 3))
    for start, stop, *states in doors:
        out[round(start / STEP) : round(stop / STEP), : len(states)] = states
    return out


def test_a_stretch_is_a_doorway_in_its_middle_and_as_wide():
    (door,) = detect_doorways(walls(face()), chances(6, (2.0, 2.9, 0.9, 0.05)))
    assert door["centre"][0] == pytest.approx(2.45) and 0 < door["centre"][1] < 0.15 and door["centre"][2] == 0
    assert door["width"] == pytest.approx(0.9 * 0.95) and door["open"] == pytest.approx(0.9 / 0.95)
    assert door["rooms"].tolist() == [0, -1] and door["faces"] == 1 and door["probability"] == pytest.approx(0.95)


@pytest.mark.parametrize(("half", "state"), [(0.7, "half open"), (0.3, "open")])
def test_most_of_what_speaks_for_a_door_says_how_its_leaf_stands(half, state):
    states = (2.0, 2.9, 0.9 - half, 0.05, half)
    (door,) = detect_doorways(walls(face()), chances(6, states))
    assert door["open"] == pytest.approx(0.9 / 0.95) and door["half"] == pytest.approx(half / 0.95)
    (edge,) = seen(chances(8, states)).edges  # beside one of the plan
    assert classify_door_state(edge) == state
    map = two_doors(0)[0]
    map.edges["centre"][0, 0] = 7.2
    assert classify_door_state(seen(chances(8, states), map).edges[1]) == state  # of the wall alone


def way(rooms=(0, 1), at=0.0, width=1.1, out=(0.0, 1.0), probability=0.9, level=0.0, off=0.0):
    return (rooms, (at * out[1] - off * out[0], -at * out[0] + off * out[1], level), out, width, probability, 0.8, 0.9, 0.0, 1)


@pytest.mark.parametrize("out", [(0.0, 1.0), (0.6, 0.8)])
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_two_doorways_that_meet_are_one_wide_opening(out, order):
    halves = [way(at=-0.6, out=out, width=1.2), way((1, 0), at=0.55, out=tuple(-v for v in out), width=1.1, probability=0.95)]
    halves[1] = (halves[1][0], way(at=0.55, out=out)[1], *halves[1][2:])
    rows = np.array([halves[k] for k in order], DOORWAY_DTYPE)
    (opening,), (shown,) = merge_openings(rows)
    middle = (-1.2 + 1.1) / 2
    assert opening["width"] == pytest.approx(2.3) and shown == 1.1 and opening["probability"] == 0.95
    assert opening["centre"][:2] == pytest.approx([middle * out[1], -middle * out[0]])


@pytest.mark.parametrize(
    "other",
    [way(at=1.7), way((0, 2), at=1.0), way(at=1.0, out=(1.0, 0.0)), way(at=1.0, level=3.0), way(at=1.0, off=0.9)],
    ids=["far", "other room", "other wall", "other storey", "beside"],
)
def test_other_doorways_stay_what_they_are(other):
    rows = np.array([way(), other], DOORWAY_DTYPE)
    ways, shown = merge_openings(rows)
    assert np.array_equal(ways, rows) and shown.tolist() == [1.1, 1.1]


def test_three_parts_in_a_row_are_one_and_none_are_none():
    rows = np.array([way(at=k) for k in (2.4, 0.0, 1.2)], DOORWAY_DTYPE)
    (opening,), _ = merge_openings(rows)
    assert opening["width"] == pytest.approx(3.5) and opening["centre"][0] == pytest.approx(1.2)
    ways, shown = merge_openings(rows[:0])
    assert not len(ways) and ways.dtype == DOORWAY_DTYPE and not len(shown)


@pytest.mark.parametrize(("width", "turn"), [(2.4, 1.0), *list_longer((2.0, 0.0), (3.0, 0.3))])
def test_an_opening_wider_than_doors_is_one(width, turn):
    map = extracted(wide_opening(width).points(), turn)
    (edge,) = map.edges
    assert len(map.rooms) == 2 and edge["kind"] == "opening" and edge["confidence"] > 0.8
    assert Sim3(-turn).apply(edge["centre"][None])[0, :2] == pytest.approx([3.5, 5.0], abs=0.12)
    assert edge["width"] == pytest.approx(width, abs=0.2)


def test_what_is_narrow_or_unlikely_is_none():
    doors = chances(6, (1.0, 1.3, 1.0, 0.0), (3.0, 4.0, 0.2, 0.2))
    assert not len(detect_doorways(walls(face()), doors))


def test_both_faces_show_one_doorway_in_the_middle_of_the_wall():
    both = walls(face(), face(room=1, start=(6.0, 0.2), along=(-1.0, 0.0), out=(0.0, -1.0)))
    doors = np.concatenate([chances(6, (2.0, 3.0, 0.1, 0.8)), chances(6, (3.0, 4.0, 0.0, 0.7))])
    (door,) = detect_doorways(both, doors)
    assert sorted(door["rooms"].tolist()) == [0, 1] and door["faces"] == 2
    assert door["centre"][:2] == pytest.approx([2.5, 0.1], abs=0.01) and door["open"] < 0.15


@pytest.mark.parametrize("change", [{"start": (0.0, 0.9)}, {"floor": 3.0}])
def test_doorways_of_two_walls_or_two_storeys_stay_two(change):
    doors = np.concatenate([chances(6, (2.0, 3.0, 0.9, 0.0))] * 2)
    assert len(detect_doorways(walls(face(), face(room=1, **change)), doors)) == 2


def seen(doors, map=None):
    example = two_doors(0)
    elevations = Elevations(example[1], np.array([0, 160]), example[2] / np.float32(255))
    classes = np.zeros((len(doors), len(WALL_CLASSES)))
    classes[:, [OPEN, SHUT, HALF_OPEN]] = doors
    return find_candidates_of_map(example[0] if map is None else map, (), elevations, classes)


def test_a_door_of_the_plan_lies_where_the_wall_shows_it():
    candidates = seen(chances(8, (2.0, 2.9, 0.95, 0.0)))
    (edge,) = candidates.edges
    assert candidates.source.tolist() == [SOURCES.index("both")] and edge["centre"][0] == pytest.approx(2.45)
    assert edge["width"] == pytest.approx(0.855) and edge["rooms"].tolist() == [0, 1]
    at = dict(zip(WALL_DOOR_FEATURES, candidates.features[0], strict=True))
    assert (
        at["plan"] == pytest.approx(0.9)
        and at["wall"] == pytest.approx(np.log(0.95 / 0.05))
        and at["apart"] == pytest.approx(0.05, abs=0.02)
    )


def test_a_shut_door_that_the_wall_alone_shows_joins_the_rooms_on_its_two_sides():
    map = two_doors(0)[0]
    map.edges["centre"][0, 0] = 7.2  # what the plan takes for a door is wall
    candidates = seen(chances(8, (5.0, 5.9, 0.1, 0.8)), map)
    assert candidates.source.tolist() == [SOURCES.index("plan"), SOURCES.index("wall")]
    edge = candidates.edges[1]
    assert edge["rooms"].tolist() == [0, 1] and not edge["open"] and edge["kind"] == "door"
    assert edge["direction"] == pytest.approx(np.pi / 2)
    near, covered = (candidates.features[0][WALL_DOOR_FEATURES.index(name)] for name in ("near", "covered"))
    assert near == 0 and covered == 1


def test_a_doorway_into_nothing_joins_nothing():
    map = two_doors(0)[0]
    map.navigable_room[map.navigable_room == 1] = -1
    assert seen(chances(8, (5.0, 5.9, 0.1, 0.8)), map).source.tolist() == [SOURCES.index("plan")]


def test_a_model_each_for_what_shows_a_door():
    candidates = DoorCandidates(seen(chances(8)).edges[[0] * 4], np.eye(4, len(WALL_DOOR_FEATURES)), np.arange(4))
    zeros = [0.0] * len(WALL_DOOR_FEATURES)
    models = {
        "both": [0.0, 2.0, *zeros[1:]],
        "plan": [-1.0, *zeros],
        "wall": [1.0, *zeros],
        "flat": [2.0, *zeros],
    }
    assert compute_door_probability(candidates, models) == pytest.approx(1 / (1 + np.exp([-2.0, 1.0, -1.0, -2.0])))


def test_a_mirrored_wall_has_the_same_doors_mirrored():
    strip = two_doors(0)[2] / np.float32(255)
    there = read_both_ways(strip)
    assert np.abs(there - read_both_ways(strip[::-1])[::-1]).max() < 1e-6 and np.ptp(there[:, OPEN] + there[:, SHUT]) > 0.3


def test_a_wide_opening_of_the_plan_stays_though_walls_show_no_door():
    map = two_doors(0)[0]
    map.edges["width"], map.edges["kind"] = 2.4, "opening"
    candidates = seen(chances(8), map)
    assert compute_door_probability(candidates).tolist() == [pytest.approx(0.9)]


@pytest.mark.parametrize("turn", [0.6, *list_longer(0.0)])
def test_a_shut_door_between_two_rooms_is_an_edge_and_an_open_one_lies_in_its_wall(turn):
    map = extracted(three_doors().points(0.003), turn)
    back = Sim3(turn).inverse().apply(map.edges["centre"])
    doors = {round(float(y), 1): edge for (_, y, _), edge in zip(back, map.edges, strict=True)}
    places = sorted(doors)
    assert places == pytest.approx([SHUT_DOOR, 4.0], abs=0.15) and back[:, 0] == pytest.approx(4.0, abs=0.15)
    assert [bool(doors[y]["open"]) for y in places] == [False, True]
    assert all(0.7 < doors[y]["width"] < 1.1 and doors[y]["rooms"].tolist() == [0, 1] for y in places)


def test_without_a_look_at_walls_the_shut_door_is_none():
    assert extracted(three_doors().points(0.003), walls=False).edges["open"].tolist() == [True]


def test_a_cupboard_and_a_board_are_no_doors():
    map = extracted(cupboard_and_board(two_rooms()).points(0.003))
    assert len(map.edges) == 1 and map.edges["open"].all()
