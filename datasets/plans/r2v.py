"""Apartments of Raster-to-Vector (Liu et al., ICCV 2017): one text file a plan, many in a tar archive.

A line is ``x1 y1 x2 y2 category a b``, tab-separated, pixels, y down. Walls and doors are segments, rooms are small
rectangles that lie inside the room, the rest are fixtures. "door" is any opening. There is no scale: it follows from narrow
doors, bathtubs and toilets, which hardly differ in size between apartments. Rooms are the faces of the wall arrangement.
"""

from __future__ import annotations

import lzma
import tarfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.core.building import Wall
from topomerge.datasets.plans.sketch import Sketch, build_opening, convert_to_window, find_side_rooms, read_limited

from topomerge.errors import InputError
from topomerge.types import Array

APARTMENT_KINDS = {  # in order of precedence where a face has several labels; our word for each
    "living_room": "living",
    "bedroom": "bedroom",
    "kitchen": "kitchen",
    "stairs": "stairs",
    "bathroom": "bath",
    "washing_room": "bath",
    "restroom": "toilets",
    "entrance": "entrance",
    "corridor": "corridor",
    "closet": "storage",
    "balcony": "balcony",
    "PS": "shaft",
}
OUTSIDE_LABELS = ("balcony", "shaft")  # open air and pipe spaces are no rooms
LIVED_IN = ("bedroom", "living_room", "kitchen")
HINGED = ("1", "2", "4", "5", "7", "9")  # kinds of opening with an ordinary leaf
APARTMENT_DOOR, BATHTUB, TOILET = 0.75, 1.2, 0.74  # m, usual lengths
DOOR_RANGE = (0.7, 0.9)  # m, of the median narrow door
PIXEL_SNAP = 6.0  # px; walls whose ends miss each other by less are joined
APARTMENT_WALL = 0.12  # m
ARCHIVE_MEMBERS, ARCHIVE_BYTES, PLAN_BYTES = 100_000, 1 << 30, 1 << 20  # of an archive, and of one plan

