"""Worlds of boxes: what stands where, what the frames say, and that kind and seed say all."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from tests.cases import list_longer
from topomerge.registration.pipeline import Registration
from topomerge.types import Sim3

worlds = importlib.import_module("topomerge.datasets.simulation.box_worlds")


@pytest.mark.parametrize("kind", [worlds.APART[0], worlds.TOGETHER[0], *list_longer(*worlds.APART[1:], *worlds.TOGETHER[1:])])
def test_kind_and_seed_say_all(kind: str) -> None:
    (a, frame), (b, _) = worlds.draw_pair(kind, 3)
    again = worlds.draw_pair(kind, 3)
    assert np.array_equal(a, again[0][0]) and np.array_equal(b, again[1][0])
    heights = frame.inverse().apply(a)[:, 2]
    assert abs(np.quantile(heights, 0.02)) < 0.05 and np.quantile(heights, 0.98) == pytest.approx(worlds.HEIGHT, abs=0.05)


@pytest.mark.longer
def test_maps_of_one_world_share_their_walls_under_the_true_frames() -> None:
    def columns(kind: str) -> tuple[set[tuple[int, ...]], set[tuple[int, ...]]]:
        pair = worlds.draw_pair(kind, 5)
        seen = (frame.inverse().apply(points) for points, frame in pair)
        return tuple({tuple(c) for c in np.floor(p[p[:, 2] > 2.1][:, :2] / 0.2).astype(int).tolist()} for p in seen)

    a, b = columns("same")
    assert len(a & b) > 0.5 * min(len(a), len(b))
    a, b = columns("row-other")
    assert len(a & b) < 0.1 * min(len(a), len(b))  # other rooms of the row
    a, b = columns("row-overlap")
    assert 0.4 * min(len(a), len(b)) < len(a & b) < 0.9 * min(len(a), len(b))  # two of three


def test_things_stand_in_their_rooms_and_leave_doors_free() -> None:
    rng = np.random.default_rng(0)
    world = worlds.furnish_all(worlds.draw_world(rng, 4), rng)
    assert sum(map(len, world.things)) > len(world.rooms)
    for room, things in enumerate(world.things):
        x0, y0, x1, y1 = world.rooms[room]
        assert (things[:, :2] >= (x0, y0)).all() and (things[:, 2:4] <= (x1, y1)).all()
        for x, y in world.clear_of(room):
            near = (things[:, 0] - 0.45 < x) & (x < things[:, 2] + 0.45) & (things[:, 1] - 0.45 < y) & (y < things[:, 3] + 0.45)
            assert not near.any()
    moved = worlds.move_things(world, 0.25, rng)
    stays = [
        any((one == other).all() for other in after) for a, after in zip(world.things, moved.things, strict=True) for one in a
    ]
    assert 0.5 < np.mean(stays) < 0.95


def test_a_pose_is_right_only_where_the_places_are_one() -> None:
    truth, middle = Sim3(0.3, (1.0, 2.0, 0.0)), np.array([5.0, 0.0, 1.0])
    answer = Registration(Sim3(0.3, (1.2, 2.0, 0.0)), 0.9, True)
    assert worlds.is_right(answer, "same", truth, middle) and worlds.is_right(answer, "row-overlap", truth, middle)
    assert not worlds.is_right(answer, "storeys", truth, middle)
    assert not worlds.is_right(Registration(Sim3(0.3, (2.0, 2.0, 0.0)), 0.9, True), "same", truth, middle)
    assert not worlds.is_right(Registration(None, 0.0, False), "same", truth, middle)
