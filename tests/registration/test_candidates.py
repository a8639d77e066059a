"""The best few hypotheses, bent and ranked anew: drift that made a right pose look worse than a wrong one is no disadvantage.

Places of strangers' worlds that look alike: none is one place under the pose that is found, and none may be believed.

Turns under which walls are parallel.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.cases import list_longer
from tests.fusion.plans_of import MOVE, grid_of, off, office
from topomerge.io.maps import load_map
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.judge import Judge
from topomerge.registration.pipeline import CLOSELY, build_candidate, build_candidates, count_repeats, register, select_rivals
from topomerge.registration.prepared import prepare
from topomerge.registration.search import find_yaw_candidates, select_distinct_yaws
from topomerge.registration.verify import MARGIN_CAP, rank, score_plausibility
from topomerge.structure.lines import compute_direction_profile
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def points():
    return office().points()


def bowed(points: np.ndarray, rise: float = 0.9) -> np.ndarray:
    """A map that drifted: its far end lies `rise` m aside."""
    out = points.copy()
    out[:, 1] += rise * (np.clip(points[:, 0], 0, 24) / 24) ** 2
    return out


@pytest.fixture(scope="module")
def drifted(points):
    """A map, the same one bent by drift, and the hypothesis of their pose."""
    a, b = prepare(grid_of(points)), prepare(grid_of(bowed(points), MOVE))
    hypothesis = PoseHypothesis(MOVE.inverse())
    return a, b, rank([hypothesis], Judge(a.storeys, b.storeys))[0]


def test_bending_takes_away_what_drift_speaks_against(drifted):
    a, b, hypothesis = drifted
    bent = build_candidate(a, b, hypothesis, scaled=False)
    assert score_plausibility(bent.features) > hypothesis.score + 1
    assert bent.features["conflict_share"] < 0.5 * hypothesis.features["conflict_share"]
    assert len(bent.places) > 5 and bent.features["place_area"] == pytest.approx(bent.places.crops.area.sum())
    assert {"moved_walls", "strain", "place_mean"} <= set(bent.compute_all_features())


def test_a_right_pose_that_drift_put_second_comes_first(drifted):
    a, b, hypothesis = drifted
    shifted = rank([PoseHypothesis(Sim3(0.0, (6.0, 0.0, 0.0)) @ MOVE.inverse())], Judge(a.storeys, b.storeys))[0]
    wrong = replace(shifted, score=hypothesis.score + 0.5)  # as if walls had met by chance
    found = build_candidates(a, b, [wrong, hypothesis], scaled=False)
    assert found[0].hypothesis is hypothesis and found[0].score > found[-1].score + 1 and len(found) == 2


def test_those_that_end_in_one_pose_are_one(drifted):
    a, b, hypothesis = drifted
    near = replace(hypothesis, transform=Sim3(0.0, (0.2, 0.0, 0.0)) @ hypothesis.transform, score=hypothesis.score - 0.1)
    assert len(build_candidates(a, b, [hypothesis, near], scaled=False)) == 1


FEATURES = {
    "ratio": 0.8, "walls": 20.0, "conflict": 2.0, "conflict_share": 0.09, "worst_conflict": 0.12, "free": 150.0, "opposed": 0.03,
    "met": 0.6, "chance": 0.1, "clutter": 9.0, "share": 0.7, "sliced": 0.0, "level": 0.05, "ceilings": 0.08, "ceiling_area": 60.0,
}  # fmt: skip


def ranked(*given: tuple[float, dict[str, float]]) -> list[PoseHypothesis]:
    return [PoseHypothesis(Sim3(), score, features={**FEATURES, **changed}) for score, changed in given]


def test_what_is_looked_at_closely():
    one = ranked((5.0, {}), (4.0, {"conflict_share": 0.4}), (5.0 - MARGIN_CAP - 0.1, {}), (-9.0, {"walls": 8.0}), (-9.5, {}))
    assert select_rivals(one) == [0, 1, 2]  # the third is far behind, but no ratio speaks against it
    many = ranked(*((5.0 - k, {"conflict_share": 0.1 + 0.05 * k}) for k in range(CLOSELY + 2)), (-4.0, {"walls": 7.0}))
    assert select_rivals(many) == [*range(CLOSELY), CLOSELY + 2]  # explains less, and nothing speaks against it
    assert select_rivals(one[:1]) == [0]


def test_a_building_that_repeats_itself_is_counted():
    assert count_repeats(ranked((5.0, {}), (3.0, {}), (2.0, {"walls": 8.0}), (1.0, {"walls": 3.0}))) == 2
    assert count_repeats(ranked((5.0, {}), (3.0, {"conflict_share": 0.6, "worst_conflict": 0.7, "ratio": 0.2}))) == 0


@pytest.mark.longer
def test_the_places_of_a_registration_lie_in_the_first_map(points, drifted):
    """And seen from the other map they are the same places, in its frame."""
    a, b, _ = drifted
    here, there = register(a, b), register(b, a)
    assert here.places is not None and there.places is not None and len(here.places) == len(there.places)
    assert np.allclose(np.sort(here.places.log_odds), np.sort(there.places.log_odds))
    assert (here.places.crops.middle[:, 0] > -1).all() and (here.places.crops.middle[:, 0] < 25).all()
    back = here.transform.inverse().apply(here.places.crops.middle)
    assert np.allclose(back[:, :2], there.places.crops.middle[:, :2], atol=1e-6)
    assert here.probability == pytest.approx(there.probability) and here.posterior == pytest.approx(there.posterior)
    assert off(here.transform, MOVE.inverse(), tuple(MOVE.apply(np.array([[3.0, 7.0, 1.0]]))[0]))[0] < 0.6


@pytest.mark.data
@pytest.mark.parametrize("name", ["storeys_0", *list_longer("row_same_over_2", "storeys_1", "point_sym_3", "hotel_moved_1")])
def test_a_look_alike_is_refused(case_dir: Path, name: str) -> None:
    a, b = (load_map(case_dir / "lookalikes" / f"{name}_{side}.tmap") for side in "ab")
    seen = register(a, b)
    assert not seen.accepted
    if name.startswith(("storeys", "point_sym")):  # told by furniture, and named
        assert seen.probability < 0.3 and seen.posterior["storey"] + seen.posterior["half"] > 0.6


def test_yaw_candidates_of_a_pentagon():
    angles = 2 * np.pi * np.arange(6) / 5
    corners = 10 * np.column_stack([np.cos(angles), np.sin(angles)])
    walls = np.concatenate([p + (q - p) * np.linspace(0, 1, 120)[:, None] for p, q in pairwise(corners)])
    turn = np.radians(23.0)
    c, s = np.cos(turn), np.sin(turn)
    found = find_yaw_candidates(
        compute_direction_profile(walls @ np.array([[c, s], [-s, c]]), 0.1), compute_direction_profile(walls, 0.1)
    )
    assert min(abs(np.degrees(y) - 23.0) for y in found) < 1.0


def test_yaws_that_are_nearly_one_are_tried_once():
    yaws = np.radians([10.0, 190.0, 10.3, -170.4, 100.0, 11.0, 370.1])
    assert select_distinct_yaws(yaws.tolist()) == pytest.approx(np.radians([10.0, 190.0, 100.0, 11.0]))
