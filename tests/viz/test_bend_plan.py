"""A bent merge on the page: outlines that bend with the slider, arrows of the right length, a table; rigid ones have none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from tests.types.test_deformation import deformation
from tests.viz import test_report as report
from tests.viz.bent_merge import SWAY, bent_merge
from topomerge.fusion.result import MergeResult, Placement
from topomerge.types import Sim3
from topomerge.viz.merge_plan import PieceShifts, choose_arrow_factor, deform_path, render_arrows, render_deformation_table
from topomerge.viz.merge_report import render_merge_html
from topomerge.viz.svg import lay_out

pytestmark = pytest.mark.longer  # all are of one merge


@pytest.fixture(scope="module")
def merged() -> MergeResult:
    return bent_merge()


@pytest.fixture(scope="module")
def text(merged: MergeResult) -> str:
    return render_merge_html(merged)


def corners(d: str) -> list[np.ndarray]:
    """(n, 2) cm of each ring."""
    rings = [np.array([int(v) for v in re.findall(r"-?\d+", ring)]).reshape(-1, 2) for ring in d.split("z")[:-1]]
    return [np.cumsum(ring, axis=0) for ring in rings]


def test_outlines_are_drawn_bent_and_keep_the_rigid_ones(merged: MergeResult, text: str) -> None:
    paths = [p for p in report.Page(text).all("path") if "data-rigid" in p]
    assert len(paths) == len(merged.maps[1].rooms) + 1  # of b: its rooms and its walls; a is rigid
    most = 0.0
    for path in paths:
        for rigid, bent in zip(corners(path["data-rigid"] or ""), corners(path["d"] or ""), strict=True):
            assert rigid.shape == bent.shape
            most = max(most, float(np.hypot(*(bent - rigid).T).max()))
    assert 0.8 * 100 * SWAY < most < 1.2 * 100 * SWAY
    assert render_merge_html(merged) == text


def test_straight_edges_bend(merged: MergeResult) -> None:
    b = merged.maps[1]
    sheet, _ = lay_out(b, "b")
    d = "M0 0l2000 0 0 40 -2000 0z"
    rigid, bent = deform_path(d, sheet, merged.bends[1], 1.0)
    (outline,), (bow,) = corners(rigid), corners(bent)
    assert len(outline) == len(bow) == 22 and outline[0].tolist() == [0, 0] and [2000, 40] in outline.tolist()
    places = np.column_stack([sheet.convert_to_metres(outline), np.ones(len(outline))])
    assert np.array_equal(bow, sheet.convert_to_cm(merged.bends[1].apply(places)))
    assert np.ptp(bow[:11, 1]) > 100 * SWAY / 2


def test_arrows_say_their_true_length(merged: MergeResult, text: str) -> None:
    shifts = PieceShifts.from_deformation(merged.bends[1])
    words = re.search(r"drawn (\d+) times as long as the move", text)
    assert words
    factor = int(words[1])
    longest = factor * shifts.length.max()
    assert choose_arrow_factor([shifts], lay_out(merged.maps[0])[0]) <= factor and 0.9 < longest < 2.5
    titles = re.findall(r"<title>(b, room \d+: moved by [^<]*)</title>", text)
    assert len(titles) == (shifts.length >= 0.001).sum()
    assert f"moved by {100 * shifts.length.max():.0f} cm" in " ".join(titles)
    shafts = [p["d"] or "" for p in report.Page(text).all("path", "shaft")]
    drawn = [np.array([int(v) for v in re.findall(r"-?\d+", d)[:4]]).reshape(2, 2) for d in shafts]
    lengths = np.array([np.hypot(*(end - start)) for start, end in drawn])
    assert np.allclose(lengths, 100 * factor * shifts.length[shifts.length >= 0.001], atol=1.5)


def test_arrows_stand_on_their_storey_and_are_not_too_many() -> None:
    moves = np.random.default_rng(0).normal(0, (0.2, 0.2, 0.01, 0.0), (1200, 4))
    moves[1199] = 0
    shifts = PieceShifts.from_deformation(deformation(moves, storeys=2))
    sheet, _ = lay_out(building(2, 2))
    drawn = [str(render_arrows("b", shifts, storey, sheet, 5)) for storey in (0, 1, 2)]
    assert [d.count("<title>") for d in drawn] == [400, 400, 0]
    still = PieceShifts.from_deformation(deformation(np.zeros((4, 4))))
    assert (
        "<title>" not in render_arrows("b", still, 0, sheet, 1)
        and choose_arrow_factor([still, PieceShifts.from_deformation(None)], sheet) == 500
    )


def test_the_table_names_the_largest(merged: MergeResult) -> None:
    places = [Placement(Sim3()), Placement(Sim3(), merged.bends[1])]
    words = re.sub("<[^>]*>", "|", render_deformation_table(places, ("a", "b"), ("a", None)))
    shifts = PieceShifts.from_deformation(merged.bends[1])
    room = int(shifts.room[shifts.length.argmax()])
    assert "|a||rigid||–|" in words
    assert f"|{100 * shifts.length.max():.0f} cm||{100 * np.median(shifts.length):.0f} cm|" in words
    assert f"|room {room}, storey 0|" in words.replace("||", "|")


def test_a_rigid_merge_has_neither_arrows_nor_slider(merged: MergeResult) -> None:
    text = render_merge_html(replace(merged, bends={}))
    page = report.Page(text)
    assert not [p for p in page.all("path") if "data-rigid" in p] and not page.all("g", "bend-arrows")
    assert "data-bend=" not in text and "data-bend>" not in text and "How the maps were bent" not in text


PROBE = """
addEventListener("load", () => setTimeout(() => {
  const seen = {}, slider = document.querySelector("[data-bend]"), path = document.querySelector("[data-rigid]");
  const bent = path.getAttribute("d"), rigid = path.dataset.rigid, numbers = (d) => d.match(/-?[\\d.]+/g).map(Number);
  const arrows = document.querySelector(".bend-arrows");
  seen.arrows = [arrows.getBoundingClientRect().width > 100];
  document.querySelector('[data-layer="bends"]').click();
  seen.arrows.push(arrows.getBoundingClientRect().width > 100);
  const shown = [0, 0.5, 1].map((share) => {
    slider.value = share;
    slider.dispatchEvent(new Event("input"));
    return path.getAttribute("d");
  });
  const [a, m, b] = shown.map(numbers), middle = m.every((v, i) => Math.abs(v - (a[i] + b[i]) / 2) < 0.06);
  seen.bends = [shown[0] === rigid, middle, shown[2] === bent, rigid !== bent];
  document.title = JSON.stringify(seen);
}, 500));
"""


def test_the_slider_bends_the_outlines_in_a_browser(text: str, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text(report.with_probe(text, PROBE), encoding="utf-8")
    shown, console = report.browse(page, "--dump-dom", "--disable-3d-apis")
    assert console == []
    title = re.search("<title>(.*?)</title>", shown)
    assert title
    assert json.loads(title[1].replace("&quot;", '"')) == {"arrows": [True, False], "bends": [True, True, True, True]}
