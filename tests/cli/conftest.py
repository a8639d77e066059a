"""A fixture for all commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.processes import Run
from topomerge.cli.main import main as cli


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Call `main` in an empty folder; gives status, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TOPOMERGE_DEBUG", raising=False)

    def call(*words: str) -> tuple[int, str, str]:
        status = cli(words)
        out, err = capsys.readouterr()
        return status, out, err

    return call
