"""Maps of vacuum robots: Valetudo's JSON (``"__class": "ValetudoMap"``, version 1 or 2), that of Valetudo RE, and Roborock's own.

Layers of pixels: `wall`, `floor`, and one `segment` for each room that the robot tells apart, whose pixels are floor. Walls
become walls as of a floor plan. The frame is the robot's own, so that maps of one home on two days fit: x right, y up, the corner
of pixel (0, 0) at the origin. The robot's own rooms are no truth and are not kept: `parse_robot_map` gives them. Their names are.
Source: https://valetudo.cloud (map data format); `pixels` lists x, y, `compressedPixels` x, y and how many follow to the right.
Roborock's file (`rr`, often packed by gzip) is a head and blocks, of which one is a picture of a byte a pixel, 5 cm each, the
lowest row first: https://github.com/Hypfer/Valetudo, `assets/kaitai_structs/roborock_map_file.ksy`. It has no names of rooms.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.io import grid
from topomerge.io.floor_masks import check_outside_floor
from topomerge.io.piece import Piece, ReadOptions, build_damage_error
from topomerge.types import Array, Landmarks, build_landmarks

KIND = "a vacuum robot's map"
FREE_LAYERS = ("floor", "segment")
NAME_HEIGHT = 1.0  # m above the floor, of a room's name
WALLED = 0.3  # share of the floor's outline along which robots that draw walls have one: they have 0.5 to 1, the others under 0.1


@dataclass(frozen=True)
class RobotMap:
    """The map of a vacuum robot; arrays (h, w), the lowest row of the picture first.

    Args:
        walls, free: bool.
        rooms: int32, number of the robot's own room from 1, in the order of the file; 0: none.
        names: of these rooms, as their owner called them; "" where they have none.
        resolution: m a pixel.
        origin: (2,) m, lower left corner.
    """

    walls: Array
    free: Array
    rooms: Array
    names: tuple[str, ...]
    resolution: float
    origin: Array


def is_robot_map(about: object) -> bool:
    """Return whether a value is a map of Valetudo or of Valetudo RE."""
    return isinstance(about, dict) and (about.get("__class") == "ValetudoMap" or is_rand256_map(about))


def is_rand256_map(about: Mapping[str, Any]) -> bool:
    """Return whether it is the JSON of Valetudo RE (rand256)."""
    image = about.get("image")
    return isinstance(image, dict) and isinstance(image.get("pixels"), dict) and isinstance(image.get("dimensions"), dict)


def iter_pieces(path: Path, about: Mapping[str, Any], options: ReadOptions) -> Iterator[Piece]:
    """Yield floor points, then walls layer by layer, in metres."""
    yield from _extrude(path, parse_json_map(path, about), options)


def _extrude(path: Path, drawn: RobotMap, options: ReadOptions) -> Iterator[Piece]:
    if options.resolution is not None:
        raise InputError(f"{path}: states its own resolution; leave --resolution out")
    free, walls = np.pad(drawn.free, 1), np.pad(drawn.walls, 1)
    outline = ndimage.binary_dilation(free, np.ones((3, 3))) & ~free
    walled = float((outline & ndimage.binary_dilation(walls, np.ones((5, 5)))).sum() / max(outline.sum(), 1))
    warnings: tuple[str, ...] = ()
    if walled < WALLED:
        walls |= outline
        warnings = (f"{path}: draws walls along {walled:.0%} of its floor's outline; the outline was taken for walls",)
    outside = [f"{path}: {doubt}; save the map again" for doubt in check_outside_floor(walls, free, drawn.resolution)]
    names = find_segment_names(drawn, path.name)
    yield Piece(np.empty((0, 3)), warnings=(*warnings, *outside), done=0.1, landmarks=names)
    x, y = (drawn.origin - drawn.resolution).tolist()
    plan = grid.Plan(path, drawn.resolution, (x, y, 0.0))
    yield from grid.extrude(path, np.flipud(walls), np.flipud(free), plan, options)


def parse_json_map(path: Path, about: Mapping[str, Any]) -> RobotMap:
    """Parse a map of Valetudo or of Valetudo RE (`is_robot_map`).

    Raises:
        InputError: the map can't be used.
    """
    return _parse_rand256_map(path, about) if is_rand256_map(about) else parse_robot_map(path, about)


def parse_robot_map(path: Path, about: Mapping[str, Any]) -> RobotMap:
    """Parse the walls, the floor and the robot's own rooms.

    Args:
        path: of the file, for messages.
        about: what is in it (`is_robot_map`).

    Raises:
        InputError: the map can't be used.
    """
    cell, layers = _parse_number(about.get("pixelSize")), about.get("layers")
    if not 0.5 <= cell <= 100 or not isinstance(layers, list):
        raise InputError(f"{path}: has no layers, or no pixel size of 0.5 to 100 cm; save the map again")
    runs = [(layer.get("type"), _get_layer_name(layer), _parse_runs(path, layer)) for layer in layers if isinstance(layer, dict)]
    every = np.concatenate([np.zeros((0, 3), np.int64), *(r for _, _, r in runs)])
    if not len(every):
        raise InputError(f"{path}: shows neither floor nor walls; let the robot drive first")
    low = every[:, :2].min(axis=0)
    width, height = (np.maximum(every[:, 0] + every[:, 2], every[:, 0] + 1).max(), every[:, 1].max() + 1) - low
    if int(every[:, 2].sum()) > grid.PIXELS:
        raise build_damage_error(path, KIND, f"its layers together have more than {grid.PIXELS:,} pixels")
    if width * height > grid.PIXELS:
        raise InputError(f"{path}: spans {width} by {height} pixels, more than {grid.PIXELS:,}; it is damaged")
    walls, free = np.zeros((height, width), bool), np.zeros((height, width), bool)
    rooms, names = np.zeros((height, width), np.int32), []
    for kind, name, run in runs:
        if kind == "wall":
            _paint(walls, run, low, True)
        elif kind in FREE_LAYERS:
            _paint(free, run, low, True)
            if kind == "segment":
                names.append(name)
                _paint(rooms, run, low, len(names))
    free &= ~walls
    origin = np.array([low[0], -(low[1] + height)]) * cell / 100
    rooms[walls] = 0
    return RobotMap(np.flipud(walls), np.flipud(free), np.flipud(rooms), tuple(names), cell / 100, origin)


def find_segment_names(drawn: RobotMap, source: str) -> Landmarks:
    """Find the names that people gave the robot's rooms, each at the pixel of its room that is nearest to its middle."""
    row, column = np.nonzero(drawn.rooms)
    room = drawn.rooms[row, column]
    size = np.maximum(np.bincount(room, minlength=len(drawn.names) + 1), 1)
    middle = [np.bincount(room, axis, len(size)) / size for axis in (row, column)]
    order = np.lexsort((np.hypot(row - middle[0][room], column - middle[1][room]), room))
    rooms, first = np.unique(room[order], return_index=True)
    places = drawn.origin + (np.column_stack([column, row])[order[first]] + 0.5) * drawn.resolution
    named = np.array([bool(drawn.names[i - 1].strip()) for i in rooms.tolist()], bool)
    position = np.column_stack([places, np.full(len(places), NAME_HEIGHT)])[named]
    return build_landmarks("name", [drawn.names[i - 1] for i in rooms[named].tolist()], source, position)


