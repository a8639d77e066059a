"""Buildings of the Open-RMF traffic editor (``*.building.yaml``): levels, walls, doors, floors and lifts.

Vertices are pixels of a drawing, y down; ``measurements`` give metres for pairs of them; ``fiducials`` of the same name tie the
levels together. Rooms are the faces of the walls and doors on the floors; a gap of `OPENING_WIDTHS` in a wall is an opening.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import yaml
from topomerge.datasets.core.building import Flight, Wall
from topomerge.datasets.plans.sketch import Sketch, build_opening, find_side_rooms, read_limited

from topomerge.errors import InputError
from topomerge.types import Array

RMF_WALL = 0.12  # m
LINE_SNAP = 0.12  # m; walls whose ends miss each other by less are joined
OPENING_WIDTHS = (0.5, 3.0)  # m
ASIDE = 0.15  # m, by which the two sides of a gap may miss each other
SHAFT = 0.8  # m, from the cabin of a lift through the shaft's wall
MIN_FACE = 0.8  # m2
BUSY = 5  # openings from which on a room is a corridor
RMF_STOREY, STOREYS = 3.6, (2.6, 6.0)  # m; elevations further apart are for show
CEILING = 2.8  # m
WAYPOINT_KINDS = {  # words in the names of waypoints
    "kitchen": "kitchen",
    "lobby": "lobby",
    "restaurant": "canteen",
    "corridor": "corridor",
    "waiting": "lobby",
    "counter": "nurses",
    "nurse": "nurses",
    "treatment": "ward",
    "pantry": "kitchen",
    "lounge": "lobby",
    "supplies": "storage",
    "shop": "storage",
}
USUAL = {"hotel": "hotel", "clinic": "ward", "office": "office"}  # kind of most rooms, by the building's name
RMF_BYTES = 20 << 20
DEEPEST = 50  # a plan has 6

Level = dict[str, Any]


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of every level, lowest first.

    Raises:
        InputError: no YAML, or not of this format.
    """
    text, loader = read_limited(path, RMF_BYTES, "building"), getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_depth(text, loader)
        site = yaml.load(text, loader)
    except yaml.YAMLError as error:
        raise InputError(f"damaged YAML: {' '.join(str(error).split())[:120]}") from error
    if not isinstance(site, dict) or not isinstance(site.get("levels"), dict) or not site["levels"]:
        raise InputError("not an RMF plan: no 'levels'")
    if site.get("coordinate_system", "reference_image") != "reference_image":
        raise InputError(f"wrong version: coordinate system {site['coordinate_system']!r}, not 'reference_image'")
    stem = path.name.removesuffix(".building.yaml")
    order = sorted(site["levels"], key=lambda name: float(site["levels"][name].get("elevation", 0)))
    for k, name in enumerate(order):
        yield f"{stem}/{name}", partial(build_sketch, site, order, k, stem)


