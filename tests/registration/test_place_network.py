"""What the network of places sees: which map comes first changes nothing, turning turns, what both show is told from what one
misses."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.registration.places import (
    LOOKED,
    MOST_ODDS,
    PARTS,
    PLANES,
    SIDE,
    Crops,
    Places,
    compute_place_log_odds,
    compute_planes,
)
from topomerge.types import Sim3

BIT = {name: 1 << k for k, name in enumerate(PARTS)}
AGREE, CLASH = 3, 4  # planes of walls


def squares(seed: int = 0, count: int = 3) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    ground = rng.choice(np.array([0, BIT["wall"], BIT["free"], BIT["clutter"] | BIT["low"]], np.uint8), (count, 2, 16, 16))
    parts = ground.repeat(4, axis=2).repeat(4, axis=3) | np.where(rng.random((count, 2, SIDE, SIDE)) < 0.5, BIT["ceiling"], 0)
    ceiling = rng.integers(1, 200, parts.shape).astype(np.uint8)
    looked = (rng.random((count, 2, LOOKED)) < 0.7).astype(np.float32)
    return parts.astype(np.uint8), ceiling, looked


def test_which_map_is_first_changes_nothing():
    parts, ceiling, looked = squares()
    one, other = compute_planes(parts, ceiling, looked), compute_planes(parts[:, ::-1], ceiling[:, ::-1], looked[:, ::-1])
    assert one.shape == (3, SIDE // 4, SIDE // 4, PLANES) and np.allclose(one, other, atol=1e-6)


def test_turned_squares_give_turned_planes():
    parts, ceiling, looked = squares()
    turned = compute_planes(np.rot90(parts, 1, (2, 3)), np.rot90(ceiling, 1, (2, 3)), looked)
    assert np.allclose(np.rot90(compute_planes(parts, ceiling, looked), 1, (1, 2)), turned, atol=1e-6)


def test_walls_that_meet_and_walls_on_free_floor():
    parts = np.full((1, 2, SIDE, SIDE), BIT["free"], np.uint8)
    parts[0, :, 10] = BIT["wall"]  # in both
    parts[0, 0, 40] = BIT["wall"]  # in one, free in the other
    parts[0, 0, 50], parts[0, 1, 52] = BIT["wall"], BIT["wall"]  # as far apart as bent maps may be
    seen = compute_planes(parts, np.zeros_like(parts), np.ones((1, 2, LOOKED), np.float32))[0]
    assert seen[2, :, AGREE].min() > 0 and seen[2, :, CLASH].max() == 0
    assert seen[10, :, CLASH].min() > 0 and seen[10, :, AGREE].max() == 0
    assert seen[12:14, :, AGREE].max() > 0 and seen[12:14, :, CLASH].max() == 0


def test_what_a_map_did_not_look_at_is_no_contradiction():
    parts = np.full((1, 2, SIDE, SIDE), BIT["free"], np.uint8)
    parts[0, 0, 20:30, 20:30] = BIT["clutter"] | BIT["low"]
    both, blind = np.ones((1, 2, LOOKED), np.float32), np.ones((1, 2, LOOKED), np.float32)
    blind[0, 0, 1] = blind[0, 1, 1] = 0
    low_missing = 8
    assert compute_planes(parts, np.zeros_like(parts), both)[..., low_missing].max() > 0
    assert compute_planes(parts, np.zeros_like(parts), blind)[..., low_missing].max() == 0


def test_no_squares_give_nothing():
    assert compute_place_log_odds(Crops.none()).shape == (0,) and compute_planes(*squares(count=0)).shape == (
        0,
        SIDE // 4,
        SIDE // 4,
        PLANES,
    )
    assert Places(Crops.none(), np.zeros(0)).features == {"place_mean": 0.0, "place_worst": 0.0, "place_area": 0.0}


def test_the_mean_and_the_worst_of_places_by_hand():
    crops = Crops(*squares(count=4), np.zeros((4, 3)), np.array([10.0, 10.0, 10.0, 20.0]))
    found = Places(crops, np.array([9.0, -9.0, 1.0, 2.0])).features
    assert found["place_mean"] == pytest.approx((MOST_ODDS - MOST_ODDS + 1 + 4) / 5) and found["place_area"] == 50
    assert found["place_worst"] == pytest.approx((-MOST_ODDS + 1) / 2)  # the worst third of the floor
    back = Places(crops, np.arange(4.0)).inverse(Sim3(0.0, (1.0, 0.0, 0.0)))
    assert (back.crops.parts == crops.parts[:, ::-1]).all() and (back.crops.middle[:, 0] == -1).all()
