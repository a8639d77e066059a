"""LAS and LAZ, read in blocks by laspy."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.copc import coarse_records, octree_of
from topomerge.io.laz_chunks import check_chunk, head_size, layers_of
from topomerge.io.octree import check_node
from topomerge.io.options import ReadOptions
from topomerge.io.piece import BLOCK_POINTS, Piece, bytes8, cut_short, damaged, read_head
from topomerge.types import Array

LASZIP = b"laszip encoded"
LARGEST_HEAD = 64 << 20  # bytes searched for the record of the compression
MOST_POINTS_A_BYTE = 200  # of a packed file: equal points pack that well, and no scan does
SMALLEST_CHUNK = 20  # bytes: a compressed chunk starts with one point as it is


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Blocks of points with their colours; of a COPC file, those of the levels that are coarse enough for `spacing`."""
    octree = None if options.spacing is None else octree_of(path)
    if octree is not None:
        _check_head(path)
    for header, rows, done in records(path) if octree is None else coarse_records(path, octree, options):
        colored = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
        bright = np.asarray(rows.intensity, np.float32)
        yield Piece(coordinates(rows), _colors(rows) if colored else None, done=done, intensities=bright)


def las_node(path: Path, promised: int, options: ReadOptions) -> Iterator[Piece]:
    """The points of a node that is a LAS or LAZ file.

    Raises:
        InputError: it can't be read, or has fewer points than the hierarchy promises.
    """
    check_node(path)
    count = 0
    try:
        for piece in read(path, replace(options, spacing=None)):
            count += len(piece.points)
            yield replace(piece, done=0.0)
    except (InputError, MemoryError, ImportError, GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # panics of the decoder are no Exception
        raise damaged(path, "a node of an octree", error) from error
    if count < promised:
        raise cut_short(path, count, promised)


def records(path: Path) -> Iterator[tuple[Any, Any, float]]:
    """The header, a block of records with all their dimensions, and the share of the file that is read with it."""
    import laspy

    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs what it also raises
    _check_head(path)
    done = 0
    # The parallel decoder believes the table of chunks and ends the process where a damaged one asks for too much memory.
    # Records behind the points may be promised by the thousand million; nothing in them is needed.
    with laspy.open(path, laz_backend=[laspy.LazBackend.Lazrs], read_evlrs=False) as reader:
        header = reader.header
        promised, size = header.point_count, header.point_format.size
        room = path.stat().st_size - header.offset_to_point_data
        if not header.are_points_compressed and promised * size > room:
            raise cut_short(path, max(room, 0) // size, promised)
        if promised > MOST_POINTS_A_BYTE * max(room, 0):
            raise damaged(path, "a LAZ file", f"it promises {promised:,} points in {max(room, 0):,} bytes")
        for rows in reader.chunk_iterator(BLOCK_POINTS):
            if not len(rows):
                break
            done += len(rows)
            yield header, rows, done / promised
    if done < promised:
        raise cut_short(path, done, promised)


def coordinates(rows: Any) -> Array:
    """(n, 3) float64 of records, in the file's frame and unit."""
    return np.stack([np.asarray(rows.x), np.asarray(rows.y), np.asarray(rows.z)], axis=1)


def _colors(rows: object) -> Array | None:
    values = np.stack([np.asarray(getattr(rows, n)) for n in ("red", "green", "blue")], axis=1)
    return bytes8(values)


def _check_head(path: Path) -> None:
    """What the library would trust: the magic and the number of records before the points."""
    head = read_head(path, "a LAS file", b"LASF", 227)
    start, records = int.from_bytes(head[96:100], "little"), int.from_bytes(head[100:104], "little")
    size = path.stat().st_size
    if start > size or records * 54 > size:
        raise damaged(path, "a LAS file", f"{records:,} records before point data at byte {start:,} of {size:,}")
    if head[104] & 0x80:  # compressed
        _check_table(path, start, size)
        record = _check_items(path, start, int.from_bytes(head[105:107], "little"))
        _check_chunks(path, start, record, int.from_bytes(head[105:107], "little"))


def _check_items(path: Path, start: int, record: int) -> bytes:
    """The record of the compression.

    Raises:
        InputError: its fields don't add up to a point of `record` bytes; the decoder would allocate them.
    """
    with path.open("rb") as stream:
        before = stream.read(min(start, LARGEST_HEAD))
    at = before.find(LASZIP) + 52  # of the record's data: the name stands 2 bytes into a record head of 54
    count = int.from_bytes(before[at + 32 : at + 34], "little")
    items = before[at + 34 : at + 34 + 6 * count]  # kind, size and version of two bytes each
    if at < 52 or len(items) < 6 * count or sum(struct.unpack("<" + "2xH2x" * count, items)) != record:
        raise damaged(path, "a LAZ file", f"its fields do not add up to {record} bytes")
    return before[at : at + 34 + 6 * count]


def _check_chunks(path: Path, start: int, record: bytes, point: int) -> None:
    """Refuse a LAZ file in which the layers of a chunk promise more bytes than the chunk has."""
    import lazrs

    layers, size = layers_of(record), path.stat().st_size
    if not layers:
        return
    at = start + 8
    with path.open("rb") as stream:
        stream.seek(start)
        for count, length in lazrs.read_chunk_table(stream, lazrs.LazVlr(record)):
            if not count and not length:  # some writers end with an empty one
                continue
            if at + length > size:
                raise damaged(path, "a LAZ file", f"a chunk of {length:,} bytes at byte {at:,} of {size:,}")
            stream.seek(at)
            check_chunk(path, stream.read(head_size(layers, point)), length, layers, point)
            at += length


def _check_table(path: Path, start: int, size: int) -> None:
    """Refuse a LAZ file whose table of chunks promises more than the file can hold; the decoder would allocate for it.

    The first 8 bytes of the point data say where the table is, or -1: the last 8 bytes of the file do.
    """
    with path.open("rb") as stream:
        stream.seek(start)
        (at,) = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))
        if at == -1:
            stream.seek(max(size - 8, 0))
            (at,) = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))
        stream.seek(max(at, 0))
        chunks = int.from_bytes(stream.read(8)[4:], "little")
    if not start < at < size or chunks * SMALLEST_CHUNK > size:
        raise damaged(path, "a LAZ file", f"table of {chunks:,} chunks at byte {at:,} of {size:,}")
