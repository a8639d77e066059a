"""Ours, KISS-Matcher (0.2 and 0.3 m), FPFH + RANSAC and FGR on the same pairs, in one run: what is right, and the time it takes.

``python -m benchmarks.merging.peers SECONDS [real|heldout]`` works through test pairs (`cached_pairs.py`)
for so many seconds of processor, bin by bin and kind by kind in turn; or through the real pairs of TOPOMERGE_DATA; or through the
maps that `evaluate.py data=heldout` kept, with the learned embedder's merge among the methods. Resumable: a line of JSON a pair
with all methods in ``cache/merge/peers*.jsonl``; `peers_table.py` makes the tables of them.

Everyone gets the same two clouds, the means of the points of 0.1 m cells, on one core and one thread. Timed, in seconds of
processor: from these clouds in memory to the pose; ours also from them to the joined map with its rooms (``extract`` of both,
``merge``). KISS-Matcher gets points thinned at its voxel, so that its Python binding has little to copy, and its solver of four
degrees of freedom (Quatro). Open3D has none: its poses are made upright afterwards. Where the scale is unknown (Halmstad), ours
has to find it; the others, which can't, are given it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import load_set
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids

from benchmarks.merging.cached_pairs import pair_files
from benchmarks.merging.register import SCALELESS, open3d_features, real_pairs, upright
from topomerge.fusion.cell_means import cell_middles
from topomerge.training.belief_hypotheses import error
from topomerge.types import PointCloud, Sim3, VoxelGrid

CACHE = Path("cache/merge")
TARGETS = {"": CACHE / "peers.jsonl", "real": CACHE / "peers_real.jsonl", "heldout": CACHE / "peers_heldout.jsonl"}
HELDOUT = Path("cache/evaluation/heldout.jsonl")
VOXEL, ITERATIONS = 0.3, 100_000  # of Open3D
WHOLE = 3  # every third pair goes the whole way to a joined map
AREA_BINS = {"<40 m²": (1.0, 40.0), "40-80 m²": (40.0, 80.0), "≥80 m²": (80.0, np.inf)}
ORDER = ["lidar", "other 3D", "slice", "floor plan"]
Answer = tuple[Sim3 | None, bool, float]  # T_ab, believed?, s of processor


def kind_of(sensors: Sequence[str]) -> str:
    """What is compared: a lidar's or another scan, a 2D slice or a floor plan, with what."""
    names = {"laser2d": "slice", "drawing": "floor plan", "lidar": "lidar", "phone": "slice"}
    one, two = sorted((names.get(s, "other 3D") for s in sensors), key=ORDER.index)
    return f"{one} - {two}"


def bin_of(common: float) -> str:
    """Of the area that both maps saw."""
    return next(name for name, (low, high) in AREA_BINS.items() if low <= common < high)


def cloud(grid: VoxelGrid, free: VoxelGrid | None = None) -> PointCloud:
    """A grid's points as a cloud."""
    return PointCloud(np.asarray(grid.properties["mean"], np.float32), free=free)


def ours(pair: GridPair) -> Answer:
    """From points to the pose: cells, plans, search, verdict."""
    from topomerge.extraction.voxels import voxelise
    from topomerge.fusion.registration import register

    points = [np.asarray(g.properties["mean"]) for g in (pair.a, pair.b)]
    began = time.process_time()
    a, b = (voxelise(PointCloud(p), pair.a.edge) for p in points)
    registration = register(a, b, free=pair.free, scale="free" if pair.about["source"] in SCALELESS else "fixed")
    return registration.transform, registration.accepted, time.process_time() - began


def whole(pair: GridPair) -> dict[str, float]:
    """Seconds from two clouds to the joined map and its rooms: extraction of both, and `merge` (joined even where refused)."""
    from topomerge.extraction.extract import extract
    from topomerge.fusion.merge import merge

    began = time.process_time()
    a, b = (extract(cloud(g, f), name=n) for g, f, n in zip((pair.a, pair.b), pair.free, "ab", strict=True))
    middle = time.process_time()
    result = merge([a, b], scale="free" if pair.about["source"] in SCALELESS else "fixed", force=True)
    return {"extract": middle - began, "merge": time.process_time() - middle, "joined": float(result.map is not None)}


def kiss(voxel: float) -> Callable[[GridPair], Answer]:
    """KISS-Matcher; it believes its answer if it says `valid`."""

    def run(pair: GridPair) -> Answer:
        import kiss_matcher
        import open3d as o3d

        began = time.process_time()
        clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cell_middles(g))) for g in (pair.b, pair.a)]
        thin = [np.asarray(c.voxel_down_sample(voxel).points, np.float32) for c in clouds]
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel, use_quatro=True))
        solution = matcher.estimate(*thin)
        seconds = time.process_time() - began
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.array(solution.rotation), np.array(solution.translation).ravel()
        return upright(matrix, pair), bool(solution.valid), seconds

    return run


