"""Niches and cupboards of maps against the true ones: which are there, of which nothing is, and how far off they are.

``python -m benchmarks.extraction.fixtures --write docs/results/topology.md`` scans buildings of the validation list by a laser
scanner, a depth camera and a walked laser, a quarter of the longer walls with a niche, and makes a map of each (``--dev``: of the
training list, to develop on). Scans are kept under ``cache/scans/``.

A true niche or cupboard of a visited room is there if the map has one of its kind whose middle lies within 0.3 m along the same
wall and that shares half of both their widths. Those of the map in rooms that were only looked into count nowhere, as in the
other tables. Cupboards are what stands before walls and is 0.75 m high or higher (`wall_truth.cupboards`).
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.wall_truth import CUPBOARDS, cupboards, niches_of

from benchmarks.extraction import doors
from benchmarks.extraction.cases import BUILDING_KINDS
from benchmarks.extraction.scans import Case, Scan, load
from benchmarks.extraction.tables import replace_section
from benchmarks.extraction.windows import normals, paired
from topomerge.extraction.extract import extract
from topomerge.types import FIXTURE_KINDS, Array, TopometricMap

FIXTURE_SENSORS = ("tls", "depth", "lidar")
FIXTURE_SEEDS, FIXTURE_TRAINING = 800_800, 5_800  # first seeds
NICHE_SHARE = 0.25  # of the longer walls with a niche
FIXTURE_SPACING = {"tls": 0.025, "depth": 0.025, "lidar": 0.0}  # m; 0: the sensor's
ALONG_WALL = 0.3  # m between the middles of two that are one
IN_FRONT = 0.1  # m before a niche or a cupboard: there its room is
TRUE_FIXTURE_DTYPE = np.dtype(
    [
        ("kind", "U8"),
        ("centre", "f8", 3),
        ("direction", "f8"),  # of a cupboard up to half a turn
        *((name, "f8") for name in ("width", "depth", "bottom", "top")),
        ("visited", "?"),  # was the surveyor in its room?
    ]
)
FIXTURE_ERRORS = ("off", "width", "depth", "bottom", "top")
FIXTURE_COLUMNS = ("kind", "sensor", "scans", "true", "precision", "recall", "off, m")
FIXTURE_COLUMNS += tuple(f"{name} off, m" for name in FIXTURE_ERRORS[1:])
Row = dict[str, Any]


def cases(development: bool) -> list[Case]:
    """Every kind of building by each sensor."""
    first = FIXTURE_TRAINING if development else FIXTURE_SEEDS
    hard = (("frames", doors.FRAMES), ("niches", NICHE_SHARE))
    made = [(kind, sensor) for sensor in FIXTURE_SENSORS for kind in BUILDING_KINDS]
    return [
        Case("fixtures", "procedural", k, s, first + i, rooms=8, difficulty=hard, spacing=FIXTURE_SPACING[s])
        for i, (k, s) in enumerate(made)
    ]


def true_fixtures(building: Building, scan: Scan) -> Array:
    """(T,) TRUE_FIXTURE_DTYPE, in the building's frame."""
    assert scan.truth is not None
    seen = [shapely.Polygon(r.polygon) for r, inside in zip(scan.rooms, scan.truth.visited, strict=True) if inside]
    rooms, rows = shapely.union_all(seen), []
    for niche, (*centre, direction, width, depth) in zip(building.niches, niches_of(building), strict=True):
        before = np.array(centre[:2]) - normals(np.array(direction)) * (depth / 2 + IN_FRONT)
        inside = bool(shapely.Point(before).within(rooms))
        rows.append(("niche", tuple(centre), direction, width, depth, float(niche["bottom"]), float(niche["top"]), inside))
    things = building.things[np.isin(building.things["kind"], CUPBOARDS)]
    heights = {tuple(t["centre"][:2].tolist()): float(t["size"][2]) for t in things}
    for *centre, direction, width, depth in cupboards(building):
        top = heights[tuple(centre[:2])]
        inside = bool(shapely.Point(centre[:2]).within(rooms))
        rows.append(("cupboard", tuple(centre), direction, width, depth, 0.0, top, inside))
    return np.array(rows, TRUE_FIXTURE_DTYPE)