def _check_depth(text: bytes, loader: Any) -> None:
    """Refuse too many lists within lists: the C loader calls itself for each, and ends the process."""
    depth = 0
    for event in yaml.parse(text, loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise InputError(f"damaged YAML: more than {DEEPEST} lists within each other")


def build_sketch(site: dict[str, Any], order: list[str], k: int, stem: str = "") -> Sketch:
    """Build level k of a building, in the frame of its lowest level.

    Raises:
        InputError: no scale; no walls; walls that enclose nothing.
    """
    level = site["levels"][order[k]]
    points = _compute_points(level, site, order)
    walls = _list_segments(level, "walls", points)
    if not len(walls):
        raise InputError("no walls: not a building")
    doors = _list_segments(level, "doors", points)
    shafts = [corners for _, corners in _list_lifts(site, order, k)]
    walls = np.concatenate([walls, *(np.stack([c, np.roll(c, -1, axis=0)], axis=1) for c in shafts)])
    gaps = _find_gaps(np.concatenate([walls, doors]), walls)
    faces = _build_faces(np.concatenate([walls, doors, gaps]), level, points, shafts)
    result = Sketch(inset=RMF_WALL / 2, height=_compute_height(site, order, k), ceiling=CEILING)
    for face in faces:
        result.add_room(f"room {len(result.shapes)}", "", face)
    result.walls = [Wall((a[0], a[1]), (b[0], b[1]), RMF_WALL) for a, b in walls.tolist()]
    for kind, segments, thickness in (
        ("door", doors, RMF_WALL + 0.1),
        ("opening", gaps, RMF_WALL + 0.1),
        ("door", _list_lift_doors(site, order, k), SHAFT),
    ):
        ends = find_side_rooms(segments[:, 0], segments[:, 1], faces, thickness / 2 + 0.3)
        for (start, end), (left, right) in zip(segments, ends.tolist(), strict=True):
            result.add_opening(build_opening(kind, start, end, thickness), (left, right))
    _assign_names(result, level, points, shafts, stem)
    upper = {name for name, _ in _list_lifts(site, order, k + 1)} if k + 1 < len(order) else set()
    result.flights = [_build_flight(corners) for name, corners in _list_lifts(site, order, k) if name in upper]
    return result


def _estimate_scale(level: Level) -> float:
    pixels = np.array([v[:2] for v in level.get("vertices", [])], float).reshape(-1, 2)
    ratios = []
    for start, end, values in level.get("measurements", []):
        length = float(np.hypot(*(pixels[start] - pixels[end])))
        ratios.append(float(values["distance"][1]) / length if length else np.nan)
    if not ratios or not np.isfinite(ratios).all() or min(ratios) <= 0:
        raise InputError("no scale: a level needs 'measurements' of some length")
    return float(np.median(ratios))


def _compute_placement(site: dict[str, Any], order: list[str], name: str) -> tuple[float, Array]:
    """Return the metres per pixel and the shift, m, that bring a level's pixels into the frame of the lowest level, by the common
    fiducials."""
    level, first = site["levels"][name], site["levels"][order[0]]
    scale = _estimate_scale(level)
    marks = [{f[2]: np.array(f[:2], float) * (1, -1) for f in each.get("fiducials", [])} for each in (level, first)]
    common = sorted(set(marks[0]) & set(marks[1]), key=str)
    if name == order[0] or not common:
        return scale, np.zeros(2)
    return scale, np.mean([marks[1][c] * _estimate_scale(first) - marks[0][c] * scale for c in common], axis=0)


def _compute_points(level: Level, site: dict[str, Any], order: list[str]) -> Array:
    """Return (n, 2) vertices, m, y up."""
    name = next(name for name in order if site["levels"][name] is level)
    scale, shift = _compute_placement(site, order, name)
    pixels = np.array([v[:2] for v in level.get("vertices", [])], float).reshape(-1, 2)
    return np.asarray(pixels * (scale, -scale) + shift)


def _list_segments(level: Level, key: str, points: Array) -> Array:
    pairs = np.array([entry[:2] for entry in level.get(key) or []], np.int64).reshape(-1, 2)
    if pairs.size and not 0 <= pairs.min() <= pairs.max() < len(points):
        raise InputError(f"bad line: {key} name a vertex that is not there")
    segments = points[pairs]
    return segments[np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > 0.01]


def _list_lifts(site: dict[str, Any], order: list[str], k: int) -> list[tuple[str, Array]]:
    """List the name and cabin's corners (4, 2), m, of the lifts that stop at level k; the door is in front of the last two
    corners."""
    out = []
    for name, lift in sorted((site.get("lifts") or {}).items()):
        if order[k] in lift.get("level_doors", {}):
            half = np.array([lift["width"], lift["depth"]], float) / 2
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
            out.append((name, _transform_from_cabin(site, order, lift, corners)))
    return out


def _transform_from_cabin(site: dict[str, Any], order: list[str], lift: dict[str, Any], points: Array) -> Array:
    scale, shift = _compute_placement(site, order, lift.get("reference_floor_name", order[0]))
    c, s = np.cos(lift["yaw"]), np.sin(lift["yaw"])
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.array([lift["x"], -lift["y"]]) * scale + shift)


def _list_lift_doors(site: dict[str, Any], order: list[str], k: int) -> Array:
    """Return (n, 2, 2) doors of the lifts at level k."""
    out = []
    for _, lift in sorted((site.get("lifts") or {}).items()):
        for name in lift.get("level_doors", {}).get(order[k], []):
            door = lift["doors"][name]
            turn, half = float(door.get("motion_axis_orientation", 0)), float(door["width"]) / 2
            along = np.array([np.cos(turn), np.sin(turn)]) * half
            at = np.array([door["x"], np.sign(door["y"]) * lift["depth"] / 2])  # on the cabin's side, not on the shaft's
            out.append(_transform_from_cabin(site, order, lift, np.stack([at - along, at + along])))
    return np.array(out).reshape(-1, 2, 2)


