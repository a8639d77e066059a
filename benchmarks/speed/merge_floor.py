"""A floor of 1,500 m2 and 40 M points in two sessions, all the way: files read, extracted, merged and written moved again.

``python -m benchmarks.speed.merge_floor [points]``, from the root. Each session has 70 % of the floor, 40 % are in both; they are
binary PLY in frames of their own. The rooms are twenty equal ones, so that the merge is forced; it is timed and not judged. The
command is a process of its own; seconds by the clock and of the processor, and its peak memory.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.speed.bench import WIDTH, storey
from topomerge.types import Sim3

SHARE = 0.7  # of the floor's length that each session has


def save_cloud(path: Path, points: np.ndarray) -> None:
    """Save (n, 3) float32 as binary PLY."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    with path.open("wb") as out:
        out.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n".encode())
        points.astype("<f4").tofile(out)


def main(points: int = 40_000_000) -> None:
    """Print a line of figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cloud = storey(points)
        first, second = (cloud[side] for side in (cloud[:, 0] < SHARE * WIDTH, cloud[:, 0] > (1 - SHARE) * WIDTH))
        counts = len(first), len(second)
        save_cloud(folder / "a.ply", first)
        save_cloud(folder / "b.ply", Sim3(0.7, (12.0, -5.0, 0.0)).apply(second))
        del cloud, first, second
        command = [sys.executable, "-m", "topomerge", "merge", str(folder / "a.ply"), str(folder / "b.ply")]
        begun = time.perf_counter()
        child = os.spawnv(os.P_NOWAIT, command[0], [*command, "-o", str(folder / "out"), "--native", "--force", "-q"])
        _, status, usage = os.wait4(child, 0)
        seconds = time.perf_counter() - begun
        listing = json.loads((folder / "out" / "merge.json").read_text())
        written = sum(path.stat().st_size for path in (folder / "out").glob("*_moved.ply"))
    print(f"# {counts[0]:,} and {counts[1]:,} points, status {os.waitstatus_to_exitcode(status)}, {listing['status']}")
    print(
        f"# {seconds:.1f} s by the clock, {usage.ru_utime + usage.ru_stime:.1f} s of the processor, "
        f"peak {usage.ru_maxrss / 1024:,.0f} MB, {written / 1e6:,.0f} MB written"
    )
    print("# " + ", ".join(f"{step} {value:.1f} s" for step, value in listing["seconds"].items()))


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:2]))
