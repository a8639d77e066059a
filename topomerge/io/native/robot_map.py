"""Maps of vacuum robots joined as one map of Valetudo, in the frame and the pixels of the first.

The first map's pixels stay; what it does not show is filled from the others, each turned into its pixels (the nearest one), and
floor of no room becomes theirs. A room most of whose pixels lie in a room of the maps before is that room, and gives it its name
if that has none. Entities (charger, robot, ways, zones, virtual walls) are moved by the pose, to whole centimetres, as Valetudo
counts them. Valetudo RE's maps and Roborock's own files become maps of Valetudo, too: of the forty kinds of blocks in these most
are not known, and could not be moved. Source: https://valetudo.cloud (version 2 of the map: `compressedPixels`, `dimensions`,
`metaData.area`; whole centimetres, y down).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io import grid, valetudo
from topomerge.io.json_map import load_json_map
from topomerge.io.native import Doubt, Motion, Source, Tally
from topomerge.io.piece import build_damage_error
from topomerge.types import Array

KIND = valetudo.KIND
UNKNOWN, WALL, FLOOR = 0, -1, -2  # of a pixel; from 1 on the number of a room
SHARED = 0.5  # of a room's pixels, from which on it is the room that has them
SAME_PLACE = 30  # cm, within which two entities of one kind are one
STEPS = 8  # of finding the place that a bent map puts at a pixel
VERSION = 2
MOST_ENTITIES, LARGEST_PLACE = 100_000, 10_000_000  # entities of a map; cm
Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Map:
    """A map: numbers of its pixels (h, w), the lowest row first; m a pixel, the lower left corner in pixels; of each room what
    the file tells of it; entities in centimetres, y down; and the rest of the file."""

    pixels: Array
    cell: float
    corner: Array
    rooms: tuple[Json, ...]
    entities: tuple[Json, ...] = ()
    about: Json | None = None


def is_native(path: Path) -> bool:
    """Return whether a file is one of Roborock, or JSON of Valetudo or Valetudo RE."""
    if path.suffix.lower() != ".json":
        return True
    try:
        return valetudo.is_robot_map(load_json_map(path))
    except InputError:
        return False


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write all maps as one of Valetudo.

    Raises:
        InputError: one is damaged, or tilted.
    """
    del doubt
    for source in sources:
        if not source.motion.level:
            raise InputError(f"{source.path}: its map is tilted, and a vacuum robot's map lies in a plane; leave it out")
    maps = [read_map(source.path) for source in sources]
    counts = {"rooms": sum(len(m.rooms) for m in maps), "entities": sum(len(m.entities) for m in maps)}
    names = [str(room.get("name") or "") for m in maps for room in m.rooms]
    motions = [source.motion for source in sources]
    if len(maps) == 1 and motions[0].still and maps[0].about is not None:
        shutil.copyfile(sources[0].path, target)
        return Tally({name: (count, count) for name, count in counts.items()})
    joined = _turn_map(maps[0], motions[0], maps[0].cell, sources[0].path)
    shared = 0
    for drawn, source in zip(maps[1:], sources[1:], strict=True):
        joined, pairs = _unite(joined, _turn_map(drawn, source.motion, joined.cell, source.path), source.path)
        shared += pairs
    if maps[0].about is None:
        joined = _shift(joined, np.array([0, -round(valetudo.RR_SIDE * valetudo.RR_PIXEL / joined.cell)]))
    shifted, told = _shift_inside(joined)
    target.write_text(json.dumps(_build_file(shifted), allow_nan=False, separators=(",", ":")), encoding="utf-8")
    written = load_json_map(target)
    kept = valetudo.parse_robot_map(target, written)
    named = sum(bool(name) for name in kept.names)
    tally = {
        "rooms": (counts["rooms"], len(kept.names)),
        "rooms that are one": (shared, counts["rooms"] - len(kept.names)),
        "names": (sum(map(bool, names)), named),
        "entities": (counts["entities"], len(written["entities"])),
    }
    warnings = [f"{sources[0].path}: {told}"] if told else []
    if any(m.about is None for m in maps):
        other = next(s.path for s, m in zip(sources, maps, strict=True) if m.about is None)
        warnings.append(f"{other}: becomes a map of Valetudo; of what is drawn into it only walls, floor and rooms are kept")
    return Tally(tally, tuple(warnings))


