"""Robot grids with true rooms: UTexas BWI (``locations.yaml``) and IPA room segmentation (``*_gt_segmentation.png``).

Grids without room truth have no plan. UTexas: `locations.yaml` names the rooms and holds their polygons, in pixels from the top,
`doors.yaml` the two corners of each door, and the map itself tells where rooms are open to each other. IPA: rooms are white
regions between lines; where a line runs over free space of the scan, there is a doorway.

Rooms and doors out of any raster of labels: its row 0 is the lowest y, its label 0 is no room.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import yaml
from PIL import Image, ImageDraw
from scipy import ndimage
from topomerge.datasets.plans.sketch import Sketch, build_opening, place_door

from topomerge.errors import InputError
from topomerge.io.grid import IMAGE_FORMATS
from topomerge.types import Array

ROUGH = 1.2  # cells, tolerance of outlines
BENT = 0.35  # m, that the points of a doorway may lie aside of its line
NARROW_CONTACT = 0.65  # m; narrower contacts of two rooms are no doors
DOORWAY_THICKNESS = 0.4  # m, thickness given to a doorway found in a raster
BUSY = 5  # doors from which on a room is a corridor


def flood(labels: Array, free: Array, height: Array | None = None) -> Array:
    """Spread labels over free cells, highest first, never across a wall: two regions meet where the way between them is lowest.

    Args:
        labels: (h, w) int32, 0 where nothing is yet.
        free: (h, w) bool.
        height: (h, w), for instance the distance to the nearest wall; None: all the same.
    """
    wide = np.pad(np.where(free, labels, 0), 1)
    flat = wide.ravel()
    todo = np.flatnonzero(np.pad(free, 1).ravel() & (flat == 0))
    levels = np.zeros(len(todo)) if height is None else np.pad(height, 1).ravel()[todo]
    steps = np.array([-1, 1, -wide.shape[1], wide.shape[1]])
    for level in np.unique(levels)[::-1]:
        active = todo[levels >= level]
        active = active[flat[active] == 0]
        while len(active):
            spread = flat[active[:, None] + steps].max(axis=1)
            reached = spread > 0
            if not reached.any():
                break
            flat[active[reached]] = spread[reached]
            active = active[~reached]
    return np.ascontiguousarray(wide[1:-1, 1:-1])


def trace_outline(mask: Array, resolution: float, origin: Array, thin: float = 0.0) -> shapely.Polygon:
    """Trace the outline of the largest part of a mask, m; smoothed, and without what is narrower than twice `thin` m."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return shapely.Polygon()
    start = np.ones(len(rows), bool)
    start[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1] + 1)
    first, last = np.flatnonzero(start), np.append(np.flatnonzero(start)[1:] - 1, len(rows) - 1)
    boxes = shapely.box(columns[first], rows[first], columns[last] + 1, rows[first] + 1)
    whole = shapely.union_all(boxes)
    if thin:
        off = thin / resolution
        whole = whole.buffer(-off, join_style="mitre").buffer(off, join_style="mitre").intersection(whole)
    whole = whole.simplify(ROUGH)
    parts = [p for p in shapely.get_parts(shapely.make_valid(whole)) if p.geom_type == "Polygon"]
    best = max(parts, key=lambda p: p.area, default=shapely.Polygon())
    return shapely.transform(best, lambda points: points * resolution + origin)


def find_contacts(labels: Array, resolution: float, origin: Array) -> list[tuple[int, int, Array]]:
    """Find where regions touch: two labels and the ends (2, 2), m, of the contact's line; bent contacts are no doorways."""
    touching = []
    pairs: dict[tuple[int, int], list[Array]] = {}
    for axis in (0, 1):
        a, b = (labels[:-1], labels[1:]) if axis == 0 else (labels[:, :-1], labels[:, 1:])
        rows, columns = np.nonzero((a != b) & (a > 0) & (b > 0))
        middle = np.column_stack([columns, rows]) + ([0.5, 1.0] if axis == 0 else [1.0, 0.5])
        low, high = np.minimum(a, b)[rows, columns], np.maximum(a, b)[rows, columns]
        for pair in np.unique(np.column_stack([low, high]), axis=0).tolist():
            pairs.setdefault((pair[0], pair[1]), []).append(middle[(low == pair[0]) & (high == pair[1])])
    for (first, second), parts in sorted(pairs.items()):
        points = np.concatenate(parts)
        for cluster in _cluster_points(points):
            line = _fit_line(cluster)
            along = (line[1] - line[0]) / max(float(np.hypot(*(line[1] - line[0]))), 1e-9)
            if np.ptp(cluster @ np.array([-along[1], along[0]])) * resolution <= BENT:
                touching.append((first, second, line * resolution + origin))
    return touching


