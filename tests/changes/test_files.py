"""Changes as files: JSON, GeoJSON and BCF that other programs read, whatever the maps are called."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from tests.changes.flats import TABLE, flat_map
from tests.viz.test_report import EVIL, Page
from topomerge.changes.compare import Changes, compare_maps
from topomerge.changes.files import format_changes, save_bcf, save_geojson, save_json, serialise_changes
from topomerge.viz.pair_reports import render_changes_html, save_changes_report


@pytest.fixture(scope="module")
def changes() -> Changes:
    old, new = replace(flat_map(), source=EVIL), replace(flat_map(wall=True, box=TABLE), source="new\x00\x1b[31m.ply")
    return compare_maps(old, new)


def test_json_holds_every_change(changes: Changes, tmp_path: Path) -> None:
    save_json(changes, tmp_path / "c.json")
    read = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert read == json.loads(json.dumps(serialise_changes(changes)))
    assert [c["kind"] for c in read["changes"]] == [c.kind for c in changes.changes]
    assert read["counts"] == {"wall new": 1, "door new": 1, "room split": 1, "furniture new": 1}
    assert np.array(read["transform"]).shape == (4, 4) and read["old"]["source"] == EVIL


def test_geojson_has_valid_shapes_that_run_counter_clockwise(changes: Changes, tmp_path: Path) -> None:
    save_geojson(changes, tmp_path / "c.geojson")
    read = json.loads((tmp_path / "c.geojson").read_text(encoding="utf-8"))
    assert read["type"] == "FeatureCollection" and read["crs"] is None and len(read["features"]) == len(changes)
    for feature, change in zip(read["features"], changes.changes, strict=True):
        shape = shapely.geometry.shape(feature["geometry"])
        assert shape.is_valid and feature["properties"]["kind"] == change.kind
        assert [shape.centroid.x, shape.centroid.y] == pytest.approx(change.place[:2].tolist(), abs=0.05)
        if shape.geom_type == "Polygon":
            assert shape.exterior.is_ccw


def test_bcf_opens_again_with_a_camera_at_each_change(changes: Changes, tmp_path: Path) -> None:
    bcfxml = pytest.importorskip("bcf.v3.bcfxml")
    of_model = replace(changes.changes[0], guid="0$WU4A9R19$vKWO$AdOnKA", name="wall <b>", kind="element missing")
    save_bcf(replace(changes, changes=(*changes.changes, of_model)), tmp_path / "c.bcf")
    save_bcf(replace(changes, changes=(*changes.changes, of_model)), tmp_path / "again.bcf")
    assert (tmp_path / "c.bcf").read_bytes() == (tmp_path / "again.bcf").read_bytes()
    with bcfxml.BcfXml.load(tmp_path / "c.bcf") as read:
        topics = sorted(read.topics.values(), key=lambda t: t.topic.index)
        assert read.version.version_id == "3.0" and len(topics) == len(changes) + 1
        for topic, change in zip(topics, (*changes.changes, of_model), strict=True):
            assert topic.topic.topic_type == change.kind and change.kind in topic.topic.title
            (view,) = topic.viewpoints.values()
            camera = view.visualization_info.perspective_camera
            eye, way, up = (
                np.array([v.x, v.y, v.z]) for v in (camera.camera_view_point, camera.camera_direction, camera.camera_up_vector)
            )
            target = change.place + (0, 0, 1.2)
            assert np.cross(target - eye, way) == pytest.approx(np.zeros(3), abs=1e-6) and (target - eye) @ way > 2
            assert way @ up == pytest.approx(0, abs=1e-9) and up[2] > 0
        assert topics[-1].viewpoints and next(iter(topics[-1].viewpoints.values())).get_selected_guids() == [of_model.guid]


def test_the_table_has_a_line_for_each_change(changes: Changes) -> None:
    lines = format_changes(changes).splitlines()
    assert lines[0].startswith("1 wall new, 1 door new, 1 room split, 1 furniture new; both maps saw ")
    assert len(lines) == 3 + len(changes)
    assert format_changes(replace(changes, changes=())).startswith("nothing has changed that both maps could see; ")


def test_names_are_text_on_the_page_and_it_asks_for_nothing(changes: Changes, tmp_path: Path) -> None:
    text = render_changes_html(changes)
    page = Page(text)
    assert "<img src=x" not in text and not page.all("img")
    assert all("http" not in (about.get("src") or about.get("href") or "") for _, about in page.elements)
    assert len([row for row in page.all("tr") if "data-edge" in row]) == len(changes)
    assert len(page.all("g", "change")) == len(changes)
    assert [i for i in page.all("input") if "data-swipe" in i] and [i for i in page.all("input") if "data-blend" in i]
    save_changes_report(changes, tmp_path / "d.html")
    assert (tmp_path / "d.html").read_text(encoding="utf-8") == text
