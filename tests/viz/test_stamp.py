"""An open page of an atlas loads itself anew when the atlas changes, from the disk, too; a page alone is left alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import topomerge as tm
from tests.fusion.atlas.test_watch import room
from tests.viz.chromium import Page
from topomerge.fusion.atlas.store import add


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
