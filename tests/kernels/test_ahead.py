"""Loops are compiled ahead of their first use, once, and no others are needed by an extraction and a merge."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from topomerge.kernels import ahead, count_threads, run_in_slices, set_thread_count

MOST_SIGNATURES = 64  # compiled at the first merge on a machine; one of them samples meshes and building models
MERGE = """
import sys
from topomerge.cli.main import main
assert main(["simulate", "--building", "office", "--seed", "5", "--rooms", "4", "--overlap", "0.9", "-o", "pair", "-q"]) == 0
import topomerge.kernels
from topomerge.kernels import ahead
loops = ahead.load_loops()
from numba.core.dispatcher import Dispatcher
named = {(n, k): v for n in sys.modules if n.startswith("topomerge.kernels.") for k, v in vars(sys.modules[n]).items()}
every = {v: f"{n}.{k}" for (n, k), v in named.items() if isinstance(v, Dispatcher) and v.py_func.__module__ == n}
before = {loop: set(loop.signatures) for loop in every}
assert main(["merge", "pair/a.ply", "pair/b.ply", "-o", "merged", "-q"]) == 0
# Walls do not decide this one: rooms are compared, too.
words = "simulate --building apartment --seed 1 --sensors depth,depth --rooms 4 --overlap 0.5 -o flat -q"
assert main(words.split()) == 0
assert main(["merge", "flat/a.ply", "flat/b.ply", "-o", "flat/merged", "-q"]) == 2
assert "topomerge.matching.room_matcher" in sys.modules
from numba.core.sigutils import normalize_signature
for loop, name in every.items():
    known = {normalize_signature(f"({text},)")[0] for text in loops.get(loop, ())}
    for signature in set(loop.signatures) - before[loop] - known:
        print(name, signature)
"""


@pytest.fixture
def three_threads() -> object:
    before = count_threads()
    set_thread_count(3)
    yield
    set_thread_count(before)


def run(code: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, **environment, "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=env, cwd=cwd, timeout=300, check=False
    )


def test_signatures_are_few() -> None:
    assert sum(map(len, ahead.load_loops().values())) <= MOST_SIGNATURES


@pytest.mark.longer
def test_a_merge_needs_no_others(tmp_path: Path) -> None:
    done = run(MERGE, tmp_path)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_compiled_loops_are_loaded_without_the_compiler() -> None:
    """Each symbol that their code names is found, and the rest of numba stays away."""
    code = """
import sys, numpy as np
from numba.core.sigutils import normalize_signature
from topomerge.kernels import ahead, octree, voxels
for loop, signatures in ahead.load_loops().items():
    for signature in signatures:
        loop.compile(normalize_signature(f"({signature},)")[0])
    assert sum(loop.stats.cache_hits.values()) == len(signatures), loop
assert voxels.decode(voxels.encode(np.array([[1, 2, 3]]))).tolist() == [[1, 2, 3]]
print("numba.np.polynomial.polynomial_core" in sys.modules, "scipy.linalg" in sys.modules)
import numba
assert numba.njit(lambda x: np.sqrt(x).sum())(np.ones(3)) == 3  # the compiler, where it is needed after all
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=100)
    assert (done.returncode, done.stdout) == (0, "False False\n"), done.stderr


@pytest.mark.slow
def test_two_processes_compile_each_loop_once(tmp_path: Path) -> None:
    code = "import topomerge.kernels"
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    both = [subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, env=env) for _ in range(2)]
    told = [process.communicate(timeout=300)[1] for process in both]
    assert sorted(bool(text) for text in told) == [False, True] and max(told).count("\n") == 1
    assert len(list(tmp_path.rglob("*.nbc"))) == sum(map(len, ahead.load_loops().values()))
    assert run(code, tmp_path, NUMBA_CACHE_DIR=str(tmp_path)).stderr == ""  # it is noted


def test_what_is_noted_is_not_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[int] = []
    monkeypatch.delenv(ahead.SWITCH, raising=False)
    monkeypatch.setattr(ahead, "_run_workers", lambda count: runs.append(count) or len(runs) > 1)
    for _ in range(3):
        ahead.compile_missing(tmp_path, 2)
    assert runs == [2, 2]  # the first one failed, the second one is noted
    monkeypatch.setattr(ahead, "_describe_sources", lambda: "a changed file")
    ahead.compile_missing(tmp_path, 2)
    assert len(runs) == 3
    monkeypatch.setenv(ahead.SWITCH, "0")
    ahead.compile_missing(tmp_path / "other", 2)
    assert len(runs) == 3 and not (tmp_path / "other").exists()


def test_a_folder_that_cannot_be_written_is_left(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ahead.compile_missing(tmp_path / "file" / "below", 1)  # they are compiled when they are called
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and not (tmp_path / "file").read_text()


def test_slices_cover_the_range_in_order(three_threads: object) -> None:
    def sum_squares(first: int, last: int, values: np.ndarray) -> tuple[int, int, int]:
        return first, last, int((values[first:last] ** 2).sum())

    values = np.arange(1000)
    parts = run_in_slices(sum_squares, 1000, 10, values)
    assert len(parts) == 12 and [part[0] for part in parts] == [0, *(part[1] for part in parts[:-1])] and parts[-1][1] == 1000
    assert sum(part[2] for part in parts) == (values**2).sum()
    assert run_in_slices(sum_squares, 19, 10, values) == [(0, 19, int((values[:19] ** 2).sum()))]
    assert run_in_slices(sum_squares, 0, 10, values) == [(0, 0, 0)]


def test_an_error_of_a_slice_is_raised(three_threads: object) -> None:
    def fail(first: int, last: int) -> None:
        if first:
            raise ValueError(last)

    with pytest.raises(ValueError, match="100"):
        run_in_slices(fail, 100, 50)
