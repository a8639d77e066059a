"""Stress tests at the limits: large clouds, many rooms, many maps, many merges, threads, processes, and kills.

``python -m benchmarks.stress CASE [NUMBER]`` runs one case and prints a line or a few: seconds of the processor, and the peak of
the memory. The cases are the functions below; each has a default that takes minutes.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.walk import sample_part

import topomerge as tm
from benchmarks.speed.bench import DEPTH, WIDTH, run_timed, storey
from topomerge.embedding.learned import build_embedder
from topomerge.matching.match import match
from topomerge.types import Array, PointCloud, Sim3, TopometricMap

OUTLIERS = 20_000  # points scattered about a large cloud
POINTS_A_FLOOR = 700_000  # of the floors that rooms are counted on: enough for cells of 0.1 m
EPOCHS = 40  # of a run that is killed
SEED, SPACING = 41_700, 0.06  # of the training list; m
TINY = ["data.scans=4", "data.seed=0", "data.folder=", "steps=6", "batch=2", "crop=32", "hold_out=2", "widths=[4,4,4,4,4,4,4,4]"]


def measure_peak() -> int:
    """Return how many MB this process held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def measure_held() -> int:
    """Return how many MB this process holds now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 2**20


def cloud(millions: int = 20) -> None:
    """Extract a cloud of so many million points: a tower of floors of 2 million, with outliers."""
    floors = max(millions // 2, 1)
    beside = int(np.ceil(np.sqrt(floors)))
    points = np.empty((floors * 2_000_000 + OUTLIERS, 3), np.float32)
    for k in range(floors):
        points[k * 2_000_000 : (k + 1) * 2_000_000] = storey(2_000_000, k) + compute_offset(k, beside)
    low, high = points[:-OUTLIERS].min(axis=0), points[:-OUTLIERS].max(axis=0)
    points[-OUTLIERS:] = np.random.default_rng(0).uniform(low - 10, high + 10, (OUTLIERS, 3))
    before, began = measure_peak(), time.process_time()
    map = tm.extract(points)
    spent = time.process_time() - began
    found = f"{len(points):,} points, {floors * 20} rooms: found {len(map.rooms)}"
    print(f"{found}; {spent:.1f} s; {before} MB before, {measure_peak()} MB at most", flush=True)


def compute_offset(number: int, beside: int) -> Array:
    """Return (3,) float32 m, where a floor lies among others that lie beside each other without a gap wider than a wall."""
    return np.array([number % beside * (WIDTH + 0.5), number // beside * (DEPTH + 0.5), 0.0], np.float32)


def rooms(most: int = 320) -> None:
    """Extract, describe and match (seconds each) maps of 20, 80, 320, ... rooms with a copy of themselves."""
    describe = build_embedder("learned")
    floors = 1
    while floors * 20 <= most:
        beside = int(np.ceil(np.sqrt(floors)))
        points = np.concatenate([storey(POINTS_A_FLOOR, k) + compute_offset(k, beside) for k in range(floors)])
        parts = []
        began = time.process_time()
        map = tm.extract(points)
        parts.append(time.process_time() - began)
        copy = tm.extract(Sim3(0.4, (3.0, 1.0, 0.0)).apply(points.astype(np.float64)))
        for step in (lambda: describe(map), lambda: match(map, copy)):  # noqa: B023
            began = time.process_time()
            step()
            parts.append(time.process_time() - began)
        print(
            f"{len(map.rooms)} rooms: extract {parts[0]:.1f} s, describe {parts[1]:.2f} s, match {parts[2]:.2f} s; "
            f"{measure_peak()} MB",
            flush=True,
        )
        floors *= 4


def simulate_partial_clouds(count: int, rooms: int = 4) -> list[PointCloud]:
    """Simulate scans of a few rooms each of one office, each in a frame of its own."""
    building = make_building("office", SEED)
    out = []
    for k in range(count):
        rng = np.random.default_rng([SEED, k])
        some = sample_part(building, rooms, rng)
        frame = Sim3(float(rng.uniform(-np.pi, np.pi)), tuple(rng.uniform(-9, 9, 3).tolist()))
        out.append(scan_building(building, "tls", some, rng, SPACING, frame=frame))
    return out


def load_maps(count: int = 30) -> None:
    """Merge so many partial maps of one office at once."""
    parts = [tm.extract(cloud) for cloud in simulate_partial_clouds(count)]
    print(f"{count} maps extracted, {measure_peak()} MB", flush=True)
    result, seconds, spent = run_timed(lambda: tm.merge(parts))
    joined = sum(t is not None for t in result.transforms)
    times = f"{spent:.0f} s of the processor, {seconds:.0f} s"
    print(f"{count} maps: {result.status}, {joined} joined; {times}; {measure_peak()} MB")


def merges(count: int = 300) -> None:
    """Merge the same two maps so often in one process: does memory grow?"""
    a, b = (tm.extract(cloud) for cloud in simulate_partial_clouds(2))
    first, began = None, time.process_time()
    for k in range(count):
        result = tm.merge([a, b])
        answer = (result.status, result.probability)
        first = answer if first is None else first
        assert answer == first, (k, answer, first)
        if k + 1 in (1, 10, count // 2, count) or (k + 1) % 100 == 0:
            print(f"{k + 1} merges: {measure_held()} MB held, {(time.process_time() - began) / (k + 1):.2f} s each", flush=True)


def extract_signature(cloud: PointCloud) -> bytes:
    """Serialise the tables of the map of a cloud: maps that differ give different bytes."""
    return compute_signature(tm.extract(cloud))


def compute_signature(map: TopometricMap) -> bytes:
    """Return the tables of a map, as bytes."""
    return b"".join(np.ascontiguousarray(table).tobytes() for table in (map.rooms, map.edges, map.room, map.navigable_room))


def summarise_merge(maps: Sequence[TopometricMap]) -> tuple[str, float]:
    """Summarise a merge: its verdict and its probability."""
    result = tm.merge(list(maps))
    return result.status, float(result.probability)


def threads(count: int = 4) -> None:
    """Extract and merge in so many threads, and in processes that are spawned and forked: are the results equal?"""
    clouds = simulate_partial_clouds(count)
    alone = [extract_signature(cloud) for cloud in clouds]
    maps = [tm.extract(cloud) for cloud in clouds]
    pairs = [(maps[k], maps[(k + 1) % count]) for k in range(count)]
    answers = [summarise_merge(pair) for pair in pairs]
    for name, pool in (
        ("threads", ThreadPoolExecutor(count)),
        ("spawned processes", ProcessPoolExecutor(2, get_context("spawn"))),
        ("forked processes", ProcessPoolExecutor(2, get_context("fork"))),
    ):
        try:
            with pool:
                same = list(pool.map(extract_signature, clouds)) == alone
                agree = list(pool.map(summarise_merge, pairs)) == answers
        except BrokenProcessPool as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(f"{name}: maps {'equal' if same else 'DIFFER'}, merges {'equal' if agree else 'DIFFER'}", flush=True)


def kills(count: int = 8) -> None:
    """Kill train.py with SIGKILL at random moments, resume each time, and compare the weights with those of a run without."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        cache, runs = f"cache={folder}/cache", f"runs={folder}/runs"
        command = [sys.executable, "train.py", "task=plan_segmentation", "patience=0", *TINY, cache, runs]

        def start(name: str, resume: bool, epochs: int = EPOCHS) -> subprocess.Popen[bytes]:
            words = [*command, f"name={name}", f"resume={str(resume).lower()}", f"epochs={epochs}"]
            return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)

        start("data", False, 1).communicate()  # makes the scans
        start("whole", False).communicate()
        killed, errors = 0, []
        run = Path(folder, "runs", "cut")
        for epoch in [*np.sort(rng.integers(1, EPOCHS, count)).tolist(), None]:
            process = start("cut", (run / "last").exists())
            while epoch is not None and process.poll() is None and count_lines(run / "metrics.jsonl") < epoch:
                time.sleep(0.02)
            if epoch is not None and process.poll() is None:
                time.sleep(float(rng.uniform(0.0, 0.5)))
                process.send_signal(signal.SIGKILL)
                killed += 1
            _, error = process.communicate()
            if process.returncode not in (0, -signal.SIGKILL):
                errors.append(error.decode()[-300:])
        whole, cut = (tensor_bytes(Path(folder, "runs", name, "last", "network.safetensors")) for name in ("whole", "cut"))
        left = [str(path) for path in Path(folder).rglob(".*") if path.is_file()]
        same = "equal" if whole == cut else "DIFFER"
        print(f"{killed} kills in a run of {EPOCHS} epochs: weights {same}; errors {errors}; left over: {left}")


def count_lines(path: Path) -> int:
    """Count the lines of a file; 0 where there is none."""
    return path.read_bytes().count(b"\n") if path.exists() else 0


def tensor_bytes(path: Path) -> bytes:
    """Return the bytes of a file's tensors, without its header, which holds the run's name."""
    content = path.read_bytes()
    return content[8 + int.from_bytes(content[:8], "little") :]


CASES: dict[str, Callable[..., None]] = {c.__name__: c for c in (cloud, rooms, load_maps, merges, threads, kills)}


def main(words: Sequence[str] | None = None) -> None:
    """Run a case."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stress", description=__doc__)
    parser.add_argument("case", choices=list(CASES))
    parser.add_argument("number", nargs="?", type=int, help="how many: millions, rooms, maps, merges, threads, kills")
    args = parser.parse_args(words)
    CASES[args.case](*([] if args.number is None else [args.number]))


if __name__ == "__main__":
    main()
