"""The fits of the belief in merges, on made-up features."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.training.merge_belief import compute_spread, fit_logistic


def test_a_feature_that_is_always_the_same_divides_nothing_by_zero() -> None:
    """As of few pairs, none of which has a ceiling; the weights are written with five decimals."""
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.normal(0, 2, 40), np.full(40, 0.3), rng.normal(0, 1e-7, 40)])
    assert compute_spread(x)[1:].tolist() == [1.0, 1.0] and compute_spread(x)[0] == pytest.approx(x[:, 0].std())
    model = fit_logistic(x, x[:, 0] > 0, ["walls", "ceilings", "hanging"], 1.0)
    assert min(round(s, 5) for s in model["scale"]) > 0 and model["weight"][0] > 1 and np.isfinite(model["weight"]).all()
