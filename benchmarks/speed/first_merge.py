"""Time the compilation at the first import on a machine: `python -m benchmarks.speed.first_merge` prints loops, seconds by the
clock and of processors. Nothing that was compiled before is used, and nothing is kept. The peer of its line is one core alone."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from functools import partial
from tempfile import TemporaryDirectory

from benchmarks.speed.bench import print_line, run_timed
from topomerge.kernels.ahead import load_loops


def main() -> None:
    """Print two lines."""
    with TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        words = [sys.executable, "-c", "import topomerge.kernels"]
        compile_all = partial(subprocess.run, words, env=environment, check=True, stderr=subprocess.DEVNULL)
        _, seconds, busy = run_timed(compile_all, resource.RUSAGE_CHILDREN)
    print_line("first_merge", seconds, busy)
    signatures = sum(map(len, load_loops().values()))
    print(f"# {signatures} signatures: {seconds:.1f} s, {busy:.1f} s of processors, {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
