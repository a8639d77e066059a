"""Walls against the truth: how far their faces are off, how much of the true walls is there, how much is none, doors in them.

``python evaluate.py task=walls`` scans simulated buildings of the validation list (``data=dev``: of the training list, to develop
on), makes maps of them and judges `topomerge.structure`.

True faces are the outlines of the true rooms that were visited, without doors, as far as a point of the scan lies within
`SEEN_REACH` of them at the height of faces. A face of a wall that was seen is compared with the true faces that look the
same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

from topomerge.evaluation.cases import dev
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.scans import Case, Scan, load_scan
from topomerge.evaluation.tasks import Row, TaskSettings, find_optional_data, limit_cases
from topomerge.extraction.extract import extract
from topomerge.structure.floors import FACE_HEIGHTS
from topomerge.types import Array, LogFn, TopometricMap

MAKERS = ("topomerge.extraction.extract", "topomerge.structure.plan_structure", "topomerge.evaluation.scans")
STEP = 0.05  # m between places on faces
SEEN_REACH = 0.05  # m between a true face and a point of the scan
PRESENT, NONE = 0.15, 0.2  # m: so near a true face is present; a face farther than that from all true ones is none
TURNED = 0.85  # cosine between faces that look the same way
NEAR_DOOR, DOOR_OFF, IN_WALL = 0.5, 0.3, 0.15  # m: a door that is judged; along and across its wall, to be right
LEVEL = 0.6  # m between floors of one storey
VALIDATION = 800_700  # first seed
KINDS: tuple[tuple[str, str], ...] = (
    ("office", "tls"),
    ("school", "lidar"),
    ("hospital", "depth"),
    ("hotel", "tls"),
    ("apartment", "tablet"),
    ("lab", "tls"),
)
KINDS += (("house", "depth"), ("openplan", "lidar"))
COLUMNS = {
    "off": "faces off, m",
    "off_90": "90 % of those with a true face within, m",
    "thickness": "thickness off, m",
    "present": "present",
    "none": "none",
    "double": "both sides seen",
    "openings": "openings right",
    "iou": "outlines IoU",
    "iou_floor": "IoU of floors",
}


def draw_cases(development: bool) -> list[Case]:
    """Draw buildings of the validation list, one of each kind; or those of `dev`."""
    if development:
        return [case for case in dev() if case.source == "procedural" and case.spoil != "sparse"]
    return [Case("walls", "procedural", kind, sensor, VALIDATION + i, rooms=10) for i, (kind, sensor) in enumerate(KINDS)]


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the scans."""
    return [case.key for case in limit_cases(draw_cases(settings.data.set == "dev"), settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure the walls of each scan."""
    rows = []
    for case in limit_cases(draw_cases(settings.data.set == "dev"), settings):
        scan = load_scan(case, Path(settings.cache) / "scans", find_optional_data())
        rows.append({"name": case.name, **score_walls(scan, extract(scan.cloud, voxel_size=0.1))})
        log_line(f"{case.name} {rows[-1]['walls']} walls")
    return rows


def score_walls(scan: Scan, map: TopometricMap) -> Row:
    """Measure the walls of one map."""
    from topomerge.structure.plan_structure import build_plan_structure

    assert scan.truth is not None
    began = process_time()
    structure = build_plan_structure(map)
    row: Row = {"seconds": process_time() - began, "walls": len(structure.walls)}
    parts = [measure_storey(scan, map, structure, level) for level in range(len(scan.truth.floors))]
    row |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return row


def measure_storey(scan: Scan, map: TopometricMap, structure: Any, level: int) -> dict[str, Array]:
    """Return what is measured of each place on our faces and on the true ones, and of each door."""
    truth = scan.truth
    assert truth is not None
    floor = float(truth.floors[level])
    own = structure.walls[[abs(find_height(scan, map, w) - floor) < LEVEL for w in structure.walls]]
    at, out, double = sample_own_faces(scan, own, floor)
    polygons = {i: r.polygon for i, r in enumerate(scan.rooms) if abs(r.floor - floor) < LEVEL}
    true_at, true_out, room = sample_true_faces(polygons)
    off = measure_distances(at, out, true_at, true_out)
    seen = truth.visited[room] & find_seen(scan, true_at, floor) & ~find_in_door(truth.doors, true_at, floor)
    back = measure_distances(true_at[seen], true_out[seen], at, out)
    shapes = [shapely.Polygon(polygons[i]) for i in polygons if truth.visited[i]]
    return {
        "off": off,
        "double": double,
        "back": back,
        "thickness": measure_thickness(scan, own, polygons, floor),
        "openings": check_openings(scan, map, structure, floor),
        **measure_overlaps(scan, map, structure, shapes, floor),
    }


def find_height(scan: Scan, map: TopometricMap, wall: Array) -> float:
    assert scan.truth is not None
    return float(scan.truth.transform_to_building(np.array([[*wall["start"], wall["low"]]]))[0, 2])


def place_points(scan: Scan, points: Array, z: float) -> Array:
    """Return (n, 2) points of the map in the frame of the building."""
    assert scan.truth is not None
    return scan.truth.transform_to_building(np.column_stack([points, np.full(len(points), z)]))[:, :2]


def sample_own_faces(scan: Scan, walls: Array, floor: float) -> tuple[Array, Array, Array]:
    """Return (n, 2) places on the faces of walls that were seen, which way leads into the wall, and was its other face seen."""
    places, outs, double = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, bool)]
    for wall in walls:
        along = wall["end"] - wall["start"]
        length = float(np.hypot(*along))
        if length < STEP:
            continue
        along = along / length
        left = np.array([-along[1], along[0]])
        on_line = wall["start"] + np.arange(STEP / 2, length, STEP)[:, None] * along
        for side in (0, 1) if wall["faces"] == 2 else (0,):
            into = -left if side == 0 else left
            on_face = on_line - into * wall["thickness"] / 2
            ends = place_points(scan, np.concatenate([on_face, on_face + 0.1 * into]), float(wall["low"]))
            places.append(ends[: len(on_face)])
            outs.append((ends[len(on_face) :] - ends[: len(on_face)]) / 0.1)
            double.append(np.full(len(on_face), wall["faces"] == 2))
    return np.concatenate(places), np.concatenate(outs), np.concatenate(double)


def sample_true_faces(polygons: dict[int, Array]) -> tuple[Array, Array, Array]:
    """Return (n, 2) places on the outlines of rooms, which way leads into the wall, and (n,) the room."""
    places, outs, rooms = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, int)]
    for i, polygon in polygons.items():
        ring = np.asarray(shapely.geometry.polygon.orient(shapely.Polygon(polygon)).exterior.coords)
        for a, b in pairwise(ring):
            length = float(np.hypot(*(b - a)))
            along = (b - a) / max(length, 1e-9)
            t = np.arange(STEP / 2, length, STEP)
            places.append(a + t[:, None] * along)
            outs.append(np.tile([along[1], -along[0]], (len(t), 1)))
            rooms.append(np.full(len(t), i))
    return np.concatenate(places), np.concatenate(outs), np.concatenate(rooms)


def measure_distances(at: Array, out: Array, others: Array, outs: Array) -> Array:
    """Return (n,) m across the face from each place to the nearest of others that look the same way; inf without any within 0.4
    m."""
    off = np.full(len(at), np.inf)
    if len(at) and len(others):
        far, rows = cKDTree(others).query(at, k=min(40, len(others)), distance_upper_bound=0.4)
        for k in range(far.shape[1]):
            ok = np.flatnonzero(np.isfinite(far[:, k]))
            r = rows[ok, k]
            same = (out[ok] * outs[r]).sum(axis=1) > TURNED
            near = np.abs((at[ok] - others[r])[:, 0] * outs[r, 1] - (at[ok] - others[r])[:, 1] * outs[r, 0]) < 0.1
            across = np.abs(((at[ok] - others[r]) * outs[r]).sum(axis=1))
            use = same & near
            off[ok[use]] = np.minimum(off[ok[use]], across[use])
    return off


def find_seen(scan: Scan, places: Array, floor: float) -> Array:
    truth = scan.truth
    assert truth is not None
    points = truth.transform_to_building(scan.cloud.points.astype(np.float64) + scan.cloud.shift)
    height = points[:, 2] - floor
    upright = points[(height > FACE_HEIGHTS[0]) & (height < FACE_HEIGHTS[1]), :2]
    if not len(upright):
        return np.zeros(len(places), bool)
    return np.asarray(cKDTree(upright).query(places, distance_upper_bound=SEEN_REACH)[0] < SEEN_REACH)


def find_in_door(doors: Array, places: Array, floor: float) -> Array:
    centres = doors[np.abs(doors[:, 4] - floor) < LEVEL, 2:4]
    return np.asarray(cKDTree(centres).query(places)[0] < NEAR_DOOR) if len(centres) else np.zeros(len(places), bool)


def measure_thickness(scan: Scan, walls: Array, polygons: dict[int, Array], floor: float) -> Array:
    """Return (n,) m by which walls seen from both sides are thicker or thinner than the gap between the true rooms at their
    middle."""
    union = shapely.union_all([shapely.Polygon(p) for p in polygons.values()])
    out = []
    for wall in walls[walls["faces"] == 2]:
        along = wall["end"] - wall["start"]
        across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        ends = place_points(scan, (wall["start"] + wall["end"]) / 2 + np.outer([-0.6, 0.0, 0.6], across), float(wall["low"]))
        gaps = [p for p in shapely.get_parts(shapely.LineString(ends[[0, 2]]).difference(union)) if p.length > 0.01]
        near = [p for p in gaps if p.distance(shapely.Point(ends[1])) < NONE]
        if near:
            out.append(abs(near[0].length - float(wall["thickness"])))
    return np.array(out)


def check_openings(scan: Scan, map: TopometricMap, structure: Any, floor: float) -> Array:
    """Return (n,) bool: of the doors of the map that are true ones, which are set into a wall at the right place."""
    truth = scan.truth
    assert truth is not None
    right = []
    for opening in structure.openings:
        edge = map.edges[opening["edge"]]
        true = truth.doors[np.abs(truth.doors[:, 4] - floor) < LEVEL, 2:4]
        placed = truth.transform_to_building(np.stack([edge["centre"], opening["centre"]]))
        if not len(true) or abs(placed[0, 2] - floor) > LEVEL:
            continue
        off = np.hypot(*(true - placed[0, :2]).T)
        if off.min() > NEAR_DOOR:
            continue
        apart = placed[1, :2] - true[off.argmin()]
        turn = np.array([np.cos(opening["direction"]), np.sin(opening["direction"])])
        normal = truth.matrix[:2, :2] @ turn
        across = abs(float(apart @ normal))
        along = float(np.sqrt(max(apart @ apart - across**2, 0.0)))
        right.append(opening["wall"] >= 0 and across <= IN_WALL and along <= DOOR_OFF)
    return np.array(right, bool)


def measure_overlaps(
    scan: Scan, map: TopometricMap, structure: Any, true: list[shapely.Polygon], floor: float
) -> dict[str, Array]:
    """Measure the (n,) IoU of each visited room with the outline, and with the floor, that overlaps it most."""
    from topomerge.structure.floors import build_floor_polygons

    out = {}
    for name, shapes in (("iou", structure.rooms), ("iou_floor", build_floor_polygons(map))):
        placed = []
        for r, shape in enumerate(shapes):
            z = float(map.rooms["centroid"][r, 2])
            moved = shapely.transform(shape, lambda p, z=z: place_points(scan, p, z))
            placed.append(shapely.make_valid(moved))
        out[name] = np.array([max((s.intersection(t).area / s.union(t).area for s in placed), default=0.0) for t in true])
    return out


def format_summary(row: Row) -> dict[str, float]:
    """Return the figures of a map, or of several whose places were put together."""
    finite = row["off"][np.isfinite(row["off"])]
    none = ~(row["off"] <= NONE)
    return {
        "off": float(np.median(np.minimum(row["off"], 1.0))),
        "off_90": float(np.quantile(finite, 0.9)),
        "thickness": float(np.median(row["thickness"])) if len(row["thickness"]) else float("nan"),
        "present": float((row["back"] <= PRESENT).mean()),
        "none": float(none.mean()),
        "double": float(row["double"].mean()),
        "openings": float(row["openings"].mean()) if len(row["openings"]) else float("nan"),
        "iou": float(row["iou"].mean()),
        "iou_floor": float(row["iou_floor"].mean()),
    }


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate the maps, and all of their places together."""
    places = [name for name in rows[0] if name not in ("name", "seconds", "walls")]
    whole = {name: np.concatenate([row[name] for row in rows]) for name in places}
    lines = [write_cells(row["name"], row["walls"], f"{row['seconds']:.1f}", format_summary(row)) for row in rows]
    lines.append(write_cells("all", sum(row["walls"] for row in rows), "", format_summary(whole)))
    return {"walls": write_table(("map", "walls", "s", *COLUMNS.values()), lines)}


def write_cells(name: str, walls: int, seconds: str, figures: dict[str, float]) -> list[str]:
    """Write the cells of a map."""
    digits = {"off": 3, "off_90": 3, "thickness": 3}
    return [
        name,
        str(walls),
        seconds,
        *(f"{figures[k]:.{digits.get(k, 2)}f}" if np.isfinite(figures[k]) else "–" for k in COLUMNS),
    ]