def _cluster_points(points: Array) -> list[Array]:
    """Group points that are at most two cells apart."""
    low = np.floor(points.min(axis=0)).astype(int) - 2
    image = np.zeros(np.floor(points.max(axis=0)).astype(int) - low + 3, bool)
    cells = np.floor(points).astype(int) - low
    image[cells[:, 0], cells[:, 1]] = True
    numbers = ndimage.label(ndimage.binary_dilation(image, np.ones((3, 3))), np.ones((3, 3)))[0]
    which = numbers[cells[:, 0], cells[:, 1]]
    return [points[which == k] for k in np.unique(which)]


def _fit_line(points: Array) -> Array:
    """Return (2, 2) ends of the points along their main direction, which is an axis where that is nearly right."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0] if len(points) > 1 else np.array([1.0, 0])
    if np.abs(along).max() > 0.97:
        along = np.round(np.abs(along))
    t = (points - centre) @ along
    aside = np.array([-along[1], along[0]])
    middle = np.abs(t) <= np.abs(t).min() + max(np.ptp(t) / 4, 1.0)
    centre = centre + aside * float(np.mean((points[middle] - centre) @ aside))  # on the contact itself, where it is curved
    return np.asarray(centre + np.array([[t.min() - 0.5], [t.max() + 0.5]]) * along)


def add_rooms(
    result: Sketch,
    labels: Array,
    names: dict[int, str],
    resolution: float,
    origin: Array,
    smallest: float,
    thin: float = 0.0,
) -> dict[int, int]:
    """Add a room for each label whose outline has at least `smallest` m2; return its index by label."""
    index = {}
    for label, place in enumerate(ndimage.find_objects(labels), 1):
        if place is None:
            continue
        corner = origin + np.array([place[1].start, place[0].start]) * resolution
        shape = trace_outline(labels[place] == label, resolution, corner, thin)
        if shape.area >= smallest:
            index[label] = result.add_room(names.get(label, f"room {label}"), "", shape)
    return index


def add_contacts(result: Sketch, doorways: list[tuple[int, int, Array]], index: dict[int, int], kind: str) -> None:
    """Add a doorway for each contact of two rooms."""
    for a, b, ends in doorways:
        if a in index and b in index and np.hypot(*(ends[1] - ends[0])) >= NARROW_CONTACT:
            result.add_opening(build_opening(kind, ends[0], ends[1], DOORWAY_THICKNESS), (index[a], index[b]))


def guess_kinds(result: Sketch, usual: str) -> None:
    """Guess the kinds of rooms: those with many doors are corridors, the others `usual`."""
    doors = np.bincount(np.array([e for ends in result.ends for e in ends if e >= 0], int), minlength=len(result.shapes))
    result.kinds = ["corridor" if n >= BUSY else usual for n in doors]


IPA_CELL = 0.05  # m, nominal
FREE_GREY, WHITE = 250, 250  # grey levels of free space, of the inside of a true room
SMALLEST_GRID_ROOM = 1.0  # m2 of a room
GRID_CAVITY = 0.3  # m; narrower strips of a room are left out
BRIDGE = 6  # cells between two rooms that an opening may cross
ROBOT_BODY = 0.3  # m that a way from room to room keeps from what is not free: speckled walls have holes
GRID_PASSAGE = 1.5  # m, of openings whose place is not known
DOORS_APART = 1.0  # m between an opening of the map and a door of the list
MAX_PIXELS = 100_000_000


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of the one storey."""
    if path.suffix == ".yaml":
        yield path.parent.name, partial(read_bwi, path)
    else:
        yield path.stem.removesuffix("_gt_segmentation"), partial(read_ipa, path)


