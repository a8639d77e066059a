"""The page of models: a row for each experiment over its seeds, on the same pairs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from topomerge.errors import InputError
from topomerge.training.embedding import TASK
from topomerge.training.settings import Training, convert_to_dict
from topomerge.training.table import list_experiments, write_model_page

START = {"command": "python train.py experiment=x", "commit": "0123456789abcdef"}


def write_run(folder: Path, experiment: str, seed: int, score: float, watched: str = "1") -> None:
    """A run of one epoch."""
    run = folder / f"experiment={experiment},seed={seed}"
    run.mkdir(parents=True)
    settings = replace(Training(), seed=seed, name=run.name)
    (run / "config.json").write_text(json.dumps(convert_to_dict(settings)))
    row = {"epoch": 0, "seconds": 1.0, **{f"val/{name}": score for name in TASK.scores}}
    (run / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    data = {"data": {"name": "walks", "sha256": "0"}, "validation": {"name": "val", "sha256": watched}}
    (run / "run.json").write_text(json.dumps({"format": 1, "data": data, "starts": [START]}))


def test_every_experiment_has_a_row_over_its_seeds(tmp_path: Path) -> None:
    for name, seed, score in (("gat_all", 0, 0.5), ("gat_all", 1, 0.6), ("surroundings", 0, 0.9), ("surroundings", 1, 0.8)):
        write_run(tmp_path / "runs", name, seed, score)
    write_run(tmp_path / "runs", "gat_near", 0, 0.7)
    text = write_model_page(tmp_path / "runs", tmp_path / "models.md").read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert rows[0][:2] == ["| experiment", "geometry"] and [row[0] for row in rows[1:]] == [
        "| surroundings",
        "| gat_near",
        "| gat_all",
    ]
    column = rows[0].index("recall@1")
    assert rows[3][column] == "0.550, 0.500–0.600" and rows[2][column] == "0.700"
    assert [row[rows[0].index("seeds")] for row in rows[1:]] == ["2", "1", "2"]
    assert "**`surroundings` is first, `gat_all` is last (recall@1 of rooms 0.85 and 0.55).**" in text
    assert "One of the runs: `python train.py experiment=x` (commit 0123456)." in text
    assert "trained on `walks` and judged on the same pairs of `val`" in text
    missing = [name for name in list_experiments() if name not in ("gat_all", "gat_near", "surroundings")]
    assert f"Not trained yet: {', '.join(missing)}." in text and "gat_around" in missing and "ablation" not in missing


def test_runs_on_other_pairs_are_not_compared(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no run called experiment=NAME,seed=N"):
        write_model_page(tmp_path, tmp_path / "models.md")
    write_run(tmp_path, "gat_all", 0, 0.5)
    write_run(tmp_path, "gat_near", 0, 0.5, watched="2")
    with pytest.raises(InputError, match="gat_all,seed=0 and experiment=gat_near,seed=0 learned from, or watched, other pairs"):
        write_model_page(tmp_path, tmp_path / "models.md")
