"""The benchmark of the extraction runs, goes on where it was, and writes its tables between the marks."""

from __future__ import annotations

import importlib
import json

import pytest


@pytest.fixture
def benchmark():
    return importlib.import_module("benchmarks.extraction.run")


def test_one_small_case(benchmark, tmp_path, capsys, monkeypatch) -> None:
    page = tmp_path / "results.md"
    page.write_text("# Results\nbefore\n<!-- extraction:begin -->\nold\n<!-- extraction:end -->\nafter\n")
    words = ["--dev", "--only", "house-2", "--out", str(tmp_path / "out"), "--scans", str(tmp_path / "scans")]
    words += ["--write", str(page), "--pictures"]
    assert benchmark.main(words) == 0
    row = json.loads((tmp_path / "out" / "results.jsonl").read_text())
    assert not row["error"] and 0 <= row["iou"] <= 1 and row["rooms"] >= 3
    assert len(list((tmp_path / "out" / "pictures").glob("*.png"))) == len(list((tmp_path / "scans").iterdir())) == 1
    text = page.read_text()
    assert "before" in text and "after" in text and "old" not in text and "| dev | 1 |" in text
    monkeypatch.setattr(benchmark, "measure", None)  # the second time nothing is left to do
    assert benchmark.main(words) == 0
    assert f"{row['iou']:.2f}" in capsys.readouterr().out


def test_sets_keep_to_their_buildings(benchmark) -> None:
    """Development sees training buildings only, everything else test buildings; no two maps share a name."""
    from topomerge.datasets.plans.splits import split_of

    cases = importlib.import_module("benchmarks.extraction.cases")
    for name, group in cases.GROUPS.items():
        found = group()
        assert len({c.name for c in found}) == len(found)
        for case in found:
            if case.source in ("procedural", "r2v", "campus"):
                of = split_of(case.source, str(case.seed) if case.source == "procedural" else case.building)
                assert of == ("train" if name == "dev" else "test"), case.name
    assert len(cases.chosen(["all"], 1)) == len({c.set for c in cases.chosen(["all"])})


@pytest.mark.longer
@pytest.mark.data
def test_rooms_of_a_robot_grid_are_those_of_its_segmentation(benchmark, data_dir, tmp_path) -> None:
    """IPA's own lab: at most one of the ten rooms that a person drew is missing, whatever corners are rooms beside them."""
    from topomerge.datasets.simulation.floor_truth import judge

    from topomerge.extraction.extract import extract

    scans = importlib.import_module("benchmarks.extraction.scans")
    case = scans.Case("grids", "ipa", "lab_ipa", "")
    scan = scans.load(case, tmp_path, data_dir)
    rooms = judge(extract(scan.cloud, voxel_size=case.voxel), scan.truth).rooms
    assert len(rooms.each) == 10 and rooms.recall >= 0.9 and rooms.iou >= 0.8 and rooms.precision >= 0.75
