"""Damaged files of every format: a cloud or an InputError of one line, never anything else, and soon."""

from __future__ import annotations

import io
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.types import PointCloud

SAMPLE_NAMES = (
    *("ascii.ply", "little.ply", "big.ply", "mesh.ply", "ascii.pcd", "binary.pcd", "packed.pcd", "table.xyz", "table.csv"),
    *("array.npz", "array.npy", "cloud.las", "cloud.laz", "cloud.e57", "mesh.obj", "mesh.stl", "mesh.glb", "mesh.gltf"),
    *("tree.bt", "model.ifc", "plan.yaml", "plan.pgm"),
)
SELF_CHECKING = set(SAMPLE_NAMES) - {"table.xyz", "table.csv", "mesh.obj", "plan.yaml"}  # a part of these is a file of its own


def attempt(path: Path, data: bytes) -> PointCloud | None:
    """Read damaged data; None where it was refused in one line that names the file."""
    path.write_bytes(data)
    try:
        return read_points(path, resolution=0.1 if path.suffix == ".pgm" else None, spacing=2.0)
    except InputError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return None


def source(samples: dict[str, Path], name: str, folder: Path) -> tuple[Path, bytes]:
    """Where to write damaged copies of a sample, and the sample's bytes."""
    if name == "plan.yaml":
        (folder / "plan.pgm").write_bytes(samples[name].with_suffix(".pgm").read_bytes())
    path = samples.get(name) or samples["plan.yaml"].with_suffix(".pgm")
    return folder / name, path.read_bytes()


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_cut_short(samples: dict[str, Path], tmp_path: Path, name: str) -> None:
    path, data = source(samples, name, tmp_path)
    for length in (1, 3, 10, 60, 200, len(data) // 3, len(data) // 2, len(data) - 40):
        cloud = attempt(path, data[: max(1, min(length, len(data) - 1))])
        assert cloud is None or name not in SELF_CHECKING, f"{name} cut to {length} of {len(data)} bytes was read"


@pytest.mark.longer
@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_flipped_bytes(samples: dict[str, Path], tmp_path: Path, name: str) -> None:
    path, data = source(samples, name, tmp_path)
    rng = np.random.default_rng(len(name))
    for attempt_number in range(6 if name == "model.ifc" else 40):  # each building model takes a process
        broken = bytearray(data)
        reach = len(data) if attempt_number % 2 else min(len(data), 300)  # every other time in the header
        for at in rng.integers(0, reach, 1 + attempt_number % 5):
            broken[at] = int(rng.integers(256))
        attempt(path, bytes(broken))


@pytest.mark.parametrize("name", SAMPLE_NAMES)
@pytest.mark.parametrize("data", [b"", b"hello\nworld\n" * 50, bytes(range(256)) * 8, b"\0" * 500, b"\n"])
def test_other_data_under_the_suffix(samples: dict[str, Path], tmp_path: Path, name: str, data: bytes) -> None:
    path, _ = source(samples, name, tmp_path)
    assert attempt(path, data) is None


@pytest.mark.parametrize("name", SAMPLE_NAMES)
def test_another_format_under_the_suffix(samples: dict[str, Path], tmp_path: Path, name: str) -> None:
    path, _ = source(samples, name, tmp_path)
    for other in ("little.ply", "array.npz", "model.ifc", "cloud.e57"):
        if other[-4:] != name[-4:] and {other, name} != {"array.npz", "array.npy"}:
            assert attempt(path, samples[other].read_bytes()) is None


ABSURD = 10**12


def npy_header(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def boasts(samples: dict[str, Path]) -> dict[str, bytes]:
    """Files whose header promises 10^12 points."""
    columns = "property float x\nproperty float y\nproperty float z\n"
    ply = f"ply\nformat %s 1.0\nelement vertex {ABSURD}\n{columns}%send_header\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    pcd = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {ABSURD}\nHEIGHT 1\nPOINTS {ABSURD}\nDATA %s\n"
    las, stl = bytearray(samples["cloud.las"].read_bytes()), bytearray(samples["mesh.stl"].read_bytes())
    laz = bytearray(samples["cloud.laz"].read_bytes())
    las[107:111] = laz[107:111] = stl[80:84] = struct.pack("<I", 2**32 - 1)
    las_records = bytearray(samples["cloud.las"].read_bytes())
    las_records[100:104] = struct.pack("<I", 2**32 - 1)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as packed:
        packed.writestr("points.npy", npy_header((ABSURD, 3)) + bytes(64))
    return {
        "a.ply": (ply % ("ascii", "")).encode() + b"1 2 3\n",
        "b.ply": (ply % ("binary_little_endian", "")).encode() + bytes(120),
        "c.ply": (ply % ("ascii", faces)).encode() + b"1 2 3\n",
        "d.ply": (ply % ("binary_big_endian", faces)).encode() + bytes(120),
        "a.pcd": (pcd % "ascii").encode() + b"1 2 3\n",
        "b.pcd": (pcd % "binary").encode() + bytes(120),
        "c.pcd": (pcd % "binary_compressed").encode() + struct.pack("<II", 100, 2**32 - 1) + bytes(120),
        "a.npy": npy_header((ABSURD, 3)) + bytes(120),
        "a.npz": archive.getvalue(),
        "a.las": bytes(las),
        "b.las": bytes(las_records),
        "a.laz": bytes(laz),
        "a.stl": bytes(stl),
        "a.gltf": samples["mesh.gltf"].read_bytes().replace(b'"count":', f'"count":{ABSURD}'.encode(), 1),
    }


def test_headers_that_promise_too_much(samples: dict[str, Path], tmp_path: Path) -> None:
    for name, data in boasts(samples).items():
        assert attempt(tmp_path / name, data) is None, name


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    bomb = np.array([{"a": 1}], dtype=object)
    np.save(tmp_path / "a.npy", bomb, allow_pickle=True)
    np.savez(tmp_path / "a.npz", points=bomb)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(InputError, match="never loaded"):
            read_points(tmp_path / name)


def test_zip_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from topomerge.io import arrays

    np.savez_compressed(tmp_path / "a.npz", points=np.zeros((100_000, 3)))
    assert len(read_points(tmp_path / "a.npz")) == 100_000
    monkeypatch.setattr(arrays, "MODEST", 1 << 20)
    with pytest.raises(InputError, match="would unpack to 2,400,128 bytes"):
        read_points(tmp_path / "a.npz")


def test_meshes_whose_faces_name_no_vertex(samples: dict[str, Path], tmp_path: Path) -> None:
    data = samples["mesh.obj"].read_text().replace("\nf ", "\nf 999 ", 1)
    (tmp_path / "a.obj").write_text(data)
    with pytest.raises(InputError, match=r"a\.obj: damaged"):
        read_points(tmp_path / "a.obj")


def test_compressed_scenes_say_so(samples: dict[str, Path], tmp_path: Path) -> None:
    needs = b'{"extensionsRequired":["KHR_draco_mesh_compression"],'
    (tmp_path / "a.gltf").write_bytes(samples["mesh.gltf"].read_bytes().replace(b"{", needs, 1))
    with pytest.raises(InputError, match="KHR_draco_mesh_compression, which is not read"):
        read_points(tmp_path / "a.gltf")


def test_e57_pages_are_checked_before_the_library_sees_them(samples: dict[str, Path], tmp_path: Path) -> None:
    data = bytearray(samples["cloud.e57"].read_bytes())
    data[5000] ^= 1
    (tmp_path / "a.e57").write_bytes(data)
    with pytest.raises(InputError, match="page 4 fails its checksum"):
        read_points(tmp_path / "a.e57")


@pytest.mark.longer
@pytest.mark.parametrize(
    ("does", "says"),
    [
        ("os.abort()", "the library that reads it broke down"),
        ("[0 for _ in iter(int, 1)]", "more than 1 s for a small part of it"),
        ("bytearray(8 << 30)", "does not fit into memory"),
        ("print('noise'); raise RuntimeError('two\\nlines')", "two lines"),
    ],
)
def test_e57_library_that_dies_hangs_or_eats_memory(
    samples: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: str, says: str
) -> None:
    from topomerge.io import e57

    (tmp_path / "pye57.py").write_text(f"import os\n\ndef E57(path):\n    {does}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pye57", raising=False)
    monkeypatch.setattr(e57, "BLOCK_SECONDS", 1)
    with pytest.raises(InputError, match=says) as caught:
        read_points(samples["cloud.e57"])
    assert "cloud.e57: " in str(caught.value) and "\n" not in str(caught.value)


def test_a_cut_ply_tells_how_many_rows_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 1000\n{names}end_header\n"
    path.write_bytes(head.encode() + bytes(12 * 30 + 5))
    with pytest.raises(InputError, match="holds 30 of the 1,000 rows of vertex"):
        read_points(path)
    path.write_text(head.replace("binary_little_endian", "ascii") + 7 * "1 2 3\n")
    with pytest.raises(InputError, match="holds 7 of the 1,000 rows of vertex"):
        read_points(path)