Rows = list[tuple[Array, str, str]]  # (2, 2) px, category, type


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of every plan of a text file or a tar archive, whose members are read in memory only.

    Raises:
        InputError: truncated or absurdly large archive.
    """
    if path.suffix == ".txt":
        yield path.stem, partial(parse_sketch, read_limited(path, PLAN_BYTES))
        return
    total = 0
    try:
        with tarfile.open(path, "r:*") as archive:
            for count, member in enumerate(archive):
                total += member.size
                if count >= ARCHIVE_MEMBERS or total > ARCHIVE_BYTES:
                    raise InputError(f"absurd size: more than {ARCHIVE_MEMBERS} members or {ARCHIVE_BYTES >> 20} MiB")
                if not member.isfile() or not member.name.endswith(".txt"):
                    continue
                name = member.name.removeprefix("./").removesuffix(".txt")
                if member.size > PLAN_BYTES:
                    yield name, partial(_refuse, f"absurd size: {member.size} bytes for one plan")
                    continue
                stream = archive.extractfile(member)
                yield name, partial(parse_sketch, stream.read() if stream else b"")
    except (tarfile.TarError, EOFError, lzma.LZMAError, zlib.error) as error:
        raise InputError(f"damaged archive: {error}") from error


def _refuse(reason: str) -> Sketch:
    raise InputError(reason)


def parse_sketch(text: bytes) -> Sketch:
    """Return one apartment.

    Raises:
        InputError: a line that can't be read; no walls; walls that enclose nothing; no scale.
    """
    rows = _parse_rows(text)
    walls = np.array([ends for ends, category, _ in rows if category == "wall" and np.ptp(ends, axis=0).max() > 0])
    if not len(walls):
        raise InputError("no walls: not a Raster-to-Vector plan")
    scale = _estimate_scale(rows)
    walls = walls * scale
    faces = _build_faces(walls, PIXEL_SNAP * scale)
    kinds = _classify_faces(faces, rows, scale)
    _check_seeds(faces, rows, scale)
    result = Sketch(height=2.9, ceiling=2.4)
    rooms = np.full(len(faces) + 1, -1)  # the last one is the answer to index -1: outside
    for i, (face, kind) in enumerate(zip(faces, kinds, strict=True)):
        if kind not in OUTSIDE_LABELS:
            rooms[i] = result.add_room(f"{kind or 'room'} {len(result.shapes)}", kind, face)
    result.walls = [Wall((w[0][0], w[0][1]), (w[1][0], w[1][1]), APARTMENT_WALL) for w in walls.tolist()]
    _add_openings(result, rows, scale, faces, rooms, walls)
    return result


def _parse_rows(text: bytes) -> Rows:
    rows: Rows = []
    for number, line in enumerate(text.decode("utf-8", "replace").splitlines(), 1):
        fields = line.split()
        if not fields:
            continue
        try:
            ends = np.array(fields[:4], np.float64).reshape(2, 2) * (1, -1)  # y up
        except ValueError:
            ends = np.full((2, 2), np.nan)
        if len(fields) < 5 or not np.isfinite(ends).all():
            raise InputError(f"bad line: {number} is not 'x1 y1 x2 y2 category'")
        rows.append((ends, fields[4], fields[5] if len(fields) > 5 else ""))
    return rows


def _estimate_scale(rows: Rows) -> float:
    """Return the metres per pixel: the middle one of what doors, bathtubs and toilets say, kept where narrow doors are 0.7 to 0.9
    m."""

    def lengths(category: str, types: tuple[str, ...] = ()) -> Array:
        chosen = [np.ptp(ends, axis=0).max() for ends, c, t in rows if c == category and (not types or t in types)]
        return np.array([length for length in chosen if length > 5])

    doors = lengths("door", HINGED)
    doors = doors if len(doors) else lengths("door")
    if not len(doors):
        raise InputError("zero-width doors: none is longer than 5 px" if any(r[1] == "door" for r in rows) else "no doors")
    narrow = float(np.median(doors))
    guesses = [APARTMENT_DOOR / narrow]
    for category, length in (("bathtub", BATHTUB), ("toilet", TOILET)):
        drawn_lengths = lengths(category)
        guesses += [length / float(np.median(drawn_lengths))] if len(drawn_lengths) else []
    low, high = np.array(DOOR_RANGE) / narrow
    return float(np.clip(np.median(guesses), low, high))


def _build_faces(walls: Array, snap: float) -> list[shapely.Polygon]:
    """Build the faces of the walls after making them longer by `snap` at both ends; slivers between double lines are left out."""
    along = walls[:, 1] - walls[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True) * snap
    lines = np.stack([walls[:, 0] - along, walls[:, 1] + along], axis=1)
    noded = shapely.node(shapely.multilinestrings(shapely.linestrings(lines)))
    faces = shapely.get_parts(shapely.polygonize([noded]))
    faces = [face for face in faces if not face.buffer(-snap).is_empty]
    if not faces:
        raise InputError("not closed: the walls enclose no room")
    return faces


def _classify_faces(faces: list[shapely.Polygon], rows: Rows, scale: float) -> list[str]:
    """Return the kind of each face: that of the seed in it, the most telling one where there are several."""
    tree, order = shapely.STRtree(faces), list(APARTMENT_KINDS)
    best = np.full(len(faces), len(order))
    for ends, category, _ in rows:
        if category in APARTMENT_KINDS:
            for i in tree.query(shapely.Point(ends.mean(axis=0) * scale), predicate="within"):
                best[i] = min(best[i], order.index(category))
    return [APARTMENT_KINDS[order[k]] if k < len(order) else "" for k in best]


def _check_seeds(faces: list[shapely.Polygon], rows: Rows, scale: float) -> None:
    """Refuse a plan where half of the rooms that people live in stand open: what is left of it is no apartment."""
    seeds = [shapely.Point(ends.mean(axis=0) * scale) for ends, category, _ in rows if category in LIVED_IN]
    open_ = sum(1 for seed in seeds if not len(shapely.STRtree(faces).query(seed, predicate="within")))
    if open_ and 2 * open_ >= len(seeds):
        raise InputError(f"not closed: no walls around {open_} of {len(seeds)} bedrooms, living rooms and kitchens")


def _add_openings(result: Sketch, rows: Rows, scale: float, faces: list[shapely.Polygon], rooms: Array, walls: Array) -> None:
    """Add doors between rooms and at the entrance; other openings to outside are windows, wide ones down to the floor."""
    ends = np.array([ends * scale for ends, category, _ in rows if category == "door" and np.ptp(ends, axis=0).max() > 0])
    if not len(ends):
        return
    lines = shapely.linestrings(walls)
    ends = np.array([_snap_to_wall(pair, walls, lines) for pair in ends])
    faced = find_side_rooms(ends[:, 0], ends[:, 1], faces, APARTMENT_WALL / 2 + 0.3)
    for (start, end), (left, right) in zip(ends, rooms[faced].tolist(), strict=True):
        opening = build_opening("door", start, end, APARTMENT_WALL + 0.1)
        inner = max(left, right)
        if min(left, right) < 0 <= inner and result.kinds[inner] != "entrance":
            wide = np.hypot(*(end - start)) > 1.5
            opening = convert_to_window(opening, 0.0 if wide else 0.9, 2.0)
        result.add_opening(opening, (left, right))


def _snap_to_wall(ends: Array, walls: Array, lines: Array) -> Array:
    """Return (2, 2) the opening moved onto the nearest wall that runs its way, if there is one within 0.2 m."""
    along = ends[1] - ends[0]
    if abs(along[0]) > 1e-9 and abs(along[1]) > 1e-9:  # a slanted opening stays where it is
        return ends
    axis = int(abs(along[0]) > abs(along[1]))  # the coordinate that does not change
    parallel = np.ptp(walls[:, :, axis], axis=1) < 0.1 * np.ptp(walls[:, :, 1 - axis], axis=1)
    distance = np.where(parallel, shapely.distance(lines, shapely.Point(ends.mean(axis=0))), np.inf)
    best = int(np.argmin(distance))
    moved = ends.copy()
    if distance[best] < 0.2:
        moved[:, axis] = walls[best][:, axis].mean()
    return moved
