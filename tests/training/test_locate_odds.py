"""The odds of where a scan was taken: a choice that features decide is learned, and "nowhere" where none fits."""

from __future__ import annotations

import json

import numpy as np
import pytest

from topomerge.archive import find_weights_file
from topomerge.fusion.atlas.locate import JudgedPose, compute_nowhere, compute_probabilities, load_odds
from topomerge.fusion.atlas.place_index import FEATURES
from topomerge.training.locate_odds import LocateRows, fit_choice, score_choices
from topomerge.types import Sim3


def draw_rows(count: int, seed: int) -> list[LocateRows]:
    """Scans of which the right pose has a high first feature; every third one has no right pose."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(count):
        x = rng.normal(size=(8, len(FEATURES)))
        y = np.zeros(8, bool)
        if k % 3:
            y[k % 8] = True
            x[y, 0] += 8.0
        rows.append(LocateRows(k, x, y))
    return rows


def test_a_choice_is_learned_and_holds_on_other_scans() -> None:
    found = fit_choice(draw_rows(90, 0))
    assert found.weight[0] > 1.0 and np.abs(found.weight[1:]).max() < 0.3 * found.weight[0] and found.nowhere > 0
    scores = score_choices(draw_rows(60, 1), found)
    assert scores["log_loss"] < 0.5 and scores["right"] > 0.4 and scores["wrong"] <= 0.05


def test_the_weights_that_ship_are_of_these_features() -> None:
    held = load_odds()
    assert held["names"] == list(FEATURES) and len(held["weight"]) == len(FEATURES) and held["nowhere"] > 0
    assert json.loads(find_weights_file("topomerge.fusion.atlas", "locate_odds.json").read_text()) == held
    weight = dict(zip(held["names"], held["weight"], strict=True))
    assert weight["sharp"] > 0 and weight["agree"] > 0 and weight["conflict"] < 0 and weight["off"] < 0


def test_nowhere_is_likelier_where_all_poses_are_good() -> None:
    """A pose that stands out is believed; the same one among many that are nearly as good is not."""
    out, among = ([JudgedPose(0, Sim3(), np.zeros(len(FEATURES)), o) for o in [14.0, *[rest] * 23]] for rest in (3.0, 13.0))
    assert compute_nowhere(out) < compute_nowhere(among)
    assert compute_nowhere([]) == pytest.approx(load_odds()["nowhere"] + load_odds()["chance"] * load_odds()["usual"])


def test_probabilities_of_poses_and_of_nowhere_sum_to_one() -> None:
    poses = [JudgedPose(0, Sim3(), np.zeros(len(FEATURES)), odds) for odds in (12.0, 12.0, -900.0)]
    chances, nowhere = compute_probabilities(poses, 10.0)
    assert chances.sum() + nowhere == pytest.approx(1.0) and chances[0] == chances[1] > nowhere > chances[2] == 0.0
