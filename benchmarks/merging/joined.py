"""Joined maps, measured: rooms and doors of the joined map against those of the better of the two, and walls that it has twice.

    python -m benchmarks.merging.joined 24 1800 [split]             # pairs, seconds that a run may take
    python -m benchmarks.merging.joined --write docs/results/bending.md [split]

Simulated pairs with the usual drift (`datasets.pairs.bent_pairs`, without drawings), from the true pose refined as registration
does, rigid and bent. Resumable: a line of JSON a pair in ``cache/merge/joined_<split>.jsonl``. Split ``validation`` to choose by,
``test`` for the table.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.bent_pairs import DRAWING, BentMaker, bent_items
from topomerge.datasets.pairs.items import plans_of
from topomerge.datasets.simulation.floor_truth import Truth, in_frame, judge, truth_of
from topomerge.datasets.simulation.joined_truth import joined_truth

import topomerge
from benchmarks.merging.tables import RESULTS_CACHE, put, table
from benchmarks.real_data import real_data
from topomerge.errors import InputError
from topomerge.evaluation.doubled_walls import doubled_walls
from topomerge.fusion.fuse import fuse
from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import sensor_drift
from topomerge.registration.pipeline import fine
from topomerge.registration.prepared import prepare
from topomerge.types import Placement, Sim3, TopometricMap

Row = dict[str, Any]
WAYS = ("rigid", "bent")
HEADS = ("pairs", "rooms of the better map", "of the joined map", "not below the better", "doors of the better", "of the joined",
         "doubled walls", "at most 2 %", "fusing s")  # fmt: skip
ABOUT = (
    "Mean IoU of the true rooms over what was seen (of a single map: what it saw; of the joined one: what either saw), F1 of "
    "doors, share of the wall columns with a parallel wall within 0.1-0.6 m that neither map has, between which one could look. "
    "The drift of each map is taken out of its places before rooms are judged. Medians over pairs."
)


def truth_about(maker: BentMaker, side: int, factor: float) -> tuple[TopometricMap, Truth]:
    """A map of a pair, extracted, and what is true about it, in its frame."""
    building, visited, frames = maker.place
    cloud, undrift = maker.map(side, factor)
    frame = frames[side]
    back = frame.inverse()
    turn = Sim3(-frame.yaw).matrix[:3, :3]
    been = np.isin(np.arange(len(building.rooms)), visited[side])
    points = back.apply(cloud.points.astype(np.float64) + cloud.shift)
    truth = truth_of(building, been, points, back.apply(undrift.places), undrift.shifts @ turn.T)
    return topomerge.extract(cloud), in_frame(truth, frame)


def scores(map: TopometricMap, truth: Truth) -> dict[str, float]:
    """Mean IoU of rooms and F1 of doors."""
    verdict = judge(map, truth)
    p, r = verdict.doors.precision, verdict.doors.recall
    return {"iou": verdict.rooms.iou, "doors": 2 * p * r / (p + r) if p + r > 0 else 0.0 if p == p and r == r else float("nan")}


def row_of(maker: BentMaker, name: str, factor: float) -> Row:
    """Both maps, joined rigidly and bent."""
    (a, truth_a), (b, truth_b) = (truth_about(maker, side, factor) for side in (0, 1))
    frames = maker.place[2]
    right = frames[0] @ frames[1].inverse()
    sensors = maker.item.sensors
    row: Row = {"name": name, "sensors": sensors, "factor": factor, "building": maker.place[0].name}
    row |= {side: scores(m, t) for side, m, t in zip("ab", (a, b), (truth_a, truth_b), strict=True)}
    pa, pb = prepare(a), prepare(b)
    pose = fine(pa, pb, right)[0]
    bent = bend(pa, pb, pose, drift=(sensor_drift(sensors[0]), sensor_drift(sensors[1])))
    row["bend"] = {**bent.features, "reason": bent.reason}
    for way, transform, bends in (("rigid", pose, {}), ("bent", bent.transform, dict(enumerate(bent.deformations)))):
        began = time.process_time()
        joined = fuse((a, b), [(0, Sim3()), (1, transform)], bends)
        seconds = time.process_time() - began
        lay = Placement.of(Sim3(), bends.get(0)).transform_points, Placement.of(transform, bends.get(1)).transform_points
        truth = joined_truth(truth_a, truth_b, right, lay)
        row[way] = {**scores(joined, truth), "doubled": doubled_walls(joined), "rooms": len(joined.rooms), "seconds": seconds}
    return row


def rows(split: str, pairs: int, done: set[str], factor: float = 1.0) -> Iterator[Row]:
    """Rows of the pairs that are not done."""
    items, plans = bent_items(split, str(real_data()), pairs)
    for item in items:
        if item.name in done or DRAWING in item.sensors:
            continue
        try:
            yield row_of(BentMaker(item, list(plans_of(item, plans))), item.name, factor)
        except InputError as error:  # no such parts, or a room that can't be reached
            print(f"{item.name}: {error}", file=sys.stderr)


def _median(values: Sequence[float]) -> str:
    numbers = np.array(values)[~np.isnan(values)]
    return f"{np.median(numbers):.3f}" if len(numbers) else "–"


def summary(measured: Sequence[Row]) -> str:
    """A line for each way."""
    lines = []
    for way in WAYS:
        joined = [r[way] for r in measured]
        better = [{k: np.nanmax([r["a"][k], r["b"][k]]) for k in ("iou", "doors")} for r in measured]
        enough = np.mean([j["iou"] >= k["iou"] - 1e-9 for j, k in zip(joined, better, strict=True)])
        doubled = np.array([j["doubled"] for j in joined])
        lines.append([
            way, len(joined), _median([k["iou"] for k in better]), _median([j["iou"] for j in joined]), f"{100 * enough:.0f} %",
            _median([k["doors"] for k in better]), _median([j["doors"] for j in joined]), f"{100 * np.nanmedian(doubled):.1f} %",
            f"{100 * np.mean(doubled <= 0.02):.0f} %", _median([j["seconds"] for j in joined]),
        ])  # fmt: skip
    return table(("way", *HEADS), lines)


def main(*words: str) -> None:
    """Run what is missing until the time is over, or write the table."""
    writes = words[0] == "--write"
    split = (*words[2:], "test" if writes else "validation")[0]
    target = RESULTS_CACHE / f"joined_{split}.jsonl"
    target.parent.mkdir(parents=True, exist_ok=True)
    listed: list[Row] = [json.loads(line) for line in target.read_text().splitlines()] if target.exists() else []
    if writes:
        if not listed:
            raise SystemExit(f"{target}: nothing was measured yet")
        command = f"`python -m benchmarks.merging.joined 30 3600 {split}`"
        put(Path(words[1]), f"{command}: {len(listed)} simulated pairs. {ABOUT}\n\n{summary(listed)}", "joined")
        return
    began = time.monotonic()
    for row in rows(split, int(words[0]), {r["name"] for r in listed}):
        listed.append(row)
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
        if time.monotonic() - began > float(words[1]):
            break
    print(summary(listed))


if __name__ == "__main__":
    main(*sys.argv[1:])
