"""What two maps of an atlas say to a pose of one in the other."""

from __future__ import annotations

import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.pairs import Checks, hypotheses
from topomerge.types import Sim3, TopometricMap


@pytest.fixture(scope="module")
def maps() -> list[TopometricMap]:
    return [office_map(k) for k in range(4)]


def test_an_ambiguous_pair_is_settled_by_the_others(maps):
    """South and north share a corridor only: three places are about as good; west and east know which is right."""
    inner = Maps(maps)
    pair = hypotheses(inner, 1, 3)
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
