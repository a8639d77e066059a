"""Processes of tests that start with nothing compiled."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CALLS = """
from tests.compiling import compile_once
compile_once()
import numpy as np
from topomerge.kernels import voxels
voxels.encode(np.array([[1, 1, 1]]))
print(sum(voxels._encode.stats.cache_misses.values()))
"""
ROOT = Path(__file__).parent.parent


def test_two_processes_compile_a_kernel_once(tmp_path: Path) -> None:
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT), "TOPOMERGE_COMPILE_AHEAD": "0"}
    both = [subprocess.Popen([sys.executable, "-c", CALLS], stdout=subprocess.PIPE, text=True, env=env) for _ in range(2)]
    assert sorted(process.communicate(timeout=120)[0] for process in both) == ["0\n", "1\n"]
