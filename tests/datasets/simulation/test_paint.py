"""Colours of simulated scans: one for a thing, the same at every scan; the points stay where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import SURFACES
from topomerge.datasets.simulation.paint import painted
from topomerge.datasets.simulation.rays import cast, placed
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import get_sensor

from topomerge.errors import InputError

TLS = get_sensor("tls")


@pytest.fixture(scope="module")
def house():
    return make_building("office", 5)


@pytest.fixture(scope="module")
def seen(house):
    pose = np.eye(4)
    x, y = np.mean(house.rooms[0].polygon, axis=0)
    pose[:3, 3] = x, y, house.rooms[0].floor + 1.6
    hits = cast(house, TLS, pose[None], 40_000, np.random.default_rng(0))
    return hits, placed(pose[None], hits, hits.ranges), np.zeros(len(hits.ranges), np.int32)


@pytest.mark.parametrize("kind", ["colour", "intensity"])
def test_points_are_the_same_with_and_without(house, kind):
    plain, shaded = scan(house, TLS, [0], 3, 0.1), scan(house, replace(TLS, shades=kind), [0], 3, 0.1)
    assert plain.colors is None and np.array_equal(plain.points, shaded.points)
    assert shaded.colors.shape == plain.points.shape and shaded.colors.dtype == np.uint8
    grey = (shaded.colors == shaded.colors[:, :1]).all()
    assert grey == (kind == "intensity") and shaded.colors.std() > 5
    assert np.array_equal(shaded.colors, scan(house, replace(TLS, shades=kind), [0], 3, 0.1).colors)


def test_a_thing_has_one_colour_up_to_light_and_noise(house, seen):
    hits, points, rooms = seen
    colours = painted(house, hits, points, rooms, "colour", np.random.default_rng(1)).astype(float)
    hue = colours[:, 0] - colours[:, 2]
    floor = house.labels[hits.triangle] == SURFACES.index("floor")
    assert floor.sum() > 1000 and hue[floor].std() < 25
    thing = house.thing_of[hits.triangle]
    large = np.argsort(-np.bincount(thing[thing >= 0]))[:4]
    assert all((thing == k).sum() > 20 and hue[thing == k].std() < 25 for k in large)
    assert hue[thing >= 0].std() > 15


def test_two_scans_differ_in_light_alone(house, seen):
    hits, points, rooms = seen
    one, other = (painted(house, hits, points, rooms, "colour", np.random.default_rng(k)).astype(float) for k in (1, 2))
    assert not np.array_equal(one, other)
    thing = house.thing_of[hits.triangle]
    large = np.flatnonzero(np.bincount(thing[thing >= 0]) > 20)
    hues = [[(shown[thing == k, 0] - shown[thing == k, 2]).mean() for k in large] for shown in (one, other)]
    assert len(large) > 4 and np.corrcoef(hues)[0, 1] > 0.9


def test_other_shades_are_refused(house):
    with pytest.raises(InputError, match="shades 'heat' of a sensor: colour, intensity or none"):
        scan(house, replace(TLS, shades="heat"), [0], 3, 0.1)
