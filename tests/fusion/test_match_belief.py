"""How likely matched rooms are one, with what both maps show of them: by hand, and on an office and a stranger."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, stranger
from topomerge.archive import VARIABLE
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.fusion.match_belief import (
    BELIEF_FILE,
    BELIEF_NAMES,
    BELIEVED_METHODS,
    compute_belief_features,
    find_places,
    load_belief_weights,
    measure_shared_floor,
    update_match_probabilities,
)
from topomerge.io.maps import save_map
from topomerge.matching.consistency import find_matches
from topomerge.matching.match import Matching, match
from topomerge.matching.room_plans import build_room_plans
from topomerge.registration.places import LOOKED, SIDE, Crops, Places
from topomerge.registration.verify import PLACE_AREA
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def halves():
    return office_map(0), office_map(2)


@pytest.fixture(scope="module")
def matching(halves):
    return match(*halves, method="attention")


def seen_at(middle, log_odds) -> Places:
    """Places of 10 m2 each at middles (k, 3)."""
    k = len(log_odds)
    empty = np.zeros((k, 2, SIDE, SIDE), np.uint8)
    looked = np.zeros((k, 2, LOOKED), np.float32)
    return Places(
        Crops(empty, empty, looked, np.array(middle, float).reshape(-1, 3), np.full(k, 10.0)), np.array(log_odds, float)
    )


def test_features_by_hand(halves):
    """Two places: one in the middle of room 0, one far away."""
    a, b = halves
    middle = [*(a.rooms["lo"][0] + a.rooms["hi"][0])[:2] / 2, a.storeys["floor"][0]]
    pair = Matching(np.array([[0, 1]]), np.array([0.8]), Sim3())
    x = compute_belief_features(pair, a, b, seen_at([middle, [500.0, 0.0, 0.0]], [2.0, -1.0]))
    whole, (shared,) = 0.5 * np.log1p(20 / PLACE_AREA), measure_shared_floor(pair, a, b)
    assert x[0] == pytest.approx([1.0, np.log(4.0), whole, 2.0, shared, shared / (1 + np.exp(-whole))])
    above = compute_belief_features(pair, a, b, seen_at([np.add(middle, (0, 0, 3.0))], [2.0]))
    assert above[0, 3] == 0.0 and compute_belief_features(pair, a, b, seen_at([], []))[0, 2:4].tolist() == [0.0, 0.0]


def test_how_rooms_lie_on_each_other_by_hand(halves):
    """A map on itself; moved by 0.8 m and by more than it is wide; on another storey; a room without floor."""
    a = halves[0]
    same = Matching(np.array([[0, 0]]), np.array([0.8]), Sim3())
    assert measure_shared_floor(same, a, a) == pytest.approx([1.0], abs=0.02)
    (share,) = measure_shared_floor(replace(same, transform=Sim3(translation=(0.8, 0.0, 0.0))), a, a)
    width = float(a.rooms["hi"][0, 0] - a.rooms["lo"][0, 0])
    assert share == pytest.approx(1 - 0.8 / width, abs=0.1)
    for away in ((width + 0.4, 0.0, 0.0), (0.0, 0.0, 4.0)):
        assert measure_shared_floor(replace(same, transform=Sim3(translation=away)), a, a).tolist() == [0.0]
    half = replace(same, transform=Sim3(scale=0.5, translation=0.25 * (a.rooms["lo"][0] + a.rooms["hi"][0]) * (1, 1, 0)))
    assert measure_shared_floor(half, a, a) == pytest.approx([1.0], abs=0.1)


def test_the_probability_is_that_of_the_model(halves, matching):
    believed = update_match_probabilities(matching, *halves, "attention")
    x = compute_belief_features(matching, *halves, find_places(matching, *halves))
    assert believed.probability == pytest.approx(1 / (1 + np.exp(-x @ load_belief_weights("attention"))))
    assert np.array_equal(believed.rooms, matching.rooms) and believed.alternatives == matching.alternatives


def lying_on_each_other(matching, a, b):
    """(M,) bool: do the rooms of each match share floor under the pose?"""
    shared, _ = find_matches(matching.transform, (build_room_plans(a), build_room_plans(b)))
    return np.array([pair in shared.tolist() for pair in matching.rooms.tolist()])


def believed(west, other):
    matching = match(west, other, method="attention")
    return matching, update_match_probabilities(matching, west, other, "attention").probability


@pytest.mark.longer
def test_rooms_that_lie_right_are_believed_and_those_that_do_not_are_not(halves, matching):
    """North lies right on west; east is laid 9 m off, as the rooms look alike; the third one is another building."""
    west, east = halves
    (right, now), (wrong, wrong_now), (_, other_now) = (believed(west, b) for b in (office_map(3), east, stranger()))
    lying = lying_on_each_other(right, west, office_map(3))
    assert lying.any() and np.median(now[lying]) > np.median(right.probability[lying]) and (now[lying] > 0.5).all()
    assert (wrong_now < wrong.probability).all() and np.median(wrong_now) < 0.5 and (other_now < 0.1).all()


def test_rooms_apart_under_a_right_pose_are_not_believed(halves):
    """The pose of north on west is right, and each room is matched with the partner of the next one."""
    north = office_map(3)
    right = match(halves[0], north, method="attention")
    wrong = replace(right, rooms=np.column_stack([right.rooms[:, 0], np.roll(right.rooms[:, 1], 1)]))
    apart = ~lying_on_each_other(wrong, halves[0], north)
    now = update_match_probabilities(wrong, halves[0], north, "attention").probability
    assert apart.any() and (now[apart] < 0.5).all()


@pytest.mark.parametrize("method", BELIEVED_METHODS)
def test_places_that_agree_never_lower_a_match(method):
    assert (load_belief_weights(method)[1:] >= 0).all()


def test_what_has_no_pose_or_no_cells_stays(halves, matching):
    a, b = halves
    empty = replace(a, grid=a.grid.replace_cells(a.grid.cells[:0]), room=a.room[:0])
    for given in (replace(matching, transform=None), Matching(transform=Sim3())):
        assert update_match_probabilities(given, a, b, "attention") is given
    assert update_match_probabilities(matching, empty, b, "attention") is matching
    assert all(update_match_probabilities(matching, a, b, method) is matching for method in ("growing", "consistent"))


def test_the_command_prints_them(halves, matching, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for m, name in zip(halves, "ab", strict=True):
        save_map(m, f"{name}.tmap")
    assert cli(["match", "a.tmap", "b.tmap", "--method", "attention", "--json"]) == 0
    printed = [m["probability"] for m in json.loads(capsys.readouterr().out)["matches"]]
    assert printed == pytest.approx(update_match_probabilities(matching, *halves, "attention").probability.tolist(), abs=1e-3)


@pytest.mark.parametrize("spoiled", [{}, {"attention": [1.0]}, {"attention": [1.0, float("nan"), 0.0, 0.0]}])
def test_damaged_weights_are_told(spoiled, tmp_path, monkeypatch):
    (tmp_path / BELIEF_FILE).write_text(json.dumps(spoiled))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=f"{BELIEF_FILE}: attention must be {len(BELIEF_NAMES)} numbers"):
        load_belief_weights("attention")
