"""Which scale a map of unknown scale has, by its rooms."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases import list_longer
from tests.matching.turned_maps import turned
from tests.scenes_map import building
from topomerge import load_embedder
from topomerge.fusion.pipeline import merge
from topomerge.matching.match import match
from topomerge.matching.room_matcher import COARSE_SCALES, find_best_scale


@pytest.mark.longer
@pytest.mark.parametrize("true", [0.6, *list_longer(0.8, 1.0, 1.5)])
def test_rooms_are_surest_at_the_true_scale(true: float) -> None:
    a, describe = building(3), load_embedder()
    rows_at, asked = describe.at_scales(a), []

    def rows(scale: float):
        """Of a map whose unit is so long that it has its true size at `true`."""
        asked.append(scale)
        return rows_at(scale / true)

    scale, odds = find_best_scale(describe(a), describe(a), rows)
    assert scale == pytest.approx(true, rel=0.11) and sum(turned.probability for turned in odds) == pytest.approx(1.0)
    assert set(COARSE_SCALES) <= set(asked) and len(asked) == len(COARSE_SCALES) + 2


@pytest.mark.longer
def test_matching_at_unknown_scale_says_which_it_took() -> None:
    a = building(3)
    b, _ = turned(a, (3.0, 1.0, 0.0), 1.25)
    found = match(a, b, scale_free=True)
    assert found.statistics["scale"] == pytest.approx(0.8, rel=0.12)
    assert "scale" not in match(a, b, "engineered", scale_free=True).statistics
    assert found.transform is not None and found.transform.scale == pytest.approx(0.8, rel=0.05)


def test_an_embedder_without_a_matcher_has_no_say() -> None:
    assert find_best_scale(np.eye(3), np.eye(3), lambda scale: np.eye(3)) == (1.0, ())


@pytest.mark.longer
def test_poses_of_rooms_alone_have_their_scale() -> None:
    a = building(3)
    b, true = turned(a, (3.0, 1.0, 0.0), 1.25)
    merged = merge([a, b], poses="rooms", scale="free")
    assert merged.registration is not None and merged.registration.transform is not None
    assert merged.registration.transform.scale == pytest.approx(true.scale, rel=0.02)
