"""The classic segmentations of grids into rooms beside ours: ``python -m benchmarks.peers.rooms [SETS]`` (``peers``).

They get what a robot would draw of a scan: its storeys from above. They have neither doors nor storeys to be judged by.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy import ndimage
from topomerge.datasets.simulation.floor_truth import (
    LEAST_SEEN_AREA,
    NOT_JUDGED,
    TRUTH_CELL,
    FloorScores,
    FloorTruth,
    evaluate_map,
    predict_storey_columns,
)

from benchmarks.peers.segmentations import METHODS
from topomerge.evaluation.cases import select_cases
from topomerge.evaluation.documents import compute_mean, write_mean, write_table
from topomerge.evaluation.rooms import measure_case
from topomerge.evaluation.scans import Case, Scan, load_scan
from topomerge.evaluation.tasks import find_optional_data
from topomerge.metrics import count_contingency
from topomerge.types import Array

PEER_COLUMNS = {
    "iou": "IoU", "mcc": "MCC", "precision": "P", "recall": "R", "survey_precision": "survey P", "survey_recall": "survey R",
}  # fmt: skip
CELL = 0.05  # m: the maps of the survey
# m above the floor, in which points are obstacles: above furniture, chosen on three training scans; lower of what ends below.
WALL_HEIGHTS, LOW_HEIGHTS = (1.7, 2.6), (0.3, 1.9)
REACHED = 95.0  # percentile of the heights of points that must be as high
CLOSED_GAPS = 0.1  # m: gaps between points, of floor and ceiling and of walls, that are closed
OBSTACLE_SPECK, FREE_ISLAND = 0.05, 1.0  # m2: smaller obstacles, and smaller pieces of free space, are left out
NEAR_FLOOR = 0.3  # m below the floor and above the ceiling that belong to a storey


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """A storey from above, in the scan's own frame.

    Args:
        free: (h, w) bool.
        seen: (h, w) bool, free or occupied.
        origin: (2,) m, corner of the first cell.
        floor: m, in the scan's frame.
    """

    free: Array
    seen: Array
    origin: Array
    floor: float

    def compute_centres(self, cells: Array) -> Array:
        """Return (n, 3) m, of the marked cells."""
        rows, columns = np.nonzero(cells)
        x, y = self.origin[0] + (columns + 0.5) * CELL, self.origin[1] + (rows + 0.5) * CELL
        return np.column_stack([x, y, np.full(len(x), self.floor)])


def build_floor_grids(scan: Scan) -> list[FloorGrid | None]:
    """Return the grid of each true storey, by its true floor and ceiling; None where the scan has nothing of it.

    A cell is occupied where points lie in the band, else free where others do: floor, ceiling, lamps or a lintel.
    """
    truth = scan.truth
    assert truth is not None
    points = scan.cloud.points.astype(np.float64) + scan.cloud.shift
    height = truth.transform_to_building(points)[:, 2]
    scale = float(truth.matrix[2, 2])
    out: list[FloorGrid | None] = []
    for floor, room_height in zip(truth.floors.tolist(), truth.height.tolist(), strict=True):
        above = height - floor
        level = (above > -NEAR_FLOOR) & (above < room_height + NEAR_FLOOR)
        if not level.any():
            out.append(None)
            continue
        origin = points[level, :2].min(axis=0) - 2.5 * CELL  # points of a robot's grid are in the middle of their cells
        columns, rows = np.floor((points[level, :2] - origin) / CELL).astype(np.int64).T
        shape = (int(rows.max()) + 3, int(columns.max()) + 3)
        heights = WALL_HEIGHTS if np.percentile(above[level], REACHED) > WALL_HEIGHTS[0] else LOW_HEIGHTS
        within = (above[level] > heights[0]) & (above[level] < min(heights[1], room_height - NEAR_FLOOR))
        occupied, seen = np.zeros(shape, bool), np.zeros(shape, bool)
        occupied[rows[within], columns[within]] = True
        seen[rows, columns] = True
        occupied, seen = _remove_pieces(_close_gaps(occupied), OBSTACLE_SPECK), _close_gaps(seen)
        own_floor = (floor - float(truth.matrix[2, 3])) / scale  # in the scan's frame
        out.append(FloorGrid(_remove_pieces(seen & ~occupied, FREE_ISLAND), seen, origin, own_floor))
    return out


def _close_gaps(mask: Array) -> Array:
    """Return the mask with gaps closed."""
    reach = round(CLOSED_GAPS / CELL / 2)
    size = 2 * reach + 1
    return mask | ndimage.binary_closing(np.pad(mask, size), np.ones((size, size)))[size:-size, size:-size]


def _remove_pieces(mask: Array, least: float) -> Array:
    """Remove connected pieces of less than an area (m2)."""
    pieces, _ = ndimage.label(mask, np.ones((3, 3)))
    large = np.bincount(pieces.ravel()) * CELL**2 >= least
    large[0] = False
    return large[pieces]


def segment_scan(scan: Scan, method: str, grids: list[FloorGrid | None]) -> tuple[Array, int]:
    """Return the room of each column of the truth's raster by a classic method, -1 none, and how many rooms there are.

    Words are spread as those of our maps are (`floor_truth.predict_columns`): furniture has the room that is the nearest.
    """
    truth = scan.truth
    assert truth is not None
    out, total = np.full(truth.raster.shape, -1, np.int32), 0
    for k, grid in enumerate(grids):
        if grid is None:
            continue
        labels = METHODS[method](grid.free, CELL)
        if not (labels >= 0).any():
            continue
        nearest = ndimage.distance_transform_edt(labels < 0, return_distances=False, return_indices=True)
        filled = np.where(grid.seen, labels[tuple(nearest)], -1)
        stood, over = (_rasterise_labels(truth, grid, cells) for cells in (labels, filled))
        words = predict_storey_columns(truth, k, stood, over)
        out[k] = np.where(words >= 0, words + total, -1)
        total += int(labels.max()) + 1
    return out, total


def _rasterise_labels(truth: FloorTruth, grid: FloorGrid, labels: Array) -> Array:
    """Return (rows, columns) int32 labels of cells on the raster of the truth, -1 none."""
    cells = labels >= 0
    ij, inside = truth.compute_columns(truth.transform_to_building(grid.compute_centres(cells)))
    out = np.full(truth.raster.shape[1:], -1, np.int32)
    out[ij[inside, 0], ij[inside, 1]] = labels[cells][inside]
    return out


def score_map(truth: FloorTruth, columns: Array, count: int) -> FloorScores:
    """Compute the scores of rooms alone. Rooms that lie mostly in true ones that were not visited are not held against the
    method."""
    foreign = (truth.raster >= 0) & ~np.append(truth.visited, False)[truth.raster] & (columns >= 0)
    every = (truth.raster != NOT_JUDGED) & (columns >= 0)
    glimpsed = 2 * np.bincount(columns[foreign], minlength=count) > np.bincount(columns[every], minlength=count)
    edges = np.zeros(0, [("rooms", "<i4", 2), ("kind", "<U8"), ("centre", "<f8", 3)])
    rooms = np.zeros(count, [("glimpsed", bool), ("outside", float)])
    rooms["glimpsed"] = glimpsed
    storeys = np.zeros(0, [("floor", "<f8")])
    return evaluate_map(SimpleNamespace(rooms=rooms, edges=edges, storeys=storeys), truth, columns)


def compute_survey_scores(truth: FloorTruth, columns: Array) -> tuple[float, float]:
    """Compute precision and recall as the survey has them, by area: the mean over the rooms of a map of the largest share of one
    that lies in one true room, and the mean over the true rooms of the largest share of one that lies in one room of the map.
    Cutting a room costs recall alone, and uniting two costs precision alone. Only what is of visited rooms counts.
    """
    visited = (truth.raster >= 0) & np.append(truth.visited, False)[truth.raster]
    count = int(columns.max()) + 1
    both = count_contingency(truth.raster[visited], columns[visited], len(truth.visited), count)
    area = np.bincount(truth.raster[visited], minlength=len(truth.visited))
    expected, of_map = area * TRUTH_CELL**2 >= LEAST_SEEN_AREA, both.sum(axis=0)
    if not count or not expected.any():
        return float("nan"), 0.0
    real = of_map * TRUTH_CELL**2 >= LEAST_SEEN_AREA
    precision = float((both.max(axis=0)[real] / of_map[real]).mean()) if real.any() else float("nan")
    return precision, float((both.max(axis=1)[expected] / area[expected]).mean())


def measure_method(case: Case, method: str, scans: Path) -> dict[str, Any]:
    """Segment the grids of a case by a classic method; ours is `measure_case`."""
    if method == "ours":
        return {**measure_case(case, "default", scans, find_optional_data(), ""), "method": method}
    scan = load_scan(case, scans, find_optional_data())
    assert scan.truth is not None
    began = process_time()
    columns, count = segment_scan(scan, method, build_floor_grids(scan))
    row: dict[str, Any] = {"set": case.set, "place": case.place, "method": method, "seconds": process_time() - began}
    rooms = score_map(scan.truth, columns, count).rooms
    row |= {"iou": rooms.iou, "mcc": rooms.mcc, "precision": rooms.precision, "recall": rooms.recall}
    row["survey_precision"], row["survey_recall"] = compute_survey_scores(scan.truth, columns)
    return row


def tabulate_methods(rows: Sequence[dict[str, Any]]) -> str:
    """Tabulate a line a set and method, the same maps for each."""
    lines = []
    for group, method in dict.fromkeys((r["set"], r["method"]) for r in rows):
        these = [r for r in rows if (r["set"], r["method"]) == (group, method)]
        cells = [write_mean(these, k) if k in ("iou", "mcc") else compute_mean(these, k) for k in (*PEER_COLUMNS, "seconds")]
        lines.append([group, len(these), method, *cells])
    return write_table(("set", "maps", "method", *PEER_COLUMNS.values(), "s"), lines)


def main(*sets: str) -> None:
    """Measure and print."""
    rows = []
    for case in select_cases(sets or ("peers",)):
        rows += [measure_method(case, method, Path("cache/scans")) for method in ("ours", *METHODS)]
        print(case.name, *(f"{r['method']} {r.get('iou', float('nan')):.2f}" for r in rows[-len(METHODS) - 1 :]), flush=True)
    print(tabulate_methods(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
