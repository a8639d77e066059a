"""The whole of `extract`, default preset: seconds a step on a floor of 1,500 m2 and 6 M points, memory, and growth with floors.

The peer of `extract_floor` is the thesis preset on the same points. `beside_n` compares n floors beside each other with n times
the seconds of one, `above_n` the same one above the other: a ratio of 1 is linear growth, above 1 is better. Run from the root:
``python -m benchmarks.speed.extract_floor [most floors]``. Each measurement is a process of its own, after one that compiles; one
alone: ``--measure FLOORS default POINTS PLACE``, of `STEPS`.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from typing import Any

import numpy as np

from benchmarks.speed.bench import STOREY_HEIGHT, WIDTH, print_line, run_timed, storey
from topomerge.evaluation.documents import FIGURES, build_stamp, write_headline

STOREY_GAP = 0.4  # m
STEPS = {"beside": (WIDTH + 1, 0, 0), "above": (0, 0, STOREY_HEIGHT + STOREY_GAP), "apart": (WIDTH + 95, 0, 0)}  # m


def measure(floors: int, preset: str, points: int, place: str) -> dict[str, Any]:
    """Extract `floors` storeys in this process: seconds in all and a step, peak memory (MB), rooms, storeys."""
    from topomerge.extraction.extract import extract
    from topomerge.types import PointCloud

    extract(storey(60_000), preset=preset)  # loads what was compiled
    cloud = storey(points)
    step = np.array(STEPS[place], np.float32)
    chunks = (PointCloud(cloud + i * step) for i in range(floors))
    result, seconds, worked = run_timed(lambda: extract(chunks, preset=preset))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "seconds": seconds,
        "processor": worked,
        "steps": dict(result.seconds),
        "peak_mb": peak,
        "rooms": len(result.rooms),
        "storeys": len(result.storeys),
        "cells": len(result.grid),
    }


def measure_in_process(floors: int, preset: str = "default", points: int = 6_000_000, place: str = "beside") -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.speed.extract_floor", "--measure", str(floors), preset, str(points), place]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


def main(most: int = 16, points: int = 6_000_000, repeat: int = 3) -> None:
    """Print the lines; `most` floors at the most. With 1 the figure of the README is written."""
    measure_in_process(1, points=100_000)
    one = min((measure_in_process(1, points=points) for _ in range(repeat)), key=lambda m: m["seconds"])
    thesis = measure_in_process(1, "thesis", points)
    print_line("extract_floor", one["seconds"], thesis["seconds"])
    if most == 1 and points == 6_000_000:
        stamp = build_stamp("python -m benchmarks.speed.extract_floor 1", ("topomerge.extraction.extract",))
        ratio = f"{float(thesis['seconds']) / float(one['seconds']):.1f}"
        write_headline(FIGURES, {"speed-floor": (ratio, "1 floor, one run of both")}, stamp)
    for step, seconds in one["steps"].items():
        print(f"#   {step}: {seconds:.2f} s")
    print(f"# {one['cells']} cells, {one['rooms']} rooms, peak {one['peak_mb']:.0f} MB; thesis: {thesis['rooms']} rooms")
    if most < 2:
        return
    small = min((measure_in_process(1, points=points // 3) for _ in range(repeat)), key=lambda m: m["seconds"])
    for place in ("beside", "above"):
        floors = 2
        while floors <= most:
            floor_run = measure_in_process(floors, points=points // 3, place=place)
            print_line(f"{place}_{floors}", floor_run["seconds"], floors * small["seconds"])
            size = f"{floor_run['cells']} cells, {floor_run['rooms']} rooms, {floor_run['storeys']} storeys"
            print(f"# {size}, peak {floor_run['peak_mb']:.0f} MB")
            floors *= 2


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measure(int(sys.argv[2]), sys.argv[3], int(sys.argv[4]), sys.argv[5])))
    else:
        main(*(int(a) for a in sys.argv[1:2]))