def _get_layer_name(layer: dict[str, Any]) -> str:
    about = layer.get("metaData")
    return str(about.get("name") or "")[:80] if isinstance(about, dict) else ""


def _parse_number(value: object) -> float:
    """Return the value, nan where it is no number."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else float("nan")


def _parse_runs(path: Path, layer: dict[str, Any]) -> Array:
    """Return (n, 3) int64 column, row and length of runs of pixels."""
    compressed = layer.get("compressedPixels") or []
    listed, numbers = (compressed, 3) if compressed else (layer.get("pixels") or [], 2)
    kind = str(layer.get("type"))[:20]
    if not listed:
        return np.zeros((0, 3), np.int64)
    try:
        runs = np.array(listed)
    except ValueError as error:
        raise build_damage_error(path, KIND, f"pixels of the layer {kind} are no numbers") from error
    if runs.ndim != 1 or len(runs) % numbers or not np.issubdtype(runs.dtype, np.integer):
        raise build_damage_error(path, KIND, f"pixels of the layer {kind} are no list of whole numbers, {numbers} each")
    runs = runs.reshape(-1, numbers).astype(np.int64)
    if numbers == 2:
        runs = np.column_stack([runs, np.ones(len(runs), np.int64)])
    if runs.min() < 0 or runs.max() > grid.PIXELS or int(runs[:, 2].sum()) > grid.PIXELS:
        raise build_damage_error(path, KIND, f"pixels of the layer {kind} lie outside of any map")
    return runs


def _paint(picture: Array, runs: Array, low: Array, value: int) -> None:
    """Give the pixels of runs a value, in a picture (h, w) whose top row comes first; work and memory are those of the runs."""
    flat = picture.reshape(-1)
    first = (runs[:, 1] - low[1]) * picture.shape[1] + runs[:, 0] - low[0]
    for start, end in zip(first.tolist(), (first + runs[:, 2]).tolist(), strict=True):
        flat[start:end] = value


RR_MAGIC, GZIP_MAGIC = b"rr", b"\x1f\x8b"
RR_HEAD, RR_BLOCK = struct.Struct("<2xHI2H2I"), struct.Struct("<2HI")
RR_IMAGE, RR_DIGEST = 2, 1024  # kinds of blocks
RR_PIXEL, RR_SIDE = 0.05, 1024  # m, and pixels of the robot's whole world
LARGEST_RR = 1 << 26  # bytes, unpacked
SEGMENT_SHIFT, LARGEST_SEGMENT = 21, 31  # Valetudo RE packs the number of a room above that of a pixel


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read a map file of Roborock: floor points, then walls layer by layer, in metres."""
    yield from _extrude(path, read_roborock_map(path), options)


