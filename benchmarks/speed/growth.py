"""Time of a merge of two extracted maps against their rooms: 5, 20, 80 and 300 a map.

``python -m benchmarks.speed.growth [rooms ...]``: the floors of `merge_growth`, extracted first. A line for each step and size:
its seconds, and those of the smallest size times as many rooms (above 1: time grows less than the maps). Steps: `pose`
(registration), `join` (the joined map), `save` (report and files).
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from time import process_time

import topomerge
from benchmarks.speed.bench import print_line
from benchmarks.speed.merge_growth import TURNED_POSE, build_two_maps
from topomerge.fusion.fuse import fuse
from topomerge.types import Sim3, TopometricMap

SIZES = (5, 20, 80, 300)  # rooms a map
SHARE = 0.75  # of the floor that each map has


def measure(maps: Sequence[TopometricMap]) -> dict[str, float]:
    """Measure seconds of the processor for each step; the second of two runs, which compiles nothing."""
    pose = TURNED_POSE.inverse()
    for _ in range(2):
        began = process_time()
        result = topomerge.merge(maps, force=True)  # maps of few rooms are not believed
        merged = process_time()
        fuse(maps, [(0, Sim3()), (1, result.transforms.get(1, pose))], result.bends)
        joined = process_time() - merged
        with tempfile.TemporaryDirectory() as folder:
            began_save = process_time()
            result.save(folder)
            saved = process_time() - began_save
    return {"pose": max(merged - began - joined, 0.0), "join": joined, "save": saved}


def main(rooms: Sequence[int] = SIZES) -> None:
    """Print the lines."""
    first: tuple[int, dict[str, float]] | None = None
    for number in rooms:
        a, b, _ = build_two_maps(round(number / SHARE))
        maps = [topomerge.extract(a, name="a"), topomerge.extract(b, name="b")]
        count = sum(len(map.rooms) for map in maps)
        seconds = measure(maps)
        first = first or (count, seconds)
        print(f"# {number} rooms a map: {count} found in both")
        for step, value in seconds.items():
            print_line(f"{step}_{number}", value, first[1][step] * count / first[0])


if __name__ == "__main__":
    main([int(number) for number in sys.argv[1:]] or SIZES)
