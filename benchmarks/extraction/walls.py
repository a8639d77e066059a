"""Walls against the truth: how far their faces are off, how much of the true walls is there, how much is none, doors in them.

``python -m benchmarks.extraction.walls --write docs/results/topology.md`` scans simulated buildings of the validation list
(``--dev``: of the training list, to develop on), makes maps of them and judges `topomerge.structure`. Scans are kept under
``cache/scans/``.

True faces are the outlines of the true rooms that were visited, without doors, as far as a point of the scan lies within
`SEEN_REACH` of them at the height of faces. A face of a wall that was seen is compared with the true faces that look the
same way.
"""

from __future__ import annotations

import argparse
import os
import sys
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

from benchmarks.extraction.cases import dev
from benchmarks.extraction.scans import Case, Scan, load
from benchmarks.extraction.tables import replace_section
from topomerge.structure.face_points import FACE_HEIGHTS
from topomerge.types import Array, TopometricMap

STEP = 0.05  # m between places on faces
SEEN_REACH = 0.05  # m between a true face and a point of the scan
PRESENT, NONE = 0.15, 0.2  # m: so near a true face is present; a face farther than that from all true ones is none
TURNED = 0.85  # cosine between faces that look the same way
NEAR_DOOR, DOOR_OFF, IN_WALL = 0.5, 0.3, 0.15  # m: a door that is judged; along and across its wall, to be right
LEVEL = 0.6  # m between floors of one storey
VALIDATION = 800_700  # first seed
KINDS = (("office", "tls"), ("school", "lidar"), ("hospital", "depth"), ("hotel", "tls"), ("apartment", "tablet"), ("lab", "tls"))
KINDS += (("house", "depth"), ("openplan", "lidar"))
MARK = "walls"
Row = dict[str, Any]
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


def cases(development: bool) -> list[Case]:
    """Buildings of the validation list, one of each kind; or those of `dev`."""
    if development:
        return [case for case in dev() if case.source == "procedural" and case.spoil != "sparse"]
    return [Case("walls", "procedural", kind, sensor, VALIDATION + i, rooms=10) for i, (kind, sensor) in enumerate(KINDS)]