def read_roborock_map(path: Path) -> RobotMap:
    """Read the walls, the floor and the robot's own rooms of a map file of Roborock.

    Raises:
        InputError: it is damaged, or shows nothing.
    """
    data = path.read_bytes() if path.stat().st_size <= LARGEST_RR else b""
    if data.startswith(GZIP_MAGIC):
        unpacker = zlib.decompressobj(31)
        try:
            data = unpacker.decompress(data, LARGEST_RR)
        except zlib.error as error:
            raise build_damage_error(path, KIND, error) from error
        if not unpacker.eof:
            raise build_damage_error(path, KIND, f"it is cut short, or unpacks to more than {LARGEST_RR >> 20} MB")
    if not data.startswith(RR_MAGIC):
        raise InputError(f"{path}: is no map of Roborock (it does not start with rr); check the file's suffix")
    return parse_roborock_map(path, data)


def parse_roborock_map(path: Path, data: bytes) -> RobotMap:
    """Parse the walls, the floor and the robot's own rooms of a map file of Roborock, unpacked.

    Raises:
        InputError: it is damaged, or shows nothing.
    """
    if len(data) < RR_HEAD.size:
        raise build_damage_error(path, KIND, "its header is cut short")
    at = RR_HEAD.unpack_from(data)[0]
    while at + RR_BLOCK.size <= len(data):
        kind, head, length = RR_BLOCK.unpack_from(data, at)
        if head < RR_BLOCK.size or at + head + length > len(data):
            raise build_damage_error(path, KIND, f"a block of {length:,} bytes at {at:,}")
        if kind == RR_IMAGE:
            if head < RR_BLOCK.size + 16:
                raise build_damage_error(path, KIND, "a picture without its size")
            top, left, height, width = struct.unpack_from("<4i", data, at + head - 16)
            if min(height, width) <= 0 or height * width != length or max(abs(top), abs(left)) > grid.PIXELS:
                raise build_damage_error(path, KIND, f"a picture of {width} by {height} pixels in {length:,} bytes")
            pixels = np.frombuffer(data, np.uint8, length, at + head).reshape(height, width)
            return _build_roborock_map(path, pixels, (left, top))
        at += head + length
        if kind == RR_DIGEST:
            break
    raise InputError(f"{path}: shows neither floor nor walls; let the robot drive first")


