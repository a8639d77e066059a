"""What the belief in merges is fitted to: errors of poses, pairs that nobody can tell, strangers made of two pairs.

The fits of the belief in merges, on made-up features.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from topomerge.datasets.pairs.grid_pairs import GridPair

from topomerge.training.belief_hypotheses import (
    classify_pair,
    compute_pose_error,
    is_distinguishable,
    is_hypothesis_right,
    pair_different_buildings,
)
from topomerge.training.merge_belief import compute_spread, fit_logistic
from topomerge.types import Sim3

TRUTH = Sim3(3.1, (5.0, -2.0, 1.0))


def pair(anchor: tuple[float, float, float] = (0.0, 0.0, 0.0), kind: str = "overlap", truth: Sim3 | None = TRUTH) -> Any:
    return SimpleNamespace(truth=truth, anchor=np.array(anchor), about={"kind": kind})


def test_errors_are_measured_in_the_middle_of_what_both_maps_saw():
    aside = Sim3(TRUTH.yaw, (5.3, -1.6, 0.75))
    assert compute_pose_error(aside, pair()) == pytest.approx([0.5, -0.25, 0.0])
    turned = Sim3(-3.1, TRUTH.translation)  # 4.77 degrees, across half a turn
    degrees = np.degrees(2 * np.pi - 6.2)
    assert compute_pose_error(turned, pair()) == pytest.approx([0.0, 0.0, degrees])
    assert compute_pose_error(turned, pair((10.0, 0.0, 0.0))) == pytest.approx(
        [20 * np.sin(np.radians(degrees) / 2), 0.0, degrees]
    )


def test_of_maps_of_two_places_no_pose_is_right():
    assert (
        compute_pose_error(TRUTH, pair(kind="twin-wing")) is None
        and compute_pose_error(TRUTH, pair(truth=None)) is None
        and not is_hypothesis_right(None, ("tls", "tls"))
    )


@pytest.mark.parametrize(
    ("err", "is_right"),
    [
        ([0.3, 0.3, 4.9], True),
        ([0.3, -0.3, 4.9], True),
        ([0.3, 0.45, 1.0], False),
        ([0.6, 0.0, 0.0], False),
        ([0.1, 0.0, 5.1], False),
    ],
)
def test_a_pose_is_right_within_half_a_metre_and_5_degrees(err, is_right):
    assert is_hypothesis_right(err, ("tls", "depth")) == is_right
    assert is_hypothesis_right([0.12, 0.0, 0.5], ("tls", "depth"), (0.1, 1.0)) is False


def test_strangers_are_map_a_of_one_pair_and_map_b_of_another():
    def made(name: str, building: str, sensors: list[str]) -> GridPair:
        grids = tuple(SimpleNamespace(name=f"{name}.{side}") for side in "ab")
        free = tuple(SimpleNamespace(name=f"{name}.{side} free") for side in "ab")
        about = {"building": building, "sensors": sensors, "kind": "overlap", "overlap": 0.5, "source": "procedural"}
        return GridPair(name, *grids, free, TRUTH, 60.0, about)  # type: ignore[arg-type]

    first, second = made("p", "house-1", ["tls", "depth"]), made("q", "office-2", ["lidar", "laser2d"])
    mixed = pair_different_buildings(first, second)
    assert (mixed.a, mixed.b) == (first.a, second.b) and mixed.free == (first.free[0], second.free[1])
    assert mixed.truth is None and mixed.common == 0.0 and mixed.about["sensors"] == ["tls", "laser2d"]
    assert mixed.about["building"] == "house-1 + office-2" and mixed.about["kind"] == "strangers"
    assert pair_different_buildings(first, made("r", "house-1", ["tls", "tls"])).about["kind"] == "same"


ROW = {"kind": "overlap", "common": 60.0, "sensors": ["tls", "depth"], "overlap": 0.5}


@pytest.mark.parametrize(
    ("change", "is_fair"),
    [
        ({}, True),
        ({"common": 0.5}, True),
        ({"common": 0.5, "sensors": ["tls", "drawing"]}, False),  # a twin's frame
        ({"kind": "same"}, False),
        ({"kind": "other-storey", "walls_differ": 2.9}, False),
        ({"kind": "other-storey", "walls_differ": 3.0}, True),
        ({"kind": "twin-wing", "differs": 0.29}, False),
        ({"kind": "twin-wing", "differs": 0.3}, True),
        ({"kind": "twin-wing", "differs": None}, True),
        ({"kind": "other-storey", "differs": 0.1}, True),
    ],
)
def test_pairs_that_anybody_could_tell(change, is_fair):
    assert is_distinguishable({**ROW, **change}) == is_fair


def test_bins_of_the_area_in_common():
    assert [classify_pair({**ROW, "common": m2}) for m2 in (1.0, 40.0, 79.9, 80.0, 200.0)] == [
        "<40",
        "40-80",
        "40-80",
        "80-200",
        ">200",
    ]
    assert classify_pair({**ROW, "common": 0.9}) == classify_pair({**ROW, "overlap": 0}) == "none (overlap)"
    assert classify_pair({**ROW, "kind": "strangers"}) == "none (strangers)"


def test_a_feature_that_is_always_the_same_divides_nothing_by_zero() -> None:
    """As of few pairs, none of which has a ceiling; the weights are written with five decimals."""
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.normal(0, 2, 40), np.full(40, 0.3), rng.normal(0, 1e-7, 40)])
    assert compute_spread(x)[1:].tolist() == [1.0, 1.0] and compute_spread(x)[0] == pytest.approx(x[:, 0].std())
    model = fit_logistic(x, x[:, 0] > 0, ["walls", "ceilings", "hanging"], 1.0)
    assert min(round(s, 5) for s in model["scale"]) > 0 and model["weight"][0] > 1 and np.isfinite(model["weight"]).all()
