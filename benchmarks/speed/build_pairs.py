"""Building a set of pairs: seconds a pair of 15 rooms each on one core, what a second worker gives, and memory of a worker.

`pair` compares the median pair (simulated, extracted, cached) with the target of 6 s; `pair_cpu` does so with the seconds that
the processor worked, which other programs disturb less. `two_workers` compares the time that one worker process takes for the
same pairs with the time of two: 2 would be perfect. Both run in worker processes that have done a pair before, so that neither
pays for imports and compiled code; `busy` is the share of the time that workers worked, which shows where time is lost.
`memory` compares the peak of a worker, GB, with the target of 1.5 GB.
Run from the root: ``python -m benchmarks.speed.build_pairs [pairs]``.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
from dataclasses import replace
from statistics import median

from topomerge.datasets.pairs.example import make_file
from topomerge.datasets.pairs.items import Item, Recipe, draw_items

from benchmarks.speed.bench import print_line, run_timed
from topomerge.progress import Stopwatch

TARGET, LIMIT = 6.0, 1.5  # s a pair; GB a worker
SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
RECIPE = Recipe(
    name="bench",
    sources={"procedural": 1.0},
    kinds={"office": 1.0, "hotel": 1.0, "hospital": 1.0, "lab": 1.0},
    sensors={"tls": 1.0, "depth": 1.0, "lidar": 1.0},
    overlaps=[0.5],
    rooms=[15, 15],
)


def build_one(item: Item) -> tuple[float, float]:
    """Return the seconds of a pair, and those that the processor worked."""
    with tempfile.TemporaryDirectory() as folder:
        reason, seconds, worked = build_in_worker(item, folder)
    if reason:
        raise RuntimeError(reason)
    return seconds, worked


def warm_up(folder: str, number: int) -> int:
    """Do a pair in a worker; other workers get theirs meanwhile."""
    make_file(draw_items(replace(RECIPE, pairs=1, seed=1000 + number), {})[0], [], folder)
    return os.getpid()


def build_in_worker(item: Item, folder: str) -> tuple[str, float, float]:
    """Make a pair in a worker: why not, seconds, and seconds that the processor worked."""
    row, seconds, worked = run_timed(lambda: make_file(item, [], folder))
    return row.reason, seconds, worked


def time_all(items: list[Item], jobs: int) -> float:
    """Return the seconds that warm workers take for all items, the longest first, as `build` does."""
    from joblib.externals.loky import get_reusable_executor

    pool = get_reusable_executor(max_workers=jobs, timeout=600, kill_workers=True, env=dict.fromkeys(SINGLE, "1"))
    with tempfile.TemporaryDirectory() as folder:
        warm: set[int] = set()
        while len(warm) < jobs:
            warm |= set(pool.map(warm_up, [folder] * jobs, range(jobs), chunksize=1))
        watch = Stopwatch()
        rows = list(pool.map(build_in_worker, items, [folder] * len(items), chunksize=1))
        seconds = watch.elapsed
    if any(reason for reason, _, _ in rows):
        raise RuntimeError([reason for reason, _, _ in rows if reason])
    busy, worked = (sum(row[k] for row in rows) for k in (1, 2))
    print(f"# {jobs} at work: busy {busy / (jobs * seconds):.1%} of the time, processor {worked:.1f} s, clock {seconds:.1f} s")
    return seconds


def main(pairs: int = 24, rooms: int = 15) -> None:
    """Print the lines, of `pairs` pairs of maps of `rooms` rooms."""
    from joblib.externals.loky import get_reusable_executor

    items = draw_items(replace(RECIPE, pairs=pairs, rooms=[rooms, rooms]), {})
    build_one(items[0])  # compiles
    seconds, worked = zip(*(build_one(item) for item in items[:8]), strict=True)
    print_line("pair", median(seconds), TARGET)
    print_line("pair_cpu", median(worked), TARGET)
    print(f"# pairs of {rooms} rooms took {min(seconds):.1f} to {max(seconds):.1f} s")
    items.sort(key=lambda item: -item.rooms)
    alone = time_all(items, 1)
    print_line("two_workers", time_all(items, 2), alone)
    get_reusable_executor().shutdown(wait=True)
    print_line("memory", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20, LIMIT)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:2]))
