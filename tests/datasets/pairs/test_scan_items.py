"""Scans that learned parts of the extraction train with: grids and drawings look as files of robots and draughtsmen do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.pairs.drawing import simulate_grid_map
from topomerge.datasets.pairs.plan_examples import (
    FLAT_SENSOR_SHARES,
    PlanItem,
    PlanRecipe,
    build_storey_plans,
    check_plans,
    draw_item,
    make_examples,
    simulate_item_scan,
)

from tests.cases import list_longer
from tests.datasets.boxes import BARE, two_rooms
from topomerge.errors import InputError
from topomerge.extraction.plans.plan_network import compute_evidence
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import is_raised, is_slice
from topomerge.io import read_points
from topomerge.training.plan_segmentation import convert_to_grid


def walls_of(cloud, edge):
    """(k, 11) evidence of the columns of walls in which something stands."""
    ((plan, _),) = build_storey_plans(cloud, edge)
    x = compute_evidence(plan)[plan.wall]
    return x[x[:, 2] > 0]


@pytest.mark.parametrize("edge", [0.1, *list_longer(0.08, 0.15)])
def test_walls_of_a_drawn_map_are_as_full_as_those_of_a_file(edge, tmp_path):
    """They once had gaps, by which the network told drawings from real grids."""
    from PIL import Image

    image = np.full((90, 150), 254, np.uint8)
    image[[0, 89]] = image[:, [0, 70, 149]] = 0
    image[30:50, 70] = 254
    Image.fromarray(image).save(tmp_path / "grid.png")
    drawn = simulate_grid_map(build_building([two_rooms()], BARE, 0), np.arange(2), np.random.default_rng(0))
    file = read_points(tmp_path / "grid.png", resolution=0.05)
    assert is_raised(read_scan(drawn, edge).grid) and is_raised(read_scan(file, edge).grid)
    ours, theirs = walls_of(drawn, edge), walls_of(file, edge)
    common = [np.median(x, axis=0) for x in (ours, theirs)]
    assert common[0][1:10] == pytest.approx(common[1][1:10], abs=0.06)
    assert (ours[:, 2:6] == 1).mean() > 0.9


@pytest.mark.longer
def test_flat_items_are_grids_drawings_and_slices():
    items = [draw_item(seed, {}, flat=True) for seed in range(100_000, 100_030)]
    made = [simulate_item_scan(item, None) for item in items[:6]]
    assert {m.sensor for m in made} <= set(FLAT_SENSOR_SHARES) and len({m.sensor for m in made}) > 1
    for m in made:
        grid = read_scan(m.cloud, 0.1).grid
        assert is_slice(grid) if m.sensor == "laser2d" else is_raised(grid)
    assert all(item.flat for item in items) and not draw_item(100_000, {}).flat
    assert draw_item(100_000, {}).name != draw_item(100_000, {}, flat=True).name
    with pytest.raises(InputError, match=r"data\.scans"):
        check_plans(PlanRecipe(scans=0, flat=True))


@pytest.mark.longer
def test_a_scan_is_shown_as_a_grid_to_the_network_of_grids(tmp_path):
    """Its walls are raised alike, furniture that a laser meets is wall, and what is true of each column stays."""
    scanned = make_examples(PlanItem(100_003, "procedural", 0, "", ""), None)[0]
    assert scanned.source.split("/")[0] not in FLAT_SENSOR_SHARES
    bare, furnished = (convert_to_grid(scanned, with_furniture) for with_furniture in (False, True))
    for grid in (bare, furnished):
        x = compute_evidence(grid.plan)
        walls, floor = x[grid.plan.wall], x[grid.plan.inside]
        assert (walls[:, 1:7] == 1).all() and (walls[:, 9] < -0.5).all()  # as of a file, above
        assert not floor[:, 1:6].any() and (floor[:, [0, 6]] == 1).all() and not floor[:, 7:10].any()
        assert grid.truth is scanned.truth and not (grid.plan.wall & grid.plan.inside).any()
    assert (bare.plan.wall == scanned.plan.wall).all() and not (bare.plan.wall & ~furnished.plan.wall).any()
    assert furnished.plan.wall.sum() > bare.plan.wall.sum()
    drawn = replace(scanned, source="drawn/procedural")
    assert convert_to_grid(drawn, True) is drawn
