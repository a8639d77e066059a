"""How likely hypotheses and matches are: features by hand, and what more evidence does."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.matching.consistency import (
    HYPOTHESIS,
    MATCH,
    compute_hypothesis_features,
    compute_hypothesis_probability,
    compute_match_features,
    compute_match_probability,
    load_odds_weights,
)


def test_features_of_a_hypothesis():
    """20 m of walls agree, 3 m conflict, 50 m2 of floor in common: a score of 20 - 2 * 3 + 0.1 * 50."""
    features = compute_hypothesis_features(np.array([[20.0, 3.0, 50.0], [0.0, 0.0, 0.0]]))
    assert features == pytest.approx(np.array([[1.0, np.log(21.0), 3 / 23, 1.9], [1.0, 0.0, 0.0, 0.0]]))


def test_hypotheses_share_what_none_of_them_leaves():
    alike = compute_hypothesis_probability(np.array([[40.0, 1.0, 100.0]] * 2))
    alone = compute_hypothesis_probability(np.array([[40.0, 1.0, 100.0]]))
    assert alike[0] == alike[1] < alone[0] < 1 and alike.sum() < 1
    odds = alone[0] / (1 - alone[0])  # against "none of them", which does not depend on how many there are
    assert alike == pytest.approx([odds / (2 * odds + 1)] * 2)


def test_probabilities_are_those_of_the_logistic_models():
    evidence = np.array([[3.0, 2.0, 5.0]])
    logit = float((compute_hypothesis_features(evidence) @ load_odds_weights(HYPOTHESIS))[0])
    assert compute_hypothesis_probability(evidence) == pytest.approx([1 / (1 + np.exp(-logit))])
    a, b, rooms, fit = building(2), building(2), np.array([[0, 1]]), np.array([0.4])
    a.rooms["area"][0] = 3.0
    expected = 1 / (1 + np.exp(-compute_match_features(a, b, rooms, fit) @ load_odds_weights(MATCH)))
    assert compute_match_probability(a, b, rooms, fit) == pytest.approx(expected)


def test_conflict_speaks_against_a_hypothesis():
    agreeing, conflicting = (compute_hypothesis_probability(np.array([[40.0, c, 100.0]]))[0] for c in (0.0, 15.0))
    assert agreeing > conflicting


def test_features_of_a_match():
    a, b = building(2), building(2)
    a.rooms["area"], b.rooms["area"] = (12.0, 0.1, 30.0, 8.0, 9.0), (10.0, 20.0, 4.0, 8.0, 9.0)
    a.rooms["completeness"], b.rooms["completeness"] = (0.5, 1.0, 0.6, 0.9, 0.8), (0.2, 0.7, 0.59, 1.0, 1.0)
    a.rooms["glimpsed"] = ~a.rooms["glimpsed"]  # that it was only looked into is another thing, and counts for nothing here
    rooms, fit = np.array([[0, 0], [1, 1], [2, 2], [3, 3], [3, 4]]), np.array([0.9, 0.8, 0.7, 0.6, 0.5])
    features = compute_match_features(a, b, rooms, fit)
    assert features[:, :2] == pytest.approx(np.column_stack([np.ones(5), fit]))
    assert np.exp(features[:, 2]) == pytest.approx([10.0, 0.5, 4.0, 8.0, 8.0])  # the smaller room, a scrap at least
    assert features[:, 3].tolist() == [2, 0, 1, 0, 0]
    assert features[:, 4].tolist() == [0, 0, 0, 1, 1]  # room 3 of a is cut in two
    turned = compute_match_features(b, a, rooms[:, ::-1], fit)
    assert turned == pytest.approx(features)


def test_rooms_that_fit_well_are_likelier_one_than_glimpsed_scraps():
    a, b = building(2), building(2)
    a.rooms["area"][2], a.rooms["completeness"][2] = 0.3, 0.2
    good, poor, scrap = compute_match_probability(a, b, np.array([[0, 0], [1, 1], [2, 2]]), np.array([0.95, 0.2, 0.2]))
    assert 1 > good > poor > scrap > 0
