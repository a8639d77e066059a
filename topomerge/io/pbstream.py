"""States of Cartographer (`.pbstream`): submaps where the pose graph puts them, as walls and floor, or as points in space.

A magic number, then messages of Protocol Buffers, each packed by gzip behind its length. Only their wire format is needed here: a
message is its fields in their order, and what is not known is kept as it is. Source: `cartographer/io/proto_stream.cc` and
`cartographer/mapping/proto/*.proto` of Cartographer 1.0 and 2.0.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from topomerge.errors import InputError
from topomerge.io import grid
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error
from topomerge.io.sightings import clean_text
from topomerge.io.trajectory import UNIT_TOLERANCE, build_pose_matrices
from topomerge.types import Array, Landmarks, build_landmarks, transform_points

KIND = "a state of Cartographer"
MAGIC = (0x7B1D1F7B5BF501DB).to_bytes(8, "little")
VERSIONS = (1, 2)  # of the format; 1 has no histograms of submaps
LARGEST_MESSAGE = 1 << 28  # bytes, unpacked
LARGEST_GROWTH = 200  # times the file, all messages together, and 64 MB
MOST_FIELDS = 1 << 24  # of a message
POSE_GRAPH, OPTIONS, SUBMAP, NODE = 1, 2, 3, 4  # fields of SerializedData
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # kinds of values
OCCUPIED, FREE = 0.55, 0.45  # probability from which on, and up to which, a cell is a wall or floor
LOWEST, HIGHEST, STEPS = 0.1, 0.9, 32766.0  # probability of the values 1 and 32767 of a grid in space
TAG_SIGMA = 0.1  # m
Field = tuple[int, int, "int | bytes"]
Key = tuple[int, int]  # trajectory, and index in it


def parse_message(data: bytes) -> list[Field]:
    """Parse the fields of a message: number, kind, and the value: a whole number of kind 0, else bytes.

    Raises:
        ValueError: it is damaged.
    """
    fields: list[Field] = []
    at, end = 0, len(data)
    while at < end:
        key, at = _parse_varint(data, at)
        number, kind = key >> 3, key & 7
        if number == 0 or len(fields) >= MOST_FIELDS:
            raise ValueError(f"a field {number} of a message")
        if kind == VARINT:
            value, at = _parse_varint(data, at)
            fields.append((number, kind, value))
            continue
        if kind == BYTES:
            length, at = _parse_varint(data, at)
        elif kind in (FIXED64, FIXED32):
            length = 8 if kind == FIXED64 else 4
        else:
            raise ValueError(f"a value of kind {kind}")
        if at + length > end:
            raise ValueError("a message is cut short")
        fields.append((number, kind, data[at : at + length]))
        at += length
    return fields


def _parse_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number is cut short")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value & (1 << 64) - 1, at


def get_message(fields: Sequence[Field], number: int) -> bytes:
    """Return the bytes of a field, the last one as Protocol Buffers has it; none where it is missing."""
    return next((v for n, k, v in reversed(fields) if n == number and isinstance(v, bytes) and k == BYTES), b"")


def get_int(fields: Sequence[Field], number: int) -> int:
    """Return a field of type int32; 0 where it is missing."""
    value = next((v for n, k, v in reversed(fields) if n == number and isinstance(v, int) and k == VARINT), 0)
    return value - (1 << 64) if value >> 63 else value


def get_double(fields: Sequence[Field], number: int) -> float:
    """Return a field of type double or float; 0 where it is missing."""
    data = next((v for n, k, v in reversed(fields) if n == number and isinstance(v, bytes) and k in (FIXED64, FIXED32)), bytes(8))
    return float(struct.unpack("<d" if len(data) == 8 else "<f", data)[0])


def get_packed(fields: Sequence[Field], number: int, signed: bool = False) -> Array:
    """Return (n,) int64 of a repeated field of whole numbers, packed or not; `signed`: of type sint32."""
    parts = []
    for n, kind, value in fields:
        if n == number and isinstance(value, bytes) and kind == BYTES:
            parts.append(_parse_varints(value))
        elif n == number and isinstance(value, int):
            parts.append(np.array([value], np.uint64))
    every = np.concatenate(parts) if parts else np.zeros(0, np.uint64)
    if signed:
        return (every >> np.uint64(1)).astype(np.int64) ^ -(every & np.uint64(1)).astype(np.int64)
    return every.astype(np.int64)


def _parse_varints(data: bytes) -> Array:
    """Return (n,) uint64 of whole numbers behind each other."""
    raw = np.frombuffer(data, np.uint8)
    if not len(raw):
        return np.zeros(0, np.uint64)
    last = raw < 0x80
    if not last[-1]:
        raise ValueError("a list of numbers is cut short")
    ends = np.flatnonzero(last)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if (ends - starts).max() > 9:
        raise ValueError("a number of more than ten bytes")
    shifts = (7 * (np.arange(len(raw)) - np.repeat(starts, ends - starts + 1))).astype(np.uint64)
    return np.add.reduceat((raw & 0x7F).astype(np.uint64) << shifts, starts)


def parse_pose(data: bytes) -> Array:
    """Parse (4, 4) of a Rigid3d.

    Raises:
        ValueError: it is no rotation and place.
    """
    fields = parse_message(data)
    place, turn = (parse_message(get_message(fields, number)) for number in (1, 2))
    values = np.array([get_double(place, k) for k in (1, 2, 3)] + [get_double(turn, k) for k in (1, 2, 3, 4)])
    if not np.isfinite(values).all() or abs(float(np.linalg.norm(values[3:])) - 1) > UNIT_TOLERANCE:
        raise ValueError("a pose that is none")
    return np.asarray(build_pose_matrices(values[None, :3], values[None, 3:])[0])


def iter_messages(path: Path) -> Iterator[tuple[bytes, float]]:
    """Yield the messages behind the header, and the share of the file that is read with each.

    Raises:
        InputError: it is no such file, of another version, damaged, or swells suspiciously.
    """
    size = path.stat().st_size
    left = 64 * (1 << 20) + LARGEST_GROWTH * size
    with path.open("rb") as stream:
        if stream.read(8) != MAGIC:
            raise InputError(f"{path}: is not {KIND} (its first eight bytes are others); check the file's suffix")
        for number, data in enumerate(_iter_chunks(path, stream, size)):
            left -= len(data)
            if left < 0:
                raise build_damage_error(path, KIND, f"it unpacks to more than {LARGEST_GROWTH:,} times its bytes")
            if number == 0:
                version = get_int(parse_message(data), 1)
                if version not in VERSIONS:
                    shown = " or ".join(map(str, VERSIONS))
                    raise InputError(f"{path}: is of format {version} of Cartographer, only {shown} is read; migrate it with "
                                     "cartographer_pbstream migrate")  # fmt: skip
                continue
            yield data, stream.tell() / size


def _iter_chunks(path: Path, stream: IO[bytes], size: int) -> Iterator[bytes]:
    while head := stream.read(8):
        length = int.from_bytes(head, "little")
        if len(head) < 8 or length > size - stream.tell():
            raise InputError(f"{path}: ends within a message; it is cut short, save it again")
        unpacker = zlib.decompressobj(31)
        try:
            data = unpacker.decompress(stream.read(length), LARGEST_MESSAGE)
        except zlib.error as error:
            raise build_damage_error(path, KIND, error) from error
        if not unpacker.eof:
            raise build_damage_error(path, KIND, f"a message is cut short, or has more than {LARGEST_MESSAGE >> 20} MB")
        yield data


@dataclass(eq=False)
class PoseGraph:
    """Poses (4, 4) in the map's frame of nodes and submaps, by trajectory and index, pairs of trajectories that constraints
    join, and the places of landmarks."""

    nodes: dict[Key, Array] = field(default_factory=dict)
    submaps: dict[Key, Array] = field(default_factory=dict)
    constraints: int = 0
    joined: set[tuple[int, int]] = field(default_factory=set)
    landmarks: list[tuple[str, Array]] = field(default_factory=list)

    def find_components(self) -> list[set[int]]:
        """Find the sets of trajectories that constraints join, those with most nodes first."""
        groups: list[set[int]] = [{t} for t in sorted({t for t, _ in [*self.nodes, *self.submaps]})]
        for a, b in sorted(self.joined):
            own = [g for g in groups if a in g or b in g]
            groups = [g for g in groups if g not in own] + ([set().union(*own)] if own else [])
        return sorted(groups, key=lambda g: (-sum(t in g for t, _ in self.nodes), min(g)))


def parse_pose_graph(data: bytes) -> PoseGraph:
    """Parse a message PoseGraph.

    Raises:
        ValueError: it is damaged.
    """
    graph = PoseGraph()
    for number, _, value in parse_message(data):
        if not isinstance(value, bytes):
            continue
        if number == 2:
            fields = parse_message(value)
            ends = [get_int(parse_message(get_message(fields, k)), 1) for k in (1, 2)]
            graph.constraints += 1
            graph.joined.add((min(ends), max(ends)))
        elif number == 4:
            fields = parse_message(value)
            trajectory = get_int(fields, 3)
            for kind, _, item in fields:
                if kind in (1, 2) and isinstance(item, bytes):
                    inner = parse_message(item)
                    pose = parse_pose(get_message(inner, 5 if kind == 1 else 1))
                    (graph.nodes if kind == 1 else graph.submaps)[trajectory, get_int(inner, 7 if kind == 1 else 2)] = pose
        elif number == 5:
            fields = parse_message(value)
            place = get_message(fields, 2)
            if place:
                graph.landmarks.append((get_message(fields, 1).decode("utf-8", "replace"), parse_pose(place)))
    return graph


@dataclass(frozen=True, eq=False)
class FlatSubmap:
    """Cells of a submap: probability (ny, nx) of being occupied, nan where unknown; the pose of the grid's frame on the map,
    the corner with the largest x and y, m, and the size of a cell."""

    odds: Array
    pose: Array
    corner: tuple[float, float]
    resolution: float


def parse_flat_submap(data: bytes, pose: Array) -> FlatSubmap:
    """Parse a message Submap2D of which the pose on the map is known.

    Raises:
        ValueError: it is damaged, or its grid is none of probabilities.
    """
    fields = parse_message(data)
    cells = parse_message(get_message(fields, 4))
    limits = parse_message(get_message(cells, 1))
    corner, counts = (parse_message(get_message(limits, number)) for number in (2, 3))
    nx, ny, resolution = get_int(counts, 1), get_int(counts, 2), get_double(limits, 1)
    values = get_packed(cells, 2)
    if any(number == 5 for number, _, _ in cells):
        raise ValueError("its grid holds distances (TSDF), which are not read")
    if min(nx, ny) <= 0 or nx * ny != len(values) or not 1e-3 <= resolution <= 10 or values.min() < 0 or values.max() > 65535:
        raise ValueError(f"a grid of {nx} by {ny} cells with {len(values):,} values")
    low, high = get_double(cells, 6), get_double(cells, 7)
    low, high = (low, high) if high > low else (LOWEST, HIGHEST)
    values = (values & 0x7FFF).reshape(ny, nx)
    odds = np.where(values > 0, 1.0 - (low + (high - low) * (values - 1) / STEPS), np.nan)
    place = (get_double(corner, 1), get_double(corner, 2))
    if not np.isfinite(place).all():
        raise ValueError("a grid without a corner")
    return FlatSubmap(odds, pose @ np.linalg.inv(parse_pose(get_message(fields, 1))), place, resolution)


def parse_spatial_submap(data: bytes, pose: Array) -> Array:
    """Parse (n, 3) points, the middles of the occupied cells of a message Submap3D on the map.

    Raises:
        ValueError: it is damaged.
    """
    cells = parse_message(get_message(parse_message(data), 4))
    resolution = get_double(cells, 1)
    index = [get_packed(cells, number, signed=True) for number in (3, 4, 5)]
    values = get_packed(cells, 6) & 0x7FFF
    if (
        len({len(values), *map(len, index)}) > 1
        or not 1e-3 <= resolution <= 10
        or any(np.abs(i).max(initial=0) > 1 << 20 for i in index)
    ):
        raise ValueError(f"a grid in space of {len(values):,} cells of {resolution:g} m")
    odds = LOWEST + (HIGHEST - LOWEST) * (values - 1) / STEPS
    return transform_points(pose, np.stack(index, axis=1)[(values > 0) & (odds >= 0.5)] * resolution)


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the submaps of the trajectories that are joined: walls and floor of grids in a plane, points of those in space."""
    graph, kept, warnings = PoseGraph(), set[int](), []
    flat: list[FlatSubmap] = []
    spatial, missing = False, set[Key]()
    try:
        for data, done in iter_messages(path):
            for number, _, value in parse_message(data):
                if number == POSE_GRAPH and isinstance(value, bytes):
                    graph = parse_pose_graph(value)
                    components = graph.find_components()
                    kept = components[0] if components else set()
                    warnings += [_describe_apart(path, part) for part in components[1:]]
                    missing = {key for key in graph.submaps if key[0] in kept}
                elif number == SUBMAP and isinstance(value, bytes):
                    fields = parse_message(value)
                    key = _parse_key(get_message(fields, 1))
                    pose = graph.submaps.get(key)
                    if pose is None or key[0] not in kept:
                        continue
                    missing.discard(key)
                    if get_message(fields, 2):
                        flat.append(parse_flat_submap(get_message(fields, 2), pose))
                        if sum(submap.odds.size for submap in flat) > grid.PIXELS:
                            raise InputError(f"{path}: has submaps of more than {grid.PIXELS:,} cells; it is damaged")
                    elif get_message(fields, 3):
                        spatial = True
                        for block in _split(parse_spatial_submap(get_message(fields, 3), pose)):
                            yield Piece(block, done=0.9 * done)
    except InputError:
        raise
    except ValueError as error:
        raise build_damage_error(path, KIND, error) from error
    if not flat and not spatial:
        raise InputError(f"{path}: holds no submaps with poses; finish the trajectory before it is saved")
    if missing:
        warnings.append(f"{path}: {len(missing):,} of its submaps have no grid; it may be cut short")
    yield Piece(np.empty((0, 3)), warnings=tuple(warnings), landmarks=_build_landmarks(graph, path), done=0.9)
    if flat:
        walls, free, plan = _draw_submaps(path, flat)
        yield from grid.extrude(path, np.flipud(walls), np.flipud(free), plan, options)


