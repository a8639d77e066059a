"""`topomerge info`, and what any command prints of a stranger's file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.cli.processes import Run, process
from tests.scenes_map import building
from topomerge.io.maps import save_map


def test_info(run: Run, tmp_path: Path) -> None:
    save_map(building(1, 1), tmp_path / "a.tmap")
    status, out, _ = run("info", "a.tmap")
    assert status == 0 and out.startswith("building.ply: 3 rooms, 1 storey, 2 doors")
    status, out, err = run("info", "a.tmap", "--json")
    assert status == 0 and len(json.loads(out)["rooms"]) == 3
    (tmp_path / "bad.tmap").write_bytes((tmp_path / "a.tmap").read_bytes()[:-50])
    status, out, err = run("info", "bad.tmap")
    assert (status, out) == (1, "") and err.startswith("topomerge: bad.tmap: damaged") and err.count("\n") == 1


def test_a_strangers_map_does_not_steer_the_terminal(run: Run, tmp_path: Path) -> None:
    text = "\x1b[31mred\x07\x9b\u202e\x00\ud800.ply"
    save_map(replace(building(1, 1), source=text, warnings=(text,)), tmp_path / "a.tmap")
    status, out, err = run("info", "a.tmap")
    assert status == 0 and "red" in out and "red" in err
    assert all(c.isprintable() or c == "\n" for c in out + err)
    status, out, err = run("info", "\x1b[31mno.tmap")
    assert status == 1 and "\x1b" not in err


@pytest.mark.longer
def test_info_into_a_pipe_that_closed(tmp_path: Path) -> None:
    save_map(replace(building(1, 1), warnings=()), tmp_path / "a.tmap")
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "topomerge", "info", str(tmp_path / "a.tmap")]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.longer
def test_a_terminal_without_umlauts(tmp_path: Path) -> None:
    save_map(building(1, 1), tmp_path / "a.tmap")
    done = process("info", str(tmp_path / "a.tmap"), env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0 and "area m?" in done.stdout
