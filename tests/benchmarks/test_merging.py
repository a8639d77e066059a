"""What the benchmarks of merging count: kinds of pairs, plans that nobody can tell apart, what is right."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building

from topomerge.types import Sim3


@pytest.fixture
def module():
    return lambda name: importlib.import_module(f"benchmarks.merging.{name}")


def test_kinds_and_bins_do_not_depend_on_the_order(module) -> None:
    peers = module("peers")
    assert peers.kind_of(("laser2d", "lidar")) == peers.kind_of(("lidar", "laser2d")) == "lidar - slice"
    assert peers.kind_of(("drawing", "tls")) == "other 3D - floor plan"
    assert [peers.bin_of(m2) for m2 in (1.0, 39.9, 40.0, 80.0)] == ["<40 m²", "<40 m²", "40-80 m²", "≥80 m²"]


def test_plans_that_differ_only_where_nobody_looked_are_the_same() -> None:
    drawings = importlib.import_module("topomerge.datasets.pairs.grid_drawings")
    building = make_building("office", 5, 2)
    lower = np.array([i for i, r in enumerate(building.rooms) if r.storey == 0])
    here = drawings.Place("x", "a", building, Sim3(), 0, lower)
    assert drawings.differing(here, here, 0)["walls_differ"] == 0
    everywhere, two = (drawings.differing(drawings.replace(here, visited=v), here, 1)["walls_differ"] for v in (lower, lower[:2]))
    assert 0 <= two <= everywhere


def test_a_slice_or_a_drawing_says_nothing_of_its_height() -> None:
    right = importlib.import_module("topomerge.training.belief_hypotheses").right
    off = [0.1, 1.0, 1.0]
    assert right(off, ("tls", "laser2d")) and right(off, ("drawing", "tls")) and not right(off, ("tls", "depth"))
    assert not right(None, ("tls", "laser2d"))


def test_a_slice_or_a_drawing_on_the_wrong_storey_is_wrong() -> None:
    right = importlib.import_module("topomerge.training.belief_hypotheses").right
    for sensors in (("tls", "laser2d"), ("drawing", "tls"), ("laser2d", "laser2d")):
        assert not right([0.05, 2.9, 0.1], sensors) and not right([0.05, -2.9, 0.1], sensors)
        assert right([0.05, 0.45, 0.1], sensors) and right([0.05, -0.45, 0.1], sensors)
