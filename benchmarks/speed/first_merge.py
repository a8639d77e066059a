"""Time the compilation at the first import on a machine: `python -m benchmarks.speed.first_merge` prints loops, seconds by the
clock and of processors. Nothing that was compiled before is used, and nothing is kept."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from tempfile import TemporaryDirectory

from topomerge.kernels.ahead import load_loops


def main() -> None:
    """Print a line."""
    with TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run([sys.executable, "-c", "import topomerge.kernels"], env=environment, check=True, stderr=subprocess.DEVNULL)
        seconds, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    signatures = sum(map(len, load_loops().values()))
    print(f"# {signatures} signatures: {seconds:.1f} s, {busy:.1f} s of processors, {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
