"""Read LAS and LAZ files, COPC included."""

from __future__ import annotations

import logging
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import (
    BLOCK_POINTS,
    MOST_LEVELS,
    Piece,
    ReadOptions,
    build_damage_error,
    build_truncation_error,
    check_node,
    compute_deepest_level,
    convert_to_uint8,
    read_head,
)
from topomerge.types import Array

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of fields: a point, colours, colours and near infrared, waves; extra bytes have one each
EXTRA_BYTES = 14
ITEM = struct.Struct("<3H")  # kind, size and version of fields
ITEMS_AT = 32  # of the record of the compression


def count_layers(record: bytes) -> int:
    """Count the layers of a chunk; 0 for point formats that have none.

    Args:
        record: the data of the file's record of its compression.
    """
    (count,) = struct.unpack_from("<H", record, ITEMS_AT)
    items = [ITEM.unpack_from(record, ITEMS_AT + 2 + k * ITEM.size) for k in range(count)]
    if not items or items[0][0] not in LAYERS:
        return 0
    return sum(size if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, size, _ in items)


def check_chunk(path: Path, head: bytes, length: int, layers: int, point: int) -> None:
    """Refuse a chunk whose layers promise more bytes than it has.

    Args:
        head: its first bytes, `compute_head_size` of them at least.
        length: its bytes.
        layers: of it.
        point: bytes of a point that is not compressed.
    """
    size = compute_head_size(layers, point)
    promised = sum(struct.unpack_from(f"<{layers}I", head, point + 4)) + size if len(head) >= size else size
    if promised > length:
        raise build_damage_error(path, "a LAZ file", f"a chunk of {length:,} bytes promises {promised:,}")


def compute_head_size(layers: int, point: int) -> int:
    """Compute the number of bytes before the first layer."""
    return point + 4 + 4 * layers


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


def read_octree(path: Path) -> Octree | None:
    """Read the octree of a COPC file; None: it is another LAS or LAZ file."""
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


def iter_coarse_records(path: Path, octree: Octree, options: ReadOptions) -> Iterator[tuple[Any, Any, float]]:
    """Yield the header, the records of a node, and the share of the file that is read with it, for each node that is coarse
    enough.

    Raises:
        InputError: the octree does not fit the file.
    """
    import laspy
    import lazrs

    with path.open("rb") as stream:
        header = laspy.LasHeader.read_from(stream)
        packing = header.vlrs.get("LasZipVlr")
        if not packing:
            raise build_damage_error(path, COPC_KIND, "its points are not compressed")
        record = packing[0].record_data_bytes()
        layers, size, seen = count_layers(record), header.point_format.size, 0
        for place, length, count in _iter_nodes(path, stream, octree, compute_deepest_level(octree.spacing, options)):
            seen += count
            if seen > header.point_count:
                raise build_damage_error(
                    path, COPC_KIND, f"its octree has more points than the {header.point_count:,} of the file"
                )
            stream.seek(place)
            data = stream.read(length)
            check_chunk(path, data, length, layers, size)
            out = np.zeros(count * size, np.uint8)
            lazrs.decompress_points_with_chunk_table(data, record, out, [(count, length)], _select_fields().to_lazrs())
            yield header, _build_rows(out, header), seen / header.point_count


def _iter_nodes(path: Path, stream: IO[bytes], octree: Octree, deepest: int) -> Iterator[tuple[int, int, int]]:
    """Yield the place, bytes and points of each node down to a level."""
    whole = left = path.stat().st_size
    pages, seen = [(octree.place, octree.size)], {octree.place}
    while pages:
        place, size = pages.pop()
        if size > LARGEST_PAGE or size % ENTRY.size or place + size > whole:
            raise build_damage_error(path, COPC_KIND, f"a page of {size:,} bytes at {place:,} of {whole:,}")
        left -= size
        stream.seek(place)
        for level, _, _, _, start, length, count in list(ENTRY.iter_unpack(stream.read(size))):
            if not 0 <= level <= MOST_LEVELS or count < -1 or length < 0 or (count and start + length > whole):
                raise build_damage_error(
                    path, COPC_KIND, f"a node of level {level} with {count:,} points and {length:,} bytes at {start:,}"
                )
            if count > MOST_NODE_POINTS:
                raise InputError(f"{path}: has a node of {count:,} points, too many for one; read it without --spacing")
            if level > deepest or count == 0:
                continue
            left -= length if count > 0 else 0
            if left < 0:  # pages and nodes that are named again and again are endless work
                raise build_damage_error(path, COPC_KIND, f"its pages and nodes have more than the {whole:,} bytes of the file")
            if count > 0:
                yield start, length, count
            elif start in seen:
                raise build_damage_error(path, COPC_KIND, f"the page at {start:,} is named twice")
            else:
                seen.add(start)
                pages.append((start, length))