def judged(scan: Scan, map: TopometricMap) -> Row:
    """The measures of one map."""
    from topomerge.structure.plan_structure import plan_structure

    assert scan.truth is not None
    began = process_time()
    structure = plan_structure(map)
    row: Row = {"seconds": process_time() - began, "walls": len(structure.walls)}
    parts = [_storey(scan, map, structure, level) for level in range(len(scan.truth.floors))]
    row |= {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return row


def _storey(scan: Scan, map: TopometricMap, structure: Any, level: int) -> dict[str, Array]:
    """Of each place on our faces and on the true ones, and of each door, what is measured."""
    truth = scan.truth
    assert truth is not None
    floor = float(truth.floors[level])
    own = structure.walls[[abs(_height(scan, map, w) - floor) < LEVEL for w in structure.walls]]
    at, out, double = _own_places(scan, own, floor)
    polygons = {i: r.polygon for i, r in enumerate(scan.rooms) if abs(r.floor - floor) < LEVEL}
    true_at, true_out, room = _true_places(polygons)
    off = _off(at, out, true_at, true_out)
    seen = truth.visited[room] & _seen(scan, true_at, floor) & ~_in_door(truth.doors, true_at, floor)
    back = _off(true_at[seen], true_out[seen], at, out)
    shapes = [shapely.Polygon(polygons[i]) for i in polygons if truth.visited[i]]
    return {
        "off": off,
        "double": double,
        "back": back,
        "thickness": _thickness_off(scan, own, polygons, floor),
        "openings": _openings(scan, map, structure, floor),
        **_overlaps(scan, map, structure, shapes, floor),
    }


def _height(scan: Scan, map: TopometricMap, wall: Array) -> float:
    assert scan.truth is not None
    return float(scan.truth.place(np.array([[*wall["start"], wall["low"]]]))[0, 2])


def _placed(scan: Scan, points: Array, z: float) -> Array:
    """(n, 2) points of the map in the frame of the building."""
    assert scan.truth is not None
    return scan.truth.place(np.column_stack([points, np.full(len(points), z)]))[:, :2]


def _own_places(scan: Scan, walls: Array, floor: float) -> tuple[Array, Array, Array]:
    """(n, 2) places on the faces of walls that were seen, which way leads into the wall, and was its other face seen."""
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
            ends = _placed(scan, np.concatenate([on_face, on_face + 0.1 * into]), float(wall["low"]))
            places.append(ends[: len(on_face)])
            outs.append((ends[len(on_face) :] - ends[: len(on_face)]) / 0.1)
            double.append(np.full(len(on_face), wall["faces"] == 2))
    return np.concatenate(places), np.concatenate(outs), np.concatenate(double)


def _true_places(polygons: dict[int, Array]) -> tuple[Array, Array, Array]:
    """(n, 2) places on the outlines of rooms, which way leads into the wall, and (n,) the room."""
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


def _off(at: Array, out: Array, others: Array, outs: Array) -> Array:
    """(n,) m across the face from each place to the nearest of others that look the same way; inf without any within 0.4 m."""
    off = np.full(len(at), np.inf)
    if len(at) and len(others):
        far, rows = cKDTree(others).query(at, k=min(40, len(others)), distance_upper_bound=0.4)
        for k in range(far.shape[1]):
            ok = np.flatnonzero(np.isfinite(far[:, k]))
            r = rows[ok, k]
            same = (out[ok] * outs[r]).sum(axis=1) > TURNED
            beside = np.abs((at[ok] - others[r])[:, 0] * outs[r, 1] - (at[ok] - others[r])[:, 1] * outs[r, 0]) < 0.1
            across = np.abs(((at[ok] - others[r]) * outs[r]).sum(axis=1))
            use = same & beside
            off[ok[use]] = np.minimum(off[ok[use]], across[use])
    return off


def _seen(scan: Scan, places: Array, floor: float) -> Array:
    truth = scan.truth
    assert truth is not None
    points = truth.place(scan.cloud.points.astype(np.float64) + scan.cloud.shift)
    height = points[:, 2] - floor
    upright = points[(height > FACE_HEIGHTS[0]) & (height < FACE_HEIGHTS[1]), :2]
    if not len(upright):
        return np.zeros(len(places), bool)
    return np.asarray(cKDTree(upright).query(places, distance_upper_bound=SEEN_REACH)[0] < SEEN_REACH)


def _in_door(doors: Array, places: Array, floor: float) -> Array:
    centres = doors[np.abs(doors[:, 4] - floor) < LEVEL, 2:4]
    return np.asarray(cKDTree(centres).query(places)[0] < NEAR_DOOR) if len(centres) else np.zeros(len(places), bool)


def _thickness_off(scan: Scan, walls: Array, polygons: dict[int, Array], floor: float) -> Array:
    """(n,) m by which walls seen from both sides are thicker or thinner than the gap between the true rooms at their middle."""
    union = shapely.union_all([shapely.Polygon(p) for p in polygons.values()])
    out = []
    for wall in walls[walls["faces"] == 2]:
        along = wall["end"] - wall["start"]
        across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        ends = _placed(scan, (wall["start"] + wall["end"]) / 2 + np.outer([-0.6, 0.0, 0.6], across), float(wall["low"]))
        gaps = [p for p in shapely.get_parts(shapely.LineString(ends[[0, 2]]).difference(union)) if p.length > 0.01]
        near = [p for p in gaps if p.distance(shapely.Point(ends[1])) < NONE]
        if near:
            out.append(abs(near[0].length - float(wall["thickness"])))
    return np.array(out)


def _openings(scan: Scan, map: TopometricMap, structure: Any, floor: float) -> Array:
    """(n,) bool: of the doors of the map that are true ones, which are set into a wall at the right place."""
    truth = scan.truth
    assert truth is not None
    right = []
    for opening in structure.openings:
        edge = map.edges[opening["edge"]]
        true = truth.doors[np.abs(truth.doors[:, 4] - floor) < LEVEL, 2:4]
        placed = truth.place(np.stack([edge["centre"], opening["centre"]]))
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


def _overlaps(scan: Scan, map: TopometricMap, structure: Any, true: list[shapely.Polygon], floor: float) -> dict[str, Array]:
    """(n,) IoU of each visited room with the outline, and with the floor, that overlaps it most."""
    from topomerge.structure.floors import floor_polygons

    out = {}
    for name, shapes in (("iou", structure.rooms), ("iou_floor", floor_polygons(map))):
        placed = []
        for r, shape in enumerate(shapes):
            z = float(map.rooms["centroid"][r, 2])
            moved = shapely.transform(shape, lambda p, z=z: _placed(scan, p, z))
            placed.append(shapely.make_valid(moved))
        out[name] = np.array([max((s.intersection(t).area / s.union(t).area for s in placed), default=0.0) for t in true])
    return out


def summary(row: Row) -> dict[str, float]:
    """The figures of a map, or of several whose places were put together."""
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


def report(rows: dict[str, Row], command: str) -> str:
    """The table of the maps, and of all of their places together."""
    whole = {
        name: np.concatenate([row[name] for row in rows.values()]) for name in next(iter(rows.values())) if name not in ALONE
    }
    lines = [f"`{command}`", "", "| map | walls | s | " + " | ".join(COLUMNS.values()) + " |", "|" + "---|" * (3 + len(COLUMNS))]
    for name, row in rows.items():
        lines.append(_line(name, row["walls"], f"{row['seconds']:.1f}", summary(row)))
    lines.append(_line("all", sum(row["walls"] for row in rows.values()), "", summary(whole)))
    return "\n".join(lines)


ALONE = ("seconds", "walls")


def _line(name: str, walls: int, seconds: str, figures: dict[str, float]) -> str:
    digits = {"off": 3, "off_90": 3, "thickness": 3}
    cells = [f"{figures[k]:.{digits.get(k, 2)}f}" if np.isfinite(figures[k]) else "–" for k in COLUMNS]
    return "| " + " | ".join([name, str(walls), seconds, *cells]) + " |"


def main(words: list[str] | None = None) -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dev", action="store_true", help="buildings of the training list")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--scans", type=Path, default=Path("cache/scans"))
    parser.add_argument("--write", type=Path, help="file whose section between the marks of the walls is replaced")
    settings = parser.parse_args(words)
    data = Path(os.environ["TOPOMERGE_DATA"]) if os.environ.get("TOPOMERGE_DATA") else None
    rows = {}
    for case in cases(settings.dev):
        if settings.only in case.name:
            rows[case.name] = measured(case, settings.scans, data)
            print(case.name, {k: round(v, 3) for k, v in summary(rows[case.name]).items()}, file=sys.stderr, flush=True)
    command = " ".join(["python -m benchmarks.extraction.walls", *(words if words is not None else sys.argv[1:])])
    print(report(rows, command))
    if settings.write:
        replace_section(settings.write, report(rows, command), MARK)
    return 0


def measured(case: Case, scans: Path, data: Path | None) -> Row:
    """A case from its scan to its figures."""
    from topomerge.extraction.extract import extract

    scan = load(case, scans, data)
    return judged(scan, extract(scan.cloud, voxel_size=case.voxel))


if __name__ == "__main__":
    sys.exit(main())
