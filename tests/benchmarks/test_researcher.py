"""The list of a researcher's tasks runs as it is typed, from nothing to a merge."""

from __future__ import annotations

import pytest

from benchmarks.speed import researcher


@pytest.mark.slow
def test_each_line_of_the_list_runs(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("optuna")
    pytest.importorskip("torch_geometric")
    researcher.main()  # ends where a line fails
    told = capsys.readouterr().out
    assert all(f"# {what}: " in told for what, _ in researcher.STEPS)