def read_map(path: Path) -> _Map:
    """Read a map of any of the three.

    Raises:
        InputError: it is none, or damaged.
    """
    if path.suffix.lower() != ".json":
        drawn, about = valetudo.read_roborock_map(path), None
    else:
        about = load_json_map(path)
        drawn = valetudo.parse_json_map(path, about)
        about = None if valetudo.is_rand256_map(about) else about
    pixels = np.where(drawn.walls, WALL, np.where(drawn.rooms > 0, drawn.rooms, np.where(drawn.free, FLOOR, UNKNOWN)))
    corner = np.round(drawn.origin / drawn.resolution).astype(np.int64)
    if about is None:
        return _Map(pixels.astype(np.int32), drawn.resolution, corner, tuple({} for _ in drawn.names))
    layers = [x for x in about["layers"] if isinstance(x, dict) and x.get("type") == "segment"]
    rooms = [dict(x["metaData"]) if isinstance(x.get("metaData"), dict) else {} for x in layers]
    return _Map(pixels.astype(np.int32), drawn.resolution, corner, tuple(rooms), tuple(_read_entities(path, about)), dict(about))


def _read_entities(path: Path, about: Mapping[str, Any]) -> list[Json]:
    listed = about.get("entities") or []
    if not isinstance(listed, list) or len(listed) > MOST_ENTITIES:
        raise build_damage_error(path, KIND, "its entities are none")
    for entity in listed:
        points = entity.get("points") if isinstance(entity, dict) else None
        if not isinstance(points, list) or len(points) % 2:
            raise build_damage_error(path, KIND, "an entity without points")
        if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < LARGEST_PLACE for v in points):
            raise build_damage_error(path, KIND, "an entity outside of any map")
    return listed


def _turn_map(drawn: _Map, motion: Motion, cell: float, path: Path) -> _Map:
    """Return a map in the joined frame, in pixels of another size: each takes what lies at its middle."""
    if motion.still and cell == drawn.cell:
        return drawn
    low, high = drawn.corner * drawn.cell, (drawn.corner + drawn.pixels.shape[::-1]) * drawn.cell
    rim = np.linspace(low, high, 33)
    edges = [(x, y) for x in rim[:, 0] for y in (low[1], high[1])] + [(x, y) for y in rim[:, 1] for x in (low[0], high[0])]
    reach = _move(motion, np.array(edges))
    first = np.floor(reach.min(axis=0) / cell).astype(np.int64) - 1
    width, height = (np.ceil(reach.max(axis=0) / cell).astype(np.int64) + 1 - first).tolist()
    if width * height > grid.PIXELS:
        raise InputError(f"{path}: would span {width:,} by {height:,} pixels, more than {grid.PIXELS:,}; leave it out")
    pixels = np.zeros((height, width), np.int32)
    columns = (first[0] + np.arange(width) + 0.5) * cell
    for row in range(height):
        aim = np.column_stack([columns, np.full(width, (first[1] + row + 0.5) * cell)])
        x, y = (np.floor(_find_origin(motion, aim) / drawn.cell).astype(np.int64) - drawn.corner).T
        inside = (x >= 0) & (y >= 0) & (x < drawn.pixels.shape[1]) & (y < drawn.pixels.shape[0])
        pixels[row, inside] = drawn.pixels[y[inside], x[inside]]
    if not pixels.any():
        raise InputError(f"{path}: has no pixel left in pixels of {cell:g} m; name the map with the smaller ones first")
    shown = [np.flatnonzero(pixels.any(axis=axis)) for axis in (0, 1)]
    (left, right), (bottom, top) = ((int(numbers[0]), int(numbers[-1]) + 1) for numbers in shown)
    entities = tuple(_move_entity(entity, motion) for entity in drawn.entities)
    corner = first + (left, bottom)
    return replace(drawn, pixels=pixels[bottom:top, left:right], cell=cell, corner=corner, entities=entities)


