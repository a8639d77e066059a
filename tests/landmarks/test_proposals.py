"""Poses that landmarks propose."""

from dataclasses import replace

import numpy as np
import pytest

from tests.landmarks.test_evidence import HALL, NUMBERS, places, with_signs
from topomerge.landmarks.evidence import LandmarkScorer
from topomerge.landmarks.map_search import build_landmark_index, list_strings
from topomerge.landmarks.proposals import MOST_PROPOSED, propose_poses
from topomerge.landmarks.sightings import MOST_SIGHTINGS
from topomerge.types import Sim3, build_landmarks, move_landmarks

TRUE = Sim3(2.1, (30.0, -7.0, 0.6))


def moved(map, pose=TRUE):
    """The map in another frame, of which T_ab is `pose`."""
    return replace(map, landmarks=move_landmarks(map.landmarks, pose.inverse()))


def off(pose, at):
    return float(np.linalg.norm(pose.apply(TRUE.inverse().apply(at)) - at, axis=1).max())


def test_two_signs_give_the_pose():
    at = places(6, 3.0)
    a = with_signs(NUMBERS, at)
    best = propose_poses(LandmarkScorer(a, moved(a)))[0]
    assert off(best, at) < 1e-6 and best.yaw == pytest.approx(TRUE.yaw)


def test_wrong_matches_are_outvoted():
    at = places(8, 3.0)
    texts = [*NUMBERS, "7.001", "7.002"]
    a, b = with_signs(texts, at), moved(with_signs([*NUMBERS, "7.002", "7.001"], at))
    assert off(propose_poses(LandmarkScorer(a, b))[0], at[:6]) < 0.3


def test_a_free_scale_comes_from_two_signs():
    at = places(4, 3.0)
    a = with_signs(NUMBERS[:4], at)
    pose = replace(TRUE, scale=0.6)
    best = propose_poses(LandmarkScorer(a, moved(a, pose)), scaled=True)[0]
    assert best.scale == pytest.approx(0.6) and np.allclose(best.apply(pose.inverse().apply(at)), at)


def test_one_tag_that_faces_a_known_way_gives_the_pose():
    at = places(1)
    a = with_signs(["tag36h11:5"], at, kind="tag", number=0.4)
    assert off(propose_poses(LandmarkScorer(a, moved(a)))[0], at) < 1e-6


def test_one_sign_is_tried_in_line_with_the_walls_on_the_nearest_floor():
    at = places(1)
    a = with_signs(["2.113"], at)
    poses = propose_poses(LandmarkScorer(a, moved(a)), yaws=[0.0, TRUE.yaw, 1.0], heights=[0.5, 3.5])
    assert [p.yaw for p in poses] == pytest.approx([0.0, TRUE.yaw, 1.0])
    assert all(p.translation[2] == 0.5 for p in poses) and off(poses[1], at) == pytest.approx(0.1)


def test_strings_that_stand_everywhere_or_nowhere_propose_nothing():
    many = with_signs(["EXIT", "WC", *["101"] * 6], places(8))
    assert propose_poses(LandmarkScorer(many, moved(many)), yaws=[0.0]) == []
    lost = replace(HALL, landmarks=build_landmarks("text", NUMBERS, "x"))
    assert propose_poses(LandmarkScorer(lost, lost), yaws=[0.0]) == []


def test_heights_that_are_not_known_are_those_of_the_floors():
    at = places(3, 3.0)
    a, b = with_signs(NUMBERS[:3], at), moved(with_signs(NUMBERS[:3], at))
    for map in (a, b):
        map.landmarks.table["position"][:, 2] = np.nan
    two = [replace(map, storeys=np.repeat(map.storeys, 2)) for map in (a, b)]
    best = propose_poses(LandmarkScorer(*two), heights=[3.2])[0]
    assert best.translation[2] == 3.2 and best.yaw == pytest.approx(TRUE.yaw)


@pytest.mark.longer
@pytest.mark.parametrize("count", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_many_signs_propose_within_bounds(count):
    """Hostile: of both maps the surest and rarest are looked at; poses are few and finite, and so are strings of an index."""
    rng = np.random.default_rng(0)
    many = build_landmarks("text", [f"{k}.{k % 97}" for k in range(2000)], "hostile")
    table = np.repeat(many.table[:1], count)
    table["value"], table["position"] = rng.integers(2000, size=count), rng.uniform(0, 20, (count, 3))
    hostile = replace(HALL, landmarks=replace(many, table=table))
    poses = propose_poses(LandmarkScorer(hostile, moved(hostile)))
    assert len(poses) <= MOST_PROPOSED and all(np.isfinite(pose.matrix).all() for pose in poses)
    assert len(list_strings(hostile)) <= MOST_SIGHTINGS
    index = build_landmark_index([hostile, HALL, hostile])
    assert [k for k, _ in index.rank(hostile, but=0)] == [2] and index.rank(HALL) == []
