"""Seconds until there is a pose: the way through extraction, rows and registration on the smallest floor, and the table."""

from __future__ import annotations

import importlib

import pytest


@pytest.mark.longer
def test_each_way_gives_the_pose() -> None:
    module = importlib.import_module("benchmarks.merging.pose_seconds")
    from benchmarks.speed.merge_growth import two_maps
    from topomerge.extraction.extract import extract

    a, b = (extract(grid) for grid in two_maps(20)[:2])
    for way in module.WAYS_TO_POSE:
        row = module.timed(a, b, way, "fixed")
        assert row["off"] < module.NEAR and (row["rows"] > 0) == (way != "walls") and row["plans"] > 0


def test_seconds_are_compared_with_those_of_walls_alone() -> None:
    module = importlib.import_module("benchmarks.merging.pose_seconds")
    parts = {"rooms": 20, "a": 15, "b": 16, "rows": 0.0, "match": 0.0, "plans": 1.0, "verify": 0.5, "search": 0.5, "off": 0.01}
    rows = [
        {**parts, "scale": "fixed", "way": "walls"},
        {**parts, "scale": "fixed", "way": "rooms", "rows": 1.5, "match": 1.0, "search": 0.0, "off": 3.0},
    ]
    lines = module.table(rows).splitlines()
    assert lines[2] == "| 15, 16 | known | walls | 0.0 | 0.0 | 0.5 | 2.0 | 1.0 | 0.01 |"
    assert lines[3] == "| 15, 16 | known | rooms | 1.5 | 1.0 | 0.0 | 4.0 | 2.0 | **3.0** |"