def _build_roborock_map(path: Path, pixels: Array, corner: tuple[int, int]) -> RobotMap:
    """Build the map of a picture whose lowest three bits say what a pixel is, 1 wall and others floor, and the upper five which
    room."""
    low = pixels & 7
    walls, segment = (low == 1) | ((low == 0) & (pixels > 0)), np.where(low == 7, pixels >> 3, 0)
    free = (pixels > 0) & ~walls
    if not free.any() and not walls.any():
        raise InputError(f"{path}: shows neither floor nor walls; let the robot drive first")
    numbers = np.unique(segment[(segment > 0) & (segment < LARGEST_SEGMENT)])
    rooms = np.where(np.isin(segment, numbers), np.searchsorted(numbers, segment) + 1, 0).astype(np.int32)
    return RobotMap(walls, free, rooms, ("",) * len(numbers), RR_PIXEL, np.array(corner) * RR_PIXEL)


def _parse_rand256_map(path: Path, about: Mapping[str, Any]) -> RobotMap:
    """Parse the same of Valetudo RE, whose rows are counted from the top."""
    image = about["image"]
    sizes: list[Any] = [image["dimensions"].get(side) for side in ("height", "width")]
    corner: list[Any] = [(image.get("position") or {}).get(side) for side in ("left", "top")]
    if (
        not all(isinstance(v, int) and 0 <= v <= grid.PIXELS for v in (*sizes, *corner))
        or not 0 < sizes[0] * sizes[1] <= grid.PIXELS
    ):
        raise build_damage_error(path, KIND, f"a picture of {sizes[1]} by {sizes[0]} pixels at {corner}")
    height, width = sizes
    picture = np.zeros(height * width, np.uint8)
    listed = image["pixels"]
    for name, value in (("floor", 255), ("obstacle_weak", 1), ("obstacle_strong", 1)):
        picture[_parse_pixels(path, listed.get(name) or [], width, height, name)[0]] = value
    segments = listed.get("segments") or []
    parts = segments.items() if isinstance(segments, dict) else [("", segments)]
    for number, part in parts:
        index, above = _parse_pixels(path, part, width, height, "segments")
        room = above if not str(number).isdigit() else np.full(len(index), min(int(number), LARGEST_SEGMENT))
        picture[index] = (room.clip(0, LARGEST_SEGMENT).astype(np.uint8) << 3) | 7
    top = RR_SIDE - corner[1] - height
    return _build_roborock_map(path, np.flipud(picture.reshape(height, width)), (corner[0], top))


def _parse_pixels(path: Path, listed: Any, width: int, height: int, name: str) -> tuple[Array, Array]:
    """Return the numbers of pixels of a list of pairs x, y, or of whole numbers; and what is packed above these."""
    try:
        values = np.array(listed)
    except ValueError as error:
        raise build_damage_error(path, KIND, f"pixels of {name} are no numbers") from error
    if not values.size:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    if (
        not np.issubdtype(values.dtype, np.integer)
        or values.min() < 0
        or values.ndim > 2
        or (values.ndim == 2 and values.shape[1] != 2)
    ):
        raise build_damage_error(path, KIND, f"pixels of {name} are no list of whole numbers")
    if values.ndim == 2:
        inside = (values < (width, height)).all()
        index, above = values[:, 0] + values[:, 1] * width, np.zeros(len(values), np.int64)
    else:
        index, above = values & ((1 << SEGMENT_SHIFT) - 1), values >> SEGMENT_SHIFT
        inside = index.max() < width * height
    if not inside:
        raise build_damage_error(path, KIND, f"pixels of {name} lie outside of the picture")
    return index.astype(np.int64), above.astype(np.int64)
