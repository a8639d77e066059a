"""`topomerge export-embedder`: what training made comes out as it is, or one line says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.cli.main import main as cli
from topomerge.embedding.learned import find_embedder, load_embedder
from topomerge.embedding.quarter_turns import get_rows

SHIPPED = str(find_embedder())


def test_an_embedder_comes_out_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["export-embedder", SHIPPED, "-o", str(tmp_path / "a" / "b")]) == 0
    assert "numbers a room" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == ["embedder.card.json", "embedder.onnx"]
    map = building(2, 2)
    rows = [get_rows(load_embedder(folder)(map)) for folder in (tmp_path / "a" / "b", SHIPPED)]
    assert rows[0].shape == (len(map.rooms), 4, 64) and np.array_equal(*rows)


@pytest.mark.parametrize(("run", "place"), [("nowhere", "a/b"), ("", "a"), (SHIPPED, "file"), (SHIPPED, "file/x"), (SHIPPED, "")])
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run: str, place: str
) -> None:
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert cli(["export-embedder", run, "-o", place]) == 1
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "; give " in err
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
