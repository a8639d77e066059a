"""Radio as evidence and as search: laws of likeness, robustness, frames, hostile readings."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.landmarks.radio_worlds import SETTINGS, build, hear, spoof
from topomerge.archive import find_weights_file, read_weights_json
from topomerge.errors import InputError
from topomerge.landmarks.radio import (
    MOST_ADDRESSES,
    MOST_RATIO,
    MOST_SCANS,
    RADIO_LAW_FILE,
    WRONG,
    collect_radio_scans,
    compare_scans,
    convert_law,
    load_radio_law,
    score_radio,
)
from topomerge.landmarks.radio_search import build_radio_index, compute_pose_features, propose_radio_poses, rank_maps
from topomerge.registration.posterior import POSTERIOR
from topomerge.registration.posterior import WRONG as ALTERNATIVES
from topomerge.types import Landmarks, Sim3, build_landmarks, join_landmarks

FRAME = Sim3(0.7, (12.0, -5.0, 0.0))
NOTHING = dict.fromkeys(POSTERIOR, 0.0)


def readings(*scans: dict[str, float], at: object = None) -> Landmarks:
    """Scans, each a table of addresses and dBm, 1 m apart or at the places that are given."""
    values = [name for scan in scans for name in scan]
    group = [k for k, scan in enumerate(scans) for _ in scan]
    place = np.array([[k, 0.0, 1.2] for k in range(len(scans))] if at is None else at)
    number = [dbm for scan in scans for dbm in scan.values()]
    return build_landmarks("radio", values, "test", place[group], number=number, group=group)


def move(pose: Sim3, x: float, y: float) -> Sim3:
    return Sim3(0.0, (x, y, 0.0)) @ pose


def test_alternatives_are_those_of_the_posterior():
    assert WRONG == ALTERNATIVES


def test_readings_become_scans():
    heard = readings({"AA": -50, "bb": -70}, {"aa": -60})
    twice = join_landmarks([heard, readings({"aa": -40})])
    scans = collect_radio_scans(twice)
    assert len(scans) == 2 and scans.addresses == ("aa", "bb")
    power = scans.power.toarray()
    assert power[0, 0] == pytest.approx(np.expm1(55 / 12)) and power[1, 0] == pytest.approx(np.expm1(35 / 12))
    hostile = readings({"a": np.nan, "b": np.inf, "c": 1e9, "d": -500.0, "e": -60.0})
    assert collect_radio_scans(hostile).power.nnz == 1
    lost = build_landmarks("radio", ["a"], "test", np.full((1, 3), np.nan), number=-50.0)
    assert len(collect_radio_scans(lost)) == 0 and len(collect_radio_scans(lost, placed=False)) == 1
    assert len(collect_radio_scans(Landmarks())) == 0


def test_one_group_at_two_places_is_two_scans():
    joined = build_landmarks("radio", ["a", "a"], "test", np.array([[0, 0, 0], [9.0, 0, 0]]), number=-50.0, group=4)
    assert len(collect_radio_scans(joined)) == 2


def test_likeness_falls_with_distance_in_free_space():
    """Two access points 40 m apart, 20 dB a decade: the cosine of the powers is known, and falls along the line between them."""
    at = np.arange(2.0, 39.0)
    loss = [-40 - 20 * np.log10(np.array([x, 40 - x])) for x in at]
    scans = [dict(zip("ab", dbm, strict=True)) for dbm in loss]
    places = np.column_stack([at * 100, np.zeros(len(at)), np.zeros(len(at))])  # far apart: nothing is pooled
    all_scans = collect_radio_scans(readings(*scans, at=places))
    likeness = compare_scans(all_scans, all_scans).compute()
    power = np.expm1((np.array(loss) + 95) / 12)
    weight = np.sqrt(np.log1p(power.max(axis=0) / power.mean(axis=0)))
    spread = np.array([places[p >= p.max() / 2, 0].var() for p in power.T])
    v = power * weight / (1 + spread / 400)
    want = v @ v.T / np.outer(np.linalg.norm(v, axis=1), np.linalg.norm(v, axis=1))
    assert np.allclose(likeness, want, atol=1e-5)
    assert (np.diff(likeness[0]) < 1e-6).all() and likeness[0, -1] < 0.25


def test_gain_of_a_phone_changes_little():
    heard = hear()
    louder = replace(heard, table=heard.table.copy())
    louder.table["number"] -= 5
    scans = collect_radio_scans(heard), collect_radio_scans(louder)
    likeness = compare_scans(*scans).compute()
    assert np.median(np.diag(likeness)) > 0.97


def test_right_poses_are_told_from_wrong_ones():
    a, b = build(hear(2, 45)), build(hear(25, 68, session=1), FRAME)
    truth = FRAME.inverse()
    right = score_radio(a, b, truth)
    assert right["here"] == 0 and set(right) == set(POSTERIOR)
    assert all(right[name] < -4 for name in ("elsewhere", "storey", "half", "building", "outside"))
    for wrong in (move(truth, 20, 0), move(truth, -25, 8)):
        assert score_radio(a, b, wrong)["elsewhere"] > 2
    above = build(hear(25, 68, session=1, level=1), FRAME)
    assert score_radio(a, above, truth)["storey"] > 2
    other = build(hear(25, 68, session=1, seed=4), FRAME)
    assert score_radio(a, other, truth)["building"] > 2
    assert all(abs(v) <= MOST_RATIO for s in (right, score_radio(a, other, truth)) for v in s.values())


def test_scores_do_not_change_with_the_frame_and_are_symmetric():
    """Maps of which each has but a few scans, so that no score is at its limit."""
    a, b = build(hear(20, 26)), build(hear(23, 29, session=1))
    truth = Sim3()
    one = score_radio(a, b, truth)
    away = Sim3(2.1, (300.0, -40.0, 3.0))
    turned = score_radio(build(hear(20, 26), away), build(hear(23, 29, session=1), FRAME), away @ FRAME.inverse())
    assert [turned[n] for n in WRONG] == pytest.approx([one[n] for n in WRONG], abs=0.05)
    back = score_radio(b, a, truth)
    assert [back[n] for n in WRONG if n != "half"] == pytest.approx([one[n] for n in WRONG if n != "half"], abs=0.3)
    assert any(0.5 < abs(v) < MOST_RATIO for v in one.values())


@pytest.mark.longer
def test_one_address_decides_nothing():
    """Two buildings in which somebody runs an access point of one name: without it, nothing is alike."""
    a, b = build(spoof(hear(2, 40), "spoofed", -45)), build(spoof(hear(2, 40, session=1, seed=4), "SPOOFED", -45))
    for pose in (Sim3(), Sim3(0.0, (15.0, 0, 0))):
        scores = score_radio(a, b, pose)
        assert all(scores[name] > -0.5 for name in WRONG)
    assert not any(p.is_sure for p in propose_radio_poses(a, b))
    same = score_radio(build(spoof(hear(2, 45), "x", -40)), build(spoof(hear(25, 68, session=1), "x", -40)), Sim3())
    assert same["elsewhere"] < -2 and same["storey"] < -2  # one loud stranger among them does not spoil it
    single = build(readings(*[{"a": -50.0}] * 5)), build(readings(*[{"a": -50.0}] * 5))
    assert all(score_radio(*single, Sim3())[name] > -0.5 for name in WRONG)


@pytest.mark.longer
def test_poses_are_found_though_access_points_moved():
    settings = replace(SETTINGS, moved=0.3, missed=0.3)
    a, b = build(hear(2, 45, settings=settings)), build(hear(25, 68, session=1, settings=settings), FRAME)
    best = propose_radio_poses(a, b)[0]
    pose, score = best
    at = b.landmarks.table["position"]
    error = np.linalg.norm((pose.apply(at) - FRAME.inverse().apply(at))[:, :2], axis=1).mean()
    assert error < 4 and score == best.score > 5 and best.chance > 0.9 and pose.scale == 1
    again = propose_radio_poses(a, b)[0]
    assert again.pose == best.pose and np.array_equal(again.covariance, best.covariance)


@pytest.mark.longer
def test_a_pose_of_few_places_is_told_less_sure_than_its_law_has_it():
    """The odds that ship: surer with more places, a smaller standard deviation, a larger lead; and never surer than the law."""
    few, many = (propose_radio_poses(build(hear(2, last)), build(hear(2, last, session=1), FRAME)) for last in (12, 45))
    assert few[0].places < many[0].places and few[0].probability < many[0].probability
    margin = few[0].score - max([0.0, *(pose.score for pose in few[1:2])])
    assert np.allclose(compute_pose_features(few), [1.0, *np.log([few[0].sigma, margin, few[0].places])])
    weights = load_radio_law().pose_odds
    assert weights[1] < 0 < weights[2] and weights[3] > 0
    bare = propose_radio_poses(
        build(hear(2, 12)), build(hear(2, 12, session=1), FRAME), law=replace(load_radio_law(), pose_odds=())
    )
    assert bare[0].pose == few[0].pose and few[0].probability <= bare[0].probability
    assert sum(pose.probability for pose in few) <= 1.0 and type(few[0].probability) is float and type(few[0].is_sure) is bool


def test_maps_that_share_nothing_are_told_as_unsure():
    strangers = propose_radio_poses(build(hear(2, 40)), build(hear(2, 40, session=1, seed=4)))
    assert not any(p.is_sure for p in strangers)
    apart = propose_radio_poses(build(hear(2, 14)), build(hear(58, 68, session=1)))
    assert not any(p.is_sure for p in apart)


def test_hardly_anything_says_nothing():
    a, none = build(hear(2, 20)), build(Landmarks())
    assert score_radio(a, none, Sim3()) == score_radio(none, a, Sim3()) == score_radio(none, none, Sim3()) == NOTHING
    assert propose_radio_poses(a, none) == propose_radio_poses(none, none) == []
    one = build(readings({"a": -50, "b": -60, "c": -70}))
    assert propose_radio_poses(a, one) == [] and score_radio(a, one, Sim3(0, (1e6, 0, 0))) == NOTHING
    assert all(np.isfinite(v) for v in score_radio(one, one, Sim3()).values())
    signs = build(build_landmarks("text", ["101"], "x", np.zeros((1, 3))))
    assert score_radio(signs, a, Sim3()) == NOTHING
    broken = hear(2, 20)
    broken.table["position"][::3] = np.nan
    broken.table["number"][::5] = np.nan
    broken.table["position"][:, 2] = np.nan
    assert np.isfinite(compare_scans(collect_radio_scans(broken), collect_radio_scans(a.landmarks)).compute()).all()
    holed = replace(a, landmarks=broken)
    assert all(np.isfinite(v) for v in score_radio(holed, a, Sim3()).values()) and propose_radio_poses(holed, a)


@pytest.mark.longer
@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("names", [50, 20_000])
def test_many_readings_are_bounded(names, count):
    rng = np.random.default_rng(0)
    scan = rng.integers(0, 20_000, count)
    places = rng.uniform(0, 200, (20_000, 3)) * (1, 1, 0)
    values = [f"{k:x}" for k in rng.integers(0, names, len(scan)).tolist()]
    heard = build_landmarks("radio", values, "test", places[scan], number=rng.uniform(-90, -40, len(scan)), group=scan)
    scans = collect_radio_scans(heard)
    compared = compare_scans(scans, scans)
    assert len(scans) <= MOST_SCANS and compared.a.shape[1] <= MOST_ADDRESSES
    map = build(heard)
    scores = score_radio(map, map, Sim3())
    assert all(np.isfinite(v) for v in scores.values())
    assert len(rank_maps(build_radio_index([map]), heard)) == 1


def test_places_of_readings_are_found_in_an_index():
    maps = [build(hear(2, 40, seed=s)) for s in (3, 4, 5)]
    index = build_radio_index(maps)
    for k, seed in enumerate((3, 4, 5)):
        heard = hear(10, 20, session=1, seed=seed)
        ranks = rank_maps(index, heard)
        assert ranks[0].map == k and ranks[0].probability > 0.9 and ranks[0].likeness > 0.5
        one = heard.select(heard.table["group"] == heard.table["group"][0])
        one.table["position"] = np.nan  # a place is not needed
        assert rank_maps(index, one)[0].map == k
    assert rank_maps(index, readings({"unknown": -50})) == rank_maps(index, Landmarks()) == []
    assert rank_maps(build_radio_index([]), hear(2, 10)) == []


def test_storeys_of_one_map_are_told_apart_by_an_index():
    storeys = hear(2, 40, level=0), hear(2, 40, level=1)
    for level, heard in enumerate(storeys):
        heard.table["storey"] = level
    storeys[1].table["position"][:, 2] += 3.5
    storeys[1].table["group"] += 1000
    map = build(Landmarks())
    index = build_radio_index([replace(map, storeys=np.repeat(map.storeys, 2), landmarks=join_landmarks(storeys))])
    for level in (0, 1):
        best = rank_maps(index, hear(15, 30, session=1, level=level))[0]
        assert (best.map, best.storey) == (0, level)


def test_a_damaged_law_is_refused():
    data = json.loads(find_weights_file("topomerge.landmarks", RADIO_LAW_FILE).read_text())
    law = convert_law(data)
    assert np.array_equal(law.log_density, load_radio_law().log_density)
    assert np.exp(law.log_density).sum(axis=2) == pytest.approx(1, abs=0.05)
    assert read_weights_json("topomerge.landmarks", RADIO_LAW_FILE)["discount"] == law.discount
    nan = [[[float("nan")]]]
    for wrong in (
        {},
        {**data, "discount": -1},
        {**data, "blur": "x"},
        {**data, "pose_odds": [1.0]},
        {**data, "pose_odds": [float("nan")] * 4},
        {**data, "log_density": [[1.0]]},
        {**data, "log_density": nan},
    ):
        with pytest.raises(InputError, match=RADIO_LAW_FILE):
            convert_law(wrong)
