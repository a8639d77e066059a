"""Windows of which the two faces of a wall show different ends.

How full the walls are stands beside what they show of a door.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.training.tiny import two_doors
from topomerge.extraction.elevations.doorways import HALF_WALL
from topomerge.extraction.elevations.elevation import (
    ACROSS,
    BANDS,
    BEFORE,
    DEPTHS,
    FACE_DTYPE,
    LOWEST,
    STRIP_CHANNELS,
    UPWARDS,
    WALL_CLASSES,
    Elevations,
)
from topomerge.extraction.elevations.wall_doors import LEAST_FILL, WALL_DOOR_FEATURES
from topomerge.extraction.elevations.windows import detect_windows
from topomerge.training.wall_doors import find_candidates_of_map

WALL = 12  # element across, in which the wall lies
PLACE_COUNT = 80  # of a wall of 8 m


def seen_window(empty: tuple[slice, slice], likely: tuple[float, float]) -> np.void:
    """The one window that both faces of a wall show, empty in so many bands of each."""
    across = 2 * ((WALL + 0.5) * ACROSS - BEFORE + HALF_WALL)
    faces = np.array([(0, (0, 3), (1, 0), (0, 1), 8.0, 0.0), (1, (8, 3 + across), (-1, 0), (0, -1), 8.0, 0.0)], FACE_DTYPE)
    strips = np.zeros((2, 2 * PLACE_COUNT, DEPTHS, STRIP_CHANNELS), np.float32)
    strips[:, :, WALL, :BANDS] = 0.8
    chance = np.zeros((2, PLACE_COUNT))
    for k, (low, high) in enumerate(((30, 42), (38, 50))):
        strips[k, 2 * low : 2 * high, WALL, empty[k]] = 0.0
        chance[k, low:high] = likely[k]
    ends = 2 * PLACE_COUNT * np.arange(3)
    (window,) = detect_windows(Elevations(faces, ends, strips.reshape(-1, *strips.shape[2:])), chance.ravel())
    return window


def band(number: int) -> float:
    return LOWEST + UPWARDS * number


def test_what_one_face_shows_of_an_end_is_taken():
    window = seen_window((slice(4, BANDS), slice(0, 9)), (0.95, 0.9))
    assert sorted(window["rooms"].tolist()) == [0, 1] and window["width"] == pytest.approx(1.2)
    assert (window["sill"], window["head"]) == pytest.approx((band(4), band(9)))


@pytest.mark.parametrize(("likely", "sill", "head"), [((0.95, 0.9), band(8), np.nan), ((0.9, 0.95), np.nan, band(5))])
def test_a_head_below_the_sill_is_that_of_the_likelier_face(likely: tuple[float, float], sill: float, head: float):
    window = seen_window((slice(8, BANDS), slice(0, 5)), likely)
    assert (window["sill"], window["head"]) == pytest.approx((sill, head), nan_ok=True)


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
