"""The whole way, two clouds on disk to the joined map and its report, beside KISS-Matcher from points in memory to the bare pose.

Run from the root: ``python -m benchmarks.speed.whole [pairs]``: ten pairs of .3 to 10 million points, simulated once below
``cache/benchmarks/``. Both use all cores, one after the other, the less disturbed of two runs each; ours is a command with its
start. Lines: `name ours peer ratio` (`bench.print_line`), of `name_cores` the peer is ours on one core alone, so that the ratio
says how many it kept busy; then the share of each of its steps.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.speed.bench import print_line, run_timed
from topomerge.progress import Stopwatch

CACHE = Path("cache/benchmarks/whole")
VOXEL = 0.2  # m, of KISS-Matcher
PAIRS = (  # building, seed, sensors, rooms of each map
    ("apartment", 1, "depth,depth", 4),
    ("office", 2, "tls,depth", 8),
    ("hotel", 3, "lidar,depth", 12),
    ("lab", 4, "tls,depth", 15),
    ("school", 5, "lidar,lidar", 20),
    ("office", 6, "tls,tls", 20),
    ("hotel", 7, "tls,lidar", 30),
    ("hospital", 8, "tls,depth", 40),
    ("office", 9, "tls,tls", 80),
    ("hospital", 10, "tls,tls", 150),
)


def main(pairs: int = len(PAIRS), repeat: int = 2) -> None:
    """Print the lines of the first `pairs` pairs, and the median ratio."""
    has_peer = find_spec("kiss_matcher") is not None
    if not has_peer:
        print("# no kiss_matcher: pip install kiss-matcher; ours alone")
    ratios: list[float] = []
    for building, seed, sensors, rooms in PAIRS[:pairs]:
        name, folder = f"{building}_{seed}", CACHE / f"{building}_{seed}_{sensors.replace(',', '_')}_{rooms}"
        if not (folder / "b.ply").is_file():
            words = ["--building", building, "--seed", str(seed), "--sensors", sensors, "--rooms", str(rooms), "--overlap", "0.5"]
            subprocess.run([sys.executable, "-m", "topomerge", "simulate", *words, "-o", str(folder), "-q"], check=True)
        seconds, cores, steps = min(merge(folder) for _ in range(repeat))
        shares = ", ".join(f"{step} {100 * share:.0f} %" for step, share in steps)
        if has_peer:
            peer = min(run_peer(folder) for _ in range(repeat))
            print_line(name, seconds, peer)
            ratios.append(seconds / peer)
        print_line(f"{name}_cores", seconds, seconds * cores)
        print(f"# {name}: {seconds:.1f} s, {cores:.2f} of {os.cpu_count()} cores busy; {shares}", flush=True)
    if ratios:
        print(f"# ours over peer: median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")


def merge(folder: Path) -> tuple[float, float, tuple[tuple[str, float], ...]]:
    """Merge two clouds by a command: seconds by the clock, cores that were busy, and shares of the steps and of the rest."""
    with TemporaryDirectory() as out:
        words = [str(folder / "a.ply"), str(folder / "b.ply"), "--force", "-q", "-o", f"{out}/merged"]
        command = partial(subprocess.run, [sys.executable, "-m", "topomerge", "merge", *words], check=False)
        done, seconds, busy = run_timed(command, resource.RUSAGE_CHILDREN)
        if done.returncode not in (0, 2):  # 2: joined, though it is not believed
            raise SystemExit(f"{folder}: the merge ends with {done.returncode}")
        steps = json.loads(Path(out, "merged", "merge.json").read_text(encoding="utf-8"))["seconds"]
    shares = [(step, value / seconds) for step, value in steps.items() if value > 0]
    rest = 1 - sum(share for _, share in shares)  # below 0 where two processes read and extract side by side
    return seconds, busy / seconds, (*shares, ("start, report and files", rest)) if rest > 0 else tuple(shares)


def run_peer(folder: Path) -> float:
    """Return the seconds that KISS-Matcher takes, in a process of its own."""
    words = [sys.executable, "-m", "benchmarks.speed.whole", "peer", str(folder)]
    return float(subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()[-1])


def time_peer(folder: Path) -> None:
    """Print the seconds of KISS-Matcher on two clouds, reading left out."""
    import kiss_matcher

    from topomerge.io.points import read_points

    b, a = (read_points(folder / f"{name}.ply").points.astype(float).T for name in "ba")
    watch = Stopwatch()
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL))
    matched = [np.array(m, float).reshape(-1, 3).T for m in matcher.match(b, a)]
    matcher.solve(*matched)
    print(watch.elapsed)


def parse_words(words: Sequence[str]) -> None:
    """Run what the words of the command line name."""
    if words[:1] == ["peer"]:
        time_peer(Path(words[1]))
    else:
        main(*(int(word) for word in words[:1]))


if __name__ == "__main__":
    parse_words(sys.argv[1:])
