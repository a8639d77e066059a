"""How full the walls are stands beside what they show of a door."""

from __future__ import annotations

import numpy as np
import pytest

from tests.training.tiny import two_doors
from topomerge.extraction.elevations.elevation import BANDS, WALL_CLASSES, Elevations
from topomerge.extraction.elevations.wall_doors import LEAST_FILL, WALL_DOOR_FEATURES
from topomerge.training.wall_doors import find_candidates_of_map

FILL = WALL_DOOR_FEATURES.index("fill")


@pytest.mark.parametrize("share", [1.0, 0.3, 0.0])
def test_the_share_of_elements_with_points_is_heard(share: float):
    map, faces, strips, truth, _ = two_doors(0)
    held = strips * (np.random.default_rng(0).random(strips.shape) < share)
    walls = Elevations(faces, np.array([0, len(truth)]), (held / np.float32(255)).astype(np.float32))
    classes = np.eye(len(WALL_CLASSES))[truth[::2]]
    candidates = find_candidates_of_map(map, (), walls, classes)
    full = np.count_nonzero(held[..., :BANDS]) / held[..., :BANDS].size
    assert len(candidates.edges) and candidates.features[:, FILL] == pytest.approx(np.log(LEAST_FILL + full))


def test_a_map_without_walls_says_nothing_of_it():
    map = two_doors(0)[0]
    assert (find_candidates_of_map(map, (), None).features[:, FILL] == 0).all()


def test_rooms_without_a_wall_are_as_empty_as_walls_without_points():
    map, faces, strips, _, _ = two_doors(0)
    walls = Elevations(faces[:0], np.zeros(1, np.int64), strips[:0].astype(np.float32))
    candidates = find_candidates_of_map(map, (), walls, np.zeros((0, len(WALL_CLASSES))))
    assert len(candidates.edges) and candidates.features[:, FILL] == pytest.approx(np.log(LEAST_FILL))
