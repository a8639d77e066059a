"""The benchmarks of speed run without arguments: each on so little that it takes seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.speed.__main__ import SMALL, main

ROOT = Path(__file__).parents[2]
SLOW = set(SMALL) - {"start"}  # processes that load compiled code: a minute together


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else []) for n in SMALL])
def test_a_benchmark_runs(name: str) -> None:
    if name in ("voxelise", "visibility"):
        pytest.importorskip("open3d")
    command = [sys.executable, "-m", "benchmarks.speed", "--small", name]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith(f"# {name}\n") and done.stdout.count("\n") >= 2


def test_every_benchmark_is_run() -> None:
    folder = ROOT / "benchmarks" / "speed"
    scripts = {p.stem for p in folder.glob("*.py") if "__name__" in p.read_text() and not p.stem.startswith("_")}
    assert scripts == set(SMALL)


def test_a_name_that_there_is_none_of_is_refused() -> None:
    with pytest.raises(SystemExit, match="benchmark 'none': start, "):
        main(["none"])
