"""Scans against drawn plans: is a scan laid right on the picture of its building's plan, whose scale nobody tells?

``python evaluate.py task=drawn_merges`` draws plans of the test list (``data=dev``: of the validation list) with texts and
furniture (`drawings`), reads them as `topomerge extract` does, scale included, and registers simulated scans with them, whole
and in part, at unknown scale. Each page is also compared with a scan of the next page's building, which must not be merged.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.core.building import Difficulty, find_physical_building
from topomerge.datasets.pairs.evaluation_pair import compute_anchor
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.walk import sample_part
from topomerge.evaluation.documents import write_mean, write_table
from topomerge.evaluation.drawings import Page, draw_page, list_pages
from topomerge.evaluation.merges import time_registration
from topomerge.evaluation.scans import find_plan
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data, measure_missing
from topomerge.extraction.extract import extract
from topomerge.io.drawing import trace_drawing
from topomerge.io.drawn_page import find_page
from topomerge.io.grid import read_paper, read_picture
from topomerge.io.points import read_points
from topomerge.matching.poses import wrap_yaw
from topomerge.metrics import is_pose_right
from topomerge.training.belief_hypotheses import RIGHT_POSE
from topomerge.types import LogFn, Sim3, TopometricMap

MAKERS = ("topomerge.io.drawing", "topomerge.io.drawn_page", "topomerge.extraction.extract", "topomerge.registration.pipeline")
SENSORS = ("tls", "depth", "lidar", "tablet")  # of the scans, in turn
PART, FEWEST_ROOMS = 0.6, 3  # of the rooms that every second scan visits
SOURCES = ("r2v", "campus")  # pages of real plans
SCALE_NEAR, SIZE_NEAR, SIZE_RIGHT = 0.03, 0.05, 0.1  # shares, of the scale that is read on a page, and of that of a pose


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """The map of a page, and the pose that takes places of the building's plan into it.

    Args:
        map: None where the page could not be read.
        resolution: m a pixel by what is drawn and written, and the true one.
    """

    map: TopometricMap | None
    frame: Sim3
    resolution: tuple[float, float]
    refused: str = ""


def list_drawn(settings: TaskSettings) -> list[Page]:
    """List the pages of the set, as they were drawn."""
    return [page for page in list_pages(settings) if not page.spoilt and page.shapes.name.startswith(SOURCES)]


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the pages."""
    return [page.name for page in list_drawn(settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure each page with a scan of its own building and one of another."""
    find_real_data()
    pages = list_drawn(settings)
    items = {page.name: (page, other, k) for k, (page, other) in enumerate(zip(pages, [*pages[1:], *pages[:1]], strict=True))}
    path = Path(settings.cache) / "evaluation" / f"drawn_merges-{settings.data.set or 'test'}.jsonl"
    return measure_missing(path, items, measure_page, log_line, settings)


def measure_page(page: Page, other: Page, number: int) -> Row:
    """Register scans of a page's building and of another one with the map of the page."""
    source, _, name = page.shapes.name.partition("/")
    row: Row = {"source": source, "place": find_physical_building(source, name), "whole": number % 2 == 0}
    drawn = read_drawn_map(page)
    if drawn.map is None:
        return row | {"refused": drawn.refused}
    row["scale_read"] = bool(abs(np.log(drawn.resolution[0] / drawn.resolution[1])) < SCALE_NEAR)
    scan, frame = simulate_scan(page, number)
    row["sensor"] = SENSORS[number % len(SENSORS)]
    outcome, registration = time_registration(scan, drawn.map, True)
    row |= outcome | judge_pose(registration.transform, frame @ drawn.frame.inverse(), scan, drawn.map)
    negative, found = time_registration(simulate_scan(other, number + 1)[0], drawn.map, True)
    return row | {"other": other.name, "other_believed": bool(found.accepted), "other_probability": negative["probability"]}


def read_drawn_map(page: Page) -> DrawnMap:
    """Draw a page and read it, its scale included."""
    drawing = draw_page(page)
    points = np.concatenate([room.polygon for room in page.shapes.rooms])
    low, true = points.min(axis=0) - 2.5, 1 / drawing.scale
    with tempfile.TemporaryDirectory() as folder, limit_threads():
        path = Path(folder) / "plan.png"
        Image.fromarray(drawing.picture).save(path)
        found = find_page(read_picture(path))
        try:
            if found is None or found.mended:
                return DrawnMap(None, Sim3(), (0.0, true), "taken for a photograph")
            traced = trace_drawing(path, found, None, paper=read_paper(path))
            resolution = traced.resolution * traced.drawing.zoom
            map = extract(read_points(path, resolution=resolution, text=False))
        except ValueError as error:
            return DrawnMap(None, Sim3(), (0.0, true), str(error).partition(": ")[2])
    size = resolution / true
    x, y = (-size * low).tolist()
    return DrawnMap(map, Sim3(0.0, (x, y, 0.0), size), (resolution, true))


def simulate_scan(page: Page, number: int) -> tuple[TopometricMap, Sim3]:
    """Simulate a scan of a page's building by one of the sensors; its map, and the pose of the building in it."""
    source, _, name = page.shapes.name.partition("/")
    building = build_building([find_plan(source, name, find_real_data())], Difficulty(), page.seed, name=name, kind=source)
    rng = np.random.default_rng([page.seed, number, 52])
    inside = np.array([i for i, r in enumerate(building.rooms) if r.kind != "lift"])
    parts = building.find_components()[inside]
    rooms = inside[parts == np.bincount(parts).argmax()]
    if number % 2:
        rooms = sample_part(building, max(FEWEST_ROOMS, round(PART * len(rooms))), rng)
    (frame,) = draw_frames(1, False, rng)
    cloud = scan_building(building, get_sensor(SENSORS[number % len(SENSORS)]), rooms, rng, frame=frame)
    with limit_threads():
        return extract(replace(cloud, rooms=())), frame


def judge_pose(pose: Sim3 | None, truth: Sim3, scan: TopometricMap, drawn: TopometricMap) -> Row:
    """Judge a pose of the drawn map in the scan: ``right`` within 0.5 m and 5 degrees in the middle of what both show, ``sized``
    within 5 %. Walls are not drawn as thick as they are built, so that sizes are off by some."""
    if pose is None:
        return {"right": False, "sized": False, "err": None}
    pair: Any = SimpleNamespace(truth=truth)
    middle = compute_anchor(pair, (scan, drawn))[None]
    off = (pose.apply(middle) - truth.apply(middle))[0]
    err = [float(np.hypot(*off[:2])), float(off[2]), float(np.degrees(abs(wrap_yaw(pose.yaw - truth.yaw))))]
    size = float(pose.scale / truth.scale)
    return {
        "right": bool(is_pose_right(err, True, RIGHT_POSE)),
        "sized": bool(abs(np.log(size)) < SIZE_NEAR),
        "err": err,
        "size": size,
    }


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate whole scans, scans of parts, and all."""
    read = []
    for row in rows:
        if "refused" not in row:
            right = row["right"] and abs(np.log(row["size"])) < SIZE_RIGHT
            read.append(row | {"right": right, "kept": right and row["believed"]})
    groups = {
        "whole scans": [row for row in read if row["whole"]],
        "parts": [row for row in read if not row["whole"]],
        "all": read,
    }
    lines: list[list[object]] = []
    for what, some in groups.items():
        shares = [write_mean(some, key) for key in ("right", "kept")]
        wrong = sum(row["believed"] and not row["right"] for row in some)
        counts = [sum(row[key] for row in some) for key in ("scale_read", "sized", "other_believed")]
        lines.append([what, len(some), counts[0], *shares, counts[1], wrong, counts[2]])
    head = ["scans", "pages", "scale read to 3 %", "right", "right and believed", "sized to 5 %", "believed and wrong"]
    head.append("another building's scan believed")
    refused = [f"{row['name']}: {row['refused']}" for row in rows if "refused" in row]
    worst = [
        f"{row['name']} ({row['sensor']}): {row['probability']:.2f}, {'right' if row['right'] else 'wrong'}"
        for row in read
        if not row["kept"]
    ]
    more = f"Not read: {len(refused)} of {len(rows)}" + "".join(f"\n- {line}" for line in refused)
    return {
        "drawn-merges": "\n\n".join(
            [write_table(head, lines), more, "Not right or not believed:", "\n".join(f"- {w}" for w in worst)]
        )
    }
