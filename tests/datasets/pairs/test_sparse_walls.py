"""Scans that lose most of their points before doors are weighed on them."""

from __future__ import annotations

import numpy as np
import pytest
from topomerge.datasets.pairs.plan_examples import PlanRecipe, build_plans
from topomerge.datasets.pairs.wall_examples import LOST_BY_CHANCE, SPACING_LEFT, draw_wall_item, thin_cloud

from topomerge.errors import InputError
from topomerge.training.scan_settings import WallDoors
from topomerge.types import PointCloud

POINTS = np.random.default_rng(0).uniform(0, 3, (20_000, 3)).astype(np.float32)
CLOUD = PointCloud(POINTS, poses=np.eye(4)[None], pose_of=np.zeros(len(POINTS), np.int32))


@pytest.mark.longer
def test_a_thinned_cloud_is_part_of_the_cloud_and_the_same_again():
    by_chance = np.array([np.random.default_rng([seed, 10]).random() < LOST_BY_CHANCE for seed in range(40)])
    left = [thin_cloud(CLOUD, seed) for seed in range(40)]
    whole = {tuple(p) for p in POINTS.tolist()}
    assert all({tuple(p) for p in cloud.points.tolist()} <= whole for cloud in left[:6])
    assert all(cloud.pose_of is not None and len(cloud.pose_of) == len(cloud) for cloud in left)
    shares = np.array([len(cloud) / len(CLOUD) for cloud in left])
    assert 0 < by_chance.sum() < 40 and (shares[by_chance] < 0.33).all() and (shares[by_chance] > 0.02).all()
    assert (thin_cloud(CLOUD, 7).points == left[7].points).all()


def test_of_a_cloud_in_a_raster_one_point_stays_in_each_cell():
    seed = next(s for s in range(40) if np.random.default_rng([s, 10]).random() >= LOST_BY_CHANCE)
    rng = np.random.default_rng([seed, 10])
    rng.random()
    cell = rng.uniform(*SPACING_LEFT)
    cells = np.floor(thin_cloud(CLOUD, seed).points.astype(float) / cell).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells) == len(np.unique(np.floor(POINTS.astype(float) / cell), axis=0))


def test_a_share_of_the_items_is_sparse():
    items = [draw_wall_item(seed, {}, PlanRecipe(sparse=0.3)) for seed in range(400)]
    assert 0.22 < np.mean([item.sparse for item in items]) < 0.38
    assert not any(draw_wall_item(seed, {}, PlanRecipe()).sparse for seed in range(50))
    assert len({item.name for item in items}) == 400


def test_a_share_that_is_none_is_refused():
    with pytest.raises(InputError, match="data.sparse must be 0 to 1, not 3"):
        build_plans(PlanRecipe(sparse=3.0), WallDoors())
