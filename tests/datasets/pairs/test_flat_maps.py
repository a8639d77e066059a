"""What robots and architects draw of a building: rays counted in cells, drawings with their symbols, true rooms of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs import drawing
from topomerge.datasets.pairs.atlases import FLAT_KINDS, make_atlas, simulate_partial_map
from topomerge.datasets.pairs.flat_maps import GRID_CELL, count_rays
from topomerge.datasets.pairs.items import Recipe, check, draw_items
from topomerge.datasets.simulation.sensors import get_sensor, scale_sensor_drift

from tests.recipes import SMALL_HOUSES
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.types import Sim3

FRAME = Sim3(0.7, (5.0, -3.0, 1.5))
SIX = Recipe(name="six", pairs=2, walks=6, drifts=[0.0, 4.0], **{**SMALL_HOUSES, "sensors": {"grid": 1, "drawing": 1}})


@pytest.fixture(scope="module")
def house() -> Building:
    return make_building("house", 11)


def test_a_cell_is_occupied_where_rays_end_and_free_where_they_pass():
    """Rays from one place to a wall 2 m ahead: the wall's cells are occupied, those before it free, those behind it unknown."""
    across = np.linspace(-1.0, 1.0, 400)
    ends = np.column_stack([np.full(400, 2.01), across])
    occupied, free, corner = count_rays(np.zeros((400, 2)), ends)
    y, x = ((np.argwhere(occupied) + 0.5) * GRID_CELL + corner[::-1]).T
    assert np.allclose(x, 2.025) and y.min() < -0.95 and y.max() > 0.95
    y, x = ((np.argwhere(free) + 0.5) * GRID_CELL + corner[::-1]).T
    assert x.max() < 2.0 and x.min() > -GRID_CELL and (np.abs(y) <= x / 2 + GRID_CELL).all()
    assert free.sum() * GRID_CELL**2 == pytest.approx(2.0, rel=0.1)  # the triangle that they cover
    assert not (occupied & free).any()


def test_a_cell_that_most_rays_pass_is_free():
    starts = np.zeros((101, 2))
    ends = np.tile([[3.01, 0.01]], (101, 1))
    ends[0] = [1.01, 0.01]
    occupied, free, corner = count_rays(starts, ends)
    row, column = np.floor((np.array([0.01, 1.01]) - corner[::-1]) / GRID_CELL).astype(int)
    assert free[row, column] and not occupied[row, column] and occupied.sum() == 1


@pytest.mark.parametrize("kind", FLAT_KINDS)
def test_flat_maps_tell_the_true_rooms_of_their_points(kind: str, house: Building):
    cloud = simulate_partial_map(house, kind, np.arange(len(house.rooms)), np.random.default_rng(0), FRAME, drift=0.0)
    assert cloud.labels is not None and len(cloud.rooms) == len(house.rooms)
    room = max(range(len(house.rooms)), key=lambda i: shapely.Polygon(house.rooms[i].polygon).area)
    outline = shapely.Polygon(FRAME.apply(np.column_stack([house.rooms[room].polygon, np.zeros(len(house.rooms[room].polygon))])))
    inside = shapely.contains_xy(outline.buffer(-0.3), *cloud.points[:, :2].astype(float).T)
    assert inside.any() and (cloud.labels[inside] == room).all()
    floor = float(house.storeys["floor"][0]) + FRAME.translation[2]
    assert cloud.points[:, 2].min() == pytest.approx(floor, abs=0.02)
    map = extract(cloud)
    assert len(map.rooms) >= 3


def test_a_robot_draws_what_it_drove_through_and_an_architect_also_what_lies_about_it(house: Building):
    some = np.array([0, 1])
    grid, plan = (simulate_partial_map(house, kind, some, np.random.default_rng(1), Sim3(), 0.0) for kind in FLAT_KINDS)
    assert grid.free is not None and plan.free is None
    assert len(np.unique(plan.labels[plan.labels >= 0])) >= 2


def test_a_drawing_has_arcs_outlines_and_names_or_walls_alone(house: Building, monkeypatch: pytest.MonkeyPatch):
    every = np.arange(len(house.rooms))
    counts = []
    for shares in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)):
        monkeypatch.setattr(drawing, "SYMBOLS_SHARES", shares)
        cloud = simulate_partial_map(house, "drawing", every, np.random.default_rng(2), Sim3())
        counts.append(int((cloud.points[:, 2] > cloud.points[:, 2].min() + 1.0).sum()))
    bare, *each, full = counts
    assert all(bare < count < full for count in each)


def test_a_leaf_swings_from_its_hinge_to_the_other_end_of_the_opening(house: Building):
    door = drawing.find_inner_doors(house, 0)[0].copy()
    door["state"] = "shut"
    leaf, arc = drawing._draw_leaf_and_arc(door, np.random.default_rng(0))
    assert np.allclose(np.hypot(*(arc - leaf[0]).T), door["width"])
    assert np.allclose(leaf[1], arc[-1])
    centre = np.array(door["centre"][:2])
    assert np.hypot(*((leaf[0] + arc[0]) / 2 - centre)) == pytest.approx(door["thickness"] / 2, abs=1e-9)
    door["state"] = "none"
    assert not drawing._draw_leaf_and_arc(door, np.random.default_rng(0))


@pytest.mark.longer
def test_maps_of_one_building_fit_by_their_true_transforms_whatever_made_them(house: Building):
    """Walls of a drawing lie on those of a scan that did not drift."""
    atlas = make_atlas(house, ("tls", "drawing", "grid"), np.random.default_rng(3), drifts=(0.0, 0.0, 0.0))
    from scipy.spatial import cKDTree

    clouds = [t.apply(m.points.astype(np.float64)) for t, m in zip(atlas.truth, atlas.maps, strict=True)]
    walls = [cloud[(cloud[:, 2] > cloud[:, 2].min() + 0.8) & (cloud[:, 2] < cloud[:, 2].min() + 1.6)][:, :2] for cloud in clouds]
    for other in walls[1:]:
        assert np.median(cKDTree(other).query(walls[0][::7])[0]) < 0.2
    assert {m.source.rpartition(":")[2] for m in atlas.maps} == {"tls", "drawing", "grid"}


def test_items_draw_flat_maps_and_drifts_and_what_makes_no_sense_is_refused():
    check(SIX)
    items = draw_items(SIX, {})
    assert all(len(item.drifts) == 6 and set(item.drifts) <= {0.0, 4.0} and len(item.more) == 4 for item in items)
    assert {s for item in items for s in (*item.sensors, *item.more)} <= set(FLAT_KINDS)
    assert draw_items(replace(SIX, drifts=[]), {})[0].drifts == ()
    with pytest.raises(InputError, match="sensor 'grid'"):
        check(replace(SIX, walks=2, drifts=[]))
    with pytest.raises(InputError, match="drifts are of more than two walks"):
        check(replace(SIX, drifts=[-1.0]))
    with pytest.raises(InputError, match="drifts are of more than two walks"):
        check(replace(SIX, walks=2, sensors={"tls": 1}))


def test_a_multiple_of_the_drift_is_that_of_the_sensor():
    assert scale_sensor_drift("lidar", 2.0).drift == pytest.approx(2 * get_sensor("lidar").drift)
    assert scale_sensor_drift("lidar", 1.0) == get_sensor("lidar") and scale_sensor_drift("lidar", 0.0).tilt == 0.0
