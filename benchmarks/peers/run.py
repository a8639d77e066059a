"""Ours, KISS-Matcher (0.2 and 0.3 m), FPFH + RANSAC and FGR on the same pairs: poses, scores, and the time they take.

``python -m benchmarks.peers.run SECONDS [train|test|raw|thinned|real|heldout|MANIFEST]`` works through pairs
(`pairs.py`) for so many seconds of processor: ``train`` for the thresholds of the verdicts (`thresholds.py`),
``test`` for the tables (`tables.py`), ``raw`` with all simulated points instead of the means of 0.1 m cells,
``thinned`` the same pairs with these; the real pairs of TOPOMERGE_DATA; the maps that `evaluate.py data=heldout` kept, with
the learned embedder's merge among the methods; or any manifest of pairs of the same format, e.g. of look-alikes. Resumable:
a line of JSON a pair with all methods in ``cache/merge/peers_*.jsonl``. After a change of ours, ``python -m
benchmarks.peers.run again [test|real|MANIFEST]`` measures ours alone on the pairs that are there; ``python -m
benchmarks.peers.run whole [9]`` only the whole way of so many of the first test pairs, beside the pose of KISS-Matcher;
``python -m benchmarks.peers.run files FOLDER ...`` that of a.ply and b.ply in each folder (`topomerge simulate`), from the
files to the report, by the command.

All on one core, in seconds of processor from points in memory to the pose; ours also from them to the joined map with its rooms
(``extract`` of both, ``merge``). Peers run in processes of their own; what takes longer than a minute of processor, or dies, is
a miss (`methods.py`). Open3D's methods get every third pair. Poses are made upright afterwards. Where the scale is unknown
(Halmstad), ours has to find it; the others, which can't, are given it.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from topomerge.datasets.pairs.grid_pairs import GridPair

from benchmarks.peers import methods
from benchmarks.peers.methods import CALL_SECONDS, GuardedWork
from benchmarks.peers.pairs import PEER_SPLITS, PeerPair, described, iter_peer_pairs, scale_pair
from topomerge.errors import InputError
from topomerge.evaluation.tasks import SCALELESS, convert_to_upright, find_places
from topomerge.extraction.cleaning import compute_cell_means
from topomerge.training.belief_hypotheses import compute_pose_error
from topomerge.types import Array, PointCloud, VoxelGrid

CACHE = Path("cache/merge")
WHOLE = 6  # every sixth pair of the test set goes the whole way to a joined map
OPEN3D_SHARE = 3  # RANSAC and FGR, which take most of the time, get every third pair
PEER_CALLS: tuple[PeerCall, ...] = (  # each in a process of its own
    (GuardedWork(partial(methods.run_kiss, voxel=0.2)), ("kiss02", "kiss02q")),
    (GuardedWork(partial(methods.run_kiss, voxel=0.3)), ("kiss03", "kiss03q")),
    (GuardedWork(methods.run_open3d), ("fpfh", "fgr")),
)
PACKAGES = {"kiss_matcher": "kiss-matcher==1.0.2", "open3d": "open3d-cpu==0.19.*"}  # modules of the peers
PeerCall = tuple[GuardedWork, tuple[str, ...]]
Outcome = dict[str, Any]  # status (empty: answered), err, err_icp, scores, seconds, refinement_seconds


def get_target(what: str) -> Path:
    """Return where the lines of a set of pairs are."""
    return CACHE / f"peers_{Path(what).stem if what.endswith('.jsonl') else what}.jsonl"


def read_result_rows(what: str) -> list[dict[str, Any]]:
    """Read the lines of a set of pairs; none where nothing was measured."""
    path = get_target(what)
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def run_ours(given: PeerPair) -> Outcome:
    """Go from points to the pose: cells, plans, search, verdict."""
    from topomerge.extraction.voxels import voxelise
    from topomerge.registration.pipeline import register

    pair, free = given.pair, given.pair.about.get("source") in SCALELESS
    begun = time.process_time()
    clouds = (given.a, compute_cell_means(pair.b) if free else given.b)
    a, b = (voxelise(PointCloud(points), pair.a.edge) for points in clouds)
    registration = register(a, b, free=pair.free, scale="free" if free else "fixed")
    seconds = time.process_time() - begun
    pose = registration.transform
    err = None if pose is None else compute_pose_error(pose, pair)
    scores = {"probability": 0.0 if pose is None else registration.probability}
    return {"status": "", "err": err, "scores": scores, "believed": registration.accepted, "seconds": seconds}


def time_whole_way(pair: GridPair) -> dict[str, float]:
    """Return the seconds from two clouds to the joined map and its rooms: extraction of both, and `merge` (joined even where
    refused)."""
    from topomerge.extraction.extract import extract
    from topomerge.fusion.pipeline import merge

    begun = time.process_time()
    a, b = (extract(cloud(g, f), name=n) for g, f, n in zip((pair.a, pair.b), pair.free, "ab", strict=True))
    middle = time.process_time()
    result = merge([a, b], scale="free" if pair.about.get("source") in SCALELESS else "fixed", force=True)
    return {"extract": middle - begun, "merge": time.process_time() - middle, "joined": float(result.map is not None)}


def cloud(grid: VoxelGrid, free: VoxelGrid | None = None) -> PointCloud:
    """Return a grid's points as a cloud."""
    return PointCloud(compute_cell_means(grid).astype(np.float32), free=free)


