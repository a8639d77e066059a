"""Bars that show how far the work is."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from topomerge.cli import console
from topomerge.errors import InputError


class Terminal:
    """Stands for a stderr that is a terminal."""

    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


def test_bars_only_when_it_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    with console.ProgressBars() as bars:
        report = bars.start_task("read")
        assert report is not None
        report(0.5, "scan.ply")
    assert sys.stderr.text == ""  # type: ignore[attr-defined]
    with console.ProgressBars(delay=0.0) as bars:
        report = bars.start_task("read")
        assert report is not None
        report(0.2, "[odd] name")
        bars._timer.join()
        report(2.0, "[odd] name")
    report(1.0)  # a late word after the end does no harm
    assert "[odd] name" in sys.stderr.text  # type: ignore[attr-defined]
    assert console.ProgressBars(enabled=False).start_task("read") is None


def test_no_bars_without_a_terminal() -> None:
    with console.ProgressBars(delay=0.0) as bars:
        assert bars.start_task("read") is None


def test_links_in_a_circle_are_no_fault_of_ours(tmp_path: Path) -> None:
    (tmp_path / "a.ply").symlink_to("a.ply")
    with pytest.raises(InputError, match="no such file"):
        console.check_inputs([str(tmp_path / "a.ply")])
    console.check_outputs([tmp_path / "b.tmap"], [tmp_path / "a.ply"])


def test_a_failure_is_one_line_whatever_the_file_is_called() -> None:
    name = "no\nsuch.tmap"
    assert console.format_failure(ValueError(f"{name}: no such file"), [name]) == "no such.tmap: no such file"
    assert console.format_failure(ValueError("is empty"), [name]) == "no such.tmap: is empty"
