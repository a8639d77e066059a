"""PLY: ascii and binary of either byte order, as clouds (mapped, in blocks) or as meshes (sampled).

Source: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io import text
from topomerge.io.piece import (
    BLOCK_POINTS,
    Piece,
    ReadOptions,
    build_damage_error,
    build_truncation_error,
    convert_to_float32,
    convert_to_uint8,
)
from topomerge.types import Array

LONGEST_HEADER = 1 << 20  # bytes
PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
INTENSITY_NAMES = ("intensity", "scalar_intensity", "reflectance", "scalar_reflectance")
CLASS_NAMES = ("label", "class", "classification", "semantic", "semantics", "sem_class", "category", "class_id", "label_id")
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Element:
    """An element of a PLY header: properties as (name, type code), a list's as (name, None)."""

    name: str
    count: int
    properties: list[tuple[str, str | None]]

    @property
    def fixed(self) -> bool:
        """Do all rows have the same length?"""
        return all(kind is not None for _, kind in self.properties)

    def build_dtype(self, order: str) -> np.dtype:
        """Build type of a binary row."""
        return np.dtype([(name, order + str(kind)) for name, kind in self.properties])

    def compute_min_row_size(self) -> int:
        """Compute the bytes that a row needs at least, binary or ascii."""
        return max(len(self.properties), 1)


@dataclass(frozen=True)
class Header:
    """The header of a PLY file; `start` is the offset of the first row."""

    order: str  # "", "<" or ">"
    elements: list[Element]
    start: int
    lines: int

    def find(self, name: str) -> Element | None:
        """Find the element of that name."""
        return next((e for e in self.elements if e.name == name), None)


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of vertices, and where there are faces points sampled on them."""
    header = read_header(path)
    vertex, face = header.find("vertex"), header.find("face")
    if vertex is None or not {"x", "y", "z"} <= {n for n, k in vertex.properties if k}:
        raise InputError(f"{path}: has no vertices with x, y and z; export it as a point cloud")
    size = path.stat().st_size
    for element in header.elements:
        if element.count * element.compute_min_row_size() > size - header.start:
            have = 0  # of others than the first one nobody knows where they begin or end
            if element is header.elements[0] and not header.order:
                with path.open("rb") as stream:
                    have = sum(1 for _ in stream) - header.lines
            elif element is header.elements[0] and element.fixed:
                have = (size - header.start) // max(element.build_dtype(header.order).itemsize, 1)
            raise build_truncation_error(path, have, element.count, f"rows of {element.name}")
    before = header.elements[: header.elements.index(vertex)]
    if (face is not None and face.count) or not all(e.fixed for e in (*before, vertex)):
        yield from _read_whole(path, options)
    elif header.order:
        yield from _read_binary(path, header, before, vertex)
    else:
        yield from _read_ascii(path, header, before, vertex)


def read_header(path: Path) -> Header:
    """Read the header of a PLY file.

    Raises:
        InputError: it is not one.
    """
    with path.open("rb") as stream:
        head = stream.read(LONGEST_HEADER)
    if head[:3] != b"ply":
        raise InputError(f"{path}: is not a PLY file (its first line is not 'ply'); check the file's suffix")
    end = re.search(rb"(?m)^end_header[ \t]*(\r\n|\n|\r)", head)
    if end is None:
        raise InputError(f"{path}: its PLY header has no end; the file is cut short or damaged, copy it again")
    lines = head[: end.end()].decode("latin-1").splitlines()
    order: str | None = None
    elements: list[Element] = []
    for fields in (line.split() for line in lines[1:-1]):
        try:
            if fields[:1] == ["format"]:
                order = ORDERS[fields[1]]
            elif fields[:1] == ["element"]:
                elements.append(Element(fields[1], int(fields[2]), []))
            elif fields[:1] == ["property"]:
                is_list = fields[1] == "list"
                elements[-1].properties.append((fields[-1], None if is_list else PLY_TYPES[fields[1]]))
        except (KeyError, IndexError, ValueError) as error:
            raise build_damage_error(path, "a PLY file", f"header line {' '.join(fields)!r}") from error
    if order is None or any(e.count < 0 or len({n for n, _ in e.properties}) < len(e.properties) for e in elements):
        raise build_damage_error(path, "a PLY file", "no format line, a negative count or a property named twice")
    return Header(order, elements, end.end(), len(lines))


def find_color_names(names: list[str]) -> tuple[str, ...]:
    """Find the names of the colour channels, or none."""
    return next((c for c in text.COLOR_COLUMNS if all(n in names for n in c)), ())


def find_intensity_name(names: list[str]) -> str:
    """Find the name of the intensity, or none."""
    return next((n for n in names if n.lower() in INTENSITY_NAMES), "")


def find_class_name(names: list[str]) -> str:
    """Find the name of the field that says what a point lies on, or none."""
    return next((n for n in names if n.lower().removeprefix("scalar_") in CLASS_NAMES), "")


def convert_to_classes(values: Array) -> Array:
    """Return (n,) int32 classes; -1 where the value is no whole number from 0 on."""
    numbers = np.nan_to_num(np.asarray(values, np.float64), nan=-1.0, posinf=-1.0, neginf=-1.0)
    whole = (numbers >= 0) & (numbers < 1 << 31) & (numbers == np.rint(numbers))
    return np.where(whole, numbers, -1).astype(np.int32)


def _read_binary(path: Path, header: Header, before: list[Element], vertex: Element) -> Iterator[Piece]:
    dtype = vertex.build_dtype(header.order)
    start = header.start + sum(e.count * e.build_dtype(header.order).itemsize for e in before)
    have = max(path.stat().st_size - start, 0) // dtype.itemsize
    if have < vertex.count:
        raise build_truncation_error(path, have, vertex.count)
    if not vertex.count:
        return
    rows = np.memmap(path, dtype, "r", start, (vertex.count,))
    names = [n for n, _ in vertex.properties]
    colors, shade, kind = find_color_names(names), find_intensity_name(names), find_class_name(names)
    for first in range(0, vertex.count, BLOCK_POINTS):
        block = rows[first : first + BLOCK_POINTS]
        done = (first + len(block)) / vertex.count
        bright = convert_to_float32(block[shade]) if shade else None
        classes = convert_to_classes(block[kind]) if kind else None
        points = _stack_columns(block, ("x", "y", "z"))
        yield Piece(points, _stack_colors(block, colors), done=done, intensities=bright, classes=classes)


def _stack_columns(rows: Array, names: tuple[str, ...]) -> Array:
    """Return (n, 3) from three columns of a structured array, in the machine's byte order."""
    kind = np.result_type(*(rows.dtype[n] for n in names)).newbyteorder("=")
    out = np.empty((len(rows), len(names)), kind)
    for i, name in enumerate(names):
        out[:, i] = rows[name]
    return out


