"""Which scale a map of unknown scale has, by its rooms."""

from __future__ import annotations

import numpy as np
import pytest

from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge import load_embedder
from topomerge.matching.match import match
from topomerge.matching.unknown_scale import SCALES_TRIED, odds_at_best_scale
from topomerge.types import TopometricMap


def test_rooms_are_surest_at_the_true_scale():
    a, describe = building(3), load_embedder()
    asked: list[float] = []

    def at_scale(map: TopometricMap, scale: float):
        """Rows of a map whose unit is 1.25 m: as they are at 0.8 of what they are in metres."""
        asked.append(scale)
        return describe.at_scale(map, scale / 0.8)

    scale, odds = odds_at_best_scale(at_scale, describe(a), a)
    assert scale == pytest.approx(0.8, rel=0.08) and len(odds) == 4
    assert set(SCALES_TRIED) <= set(asked)


def test_matching_at_unknown_scale_says_which_it_took():
    a = building(3)
    b, _ = turned(a, (3.0, 1.0, 0.0), 1.25)
    found = match(a, b, scale_free=True)
    assert found.statistics["scale"] == pytest.approx(0.8, rel=0.12)
    assert "scale" not in match(a, b, "engineered", scale_free=True).statistics
    assert found.transform is not None and found.transform.scale == pytest.approx(0.8, rel=0.05)


def test_an_embedder_without_a_matcher_has_no_say():
    a = building(2)
    scale, odds = odds_at_best_scale(lambda map, scale: np.eye(len(map.rooms)), np.eye(len(a.rooms)), a)
    assert scale == 1.0 and odds == ()