def judged(case: Case, scan: Scan, map: TopometricMap) -> list[Row]:
    """Counts and errors of one map, of each kind."""
    assert scan.truth is not None
    true = true_fixtures(make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty))), scan)
    own = map.fixtures[~map.rooms["glimpsed"][map.fixtures["room"]]]
    turned = scan.truth.place(own["centre"] + np.column_stack([normals(own["direction"]), np.zeros(len(own))]))
    at = scan.truth.place(own["centre"])
    direction = np.arctan2(*(turned - at)[:, 1::-1].T)
    along = normals(true["direction"] + np.pi / 2)[:, None]
    off = np.abs(((at[None] - true["centre"][:, None])[..., :2] * along).sum(axis=-1))
    facing = (np.cos(direction[None] - true["direction"][:, None]) > 0) | (true["kind"] == "cupboard")[:, None]
    allowed = (true["kind"][:, None] == own["kind"]) & facing & (off < ALONG_WALL)
    places = np.column_stack([true["centre"], true["direction"], true["width"]])
    t, m = paired(places, at, direction, own["width"], allowed).T
    rows = []
    for kind in FIXTURE_KINDS:
        of, wanted = true["kind"][t] == kind, (true["kind"] == kind) & true["visited"]
        counts = {"right": np.array([int(of.sum()), int((own["kind"] == kind).sum())])}
        counts["there"] = np.array([int((of & true["visited"][t]).sum()), int(wanted.sum())])
        errors = {name: np.abs(own[name][m[of]] - true[name][t[of]]) for name in FIXTURE_ERRORS[1:]}
        rows.append({"kind": kind, "sensor": case.sensor, **counts, "off": off[t[of], m[of]], **errors})
    return rows


def table(rows: list[Row]) -> str:
    """Of each kind a line for each sensor, and for all: counts, then medians."""
    lines = [f"| {' | '.join(FIXTURE_COLUMNS)} |", "|" + "---|" * len(FIXTURE_COLUMNS)]
    for kind in FIXTURE_KINDS:
        for sensor in (*FIXTURE_SENSORS, "all"):
            some = [row for row in rows if row["kind"] == kind and sensor in (row["sensor"], "all")]
            right, there = (sum(row[name] for row in some) for name in ("right", "there"))
            errors = [np.concatenate([row[name] for row in some]) for name in FIXTURE_ERRORS]
            medians = [f"{np.nanmedian(e):.2f}" if np.isfinite(e).any() else "–" for e in errors]
            cells = [kind, sensor, str(len(some)), str(there[1]), doors.share(right), doors.share(there), *medians]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(words: list[str] | None = None) -> int:
    """See the text at the top."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.extraction.fixtures", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--write", type=Path, help="a document whose section between the marks `fixtures` is written anew")
    parser.add_argument("--dev", action="store_true", help="buildings of the training list")
    parser.add_argument("--scans", type=Path, default=Path("cache/scans"), help="where scans are kept")
    chosen = parser.parse_args(words)
    data = os.environ.get("TOPOMERGE_DATA")
    rows: list[Row] = []
    for case in cases(chosen.dev):
        scan = load(case, chosen.scans, Path(data) if data else None)
        rows += judged(case, scan, extract(scan.cloud))
        print(case.name, [row["right"].tolist() + row["there"].tolist() for row in rows[-2:]], file=sys.stderr, flush=True)
    text = f"{len(rows) // len(FIXTURE_KINDS)} maps.\n\n{table(rows)}"
    print(text)
    if chosen.write:
        command = f"`python -m benchmarks.extraction.fixtures --write {chosen.write}`"
        replace_section(chosen.write, f"{command}\n\n{text}", "fixtures")
    return 0


if __name__ == "__main__":
    sys.exit(main())
