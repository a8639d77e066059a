"""LAZ files, whose chunks are unpacked side by side: the same points as one by one, in the same blocks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("laspy")

import laspy
import lazrs

from tests.io.test_read_folders import refusal_of
from topomerge.io import las, read_points

POINTS, CHUNK = 120_000, 50_000  # of the file; laszip's usual chunk
BLOCK = 70_000


def write_laz(path: Path, kind: int) -> Path:
    """A file of three chunks, of a kind of points with layers (7) or without (3)."""
    header = laspy.LasHeader(point_format=kind, version="1.4" if kind > 5 else "1.2")
    header.scales = [1e-3] * 3
    cloud, rng = laspy.LasData(header), np.random.default_rng(kind)
    cloud.x, cloud.y, cloud.z = rng.uniform(0, [[20], [10], [3]], (3, POINTS))
    for name in ("red", "green", "blue", "intensity", "classification", "gps_time", "user_data"):
        cloud[name] = rng.integers(0, 18, POINTS)
    cloud.write(str(path))
    return path


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """Points of each chunk that was unpacked, of those together."""
    seen: list[list[int]] = []
    unpack = lazrs.decompress_points_with_chunk_table

    def note(data: bytes, record: bytes, out: np.ndarray, chunks: list[tuple[int, int]], *rest: Any) -> None:
        seen.append([count for count, _ in chunks])
        unpack(data, record, out, chunks, *rest)

    monkeypatch.setattr(lazrs, "decompress_points_with_chunk_table", note)
    return seen


def read_one_by_one(path: Path) -> Iterator[np.ndarray]:
    with laspy.open(path, laz_backend=[laspy.LazBackend.Lazrs]) as reader:
        for rows in reader.chunk_iterator(BLOCK):
            yield rows.array


@pytest.mark.parametrize("kind", [3, 7])
@pytest.mark.parametrize("process", [None, -1], ids=["first", "forked"])
def test_chunks_are_unpacked_side_by_side(
    tmp_path: Path, batches: list[list[int]], monkeypatch: pytest.MonkeyPatch, kind: int, process: int | None
) -> None:
    monkeypatch.setattr(las, "BLOCK_POINTS", BLOCK)
    monkeypatch.setattr(las, "_unpacking", {} if process is None else {"process": process})
    path = write_laz(tmp_path / "a.laz", kind)
    blocks = [(rows.array, done) for _, rows, done in las.records(path)]
    one_by_one = list(read_one_by_one(path))
    assert [len(rows) for rows, _ in blocks] == [BLOCK, POINTS - BLOCK] and blocks[-1][1] == 1.0
    assert all((rows == other).all() for (rows, _), other in zip(blocks, one_by_one, strict=True))
    # two chunks do not fit into a block; a process that was forked of one with the decoder's threads has none
    assert batches == [[CHUNK], [CHUNK, POINTS - 2 * CHUNK]] if process is None else [[CHUNK], [CHUNK], [POINTS - 2 * CHUNK]]


def test_layers_that_nobody_looks_at_are_passed_over(tmp_path: Path) -> None:
    path = write_laz(tmp_path / "a.laz", 7)
    (whole,), (part,) = ([rows for _, rows, _ in las.records(path, fields)] for fields in (None, las._select_fields()))
    for name in ("X", "Y", "Z", "red", "green", "blue", "intensity", "classification"):
        assert (whole[name] == part[name]).all() and whole[name].any()
    assert len(np.unique(whole["gps_time"])) == 18 and len(np.unique(part["gps_time"])) <= 3  # those of each first point


def test_chunks_that_do_not_add_up_are_read_one_by_one(tmp_path: Path, batches: list[list[int]]) -> None:
    path = write_laz(tmp_path / "a.laz", 3)
    assert len(read_points(path).points) == POINTS and len(batches) == 1
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, 2 * POINTS)  # points of a header of LAS 1.2
    path.write_bytes(data)
    batches.clear()
    assert "damaged" in refusal_of(path) and not batches
