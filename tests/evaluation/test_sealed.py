"""The sealed run: it appends and never overwrites, measures a version once, and needs the gate for what is sealed."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image
from topomerge.datasets.pairs.flat_maps import FlatMap
from topomerge.datasets.plans import sealed

from tests.datasets.plans import plan_files as write

Row = dict[str, Any]
FIRST = "## 2026-01-02 03:04 UTC: version 0.0.9, commit abc\n\n`make sealed`\n\n| a | b |\n"
ROOM: Row = {"part": "rooms", "group": "tls", "place": "x", "iou": 0.9, "mcc": 0.95, "recall": 1.0, "precision": 0.9}
MERGE: Row = {
    "part": "merges", "group": "procedural", "place": "y", "kind": "overlap", "common": 50.0, "overlap": 0.5, "right": True,
    "fine": False, "believed": True, "sensors": ["tls", "tls"], "differs": None,
}  # fmt: skip


@pytest.fixture
def module() -> ModuleType:
    return importlib.import_module("topomerge.evaluation.sealed")


@pytest.fixture
def measures() -> ModuleType:
    return importlib.import_module("topomerge.evaluation.sealed_measures")


@pytest.fixture
def page(tmp_path: Path, module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page with a block of an earlier version; the run measures nothing."""
    path = tmp_path / "sealed.md"
    path.write_text(module.HEAD + "\n" + FIRST, encoding="utf-8")
    monkeypatch.setattr(module, "run", lambda *_: [ROOM, MERGE, {"part": "merges", "group": "real plans", "failed": "torn"}])
    monkeypatch.setattr(module, "PAGE", path)
    monkeypatch.delenv("TOPOMERGE_DATA", raising=False)
    return path


def test_a_block_is_appended_and_the_first_stays_byte_for_byte(page: Path, module: ModuleType) -> None:
    before = page.read_bytes()
    assert module.main(["--jobs", "1"]) == 0
    after = page.read_bytes()
    assert after.startswith(before) and len(after) > len(before)
    added = after[len(before) :].decode()
    assert f"version {module.__version__}" in added and "`python -m topomerge.evaluation.sealed --jobs 1`" in added
    assert "| tls | 1 | 0.90" in added and "| procedural: at least 40 m² in common | 1 | 1 | 1 | 0 | 1 | 0 |" in added
    assert "Not measured: 1:" in added and "- merges, real plans: torn" in added and "measured 1 times" not in added
    assert module.main(["--again"]) == 0
    assert page.read_bytes().startswith(after)
    assert "This version had been measured 1 times before" in page.read_bytes()[len(after) :].decode()


