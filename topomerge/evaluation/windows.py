"""Windows of maps against the true ones: which are there, of which nothing is, and how far off they are.

``python evaluate.py task=windows`` scans buildings of the validation list (``data=dev``: of the training list) with five sensors
and makes a map of each: those of `doors` by a laser scanner and a depth camera, others by a walked laser, a tablet and a camera.

A true window of a visited room is there if the map has one that shares half of both their widths, along the same wall. Windows of
the map in rooms that were only looked into count nowhere, as in the other tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.buildings.openings import find_windows
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Difficulty
from topomerge.evaluation import doors
from topomerge.evaluation.cases import BUILDING_KINDS
from topomerge.evaluation.documents import write_medians, write_share, write_table
from topomerge.evaluation.scans import Case, Scan, load_scan
from topomerge.evaluation.tasks import Row, TaskSettings, find_optional_data, limit_cases, measure_missing
from topomerge.extraction.extract import extract
from topomerge.types import Array, LogFn, TopometricMap

MAKERS = doors.MAKERS
ERRORS = ("off", "width", "sill", "head")
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


def draw_cases(development: bool) -> list[Case]:
    """Draw every kind of building by each sensor."""
    first = WINDOW_TRAINING if development else WINDOW_SEEDS
    cases = [(kind, sensor) for sensor in OTHER_SENSORS for kind in BUILDING_KINDS]
    others = [Case("windows", "procedural", kind, sensor, first + i, rooms=8) for i, (kind, sensor) in enumerate(cases)]
    return doors.draw_cases(development) + others


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the scans."""
    return [case.key for case in limit_cases(draw_cases(settings.data.set == "dev"), settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure the windows of each scan."""
    scans, data = Path(settings.cache) / "scans", find_optional_data()
    items = {case.key: (case, scans, data) for case in limit_cases(draw_cases(settings.data.set == "dev"), settings)}
    path = Path(settings.cache) / "evaluation" / "windows.jsonl"
    return measure_missing(path, items, measure_case, log_line, settings, compute_code_digest(*MAKERS, __name__))


def measure_case(case: Case, scans: Path, data: Path | None) -> Row:
    """Load a scan and score the windows of its map."""
    scan = load_scan(case, scans, data)
    return score_windows(case, scan, extract(scan.cloud))


def score_windows(case: Case, scan: Scan, map: TopometricMap) -> Row:
    """Count the windows of one map and measure their errors."""
    assert scan.truth is not None
    building = make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty)))
    true = np.array(find_windows(building), float).reshape(-1, 7)
    own = map.windows[~map.rooms["glimpsed"][map.windows["rooms"][:, 0]]]
    turned = scan.truth.transform_to_building(
        own["centre"] + np.column_stack([compute_normals(own["direction"]), np.zeros(len(own))])
    )
    at = scan.truth.transform_to_building(own["centre"])
    direction = np.arctan2(*(turned - at)[:, 1::-1].T)
    pairs = pair_windows(true, at, direction, own["width"])
    requested = find_in_visited(scan, true)
    present = np.isin(np.arange(len(true)), pairs[:, 0])
    t, m = true[pairs[:, 0]], own[pairs[:, 1]]
    errors = {"off": np.linalg.norm((at[pairs[:, 1]] - t[:, :3])[:, :2], axis=1), "width": np.abs(m["width"] - t[:, 4])}
    errors |= {"sill": np.abs(m["sill"] - t[:, 5]), "head": np.abs(m["head"] - t[:, 6])}
    counts = {"right": [len(pairs), len(own)], "there": [int((present & requested).sum()), int(requested.sum())]}
    return {"sensor": case.sensor, **counts, **{name: values.tolist() for name, values in errors.items()}}


def compute_normals(direction: Array) -> Array:
    """Compute the unit vectors (n, 2) of directions."""
    return np.stack([np.cos(direction), np.sin(direction)], axis=-1)


def pair_windows(true: Array, at: Array, direction: Array, width: Array) -> Array:
    """Pair true windows with those of the map that are one (k, 2), each once, the best first.

    Args:
        true: (T, 5+) centre (m), direction (rad) and width (m) of each.
        at: (n, 3) m, direction (n,) rad and width (n,) m of those of the map.
    """
    apart = at[None] - true[:, None, :3]
    normal = compute_normals(true[:, 3])[:, None]
    across = np.abs((apart[..., :2] * normal).sum(axis=-1))
    place = np.abs(apart[..., 0] * normal[..., 1] - apart[..., 1] * normal[..., 0])
    wide = true[:, 4, None]
    shared = np.minimum((wide + width) / 2 - place, np.minimum(wide, width))
    iou = shared / (wide + width - shared)
    fits = (across < ACROSS_WALL) & (np.abs(apart[..., 2]) < ONE_LEVEL) & (iou >= LEAST_IOU)
    fits &= np.abs(np.cos(direction[None] - true[:, 3, None])) > np.cos(np.radians(15))
    pairs: list[tuple[int, int]] = []
    for i, j in np.column_stack(np.unravel_index(np.argsort(-iou, axis=None, kind="stable"), iou.shape)).tolist():
        if fits[i, j] and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return np.array(pairs, int).reshape(-1, 2)


def find_in_visited(scan: Scan, true: Array) -> Array:
    """Find the windows in a wall of a room that was visited: (W,) bool."""
    assert scan.truth is not None
    rooms = [shapely.Polygon(r.polygon) for r, seen in zip(scan.rooms, scan.truth.visited, strict=True) if seen]
    return np.asarray(shapely.distance(shapely.points(true[:, :2]), shapely.union_all(rooms)) < OF_ROOM)


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate a line for each sensor, and for all: counts, then medians."""
    lines = []
    for sensor in (*dict.fromkeys(row["sensor"] for row in rows), "all"):
        some = [row for row in rows if sensor in (row["sensor"], "all")]
        right, present = (np.sum([row[name] for row in some], axis=0).tolist() for name in ("right", "there"))
        medians = write_medians(np.concatenate([row[name] for row in some]) for name in ERRORS)
        lines.append([sensor, len(some), present[1], write_share(right), write_share(present), *medians])
    return {"windows": f"{len(rows)} maps.\n\n{write_table(WINDOW_COLUMNS, lines)}"}