LAST_STANDARD_CLASS = 22  # of ASPRS, LAS 1.4 R15: temporal exclusion; users define their own from 64 on
LASZIP = b"laszip encoded"
CHUNKED = (2, 3)  # kinds of compression whose chunks do not depend on each other: point by point, and in layers
_unpacking: dict[str, int] = {}  # the process whose chunks the decoder's threads unpack
LEAST_UNPACKED = 1 << 16  # points of a file, below which threads are not worth it
LARGEST_HEAD = 64 << 20  # bytes searched for the record of the compression
MOST_POINTS_A_BYTE = 200  # of a packed file: equal points pack that well, and no scan does
SMALLEST_CHUNK = 20  # bytes: a compressed chunk starts with one point as it is


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of points with their colours; of a COPC file, those of the levels that are coarse enough for `spacing`."""
    octree = None if options.spacing is None else read_octree(path)
    if octree is not None:
        _check_head(path)
    blocks = records(path, _select_fields()) if octree is None else iter_coarse_records(path, octree, options)
    for header, rows, done in blocks:
        colored = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
        bright = np.asarray(rows.intensity, np.float32)
        colors, classes = _convert_colors(rows) if colored else None, _convert_classes(rows)
        yield Piece(get_coordinates(rows), colors, done=done, intensities=bright, classes=classes)


def read_las_node(path: Path, promised: int, options: ReadOptions) -> Iterator[Piece]:
    """Read the points of a node that is a LAS or LAZ file.

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
        raise build_damage_error(path, "a node of an octree", error) from error
    if count < promised:
        raise build_truncation_error(path, count, promised)


def _select_fields() -> Any:
    """Select the fields of a cloud; other layers of a packed file are not unpacked, where it has layers."""
    from laspy import DecompressionSelection

    return DecompressionSelection.base().decompress_z().decompress_classification().decompress_intensity().decompress_rgb()


def _build_rows(data: Array, header: Any) -> Any:
    """Return the records of unpacked bytes."""
    import laspy

    packed = laspy.PackedPointRecord.from_buffer(data, header.point_format)
    return laspy.ScaleAwarePointRecord(packed.array, header.point_format, header.scales, header.offsets)