def open3d(pair: GridPair) -> dict[str, Answer]:
    """RANSAC and FGR, with one set of features, whose time counts for both. It has no verdict: an answer counts as believed."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    reg = o3d.pipelines.registration
    began = time.process_time()
    b, a, fb, fa = open3d_features(pair, VOXEL)
    features = time.process_time() - began
    checks = [reg.CorrespondenceCheckerBasedOnEdgeLength(0.9), reg.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL)]
    estimate, criteria = reg.TransformationEstimationPointToPoint(False), reg.RANSACConvergenceCriteria(ITERATIONS, 0.999)
    option = reg.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * VOXEL)
    run: dict[str, Callable[[], Any]] = {
        "fpfh": lambda: reg.registration_ransac_based_on_feature_matching(
            b, a, fb, fa, True, 1.5 * VOXEL, estimate, 3, checks, criteria
        ),
        "fgr": lambda: reg.registration_fgr_based_on_feature_matching(b, a, fb, fa, option),
    }
    out: dict[str, Answer] = {}
    for name, method in run.items():
        began = time.process_time()
        solution = method()
        out[name] = upright(np.asarray(solution.transformation), pair), True, features + time.process_time() - began
    return out


def learned(pair: GridPair) -> Answer:
    """`merge` of the extracted maps: rooms matched by the embedder that ships propose poses, too."""
    from topomerge.fusion.merge import merge

    maps = pair.about["evaluation_pair"].maps()  # type: ignore[attr-defined]
    began = time.process_time()
    result = merge(maps)
    pose = result.registration.transform if result.registration else None
    return pose, result.merged, time.process_time() - began


def heldout_pairs() -> Iterator[GridPair]:
    """Held-out pairs of extracted maps that show something in common, as cells."""
    for evaluation_pair in load_set(HELDOUT):
        if evaluation_pair.transform is None or evaluation_pair.about["common"] < 1 or evaluation_pair.about["scale_free"]:
            continue
        maps = evaluation_pair.maps()
        a, b = (m.grid.with_properties(mean=m.grid.centroids()) for m in maps)
        about = {key: evaluation_pair.about[key] for key in ("sensors", "source")}
        about |= {"building": str(evaluation_pair.about["building"]), "kind": "overlap", "evaluation_pair": evaluation_pair}
        free, common = (maps[0].free, maps[1].free), evaluation_pair.about["common"]
        yield GridPair(evaluation_pair.name, a, b, free, evaluation_pair.transform, common, about)


def scaled(pair: GridPair) -> GridPair:
    """The pair with b brought to the scale of a."""
    size = pair.truth.scale if pair.truth is not None else 1.0
    if size == 1.0:
        return pair
    grid = VoxelGrid(pair.b.cells, pair.b.origin * size, pair.b.edge * size, pair.b.shape)
    grid = grid.with_properties(mean=np.asarray(pair.b.properties["mean"]) * size)
    return replace(pair, b=grid, free=(pair.free[0], None), truth=replace(pair.truth, scale=1.0))


def measured(pair: GridPair, all_the_way: bool) -> dict[str, Any]:
    """All methods on one pair."""
    given = scaled(pair)
    answers = {"kiss02": kiss(0.2)(given), "kiss03": kiss(0.3)(given), **open3d(given)}
    outcomes = {}
    for name, where, (pose, believed, seconds) in (("ours", pair, ours(pair)), *((n, given, a) for n, a in answers.items())):
        outcomes[name] = {"err": None if pose is None else error(pose, where), "believed": believed, "seconds": seconds}
    if "evaluation_pair" in pair.about:
        pose, believed, seconds = learned(pair)
        outcomes["learned"] = {"err": None if pose is None else error(pose, pair), "believed": believed, "seconds": seconds}
    about = {k: pair.about[k] for k in ("sensors", "building", "kind", "source")}
    return {"name": pair.name, "common": pair.common, **about, "methods": outcomes, "whole": whole(pair) if all_the_way else None}


def chosen() -> Iterator[Path]:
    """Pairs that share something, one of each bin and kind in turn; drawings of unknown scale are left out."""
    groups: dict[tuple[str, str], list[Path]] = {}
    for path in pair_files("test") + pair_files("test_drawings", ("overlap",)):
        with np.load(path) as arrays:
            about = json.loads(arrays["about"].tobytes())
        if about["kind"] == "overlap" and about["common"] >= 1 and not about.get("scaled"):
            groups.setdefault((bin_of(about["common"]), kind_of(about["sensors"])), []).append(path)
    for k in range(max(map(len, groups.values()))):
        yield from (paths[k] for _, paths in sorted(groups.items()) if k < len(paths))


def pairs(which: str, done: set[str]) -> Iterator[tuple[int, GridPair]]:
    """Numbered pairs that are not done."""
    if which:
        every = real_pairs() if which == "real" else heldout_pairs()
        yield from ((k, pair) for k, pair in enumerate(every) if pair.name not in done)
        return
    for k, path in enumerate(list(chosen())):
        if path.stem not in done:
            yield k, load_grids(path, mean=True)


def run(seconds: float, which: str = "") -> None:
    """Measure what is missing, until the seconds of processor are used up."""
    os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[-1]})  # KISS-Matcher takes all cores otherwise
    target = TARGETS[which]
    done = {json.loads(line)["name"] for line in target.read_text().splitlines()} if target.exists() else set()
    for k, pair in pairs(which, done):
        row = measured(pair, k % WHOLE == 0 and not which)
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")
        summary = {m: (round(r["seconds"], 1), r["err"] and round(r["err"][0], 2)) for m, r in row["methods"].items()}
        print(row["name"], row["sensors"], summary, row["whole"], flush=True)
        if time.process_time() > seconds:
            return


if __name__ == "__main__":
    run(float(sys.argv[1]), *sys.argv[2:])
