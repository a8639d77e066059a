"""Windows of maps against the true ones: which are there, of which nothing is, and how far off they are.

``python -m benchmarks.extraction.windows --write docs/results/topology.md`` scans buildings of the validation list with five
sensors and makes a map of each: those of the benchmark of doors by a laser scanner and a depth camera, others by a walked laser,
a tablet and a camera. It also judges the class `window` by places, on the cached walls of scans that trained nothing, where
``cache/walls`` has them (`python train.py task=wall_segmentation` makes them). Scans are kept under ``cache/scans/``.

A true window of a visited room is there if the map has one that shares half of both their widths, along the same wall. Windows of
the map in rooms that were only looked into count nowhere, as in the other tables.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.panes import glazed
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.wall_examples import load_walls

from benchmarks.extraction import doors
from benchmarks.extraction.cases import BUILDING_KINDS
from benchmarks.extraction.scans import Case, Scan, load
from benchmarks.extraction.tables import replace_section
from topomerge.extraction.elevations.doorways import place_classes
from topomerge.extraction.elevations.stretches import STRETCH_CHANCE
from topomerge.extraction.elevations.wall_network import PLACES
from topomerge.extraction.elevations.windows import WINDOW
from topomerge.extraction.extract import extract
from topomerge.types import Array, TopometricMap

OTHER_SENSORS = ("lidar", "tablet", "mono")
WINDOW_SEEDS, WINDOW_TRAINING = 800_740, 5_740  # first seeds
OF_ROOM = 0.6  # m between a window and its room
LEAST_IOU, ACROSS_WALL, ONE_LEVEL = 0.5, 0.6, 0.75  # of two windows that are one: along, across (m) and in height (m)
WINDOW_COLUMNS = (
    "sensor",
    "scans",
    "true windows",
    "precision",
    "recall",
    "off, m",
    "width off, m",
    "sill off, m",
    "head off, m",
)
Row = dict[str, Any]


def cases(development: bool) -> list[Case]:
    """Every kind of building by each sensor."""
    first = WINDOW_TRAINING if development else WINDOW_SEEDS
    made = [(kind, sensor) for sensor in OTHER_SENSORS for kind in BUILDING_KINDS]
    others = [Case("windows", "procedural", kind, sensor, first + i, rooms=8) for i, (kind, sensor) in enumerate(made)]
    return doors.cases(development) + others


def judged(case: Case, scan: Scan, map: TopometricMap) -> Row:
    """Counts and errors of one map."""
    assert scan.truth is not None
    building = make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty)))
    true = np.array(glazed(building), float).reshape(-1, 7)
    own = map.windows[~map.rooms["glimpsed"][map.windows["rooms"][:, 0]]]
    turned = scan.truth.place(own["centre"] + np.column_stack([normals(own["direction"]), np.zeros(len(own))]))
    at = scan.truth.place(own["centre"])
    direction = np.arctan2(*(turned - at)[:, 1::-1].T)
    pairs = paired(true, at, direction, own["width"])
    wanted = _of_visited(scan, true)
    there = np.isin(np.arange(len(true)), pairs[:, 0])
    t, m = true[pairs[:, 0]], own[pairs[:, 1]]
    errors = {"off": np.linalg.norm((at[pairs[:, 1]] - t[:, :3])[:, :2], axis=1), "width": np.abs(m["width"] - t[:, 4])}
    errors |= {"sill": np.abs(m["sill"] - t[:, 5]), "head": np.abs(m["head"] - t[:, 6])}
    counts = {"right": np.array([len(pairs), len(own)]), "there": np.array([int((there & wanted).sum()), int(wanted.sum())])}
    return {"sensor": case.sensor, **counts, **errors}


def normals(direction: Array) -> Array:
    """(n, 2) unit."""
    return np.stack([np.cos(direction), np.sin(direction)], axis=-1)


def paired(true: Array, at: Array, direction: Array, width: Array, allowed: Array | None = None) -> Array:
    """(k, 2) true windows, or fixtures, and those of the map that are one, each once, the best first.

    Args:
        true: (T, 5+) centre (m), direction (rad) and width (m) of each.
        at: (n, 3) m, direction (n,) rad and width (n,) m of those of the map.
        allowed: (T, n) bool, which may be one at all; None: all.
    """
    apart = at[None] - true[:, None, :3]
    normal = normals(true[:, 3])[:, None]
    across = np.abs((apart[..., :2] * normal).sum(axis=-1))
    place = np.abs(apart[..., 0] * normal[..., 1] - apart[..., 1] * normal[..., 0])
    wide = true[:, 4, None]
    shared = np.minimum((wide + width) / 2 - place, np.minimum(wide, width))
    iou = shared / (wide + width - shared)
    fits = (across < ACROSS_WALL) & (np.abs(apart[..., 2]) < ONE_LEVEL) & (iou >= LEAST_IOU)
    fits &= np.abs(np.cos(direction[None] - true[:, 3, None])) > np.cos(np.radians(15))
    fits &= True if allowed is None else allowed
    pairs: list[tuple[int, int]] = []
    for i, j in np.column_stack(np.unravel_index(np.argsort(-iou, axis=None, kind="stable"), iou.shape)).tolist():
        if fits[i, j] and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return np.array(pairs, int).reshape(-1, 2)


def _of_visited(scan: Scan, true: Array) -> Array:
    """(W,) bool: in a wall of a room that was visited."""
    assert scan.truth is not None
    rooms = [shapely.Polygon(r.polygon) for r, seen in zip(scan.rooms, scan.truth.visited, strict=True) if seen]
    return np.asarray(shapely.distance(shapely.points(true[:, :2]), shapely.union_all(rooms)) < OF_ROOM)


def table(rows: list[Row]) -> str:
    """A line for each sensor, and for all: counts, then medians."""
    lines = [f"| {' | '.join(WINDOW_COLUMNS)} |", "|" + "---|" * len(WINDOW_COLUMNS)]
    for sensor in (*dict.fromkeys(row["sensor"] for row in rows), "all"):
        some = [row for row in rows if sensor in (row["sensor"], "all")]
        right, there = (sum(row[name] for row in some) for name in ("right", "there"))
        errors = [np.concatenate([row[name] for row in some]) for name in ("off", "width", "sill", "head")]
        medians = [f"{np.nanmedian(e):.2f}" if np.isfinite(e).any() else "–" for e in errors]
        cells = [sensor, str(len(some)), str(there[1]), doors.share(right), doors.share(there), *medians]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def places(listing: Path, folder: Path) -> str:
    """The class `window` of each place along the cached walls, by sensor."""
    counts: dict[str, list[Array]] = {}
    for line in listing.read_text(encoding="utf-8").splitlines():
        example = load_walls(folder / json.loads(line)["file"])
        walls = example.elevations
        seen = walls.strips.reshape(len(walls.strips) // PLACES, -1).any(axis=1)
        said, true = place_classes(walls)[seen, WINDOW] > STRETCH_CHANCE, example.truth[::PLACES][seen] == WINDOW
        row = np.array([(said & true).sum(), said.sum(), true.sum(), len(true), 1])
        for sensor in (example.source.partition("/")[0], "all"):
            counts.setdefault(sensor, []).append(row)
    lines = ["| sensor | scans | places | of windows | precision | recall |", "|---|---|---|---|---|---|"]
    for sensor, each in sorted(counts.items(), key=lambda item: (item[0] == "all", item[0])):
        right, said, true, every, scans = np.sum(each, axis=0).tolist()
        lines.append(f"| {sensor} | {scans} | {every:,} | {true:,} | {right / max(said, 1):.2f} | {right / max(true, 1):.2f} |")
    return "\n".join(lines)


def main(words: list[str] | None = None) -> int:
    """See the text at the top."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.extraction.windows", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--write", type=Path, help="a document whose section between the marks `windows` is written anew")
    parser.add_argument("--dev", action="store_true", help="buildings of the training list")
    parser.add_argument("--scans", type=Path, default=Path("cache/scans"), help="where scans are kept")
    parser.add_argument("--walls", type=Path, default=Path("cache/walls"), help="where walls of scans are cached")
    chosen = parser.parse_args(words)
    data = os.environ.get("TOPOMERGE_DATA")
    rows = []
    for case in cases(chosen.dev):
        scan = load(case, chosen.scans, Path(data) if data else None)
        rows.append(judged(case, scan, extract(scan.cloud)))
        print(case.name, {k: v.tolist() for k, v in rows[-1].items() if k in ("right", "there")}, file=sys.stderr, flush=True)
    text = f"{len(rows)} maps.\n\n{table(rows)}"
    listing = chosen.walls.parent / "wall_scans_heldout.jsonl"
    if listing.exists():
        text += f"\n\nThe class `window` by places of 10 cm, on scans that trained nothing:\n\n{places(listing, chosen.walls)}"
    print(text)
    if chosen.write:
        command = f"`python -m benchmarks.extraction.windows --write {chosen.write}`"
        replace_section(chosen.write, f"{command}\n\n{text}", "windows")
    return 0


if __name__ == "__main__":
    sys.exit(main())
