"""`make weights`: in order, resumable, and it says how long is left."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from topomerge.registry import TASKS
from topomerge.training import weights


def test_steps_run_in_order_and_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    made: list[str] = []

    def make(task: str, runs: Path, shared: list[str]) -> None:
        if task == "match_odds" and "match_odds" not in made:
            made.append(task)
            raise KeyboardInterrupt
        made.append(task)

    monkeypatch.setattr(weights, "make_task", make)
    assert weights.main([f"runs={tmp_path}"]) == 130
    scans = ["plan_segmentation", "grid_segmentation", "drawing_segmentation", "door_classification", "wall_segmentation"]
    scans += ["passages", "wall_doors", "room_odds", "embedding", "room_matcher"]
    assert made == [*scans, "feature_scale", "match_odds"]
    assert "in all about" in capsys.readouterr().err
    assert weights.main([f"runs={tmp_path}"]) == 0 and made[12:] == [
        "match_odds",
        "place_evidence",
        "match_belief",
        "merge_belief",
        "radio_law",
        "locate_odds",
    ]
    said = capsys.readouterr().err
    assert "plan_segmentation: is there" in said and set(TASKS) <= set(json.loads((tmp_path / "seconds.json").read_text()))
    assert weights.main([f"runs={tmp_path}", "only=nothing"]) == 1 and "only=nothing" in capsys.readouterr().err


@pytest.mark.longer
def test_each_step_is_a_task_with_its_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(weights, "train", lambda settings, log_line: asked.append(settings))
    monkeypatch.setattr("topomerge.datasets.pairs.build.build", lambda settings, log_line: asked.append(settings))
    for task in TASKS:
        weights.make_task(task, tmp_path, ["jobs=2", f"cache={tmp_path}", "export="])
    sets, settings = [a.data.name for a in asked if not hasattr(a, "task")], [a for a in asked if hasattr(a, "task")]  # type: ignore[attr-defined]
    assert sets == ["train_walks", "val_small"] and [s.task for s in settings] == list(TASKS)
    embedding = settings[list(TASKS).index("embedding")]
    assert (
        embedding.epochs == 12
        and embedding.precision == "bf16-mixed"
        and embedding.network.node.around == 10
        and settings[0].jobs == 2
    )
    assert all(s.cache == str(tmp_path) and s.export == "" and s.name == s.task for s in settings)
