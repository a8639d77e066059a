"""The evaluation of rooms runs, goes on where it was, and writes its tables between the marks."""

from __future__ import annotations

import importlib
from dataclasses import replace

import pytest

from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.evaluation.documents import read_stamp
from topomerge.evaluation.tasks import run_task


@pytest.fixture
def benchmark():
    return importlib.import_module("topomerge.evaluation.rooms")


def test_one_small_case(benchmark, tmp_path, monkeypatch) -> None:
    page = tmp_path / "results.md"
    page.write_text("# Results\nbefore\n<!-- dev:begin -->\nold\n<!-- dev:end -->\nafter\n")
    words = ["data=dev", "data.only=house-2", f"cache={tmp_path}", f"folder={tmp_path / 'out'}", f"write={page}", "pictures=true"]
    (row,) = run_task("rooms", words, lambda text: None).rows
    assert not row["error"] and 0 <= row["iou"] <= 1 and row["rooms"] >= 3
    assert len(list((tmp_path / "out" / "pictures").glob("*.png"))) == len(list((tmp_path / "scans").iterdir())) == 1
    text = page.read_text()
    assert "before" in text and "after" in text and "\nold\n" not in text and "| dev | default | 1 |" in text
    assert read_stamp(text.split("begin -->")[1]).command.startswith("python evaluate.py task=rooms data=dev")
    monkeypatch.setattr(benchmark, "measure_case", None)  # the second time nothing is left to do
    assert f"{row['iou']:.2f}" in run_task("rooms", words, lambda text: None).summary


def test_a_set_or_a_preset_that_is_not_there_is_named(tmp_path) -> None:
    for words, said in ((["data=nowhere"], "data.set=nowhere"), (["presets=best"], "presets=best"), (["limit=3"], "limit")):
        with pytest.raises(InputError, match=said):
            run_task("rooms", [*words, f"folder={tmp_path}", f"cache={tmp_path}"], lambda text: None)


def test_marked_places_are_counted_by_what_the_map_says(benchmark) -> None:
    map = building(2)
    rooms = map.rooms.copy()
    rooms["glimpsed"], rooms["outside"] = [False, True, True, False, False], [0, 0, 0.7, 0, 0]
    at = [tuple(map.rooms["centroid"][r, :2].tolist()) for r in range(4)]
    counts = benchmark.count_marks(replace(map, rooms=rooms), {"fan": [*at[1:3], (-50.0, 0.0)], "room": [at[0], at[3]]})
    assert counts["fan"] == {"room": 0, "glimpsed": 1, "outside": 1, "no room": 1}
    assert counts["room"] == {"room": 2, "glimpsed": 0, "outside": 0, "no room": 0}
    table = benchmark.tabulate_marks([{"marks": counts}, {"marks": counts}, {}])
    assert "| fans of rays | 6 | 0 | 2 | 2 | 2 |" in table and "| painted letters | 0 | 0 | 0 | 0 | 0 |" in table


def test_sets_keep_to_their_buildings(benchmark) -> None:
    """Development sees training buildings only, everything else test buildings; no two maps share a name."""
    from topomerge.datasets.plans.splits import find_split

    cases = importlib.import_module("topomerge.evaluation.cases")
    for name, group in cases.GROUPS.items():
        found = group()
        assert len({c.name for c in found}) == len(found)
        for case in found:
            if case.source in ("procedural", "r2v", "campus"):
                of = find_split(case.source, str(case.seed) if case.source == "procedural" else case.building)
                assert of == ("train" if name == "dev" else "test"), case.name
    assert len(cases.select_cases(["all"], 1)) == len({c.set for c in cases.select_cases(["all"])})


@pytest.mark.longer
@pytest.mark.data
def test_rooms_of_a_robot_grid_are_those_of_its_segmentation(benchmark, data_dir, tmp_path) -> None:
    """IPA's own lab: at most one of the ten rooms that a person drew is missing, whatever corners are rooms beside them."""
    from topomerge.datasets.simulation.floor_truth import evaluate_map

    from topomerge.extraction.extract import extract

    scans = importlib.import_module("topomerge.evaluation.scans")
    case = scans.Case("grids", "ipa", "lab_ipa", "")
    scan = scans.load_scan(case, tmp_path, data_dir)
    rooms = evaluate_map(extract(scan.cloud, voxel_size=benchmark.VOXEL), scan.truth).rooms
    assert len(rooms.each) == 10 and rooms.recall >= 0.9 and rooms.iou >= 0.8 and rooms.precision >= 0.75
