"""Small files that promise, or become, absurdly much: refused before memory and time are spent on them."""

from __future__ import annotations

import bz2
import struct
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.scenes_map import building
from topomerge import archive
from topomerge.errors import InputError
from topomerge.io import trajectory
from topomerge.io.maps import load_map, save_map
from topomerge.io.trajectory import SPARE_POSES, read_trajectory

MAGIC = b"\x89MCAP0\r\n"


def record(kind: int, content: bytes) -> bytes:
    return bytes([kind]) + struct.pack("<Q", len(content)) + content


def text(word: bytes) -> bytes:
    return struct.pack("<I", len(word)) + word


def mcap(path: Path, kind: str, unpacked: int, promised: int | None = None) -> Path:
    """One chunk of zeros."""
    zeros = b"\0" * unpacked
    if kind == "lz4":
        packed = pytest.importorskip("lz4.frame").compress(zeros)
    else:
        pytest.importorskip("rosbags")
        from rosbags.rosbag2 import storage_mcap

        packed = storage_mcap.zstd.compress(zeros)
    head = struct.pack("<QQQI", 0, 0, unpacked if promised is None else promised, 0)
    chunk = head + text(kind.encode()) + struct.pack("<Q", len(packed)) + packed
    end = record(15, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0))
    path.write_bytes(MAGIC + record(1, text(b"ros2") + text(b"x")) + record(6, chunk) + end + MAGIC)
    return path


@pytest.mark.parametrize(("kind", "size"), [("lz4", 90 << 20), *list_longer(("zstd", 80 << 20), ("zstd", 300 << 20))])
def test_a_chunk_that_promises_more_than_a_recording(tmp_path: Path, kind: str, size: int) -> None:
    with pytest.raises(InputError, match=rf"a\.mcap: .*a chunk of [\d,]+ bytes promises {size:,}"):
        tm.read_points(mcap(tmp_path / "a.mcap", kind, size))


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_chunk_that_lies_about_its_size(tmp_path: Path, kind: str) -> None:
    with pytest.raises(InputError, match=r"a\.mcap: .*unpacks to more than [68]\d,\d\d\d,\d\d\d"):
        tm.read_points(mcap(tmp_path / "a.mcap", kind, 100 << 20, promised=1 << 20))


def test_unpacking_is_limited_for_all_chunks_together() -> None:
    pytest.importorskip("rosbags")
    from topomerge.io.bag_file import MODEST_BAG, UnpackingBudget, UnpackingError

    packed = bz2.compress(b"\0" * (30 << 20))
    budget = UnpackingBudget(0)
    for _ in range(2):
        assert len(budget.unpack(bz2.BZ2Decompressor, packed)) == 30 << 20
    assert budget.left == MODEST_BAG - (60 << 20)
    with pytest.raises(UnpackingError, match="of all chunks"):
        budget.unpack(bz2.BZ2Decompressor, packed)
    budget.reset()
    assert budget.unpack(bz2.BZ2Decompressor, bz2.compress(b"ab") + bz2.compress(b"cd")) == b"abcd"
    with pytest.raises(EOFError):
        budget.unpack(bz2.BZ2Decompressor, packed[:-20])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: {"rooms": np.zeros(100_000, a["rooms"].dtype)}, r"declares 100,000 rooms, more than 5,000"),
        (lambda a: {"grid_property.x": np.zeros(3_000_000, "<i4")}, r"grid_property\.x has the shape \(3000000,\) for"),
        (lambda a: {"room": np.zeros(3_000_000, "<i4")}, r"room has the shape \(3000000,\) for"),
        (lambda a: {"grid_property.x": np.zeros((len(a["room"]), 90), "u1")}, r"has 90 numbers a cell, more than 64"),
        (lambda a: {"about": np.array(b"{}".ljust(20 << 20))}, r"says more than 16 MB about itself"),
    ],
)
def test_a_map_that_lies_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch, change, said: str) -> None:
    save_map(building(1, 2), tmp_path / "a.tmap")
    arrays = archive.read(tmp_path / "a.tmap")
    padding = {"zz": np.frombuffer(np.random.default_rng(0).bytes(4_000_000), "u1")}  # else the ratio tells
    archive.write({**arrays, **change(arrays), **padding}, tmp_path / "b.tmap", effort=1)
    unpacked = []
    whole = archive._read_array
    monkeypatch.setattr(archive, "_read_array", lambda a, e: unpacked.append(e.filename) or whole(a, e))
    with pytest.raises(InputError, match=rf"b\.tmap: damaged \(.*{said}"):
        load_map(tmp_path / "b.tmap")
    assert unpacked == ["format.npy"]


def test_no_more_poses_are_read_than_scans_can_need(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory, "SPARE_TIMES", 2000)
    monkeypatch.setattr(trajectory, "POSES_PER_SCAN", 100)
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5000 + "no pose\n")
    assert len(read_trajectory(path, scans=3, last=40)) == 41 + SPARE_POSES
    with pytest.raises(InputError, match="line 5001"):
        read_trajectory(path, scans=5000)
    path.write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(2110)))
    with pytest.raises(InputError, match=r"more than 2,100 poses for 1 scans; give the trajectory of these scans"):
        read_trajectory(path, scans=1)
    assert len(read_trajectory(path, scans=2)) == 2110


@pytest.mark.longer
def test_arrays_of_an_archive_are_limited_together(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    big = np.zeros((12_000_000, 3), np.float32)
    np.savez_compressed(path, points=big, poses=np.zeros((10, 4, 4)), rgb=np.zeros((12_000_000, 3), np.float32))
    with pytest.raises(InputError, match="together; refused"):
        tm.read_points(path)


@pytest.mark.data
def test_the_case_of_a_gigabyte_of_zeros(case_dir: Path) -> None:
    with pytest.raises(InputError, match=r"m1\.mcap: .*promises 1,073,741,824"):
        tm.read_points(case_dir / "bombs" / "m1.mcap")
