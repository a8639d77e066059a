"""What Rerun is given of an atlas: each component, its rooms and links; a file that its own reader opens."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import topomerge as tm
from tests.fusion.atlas.test_watch import room
from topomerge.cli.main import main
from topomerge.errors import InputError
from topomerge.viz.rerun_log import RerunLog


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'topomerge\[rerun\]'"):
        RerunLog(tmp_path / "a.rrd")


@pytest.mark.longer
def test_a_watch_writes_a_file_that_can_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    Path("scans").mkdir()
    for k in range(2):
        tm.save_map(room(k), Path("scans") / f"{k}.tmap")
    assert main(["watch", "scans", "-o", "site", "--once", "--rerun", "a.rrd", "--settle", "0.05", "--every", "0.05"]) == 0
    words = [sys.executable, "-m", "rerun", "rrd", "print", "a.rrd"]
    printed = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout
    for n in range(2):
        for part in ("cells", "rooms", "maps"):
            assert f"/atlas/component_{n}/{part}" in printed
