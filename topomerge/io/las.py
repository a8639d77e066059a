"""LAS and LAZ, read in blocks by laspy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK, Options, Piece, bytes8, cut_short, damaged
from topomerge.types import Array


def read(path: Path, options: Options) -> Iterator[Piece]:
    """Blocks of points with their colours."""
    import laspy

    del options
    _check_head(path)
    done = 0
    with laspy.open(path) as reader:
        header = reader.header
        promised, size = header.point_count, header.point_format.size
        room = path.stat().st_size - header.offset_to_point_data
        if not header.are_points_compressed and promised * size > room:
            raise cut_short(path, max(room, 0) // size, promised)
        colored = {"red", "green", "blue"} <= set(header.point_format.dimension_names)
        for rows in reader.chunk_iterator(BLOCK):
            if not len(rows):
                break
            done += len(rows)
            xyz = np.stack([np.asarray(rows.x), np.asarray(rows.y), np.asarray(rows.z)], axis=1)
            yield Piece(xyz, _colors(rows) if colored else None, done=done / promised)
    if done < promised:
        raise cut_short(path, done, promised)


def _colors(rows: object) -> Array | None:
    values = np.stack([np.asarray(getattr(rows, n)) for n in ("red", "green", "blue")], axis=1)
    return bytes8(values)


def _check_head(path: Path) -> None:
    """What the library would trust: the magic and the number of records before the points."""
    with path.open("rb") as stream:
        head = stream.read(227)
    if head[:4] != b"LASF":
        raise InputError(f"{path}: is not a LAS file (it does not start with LASF); check the file's suffix")
    if len(head) < 227:
        raise damaged(path, "a LAS file", "its header is cut short")
    start, records = int.from_bytes(head[96:100], "little"), int.from_bytes(head[100:104], "little")
    size = path.stat().st_size
    if start > size or records * 54 > size:
        raise damaged(path, "a LAS file", f"{records:,} records before point data at byte {start:,} of {size:,}")