def read_ipa(path: Path) -> Sketch:
    """Read rooms of a segmentation image and doorways where its lines cross free space of the scan beside it.

    Raises:
        InputError: no scan of the same name and size, or no rooms.
    """
    truth = _read_image(path)
    stem = path.stem.removesuffix("_gt_segmentation")
    scans = [path.with_name(f"{stem}{end}.png") for end in ("", "_scan")]
    scan = next((s for s in scans if s.is_file()), None)
    if scan is None:
        raise InputError(f"missing file: {stem}.png")
    free = _read_image(scan) >= FREE_GREY
    if free.shape != truth.shape:
        raise InputError(f"wrong version: {scan.name} is {free.shape[::-1]} pixels, its rooms are {truth.shape[::-1]}")
    labels = ndimage.label(truth >= WHITE)[0].astype(np.int32)
    sizes = np.bincount(labels.ravel())
    labels[np.isin(labels, np.flatnonzero(sizes < SMALLEST_GRID_ROOM / IPA_CELL**2))] = 0
    labels = _remove_outside(labels, free)
    labels = flood(labels, free | (labels > 0))
    result = Sketch(height=3.2, ceiling=2.7, inset=0.02)
    origin = np.zeros(2)
    index = add_rooms(result, labels, {}, IPA_CELL, origin, SMALLEST_GRID_ROOM, GRID_CAVITY / 2)
    add_contacts(result, find_contacts(labels, IPA_CELL, origin), index, "door")
    guess_kinds(result, "office")
    return result


def read_bwi(path: Path) -> Sketch:
    """Read rooms of `locations.yaml`, doors of `doors.yaml`, and openings where the map is free between two rooms.

    The image `locations.png` is not read: on floor 3 its numbers are not those of the list.

    Raises:
        InputError: a polygon for each room, `doors.yaml` or the map with its resolution is missing.
    """
    about = _read_yaml(path)
    names, polygons = (about.get(key) if isinstance(about, dict) else None for key in ("locations", "polygons"))
    if not isinstance(names, list) or not isinstance(polygons, list) or not names or len(names) != len(polygons):
        raise InputError("not a grid plan: expected as many 'polygons' as 'locations'")
    if not path.with_name("doors.yaml").is_file():
        raise InputError("missing file: doors.yaml")
    grid, resolution, origin = _read_map(path.parent)
    labels = _rasterize_polygons(polygons, grid.shape)
    result = Sketch(height=3.6, ceiling=2.8, inset=0.05)
    index = add_rooms(
        result, labels, dict(enumerate(map(str, names), 1)), resolution, origin, SMALLEST_GRID_ROOM, GRID_CAVITY / 2
    )
    room_of_name = {str(name): index.get(k, -1) for k, name in enumerate(names, 1)}
    _add_listed_doors(result, _read_yaml(path.with_name("doors.yaml")), room_of_name)
    doors = [np.add(o.start, o.end) / 2 for o in result.openings]
    body = ndimage.distance_transform_edt(grid >= FREE_GREY) * resolution > ROBOT_BODY
    near = ndimage.distance_transform_edt(labels == 0) <= BRIDGE / 2
    for a, b, ends in find_contacts(flood(np.where(body, labels, 0), body & near), resolution, origin):
        along = (ends[1] - ends[0]) / np.hypot(*(ends[1] - ends[0]))
        if all(np.hypot(*(ends.mean(axis=0) - door)) > DOORS_APART for door in doors):
            add_contacts(result, [(a, b, ends + np.stack([-along, along]) * ROBOT_BODY)], index, "opening")
    if (path.with_name("connectivity.yaml")).is_file():
        _add_connections(result, _read_yaml(path.with_name("connectivity.yaml")), room_of_name)
    guess_kinds(result, "office")
    return result


