"""Doors by how they stand: which are there, and of which nothing is, with walls looked at and without.

``python -m benchmarks.extraction.doors --write docs/results/topology.md`` scans buildings of the validation list by a laser
scanner and a depth camera at 2.5 cm (``--dev``: of the training list, to develop on), most doors with frames, and makes a
map of each with and without `extraction.elevations`. With ``--painted`` no door has a frame, and maps are made with the
colours or intensities of the scan and without. Scans are kept under ``cache/scans/``.

A true door between two visited rooms is there if the map has one within 0.5 m. One that the map calls shut is right where a shut
door is. Doors of the map that lead to rooms that were only looked into count nowhere, as in the other tables.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.simulation.floor_truth import judge

from benchmarks.extraction.cases import BUILDING_KINDS
from benchmarks.extraction.scans import Case, Scan, load
from benchmarks.extraction.tables import replace_section
from topomerge.extraction.extract import extract
from topomerge.metrics import match_places
from topomerge.types import Array, TopometricMap

DOOR_SEEDS, PAINTED_SEEDS, TRAINING = 800_720, 800_760, 5_700  # first seeds
FRAMES = 0.7  # share of the doors with frames and handles
STATES, SAID = ("open", "half", "shut"), ("right", "said", "said half")
SHOWN_BY = PLAN, WALLS, COLOURS = "plan", "plan and walls", "plan, walls and colours"

DOOR_COLUMNS = ("sensor", "doors by", "true doors", *STATES)
DOOR_COLUMNS += ("precision", "called shut: right", "called half open: right", "edges P", "edges R", "rooms IoU", "s")
Row = dict[str, Any]


def cases(development: bool, painted: bool = False) -> list[Case]:
    """Every kind of building by both sensors; painted: by a laser scanner with colours or intensities, and by a depth camera."""
    if painted:
        first = TRAINING + 40 if development else PAINTED_SEEDS
        shades = [(kind, *s) for s in (("tls", "colour"), ("tls", "intensity"), ("depth", "colour")) for kind in BUILDING_KINDS]
        return [
            Case("painted", "procedural", k, s, first + i, rooms=8, difficulty=(("frames", 0.0),), spacing=0.025, shades=shade)
            for i, (k, s, shade) in enumerate(shades)
        ]
    first = TRAINING if development else DOOR_SEEDS
    made = [(kind, sensor) for sensor in ("tls", "depth") for kind in BUILDING_KINDS]
    return [
        Case("doors", "procedural", kind, sensor, first + i, rooms=8, difficulty=(("frames", FRAMES),), spacing=0.025)
        for i, (kind, sensor) in enumerate(made)
    ]


def judged(case: Case, scan: Scan, how: str) -> Row:
    """Counts of one map, made as one of `SHOWN_BY` says."""
    assert scan.truth is not None
    truth = scan.truth
    began = process_time()
    map = extract(scan.cloud if how == COLOURS else replace(scan.cloud, colors=None), walls=how != PLAN)
    sensor = f"{case.sensor}, {case.shades}" if case.shades else case.sensor
    row: Row = {"how": how, "sensor": sensor, "seconds": process_time() - began}
    verdict = judge(map, truth)
    row |= {"edges": np.array([verdict.edges.precision, verdict.edges.recall]), "iou": verdict.rooms.iou}
    state = make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty))).doors["state"]
    wanted = _wanted(scan)
    edges = map.edges[np.isin(map.edges["kind"], ("door", "opening"))]
    pairs = match_places(truth.doors[:, 2:], truth.place(edges["centre"]))
    there = np.zeros(len(truth.doors), bool)
    there[pairs[:, 0]] = True
    for name in STATES:
        own = wanted & (state == name)
        row[name] = np.array([int((there & own).sum()), int(own.sum())])
    row["right"] = np.array([verdict.doors.right, verdict.doors.extracted])
    said_shut = ~edges["open"] & ~_looked_into(map, edges)
    said_half = edges["half"] & ~_looked_into(map, edges)
    for name, said, true in (("said", said_shut, "shut"), ("said half", said_half, "half")):
        really = np.zeros(len(edges), bool)
        really[pairs[:, 1]] = state[pairs[:, 0]] == true
        row[name] = np.array([int((said & really).sum()), int(said.sum())])
    return row


def _wanted(scan: Scan) -> Array:
    """(D,) bool: between two rooms that were visited."""
    assert scan.truth is not None
    ends = scan.truth.doors[:, :2].astype(np.int64)
    wanted: Array = ((ends >= 0) & np.append(scan.truth.visited, False)[ends]).all(axis=1)
    return wanted


def _looked_into(map: TopometricMap, edges: Array) -> Array:
    into: Array = map.rooms["glimpsed"][edges["rooms"]].any(axis=1)
    return into


def table(rows: list[Row]) -> str:
    """Sums over all maps of a sensor, by what shows the doors."""
    lines = [f"| {' | '.join(DOOR_COLUMNS)} |", "|" + "---|" * len(DOOR_COLUMNS)]
    for sensor in (*dict.fromkeys(r["sensor"] for r in rows), "all"):
        for how in SHOWN_BY:
            some = [r for r in rows if r["how"] == how and sensor in (r["sensor"], "all")]
            if not some:
                continue
            total = {name: sum(r[name] for r in some) for name in (*STATES, *SAID)}
            count = sum(int(total[name][1]) for name in STATES)
            shares = [share(total[name]) for name in (*STATES, *SAID)]
            edges = np.nanmean([r["edges"] for r in some], axis=0)
            rest = [*edges, np.mean([r["iou"] for r in some]), np.mean([r["seconds"] for r in some])]
            lines.append(f"| {sensor} | {how} | {count} | {' | '.join(shares)} | {' | '.join(f'{v:.2f}' for v in rest)} |")
    return "\n".join(lines)


def share(counts: Iterable[int]) -> str:
    """Right ones of all, in words."""
    right, every = counts
    return f"{right / every:.2f} ({right} of {every})" if every else "none"


def main(words: list[str] | None = None) -> int:
    """See the text at the top."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.extraction.doors", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", type=Path, help="a document whose section between the marks `doors` is written anew")
    parser.add_argument("--painted", action="store_true", help="with colours and without; the marks are `colours`")
    parser.add_argument("--dev", action="store_true", help="buildings of the training list")
    parser.add_argument("--scans", type=Path, default=Path("cache/scans"), help="where scans are kept")
    chosen = parser.parse_args(words)
    data = os.environ.get("TOPOMERGE_DATA")
    rows = []
    for case in cases(chosen.dev, chosen.painted):
        scan = load(case, chosen.scans, Path(data) if data else None)
        rows += [judged(case, scan, how) for how in ((WALLS, COLOURS) if chosen.painted else (PLAN, WALLS))]
        print(case.name, {k: v for k, v in rows[-1].items() if k not in ("how", "sensor")}, file=sys.stderr, flush=True)
    text = table(rows)
    print(text)
    if chosen.write:
        painted = "--painted " * chosen.painted
        command = f"`python -m benchmarks.extraction.doors {painted}--write {chosen.write}`"
        section = "colours" if chosen.painted else "doors"
        replace_section(chosen.write, f"{command}\n\n{len(rows) // 2} maps.\n\n{text}", section)
    return 0


if __name__ == "__main__":
    sys.exit(main())
