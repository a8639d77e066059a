"""Atlases of 2, 4, 8 and 16 simulated maps: time, memory, maps placed right and wrong, registrations that were needed.

``python -m benchmarks.merging.atlas test`` puts together every set that `benchmarks/merging/atlas_maps.py` made of the split,
each in a process
of its own, and prints a Markdown table; what was measured is kept in ``cache/atlas/results_SPLIT.jsonl`` and not measured again
(``--anew``: all of it). A map is right within 0.5 m and 5 degrees of where it lies in the first map of its component, at its own
middle; with slices, which say nothing of heights, seen from above.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.merging.atlas_maps import ATLAS_CACHE, AtlasSet, load
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import atlas
from topomerge.matching.poses import pose_difference

RIGHT = (0.5, np.radians(5.0))  # m, rad
SIZES = (2, 4, 8, 16)


def errors(made: AtlasSet, result: AtlasResult) -> dict[int, tuple[float, float] | None]:
    """Error of each map in its component's first map, m and rad; None for maps of two buildings in one component."""
    out: dict[int, tuple[float, float] | None] = {}
    sensors: Any = made.about["sensors"]
    for members in result.components:
        first = members[0]
        for k in members[1:]:
            one, two = made.truth[first], made.truth[k]
            if one is None or two is None:
                out[k] = None
                continue
            true, middle = one.inverse() @ two, result.maps[k].grid.centroids().mean(axis=0)
            off = result.transforms[k].apply(middle[None])[0] - true.apply(middle[None])[0]
            flat = "laser2d" in (sensors[first], sensors[k])
            out[k] = (float(np.linalg.norm(off[:2] if flat else off)), pose_difference(true, result.transforms[k], middle)[1])
    return out


def measure(folder: Path) -> dict[str, Any]:
    """One set: what is told of it."""
    made = load(folder)
    began = process_time()
    result = atlas(made.files)
    seconds = process_time() - began
    off = errors(made, result)
    right = [k for k, e in off.items() if e is not None and e[0] < RIGHT[0] and e[1] < RIGHT[1]]
    belong = sum(t is not None for t in made.truth)
    best = max((sum(k in right for k in members[1:]) for members in result.components), default=0)
    return {
        "name": made.name,
        "maps": len(made.files),
        "seconds": seconds,  # of one core
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "registered": result.registered[0],
        "pairs": result.registered[1],
        "could": belong - 1,
        "right": best,
        "wrong": len(off) - len(right),
        "components": [list(c) for c in result.components if len(c) > 1],
        "errors": {str(k): e for k, e in off.items()},
        "thrown": [list(link.maps) for link in result.rejected],
        "building": made.about["building"],
        "sensors": made.about["sensors"],
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    head = "| maps | sets | s on one core | slowest | peak MiB | pairs registered | of | placed right | wrong | median error m |"
    lines = [head, "|" + "---|" * head.count(" |")]
    for size in SIZES:
        some = [r for r in rows if r["maps"] == size]
        if not some:
            continue
        seconds = [r["seconds"] for r in some]
        off = [e[0] for r in some for e in r["errors"].values() if e]
        cells = [
            size,
            len(some),
            f"{np.median(seconds):.1f}",
            f"{max(seconds):.1f}",
            f"{max(r['peak_mib'] for r in some):.0f}",
            f"{np.mean([r['registered'] for r in some]):.1f}",
            some[0]["pairs"],
            f"{sum(r['right'] for r in some)} of {sum(r['could'] for r in some)}",
            sum(r["wrong"] for r in some),
            f"{np.median(off):.2f}" if off else "–",
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main(split: str, anew: bool = False) -> None:
    """Measure what was not measured, and print the table."""
    path = ATLAS_CACHE / f"results_{split}.jsonl"
    if anew:
        path.unlink(missing_ok=True)
    done = {row["name"] for row in map(json.loads, path.read_text().splitlines())} if path.exists() else set()
    for folder in sorted(p.parent for p in (ATLAS_CACHE / split).glob("[0-9]*/truth.json")):
        if folder.name not in done:
            one = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
            command = [sys.executable, "-m", "benchmarks.merging.atlas", "one", str(folder)]
            finished = subprocess.run(command, capture_output=True, text=True, check=True, env=one)
            with path.open("a") as out:
                out.write(finished.stdout.splitlines()[-1] + "\n")
            print(folder.name, flush=True)
    print(table([json.loads(line) for line in path.read_text().splitlines()]))


if __name__ == "__main__":
    if sys.argv[1] == "one":
        print(json.dumps(measure(Path(sys.argv[2]))))
    else:
        main(sys.argv[1], "--anew" in sys.argv)
