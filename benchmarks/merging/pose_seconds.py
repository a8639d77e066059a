"""Seconds until there is a pose, with and without rooms: 20, 200 and 1,000 rooms.

``python -m benchmarks.merging.pose_seconds [ROOMS ...] [--write docs/results/learning.md]``: the two maps of a floor of
`benchmarks.speed.merge_growth`, extracted. The pose is looked for by walls alone, which is what `merge` does where they are
believed, by matched rooms alone, and by both; of up to 200 rooms also as if the scale were not known. Seconds are of the
processor, until the hypotheses are ranked: what comes after (bending, the verdict) is the same. Each size runs in a process of
its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.merge_growth import TURNED_POSE, two_maps
from topomerge.embedding.learned import load_embedder
from topomerge.evaluation.tables import write_section
from topomerge.extraction.extract import extract
from topomerge.matching.match import match
from topomerge.registration.pipeline import register
from topomerge.types import TopometricMap

SIZES_TIMED = (20, 200, 1000)  # rooms of the floor, of which each map shows three quarters
MOST_UNSCALED = 200  # rooms up to which the scale is looked for, too
UNTIL_POSE = ("plans", "search", "verify")  # steps of a registration until the hypotheses are ranked
WAYS_TO_POSE = ("walls", "rooms", "walls and rooms")
NEAR = 0.5  # m, how far a right pose moves the middle of the second map


def timed(a: TopometricMap, b: TopometricMap, way: str, scale: str) -> dict[str, Any]:
    """Seconds of the steps until the pose, and how far it is off, m."""
    seconds, poses = {"rows": 0.0, "match": 0.0}, []
    if way != "walls":
        describe, began = load_embedder(), time.process_time()
        rows = {id(m): describe(m) for m in (a, b)}
        seconds["rows"], began = time.process_time() - began, time.process_time()
        descriptor = describe if scale == "free" else lambda m: rows[id(m)]  # of unknown scale there are others
        poses = [h.transform for h in match(a, b, descriptor, scale_free=scale == "free").alternatives]
        seconds["match"] = time.process_time() - began
    began = time.process_time()
    registration = register(a, b, scale=scale, proposed=poses, searched=way != "rooms")
    share = (time.process_time() - began) / sum(
        registration.seconds.values()
    )  # of the processor, on a machine that has other work
    seconds |= {step: share * registration.seconds.get(step, 0.0) for step in UNTIL_POSE}
    middle = b.rooms["centroid"].mean(axis=0)[None]
    pose = registration.alternatives[0].transform if registration.alternatives else None
    off = np.inf if pose is None else float(np.linalg.norm(pose.apply(middle) - TURNED_POSE.inverse().apply(middle)))
    return {"way": way, "scale": scale, "off": off, **seconds}


def measure(rooms: int) -> list[dict[str, Any]]:
    """Rows of one size."""
    for warm in (True, False):  # the first run compiles
        a, b = (extract(grid) for grid in two_maps(20 if warm else rooms)[:2])
        scales = ("fixed", "free") if rooms <= MOST_UNSCALED else ("fixed",)
        out = [timed(a, b, way, scale) for scale in scales for way in WAYS_TO_POSE]
    return [{"rooms": rooms, "a": len(a.rooms), "b": len(b.rooms), **row} for row in out]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """As Markdown; ratios are to the search of walls alone."""
    lines = [
        "| rooms of both maps | scale | pose by | rows, s | match, s | search, s | to the pose, s | of walls alone | off, m |"
    ]
    lines.append("|" + "---|" * 9)
    for row in rows:
        total = sum(row[name] for name in ("rows", "match", *UNTIL_POSE))
        alone = next(r for r in rows if (r["rooms"], r["scale"], r["way"]) == (row["rooms"], row["scale"], "walls"))
        ratio = total / sum(alone[name] for name in UNTIL_POSE)
        off = f"{row['off']:.2f}" if row["off"] < NEAR else f"**{row['off']:.1f}**"
        scale = {"fixed": "known", "free": "unknown"}[row["scale"]]
        parts = " | ".join(f"{row[name]:.1f}" for name in ("rows", "match", "search"))
        lines.append(f"| {row['a']}, {row['b']} | {scale} | {row['way']} | {parts} | {total:.1f} | {ratio:.1f} | {off} |")
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, and write where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.merging.pose_seconds", description=__doc__)
    parser.add_argument("rooms", nargs="*", type=int, default=list(SIZES_TIMED))
    parser.add_argument("--write", type=Path, help="file whose section between the marks `pose-seconds` is replaced")
    parser.add_argument("--one", action="store_true", help="one size, its rows as JSON in the last line")
    args = parser.parse_args(words)
    if args.one:
        print(json.dumps(measure(args.rooms[0])))
        return 0
    rows = []
    for size in args.rooms:
        command = [sys.executable, "-m", "benchmarks.merging.pose_seconds", str(size), "--one"]
        rows += json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    print(table(rows))
    if args.write:
        command = ["python -m benchmarks.merging.pose_seconds", *(sys.argv[1:] if words is None else words)]
        write_section(args.write, "pose-seconds", f"`{' '.join(command)}`\n\n{table(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
