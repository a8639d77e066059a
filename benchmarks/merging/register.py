"""Registration of whole maps: what is merged right and wrong, and how fast; beside other methods: `peers.py`.

``python -m benchmarks.merging.register [split] [limit]``: cached simulated pairs (``cached_pairs.py``; split ``train`` for
development, ``test`` for final runs only; ``test_drawings`` for maps and their floor plans), ``real`` for the real pairs of
TOPOMERGE_DATA, ``development`` (a floor) and ``storeys`` for those to choose by. Resumable: a line of JSON a pair in
``cache/merge/results_<split>.jsonl``; the first `limit` pairs are run (0: none, only the table).

Right: within 0.5 m and 5 degrees (fine: 0.1 m, 1 degree) in the middle of what both maps saw; of slices and drawings horizontally
and on the right storey. Seconds are of the processor, so that other jobs on the machine do not count.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids
from topomerge.datasets.real.cached_grids import real_grid_pairs

from benchmarks.merging.cached_pairs import buildings_of, hard_of, pair_files, places_of
from benchmarks.real_data import real_data
from topomerge.metrics import on_storey
from topomerge.registration.pipeline import Registration, register
from topomerge.training.belief_hypotheses import error, kind_of, right
from topomerge.types import Array, Sim3

SCALELESS = ("halmstad",)  # no metres per pixel are known
# Split -> sources of `datasets.real`; None: all that evaluate.
REAL_SPLITS = {"real": None, "development": ("office_floor",), "storeys": ("storeys",)}
FINE = (0.1, 1.0)  # m, degrees
Answer = tuple[Sim3 | None, bool, float]  # T_ab, believed?, how much


def ours(pair: GridPair) -> Answer:
    """The answer of `registered`."""
    registration = registered(pair)
    return registration.transform, registration.accepted, registration.probability


def registered(pair: GridPair) -> Registration:
    """`register` with cells and the middles of their points, as maps have them; the scale is free where that of the source is
    unknown."""
    scaled = pair.about["source"] in SCALELESS or pair.about.get("scaled")
    return register(pair.a, pair.b, free=pair.free, scale="free" if scaled else "fixed")


def upright(matrix: Array, pair: GridPair) -> Sim3 | None:
    """The pose as one under gravity that keeps the place where errors are measured; None where the map was turned over."""
    if not np.isfinite(matrix).all() or matrix[2, 2] < 0.9:
        return None
    yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
    placed = matrix[:3, :3] @ pair.anchor + matrix[:3, 3] - Sim3(yaw).apply(pair.anchor[None])[0]
    x, y, z = placed.tolist()
    return Sim3(yaw, (x, y, z))


def real_pairs(split: str = "real") -> Iterator[GridPair]:
    """The real pairs, at 0.1 m; of split ``development`` those that one may choose by."""
    return real_grid_pairs(str(real_data()), REAL_SPLITS[split])


def simulated_pairs(split: str, limit: int, skip: set[str]) -> Iterator[GridPair]:
    """The first cached pairs of a split, but for those named."""
    for path in pair_files(split, ("overlap",) if split.endswith("_drawings") else ())[:limit]:
        if path.stem not in skip:
            yield load_grids(path)


def run(split: str, limit: int, target: Path) -> None:
    """Run what is missing."""
    done = {r["name"] for r in map(json.loads, target.read_text().splitlines())} if target.exists() else set()
    for pair in real_pairs(split) if split in REAL_SPLITS else simulated_pairs(split, limit, done):
        if pair.name in done:
            continue
        began = time.process_time()
        best = registered(pair)
        pose = best.transform
        seconds = time.process_time() - began
        about = {k: pair.about.get(k) for k in ("sensors", "kind", "overlap", "differs", "scaled")}
        row = {"name": pair.name, "method": "ours", "common": pair.common, **about, **where_from(pair, split)}
        row |= {"hard": hard_of(pair), "seconds": seconds, "believed": best.accepted}
        row |= {"probability": best.probability, "posterior": best.posterior}
        row |= {"answered": pose is not None, **outcome(pose, pair)}
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")


def where_from(pair: GridPair, split: str) -> dict[str, str]:
    """Source and buildings of a pair (`places_of`)."""
    if split in REAL_SPLITS:
        name, source = str(pair.about["building"]), str(pair.about["source"])
        return places_of((name, name), (source, source))
    return places_of(buildings_of(pair, split))


def outcome(pose: Sim3 | None, pair: GridPair) -> dict[str, Any]:
    """How far a pose is off (``err``: horizontal and vertical, m, and degrees; ``scale``: by a factor), and what that makes it:
    ``right`` and ``fine`` within 0.5 m and 5 degrees, 0.1 m and 1 degree, ``wrong_storey`` on another floor."""
    off = None if pose is None else error(pose, pair)
    sensors: Any = pair.about["sensors"]
    judged = {"right": right(off, sensors), "fine": right(off, sensors, FINE)}
    scale = None if pose is None or pair.truth is None else pose.scale / pair.truth.scale
    return {"err": off, "scale": scale, **judged, "wrong_storey": off is not None and not on_storey(off[1])}


def table(rows: list[dict[str, Any]], key: Callable[[dict[str, Any]], str]) -> None:
    """One line a group: pairs, right and fine among all, believed and right, believed and wrong, median seconds."""
    for group in sorted({key(r) for r in rows}):
        members = [r for r in rows if key(r) == group]
        good, fine = (np.array([r[name] for r in members]) for name in ("right", "fine"))
        believed = np.array([r["believed"] and r["answered"] for r in members])
        print(
            f"{group:24s} pairs {len(members):3d}  right {good.sum():3d}  fine {fine.sum():3d}  believed right "
            f"{(good & believed).sum():3d}  believed wrong {(believed & ~good).sum():3d}  cpu s "
            f"{np.median([r['seconds'] for r in members]):.2f}"
        )


def main(split: str = "train", limit: str = "40") -> None:
    """Run and print."""
    target = Path("cache/merge") / f"results_{split}.jsonl"
    target.parent.mkdir(parents=True, exist_ok=True)
    run(split, int(limit), target)
    rows = [json.loads(line) for line in target.read_text().splitlines()]
    table(rows, lambda r: f"{r['source']}" if split in REAL_SPLITS else kind_of(r))
    table([r for r in rows if r["common"] >= 40], lambda r: "-".join(sorted(r["sensors"])))


if __name__ == "__main__":
    main(*sys.argv[1:])
