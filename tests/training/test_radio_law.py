"""The odds of a pose by radio: what is right where much testifies is learned, and judged on storeys that were left out."""

from __future__ import annotations

import numpy as np

from topomerge.landmarks.radio_search import RIGHT
from topomerge.training.radio_law import fit_left_out_odds, fit_pose_odds, measure_pose_loss
from topomerge.types import Array


def draw_trials(count: int, seed: int) -> Array:
    """Trials that are right the likelier the more places there are; the other features say nothing."""
    rng = np.random.default_rng(seed)
    features = np.column_stack([np.ones(count), rng.normal(size=(count, 2)), rng.uniform(2, 6, count)])
    right = rng.random(count) < 1 / (1 + np.exp(-2.0 * (features[:, 3] - 4.0)))
    return np.column_stack([features, np.where(right, 0.2 * RIGHT, 3 * RIGHT)])


def test_places_are_learned_to_tell_how_sure_a_pose_is() -> None:
    weights = fit_pose_odds(draw_trials(2000, 0))
    assert 1.6 < weights[3] < 2.4 and abs(weights[1]) < 0.3 and abs(weights[2]) < 0.3 and -9.6 < weights[0] < -6.4


def test_a_storey_is_judged_by_the_odds_of_the_others() -> None:
    trials = {name: draw_trials(300, seed) for seed, name in enumerate("abc")}
    strange = {**trials, "c": np.column_stack([trials["c"][:, :-1], 3 * RIGHT * (trials["c"][:, -1] <= RIGHT)])}
    assert measure_pose_loss(trials) < 0.5 < measure_pose_loss(strange)
    assert fit_left_out_odds(trials)["c"] == fit_left_out_odds(strange)["c"]
