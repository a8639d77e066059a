"""Walls against the truth: one small building, its table between the marks, and its measures on faces that are known."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from topomerge.evaluation.tasks import run_task
from topomerge.types import Array


@pytest.mark.longer
def test_one_small_case(tmp_path) -> None:
    page = tmp_path / "results.md"
    page.write_text("before\n<!-- walls:begin -->\nold\n<!-- walls:end -->\nafter\n")
    words = ["data=dev", "data.only=house-2", f"cache={tmp_path}", f"folder={tmp_path}", f"write={page}"]
    assert "house-2" in run_task("walls", words, lambda text: None).summary
    text = page.read_text()
    cells = [cell.strip() for cell in text.split("| all |")[1].splitlines()[0].split("|")]
    assert text.startswith("before") and text.endswith("after\n") and "\nold\n" not in text
    off, present, none = (float(cells[i]) for i in (2, 5, 6))
    assert off <= 0.03 and present >= 0.9 and none <= 0.1


def test_cases_are_of_the_validation_list() -> None:
    from topomerge.datasets.plans.splits import find_split

    benchmark = importlib.import_module("topomerge.evaluation.walls")
    assert {find_split("procedural", str(case.seed)) for case in benchmark.draw_cases(False)} == {"validation"}
    assert {find_split("procedural", str(case.seed)) for case in benchmark.draw_cases(True)} == {"train"}


@pytest.mark.parametrize(("shift", "off"), [(0.05, 0.05), (0.3, 0.3), (0.5, np.inf)])
def test_a_face_is_as_far_off_as_it_was_moved(shift: float, off: float) -> None:
    benchmark = importlib.import_module("topomerge.evaluation.walls")
    true: Array = np.column_stack([np.arange(0, 5, 0.05), np.zeros(100)])
    out = np.tile([0.0, 1.0], (100, 1))
    assert benchmark.measure_distances(true + (0, shift), out, true, out) == pytest.approx(np.full(100, off))
    assert np.isinf(benchmark.measure_distances(true, -out, true, out)).all(), "it looks the other way"
