"""Doors by how they stand: which are there, and of which nothing is, with walls looked at and without.

``python evaluate.py task=doors`` scans buildings of the validation list by a laser scanner and a depth camera at 2.5 cm
(``data=dev``: of the training list, to develop on), most doors with frames, and makes a map of each with and without
`extraction.elevations`.

A true door between two visited rooms is there if the map has one within 0.5 m. One that the map calls shut is right where a shut
door is. Doors of the map that lead to rooms that were only looked into count nowhere, as in the other tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Difficulty
from topomerge.datasets.simulation.floor_truth import evaluate_map
from topomerge.evaluation.cases import BUILDING_KINDS
from topomerge.evaluation.documents import write_share, write_table
from topomerge.evaluation.scans import Case, Scan, load_scan
from topomerge.evaluation.tasks import Row, TaskSettings, find_optional_data, limit_cases, measure_missing
from topomerge.extraction.extract import extract
from topomerge.metrics import match_places
from topomerge.types import Array, LogFn, TopometricMap

MAKERS = ("topomerge.extraction.extract", "topomerge.metrics", "topomerge.evaluation.scans")
DOOR_SEEDS, TRAINING = 800_720, 5_700  # first seeds
FRAMES = 0.7  # share of the doors with frames and handles
STATES, ANSWERS = ("open", "half", "shut"), ("right", "said", "said half")
SHOWN_BY = PLAN, WALLS = "plan", "plan and walls"

DOOR_COLUMNS: tuple[str, ...] = ("sensor", "doors by", "true doors", *STATES)
DOOR_COLUMNS += ("precision", "called shut: right", "called half open: right", "edges P", "edges R", "rooms IoU", "s")


def draw_cases(development: bool) -> list[Case]:
    """Draw every kind of building by both sensors."""
    first = TRAINING if development else DOOR_SEEDS
    cases = [(kind, sensor) for sensor in ("tls", "depth") for kind in BUILDING_KINDS]
    return [
        Case("doors", "procedural", kind, sensor, first + i, rooms=8, difficulty=(("frames", FRAMES),), spacing=0.025)
        for i, (kind, sensor) in enumerate(cases)
    ]


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the scans."""
    return [case.key for case in limit_cases(draw_cases(settings.data.set == "dev"), settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure each scan by the plan alone, and by plan and walls."""
    scans, data = Path(settings.cache) / "scans", find_optional_data()
    cases = limit_cases(draw_cases(settings.data.set == "dev"), settings)
    items = {f"{case.key} {how}": (case, how, scans, data) for case in cases for how in SHOWN_BY}
    path = Path(settings.cache) / "evaluation" / "doors.jsonl"
    return measure_missing(path, items, measure_case, log_line, settings, compute_code_digest(*MAKERS, __name__))


def measure_case(case: Case, how: str, scans: Path, data: Path | None) -> Row:
    """Load a scan and score its map."""
    return score_doors(case, load_scan(case, scans, data), how)


def score_doors(case: Case, scan: Scan, how: str) -> Row:
    """Count the doors of one map, made as one of `SHOWN_BY` says."""
    assert scan.truth is not None
    truth = scan.truth
    began = process_time()
    map = extract(replace(scan.cloud, colors=None), walls=how != PLAN)
    row: Row = {"how": how, "sensor": case.sensor, "seconds": process_time() - began}
    verdict = evaluate_map(map, truth)
    row |= {"edges": [verdict.edges.precision, verdict.edges.recall], "iou": verdict.rooms.iou}
    state = make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty))).doors["state"]
    requested = find_between_visited(scan)
    edges = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    pairs = match_places(truth.doors[:, 2:], truth.transform_to_building(edges["centre"]))
    present = np.zeros(len(truth.doors), bool)
    present[pairs[:, 0]] = True
    for name in STATES:
        own = requested & (state == name)
        row[name] = [int((present & own).sum()), int(own.sum())]
    row["right"] = [verdict.doors.right, verdict.doors.extracted]
    predicted_shut = ~edges["open"] & ~find_looked_into(map, edges)
    predicted_half = edges["half"] & ~find_looked_into(map, edges)
    for name, predicted, true in (("said", predicted_shut, "shut"), ("said half", predicted_half, "half")):
        really = np.zeros(len(edges), bool)
        really[pairs[:, 1]] = state[pairs[:, 0]] == true
        row[name] = [int((predicted & really).sum()), int(predicted.sum())]
    return row


def find_between_visited(scan: Scan) -> Array:
    """Find the doors between two rooms that were visited: (D,) bool."""
    assert scan.truth is not None
    ends = scan.truth.doors[:, :2].astype(np.int64)
    requested: Array = ((ends >= 0) & np.append(scan.truth.visited, False)[ends]).all(axis=1)
    return requested


def find_looked_into(map: TopometricMap, edges: Array) -> Array:
    """Find the edges that lead to a room that was only looked into: (n,) bool."""
    into: Array = map.rooms["glimpsed"][edges["rooms"]].any(axis=1)
    return into


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate sums over all maps of a sensor, by what shows the doors."""
    lines = []
    for sensor in (*dict.fromkeys(r["sensor"] for r in rows), "all"):
        for how in SHOWN_BY:
            some = [r for r in rows if r["how"] == how and sensor in (r["sensor"], "all")]
            total = {name: np.sum([r[name] for r in some], axis=0).tolist() for name in (*STATES, *ANSWERS)}
            edges = np.nanmean([r["edges"] for r in some], axis=0)
            rest = [*edges, np.mean([r["iou"] for r in some]), np.mean([r["seconds"] for r in some])]
            count = sum(total[name][1] for name in STATES)
            shares = [write_share(total[name]) for name in (*STATES, *ANSWERS)]
            lines.append([sensor, how, count, *shares, *(f"{v:.2f}" for v in rest)])
    return {"doors": f"{len(rows) // len(SHOWN_BY)} maps.\n\n{write_table(DOOR_COLUMNS, lines)}"}
