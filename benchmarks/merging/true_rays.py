"""What merging gains by the places of the sensor: the same walks, with free space from true rays and from views of its own.

Pairs of walks through validation buildings, by every sensor that moves; each map is extracted with the poses of its points and
without, and registered with the other one of its kind. A quarter of the pairs must not merge.
``python -m benchmarks.merging.true_rays [pairs] --write docs/results/scale.md``; resumable: a line of JSON a pair in
``cache/merge/true_rays.jsonl``. What poses do for rooms and doors: `benchmarks.extraction.entered`.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.profiles import BUILDING_KINDS
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.pairs import HARD, Pair, PairSettings, make_pair
from topomerge.datasets.pairs.scan_items import draw_difficulty

from benchmarks.extraction.tables import replace_section
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.matching.poses import wrapped
from topomerge.metrics import pose_right
from topomerge.registration.pipeline import register
from topomerge.training.belief_hypotheses import RIGHT_POSE
from topomerge.types import Sim3

FIRST_SEED, TRIED = 800_960, 12  # of validation buildings; of each pair
MOVING = ("lidar", "depth", "tablet", "laser2d")
FINE = (0.1, 1.0)  # m, degrees
RAY_WAYS = {"rays": "true rays", "views": "carved from virtual views"}
Row = dict[str, Any]


def walks(number: int) -> Pair:
    """The pair of a number, in the first building that has such parts."""
    hard = HARD[number // 4 % len(HARD)] if number % 4 == 3 else None
    sensors = MOVING[number % len(MOVING)], MOVING[(number // len(MOVING)) % len(MOVING)]
    settings = PairSettings(overlap=0.5, sensors=sensors, rooms=8, hard=hard)
    for attempt in range(TRIED):
        rng = np.random.default_rng([FIRST_SEED, number, attempt])
        kind = str(BUILDING_KINDS[(number + attempt) % len(BUILDING_KINDS)])
        try:
            storeys = 2 if hard == "other-storey" else 1
            building = make_building(kind, FIRST_SEED + number, storeys, draw_difficulty(rng))
            return make_pair(building, settings, rng)
        except InputError:  # no two storeys of one plan, or no way to a room
            continue
    raise InputError(f"pair {number}: none of {TRIED} buildings has such parts")


def measured(pair: Pair, posed: bool) -> Row:
    """What is made of a pair: rooms, free space (m3), and the verdict."""
    clouds = [c if posed else replace(c, poses=None, pose_of=None) for c in (pair.a, pair.b)]
    a, b = (extract(cloud) for cloud in clouds)
    best = register(a, b)
    off = None if best.transform is None else error(best.transform, pair)
    right, fine = (off is not None and pose_right(off, "laser2d" in pair.sensors, limits) for limits in (RIGHT_POSE, FINE))
    return {
        "rooms": len(a.rooms) + len(b.rooms),
        "free": float(sum(0 if m.free is None else len(m.free) * m.free.edge**3 for m in (a, b))),
        "believed": best.accepted,
        "probability": best.probability,
        "right": right,
        "fine": fine,
    }


def error(pose: Sim3, pair: Pair) -> tuple[float, float, float] | None:
    """Horizontal and vertical, m, in the middle of the rooms that both saw, and of the yaw, degrees; None: no pose is right."""
    if pair.truth is None or not pair.shared:
        return None
    middle = pair.b.points[np.isin(pair.b.labels, [j for _, j in pair.shared])].astype(float).mean(axis=0) + pair.b.shift
    off = pose.apply(middle[None])[0] - pair.truth.apply(middle[None])[0]
    return float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrapped(pose.yaw - pair.truth.yaw))))


def run(count: int, target: Path) -> list[Row]:
    """The rows of the first pairs, of which those that are missing are made."""
    rows = [json.loads(line) for line in target.read_text().splitlines()] if target.exists() else []
    done = {(r["number"], r["way"]) for r in rows}
    for number in range(count):
        missing = [way for way in RAY_WAYS if (number, way) not in done]
        pair = walks(number) if missing else None
        for way in missing:
            assert pair is not None
            about = {"number": number, "way": way, "kind": pair.kind, "sensors": pair.sensors}
            rows.append(about | measured(pair, posed=way == "rays"))
            with target.open("a") as out:
                out.write(json.dumps(rows[-1]) + "\n")
    return [r for r in rows if r["number"] < count]


def section(rows: list[Row], command: str) -> str:
    """The table as Markdown."""
    heads = ("free space", "maps", "rooms", "free, m³", "pairs", "right", "within 0.1 m, 1°", "right and believed")
    heads += ("median probability if right", "pairs that must not merge", "believed")
    lines = [f"`{command}`", "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for way, words in RAY_WAYS.items():
        of = [r for r in rows if r["way"] == way]
        overlap, hard = ([r for r in of if (r["kind"] == "overlap") == wanted] for wanted in (True, False))
        right = [r for r in overlap if r["right"]]
        cells = [words, 2 * len(of), sum(r["rooms"] for r in of), f"{sum(r['free'] for r in of):,.0f}", len(overlap), len(right)]
        cells += [sum(r["fine"] for r in overlap), sum(r["believed"] for r in right)]
        cells += [f"{np.median([r['probability'] for r in right]):.2f}" if right else "–"]
        cells += [len(hard), sum(r["believed"] for r in hard)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run, and print or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", type=int, nargs="?", default=32)
    parser.add_argument("--write", type=Path)
    args = parser.parse_args()
    target = Path("cache/merge/true_rays.jsonl")
    target.parent.mkdir(parents=True, exist_ok=True)
    with one_thread():
        rows = run(args.pairs, target)
    words = f"python -m benchmarks.merging.true_rays {args.pairs}" + (f" --write {args.write}" if args.write else "")
    text = section(rows, words)
    print(text)
    if args.write:
        replace_section(args.write, text, "true-rays")


if __name__ == "__main__":
    main()
