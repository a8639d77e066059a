"""What a pair of maps may be: probabilities of named alternatives, what the user knows, and thresholds from a stated risk."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.registration.posterior import (
    FEW,
    KINDS,
    POSTERIOR,
    PRIORS,
    SAME,
    WORDS,
    WRONG,
    check_same,
    compute_evidence_limit,
    compute_posterior,
    describe_posterior,
    find_threshold,
    limit_posterior,
)

MODEL = {"mean": [0.0, 1.0], "scale": [1.0, 2.0], "weight": [[1, 0], [0, 1], [0, 0], [-1, 0], [0, -1]], "bias": [0, 0.5, 0, 1, 0]}
X = np.array([0.3, -1.0])


def test_the_alternatives_sum_to_one_and_follow_their_model():
    each = compute_posterior(0.6, 0.0, MODEL, X)
    assert tuple(each) == POSTERIOR and sum(each.values()) == pytest.approx(1.0) and each["here"] == pytest.approx(0.6)
    scores = np.array([0.3, -0.5, 0.0, 0.7, 1.0])
    assert each["half"] == 0 and [each[n] for n in KINDS] == pytest.approx((0.4 * np.exp(scores) / np.exp(scores).sum()).tolist())
    assert sum(PRIORS.values()) == pytest.approx(1.0) and set(PRIORS) == set(POSTERIOR) == set(WORDS)


@pytest.mark.parametrize("here", [0.0, 0.01, 0.5, 0.999, 1.0])
def test_knowing_more_never_lowers_a_place(here):
    nothing, building, storey = (compute_posterior(here, 0.4, MODEL, X, same) for same in ("nothing", "building", "storey"))
    assert nothing["here"] <= building["here"] <= storey["here"]
    assert building["building"] == storey["building"] == storey["storey"] == 0 < building["storey"]
    for each in (nothing, building, storey):
        assert sum(each.values()) == pytest.approx(1.0)
    assert (here == 0) == (storey["half"] == 0)  # another half is possible on one storey, too
    odds = nothing["wing"] * building["outside"], nothing["outside"] * building["wing"]
    assert odds[0] == pytest.approx(odds[1])  # what is left keeps its odds


@pytest.mark.parametrize("plan", [0.0, 0.5, 3.0])
def test_another_place_of_the_plan_takes_its_odds_from_this_one_alone(plan):
    usual, each = compute_posterior(0.8, 0.0, MODEL, X), compute_posterior(0.8, plan, MODEL, X)
    assert sum(each.values()) == pytest.approx(1.0) and each["here"] == pytest.approx(1 / (1 / 0.8 + plan))
    added = {name: each[name] / each["here"] - usual[name] / usual["here"] for name in WRONG}
    assert sum(added.values()) == pytest.approx(plan) and added["half"] == pytest.approx(plan * 0.03 / 0.11)
    assert added["storey"] == pytest.approx(plan * 0.08 / 0.11) and added["wing"] == pytest.approx(0.0)


def test_what_little_evidence_can_carry():
    assert compute_evidence_limit({"walls": 0.9, "free": 50.0}) == compute_evidence_limit({"walls": 9.0, "free": 5.9}) == FEW
    assert compute_evidence_limit({"walls": 3.0, "free": 30.0}) == 1.0
    each = compute_posterior(0.95, 0.0, MODEL, X)
    less = limit_posterior(each, FEW)
    assert less["here"] == FEW and sum(less.values()) == pytest.approx(1.0) and less["wing"] == pytest.approx(10 * each["wing"])
    assert limit_posterior(each, 1.0) == each
    sure = limit_posterior({"here": 1.0, **dict.fromkeys(WRONG, 0.0)}, FEW)
    assert sure["here"] == FEW and sum(sure.values()) == pytest.approx(1.0)


def test_the_threshold_follows_from_the_risk():
    curve = [(0.5, 30.0), (0.7, 12.0), (0.9, 2.0), (0.99, 0.5)]
    assert [find_threshold(r, curve) for r in (1000, 30, 12, 11, 1)] == [0.5, 0.5, 0.7, 0.9, 0.99]
    with pytest.raises(InputError, match=r"risk 0.1: .* 0.5 in a thousand"):
        find_threshold(0.1, curve)
    for wrong in (0.0, -1.0, 1001.0, float("nan")):
        with pytest.raises(InputError, match="risk must be"):
            find_threshold(wrong, curve)


def test_a_sure_place_on_an_unsure_storey_is_told_so():
    each = {"here": 0.55, "elsewhere": 0.01, "storey": 0.41, "half": 0.0, "wing": 0.01, "building": 0.01, "outside": 0.01}
    assert describe_posterior(each, 0.8) == "the position is certain (0.96), the storey is not (0.55 for this one)"
    twin = {**each, "storey": 0.01, "wing": 0.41}
    assert describe_posterior(twin, 0.8).startswith("it could also be a wing") and "0.41" in describe_posterior(twin, 0.8)
    assert describe_posterior({**each, "here": 0.9, "storey": 0.06}, 0.8) == ""
    assert describe_posterior(dict.fromkeys(POSTERIOR, 0.1), 0.8) == ""  # nothing stands out


def test_other_words_for_what_is_known_are_refused():
    for same in SAME:
        check_same(same)
    with pytest.raises(InputError, match="same must be nothing, building, storey, not 'floor'"):
        check_same("floor")
