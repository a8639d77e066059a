"""Windows in walls at known places: where they are, and that they stay in files, exports and joined maps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.extraction.elevations.panes import HEAD, SILL, WINDOWS, three_windows
from tests.scenes import two_rooms
from topomerge.errors import InputError
from topomerge.types import Sim3, TopometricMap
from topomerge.viz.report import render_report_html

MOVE = Sim3(0.7, (12.0, -5.0, 1.0))


def extracted(points: np.ndarray, move: Sim3 | None = None) -> TopometricMap:
    return tm.extract((points if move is None else move.apply(points)).astype(np.float32))


@pytest.fixture(scope="module")
def map() -> TopometricMap:
    return extracted(three_windows())


@pytest.fixture(scope="module")
def moved() -> TopometricMap:
    return extracted(three_windows(), MOVE)


def places(map: TopometricMap, move: Sim3 | None = None) -> np.ndarray:
    """(W, 2) of its windows, in the order of those of the scene."""
    there = map.windows["centre"] if move is None else move.inverse().apply(map.windows["centre"])
    return there[np.argsort(there[:, 0])][:, :2]


def test_windows_are_where_they_are(map):
    assert len(map.windows) == 3
    assert np.abs(places(map) - WINDOWS[:, :2]).max() < 0.2
    by_x = map.windows[np.argsort(map.windows["centre"][:, 0])]
    np.testing.assert_allclose(by_x["width"], WINDOWS[:, 2], atol=0.2)
    np.testing.assert_allclose(by_x["sill"], SILL, atol=0.1)
    np.testing.assert_allclose(by_x["head"], HEAD, atol=0.15)
    assert (by_x["confidence"] > 0.85).all()
    inner = by_x[1]["rooms"]
    assert sorted(inner.tolist()) == [0, 1] and (by_x["rooms"][[0, 2], 1] == -1).all()
    across = np.abs(np.cos(by_x["direction"]))
    np.testing.assert_allclose(across, (0.0, 1.0, 1.0), atol=0.02)


def test_rooms_without_windows_have_none():
    assert not len(extracted(two_rooms().points()).windows)
    assert not len(tm.extract(three_windows().astype(np.float32), walls=False).windows)


def test_a_moved_map_has_the_same_windows_moved(map, moved):
    assert len(moved.windows) == 3 and np.abs(places(moved, MOVE) - places(map)).max() < 0.2


def test_files_keep_them_and_older_ones_have_none(map, tmp_path: Path):
    tm.save_map(map, tmp_path / "a.tmap")
    assert (tm.load_map(tmp_path / "a.tmap").windows == map.windows).all()
    without = replace(map, windows=map.windows[:0])
    tm.save_map(without, tmp_path / "b.tmap")
    assert not len(tm.load_map(tmp_path / "b.tmap").windows)
    tm.save_json(map, tmp_path / "a.json")
    listed = json.loads((tmp_path / "a.json").read_text())["windows"]
    assert len(listed) == 3 and {tuple(w["rooms"]) for w in listed} == {(0, None), (0, 1), (1, None)}


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("width", 0.0, "not wide or not high"),
        ("head", 0.1, "not wide or not high"),
        ("centre", np.nan, "no number"),
        ("confidence", 2.0, "not from 0 to 1"),
    ],
)
def test_damaged_tables_are_refused(map, tmp_path: Path, column: str, value: float, words: str):
    windows = map.windows.copy()
    windows[column][0] = value
    tm.save_map(replace(map, windows=windows), tmp_path / "a.tmap")
    with pytest.raises(InputError, match=f"a.tmap: damaged .*{words}"):
        tm.load_map(tmp_path / "a.tmap")


@pytest.mark.parametrize("rooms", [(-1, 0), (0, 2), (1, 1)])
def test_windows_of_no_rooms_are_refused(map, rooms):
    windows = map.windows.copy()
    windows["rooms"][0] = rooms
    with pytest.raises(ValueError, match="window"):
        replace(map, windows=windows)


def test_a_joined_map_has_each_once(map, moved):
    merged = tm.merge([map, moved], force=True)
    assert merged.map is not None and len(merged.map.windows) == 3
    assert np.abs(places(merged.map) - WINDOWS[:, :2]).max() < 0.25


def test_geojson_and_a_building_model_hold_them(map, tmp_path: Path):
    tm.save_export(map, "geojson", tmp_path / "a.geojson")
    kinds = [f["properties"] for f in json.loads((tmp_path / "a.geojson").read_text())["features"]]
    windows = [p for p in kinds if p["kind"] == "window"]
    assert len(windows) == 3 and all(abs(p["sill"] - SILL) < 0.1 for p in windows)
    ifcopenshell = pytest.importorskip("ifcopenshell")
    tm.save_export(map, "ifc", tmp_path / "a.ifc")
    model = ifcopenshell.open(str(tmp_path / "a.ifc"))
    made = model.by_type("IfcWindow")
    assert len(made) == 3
    holes = [window.FillsVoids[0].RelatingOpeningElement for window in made]
    assert all(hole.VoidsElements[0].RelatingBuildingElement.is_a("IfcWall") for hole in holes)
    assert all(abs(w.OverallHeight - (HEAD - SILL)) < 0.2 for w in made)


def test_the_plan_draws_them(map):
    page = render_report_html(map)
    assert page.count('<g class="window" data-sure') == 3 and "sign-window" in page
