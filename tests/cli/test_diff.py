"""`topomerge diff`: statuses, what is printed, and what is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import topomerge
from tests.changes.flats import TABLE, flat_map
from topomerge.cli.main import main as cli
from topomerge.types import Sim3

TURNED = Sim3(0.7, (30.0, -12.0, 1.5))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    topomerge.save_map(flat_map(), "old.tmap")
    topomerge.save_map(flat_map(wall=True, box=TABLE), "new.tmap")
    topomerge.save_map(flat_map(frame=TURNED, wall=True), "turned.tmap")
    return tmp_path


def test_one_frame(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["diff", "old.tmap", "new.tmap", "--aligned", "-o", "out", "--geojson", "c.geojson", "--bcf", "c.bcf"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("1 wall new, 1 door new, 1 room split, 1 furniture new; both maps saw ")
    assert out.endswith("-> out/diff.html out/changes.json c.geojson c.bcf\n")
    assert sorted(p.name for p in (folder / "out").iterdir()) == ["changes.json", "diff.html"]


def test_json_instead_of_tables(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["diff", "old.tmap", "new.tmap", "--aligned", "--json", "--least", "0.9"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "compared" and all(c["probability"] >= 0.9 for c in told["changes"])


@pytest.mark.longer
def test_aligned_first(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["diff", "old.tmap", "turned.tmap", "--threshold", "0.01", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["counts"] == {"wall new": 1, "door new": 1, "room split": 1} and told["reason"].startswith("aligned: ")


@pytest.mark.longer
def test_what_cannot_be_aligned_has_status_2(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["diff", "old.tmap", "turned.tmap", "--threshold", "1", "--json", "-o", "out"]) == 2
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["status"] == "not aligned" and told["reason"] in err and not (folder / "out").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["old.tmap", "nowhere.tmap"], "nowhere.tmap: no such file"),
        (["old.tmap", "old.tmap"], "old.tmap: is given twice"),
        (["old.tmap", "new.tmap", "--bcf", "c.zip"], "c.zip: --bcf writes .bcf"),
        (["old.tmap", "new.tmap", "--least", "2"], "must be a number from 0 to 1"),
        (["old.tmap", "new.tmap", "--geojson", "old.tmap"], "old.tmap: --geojson writes .geojson"),
    ],
)
def test_bad_input_has_status_1(folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    assert cli(["diff", *words]) == 1
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