def _move(motion: Motion, places: Array) -> Array:
    moved: Array = motion.move_points(np.column_stack([places, np.zeros(len(places))]))[:, :2]
    return moved


def _find_origin(motion: Motion, aim: Array) -> Array:
    """Return the places that a motion takes to (n, 2) m."""
    back = np.linalg.inv(motion.matrix[:2, :2])
    found: Array = (aim - motion.matrix[:2, 3]) @ back.T
    for _ in range(0 if motion.warp is None else STEPS):
        found = found + (aim - _move(motion, found)) @ back.T
    return found


def _move_entity(entity: Json, motion: Motion) -> Json:
    points = np.array(entity["points"], np.float64).reshape(-1, 2)
    if not len(points):
        return entity
    moved = 100 * _move(motion, points * (0.01, -0.01)) * (1, -1)
    out = {**entity, "points": np.round(moved).astype(np.int64).ravel().tolist()}
    about = entity.get("metaData")
    angle = about.get("angle") if isinstance(about, dict) else None
    if isinstance(about, dict) and isinstance(angle, int | float) and not isinstance(angle, bool):
        pose = np.eye(4)
        pose[:2, 3] = points[0] * (0.01, -0.01)
        turn = motion.move_poses(pose[None])[0]
        turned = angle - np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))  # angles are counted clockwise
        out["metaData"] = {**about, "angle": int(np.round(turned)) % 360}
    return out


def _unite(joined: _Map, drawn: _Map, path: Path) -> tuple[_Map, int]:
    """Return both as one, and how many rooms both have."""
    low = np.minimum(joined.corner, drawn.corner)
    ends = [m.corner + m.pixels.shape[::-1] for m in (joined, drawn)]
    width, height = (np.maximum(*ends) - low).tolist()
    if width * height > grid.PIXELS:
        raise InputError(f"{path}: lies so far off that both span {width:,} by {height:,} pixels; leave it out")
    mine, other = np.zeros((2, height, width), np.int32)
    for picture, m in ((mine, joined), (other, drawn)):
        x, y = (m.corner - low).tolist()
        picture[y : y + m.pixels.shape[0], x : x + m.pixels.shape[1]] = m.pixels
    numbers, rooms, pairs = np.arange(len(drawn.rooms) + 1), list(joined.rooms), 0
    for number, about in enumerate(drawn.rooms, 1):
        own = mine[other == number]
        shares = np.bincount(own[own > 0], minlength=1)
        if len(own) and shares.max() >= SHARED * len(own):
            numbers[number], pairs = int(shares.argmax()), pairs + 1
            known = rooms[numbers[number] - 1]
            if not known.get("name") and about.get("name"):
                rooms[numbers[number] - 1] = {**known, "name": about["name"]}
        else:
            rooms.append(about)
            numbers[number] = len(rooms)
    other = np.where(other > 0, numbers[np.maximum(other, 0)], other)
    pixels = np.where((mine == UNKNOWN) | ((mine == FLOOR) & (other > 0)), other, mine).astype(np.int32)
    entities = [*joined.entities, *(e for e in drawn.entities if not any(_is_same(e, known) for known in joined.entities))]
    rest = joined.about if joined.about is not None else drawn.about
    return replace(joined, pixels=pixels, corner=low, rooms=tuple(rooms), entities=tuple(entities), about=rest), pairs


def _is_same(a: Json, b: Json) -> bool:
    if a.get("type") != b.get("type") or len(a["points"]) != len(b["points"]):
        return False
    return all(abs(x - y) <= SAME_PLACE for x, y in zip(a["points"], b["points"], strict=True))


