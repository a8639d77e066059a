"""The section "Beside other methods" of docs/results/peers.md from what `peers.py` left in ``cache/merge``.

``python -m benchmarks.merging.peers_table docs/results/peers.md``
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.merging.peer_methods import OPEN3D_VOXEL, RANSAC_ITERATIONS
from benchmarks.merging.peer_pairs import AREA_BINS, bin_of
from benchmarks.merging.peer_pairs import pair_class as kind_of
from benchmarks.merging.peers import target_of
from benchmarks.merging.tables import METHOD_TITLES, Row, by, good, put, share

FINE = (0.1, 1.0)  # m, degrees
TEXT = (
    "Simulated test pairs in which both maps saw something in common, also where no room was entered by both; every bin of the "
    "area and every kind of sensors in turn. All on the same points (means of 0.1 m cells), one core, one thread, in seconds of "
    "processor from points in memory to the pose; KISS-Matcher on points thinned at its voxel, with Quatro for four degrees of "
    f"freedom; Open3D at {OPEN3D_VOXEL} m, RANSAC of {RANSAC_ITERATIONS:,} iterations "
    "(0.999), made upright afterwards. Right: 0.5 m and 5° in the middle of what both saw (slices and floor plans: horizontally)."
)


REAL = (
    "The real pairs (`python -m benchmarks.merging.peers 9000 real`), as many as were reached: large grids cost Open3D "
    "minutes. The "
    "scale of Halmstad's maps is unknown: topomerge finds it, the others cannot and are given the true one."
)


KEPT = (
    "Held-out pairs of [learned against untrained](#learned-against-untrained-from-scans-to-merged-maps), all methods on "
    "the cells of the extracted maps (`python -m benchmarks.merging.peers 9000 heldout`, the first by name): topomerge on the "
    "cells "
    "alone, and with the rooms that the embedder that ships matches, joined map included where it is believed."
)


def rows_of_methods(which: str = "") -> list[Row]:
    """A row a pair and method, as `merge_results` has them; none where nothing was measured."""
    path = target_of(which or "test")
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return [{**row, **outcome, "method": m} for row in rows for m, outcome in row["methods"].items()]


HEADS = ("pairs", "right %", "within 0.1 m, 1° %", "believed, wrong", "s, median", "s, most")


def measures(mine: Sequence[Row]) -> list[Any]:
    """Right, within 0.1 m and 1 degree, believed but wrong, seconds."""
    fine, seconds = [good(r, FINE) for r in mine], [r["seconds"] for r in mine]
    wrong = sum(r.get("believed") and not good(r) for r in mine if r["err"])
    return [len(mine), share(mine, good), f"{100 * np.mean(fine):.0f}", wrong, f"{np.median(seconds):.1f}", f"{max(seconds):.1f}"]


def behind(rows: Sequence[Row], keys: Sequence[Callable[[Row], str]]) -> str:
    """Where another method has more right than ours."""
    shortfalls = []
    for key in keys:
        for group in sorted({key(r) for r in rows}):
            mine = [r for r in rows if key(r) == group]
            for limit in ((0.5, 5.0), FINE):
                many = {m: sum(good(r, limit) for r in mine if r["method"] == m) for m in METHOD_TITLES}
                more = [f"{METHOD_TITLES[m]} {n}" for m, n in many.items() if n > many["ours"]]
                shortfalls += [f"{group}, within {limit[0]} m: {', '.join(more)}, topomerge {many['ours']}"] * bool(more)
    return "; ".join(shortfalls) or "nowhere"


def real() -> str:
    """Real pairs by source, and how long they take."""
    rows = rows_of_methods("real")
    key = lambda r: f"{r['source']} {' to '.join(sorted(set(r['sensors']), reverse=True))}"  # noqa: E731
    return "\n\n".join([REAL, by(rows, key, sorted({key(r) for r in rows}), "real pairs", HEADS, measures)]) if rows else ""


def heldout() -> str:
    """Held-out pairs of extracted maps by the area in common."""
    rows = rows_of_methods("heldout")
    outcome = by(rows, lambda r: bin_of(r["common"]), list(AREA_BINS), "in common", (*HEADS, "right and believed"), with_verdict)
    return "\n\n".join([KEPT, outcome]) if rows else ""


def with_verdict(mine: Sequence[Row]) -> list[Any]:
    """As `measures`, and how many are right and believed."""
    return [*measures(mine), sum(r.get("believed") and good(r) for r in mine)]


def section() -> str:
    """The tables."""
    rows = rows_of_methods()
    keys = [lambda r: bin_of(r["common"]), lambda r: kind_of(r["sensors"])]
    kinds = sorted({kind_of(r["sensors"]) for r in rows})
    done = [r["whole"] for r in rows if r["method"] == "ours" and r["whole"]]
    seconds = {k: np.median([r[k] for r in done]) for k in ("extract", "merge")}
    longest = max(r["extract"] + r["merge"] for r in done)
    names = {r["name"] for r in rows if r["method"] == "ours" and r["whole"]}
    taken = {m: [r["seconds"] for r in rows if r["method"] == m and r["name"] in names] for m in METHOD_TITLES}
    other = {m: float(np.median(s)) for m, s in taken.items() if s}
    return "\n\n".join([
        "`python -m benchmarks.merging.cached_pairs test jobs=2; "
        "python -m benchmarks.merging.peers 9000; python -m benchmarks.merging.peers_table docs/results/peers.md`",
        TEXT,
        by(rows, keys[0], list(AREA_BINS), "in common", HEADS, measures),
        by(rows, keys[1], kinds, "kind", HEADS, measures),
        f"Bins and kinds in which another method has more right than topomerge: {behind(rows, keys)}.",
        "From two clouds to one cloud is the way to the pose, as measured above: joining the points is the same for all. To one "
        f"topometric map, on {len(done)} pairs: extraction of both {seconds['extract']:.1f} s, merge with the joined map "
        f"and its rooms {seconds['merge']:.1f} s (medians; the longest pair {longest:.1f} s); to the pose alone, on these pairs: "
        + ", ".join(f"{METHOD_TITLES[m]} {s:.1f} s" for m, s in other.items())
        + ". For a joined map with rooms the others would need the same extraction and joining, too.",
        real(),
        heldout(),
    ])  # fmt: skip


if __name__ == "__main__":
    if len(sys.argv) > 1:
        put(Path(sys.argv[1]), section(), "peers")
    else:
        print(section())
