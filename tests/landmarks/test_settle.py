"""What would settle a merge: expected changes by hand, and goals in the right map and frame."""

from dataclasses import replace

import numpy as np
import pytest

from tests.landmarks.test_evidence import HALL, NUMBERS, places, with_signs
from topomerge.landmarks.evidence import score_landmarks
from topomerge.landmarks.likelihood import ALTERNATIVES, KINDS
from topomerge.landmarks.settle import READ, compute_expected_change, find_observations
from topomerge.types import Sim3, select_rooms

DOUBT = {**dict.fromkeys(ALTERNATIVES, 0.0), "here": 0.5, "wing": 0.5}
POSE = Sim3(0.7, (5.0, -2.0, 0.0))


def test_expected_change_by_hand():
    sure = {**dict.fromkeys(ALTERNATIVES, 0.0), "here": 1.0}
    assert compute_expected_change(DOUBT, sure) == pytest.approx(0.5)  # whatever comes, all is known then
    assert compute_expected_change(DOUBT, dict.fromkeys(ALTERNATIVES, 0.3)) == 0
    assert compute_expected_change(sure, sure) == 0
    p, q = 0.8, 0.1
    first, second = (p + q) / 2, 1 - (p + q) / 2
    by_hand = first * abs(p / 2 / first - 0.5) + second * abs((1 - p) / 2 / second - 0.5)
    assert compute_expected_change(DOUBT, {**dict.fromkeys(ALTERNATIVES, 0.0), "here": p, "wing": q}) == pytest.approx(by_hand)


def test_a_sign_that_only_one_map_has_is_to_be_read_in_the_other():
    at = HALL.rooms["centroid"][:1] + (0.0, 0.0, 1.0)
    low = HALL.grid.compute_centroids()[:1]
    a = with_signs(["2.113"], low)
    b = replace(HALL, grid=HALL.grid)
    found = find_observations(a, b, Sim3(), DOUBT)
    (read,) = [o for o in found if o.action == "read"]
    assert (read.map, read.expected) == (1, "2.113") and read.at == pytest.approx(low[0])
    agrees = {n: READ * (KINDS["text"].repeats[n] if n != "here" else 0.98) for n in ALTERNATIVES}
    assert read.change == pytest.approx(compute_expected_change(DOUBT, agrees)) and read.change > 0.4
    assert "read the sign at" in read.describe(["a.tmap", "b.tmap"]) and "2.113" in read.describe(["a.tmap", "b.tmap"])
    assert read.serialise()["at"] == [round(v, 2) for v in low[0].tolist()] and at.shape == (1, 3)


def test_goals_lie_in_the_frame_of_their_map():
    low = HALL.grid.compute_centroids()[:1]
    a = with_signs(["2.113"], low)
    moved = replace(HALL, grid=replace(HALL.grid, origin=HALL.grid.origin + (100.0, 0, 0)))
    found = find_observations(a, moved, Sim3(translation=(-100.0, 0, 0)), DOUBT)
    (read,) = [o for o in found if o.action == "read"]
    assert read.at == pytest.approx(low[0] + (100.0, 0, 0))


def test_what_has_testified_is_not_asked_again():
    a = with_signs(NUMBERS, HALL.grid.compute_centroids()[:: len(HALL.grid) // 6][:6])
    evidence = score_landmarks(a, a, Sim3())
    assert not [o for o in find_observations(a, a, Sim3(), DOUBT, evidence.witnesses) if o.action == "read"]


def test_doors_without_signs_and_rooms_that_one_map_lacks_are_named():
    some = select_rooms(HALL, np.isin(np.arange(7), [0, 1, 6]))
    near = some.room >= 0
    half = replace(some, grid=some.grid.replace_cells(some.grid.cells[near]), room=some.room[near])
    found = find_observations(HALL, half, Sim3(), DOUBT)
    assert {o.action for o in found} >= {"read both"}
    assert all(0 <= o.change <= 1 and np.isfinite(o.at).all() for o in found)
    turned = find_observations(half, HALL, Sim3(), DOUBT)
    assert {o.action for o in turned} == {o.action for o in found}


def test_nothing_is_asked_where_all_is_sure():
    sure = {**dict.fromkeys(ALTERNATIVES, 0.0), "here": 1.0}
    assert find_observations(with_signs(NUMBERS, places(6)), HALL, Sim3(), sure) == []
    nearly = sure | {"here": 0.01, "storey": 0.99}  # of which nothing that can be looked at changes more than 1 %
    assert find_observations(with_signs(NUMBERS, places(6)), HALL, Sim3(), nearly) == []