def _describe_apart(path: Path, part: set[int]) -> str:
    shown = ", ".join(map(str, sorted(part)))
    return f"{path}: trajectory {shown} is joined with the others by no constraint and is left out; save it alone, and merge it"


def _parse_key(data: bytes) -> Key:
    fields = parse_message(data)
    return get_int(fields, 1), get_int(fields, 2)


def _split(points: Array) -> Iterator[Array]:
    for first in range(0, len(points), BLOCK_POINTS):
        yield points[first : first + BLOCK_POINTS]


def _build_landmarks(graph: PoseGraph, path: Path) -> Landmarks:
    named = [(clean_text(name), pose[:3, 3]) for name, pose in graph.landmarks if clean_text(name)]
    places = np.array([place for _, place in named]).reshape(-1, 3)
    return build_landmarks("tag", [f"cartographer:{name}" for name, _ in named], path.name, places, sigma=TAG_SIGMA)


def _draw_submaps(path: Path, submaps: Sequence[FlatSubmap]) -> tuple[Array, Array, grid.Plan]:
    """Draw the walls and floor (h, w), the lowest row first: each pixel has the mean probability of the submaps that know it."""
    size = min(submap.resolution for submap in submaps)
    corners = np.concatenate([_list_corners(submap) for submap in submaps])
    low = np.floor(corners.min(axis=0) / size) * size - size
    width, height = (np.ceil((corners.max(axis=0) - low) / size).astype(np.int64) + 2).tolist()
    if width * height > grid.PIXELS:
        raise InputError(f"{path}: spans {width:,} by {height:,} cells, more than {grid.PIXELS:,}; it is damaged")
    total, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint16)
    for submap in submaps:
        own = _list_corners(submap)
        first = np.maximum(np.floor((own.min(axis=0) - low) / size).astype(int), 0)
        last = np.minimum(np.ceil((own.max(axis=0) - low) / size).astype(int) + 1, (width, height))
        x, y = np.meshgrid(*(low[k] + (np.arange(first[k], last[k]) + 0.5) * size for k in (0, 1)))
        placed = transform_points(np.linalg.inv(submap.pose), np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
        rows = np.floor((np.array(submap.corner) - placed[:, :2]) / submap.resolution).astype(np.int64)  # along y, then along x
        iy, ix = rows[:, 0], rows[:, 1]
        inside = (ix >= 0) & (iy >= 0) & (ix < submap.odds.shape[1]) & (iy < submap.odds.shape[0])
        odds = np.full(x.size, np.nan)
        odds[inside] = submap.odds[iy[inside], ix[inside]]
        known = np.isfinite(odds).reshape(x.shape)
        box = (slice(first[1], last[1]), slice(first[0], last[0]))
        total[box] += np.where(known, np.nan_to_num(odds).reshape(x.shape), 0)
        count[box] += known
    mean = np.divide(total, count, out=np.full(total.shape, 0.5, np.float32), where=count > 0)
    plan = grid.Plan(path, size, (float(low[0]), float(low[1]), 0.0))
    return mean >= OCCUPIED, mean <= FREE, plan


def _list_corners(submap: FlatSubmap) -> Array:
    """Return (4, 2) m corners of a submap on the map."""
    extent = submap.resolution * np.array(submap.odds.shape)  # along x are the rows
    ends = np.array(submap.corner) - extent * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    return transform_points(submap.pose, np.column_stack([ends, np.zeros(4)]))[:, :2]