def test_a_version_is_measured_once(page: Path, module: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert module.main([]) == 0
    before = page.read_bytes()
    assert module.main([]) == 1
    assert "a version is measured once (--again" in capsys.readouterr().err
    assert page.read_bytes() == before


def test_a_new_version_needs_no_word(page: Path, module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    assert module.main([]) == 0
    monkeypatch.setattr(module, "__version__", f"{module.__version__}.1")
    assert module.main([]) == 0
    assert module.list_blocks(page.read_text()) == ["0.0.9", module.__version__.removesuffix(".1"), module.__version__]


def test_a_crash_leaves_the_page_whole(page: Path, module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    before = page.read_bytes()

    def torn(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:  # while it measures
        patch.setattr(module, "run", torn)
        with pytest.raises(OSError, match="no space"):
            module.main([])
    assert page.read_bytes() == before
    with monkeypatch.context() as patch:  # while it writes: half of the bytes are there
        whole = Path.write_bytes
        patch.setattr(Path, "write_bytes", lambda path, data: (whole(path, data[: len(data) // 2]), torn()))
        with pytest.raises(OSError, match="no space"):
            module.main([])
    assert page.read_bytes() == before and [p.name for p in page.parent.iterdir()] == [page.name]


def test_the_first_block_makes_the_page(tmp_path: Path, module: ModuleType, page: Path) -> None:
    assert module.main(["--page", str(tmp_path / "new.md")]) == 0
    text = (tmp_path / "new.md").read_text(encoding="utf-8")
    assert text.startswith(module.HEAD) and len(module.list_blocks(text)) == 1


def test_a_small_run_writes_nowhere_unless_it_is_told(page: Path, module: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    before = page.read_bytes()
    assert module.main(["--small"]) == 0
    assert page.read_bytes() == before and "| tls | 1 |" in capsys.readouterr().out


def test_a_published_set_needs_a_folder(page: Path, module: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert module.main(["--public", "s3dis"]) == 1
    assert "give SOURCE=FOLDER" in capsys.readouterr().err


def test_the_page_in_the_docs_is_what_the_run_goes_on_with(module: ModuleType) -> None:
    text = (Path(module.__file__).parent.parent.parent / "docs" / "results" / "sealed.md").read_text(encoding="utf-8")
    assert text.startswith(module.HEAD)
    assert len(module.list_blocks(text)) == text.count("\n## ")


def test_what_is_counted(measures: ModuleType) -> None:
    wrong = {**MERGE, "right": False, "place": "z"}
    twin = {**MERGE, "kind": "twin-wing", "right": False, "believed": False}
    lines = list(measures.format_tables([MERGE, wrong, twin, {**twin, "differs": 0.1}, {**MERGE, "common": 3.0}]))
    assert any(line.startswith("| procedural: at least 40 m² in common | 2 | 2 | 1 | 0 | 1 | 1 | 1–99 % |") for line in lines)
    assert any(line.startswith("| procedural: less than 40 m² in common | 1 |") for line in lines)
    assert any(line.startswith("| procedural: twin wing | 1 | 1 | 0 | 0 | 0 | 0 | 0–98 % |") for line in lines)
    assert any(line.startswith("| procedural: twin wing, which nobody can tell apart | 1 |") for line in lines)


def test_halves_of_a_floor_share_the_middle() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 10, 0.1), np.arange(0, 10, 0.1)))
    flat = FlatMap(np.zeros((1, 2)), np.column_stack([x, y]), 0.1)
    a, b = importlib.import_module("topomerge.evaluation.sealed_measures").cut_floor(flat, 3)
    both = len({tuple(p) for p in a.free.tolist()} & {tuple(p) for p in b.free.tolist()})
    assert len(a.free) == pytest.approx(0.65 * len(flat.free), rel=0.03) == pytest.approx(len(b.free), rel=0.03)
    assert both == pytest.approx(0.3 * len(flat.free), rel=0.1)


def test_one_bad_item_never_ends_a_run(measures: ModuleType) -> None:
    def bad() -> list[Row]:
        raise KeyError("gone")

    (row,) = measures.measured(measures.SealedItem("rooms", "tls", bad, ()))
    assert row == {"part": "rooms", "group": "tls", "failed": "KeyError: 'gone'"}


def made_up(folder: Path) -> Path:
    """A folder of real data that is sealed by its names: a line map, and two grids of two places of which one is too small."""
    plan = folder / "utexas_amrl_vectormaps" / "AHG1"
    plan.mkdir(parents=True)
    write.amrl(plan / "AHG1.vectormap.json")
    grids = folder / "grids_rose2_homes_strands" / "Giraff"
    grids.mkdir(parents=True)
    for name in ("home_x", "home_y"):
        image = Image.new("L", (200, 160), 0)
        image.paste(254, (10, 10, 95, 150) if name == "home_x" else (10, 10, 60, 150))
        image.paste(254, (100, 10, 190, 150))
        image.paste(254, (60, 70, 110, 90))
        image.save(grids / f"{name}.png")
        about = "image: {}.png\nresolution: 0.1\norigin: [0, 0, 0]\noccupied_thresh: 0.65\nfree_thresh: 0.2\nnegate: 0\n"
        (grids / f"{name}.yaml").write_text(about.format(name))
    return folder


@pytest.mark.longer
def test_real_sites_are_measured_within_the_gate_only(tmp_path: Path, measures: ModuleType) -> None:
    data = made_up(tmp_path)
    item = measures.SealedItem("merges", "robots' grids", measures.measure_robot_pairs, (data,))
    shut = measures.measured(item)
    assert [row["failed"].split(": ")[:2] for row in shut] == [["home_x", "sealed"], ["home_y", "sealed"]]
    assert measures.list_sealed_plans(data) == []
    with sealed.open_sealed_set():
        assert measures.list_sealed_plans(data) == [(data / "utexas_amrl_vectormaps", "AHG1")]
        rows = measures.measured(item)
    assert [row["kind"] for row in rows] == ["overlap", "overlap", "other-building"]
    assert [row["place"] for row in rows] == ["strands/home_x", "strands/home_y", "strands/home_x + strands/home_y"]
    assert rows[0]["common"] > 20 and rows[2]["err"] is None
    ranking = measures.SealedItem("ranking", "robots' grids", measures.rank_robot_rooms, (data,))
    assert all("sealed" in row["failed"] for row in measures.measured(ranking))
    with sealed.open_sealed_set():
        ranked = measures.measured(ranking)
    assert [row["embedder"] for row in ranked] == ["learned", "engineered"] * (len(ranked) // 2) and ranked
    assert all(0 <= row["first"] <= row["five"] <= row["queries"] and row["queries"] >= 2 for row in ranked)
    lines = "\n".join(measures.format_tables([*ranked, {**ranked[0], "place": "another", "first": 0}]))
    assert f"| robots' grids | learned | {len(ranked) // 2 + 1} |" in lines and "| merges |" not in lines


@pytest.mark.slow
def test_a_small_run_from_end_to_end(tmp_path: Path, module: ModuleType) -> None:
    assert module.main(["--small", "--jobs", "2", "--page", str(tmp_path / "a.md")]) == 0
    text = (tmp_path / "a.md").read_text(encoding="utf-8")
    assert "| tls | 1 |" in text and "| procedural:" in text and "| procedural | learned | 1 |" in text