def records(path: Path, fields: Any = None) -> Iterator[tuple[Any, Any, float]]:
    """Yield the header, a block of records, and the share of the file that is read with it.

    Args:
        path: of the file.
        fields: a `laspy.DecompressionSelection` of those that are unpacked, where the others can be passed over; None: all.
    """
    import laspy

    logging.getLogger("laspy").setLevel(logging.CRITICAL)  # it logs what it also raises
    _check_head(path)
    done = 0
    fields = laspy.DecompressionSelection.all() if fields is None else fields
    # laspy's parallel decoder believes the table of chunks and ends the process where a damaged one asks for too much memory.
    # Records behind the points may be promised by the thousand million; nothing in them is needed.
    backend = [laspy.LazBackend.Lazrs]
    with laspy.open(path, laz_backend=backend, read_evlrs=False, decompression_selection=fields) as reader:
        header = reader.header
        promised, size = header.point_count, header.point_format.size
        room = path.stat().st_size - header.offset_to_point_data
        if not header.are_points_compressed and promised * size > room:
            raise build_truncation_error(path, max(room, 0) // size, promised)
        if promised > MOST_POINTS_A_BYTE * max(room, 0):
            raise build_damage_error(path, "a LAZ file", f"it promises {promised:,} points in {max(room, 0):,} bytes")
        chunks = _list_chunks(path, header) if header.are_points_compressed else []
        for rows in _iter_unpacked(path, header, chunks, fields) if chunks else reader.chunk_iterator(BLOCK_POINTS):
            if not len(rows):
                break
            done += len(rows)
            yield header, rows, done / promised
    if done < promised:
        raise build_truncation_error(path, done, promised)


def _list_chunks(path: Path, header: Any) -> list[tuple[int, int]]:
    """List the points and bytes of each chunk, one behind the other in the file; none where they do not add up, or cannot be
    unpacked side by side: then they are unpacked one by one, as far as they are whole."""
    import lazrs

    record = header.vlrs.get("LasZipVlr")[0].record_data_bytes()
    (kind,) = struct.unpack_from("<H", record)
    if kind not in CHUNKED or header.point_count <= LEAST_UNPACKED:
        return []
    with path.open("rb") as stream:
        stream.seek(header.offset_to_point_data)
        chunks = [(count, length) for count, length in lazrs.read_chunk_table(stream, lazrs.LazVlr(record)) if length]
    if not chunks:
        return []
    most, length = chunks[-1]  # of chunks of one size, the table promises too much of the last
    last = header.point_count - sum(count for count, _ in chunks[:-1])
    chunks[-1] = (last, length)
    fits = last <= most and header.offset_to_point_data + 8 + sum(length for _, length in chunks) <= path.stat().st_size
    return chunks if fits and all(0 < count <= BLOCK_POINTS for count, _ in chunks) else []


def _iter_unpacked(path: Path, header: Any, chunks: Sequence[tuple[int, int]], fields: Any) -> Iterator[Any]:
    """Yield blocks of records, of `BLOCK_POINTS` each as from one decoder, of which the chunks are unpacked side by side."""
    import lazrs

    record, size = header.vlrs.get("LasZipVlr")[0].record_data_bytes(), header.point_format.size
    rest = np.empty(0, np.uint8)
    with path.open("rb") as stream:
        stream.seek(header.offset_to_point_data + 8)
        for batch in _group_chunks(chunks):
            data = stream.read(sum(length for _, length in batch))
            out = np.zeros(sum(count for count, _ in batch) * size, np.uint8)
            lazrs.decompress_points_with_chunk_table(data, record, out, batch, fields.to_lazrs())
            rest = np.concatenate([rest, out])
            while len(rest) >= BLOCK_POINTS * size:
                yield _build_rows(rest[: BLOCK_POINTS * size], header)
                rest = rest[BLOCK_POINTS * size :]
    if len(rest):
        yield _build_rows(rest, header)


def _group_chunks(chunks: Sequence[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    """Yield as many chunks at a time as a block has points, or one: the decoder's threads do not survive a fork, and one chunk is
    unpacked without them."""
    _unpacking.setdefault("process", os.getpid())
    together = BLOCK_POINTS if _unpacking["process"] == os.getpid() else 0
    batch: list[tuple[int, int]] = []
    for chunk in chunks:
        if batch and sum(count for count, _ in batch) + chunk[0] > together:
            yield batch
            batch = []
        batch.append(chunk)
    yield batch


def get_coordinates(rows: Any) -> Array:
    """Return (n, 3) float64 of records, in the file's frame and unit."""
    return np.stack([np.asarray(rows.x), np.asarray(rows.y), np.asarray(rows.z)], axis=1)


def _convert_classes(rows: Any) -> Array | None:
    """Return (n,) int32 classes beyond those of the standard (ground, buildings, noise and such), -1 of others; None: there are
    none."""
    classes = np.asarray(rows.classification, np.int32)
    return np.where(classes > LAST_STANDARD_CLASS, classes, -1) if int(classes.max(initial=0)) > LAST_STANDARD_CLASS else None


def _convert_colors(rows: object) -> Array | None:
    values = np.stack([np.asarray(getattr(rows, n)) for n in ("red", "green", "blue")], axis=1)
    return convert_to_uint8(values)


def _check_head(path: Path) -> None:
    """Check what the library would trust: the magic and the number of records before the points."""
    head = read_head(path, "a LAS file", b"LASF", 227)
    start, records = int.from_bytes(head[96:100], "little"), int.from_bytes(head[100:104], "little")
    size = path.stat().st_size
    if start > size or records * 54 > size:
        raise build_damage_error(path, "a LAS file", f"{records:,} records before point data at byte {start:,} of {size:,}")
    if head[104] & 0x80:  # compressed
        _check_table(path, start, size)
        record = _check_items(path, start, int.from_bytes(head[105:107], "little"))
        _check_chunks(path, start, record, int.from_bytes(head[105:107], "little"))


def _check_items(path: Path, start: int, record: int) -> bytes:
    """Return the record of the compression, once it is checked.

    Raises:
        InputError: its fields don't add up to a point of `record` bytes; the decoder would allocate them.
    """
    with path.open("rb") as stream:
        before = stream.read(min(start, LARGEST_HEAD))
    at = before.find(LASZIP) + 52  # of the record's data: the name stands 2 bytes into a record head of 54
    count = int.from_bytes(before[at + 32 : at + 34], "little")
    items = before[at + 34 : at + 34 + 6 * count]  # kind, size and version of two bytes each
    if at < 52 or len(items) < 6 * count or sum(struct.unpack("<" + "2xH2x" * count, items)) != record:
        raise build_damage_error(path, "a LAZ file", f"its fields do not add up to {record} bytes")
    return before[at : at + 34 + 6 * count]


def _check_chunks(path: Path, start: int, record: bytes, point: int) -> None:
    """Refuse a LAZ file in which the layers of a chunk promise more bytes than the chunk has."""
    import lazrs

    layers, size = count_layers(record), path.stat().st_size
    if not layers:
        return
    at = start + 8
    with path.open("rb") as stream:
        stream.seek(start)
        for count, length in lazrs.read_chunk_table(stream, lazrs.LazVlr(record)):
            if not count and not length:  # some writers end with an empty one
                continue
            if at + length > size:
                raise build_damage_error(path, "a LAZ file", f"a chunk of {length:,} bytes at byte {at:,} of {size:,}")
            stream.seek(at)
            check_chunk(path, stream.read(compute_head_size(layers, point)), length, layers, point)
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
        raise build_damage_error(path, "a LAZ file", f"table of {chunks:,} chunks at byte {at:,} of {size:,}")
