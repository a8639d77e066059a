"""Schools and offices of Luperto et al. (generativeCMLgraphs): one XML file a storey.

Every ``space`` has a label, a ``bounding_polygon`` in pixels, y down, and portals that name the two spaces they join. Portals
have no length: doors get a usual width where the two outlines face each other. ``scale`` gives centimetres for some pixels,
measured on one small door: it is compared with usual sizes of the labelled rooms, and replaced where it can't be right.
Outlines run along the walls' faces or centre lines, as each draughtsman liked: all are set in by `CAMPUS_INSET`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import shapely
import shapely.affinity
from topomerge.datasets.plans.sketch import Sketch, find_overlaps, place_door, read_limited

from topomerge.errors import InputError
from topomerge.types import Array

CAMPUS_KINDS = {  # words in labels, the first that fits: our word and a usual area, m2 (0: differs too much)
    "CLASSROOM": ("classroom", 60),
    "CORRIDOR": ("corridor", 0),
    "CLOSET": ("storage", 6),
    "CONFERENCE HALL": ("hall", 0),
    "CONFERENCE ROOM": ("meeting", 35),
    "CONFERENCE": ("hall", 0),
    "SHARED OFFICE": ("office", 35),
    "EXECUTIVE OFFICE": ("office", 30),
    "OFFICE": ("office", 18),
    "SERVICE": ("storage", 0),
    "WASHROOM": ("toilets", 18),
    "BATHROOM": ("toilets", 6),
    "STAIRS": ("stairs", 18),
    "ELEVATOR": ("lift", 5),
    "ENTRANCE": ("lobby", 0),
    "LOBBY": ("lobby", 0),
    "HALL": ("hall", 0),
    "GYM": ("hall", 400),
    "LAB": ("lab", 70),
    "KITCHEN": ("kitchen", 20),
    "CANTEEN": ("canteen", 0),
    "CAFETERIA": ("canteen", 0),
    "OPENSPACE": ("openplan", 0),
    "CUBICULE": ("office", 9),
    "LIBRARY": ("library", 0),
    "RECEPTION": ("lobby", 0),
    "STORE": ("storage", 0),
}
SINGLE_DOOR, DOUBLE_DOOR, CAMPUS_PASSAGE = 0.9, 1.6, 2.5  # m, widths of single and double doors and of openings without one
CAMPUS_INSET = 0.075  # m
PORTAL_REACH = 0.9  # m, how far apart the outlines of two rooms with a door may be
ASTRAY = 2.0  # m, how far a door may be from where the portal is drawn
SAME_PORTAL = 1.2  # m; two marks of a portal between the same rooms, one drawn from each side, are one door
TRUSTED, HOPELESS = 1.6, 3.0  # factors between the scale of the file and that of usual rooms
PARTLY, WITHIN = 0.25, 0.95  # share of a room in another one up to which, or from which on, the other one gives way
CAMPUS_BYTES = 20 << 20


class _NoDoctype(ElementTree.TreeBuilder):
    """Entities can only be declared in a DOCTYPE, so none is taken."""

    def doctype(self, *_: str | None) -> None:
        """Refuse a DOCTYPE; called by the parser."""
        raise InputError("not read: XML with a DOCTYPE")


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of the one storey of a file."""
    yield path.stem.removesuffix("_updated"), partial(parse_sketch, read_limited(path, CAMPUS_BYTES))


def parse_sketch(text: bytes) -> Sketch:
    """Return one storey.

    Raises:
        InputError: no XML, or with a DOCTYPE; not of this format; no scale or a hopeless one; outlines that cross themselves.
    """
    try:
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=_NoDoctype()))
    except ElementTree.ParseError as error:
        raise InputError(f"damaged XML: {error}") from error
    spaces = root.findall("floor/spaces/space")
    if root.tag != "building" or not spaces:
        raise InputError("not a campus plan: expected building/floor/spaces/space")
    result = Sketch(inset=CAMPUS_INSET, height=3.6, ceiling=3.0)
    shapes = {space.get("id", ""): _parse_shape(space, result) for space in spaces}
    scale = _estimate_scale(root, spaces, shapes, result)
    indices: dict[str, int] = {}
    for space in spaces:
        key = space.get("id", "")
        if (shape := shapes[key]) is not None:
            kind, label = _parse_kind(space)[0], (space.findtext("labels/label") or "room").lower()
            larger = shapely.affinity.scale(shape, scale, scale, origin=(0, 0))
            indices[key] = result.add_room(f"{label} {len(indices)}", kind, larger)
    _tidy(result, indices, {s.get("id", ""): not s.findtext("labels/label") for s in spaces})
    _add_doors(result, spaces, indices, scale)
    return result


def _parse_kind(space: ElementTree.Element) -> tuple[str, float]:
    label = space.findtext("labels/label") or ""
    return next((entry for word, entry in CAMPUS_KINDS.items() if word in label), ("office" if label else "", 0))


def _parse_points(element: ElementTree.Element, path: str) -> Array:
    corners = [(float(p.get("x", "nan")), -float(p.get("y", "nan"))) for p in element.findall(path)]  # y up
    return np.array(corners, float).reshape(-1, 2)


