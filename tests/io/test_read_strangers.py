"""What strangers give that is not what its name says: each is named, and told what helps."""

from __future__ import annotations

import logging
import os
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

import topomerge
from tests.io.bags import walk_messages, write_bag
from tests.io.walks import room_walk
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.points import list_suffixes

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"


def refusal_of(path: Path, **options: object) -> str:
    """The one line in which a file is refused, without a warning or a line of a library's log."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError) as caught:
            read_points(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("suffix", list_suffixes())
def test_pointers_of_git_lfs(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(POINTER)
    assert refusal_of(path) == f"{path}: is a Git LFS pointer, not the file; run `git lfs pull`"


@pytest.mark.parametrize(("suffix", "advice"), [(".webp", "save it as PNG"), (".DWG", "save it as DXF"), (".doc", "rename or")])
def test_what_to_make_of_other_suffixes(tmp_path: Path, suffix: str, advice: str) -> None:
    assert f"unknown suffix {suffix}; {advice}" in refusal_of(tmp_path / f"a{suffix}")


def test_pointers_of_git_lfs_that_another_file_names(tmp_path: Path) -> None:
    for name in ("map.pgm", "000.ply", "001.ply", "map.tmap", "poses.txt"):
        (tmp_path / name).write_bytes(POINTER)
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\n")
    assert refusal_of(tmp_path / "map.yaml").startswith(f"{tmp_path / 'map.pgm'}: is a Git LFS pointer")
    assert "is a Git LFS pointer" in refusal_of(tmp_path)
    (tmp_path / "poses.txt").write_text(IDENTITY * 2)
    assert "is a Git LFS pointer" in refusal_of(tmp_path)
    with pytest.raises(InputError, match=r"map\.tmap: is a Git LFS pointer"):
        topomerge.load_map(tmp_path / "map.tmap")


def room(rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """(count, 3) points in a room of 12 m by 8 m by 3 m."""
    return rng.uniform((0, 0, 0), (12, 8, 3), (count, 3))


@pytest.mark.parametrize("place", [(11.5817, 48.1402), (-122.41, 37.77), (151.2, -33.9), (48.1402, 11.5817), (2.0, 0.0)])
@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".npy", ".ply", ".las"])
def test_degrees_are_named(tmp_path: Path, place: tuple[float, float], suffix: str) -> None:
    points = room(np.random.default_rng(0)) * (1 / 74_000, 1 / 111_000, 1) + (*place, 520)
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, points)
    elif suffix == ".las":
        laspy = pytest.importorskip("laspy")
        header = laspy.LasHeader(point_format=0)
        header.scales, header.offsets = (1e-8, 1e-8, 1e-3), points.min(axis=0)
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = points.T
        cloud.write(path)
    elif suffix == ".ply":
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(head.encode() + points.tobytes())
    else:
        np.savetxt(path, points, "%.9f", delimiter="," if suffix == ".csv" else " ")
    (warning,) = read_points(path).warnings
    assert warning.startswith("coordinates look like degrees of longitude and latitude (x ")
    assert warning.endswith("project them to metres first, as to UTM")
    with pytest.raises(InputError, match="coordinates look like degrees"):
        topomerge.extract(read_points(path))


@pytest.mark.parametrize(
    ("scale", "shift"),
    [
        ((1, 1, 1), (11.5, 48.1, 0)),
        ((1e-3, 1e-3, 1e-3), (11.5, 48.1, 0)),
        ((1e3, 1e3, 1e3), (0, 0, 0)),
        ((0.002, 0.002, 1), (0, 0, 0)),
    ],
)
def test_metres_and_models_are_no_degrees(tmp_path: Path, scale: tuple[float, ...], shift: tuple[float, ...]) -> None:
    np.save(tmp_path / "a.npy", room(np.random.default_rng(0)) * scale + shift)
    assert not any("degrees" in w for w in read_points(tmp_path / "a.npy").warnings)


@pytest.mark.parametrize(("shift", "said"), [((512345.6, 5812345.7, 34.5), "y is rounded to 0.5 m"), ((600.0, 5000.0, 3.0), "")])
def test_digits_that_floats_lost_are_told(tmp_path: Path, shift: tuple[float, ...], said: str) -> None:
    points = np.concatenate([room(np.random.default_rng(0)), np.random.default_rng(1).uniform(0, 1, (4000, 3)) * (8, 9, 2.6)])
    np.save(tmp_path / "a.npy", (points + shift).astype(np.float32))
    np.save(tmp_path / "b.npy", np.round(points / 0.1) * 0.1)  # voxels
    told = [w for w in read_points(tmp_path / "a.npy").warnings if "rounded" in w]
    assert len(told) == bool(said) and all(w.startswith(said) for w in told)
    assert not [w for w in read_points(tmp_path / "b.npy").warnings if "rounded" in w]


@pytest.mark.parametrize("version", ["1.2", "1.1", "3.0"])
def test_bags_of_another_format(tmp_path: Path, version: str) -> None:
    pytest.importorskip("rosbags")
    path = tmp_path / "a.bag"
    path.write_bytes(f"#ROSBAG V{version}\n".encode() + bytes(200))
    advice = "convert it with `rosbag fix old.bag new.bag` of ROS 1"
    assert refusal_of(path) == f"{path}: is a bag of format {version}, not 2.0; {advice}"


@pytest.mark.parametrize(("kind", "tool"), [("bag", "rosbag reindex"), ("mcap", "mcap recover")])
def test_bags_whose_index_overstates_a_length(tmp_path: Path, kind: str, tool: str) -> None:
    """The records are whole, the index at the end of the file is not."""
    pytest.importorskip("rosbags")
    data = bytearray(write_bag(tmp_path / "good", kind, walk_messages(room_walk().part(2))).read_bytes())
    if kind == "bag":
        at = data.index(b"chunk_count=") + 12
        data[at : at + 4] = struct.pack("<I", struct.unpack_from("<I", data, at)[0] + 1)
    else:
        start = struct.unpack_from("<Q", data, len(data) - 8 - 20)[0]  # of the summary, from the footer
        data[start + 1 : start + 9] = struct.pack("<Q", len(data))
    path = tmp_path / f"a.{kind}"
    path.write_bytes(data)
    said = refusal_of(path)
    assert said.startswith(f"{path}: its index does not fit its records, or it is cut short (")
    assert said.endswith(f"); copy it again, or run `{tool}` on a copy")


def test_a_link_out_of_its_folder_shows_nothing(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("swordfish:x:0:0\n")
    walk = tmp_path / "walk"
    walk.mkdir()
    np.ones((50, 4), np.float32).tofile(walk / "000000.bin")
    (walk / "poses.txt").symlink_to(tmp_path / "secret")
    assert refusal_of(walk) == f"{walk / 'poses.txt'}: line 1 is not a row of numbers; mend or remove it"
    (walk / "poses.txt").unlink()
    (walk / "other.dat").write_text("no numbers\n")
    (walk / "poses.txt").symlink_to("other.dat")
    assert "'no numbers'" in refusal_of(walk)
    for name in ("a.xyz", "a.pcd", "a.ply", "a.obj", "a.json", "a.yaml", "a.csv"):
        (walk / name).symlink_to(tmp_path / "secret")
        assert "swordfish" not in refusal_of(walk / name)
    (tmp_path / "secret").write_text("1 2 3\nswordfish:x:0:0\n")
    assert "swordfish" not in refusal_of(walk / "a.xyz")


@pytest.mark.parametrize("text", ["swordfish: [x\n  y: }\n", "swordfish:x:0\n"])
def test_a_linked_index_of_a_bag_shows_nothing(tmp_path: Path, text: str) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "secret").write_text(text)
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "metadata.yaml").symlink_to(tmp_path / "secret")
    (tmp_path / "walk" / "walk.db3").write_bytes(b"SQLite format 3\0")
    assert "swordfish" not in refusal_of(tmp_path / "walk")


@pytest.mark.parametrize("value", ["1e300", "-1e300", "1e200", "1e31", "inf", "nan"])
@pytest.mark.parametrize("column", [0, 3])
def test_poses_beyond_any_number(tmp_path: Path, value: str, column: int) -> None:
    np.ones((50, 4), np.float32).tofile(tmp_path / "000000.bin")
    words = IDENTITY.split()
    words[column] = value
    (tmp_path / "poses.txt").write_text(" ".join(words) + "\n")
    assert "line 1 holds a number that is not finite, or beyond 1e+30" in refusal_of(tmp_path)
    (tmp_path / "poses.txt").write_text("\n".join(["1e20 0 0 0 0 1 0 0 0 0 1 0"]))
    assert "line 1 is not a rotation and a place" in refusal_of(tmp_path)


@pytest.mark.parametrize("shape", [(5, 2), (5,), (5, 4), (2, 5, 3)])
def test_arrays_of_another_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError) as caught:
        topomerge.extract(np.zeros(shape))
    assert str(caught.value) == f"extract: points must be (N, 3), not {shape}; give x, y and z of each point, in metres"


def test_a_plan_without_floor_is_told_of_plans(tmp_path: Path) -> None:
    from PIL import Image

    picture = np.full((80, 80), 205, np.uint8)
    picture[10:70, 10] = picture[10:70, 70] = picture[10, 10:70] = 0
    Image.fromarray(picture).save(tmp_path / "a.pgm")
    (tmp_path / "a.yaml").write_text("image: a.pgm\nresolution: 0.05\n")
    with pytest.raises(InputError, match="no floor found: .* check the map's resolution, its thresholds and negate") as caught:
        topomerge.extract(read_points(tmp_path / "a.yaml"))
    assert "--up" not in str(caught.value) and "--unit" not in str(caught.value)


@pytest.mark.data
def test_a_library_logs_nothing_before_the_line_that_explains(case_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert "lz1.laz: damaged, or not a LAS file" in refusal_of(case_dir / "bombs" / "lz1.laz")
        assert "poses.txt: line 1 holds a number that is not finite" in refusal_of(case_dir / "bombs" / "poses_1e300")
    assert not caplog.records


def test_links_are_not_needed(tmp_path: Path) -> None:
    """A file that the user named through a link is read like any other."""
    (tmp_path / "a").mkdir()
    np.savetxt(tmp_path / "a" / "scan.xyz", room(np.random.default_rng(1), 300))
    os.symlink(tmp_path / "a" / "scan.xyz", tmp_path / "b.xyz")
    assert len(read_points(tmp_path / "b.xyz")) == 300