def run_learned(pair: GridPair) -> Outcome:
    """Run `merge` on the extracted maps: rooms matched by the embedder that ships propose poses, too."""
    from topomerge.fusion.pipeline import merge

    maps = pair.about["evaluation_pair"].maps()  # type: ignore[attr-defined]
    begun = time.process_time()
    result = merge(maps)
    seconds = time.process_time() - begun
    pose = result.registration.transform if result.registration else None
    scores = {"probability": result.registration.probability if result.registration else 0.0}
    err = None if pose is None else compute_pose_error(pose, pair)
    return {"status": "", "err": err, "scores": scores, "believed": result.merged, "seconds": seconds}


def peers(given: PeerPair, calls: Sequence[PeerCall] = PEER_CALLS) -> tuple[dict[str, Outcome], float]:
    """Return the outcomes of peers, and the seconds of processor that their processes took."""
    outcomes: dict[str, Outcome] = {}
    used, judged = 0.0, scale_pair(given.pair)
    for call, names in calls:
        answers, why, seconds = call(given.b, given.a)
        used += seconds
        for name in names:
            if name not in answers:
                outcomes[name] = {"status": why, "err": None, "err_icp": None, "scores": {}, "seconds": CALL_SECONDS}
                continue
            answer = answers[name]
            errors = {"err": _measure_error(answer.pose, judged), "err_icp": _measure_error(answer.refined, judged)}
            times = {"seconds": answer.seconds, "refinement_seconds": answer.refinement_seconds}
            outcomes[name] = {"status": "", **errors, "scores": answer.scores, **times}
    return outcomes, used


def _measure_error(matrix: Array, pair: GridPair) -> list[float] | None:
    """Measure the error of the pose made upright; None where it turns the map over, or no pose is right."""
    pose = convert_to_upright(matrix, pair)
    return None if pose is None else compute_pose_error(pose, pair)


def measured(given: PeerPair, what: str, number: int) -> tuple[dict[str, Any], float]:
    """Return the line of a pair of a set, and the seconds that the peers took.

    Args:
        number: of the pair in its set: some methods get every so many pairs only.
    """
    pair = given.pair
    outcomes = {"ours": run_ours(given)}
    if "evaluation_pair" in pair.about:
        outcomes["learned"] = run_learned(pair)
    answers, used = peers(given, PEER_CALLS if number % OPEN3D_SHARE == 0 else PEER_CALLS[:-1])
    about = {**described(pair), **(find_places(pair, PEER_SPLITS[what]) if what in PEER_SPLITS else {})}
    line = {"name": pair.name, "common": pair.common, **about, "points": [len(given.a), len(given.b)]}
    return {
        **line,
        "methods": {**outcomes, **answers},
        "whole": time_whole_way(pair) if what == "test" and number % WHOLE == 0 else None,
    }, used


def read_done(target: Path) -> set[str]:
    """Read the names of the pairs that a file has lines of."""
    return {json.loads(line)["name"] for line in target.read_text().splitlines()} if target.exists() else set()


def check_peers() -> None:
    """Refuse to measure where a peer is not installed: each of its answers would count as a miss.

    Raises:
        InputError: names the packages to install.
    """
    missing = [package for module, package in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise InputError(f"{', '.join(missing)}: not installed, so nothing can be compared; pip install {' '.join(missing)}")


def _pin_to_one_core() -> None:
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})  # KISS-Matcher takes all cores otherwise
    os.environ["OMP_NUM_THREADS"] = "1"  # in the processes of the peers: two threads on one core wait for each other


