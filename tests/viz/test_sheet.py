"""The paper of a plan: turned so that walls run along it, and rooms without gaps on it.

An open page of an atlas loads itself anew when the atlas changes, from the disk, too; a page alone is left alone.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.test_watch import room
from tests.scenes_map import building
from tests.viz.chromium import Page
from topomerge.fusion.atlas.store import add
from topomerge.viz.plan import Frame, StoreyView, compute_frame, rasterize_storeys
from topomerge.viz.svg import build_sheet, fill_rooms, lay_out


@pytest.mark.parametrize("degrees", [-40, -20, 0, 10, 30, 44])
def test_walls_run_along_the_paper(degrees: float) -> None:
    i, j = np.indices((240, 240)) - 120
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y = np.abs(c * i + s * j), np.abs(-s * i + c * j)
    walls = ((x < 80) & (y < 50)) & ~((x < 77) & (y < 47))
    plan = StoreyView(np.where((x < 77) & (y < 47), 0, -1).astype(np.int32), (x < 80) & (y < 50), walls)
    sheet = build_sheet([plan], Frame(np.zeros(2), 0.1, (240, 240), np.zeros(2, np.int64), 1))
    assert (np.degrees(sheet.turn) + degrees + 45) % 90 - 45 == pytest.approx(0.0, abs=1.0)


def test_paper_and_building() -> None:
    sheet, _ = lay_out(building(1, 1))
    a, b, c, d, e, f = sheet.back
    for point in ((2.5, -1.0), (6.0, 3.25)):
        x, y = sheet.locate(np.array(point))
        assert (a * x + b * y + c, d * x + e * y + f) == pytest.approx(point, abs=0.006)
    turned = replace(sheet, turn=0.4)
    a, b, c, d, e, f = turned.back
    x, y = turned.locate(np.array([2.5, -1.0]))
    assert (a * x + b * y + c, d * x + e * y + f) == pytest.approx((2.5, -1.0), abs=0.008)


def test_small_gaps_are_filled_and_no_room_takes_from_another() -> None:
    map = building(1, 1)
    frame = compute_frame(map)
    plan = rasterize_storeys(map, frame)[0]
    holed = plan.room.copy()
    holed[10:14, 10:30] = -1
    filled = fill_rooms(replace(plan, room=holed), frame)
    assert (filled[10:14, 10:30] == plan.room[10:14, 10:30]).all()
    labelled = plan.room >= 0
    assert (filled[labelled] == plan.room[labelled]).all()


@pytest.mark.longer
def test_an_open_page_shows_the_atlas_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", lambda *_: ())
    add(tmp_path / "house", [("one", room(0))], tm.render_atlas_html)
    with Page(tmp_path / "house" / "report.html", tmp_path / "profile") as page:
        page.run("window.opened = true")
        page.wait("performance.now() > 5000 && window.opened === true")  # nothing changed: nothing is loaded
        add(tmp_path / "house", [("two", room(1))], tm.render_atlas_html)
        page.wait("document.readyState === 'complete' && window.opened === undefined")
        assert "two" in page.run("document.body.innerText") and not page.console


@pytest.mark.longer
def test_a_page_alone_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("topomerge.fusion.atlas.solve.find_hypotheses", lambda *_: ())
    add(tmp_path / "house", [("one", room(0))], tm.render_atlas_html)
    shutil.copy(tmp_path / "house" / "report.html", tmp_path / "sent.html")
    assert 'id="stamp"' not in tm.render_atlas_html(tm.build_atlas([room(0), room(1)]), {})
    with Page(tmp_path / "sent.html", tmp_path / "profile") as page:
        page.run("window.opened = true")
        page.wait("performance.now() > 5000")
        assert page.run("window.opened") is True