def _stack_colors(rows: Array, names: tuple[str, ...]) -> Array | None:
    return convert_to_uint8(_stack_columns(rows, names)) if names else None


def _read_ascii(path: Path, header: Header, before: list[Element], vertex: Element) -> Iterator[Piece]:
    names = [n for n, _ in vertex.properties]
    shades, shade, kind = find_color_names(names), find_intensity_name(names), find_class_name(names)
    requested = ("x", "y", "z", *shades, *filter(None, (shade, kind)))
    columns = tuple(names.index(n) for n in requested)
    count = 0
    with path.open(encoding="latin-1") as stream:
        skip = header.lines + sum(e.count for e in before)
        lines = itertools.islice(stream, skip + vertex.count)
        for values in text.iter_rows(path, lines, columns, skip=skip):
            count += len(values)
            colors = values[:, 3:6] if shades else None
            bright = convert_to_float32(values[:, requested.index(shade)]) if shade else None
            classes = convert_to_classes(values[:, -1]) if kind else None
            if colors is not None and vertex.properties[columns[3]][1] not in ("f4", "f8"):
                colors = colors.clip(0, 65535).astype(np.int64)
            shown = None if colors is None else convert_to_uint8(colors)
            yield Piece(values[:, :3], shown, done=count / vertex.count, intensities=bright, classes=classes)
    if count < vertex.count:
        raise build_truncation_error(path, count, vertex.count)


def _read_whole(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read files with faces or with lists before the vertices by plyfile, and sample the faces."""
    from plyfile import PlyData, PlyElementParseError, PlyHeaderParseError

    from topomerge.io.mesh import sample

    try:
        try:
            data = PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3, "vertex_index": 3}})
        except (PlyElementParseError, KeyError, ValueError):
            data = PlyData.read(str(path))  # slower: not all faces are triangles
    except (PlyElementParseError, PlyHeaderParseError) as error:
        raise build_damage_error(path, "a PLY file", error) from error
    rows = data["vertex"].data
    vertices = _stack_columns(rows, ("x", "y", "z"))
    colors = _stack_colors(rows, find_color_names(list(rows.dtype.names or ())))
    kind = find_class_name(list(rows.dtype.names or ()))
    yield Piece(vertices, colors, done=0.5, classes=convert_to_classes(rows[kind]) if kind else None)
    faces = data["face"].data if "face" in data else np.empty(0, [("none", "u1")])
    name = next((n for n in ("vertex_indices", "vertex_index") if n in (faces.dtype.names or ())), None)
    if name is not None and len(faces):
        yield from sample(path, vertices, _triangulate(faces[name]), options, colors)


def _triangulate(polygons: Array) -> Array:
    """Return (m, 3) int64 fans of triangles of polygons given as an (n, k) array or an object array of index lists."""
    if polygons.dtype != object:
        return polygons.astype(np.int64)
    by_corners: dict[int, list[Array]] = {}
    for polygon in polygons:
        by_corners.setdefault(len(polygon), []).append(polygon)
    parts = [np.empty((0, 3), np.int64)]
    for corners, same in by_corners.items():
        table = np.array(same, np.int64)
        parts += [table[:, (0, i, i + 1)] for i in range(1, corners - 1)]
    return np.concatenate(parts)
