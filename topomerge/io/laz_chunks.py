"""Chunks of LAZ 1.4, looked at before they are decoded: the decoder allocates what they promise, or ends the process.

A chunk of the newer point formats holds one point as it is, the number of points, and the bytes of each layer of fields.
Source: Isenburg, "LASzip: lossless compression of LiDAR data", 2013, and its specification for point formats 6 to 10.
"""

from __future__ import annotations

import struct
from pathlib import Path

from topomerge.io.piece import damaged

LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of fields: a point, colours, colours and near infrared, waves; extra bytes have one each
EXTRA_BYTES = 14
ITEM = struct.Struct("<3H")  # kind, size and version of fields
ITEMS_AT = 32  # of the record of the compression


def layers_of(record: bytes) -> int:
    """How many layers a chunk has; 0 for point formats that have none.

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
        head: its first bytes, `head_size` of them at least.
        length: its bytes.
        layers: of it.
        point: bytes of a point that is not compressed.
    """
    size = head_size(layers, point)
    promised = sum(struct.unpack_from(f"<{layers}I", head, point + 4)) + size if len(head) >= size else size
    if promised > length:
        raise damaged(path, "a LAZ file", f"a chunk of {length:,} bytes promises {promised:,}")


def head_size(layers: int, point: int) -> int:
    """Bytes before the first layer."""
    return point + 4 + 4 * layers