def _rasterize_polygons(polygons: list[list[float]], shape: tuple[int, ...]) -> Array:
    """Return (h, w) int32: number of the polygon in each cell, from 1, lowest row first."""
    image = Image.new("I", (shape[1], shape[0]), 0)
    for k, polygon in enumerate(polygons, 1):
        corners = np.array(polygon, float).reshape(-1, 2)
        if len(np.unique(corners, axis=0)) < 3:
            raise InputError(f"not closed: polygon {k} has no area")
        ImageDraw.Draw(image).polygon([(float(x), float(y)) for x, y in corners], fill=k)
    return np.flipud(np.asarray(image, np.int32)).copy()


def _add_listed_doors(result: Sketch, doors: Any, room_of_name: dict[str, int]) -> None:
    if not isinstance(doors, list):
        raise InputError("not a grid plan: doors.yaml holds no list")
    for door in doors:
        ends = sorted({room_of_name.get(str(a.get("from")), -1) for a in door.get("approach", [])})
        start, end = (np.array(door[f"door_corner_pt_{k}"], float) for k in (1, 2))
        if len(ends) != 2 or ends[0] < 0:
            continue
        width = float(np.hypot(*(end - start)))
        shapes = [result.shapes[i] for i in ends]
        placed = place_door(shapes[0], shapes[1], width, 1.0, (start + end) / 2) if width else None
        placed = placed or build_opening("door", start, end, DOORWAY_THICKNESS)
        result.add_opening(replace(placed, kind="door"), (ends[0], ends[1]))  # also double ones have leaves here


def _add_connections(result: Sketch, neighbours: Any, room_of_name: dict[str, int]) -> None:
    """Add openings for rooms that `connectivity.yaml` calls neighbours and that have none yet."""
    done = {frozenset(ends) for ends in result.ends}
    for name, others in sorted(neighbours.items()) if isinstance(neighbours, dict) else []:
        for other in others:
            a, b = room_of_name.get(str(name), -1), room_of_name.get(str(other), -1)
            if min(a, b) < 0 or frozenset((a, b)) in done:
                continue
            opening = place_door(result.shapes[a], result.shapes[b], GRID_PASSAGE, 0.5, None, "opening")
            if opening is not None:
                result.add_opening(opening, (a, b))
                done.add(frozenset((a, b)))


def _remove_outside(labels: Array, free: Array) -> Array:
    """Remove white regions that are not free in the scan, or touch the rim of the image: they are no rooms."""
    counts = np.bincount(labels.ravel())
    share = np.bincount(labels.ravel(), free.ravel()) / np.maximum(counts, 1)
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    out = np.union1d(np.flatnonzero(share < 0.2), rim)
    return np.where(np.isin(labels, out), 0, labels)


def _read_map(folder: Path) -> tuple[Array, float, Array]:
    """Return the map of a folder: grey levels, m per cell, and origin, m."""
    listings = sorted(p for p in folder.glob("*.yaml") if p.stem not in ("locations", "doors", "objects", "connectivity"))
    for path in sorted(listings, key=lambda p: p.stem != folder.name):
        about = _read_yaml(path)
        image = path.with_name(f"{Path(str(about.get('image', ''))).stem}.png")
        if "resolution" in about and image.is_file():
            cell = float(about["resolution"])
            if not 0.005 <= cell <= 1.0:
                raise InputError(f"absurd scale: {cell} m per cell")
            return _read_image(image), cell, np.array(about["origin"][:2], float)
    raise InputError("missing file: a map with 'resolution', 'origin' and its image as PNG")


def _read_yaml(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_bytes()) or {}
    except yaml.reader.ReaderError as error:
        raise InputError(f"damaged YAML: {path.name}: is no text") from error
    except yaml.YAMLError as error:
        raise InputError(f"damaged YAML: {path.name}: {' '.join(str(error).split())[:100]}") from error


def _read_image(path: Path) -> Array:
    """Return (h, w) uint8 grey levels, lowest row first; transparent is as dark as it is painted."""
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            if image.width * image.height > MAX_PIXELS:
                raise InputError(f"absurd size: {path.name} has {image.width} by {image.height} pixels")
            return np.flipud(np.asarray(image.convert("L"))).copy()
    except (OSError, Image.DecompressionBombError) as error:
        raise InputError(f"damaged image: {path.name}") from error
