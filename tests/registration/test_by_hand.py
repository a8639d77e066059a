"""Maps that somebody brings together: matched rooms, or a map that was moved, end where the walls meet."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, truth
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.fusion.decisions import estimate_matched_poses, place_by_hand
from topomerge.fusion.fuse import match_common_rooms
from topomerge.matching.poses import pose_difference
from topomerge.registration.prepared import prepare
from topomerge.types import Sim3


@pytest.fixture(scope="module")
def pair():
    """Two prepared maps of one office, their true pose, and the rooms that are one."""
    a, b = office_map(0), office_map(2)
    pose = truth(0, 2)
    rooms, _ = match_common_rooms(a, b, pose)
    assert len(rooms) >= 2
    return prepare(a), prepare(b), pose, [(int(i), int(j)) for i, j in rooms]


def off(pose: Sim3, truth: Sim3, middle) -> float:
    return float(pose_difference(pose, truth, middle)[0])


@pytest.mark.longer
def test_matched_rooms_end_in_the_true_pose(pair):
    a, b, pose, rooms = pair
    placed = place_by_hand(a, b, rooms)
    assert placed.snapped and off(placed.pose, pose, b.middle) < 0.1
    assert placed.registration is not None and 0 < placed.probability < 1
    assert placed.start == estimate_matched_poses(a, b, rooms)[0] == estimate_matched_poses(a.load(), b.load(), rooms)[0]


@pytest.mark.longer
def test_a_map_that_was_moved_by_hand_snaps(pair):
    a, b, pose, _ = pair
    middle = pose.apply(b.middle[None])[0]
    for shift, turn in (((1.5, -1.0), 0.15), ((-1.8, 0.4), -0.2)):
        turned = Sim3(pose.yaw + turn)
        x, y, z = (middle - turned.apply(b.middle[None])[0] + (*shift, 0.0)).tolist()
        placed = place_by_hand(a, b, Sim3(pose.yaw + turn, (x, y, z)))
        assert placed.snapped and off(placed.pose, pose, b.middle) < 0.1


@pytest.mark.longer
def test_a_map_far_from_all_walls_stays_where_it_was_put(pair):
    a, b, pose, _ = pair
    far = Sim3(pose.yaw, tuple(np.add(pose.translation, (300.0, 0.0, 0.0)).tolist()))
    placed = place_by_hand(a, b, far)
    assert off(placed.pose, far, b.middle) < 0.6 and placed.probability < 0.5


def test_rooms_that_fix_no_pose_are_told():
    a, b = prepare(building(1)), prepare(building(2))
    i, j = 0, 0
    for pairs, words in (
        ([(i, j)], "1 matched pair of rooms fix no pose"),
        ([(i, j), (i, j + 1)], "fix no pose"),
        ([(i, j), (999, 0)], "has no room 999"),
        ([(i, j), (0, -1)], "has no room -1"),
    ):
        with pytest.raises(InputError, match=words):
            place_by_hand(a, b, pairs)
