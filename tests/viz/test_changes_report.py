"""The page of what has changed, in a browser: the swipe cuts both maps at one line, and a row zooms to its change."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.changes.flats import TABLE, flat_map
from tests.viz.chromium import Page
from topomerge.changes.compare import compare_maps
from topomerge.viz.pair_reports import save_changes_report

pytestmark = pytest.mark.longer

SET = "(() => { const s = document.querySelector('input[data-swipe]'); s.value = 0.25; s.dispatchEvent(new Event('input')); })()"
CUTS = (
    "(() => { const [a, b] = document.querySelectorAll('clipPath rect'); return [+a.getAttribute('x') + +a.getAttribute('width'),"
    " +b.getAttribute('x'), document.querySelectorAll('.side-a[clip-path], .side-b[clip-path]').length]; })()"
)
WIDE = "Number(document.querySelector('svg.plan').getAttribute('viewBox').split(' ')[2])"


def test_swipe_and_zoom(tmp_path: Path) -> None:
    save_changes_report(compare_maps(flat_map(), flat_map(wall=True, box=TABLE)), tmp_path / "d.html")
    page = Page(tmp_path / "d.html", tmp_path / "profile")
    try:
        page.run(SET)
        old_until, new_from, cut = page.run(CUTS)
        assert old_until == pytest.approx(new_from) and cut == 2
        before = page.run(WIDE)
        page.run("document.querySelector('tr[data-edge=\"c0\"]').click()")
        assert page.run(WIDE) < 0.8 * before
        page.run("document.querySelector('input[data-layer=\"wall\"]').click()")
        assert page.run("getComputedStyle(document.querySelector('.change.of-wall')).display") == "none"
        assert not page.console
    finally:
        page.close()
