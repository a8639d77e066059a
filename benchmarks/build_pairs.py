"""Building a set of pairs: seconds a pair of 15 rooms each on one core, what a second worker gives, and memory of a worker.

`pair` compares the median pair (simulated, extracted, cached) with the target of 6 s; `pair_cpu` does so with the seconds that
the processor worked, which other programs disturb less. `two_workers` compares the time that one worker takes for the same pairs
with the time of two: 2 would be perfect. `memory` compares the peak of a worker, GB, with the target of 1.5 GB.
Run from the root: ``python benchmarks/build_pairs.py [pairs]``.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

sys.path.insert(0, str(Path(__file__).parent))

from bench import line
from topomerge.datasets.build import Build, build
from topomerge.datasets.example import make_file
from topomerge.datasets.recipe import Item, Recipe, draw_items

TARGET, LIMIT = 6.0, 1.5  # s a pair; GB a worker
RECIPE = Recipe(
    name="bench",
    sources={"procedural": 1.0},
    kinds={"office": 1.0, "hotel": 1.0, "hospital": 1.0, "lab": 1.0},
    sensors={"tls": 1.0, "depth": 1.0, "lidar": 1.0},
    overlaps=[0.5],
    rooms=[15, 15],
)


def one(item: Item) -> tuple[float, float]:
    """Seconds of a pair, and those that the processor worked."""
    with tempfile.TemporaryDirectory() as folder:
        began, worked = perf_counter(), process_time()
        row = make_file(item, [], folder)
        if row.reason:
            raise RuntimeError(row.reason)
        return perf_counter() - began, process_time() - worked


def all_of(recipe: Recipe, jobs: int) -> float:
    """Seconds of a whole build, with workers that are running already; prints how busy they were, whoever else took the cores."""
    with tempfile.TemporaryDirectory() as folder:
        began = perf_counter()
        report = build(Build(recipe, folder, jobs))
        if report.refused:
            raise RuntimeError(report.refused)
        seconds = perf_counter() - began
        print(f"# {jobs} at work: busy {report.seconds / (jobs * seconds):.1%} of the time")
        return seconds


def main(pairs: int = 8) -> None:
    from joblib.externals.loky import get_reusable_executor

    recipe = Recipe(**{**vars(RECIPE), "pairs": pairs})
    items = draw_items(recipe, {})
    one(items[0])  # compiles
    seconds, worked = zip(*(one(item) for item in items), strict=True)
    line("pair", median(seconds), TARGET)
    line("pair_cpu", median(worked), TARGET)
    print(f"# pairs of 15 rooms took {min(seconds):.1f} to {max(seconds):.1f} s")
    alone = all_of(recipe, 1)
    all_of(Recipe(**{**vars(recipe), "pairs": 2, "seed": 1}), 2)  # starts the workers
    line("two_workers", all_of(recipe, 2), alone)
    get_reusable_executor().shutdown(wait=True)
    line("memory", resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20, LIMIT)


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:2]))
