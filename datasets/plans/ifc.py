"""Building models (IFC 2x3 and 4) with spaces; needs the extra ``ifc``.

A room is the lower side of an ``IfcSpace``. Doors and windows are the openings that they fill; an opening that nothing fills is a
doorway when it reaches the floor. Spaces that touch are open to each other: a wall would keep them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.plans.sketch import Sketch, build_opening, convert_to_window, find_side_rooms, place_door

from topomerge.errors import InputError
from topomerge.types import Array

IFC_KINDS = {  # words in the names of spaces
    "corridor": "corridor",
    "hall": "corridor",
    "foyer": "lobby",
    "lobby": "lobby",
    "reception": "lobby",
    "living": "living",
    "bed": "bedroom",
    "kitchen": "kitchen",
    "bath": "bath",
    "wc": "toilets",
    "toilet": "toilets",
    "restroom": "toilets",
    "stair": "stairs",
    "elev": "lift",
    "conf": "meeting",
    "meeting": "meeting",
    "open office": "openplan",
    "office": "office",
    "stor": "storage",
    "utility": "storage",
    "mech": "storage",
    "elec": "storage",
    "roof": "outside",
}
SILL = 0.3  # m; holes that start higher above the floor are no doorways
TOUCHING = 0.03  # m
IFC_PASSAGE = 4.0  # m, widest opening between spaces that touch
HEIGHTS = (2.4, 8.0)  # m, of a storey


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of every storey that has spaces, lowest first.

    Raises:
        InputError: the extra is missing; damaged file; no spaces.
    """
    try:
        import ifcopenshell
        import ifcopenshell.geom
    except ImportError as error:
        raise InputError("not read: IFC needs the extra: pip install 'topomerge[ifc]'") from error
    try:
        model = ifcopenshell.open(str(path))
    except Exception as error:  # its errors have no common class
        raise InputError(f"damaged IFC: {' '.join(str(error).split())[:120]}") from error
    if not isinstance(model, ifcopenshell.file) or not model.by_type("IfcSpace"):
        raise InputError("no rooms: the model has no IfcSpace")
    solids = ElementSolids(model)
    rooms = [(space, solids.triangulate(space)) for space in model.by_type("IfcSpace")]
    storeys: dict[int, list[tuple[Any, Array]]] = {}
    for space, triangles in rooms:
        if triangles is not None:
            storeys.setdefault(_find_storey_id(space), []).append((space, triangles))
    order = sorted(storeys, key=lambda s: float(np.median([t[..., 2].min() for _, t in storeys[s]])))
    floors = [float(np.median([t[..., 2].min() for _, t in storeys[s]])) for s in order]
    holes = _find_openings(model, solids)
    for k, storey in enumerate(order):
        element: Any = model.by_id(storey) if storey else None
        name = getattr(element, "Name", None) or f"storey {k}"
        above = floors[k + 1] if k + 1 < len(floors) else floors[k] + 3.2
        yield f"{path.stem}/{name}", partial(build_sketch, storeys[storey], holes, floors[k], above)


class ElementSolids:
    """Triangles of a model's elements, in metres and the model's frame."""

    def __init__(self, model: Any) -> None:
        import ifcopenshell.geom

        self.settings = ifcopenshell.geom.settings()
        self.settings.set("use-world-coords", True)
        self.geom = ifcopenshell.geom
        self.model = model

    def triangulate(self, element: Any) -> Array | None:
        """Return (t, 3, 3) corners of an element's triangles, None where it has no shape."""
        try:
            shape: Any = self.geom.create_shape(self.settings, element)
        except Exception:  # an element without a solid; its errors have no common class
            return None
        mesh = shape.geometry
        vertices = np.array(mesh.verts, float).reshape(-1, 3)
        triangles = vertices[np.array(mesh.faces, int).reshape(-1, 3)]
        return triangles if len(triangles) else None