def _shift_inside(drawn: _Map) -> tuple[_Map, str]:
    """Return the map moved by whole pixels so that none has a number below 0, and by how much, in words."""
    top = drawn.corner[1] + drawn.pixels.shape[0]
    shift = np.array([max(-drawn.corner[0], 0), min(-top, 0)])
    if not shift.any():
        return drawn, ""
    right, up = np.round(shift * drawn.cell * 100).astype(np.int64).tolist()
    told = f"the joined map begins beyond its corner, so that all is {right} cm further right and {-up} cm further down"
    return _shift(drawn, shift), told


def _shift(drawn: _Map, shift: Array) -> _Map:
    """Return the map moved by whole pixels."""
    cm = np.round(shift * drawn.cell * 100).astype(np.int64) * (1, -1)
    moved = [{**e, "points": (np.array(e["points"]).reshape(-1, 2) + cm).ravel().tolist()} for e in drawn.entities]
    return replace(drawn, corner=drawn.corner + shift, entities=tuple(moved))


def _build_file(drawn: _Map) -> Json:
    """Build the JSON of a map, version 2."""
    about = drawn.about or {"__class": "ValetudoMap", "metaData": {}}
    cell = round(drawn.cell * 100, 6)
    cell = int(cell) if cell == int(cell) else cell
    column, top = int(drawn.corner[0]), -int(drawn.corner[1] + drawn.pixels.shape[0])
    picture = np.flipud(drawn.pixels)
    used: set[str] = set()
    layers = []
    for value, kind, meta in [(FLOOR, "floor", {}), (WALL, "wall", {})] + [
        (number, "segment", room) for number, room in enumerate(drawn.rooms, 1)
    ]:
        own = picture == value
        if not own.any() and kind != "segment":
            continue
        if kind == "segment":
            meta = {**meta, "segmentId": _choose_id(meta.get("segmentId"), used)}
        layers.append(_build_layer(own, kind, meta, (column, top), cell))
    high = (drawn.corner[0] + picture.shape[1]) * cell, (top + picture.shape[0]) * cell
    size: Any = about.get("size")
    sides: Any = [size.get(axis) if isinstance(size, dict) else 0 for axis in "xy"]
    side = [max(old if isinstance(old, int) else 0, int(np.ceil(new))) for old, new in zip(sides, high, strict=True)]
    area = sum(layer["metaData"]["area"] for layer in layers)
    meta = {**(about.get("metaData") or {}), "version": VERSION, "totalLayerArea": area}
    changed = {"metaData": meta, "size": dict(zip("xy", side, strict=True)), "pixelSize": cell}
    return {**about, **changed, "layers": layers, "entities": list(drawn.entities)}


def _choose_id(number: Any, used: set[str]) -> str:
    name = str(number) if isinstance(number, str | int) and str(number) else "1"
    if name in used:
        name = next(str(k) for k in range(1, len(used) + 2) if str(k) not in used)
    used.add(name)
    return name


def _build_layer(own: Array, kind: str, meta: Json, corner: tuple[int, int], cell: float) -> Json:
    """Build a layer of the pixels (h, w), the top row first, that are its own."""
    padded = np.pad(own, ((0, 0), (1, 1))).astype(np.int8)
    steps = np.diff(padded, axis=1)
    row, start = np.nonzero(steps == 1)
    length = np.nonzero(steps == -1)[1] - start
    runs = np.column_stack([start + corner[0], row + corner[1], length])
    y, x = np.nonzero(own)
    count = len(x)
    sides = {}
    for axis, values in (("x", x + corner[0]), ("y", y + corner[1])):
        low, high = (int(values.min()), int(values.max())) if count else (0, 0)
        sides[axis] = {"min": low, "max": high, "mid": (low + high) // 2, "avg": int(values.mean().round()) if count else 0}
    area = count * cell * cell
    return {
        "__class": "MapLayer",
        "metaData": {**meta, "area": int(area) if area == int(area) else area},
        "type": kind,
        "pixels": [],
        "compressedPixels": runs.ravel().tolist(),
        "dimensions": {**sides, "pixelCount": count},
    }