def run(seconds: float, what: str = "test") -> None:
    """Measure what is missing, until the seconds of processor, simulation included, are used up.

    Raises:
        InputError: a peer is not installed.
    """
    check_peers()
    _pin_to_one_core()
    target = get_target(what)
    target.parent.mkdir(parents=True, exist_ok=True)
    done, of_peers = read_done(target), 0.0
    for k, given in enumerate(iter_peer_pairs(what, done), len(done)):
        if k == len(done):
            run_ours(given)  # compiled code is loaded at the first call
        row, used = measured(given, what, k)
        of_peers += used
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")
        summary = {m: (round(r["seconds"], 1), r["err"] and round(r["err"][0], 2)) for m, r in row["methods"].items()}
        total = time.process_time() + of_peers
        print(f"{k + 1} {total:.0f} s", row["name"], row["sensors"], row["kind"], round(row["common"]), summary, flush=True)
        if total > seconds:
            return


def time_whole_ways(pairs: str = "9") -> None:
    """Measure, on the first test pairs, which share most, the seconds from two clouds to the joined map, over those that
    KISS-Matcher (0.2 m) takes to the refined pose. The first pair is run twice, as compiled code is loaded."""
    check_peers()
    _pin_to_one_core()
    ratios: list[float] = []
    for given in islice(iter_peer_pairs("test", set()), int(pairs)):
        if not ratios:
            time_whole_way(given.pair)
        seconds = time_whole_way(given.pair)
        answer = peers(given, PEER_CALLS[:1])[0][PEER_CALLS[0][1][0]]
        ratios.append((seconds["extract"] + seconds["merge"]) / (answer["seconds"] + answer.get("refinement_seconds", 0.0)))
        print(given.pair.name, {k: round(v, 1) for k, v in seconds.items()}, f"{ratios[-1]:.2f}", flush=True)
    print(f"{len(ratios)} pairs: median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")


def time_whole_ways_of_files(*folders: str) -> None:
    """Measure the seconds of `topomerge merge` from two files to the report, start of Python included, over those that
    KISS-Matcher (0.2 m) takes from points in memory to the refined pose. The first pair is merged twice, as compiled code is
    kept."""
    from topomerge.io.points import read_points

    check_peers()
    _pin_to_one_core()
    ratios: list[float] = []
    for folder in folders:
        command = [sys.executable, "-m", "topomerge", "merge", f"{folder}/a.ply", f"{folder}/b.ply", "--force", "--quiet"]
        for _ in range(1 if ratios else 2):
            with TemporaryDirectory() as out:
                begun = resource.getrusage(resource.RUSAGE_CHILDREN)
                status = subprocess.run([*command, "-o", f"{out}/merged"], capture_output=True, check=False).returncode
                ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime
        a, b = (read_points(f"{folder}/{name}.ply").points.astype(float) for name in "ab")
        answers, why, _ = PEER_CALLS[0][0](b, a)
        answer = answers.get(PEER_CALLS[0][1][0])
        peer = CALL_SECONDS if answer is None else answer.seconds + answer.refinement_seconds
        ratios.append(seconds / peer)
        count = (len(a) + len(b)) / 1e6
        print(
            folder,
            f"{count:.1f} M points, status {status}, {seconds:.1f} s, peer {peer:.1f} s {why} {ratios[-1]:.2f}",
            flush=True,
        )
    print(f"{len(ratios)} pairs: median {np.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}")


def measure_ours_anew(what: str = "test") -> None:
    """Measure ours alone anew on the pairs that a file has lines of; what the peers answered stays."""
    target = get_target(what)
    lines = {row["name"]: row for row in map(json.loads, target.read_text().splitlines())}
    for given in iter_peer_pairs(what, set()):
        if given.pair.name in lines:
            lines[given.pair.name]["methods"]["ours"] = run_ours(given)
    fresh = target.with_name(f"{target.name}.{os.getpid()}")
    fresh.write_text("".join(json.dumps(row) + "\n" for row in lines.values()))
    fresh.replace(target)


if __name__ == "__main__":
    if sys.argv[1] == "again":
        measure_ours_anew(*sys.argv[2:])
    elif sys.argv[1] == "whole":
        time_whole_ways(*sys.argv[2:])
    elif sys.argv[1] == "files":
        time_whole_ways_of_files(*sys.argv[2:])
    else:
        run(float(sys.argv[1]), *sys.argv[2:])
