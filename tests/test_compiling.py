"""Processes of tests that start with nothing compiled.

Linear algebra takes one thread where the compiled loops need the cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from topomerge.blas import limit_blas_threads

CALLS = """
from tests.compiling import compile_once
compile_once()
import numpy as np
from topomerge.kernels import voxels
voxels.encode(np.array([[1, 1, 1]]))
print(sum(voxels._encode.stats.cache_misses.values()))
"""
ROOT = Path(__file__).parent.parent


@pytest.mark.longer
def test_two_processes_compile_a_kernel_once(tmp_path: Path) -> None:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT), "TOPOMERGE_COMPILE_AHEAD": "0"}
    both = [subprocess.Popen([sys.executable, "-c", CALLS], stdout=subprocess.PIPE, text=True, env=env) for _ in range(2)]
    assert sorted(process.communicate(timeout=120)[0] for process in both) == ["0\n", "1\n"]


def blas_threads() -> set[int]:
    assert np.eye(2).any()  # loads a library of linear algebra
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    @limit_blas_threads
    def work(number: int, *, fails: bool = False) -> tuple[int, set[int]]:
        """What it does."""
        if fails:
            raise ValueError("no")
        return number, blas_threads()

    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert work(3) == (3, {1}) and blas_threads() == before
        with pytest.raises(ValueError, match="no"):
            work(3, fails=True)
        assert blas_threads() == before and max(before) == 2
    assert work.__doc__ == "What it does."
