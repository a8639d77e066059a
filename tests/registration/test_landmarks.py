"""Landmarks in registration: they enter the posterior, settle twins, and change nothing where there are none."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.landmarks.evidence import LandmarkEvidence, score_landmarks
from topomerge.registration.pipeline import register
from topomerge.registration.posterior import MOST_BY_LANDMARKS, POSTERIOR, update_posterior
from topomerge.types import Sim3, build_landmarks, move_landmarks

EACH = {**dict.fromkeys(POSTERIOR, 0.1), "here": 0.4}


def doors(map):
    """Places beside the doors of a map."""
    return map.edges["centre"] + (0.0, 0.6, 1.5)


def with_signs(map, texts, kind="text"):
    at = doors(map)[: len(texts)]
    return replace(map, landmarks=build_landmarks(kind, texts, "test", at, sigma=0.2))


HALL = building(pairs=4)
NUMBERS = [f"2.11{k}" for k in range(8)]


def twin(map):
    """The same walls in another file: the cells in another frame."""
    return replace(map, grid=replace(map.grid, origin=map.grid.origin + (31.0, -12.0, 0.0)))


def told(map, texts, kind="text"):
    """The twin with signs."""
    own = with_signs(map, texts, kind)
    return replace(twin(map), landmarks=move_landmarks(own.landmarks, Sim3(translation=(31.0, -12.0, 0.0))))


@pytest.fixture(scope="module")
def bare():
    return register(HALL, twin(HALL))


@pytest.fixture(scope="module")
def agree():
    """Both maps with the same signs."""
    return register(with_signs(HALL, NUMBERS), told(HALL, NUMBERS))


@pytest.mark.longer
def test_landmarks_of_one_map_alone_change_nothing(bare):
    one_sided = register(with_signs(HALL, NUMBERS), twin(HALL))
    assert one_sided.probability == bare.probability and one_sided.transform == bare.transform
    assert one_sided.posterior == bare.posterior and one_sided.features == bare.features
    assert one_sided.landmarks == bare.landmarks == LandmarkEvidence() and bare.walls == bare.probability


def test_signs_that_agree_raise_and_those_that_contradict_refuse(bare, agree):
    other = register(with_signs(HALL, NUMBERS), told(HALL, [t.replace("2.1", "3.1") for t in NUMBERS]))
    assert agree.probability > bare.probability and "agree" in agree.landmarks.list_sentences()[0]
    assert other.probability < 0.05 and other.posterior["storey"] + other.posterior["wing"] > 0.8
    assert "contradict" in other.landmarks.list_sentences()[0] and "agree" not in other.landmarks.list_sentences()[0]
    assert sum(agree.posterior.values()) == pytest.approx(1.0) and other.walls > other.probability


@pytest.mark.longer
def test_signs_choose_among_places_that_walls_do_not_tell_apart(agree):
    shifted = [*NUMBERS[2:], "2.118", "2.119"]  # the same walls, two rooms on along the corridor
    second = register(with_signs(HALL, NUMBERS), told(HALL, shifted))
    at = doors(HALL)[:1]
    off = np.linalg.norm(second.transform.apply(at) - agree.transform.apply(at))
    assert off > 3.0 or second.probability < 0.2


@pytest.mark.longer
def test_the_order_of_the_maps_does_not_matter():
    a, b = with_signs(HALL, NUMBERS), told(HALL, [*NUMBERS[:5], "9.999"])
    one, other = register(a, b), register(b, a)
    assert one.probability == other.probability and one.posterior == other.posterior
    assert one.transform.matrix == pytest.approx(np.linalg.inv(other.transform.matrix))
    assert {w.values for w in one.landmarks.witnesses} == {w.values[::-1] for w in other.landmarks.witnesses}


def test_what_walls_do_not_carry_is_believed_at_a_lower_trust():
    evidence = score_landmarks(with_signs(HALL, NUMBERS), with_signs(HALL, NUMBERS), Sim3())
    low = update_posterior(EACH, 0.61, evidence)
    assert low["here"] == pytest.approx(MOST_BY_LANDMARKS) and sum(low.values()) == pytest.approx(1.0)
    high = update_posterior({**dict.fromkeys(POSTERIOR, 0.05), "here": 0.7}, 0.61, evidence)
    assert high["here"] > MOST_BY_LANDMARKS
    assert update_posterior(EACH, 0.61, LandmarkEvidence()) == EACH


def test_alternatives_that_the_user_rules_out_stay_ruled_out():
    evidence = score_landmarks(with_signs(HALL, NUMBERS), with_signs(HALL, [t.replace("2.", "3.") for t in NUMBERS]), Sim3())
    known = {**dict.fromkeys(POSTERIOR, 0.0), "here": 0.8, "wing": 0.2}
    assert update_posterior(known, 0.61, evidence)["storey"] == 0.0


@pytest.mark.longer
def test_hostile_landmarks_do_no_harm(bare):
    texts = ["101"] * 8
    same = register(with_signs(HALL, texts), told(HALL, texts))
    assert abs(same.probability - bare.probability) < 0.1
    nan = replace(HALL, landmarks=build_landmarks("text", NUMBERS, "x", np.full((8, 3), np.nan)))
    assert register(nan, told(HALL, NUMBERS)).probability == bare.probability