def _parse_shape(space: ElementTree.Element, result: Sketch) -> shapely.Polygon | None:
    """Return the outline in pixels; None for helpers without one."""
    points = _parse_points(space, "bounding_polygon/point")
    label = space.findtext("labels/label")
    if len(np.unique(points, axis=0)) < 3 or not np.isfinite(points).all():
        if label:
            raise InputError(f"not closed: the outline of {label.lower()} has {len(points)} points")
        return None
    shape = shapely.Polygon(points)
    if shape.is_valid and shape.area > 0:
        return shape
    parts = [p for p in shapely.get_parts(shapely.make_valid(shape)) if p.geom_type == "Polygon"]
    best = max(parts, key=lambda p: p.area, default=shapely.Polygon())
    if best.area < 0.9 * sum(p.area for p in parts) or best.is_empty:
        if label:
            raise InputError(f"crosses itself: the outline of a {label.lower()}")
        return None
    result.notes.append("mended an outline that crosses itself")
    return best


def _estimate_scale(
    root: ElementTree.Element, spaces: list[ElementTree.Element], shapes: dict[str, shapely.Polygon | None], result: Sketch
) -> float:
    """Return the metres per pixel: that of the file, or that of usual rooms where they are more than `TRUSTED` apart."""
    real, drawn = (float(root.findtext(f"scale/{w}_distance/value") or "nan") for w in ("real", "represented"))
    if not (real > 0 and drawn > 0):
        raise InputError("no scale: scale/real_distance and scale/represented_distance must be above 0")
    stated = real / drawn / 100
    ratios = []
    for space in spaces:
        shape, usual = shapes[space.get("id", "")], _parse_kind(space)[1]
        if shape is not None and usual:
            ratios.append(usual / (shape.area * stated**2))
    factor = float(np.sqrt(np.median(ratios))) if ratios else 1.0
    if not 1 / HOPELESS < factor < HOPELESS:
        raise InputError(f"absurd scale: rooms are {1 / factor:.2f} times as long as usual")
    if 1 / TRUSTED < factor < TRUSTED or len(ratios) < 3:
        return stated
    result.notes.append(f"scale made {factor:.2f} times that of the file, after usual rooms")
    return stated * factor


def _tidy(result: Sketch, indices: dict[str, int], helper: dict[str, bool]) -> None:
    """Drop unlabelled helpers that overlap a labelled room; of two rooms that overlap a little, cut the larger one."""
    keys = {i: key for key, i in indices.items()}
    for i, j, share in find_overlaps(result.shapes):
        small, large = sorted((i, j), key=lambda k: result.shapes[k].area)
        if result.shapes[small].is_empty or result.shapes[large].is_empty:
            continue
        if helper[keys[i]] != helper[keys[j]]:
            gone = i if helper[keys[i]] else j
            result.shapes[gone] = shapely.Polygon()
            result.notes.append("left out a helper space that overlaps a room")
        elif share < PARTLY or share > WITHIN:  # between the two, no one knows who is right
            rest = shapely.get_parts(result.shapes[large].difference(result.shapes[small]))
            result.shapes[large] = max(rest, key=lambda p: p.area)
            result.notes.append("cut a room out of a larger one that overlaps it")
    empty = [i for i, shape in enumerate(result.shapes) if shape.is_empty]
    order = {i: k for k, i in enumerate(i for i in range(len(result.shapes)) if i not in empty)}
    for name in ("names", "kinds", "shapes"):
        values = getattr(result, name)
        setattr(result, name, [values[i] for i in order])
    for key in [key for key, i in indices.items() if i in empty]:
        del indices[key]
    indices.update({key: order[i] for key, i in indices.items()})


def _add_doors(result: Sketch, spaces: list[ElementTree.Element], indices: dict[str, int], scale: float) -> None:
    """Add one door for each portal; marks of the same door from both sides count once."""
    marks: dict[tuple[int, int], list[tuple[Array, str, float]]] = {}
    for space in spaces:
        lines = {line.get("id"): _parse_points(line, "point") for line in space.findall("space_representation/linesegment")}
        for portal in space.findall("portals/portal"):
            ends = [indices.get(target.text or "", -1) for target in portal.findall("target/id")]
            line = lines.get(portal.findtext("linesegment"), np.empty((0, 2)))
            if len(ends) == 2 and min(ends) >= 0 and ends[0] != ends[1] and len(line):
                pair = (min(ends), max(ends))
                marks.setdefault(pair, []).append((line.mean(axis=0) * scale, *_parse_door_type(portal)))
    lost = 0
    for (a, b), portals in marks.items():
        for point, kind, width in _remove_duplicates(portals):
            opening = place_door(result.shapes[a], result.shapes[b], width, PORTAL_REACH, point, kind)
            if opening is None or np.hypot(*(np.add(opening.start, opening.end) / 2 - point)) > ASTRAY:
                lost += 1
                continue
            result.add_opening(opening, (a, b))
    if lost:
        result.notes.append(f"left out {lost} doors between rooms that do not face each other there")


def _parse_door_type(portal: ElementTree.Element) -> tuple[str, float]:
    if portal.findtext("type") == "IMPLICIT":
        return "opening", CAMPUS_PASSAGE
    return "door", DOUBLE_DOOR if portal.findtext("features") == "DOUBLE" else SINGLE_DOOR


def _remove_duplicates(marks: list[tuple[Array, str, float]]) -> list[tuple[Array, str, float]]:
    doors: list[tuple[Array, str, float]] = []
    for mark in marks:
        if all(np.hypot(*(mark[0] - other[0])) > SAME_PORTAL for other in doors):
            doors.append(mark)
    return doors
