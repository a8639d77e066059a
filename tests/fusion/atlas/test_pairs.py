"""What two maps of an atlas say to a pose of one in the other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from topomerge.fusion.atlas import pairs
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.pairs import Checks, Conflict, find_hypotheses, is_same_pose, locate_place, score_pose
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.pipeline import Registration
from topomerge.types import Sim3, TopometricMap


@pytest.fixture(scope="module")
def maps() -> list[TopometricMap]:
    return [office_map(k) for k in range(4)]


@pytest.mark.longer
def test_an_ambiguous_pair_is_settled_by_the_others(maps):
    """South and north share a corridor only: three places are about as good; west and east know which is right."""
    inner = Maps(maps)
    pair = find_hypotheses(inner, 1, 3)
    assert pair[0].probability < 0.9 and len(pair) > 1
    check = Checks(inner)(1, 3, truth(1, 3))
    assert check.overlap and check.log_odds > 0


def test_checks_see_walls_on_free_floor(maps):
    checks = Checks(Maps(maps))
    right, wrong = checks(0, 2, truth(0, 2)), checks(0, 2, Sim3(0.3, (2.0, 1.0, 0.0)) @ truth(0, 2))
    assert right.log_odds > 2 and wrong.log_odds < -2 and right.overlap and wrong.overlap
    assert checks(2, 0, truth(2, 0)).log_odds == right.log_odds
    far = checks(0, 2, Sim3(0.0, (99.0, 0.0, 0.0)))
    assert not far.overlap and far.log_odds == 0.0
    assert not checks(0, 2, Sim3(0.0, (0.0, 0.0, 9.0))).overlap


def plan_fields(explored: np.ndarray, floor: float = 0.0, sliced: bool = False) -> Any:
    """A storey of which only the explored columns matter, 0.1 m each, from the origin."""
    plan = SimpleNamespace(
        explored=explored,
        wall=explored,
        origin=np.zeros(2),
        edge=0.1,
        floor_guess=floor,
        levels=(floor, floor + 2.7),
        sliced=sliced,
    )
    return SimpleNamespace(plan=plan, middle=np.array([5.0, 5.0]))


def test_the_place_of_a_pair_is_the_middle_of_what_both_saw_and_as_wide():
    """a shows 4 x 6 m; b 10 x 6 m, of which 4 x 6 m lie in a: 1.15 m and 1.73 m are its standard deviations."""
    a, b = plan_fields(np.ones((40, 60), bool)), plan_fields(np.ones((100, 60), bool), floor=1.0)
    points = locate_place([a], [b], Sim3(0.0, (-5.0, 0.0, -1.0)))
    assert points == pytest.approx(np.array([[7.0, 3, 1], [8.15, 3, 1], [5.85, 3, 1], [7, 4.73, 1], [7, 1.27, 1]]), abs=0.06)
    nothing = locate_place([a], [b], Sim3(0.0, (99.0, 0.0, -1.0)))
    assert nothing == pytest.approx(np.array([[5.0, 5, 0], [6, 5, 0], [4, 5, 0], [5, 6, 0], [5, 4, 0]]))


@pytest.mark.parametrize(("off", "is_alike"), [(Sim3(0.0, (0.9, 0.0, 0.0)), True), (Sim3(0.0, (1.1, 0.0, 0.0)), False),
    (Sim3(np.radians(3.9)), True), (Sim3(np.radians(4.1)), False), (Sim3(scale=1.06), False)])  # fmt: skip
def test_poses_of_one_pair_that_drift_explains_are_one(off, is_alike):
    assert is_same_pose(off, Sim3(), np.zeros(3)) == is_alike


def test_what_walls_on_free_floor_say(monkeypatch):
    """The plausibility speaks for a pose up to 3; each share of the walls on free floor above 0.12 costs 30, at most 6."""
    monkeypatch.setattr(pairs, "score_plausibility", lambda f: f["said"])
    f = {"said": -1.0, "conflict": 2.0, "conflict_share": 0.12}
    assert score_pose(f) == 2.0 and score_pose({**f, "said": 9.0}) == 3.0 and score_pose({**f, "said": -9.0}) == 0.0
    assert score_pose({**f, "conflict_share": 0.22}) == pytest.approx(-1.0) and score_pose({**f, "conflict_share": 0.9}) == -4.0
    assert score_pose({**f, "conflict_share": 0.9, "conflict": 0.3}) == 2.0  # so little may be noise


@pytest.mark.parametrize(("areas", "against"), [((2.0,), 0.6), ((1.0, 1.0), 2.1), ((0.5, 0.5, 0.5, 0.5), 5.1), ((0.4,) * 5, 6.0),
    ((1.4,), 0.6 + 1.5 * 2), ((), 6.0)])  # fmt: skip
def test_one_altered_room_says_little_and_many_places_say_much(monkeypatch, areas, against):
    """Each place says so much at most; what is scattered counts as further places, one for each 0.3 m2."""
    monkeypatch.setattr(pairs, "score_plausibility", lambda f: -3.0)
    f = {"conflict": 2.0, "conflict_share": 0.9}
    assert score_pose(f, [Conflict((0.0, 0.0, 0.0), area) for area in areas]) == pytest.approx(-against)
    assert score_pose({**f, "conflict_share": 0.13}, [Conflict((0.0, 0.0, 0.0), 2.0)]) == pytest.approx(-0.3)  # little by share


def test_hypotheses_share_the_probability_that_one_of_them_is_right(monkeypatch):
    def registered(*_: object, scale: str, proposed: list[Sim3], same: str) -> Registration:
        assert scale == "free" and proposed == [] and same == "storey"
        places = [PoseHypothesis(Sim3(0.0, (float(k), 0.0, 0.0)), score) for k, score in enumerate((5.0, 4.0, 4.9, 1.0))]
        return Registration(Sim3(0.0, (0.01, 0.0, 0.0)), 0.6, False, {"walls": 9.0}, tuple(places))

    monkeypatch.setattr(pairs, "register", registered)
    maps: Any = SimpleNamespace(matched=False, get_prepared=lambda k: k)
    ranked = find_hypotheses(maps, 0, 1, "free", "storey")
    assert [h.transform.translation[0] for h in ranked] == [0.01, 1.0, 2.0, 3.0] and ranked[0].features == {"walls": 9.0}
    assert [h.probability for h in ranked] == pytest.approx([0.6, 0.6 * np.exp(-1), 0.4, 0.6 * np.exp(-4)])


def test_fine_poses_are_made_once_and_never_of_slices(monkeypatch):
    asked = []

    def refined(a: object, b: object, pose: Sim3, scaled: bool) -> tuple[Sim3, float]:
        asked.append((a, b, scaled))
        return Sim3(0.0, (1.0, 0.0, 0.0)) @ pose, 0.01

    monkeypatch.setattr(pairs, "refine_by_surfaces", refined)
    sides = [
        SimpleNamespace(storeys=[plan_fields(np.ones((2, 2), bool), sliced=s)], middle=np.zeros(3)) for s in (False, False, True)
    ]
    facts = {"is_sliced": [False, False, True].__getitem__, "get_middle": lambda k: np.zeros(3)}
    maps = SimpleNamespace(get_prepared=sides.__getitem__, answer=lambda question, pair, make: make(), **facts)
    checks = Checks(maps, scaled=True)  # type: ignore[arg-type]
    near = Sim3(0.0, (0.05, 0.0, 0.0))
    assert checks.refine_pose(0, 1, Sim3()) == checks.refine_pose(0, 1, near) == Sim3(0.0, (1.0, 0.0, 0.0))
    assert asked == [(sides[0], sides[1], True)]
    assert checks.refine_pose(0, 1, Sim3(0.0, (0.2, 0.0, 0.0))).translation[0] == 1.2 and checks.refine_pose(0, 2, near) == near
