"""A robot's bag to a map: megabytes a second, and memory, for walks of any length.

A LiDAR walks laps through a simulated office; the bag (ROS 2, MCAP) holds its scans of 16 bytes a point and tf. The peer is the
library alone (rosbags), which takes every message apart and does nothing with it. Each measurement is a process of its own, after
one that compiles. Run from the root, with as much room on the disk as the largest bag takes:
``python -m benchmarks.speed.bags [gigabytes ...]`` (1 if none is named).
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.speed.bench import print_line
from tests.io.bags import Entry, Messages, walk_messages, write_bag
from tests.io.walks import PERIOD, START, Walk
from topomerge.progress import Stopwatch

SEED, SPACING = 3, 0.025  # m, between the points of a lap
REPEATS, NOISE = 10, 0.01  # each point so often, with other noise (m): 36,000 a scan, as of 32 beams
POINT_BYTES = 16


def simulate_office_walk(spacing: float) -> Walk:
    """Return a lap through an office as a LiDAR sees it."""
    from topomerge.datasets.buildings.procedural import make_building
    from topomerge.datasets.simulation.scanner import scan_building

    cloud = scan_building(make_building("office", SEED), "lidar", seed=1, spacing=spacing)
    assert cloud.poses is not None and cloud.pose_of is not None
    scans, order = [], np.argsort(cloud.pose_of, kind="stable")
    for rows in np.split(order, np.cumsum(np.bincount(cloud.pose_of, minlength=len(cloud.poses)))[:-1]):
        pose = cloud.poses[cloud.pose_of[rows[0]]] if len(rows) else np.eye(4)
        scans.append(((cloud.points[rows] - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32))
    seen = [k for k, points in enumerate(scans) if len(points)]
    return Walk([scans[k] for k in seen], cloud.poses[seen], START + PERIOD * np.arange(len(seen)))


def iter_laps(walk: Walk, gigabytes: float, m: Messages) -> Iterable[Entry]:
    """Yield the messages of as many laps as give the bag its size."""
    rng, size, lap = np.random.default_rng(0), 0, 0
    while size < gigabytes * 1e9:
        scans = (np.repeat(s, REPEATS, axis=0) for s in walk.scans)
        scans = [s + rng.normal(0, NOISE, s.shape).astype(np.float32) for s in scans]
        lap_walk = Walk(scans, walk.poses, walk.times + lap * PERIOD * len(scans))
        for entry in walk_messages(lap_walk)(m):
            if entry[0] == "/tf_static" and lap:
                continue
            yield entry
            if entry[0] == "/points":
                size += POINT_BYTES * entry[3].width
                if size >= gigabytes * 1e9:
                    return
        lap += 1


def measure(path: str, alone: bool) -> dict[str, float]:
    """Measure seconds and peak memory (MiB, with the process that reads), of extracting a bag or of reading it by the library
    alone."""
    watch, rooms = Stopwatch(), 0
    if alone:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        with AnyReader([Path(path).parent], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection, _, data in reader.messages():
                reader.deserialize(data, connection.msgtype)
    else:
        from topomerge.extraction.extract import extract
        from topomerge.io.points import read_chunks

        rooms = len(extract(read_chunks(path)).rooms)
    usage = [resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"seconds": watch.elapsed, "peak": sum(usage), "rooms": rooms}


def measure_in_process(path: Path, alone: bool) -> dict[str, float]:
    """Run `measure` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.speed.bags", "--measure", str(path), "alone" if alone else "extract"]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    result: dict[str, float] = json.loads(output.splitlines()[-1])
    return result


def main(gigabytes: Iterable[float] = (1.0,), spacing: float = SPACING) -> None:
    """Print the lines."""
    walk = simulate_office_walk(spacing)
    for size in gigabytes:
        with tempfile.TemporaryDirectory(prefix="topomerge-") as folder:
            path = write_bag(Path(folder), "mcap", partial(iter_laps, walk, size))
            megabytes = path.stat().st_size / 1e6
            measure_in_process(path, alone=True)  # into the disk's cache, as far as it fits
            ours, alone = measure_in_process(path, alone=False), measure_in_process(path, alone=True)
            print_line(f"bag_{size:g}_GB", ours["seconds"], alone["seconds"])
            rate = f"{megabytes / ours['seconds']:.0f} MB/s, {ours['rooms']:.0f} rooms, at most {ours['peak']:.0f} MiB"
            bare = f"{megabytes / alone['seconds']:.0f} MB/s, {alone['peak']:.0f} MiB"
            print(f"# {megabytes:.0f} MB: {rate}; the library alone {bare}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        print(json.dumps(measure(sys.argv[2], sys.argv[3] == "alone")))
    else:
        main(*([[float(a) for a in sys.argv[1:]]] if sys.argv[1:] else []))
