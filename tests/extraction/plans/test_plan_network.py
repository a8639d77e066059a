"""What the network of the plans says of a drawn plan."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases import list_longer
from topomerge.extraction.plans import plan_network
from topomerge.extraction.plans.plan import build_profile_bands
from topomerge.extraction.plans.plan_network import (
    EVIDENCE_CHANNELS,
    compute_column_probabilities,
    compute_evidence,
    remove_furniture,
)
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES, StoreyPlan
from topomerge.kernels.rasters import PROFILE_BELOW
from topomerge.types import Array

WALL, FLOOR = ((1 << 24) - 1) << PROFILE_BELOW, 1 << PROFILE_BELOW


def drawn(wall: Array) -> StoreyPlan:
    """The plan of a raised grid map: walls of 2.4 m, a floor everywhere else but outside."""
    profile = np.where(wall, WALL, FLOOR).astype(np.uint64)
    none = np.full(wall.shape, np.nan)
    inside = ~wall
    inside[[0, -1]] = inside[:, [0, -1]] = False
    return StoreyPlan(np.zeros(2), 0.1, wall, inside, profile, build_profile_bands(0.1), np.zeros(wall.shape), none)


@pytest.fixture(scope="module")
def two_rooms() -> StoreyPlan:
    """5 m by 4 m each, with a door of 0.9 m and four legs of a table."""
    wall = np.zeros((106, 46), bool)
    wall[1:3], wall[-3:-1], wall[:, 1:3], wall[:, -3:-1], wall[52:54] = True, True, True, True, True
    wall[52:54, 18:27] = False
    for i, j in ((70, 15), (70, 21), (82, 15), (82, 21)):
        wall[i, j] = True
    return drawn(wall)


def test_what_it_sees(two_rooms: StoreyPlan) -> None:
    probability = compute_column_probabilities(two_rooms)
    assert probability.shape == (106, 46, len(COLUMN_CLASSES)) and np.allclose(probability.sum(axis=-1), 1, atol=1e-5)
    answer = probability.argmax(axis=-1)
    assert (answer[5:50, 5:41] == COLUMN_CLASSES.index("inside")).mean() > 0.95
    boundary = probability[..., 1:4].sum(axis=-1)  # a wall, or a door that is shut
    assert boundary[52:54, 5:15].max(axis=0).min() > 0.4 > boundary[20:40, 10:35].max()
    assert probability[52:54, 20:25, COLUMN_CLASSES.index("doorway")].mean() > 0.5


def test_furniture_is_no_wall(two_rooms: StoreyPlan) -> None:
    plan = remove_furniture(two_rooms, compute_column_probabilities(two_rooms))
    assert not plan.wall[65:90, 10:30].any() and plan.inside[65:90, 10:30].all()
    assert plan.wall[52:54, 5:15].any(axis=0).all() and not (plan.wall & plan.inside).any()


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_turned_and_shifted(two_rooms: StoreyPlan, turn: int) -> None:
    """A plan that is turned, mirrored and shifted by a few columns is classified alike."""
    wall = np.pad(two_rooms.wall, ((turn, 7), (3, turn)))
    there = compute_column_probabilities(drawn(np.rot90(wall, turn)[::-1])).argmax(axis=-1)[::-1]
    back = np.rot90(there, -turn)[turn : turn + 106, 3 : 3 + 46]
    same = back == compute_column_probabilities(two_rooms).argmax(axis=-1)
    assert same[4:-4, 4:-4].mean() > 0.97


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_turned_plan_has_turned_probabilities(two_rooms: StoreyPlan, turn: int) -> None:
    """Exactly, where its sides fit the network's coarsest level: all four sides are looked at from."""
    wall = np.pad(two_rooms.wall, ((3, 3), (1, 1)))  # 112 x 48
    turned = np.rot90(compute_column_probabilities(drawn(np.rot90(wall, turn))), -turn)
    assert np.abs(turned - compute_column_probabilities(drawn(wall))).max() < 1e-5


def test_evidence(two_rooms: StoreyPlan) -> None:
    x = compute_evidence(two_rooms)
    assert x.shape == (106, 46, EVIDENCE_CHANNELS) and x.dtype == np.float32 and np.isfinite(x).all()
    assert x[52, 5].tolist() == pytest.approx([0, 1, 1, 1, 1, 1, 1, 0, 1, -0.6, 0.5])
    assert x[20, 20].tolist() == pytest.approx([1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0.5])


@pytest.mark.parametrize("step", [(500, 500), *list_longer(((1500, 0),), ((-30, 1400),))])
@pytest.mark.longer
def test_far_parts_of_a_plan_are_looked_at_one_by_one_and_alike(two_rooms, step, monkeypatch) -> None:
    wall = np.zeros((106 + abs(step[0]), 46 + abs(step[1])), bool)
    profile, inside = np.zeros(wall.shape, np.uint64), wall.copy()
    for x, y in ((max(-step[0], 0), 0), (max(step[0], 0), step[1])):
        at = slice(x, x + 106), slice(y, y + 46)
        wall[at], inside[at], profile[at] = two_rooms.wall, two_rooms.inside, two_rooms.profile
    none = np.full(wall.shape, np.nan)
    plan = StoreyPlan(np.zeros(2), 0.1, wall, inside, profile, build_profile_bands(0.1), np.zeros(wall.shape), none)
    sizes = []
    whole = plan_network.run_network
    monkeypatch.setattr(plan_network, "run_network", lambda x, w: sizes.append(x[0].size) or whole(x, w))
    by_parts = compute_column_probabilities(plan)
    looked_at = sum(sizes)
    monkeypatch.setattr(plan_network, "_split_parts", lambda known: None)
    at_once = compute_column_probabilities(plan)
    assert np.array_equal(by_parts[plan.explored], at_once[plan.explored])
    assert looked_at < 0.9 * (sum(sizes) - looked_at)
