"""The notebook of the documents: it runs from top to bottom. `python -m tests.test_notebook` runs it and keeps what it prints."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from tests.forked import run_words

ROOT = Path(__file__).parent.parent
NOTEBOOK = ROOT / "docs" / "own-maps.ipynb"


def read_notebook() -> dict[str, Any]:
    """The notebook as it is stored."""
    notebook: dict[str, Any] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return notebook


def execute_cells(notebook: dict[str, Any]) -> list[str]:
    """What each cell of code prints, run one after the other in this process and the current folder."""
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = []
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile("".join(cell["source"]), str(NOTEBOOK), "exec"), names)
            printed.append(out.getvalue())
    return printed


def test_the_notebook_can_be_opened() -> None:
    notebook = read_notebook()
    assert notebook["nbformat"] == 4 and notebook["nbformat_minor"] >= 5
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for cell in code:
        compile("".join(cell["source"]), str(NOTEBOOK), "exec")
        assert cell["outputs"], "it is kept with what it prints: python -m tests.test_notebook"
    assert len(code) >= 5


def run_in_fork(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
    """Do what `subprocess.run` does for the commands of the notebook."""
    return run_words(words[words[0] == sys.executable :], Path.cwd())


@pytest.mark.longer
def test_the_notebook_runs(tmp_path: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cache").symlink_to(own_cache)
    monkeypatch.setattr(subprocess, "run", run_in_fork)
    printed = execute_cells(read_notebook())
    assert "recall@1" in "".join(printed) and "rooms in the joined map" in printed[-1]
    assert (tmp_path / "tuned" / "embedder.onnx").is_file() and (tmp_path / "joined" / "report.html").is_file()


def main() -> None:
    """Run the notebook in a folder that is removed, and keep what its cells print."""
    notebook = read_notebook()
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        printed = execute_cells(notebook)
    for number, (cell, text) in enumerate(
        zip([c for c in notebook["cells"] if c["cell_type"] == "code"], printed, strict=True), 1
    ):
        cell["execution_count"] = number
        cell["outputs"] = [{"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)}] if text else []
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
