"""The benchmarks of speed run without arguments: each on so little that it takes seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.speed.__main__ import COMPARED, SMALL, compare_with_recorded, main, measure_ratios

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


def test_ratios_stand_beside_the_recorded_ones(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert set(COMPARED) <= set(SMALL)
    modules = {
        "benchmarks.speed.one": SimpleNamespace(main=lambda n: print(f"# a remark\nfast 1.0 {n}.0 {n}.0\n| a | table |")),
        "benchmarks.speed.two": SimpleNamespace(main=lambda: sys.exit("needs a package")),
    }
    monkeypatch.setattr("benchmarks.speed.__main__.COMPARED", {"one": {"n": 3}, "two": {}})
    monkeypatch.setattr("benchmarks.speed.__main__.import_module", modules.__getitem__)
    ratios = measure_ratios()
    assert ratios == {"fast": 3.0} and capsys.readouterr().out == "# two: needs a package\n"
    lines = compare_with_recorded(ratios, {"fast": 1.5, "gone": 2.0})
    assert [line.split() for line in lines[1:]] == [["fast", "3.0", "1.5", "2.00"], ["gone", "-", "2.0", "-"]]