def build_sketch(rooms: list[tuple[Any, Array]], holes: list[tuple[str, Array, Array]], floor: float, above: float) -> Sketch:
    """Return one storey from its spaces and the model's holes."""
    height = float(np.clip(above - floor, *HEIGHTS))
    tops = [float(t[..., 2].max() - t[..., 2].min()) for _, t in rooms]
    result = Sketch(height=height, ceiling=float(np.clip(np.median(tops), 2.0, height - 0.2)))
    for space, triangles in rooms:
        name = " ".join(str(part) for part in (space.Name, space.LongName) if part)
        kind = next((kind for word, kind in IFC_KINDS.items() if word in name.lower()), "")
        shape = _compute_base_outline(triangles)
        if shape.area > 0.5 and kind != "outside":
            result.add_room(name or f"space {len(result.shapes)}", kind, shape)
    if not result.shapes:
        raise InputError("too few rooms: 0")
    for kind, ends, heights in holes:
        if not floor - 0.5 < heights[0] < floor + height - 0.8:
            continue
        if kind == "opening" and heights[0] > floor + SILL:
            continue
        left, right = find_side_rooms(ends[None, 0], ends[None, 1], result.shapes, 0.6)[0].tolist()
        opening = build_opening("opening" if kind == "window" else kind, ends[0], ends[1], 0.6)
        if kind == "window":
            opening = convert_to_window(opening, max(float(heights[0]) - floor, 0.0), float(heights[1]) - floor)
        result.add_opening(opening, (left, right))
    _add_open_sides(result)
    return result


def _find_storey_id(element: Any) -> int:
    """Return the id of the storey that an element is part of, 0: none."""
    from ifcopenshell.util.element import get_aggregate, get_container

    above = element
    for _ in range(5):
        above = get_aggregate(above) or get_container(above)
        if above is None:
            return 0
        if above.is_a("IfcBuildingStorey"):
            return int(above.id())
    return 0


def _compute_base_outline(triangles: Array) -> shapely.Polygon:
    """Return the outline of the lower side of a solid, seen from above."""
    z = triangles[..., 2]
    low = triangles[(z < z.min() + 0.3).all(axis=1)]
    for chosen in (low, triangles):
        flat = shapely.polygons(chosen[..., :2])
        whole = shapely.union_all(flat[shapely.area(flat) > 1e-6], grid_size=1e-3)
        parts = [p for p in shapely.get_parts(whole) if p.geom_type == "Polygon"]
        if parts:
            return max(parts, key=lambda p: p.area).simplify(0.005)
    return shapely.Polygon()


def _find_openings(model: Any, solids: ElementSolids) -> list[tuple[str, Array, Array]]:
    """Return the kind, ends (2, 2) along the middle of the wall, and lower and upper height of every door, window and bare
    opening."""
    out = []
    for element in [*model.by_type("IfcDoor"), *model.by_type("IfcWindow")]:
        hole = next((rel.RelatingOpeningElement for rel in element.FillsVoids), None)
        triangles = solids.triangulate(hole) if hole is not None else None
        triangles = solids.triangulate(element) if triangles is None else triangles
        if triangles is not None:
            out.append(_build_opening("door" if element.is_a("IfcDoor") else "window", triangles))
    for hole in model.by_type("IfcOpeningElement"):
        wall = hole.VoidsElements[0].RelatingBuildingElement if hole.VoidsElements else None
        if not hole.HasFillings and wall is not None and wall.is_a("IfcWall"):
            triangles = solids.triangulate(hole)
            if triangles is not None and np.ptp(triangles[..., 2]) > 1.8:
                out.append(_build_opening("opening", triangles))
    return out


def _build_opening(kind: str, triangles: Array) -> tuple[str, Array, Array]:
    """Return the long axis of the smallest rectangle around a hole that is as wide as it is: walls are thinner than doors are
    wide."""
    around = shapely.oriented_envelope(shapely.multipoints(triangles.reshape(-1, 3)[:, :2]))
    corners = np.asarray(around.exterior.coords)[:4] if around.geom_type == "Polygon" else np.zeros((4, 2))
    if np.hypot(*(corners[1] - corners[0])) < np.hypot(*(corners[2] - corners[1])):
        corners = np.roll(corners, -1, axis=0)
    ends = np.stack([corners[[0, 3]].mean(axis=0), corners[[1, 2]].mean(axis=0)])
    return kind, ends, np.array([triangles[..., 2].min(), triangles[..., 2].max()])


def _add_open_sides(result: Sketch) -> None:
    """Add openings where two spaces touch for at least 0.8 m."""
    shapes = np.array(result.shapes, object)
    first, second = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=TOUCHING)
    for i, j in sorted({(i, j) for i, j in zip(first.tolist(), second.tolist(), strict=True) if i < j}):
        opening = place_door(result.shapes[i], result.shapes[j], IFC_PASSAGE, TOUCHING, None, "opening")
        if opening is not None and np.hypot(*(np.subtract(opening.end, opening.start))) >= 0.8:
            result.add_opening(opening, (i, j))
