"""Chunks of bags, unpacked within limits: a few bytes of zstd, lz4 or bz2 can promise any number of zeros.

The library unpacks without any. `limit_unpacking` puts functions with limits in the place of its own; it is for the process that
reads one bag and does nothing else (`topomerge.io.subprocess_reader`).
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

MODEST_CHUNK, CHUNK_RATIO = 64 << 20, 200  # bytes that any chunk may have, and times that a larger one may have shrunk
LARGEST_CHUNK = 1 << 30  # bytes
MODEST_BAG, BAG_RATIO = 64 << 20, 1000  # likewise of all chunks together, each time that the bag is gone through
PART = 1 << 20  # bytes that are unpacked at a time


class UnpackingError(ValueError):
    """A chunk has more bytes than a recording of its size."""


class Unpacking:
    """What may still be unpacked of a bag of so many bytes; `restart` when it is gone through once more."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.restart()

    def restart(self) -> None:
        """From here on the chunks are unpacked once more."""
        self.left = MODEST_BAG + BAG_RATIO * self.size

    def unpack(self, start: Callable[[], Any], data: bytes) -> bytes:
        """The bytes of a chunk.

        Args:
            start: makes a decompressor with `decompress(data, max_length)`, `eof` and `unused_data`.
            data: the packed bytes; several frames may follow each other.

        Raises:
            UnpackingError: there would be too many.
            EOFError: they end within a frame.
        """
        most = min(max(MODEST_CHUNK, CHUNK_RATIO * len(data)), LARGEST_CHUNK)
        parts: list[bytes] = []
        total = 0
        while data:
            frame = start()
            fed = data
            while not frame.eof:
                part = frame.decompress(fed, PART)
                if not part and not frame.eof and (not fed or getattr(frame, "needs_input", False)):
                    raise EOFError("a compressed chunk is cut short")
                fed = b""
                total += len(part)
                if total > min(most, self.left):
                    kept = "of all chunks" if total <= most else "of it"
                    raise UnpackingError(f"a chunk of {len(data):,} bytes unpacks to more than {total:,}: {kept}, no recording")
                parts.append(part)
            data = frame.unused_data or b""
        self.left -= total
        return b"".join(parts)


def limit_unpacking(size: int) -> Unpacking:
    """Put limits on what the library unpacks in this process.

    Args:
        size: bytes of the bag.
    """
    import lz4.frame
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    budget = Unpacking(size)
    zstd: Any = storage_mcap.zstd

    def zstd_unpack(data: bytes) -> bytes:
        return budget.unpack(zstd.ZstdDecompressor, data)

    def lz4_unpack(data: bytes) -> bytes:
        return budget.unpack(lz4.frame.LZ4FrameDecompressor, data)

    def bz2_unpack(data: bytes) -> bytes:
        return budget.unpack(bz2.BZ2Decompressor, data)

    def zstd_file(stream: IO[bytes], mode: str = "rb") -> _LimitedFile:
        return _LimitedFile(zstd.open(stream, mode), MODEST_BAG + BAG_RATIO * size)

    storage_mcap.DECOMPRESSORS.update(
        lz4=lambda data, promised: lz4_unpack(_promised(data, promised)),
        zstd=lambda data, promised: zstd_unpack(_promised(data, promised)),
    )
    first.decompressors.update(bz2=bz2_unpack, lz4=lz4_unpack)
    vars(second)["zstd"] = SimpleNamespace(decompress=zstd_unpack, open=zstd_file)
    return budget


def bag_size(files: list[Path]) -> int:
    """Bytes of the files of a recording, and of those in the folders among them."""
    return sum(p.stat().st_size for file in files for p in (file.rglob("*") if file.is_dir() else [file]) if p.is_file())


def _promised(data: bytes, promised: int) -> bytes:
    """The data of a chunk whose header promises no more bytes than it may have."""
    if promised > min(max(MODEST_CHUNK, CHUNK_RATIO * len(data)), LARGEST_CHUNK):
        raise UnpackingError(f"a chunk of {len(data):,} bytes promises {promised:,}")
    return data


class _LimitedFile:
    """An unpacked stream that ends with an error after so many bytes."""

    def __init__(self, stream: Any, most: int) -> None:
        self.stream, self.left = stream, most

    def __enter__(self) -> _LimitedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()

    def read(self, count: int = -1) -> bytes:
        """At most so many bytes."""
        data: bytes = self.stream.read(min(count, PART) if count >= 0 else PART)
        self.left -= len(data)
        if self.left < 0:
            raise UnpackingError("a packed file has more bytes than a recording of its size")
        return data
