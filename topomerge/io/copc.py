"""The coarse levels of a COPC file (cloud-optimised LAZ), whose octree says where the points of each node lie.

All levels together are the LAZ file that it is, and read as such (`topomerge.io.las`).
Source: https://copc.io (version 1.0)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.laz_chunks import check_chunk, layers_of
from topomerge.io.octree import MOST_LEVELS, deepest_level
from topomerge.io.options import ReadOptions
from topomerge.io.piece import damaged

COPC_KIND = "a COPC file"
RECORD_AT, RECORD_HEAD = 375, struct.Struct("<2x16sHH32x")  # the first record behind a header of LAS 1.4
COPC_INFO = struct.Struct("<5d2Q")  # centre, half of the cube's edge, spacing of the root, place and size of the first page
ENTRY = struct.Struct("<4iQ2i")  # of a page: level, x, y, z, place, bytes, points (-1: a page)
LARGEST_PAGE = 1 << 26  # bytes
MOST_NODE_POINTS = 1 << 22


@dataclass(frozen=True)
class Octree:
    """Where the hierarchy starts, its bytes, and the distance of the root's points, in the file's unit."""

    place: int
    size: int
    spacing: float


def octree_of(path: Path) -> Octree | None:
    """The octree of a COPC file; None: it is another LAS or LAZ file."""
    with path.open("rb") as stream:
        stream.seek(RECORD_AT)
        data = stream.read(RECORD_HEAD.size + COPC_INFO.size)
    if len(data) < RECORD_HEAD.size + COPC_INFO.size:
        return None
    name, number, _ = RECORD_HEAD.unpack_from(data)
    if name.rstrip(b"\0") != b"copc" or number != 1:
        return None
    *_, spacing, place, size = COPC_INFO.unpack_from(data, RECORD_HEAD.size)
    return Octree(place, size, spacing)


def coarse_records(path: Path, octree: Octree, options: ReadOptions) -> Iterator[tuple[Any, Any, float]]:
    """The header, the records of a node, and the share of the file that is read with it, for each node that is coarse enough.

    Raises:
        InputError: the octree does not fit the file.
    """
    import laspy
    import lazrs

    with path.open("rb") as stream:
        header = laspy.LasHeader.read_from(stream)
        packing = header.vlrs.get("LasZipVlr")
        if not packing:
            raise damaged(path, COPC_KIND, "its points are not compressed")
        record = packing[0].record_data_bytes()
        layers, size, seen = layers_of(record), header.point_format.size, 0
        for place, length, count in _nodes(path, stream, octree, deepest_level(octree.spacing, options)):
            seen += count
            if seen > header.point_count:
                raise damaged(path, COPC_KIND, f"its octree has more points than the {header.point_count:,} of the file")
            stream.seek(place)
            data = stream.read(length)
            check_chunk(path, data, length, layers, size)
            out = np.zeros(count * size, np.uint8)
            lazrs.decompress_points_with_chunk_table(data, record, out, [(count, length)])
            packed = laspy.PackedPointRecord.from_buffer(out, header.point_format)
            rows = laspy.ScaleAwarePointRecord(packed.array, header.point_format, header.scales, header.offsets)
            yield header, rows, seen / header.point_count


def _nodes(path: Path, stream: IO[bytes], octree: Octree, deepest: int) -> Iterator[tuple[int, int, int]]:
    """Place, bytes and points of each node down to a level."""
    whole = left = path.stat().st_size
    pages, seen = [(octree.place, octree.size)], {octree.place}
    while pages:
        place, size = pages.pop()
        if size > LARGEST_PAGE or size % ENTRY.size or place + size > whole:
            raise damaged(path, COPC_KIND, f"a page of {size:,} bytes at {place:,} of {whole:,}")
        left -= size
        stream.seek(place)
        for level, _, _, _, start, length, count in list(ENTRY.iter_unpack(stream.read(size))):
            if not 0 <= level <= MOST_LEVELS or count < -1 or length < 0 or (count and start + length > whole):
                raise damaged(path, COPC_KIND, f"a node of level {level} with {count:,} points and {length:,} bytes at {start:,}")
            if count > MOST_NODE_POINTS:
                raise InputError(f"{path}: has a node of {count:,} points, too many for one; read it without --spacing")
            if level > deepest or count == 0:
                continue
            left -= length if count > 0 else 0
            if left < 0:  # pages and nodes that are named again and again are endless work
                raise damaged(path, COPC_KIND, f"its pages and nodes have more than the {whole:,} bytes of the file")
            if count > 0:
                yield start, length, count
            elif start in seen:
                raise damaged(path, COPC_KIND, f"the page at {start:,} is named twice")
            else:
                seen.add(start)
                pages.append((start, length))
