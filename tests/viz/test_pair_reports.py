"""Pages of two maps: what has changed, and a matching."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import topomerge as tm
from tests.changes.flats import TABLE, flat_map
from tests.scenes import Scene
from tests.viz.chromium import Page
from topomerge.changes.compare import compare_maps
from topomerge.cli.main import main as cli
from topomerge.embedding.surroundings import CROP, CROP_PLANES
from topomerge.matching.match import Matching
from topomerge.types import Sim3
from topomerge.viz.merge_report import PIXEL_COLOURS
from topomerge.viz.pair_reports import (
    draw_surroundings,
    find_aligning_quarters,
    render_match_html,
    save_changes_report,
    save_match_report,
)

SET = "(() => { const s = document.querySelector('input[data-swipe]'); s.value = 0.25; s.dispatchEvent(new Event('input')); })()"
CUTS = (
    "(() => { const [a, b] = document.querySelectorAll('clipPath rect'); return [+a.getAttribute('x') + +a.getAttribute('width'),"
    " +b.getAttribute('x'), document.querySelectorAll('.side-a[clip-path], .side-b[clip-path]').length]; })()"
)
WIDE = "Number(document.querySelector('svg.plan').getAttribute('viewBox').split(' ')[2])"


@pytest.mark.longer
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


FLAT = Scene().shell(0, 0, 13, 9).wall((5, 0), (5, 9), doors=(2.0,)).wall((5, 5), (13, 5), doors=(4.0,))


@pytest.fixture(scope="module")
def flats():
    """A flat of three rooms, and the same a quarter turn and some metres off."""
    points = FLAT.points()
    turned = Sim3(np.pi / 2, (40.0, -3.0, 1.0)).apply(points)
    return tuple(tm.extract(p.astype(np.float32), name=n) for p, n in ((points, "<a>.ply"), (turned, "b.ply")))


@pytest.fixture(scope="module")
def matching(flats) -> Matching:
    a, b = flats
    there = Sim3(np.pi / 2, (40.0, -3.0, 1.0)).inverse().apply(b.rooms["centroid"])
    partner = np.linalg.norm(a.rooms["centroid"][:, None] - there[None], axis=2).argmin(axis=1)
    return Matching(np.column_stack([np.arange(3), partner]), np.array([0.9, 0.6, 0.2]))


@pytest.mark.parametrize("quarters", range(4))
def test_crops_are_turned_until_their_walls_agree(quarters: int) -> None:
    crops = np.zeros((2, CROP, CROP, len(CROP_PLANES)), np.uint8)
    crops[0, 10:50, 12, 0] = crops[1, 30, 20:60, 0] = crops[1, 30:40, 20, 0] = 255
    assert find_aligning_quarters(np.rot90(crops, quarters, (1, 2)), crops) == quarters


def test_both_pictures_of_a_match_are_alike(flats, matching) -> None:
    """Of one flat twice, however it stands in its file."""
    page = render_match_html(matching, *flats)
    pictures = re.findall(r'<img src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == 6
    alike = [_pixels(one) == _pixels(other) for one, other in zip(pictures[::2], pictures[1::2], strict=True)]
    assert min(same.mean() for same in alike) > 0.85


def _pixels(data: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))).sum(axis=2)


def test_a_picture_has_its_colours_and_the_largest_y_above() -> None:
    crop = np.zeros((CROP, CROP, len(CROP_PLANES)), np.uint8)
    crop[:, -1, CROP_PLANES.index("wall")] = 255
    image = draw_surroundings(crop)
    assert (image[0] == PIXEL_COLOURS["wall"]).all() and (image[1:] != PIXEL_COLOURS["wall"]).any(axis=2).all()


def test_each_match_stands_in_the_page(flats, matching, tmp_path: Path) -> None:
    save_match_report(matching, *flats, tmp_path / "m.html")
    page = (tmp_path / "m.html").read_text(encoding="utf-8")
    assert page.count("<details data-room-of-a=") == 3 and page.count('class="match"') == 3
    assert "probability 0.60" in page and "&lt;a&gt;.ply" in page and "<a>.ply" not in page
    assert page == render_match_html(matching, *flats)
    none = render_match_html(Matching(), *flats)
    assert "<details data-room-of-a=" not in none and "<b>0</b>" in none


def test_the_command_writes_it(flats, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(tmp_path / f"{name}.tmap") for name in "ab"]
    for m, path in zip(flats, paths, strict=True):
        tm.save_map(m, path)
    assert cli(["match", *paths, "--report", str(tmp_path / "m.html")]) == 0
    assert capsys.readouterr().out.startswith("3 matches of 3 and 3 rooms")
    assert "Rooms of two maps" in (tmp_path / "m.html").read_text(encoding="utf-8")
    assert cli(["match", *paths, "--report", paths[0]]) == 1
    assert "is the input" in capsys.readouterr().err
    assert cli(["match", *paths, "--report", str(tmp_path / "none" / "m.html")]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_click_on_a_room_of_either_map_opens_its_match(flats, matching, tmp_path: Path) -> None:
    save_match_report(matching, *flats, tmp_path / "m.html")
    with Page(tmp_path / "m.html", tmp_path / "profile") as page:
        for room in ("a1", f"b{matching.rooms[2, 1]}"):
            of = f"document.querySelector('#places .plan-view [data-room={room}]')"
            page.run(f"{of}.dispatchEvent(new Event('click', {{bubbles: true}}))")
            opened = page.run("[...document.querySelectorAll('#places details[open]')].map((d) => d.dataset.roomOfA).join()")
            assert opened == ("1" if room == "a1" else "2")
        assert page.console == []
