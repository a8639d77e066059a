"""One scan in an atlas: KISS-Matcher of the scan against whole maps, one after the other, beside `locate`.

``python -m benchmarks.peers.scans [15 [10]]`` with ``pip install kiss-matcher==1.0.2``: so many scans (a station, a sweep and a
walk of each building from the 24th on of ``evaluate.py task=locate data=test``), each against its own map and so many less one of
the others. `locate` has all 50 maps. KISS-Matcher with cells of 0.3 m and Quatro's yaw, without refinement; its own choice is
the map with the most inliers. Both on one core, in seconds of processor. Rows are kept in the cache; the table goes to
docs/results/locate.md.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.localisation import make_located_scan

from benchmarks.peers.methods import CALL_FAILED, GuardedWork
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.evaluation.documents import build_stamp, write_blocks, write_table
from topomerge.evaluation.locate import FIRST, MAKERS, MAPS, RIGHT_POSE, classify_outcome, load_atlas, measure_scan
from topomerge.evaluation.tasks import Row, TaskSettings, measure_missing
from topomerge.matching.poses import wrap_yaw
from topomerge.types import Array, Sim3

KINDS = ("station", "sweep", "walk")
VOXEL = 0.3  # m
NEAR = (1.0, np.radians(15.0))  # m and rad: a pose that ICP would carry home
PAGE, BLOCK = Path("docs/results/locate.md"), "locate-peers"


def run_kiss_matcher(scan: Array, map: Array) -> Iterator[tuple[str, tuple[Array, float, float]]]:
    """Yield the pose (4, 4) of a scan in a map, its inliers and seconds of processor; clouds (n, 3) m."""
    import kiss_matcher

    begun = time.process_time()
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL, use_quatro=True))
    pairs = matcher.match(*(np.asarray(cloud, float).T for cloud in (scan, map)))
    solution = matcher.solve(*(np.array(side, float).reshape(-1, 3).T for side in pairs))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(solution.rotation), np.array(solution.translation).ravel()
    inliers = float(matcher.get_num_final_inliers()) if solution.valid else 0.0
    yield "kiss", (pose, inliers, time.process_time() - begun)


@cache
def start_peer() -> GuardedWork:
    """Start the process of the peer."""
    return GuardedWork(run_kiss_matcher)


def choose_maps(own: int, count: int) -> list[int]:
    """Choose the own map and others, spread over the atlas."""
    return [own, *((own + step) % MAPS["test"] for step in np.linspace(1, MAPS["test"] - 1, count - 1).astype(int).tolist())]


def compare_scan(number: int, kind: str, count: int, folder: Path) -> Row:
    """Ask both where a scan was taken."""
    index, maps = load_atlas("test", folder, MAPS["test"])
    scan = make_located_scan("test", number, kind, False)
    pose, moved = maps[number].place_scan(scan)
    true = replace(pose, translation=tuple((np.array(pose.translation) + moved).tolist()))  # type: ignore[arg-type]
    with limit_threads():
        ours = measure_scan(index, scan.cloud, (number, true))
    found = []
    for k in choose_maps(number, count):
        answers, why, used = start_peer()(scan.cloud.points, index.maps[k].load().grid.compute_centroids())
        if why == CALL_FAILED:  # else a peer that cannot be called would count as wrong
            raise RuntimeError(f"KISS-Matcher failed on {number} {kind} in map {k}; is it version 1.0.2?")
        matrix, inliers, seconds = answers.get("kiss", (np.eye(4), 0.0, used))
        found.append({"map": k, "inliers": inliers, "seconds": seconds, **measure_error(matrix, true)})
    return {"kind": kind, "building": number, "ours": ours, "kiss": found}


def measure_error(matrix: Array, true: Sim3) -> dict[str, float]:
    """Measure how far a pose of a scan is from the true one: m at the sensor, rad."""
    yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
    away = float(np.linalg.norm((matrix[:3, 3] - np.array(true.translation))[:2]))
    return {"away": away, "turned": abs(wrap_yaw(yaw - true.yaw))}


def tabulate(rows: Sequence[Row]) -> str:
    """Tabulate both, a line a kind of scan."""
    lines: list[list[object]] = []
    for kind in (*KINDS, "all"):
        some = [row for row in rows if kind in (row["kind"], "all")]
        if not some:
            continue
        own = [row["kiss"][0] for row in some]
        right, near = (sum(is_within(k, limits) for k in own) for limits in (RIGHT_POSE, NEAR))
        chosen = [max(row["kiss"], key=lambda k: k["inliers"]) for row in some]
        best = sum(c["map"] == row["building"] and is_within(c, NEAR) for c, row in zip(chosen, some, strict=True))
        outcomes = [classify_outcome(row["ours"]) for row in some]
        seconds = float(np.median([k["seconds"] for row in some for k in row["kiss"]]))
        ours = float(np.median([row["ours"]["seconds"] for row in some]))
        counts = [outcomes.count("right"), outcomes.count("wrong")]
        lines.append(
            [kind, len(some), right, near, best, f"{seconds:.2f}", f"{seconds * MAPS['test']:.0f}", *counts, f"{ours:.2f}"]
        )
    heads = ["scan", "scans", "KISS-Matcher, own map: within 0.3 m, 5°", "within 1 m, 15°", "… and of the maps the most inliers"]
    heads += ["s a map, median", "so s for 50 maps", "`locate` in 50 maps: told right", "told wrong", "s in all"]
    return write_table(heads, lines)


def is_within(found: Row, limits: tuple[float, float]) -> bool:
    """Return whether a pose is within m and rad of the true one."""
    return bool(found["away"] < limits[0] and found["turned"] < limits[1])


def main(scans: str = "15", maps: str = "10") -> None:
    """Compare, and write the table.

    Raises:
        InputError: KISS-Matcher is not installed.
    """
    if find_spec("kiss_matcher") is None:
        raise InputError("this comparison needs KISS-Matcher: pip install kiss-matcher==1.0.2")
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})  # it takes all cores otherwise
    os.environ["OMP_NUM_THREADS"] = "1"
    settings = TaskSettings()
    folder = Path(settings.cache) / "locate" / "test"
    queries = [(FIRST["test"] + k // len(KINDS), KINDS[k % len(KINDS)]) for k in range(int(scans))]
    items = {f"{number} {kind} {maps}": (number, kind, int(maps), folder) for number, kind in queries}
    path = Path(settings.cache) / "evaluation" / "locate_peers.jsonl"
    rows = measure_missing(path, items, compare_scan, print, settings, compute_code_digest(*MAKERS))
    table = tabulate(rows)
    print(table)
    if PAGE.exists():
        stamp = build_stamp(f"python -m benchmarks.peers.scans {scans} {maps}", MAKERS, list(items))
        write_blocks(PAGE, {BLOCK: table}, stamp)


if __name__ == "__main__":
    main(*sys.argv[1:])
