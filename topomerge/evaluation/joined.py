"""Joined maps, measured: rooms and doors of the joined map against those of the better of the two, and walls that it has twice.

``python evaluate.py task=joined data=test data.limit=30 write=docs/results/bending.md``: simulated pairs with the usual drift
(`datasets.pairs.drifted_pairs`, without drawings), from the true pose refined as registration does, rigid and bent. Set
``validation`` to choose by, ``test`` for the table.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.datasets.pairs.drifted_pairs import DRAWING, DriftedPairMaker, draw_drifted_items
from topomerge.datasets.pairs.items import select_plans
from topomerge.datasets.simulation.floor_truth import FloorTruth, build_truth, evaluate_map, join_truths, transform_truth
from topomerge.errors import InputError
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.score import measure_doubled_walls
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data, measure_missing
from topomerge.fusion.fuse import fuse
from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import get_sensor_drift
from topomerge.registration.pipeline import refine_by_surfaces
from topomerge.registration.prepared import prepare
from topomerge.types import LogFn, Placement, Sim3, TopometricMap

MAKERS = (
    "topomerge.extraction.extract",
    "topomerge.fusion.fuse",
    "topomerge.registration.pipeline",
    "topomerge.registration.bend.bend",
)
JOINED_PAIRS = 30  # if no limit is given
WAYS = ("rigid", "bent")
HEADS = ("pairs", "rooms of the better map", "of the joined map", "not below the better", "doors of the better", "of the joined",
         "doubled walls", "at most 2 %", "fusing s")  # fmt: skip


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the pairs' recipe."""
    return [f"{settings.data.set or 'validation'} {settings.data.limit or JOINED_PAIRS}"]


@lru_cache(maxsize=1)
def load_makers(split: str, pairs: int) -> dict[str, Any]:
    """Load what makes the pairs of a split."""
    items, plans = draw_drifted_items(split, str(find_real_data()), pairs)
    return {item.name: (item, plans) for item in items if DRAWING not in item.sensors}


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure the pairs that are missing; of those that can't be made there is no row."""
    split, pairs = settings.data.set or "validation", settings.data.limit or JOINED_PAIRS
    items = {name: (name, split, pairs) for name in load_makers(split, pairs) if settings.data.only in name}
    path = Path(settings.cache) / "evaluation" / f"joined_{split}.jsonl"
    return [row for row in measure_missing(path, items, measure_pair, log_line, settings) if "refused" not in row]


def measure_pair(name: str, split: str, pairs: int) -> Row:
    """Make a pair and join its maps."""
    item, plans = load_makers(split, pairs)[name]
    try:
        return build_row(DriftedPairMaker(item, list(select_plans(item, plans))), name, 1.0)
    except InputError as error:  # no such parts, or a room that can't be reached
        return {"refused": str(error)}


def extract_with_truth(maker: DriftedPairMaker, side: int, factor: float) -> tuple[TopometricMap, FloorTruth]:
    """Return a map of a pair, extracted, and what is true about it, in its frame."""
    building, visited, frames = maker.place
    cloud, undrift = maker.simulate_map(side, factor)
    frame = frames[side]
    back = frame.inverse()
    turn = Sim3(-frame.yaw).matrix[:3, :3]
    been = np.isin(np.arange(len(building.rooms)), visited[side])
    points = back.apply(cloud.points.astype(np.float64) + cloud.shift)
    truth = build_truth(building, been, points, back.apply(undrift.places), undrift.shifts @ turn.T)
    return topomerge.extract(cloud), transform_truth(truth, frame)


def compute_scores(map: TopometricMap, truth: FloorTruth) -> dict[str, float]:
    """Compute the mean IoU of rooms and the F1 of doors."""
    verdict = evaluate_map(map, truth)
    p, r = verdict.doors.precision, verdict.doors.recall
    return {"iou": verdict.rooms.iou, "doors": 2 * p * r / (p + r) if p + r > 0 else 0.0 if p == p and r == r else float("nan")}


def build_row(maker: DriftedPairMaker, name: str, factor: float) -> Row:
    """Return both maps, joined rigidly and bent."""
    (a, truth_a), (b, truth_b) = (extract_with_truth(maker, side, factor) for side in (0, 1))
    frames = maker.place[2]
    right = frames[0] @ frames[1].inverse()
    sensors = maker.item.sensors
    row: Row = {"name": name, "sensors": sensors, "factor": factor, "building": maker.place[0].name}
    row |= {side: compute_scores(m, t) for side, m, t in zip("ab", (a, b), (truth_a, truth_b), strict=True)}
    pa, pb = prepare(a), prepare(b)
    pose = refine_by_surfaces(pa, pb, right)[0]
    bent = bend(pa, pb, pose, drift=(get_sensor_drift(sensors[0]), get_sensor_drift(sensors[1])))
    row["bend"] = {**bent.features, "reason": bent.reason}
    for way, transform, bends in (("rigid", pose, {}), ("bent", bent.transform, dict(enumerate(bent.deformations)))):
        began = time.process_time()
        joined = fuse((a, b), [(0, Sim3()), (1, transform)], bends)
        seconds = time.process_time() - began
        lay = Placement.of(Sim3(), bends.get(0)).transform_points, Placement.of(transform, bends.get(1)).transform_points
        truth = join_truths(truth_a, truth_b, right, lay)
        row[way] = {
            **compute_scores(joined, truth),
            "doubled": measure_doubled_walls(joined),
            "rooms": len(joined.rooms),
            "seconds": seconds,
        }
    return row


def write_median(values: Sequence[float]) -> str:
    """Write the median of what is known."""
    numbers = np.array(values)[~np.isnan(values)]
    return f"{np.median(numbers):.3f}" if len(numbers) else "–"


def tabulate(measured: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate a line for each way."""
    lines = []
    for way in WAYS:
        joined = [r[way] for r in measured]
        better = [{k: np.nanmax([r["a"][k], r["b"][k]]) for k in ("iou", "doors")} for r in measured]
        enough = np.mean([j["iou"] >= k["iou"] - 1e-9 for j, k in zip(joined, better, strict=True)])
        doubled = np.array([j["doubled"] for j in joined])
        lines.append([
            way, len(joined), write_median([k["iou"] for k in better]), write_median([j["iou"] for j in joined]),
            f"{100 * enough:.0f} %", write_median([k["doors"] for k in better]), write_median([j["doors"] for j in joined]),
            f"{100 * np.nanmedian(doubled):.1f} %",
            f"{100 * np.mean(doubled <= 0.02):.0f} %", write_median([j["seconds"] for j in joined]),
        ])  # fmt: skip
    return {"joined": f"{len(measured)} pairs.\n\n{write_table(('way', *HEADS), lines)}"}
