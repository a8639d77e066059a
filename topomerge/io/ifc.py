"""Read building models (IFC)."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from array import array
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.landmarks import parse_landmarks
from topomerge.io.mesh import sample
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_in_subprocess
from topomerge.types import LANDMARK_KINDS, Array, Landmarks, TrueRoom

LITERALS = re.compile(rb"'[^']*'|/\*.*?\*/", re.DOTALL)  # strings and comments
STATEMENT = re.compile(rb"#(\d+)\s*=\s*([^;]*)")
ENTITY_REFERENCE = re.compile(rb"#(\d+)")
DEEPEST = 5000  # references one behind the other; models of buildings have 15
# The two sides of a wall name each other (CorrespondingBoundary): the schema's one circle, which no geometry follows.
PAIRED = re.compile(rb"IFCRELSPACEBOUNDARY2NDLEVEL\s*\(", re.IGNORECASE)


def check_references(path: Path) -> None:
    """Refuse a file whose entities refer to themselves, directly or around, or too deep.

    Raises:
        InputError: it does.
    """
    from scipy.sparse import csr_array  # here: the process that makes bodies needs none of it
    from scipy.sparse.csgraph import connected_components

    owners, targets, count = parse_references(path.read_bytes())
    graph = csr_array((np.ones(len(owners), np.int8), (owners, targets)), shape=(count, count))
    _, circle = connected_components(graph, directed=True, connection="strong")
    in_circle = np.bincount(circle)[circle] > 1 if count else np.zeros(0, bool)
    in_circle[owners[owners == targets]] = True
    if in_circle.any():
        raise build_damage_error(
            path, "an IFC model", f"{in_circle.sum():,} entities refer to themselves, directly or in a circle"
        )
    deeper = _count_deep_entities(owners, targets, count)
    if deeper:
        raise build_damage_error(path, "an IFC model", f"{deeper:,} entities are nested deeper than {DEEPEST:,}")


def _count_deep_entities(owners: Array, targets: Array, count: int) -> int:
    """Count the entities with more than DEEPEST references one behind the other below them."""
    waiting = np.bincount(owners, minlength=count)
    order = np.argsort(targets, kind="stable")
    ends = np.searchsorted(targets[order], np.arange(count + 1))
    free, left = np.flatnonzero(waiting == 0), count
    for _ in range(DEEPEST):  # in each round goes what refers to nothing that is left
        left -= len(free)
        if not len(free):
            break
        edges = np.concatenate([order[ends[i] : ends[i + 1]] for i in free])
        freed, times = np.unique(owners[edges], return_counts=True)
        waiting[freed] -= times
        free = freed[waiting[freed] == 0]
    return left


def parse_references(text: bytes) -> tuple[Array, Array, int]:
    """Parse (m,) rows that refer, (m,) rows that they refer to, and the number of entities.

    What does not exist is left out, and what boundaries of spaces say of each other.
    """
    text = LITERALS.sub(b"", text)
    statements = [(match[1], match[2]) for match in STATEMENT.finditer(text)]
    row = {name: i for i, (name, _) in enumerate(statements)}
    paired = {name for name, statement in statements if PAIRED.match(statement)}
    owners, targets = array("q"), array("q")
    for name, statement in statements:
        left_out = paired if name in paired else ()
        existing = [row[other] for other in ENTITY_REFERENCE.findall(statement) if other in row and other not in left_out]
        owners.extend([row[name]] * len(existing))
        targets.extend(existing)
    return np.array(owners, np.int64), np.array(targets, np.int64), len(statements)


# What has a shape but is not built, or is cut out of something else.
NOT_BUILT = ("IfcSpace", "IfcFeatureElement", "IfcSite", "IfcAnnotation", "IfcGrid", "IfcVirtualElement", "IfcSpatialZone")
STEP_END = b"END-ISO-10303-21"
GEOMETRY_KERNELS = ("hybrid-cgal-simple-opencascade", "opencascade")  # the first is three to six times as fast
IFC_SECONDS = 600  # of the processor for one piece: 50 elements, which take a second
IFC_MEMORY = 8 << 30  # bytes that the library may take
NAME_HEIGHT = 1.0  # m above the floor, of a space's name
UNNAMED_SPACE = re.compile(r"room \d+|")  # what topomerge calls a room without a name
WELD = 1e-3  # m, corners closer than this are one


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the true rooms, then points on every built element, in the order of their ids.

    The library is in a process of its own: a reference to an entity of another kind can make it break down.
    """
    if find_spec("ifcopenshell") is None:
        raise ImportError("no ifcopenshell", name="ifcopenshell")
    _check_ends(path)
    check_references(path)
    yield from read_in_subprocess("ifc", "an IFC model", path, options, IFC_SECONDS, IFC_MEMORY)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process."""
    ifcopenshell = _import_library()

    try:
        model = ifcopenshell.open(str(path))
    except ifcopenshell.Error as error:
        raise build_damage_error(path, "an IFC model", error) from error
    if not all(line.Points for line in model.by_type("IfcPolyline")):  # the library divides by their number
        raise build_damage_error(path, "an IFC model", "a line without points")
    built = [p for p in model.by_type("IfcProduct") if p.Representation and _is_built(p, options.doors)]
    if not built:
        raise InputError(f"{path}: has no building elements with a shape; export it with its geometry")
    spaces = _read_spaces(model)
    rooms = _build_rooms(spaces)
    yield Piece(np.empty((0, 3)), rooms=rooms, done=0.05, landmarks=_find_landmarks(model, rooms, path.name))
    shapes: dict[int, tuple[Array, Array]] = {}
    for number, (element, vertices, faces) in enumerate(_iter_shapes(model, built)):
        shapes[element] = vertices, faces
        if number % 50 == 0:
            yield Piece(np.empty((0, 3)), done=0.05 + 0.75 * number / len(built))
    if not shapes:
        raise InputError(f"{path}: none of its {len(built)} building elements has a usable shape; export it with its geometry")
    first = 0
    for _, (vertices, faces) in sorted(shapes.items()):  # threads hand the elements over in any order
        yield Piece(vertices, done=0.8)
        for piece in sample(path, vertices, faces, options, first=first):
            yield Piece(piece.points, done=0.9)
        first += len(faces)
    yield from _sample_missing_floors(path, spaces, list(shapes.values()), options, first)
    lost = len(built) - len(shapes)
    if lost:
        yield Piece(np.empty((0, 3)), warnings=(f"{lost} of {len(built)} elements have no usable shape",), done=1.0)


def _import_library() -> Any:
    """Import ifcopenshell without lark: it sets up a parser for what headers say of views, which is not read here."""
    hidden = "lark" not in sys.modules
    if hidden:
        sys.modules["lark"] = None  # type: ignore[assignment]
    try:
        with redirect_stdout(io.StringIO()):  # it tells that lark is missing
            import ifcopenshell
    finally:
        if hidden:
            del sys.modules["lark"]
    return ifcopenshell


@dataclass(frozen=True, eq=False)
class ModelElement:
    """An element of a building model.

    Args:
        guid: its GlobalId.
        kind: "wall", "column", "slab", "door" or "other".
        name: what its author calls it.
        vertices: (n, 3) float64 m, in the model's frame.
        faces: (m, 3) int64, rows of vertices.
    """

    guid: str
    kind: str
    name: str
    vertices: Array
    faces: Array


ELEMENT_KINDS = {"IfcWall": "wall", "IfcColumn": "column", "IfcSlab": "slab", "IfcDoor": "door"}  # all others are "other"


def read_elements(path: Path) -> list[ModelElement]:
    """Read the walls, columns, slabs, doors and all else that is built of a model, in the order of their ids.

    The library is in a process of its own, as in `read`.

    Raises:
        InputError: no model, a damaged one, or one without walls, columns, slabs and doors.
    """
    if find_spec("ifcopenshell") is None:
        raise InputError(f"{path}: needs the Python package ifcopenshell: pip install 'topomerge[ifc]'")
    _check_ends(path)
    check_references(path)
    rows = [sys.executable, "-c", f"from {__name__} import write_elements; write_elements()", str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    child = subprocess.run(rows, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, check=False)
    if child.returncode:
        raise build_damage_error(path, "an IFC model", "the library that reads it broke down")
    with np.load(io.BytesIO(child.stdout), allow_pickle=False) as data:
        rows, vertices, faces, ends = data["words"], data["vertices"], data["faces"], data["ends"]
    if not np.isin(rows[:, 1], list(ELEMENT_KINDS.values())).any():
        raise InputError(f"{path}: has no walls, columns, slabs or doors with a shape; export it with its geometry")
    spans = zip(rows.tolist(), ends[:-1].tolist(), ends[1:].tolist(), strict=True)
    return [ModelElement(guid, kind, name, vertices[v0:v1], faces[f0:f1]) for (guid, kind, name), (v0, f0), (v1, f1) in spans]


def write_elements() -> None:
    """Write the elements of the model that the command line names to stdout, as one NumPy archive, for `read_elements`."""
    ifcopenshell = _import_library()

    model = ifcopenshell.open(sys.argv[1])
    built = [p for p in model.by_type("IfcElement") if p.Representation and _is_built(p, doors=True)]
    requested = {p.id(): (p, next((kind for name, kind in ELEMENT_KINDS.items() if p.is_a(name)), "other")) for p in built}
    shapes = sorted(_iter_shapes(model, [p for p, _ in requested.values()]), key=lambda shape: shape[0])
    parts = [(str(requested[k][0].GlobalId), requested[k][1], str(requested[k][0].Name or "")) for k, _, _ in shapes]
    ends = np.cumsum([(0, 0), *((len(v), len(f)) for _, v, f in shapes)], axis=0)
    vertices = np.concatenate([np.zeros((0, 3)), *(v for _, v, _ in shapes)])
    faces = np.concatenate([np.zeros((0, 3), np.int64), *(f for _, _, f in shapes)])
    archive = io.BytesIO()
    np.savez(archive, words=np.array(parts, str).reshape(-1, 3), vertices=vertices, faces=faces, ends=ends)
    sys.stdout.buffer.write(archive.getvalue())


def _check_ends(path: Path) -> None:
    """Refuse what is not IFC, or cut short, before the parser sees it."""
    with path.open("rb") as stream:
        start = stream.read(4096)
        stream.seek(max(0, path.stat().st_size - 4096))
        end = stream.read()
    if b"ISO-10303-21" not in start:
        raise InputError(f"{path}: is not an IFC file (no ISO-10303-21 in its first lines); check the file's suffix")
    if STEP_END not in end:
        raise InputError(f"{path}: has no end ({STEP_END.decode()}); the file is cut short, copy it again")


def _is_built(product: Any, doors: bool) -> bool:
    left_out = NOT_BUILT if doors else (*NOT_BUILT, "IfcDoor")
    return not any(product.is_a(kind) for kind in left_out)


def _iter_shapes(model: Any, products: list[Any]) -> Iterator[tuple[int, Array, Array]]:
    """Yield (id, vertices (n, 3), faces (m, 3)) of products, in metres in the model's frame.

    Flat bodies are made by the fast one of the library's two kernels, all others, and those in which it fails, by the slow one.
    """
    left = {p.id() for p in products}
    for kernel in GEOMETRY_KERNELS:
        for element, vertices, faces in _iter_shapes_by_kernel(model, [p for p in products if p.id() in left], kernel):
            left.discard(element)
            yield element, vertices, faces


def _iter_shapes_by_kernel(model: Any, products: list[Any], kernel: Any) -> Iterator[tuple[int, Array, Array]]:
    """Yield the same by one kernel; what it cannot make is left out."""
    import ifcopenshell.geom

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    # Two threads take twice one's processor time for the same bodies: no gain where the reader's own process has the other core.
    threads = min(4, cores) if (cores := os.cpu_count() or 1) > 2 else 1
    try:
        iterator = ifcopenshell.geom.iterator(settings, model, threads, include=products, geometry_library=kernel)
        if not products or not iterator.initialize():
            return
    except (RuntimeError, TypeError):  # this build of the library lacks the kernel
        return
    while True:
        shape = iterator.get()
        vertices = np.array(shape.geometry.verts, np.float64).reshape(-1, 3)
        faces = np.array(shape.geometry.faces, np.int64).reshape(-1, 3)
        if len(faces):
            yield int(shape.id), vertices, faces
        if not iterator.next():
            return


def _read_spaces(model: Any) -> list[tuple[Any, Array, Array]]:
    """Return (space, vertices, faces) of every space with a shape, in the order of their ids."""
    spaces = {s.id(): s for s in model.by_type("IfcSpace") if s.Representation}
    shapes = sorted(_iter_shapes(model, list(spaces.values())), key=lambda s: s[0])
    return [(spaces[element], vertices, faces) for element, vertices, faces in shapes]


def _sample_missing_floors(
    path: Path, spaces: list[tuple[Any, Array, Array]], shapes: list[tuple[Array, Array]], options: ReadOptions, first: int
) -> Iterator[Piece]:
    """Yield the floors of spaces on a level that has no slab: some models hold walls and ceilings only, and nobody could stand in
    them."""
    slabs = np.concatenate([_measure_level_areas(v, f, _find_level_faces(v, f)) for v, f in shapes])
    lows = [_find_floor_faces(v, f) for _, v, f in spaces]
    floors = [_measure_level_areas(v, f, low) for (_, v, f), low in zip(spaces, lows, strict=True)]
    levels = np.round([v[:, 2].min() for _, v, _ in spaces], 1)
    added = 0
    for level in np.unique(levels):
        spaces_of_level = np.flatnonzero(levels == level)
        needed = sum(float(floors[i][:, 1].sum()) for i in spaces_of_level)
        near = (slabs[:, 0] > level - 0.4) & (slabs[:, 0] < level + 0.15)
        if float(slabs[near, 1].sum()) >= 0.5 * needed:
            continue
        for i in spaces_of_level:
            _, vertices, faces = spaces[i]
            for piece in sample(path, vertices, faces[lows[i]], options, first=first):
                yield Piece(piece.points, done=0.95)
            first += len(faces)
        added += len(spaces_of_level)
    if added:
        text = f"the model has no floors under {added} of its spaces; the lower faces of the spaces were taken for floors"
        yield Piece(np.empty((0, 3)), warnings=(text,), done=0.95)


def _measure_level_areas(vertices: Array, faces: Array, which: Array) -> Array:
    """Return (k, 2) height (m) and area (m2) of the faces chosen."""
    a, b, c = (vertices[faces[which, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.column_stack([(a + b + c)[:, 2] / 3, area])


def _find_level_faces(vertices: Array, faces: Array) -> Array:
    """Return (m,) bool: is the face rather level than steep?"""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    return np.abs(normals[:, 2]) > 0.7 * np.linalg.norm(normals, axis=1)


def _find_floor_faces(vertices: Array, faces: Array) -> Array:
    """Return (m,) bool: level faces in the lowest quarter of a body, its floor."""
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    return _find_level_faces(vertices, faces) & (vertices[faces][:, :, 2].mean(axis=1) < low + (high - low) / 4)


def _build_rooms(spaces: list[tuple[Any, Array, Array]]) -> tuple[TrueRoom, ...]:
    """Return every space with a shape, in the order of its storey and name."""
    outlined = []
    for space, vertices, faces in spaces:
        floor, ceiling = float(vertices[:, 2].min()), float(vertices[:, 2].max())
        outlined.append((space, trace_outline(vertices, faces), floor, ceiling))
    storeys = _number_storeys([(_find_storey_id(space), floor) for space, _, floor, _ in outlined])
    rooms = [
        TrueRoom(str(space.Name or ""), polygon, floor, ceiling, storey, str(space.LongName or ""))
        for (space, polygon, floor, ceiling), storey in zip(outlined, storeys, strict=True)
        if len(polygon) >= 3
    ]
    return tuple(sorted(rooms, key=lambda r: (r.storey, r.name, r.floor, *r.polygon[0])))


def _find_landmarks(model: Any, rooms: tuple[TrueRoom, ...], source: str) -> Landmarks:
    """Return the names of spaces, both the short and the long one, and annotations whose type is a kind of landmark."""
    import shapely
    from ifcopenshell.util.placement import get_local_placement
    from ifcopenshell.util.unit import calculate_unit_scale

    rows: list[dict[str, Any]] = []
    for room in rooms:
        inside = shapely.make_valid(shapely.Polygon(room.polygon)).representative_point()
        for name in dict.fromkeys((room.name, room.kind)):
            if not UNNAMED_SPACE.fullmatch(name.strip()):
                at = (inside.x, inside.y, min(room.floor + NAME_HEIGHT, room.ceiling))
                rows.append({"kind": "name", "value": name, "position": at})
    for note in model.by_type("IfcAnnotation"):
        if note.ObjectType in LANDMARK_KINDS and note.Name and note.ObjectPlacement is not None:
            place = calculate_unit_scale(model) * np.asarray(get_local_placement(note.ObjectPlacement), float)[:3, 3]
            rows.append({"kind": note.ObjectType, "value": str(note.Name), "position": place.tolist()})
    return parse_landmarks(rows, source)


def _find_storey_id(space: Any) -> int:
    """Return the id of the IfcBuildingStorey that a space belongs to, 0 where it belongs to none."""
    parent = space
    while parent is not None and not parent.is_a("IfcBuildingStorey"):
        parent = next((r.RelatingObject for r in parent.Decomposes), None)
    return 0 if parent is None else int(parent.id())


def _number_storeys(spaces: list[tuple[int, float]]) -> list[int]:
    """Return the number of the storey of each (storey id, floor height), the lowest storey with spaces being 0."""
    heights: dict[int, list[float]] = {}
    for storey, floor in spaces:
        heights.setdefault(storey, []).append(floor)
    middle = sorted((float(np.median(v)), storey) for storey, v in heights.items())
    number = {storey: i for i, (_, storey) in enumerate(middle)}
    return [number[storey] for storey, _ in spaces]


def trace_outline(vertices: Array, faces: Array) -> Array:
    """Trace (k, 2) float64 outline of a body's floor, counter-clockwise, without its holes.

    The floor is made of the flat faces in the lowest quarter; where they enclose nothing, the convex hull stands in.
    """
    corners, index = np.unique(np.round(vertices / WELD).astype(np.int64), axis=0, return_inverse=True)
    points = corners * WELD
    triangles = index.reshape(-1)[faces]
    a, b, c = (points[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    floor = _find_floor_faces(points, triangles)
    turned = np.where(normals[floor, 2:] < 0, triangles[floor][:, ::-1], triangles[floor])  # all seen from above
    loops = [points[loop, :2] for loop in _find_boundary_loops(turned)]
    best = max(loops, key=compute_signed_area, default=np.empty((0, 2)))
    return best if compute_signed_area(best) > 0.01 else _compute_hull(points[:, :2])


def _find_boundary_loops(triangles: Array) -> list[list[int]]:
    """Return the closed chains of the edges that only one of the triangles has."""
    edges = {(int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3)}
    after: dict[int, list[int]] = {}
    for start, end in sorted(edges):
        if (end, start) not in edges and start != end:
            after.setdefault(start, []).append(end)
    loops = []
    while after:
        start = next(iter(after))
        loop, at = [], start
        while at in after:
            loop.append(at)
            at_next = after[at].pop()
            if not after[at]:
                del after[at]
            at = at_next
        if at == start:
            loops.append(loop)
    return loops


def compute_signed_area(polygon: Array) -> float:
    """Compute the signed area of a polygon (k, 2), m²; positive where it runs counter-clockwise."""
    x, y = np.asarray(polygon, np.float64).T
    return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def _compute_hull(points: Array) -> Array:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]  # counter-clockwise in 2D
    except (QhullError, ValueError):
        return np.empty((0, 2))