def _find_gaps(lines: Array, walls: Array) -> Array:
    """Return (n, 2, 2) openings without doors: where a wall's loose end looks along the wall at other lines, `OPENING_WIDTHS`
    away."""
    every = shapely.linestrings(lines)
    tree = shapely.STRtree(every)
    gaps: list[Array] = []
    for i, (start, end) in enumerate(walls):
        along = (end - start) / np.hypot(*(end - start))
        for tip, way in ((end, along), (start, -along)):
            touching = tree.query(shapely.Point(tip), predicate="dwithin", distance=LINE_SNAP)
            if any(j != i for j in touching.tolist()):
                continue
            ahead = shapely.LineString([tip + way * 0.02, tip + way * OPENING_WIDTHS[1]]).buffer(ASIDE, cap_style="flat")
            hits = shapely.intersection(every[[j for j in tree.query(ahead, predicate="intersects") if j != i]], ahead)
            lines_to = [np.asarray(shapely.shortest_line(shapely.Point(tip), hit).coords) for hit in hits]
            nearest = min(lines_to, key=lambda line: float(np.hypot(*(line[1] - line[0]))), default=None)
            if nearest is not None and OPENING_WIDTHS[0] <= np.hypot(*(nearest[1] - nearest[0])) <= OPENING_WIDTHS[1]:
                gaps.append(nearest)
    middles = [f.mean(axis=0) for f in gaps]
    first = [i for i in range(len(gaps)) if all(np.hypot(*(middles[i] - middles[j])) > LINE_SNAP for j in range(i))]
    return np.array([gaps[i] for i in first]).reshape(-1, 2, 2)


def _build_faces(lines: Array, level: Level, points: Array, shafts: list[Array]) -> list[shapely.Polygon]:
    """Build the faces of the lines that lie on the level's floors or are cabins of lifts."""
    along = lines[:, 1] - lines[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True) * LINE_SNAP
    longer = np.stack([lines[:, 0] - along, lines[:, 1] + along], axis=1)
    noded = shapely.node(shapely.multilinestrings(shapely.linestrings(longer)))
    faces = [f for f in shapely.get_parts(shapely.polygonize([noded])) if not f.buffer(-0.3).is_empty and f.area > MIN_FACE]
    corners = [points[floor["vertices"]] for floor in level.get("floors") or []]
    floor = shapely.union_all([shapely.make_valid(shapely.Polygon(c)) for c in corners if len(c) > 2])
    if not floor.is_empty:
        floor = shapely.union_all([floor, *(shapely.Polygon(c) for c in shafts)])
        faces = [f for f in faces if f.intersection(floor).area > 0.5 * f.area]
    if not faces:
        raise InputError("not closed: the walls enclose no room")
    return faces


def _compute_height(site: dict[str, Any], order: list[str], k: int) -> float:
    if k + 1 == len(order):
        return RMF_STOREY
    here, above = (float(site["levels"][order[i]].get("elevation", 0)) for i in (k, k + 1))
    return above - here if STOREYS[0] <= above - here <= STOREYS[1] else RMF_STOREY


def _assign_names(result: Sketch, level: Level, points: Array, shafts: list[Array], stem: str) -> None:
    """Assign names from the waypoints in each room, and kinds from words in them, from the lifts, and from the number of
    doors."""
    tree = shapely.STRtree(result.shapes)
    for vertex, point in zip(level.get("vertices", []), points, strict=True):
        if len(vertex) > 3 and vertex[3]:
            for i in tree.query(shapely.Point(point), predicate="within"):
                result.names[i] = str(vertex[3])
    openings = np.bincount(np.array([e for ends in result.ends for e in ends if e >= 0], int), minlength=len(result.shapes))
    for i, shape in enumerate(result.shapes):
        word = next((w for w in WAYPOINT_KINDS if w in result.names[i].lower()), "")
        usual = "corridor" if openings[i] >= BUSY else USUAL.get(stem, "")
        lift = any(shape.contains(shapely.Point(corners.mean(axis=0))) and shape.area < 20 for corners in shafts)
        result.kinds[i] = "lift" if lift else WAYPOINT_KINDS.get(word, usual)


def _build_flight(corners: Array) -> Flight:
    """Return a lift's cabin."""
    ahead = corners[3] - corners[0]
    size = np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(ahead)
    heading = float(np.arctan2(ahead[1], ahead[0]))
    return Flight("lift", (float(corners[0][0]), float(corners[0][1])), heading, float(size[0]), float(size[1]))
