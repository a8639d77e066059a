"""Folders whose files are parts of one cloud: tiles and stations of one frame, in any mixture of formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from topomerge.cli.main import main
from topomerge.errors import InputError

RNG = np.random.default_rng(3)
GREY = np.full((300, 3), 90, np.uint8)


def block(x: float, y: float, count: int = 300) -> np.ndarray:
    return RNG.random((count, 3)) * (5, 5, 2.5) + (x, y, 0)


def ply(path: Path, points: np.ndarray, colored: bool = False) -> np.ndarray:
    rows = np.empty(len(points), [(n, "<f8") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")] * colored)
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    for name in ("red", "green", "blue") if colored else ():
        rows[name] = 90
    head = [
        f"property {'uchar' if kind == 'u1' else 'double'} {n}"
        for n, kind in ((n, rows.dtype[n].str[-2:]) for n in rows.dtype.names)
    ]
    path.write_bytes(
        "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *head, "end_header\n"]).encode()
    )
    with path.open("ab") as stream:
        stream.write(rows.tobytes())
    return points


def las(path: Path, points: np.ndarray, offset: float = 0.0, code: int = 0) -> np.ndarray:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.full(3, offset)
    if code:
        keys = np.array([1, 1, 0, 1, 3072, 0, 1, code], "<u2")
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", keys.tobytes()))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.intensity = np.full(len(points), 700, np.uint16)
    cloud.write(str(path))
    return points


def e57(path: Path, points: np.ndarray, place: float) -> np.ndarray:
    """Two stations a file."""
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(path), mode="w")
    for half, x in ((points[::2], place), (points[1::2], place + 1)):
        own = half - (x, 0, 0)
        data = {name: np.ascontiguousarray(own[:, k]) for k, name in enumerate(("cartesianX", "cartesianY", "cartesianZ"))}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.array([x, 0.0, 0.0]))
    file.close()
    return points


def rows_of(points: np.ndarray) -> np.ndarray:
    rounded = np.round(points.astype(np.float64), 2) + 0.0
    return rounded[np.lexsort(rounded.T)]


def test_tiles_of_ply_are_one_cloud_named_by_the_folder(tmp_path: Path) -> None:
    parts = [ply(tmp_path / f"tile_{k}.ply", block(5 * k, 0)) for k in (2, 10, 0)]
    cloud = tm.read_points(tmp_path, one_frame=True)
    assert cloud.source == str(tmp_path) and cloud.poses is None
    assert np.allclose(cloud.points, np.concatenate([parts[2], parts[0], parts[1]]), atol=1e-4)  # by their numbers


def test_tiles_of_las_keep_their_intensities_and_may_have_different_offsets(tmp_path: Path) -> None:
    parts = [
        las(tmp_path / f"a{k}.{kind}", block(600_000 + 5 * k, 700_000), 1e5 * (5 + k), 25832)
        for k, kind in enumerate(("las", "laz"))
    ]
    cloud = tm.read_points(tmp_path, one_frame=True)
    assert np.abs(cloud.points + cloud.shift - np.concatenate(parts)).max() < 0.01
    assert cloud.intensities is not None and (cloud.intensities == 700).all()


def test_stations_of_e57_keep_whose_ray_met_each_point(tmp_path: Path) -> None:
    parts = [e57(tmp_path / f"s{k}.e57", block(5 * k, 0), 10.0 * k) for k in range(3)]
    cloud = tm.read_points(tmp_path, one_frame=True)
    assert cloud.poses is not None and cloud.pose_of is not None
    assert cloud.poses[:, 0, 3].tolist() == [0, 1, 10, 11, 20, 21]
    assert np.allclose(rows_of(cloud.points), rows_of(np.concatenate(parts)), atol=0.011)
    assert np.bincount(cloud.pose_of).tolist() == [150] * 6


def test_mixed_formats_fill_what_they_lack(tmp_path: Path) -> None:
    parts = [
        ply(tmp_path / "a.ply", block(0, 0), colored=True),
        las(tmp_path / "b.las", block(5, 0)),
        e57(tmp_path / "c.e57", block(9, 0), 9),
    ]
    np.save(tmp_path / "d.npy", block(0, 5))
    parts.append(np.load(tmp_path / "d.npy"))
    (tmp_path / "readme.txt").write_text("what the tiles are\n")
    cloud = tm.read_points(tmp_path, one_frame=True)
    assert len(cloud) == sum(map(len, parts))
    assert cloud.colors is not None and (cloud.colors.any(axis=1)).sum() == 300
    assert cloud.intensities is None  # each format counts them in its own way
    assert cloud.pose_of is not None and (cloud.pose_of >= 0).sum() == 300


def test_texts_are_tiles_where_there_is_nothing_else(tmp_path: Path) -> None:
    for k in range(2):
        np.savetxt(tmp_path / f"{k}.txt", block(5 * k, 0))
    assert len(tm.read_points(tmp_path, one_frame=True)) == 600


def test_chunks_of_many_tiles_are_of_the_wanted_size(tmp_path: Path) -> None:
    for k in range(7):
        ply(tmp_path / f"{k}.ply", block(5 * k, 0))
    assert [len(chunk) for chunk in tm.read_chunks(tmp_path, one_frame=True, chunk=500)] == [500, 500, 500, 500, 100]


def test_one_bad_tile_is_named(tmp_path: Path) -> None:
    ply(tmp_path / "a.ply", block(0, 0))
    ply(tmp_path / "b.ply", block(5, 0))
    (tmp_path / "b.ply").write_bytes((tmp_path / "b.ply").read_bytes()[:-500])
    with pytest.raises(InputError, match=r"b\.ply: holds 2\d\d of the 300 points .*take it out of the folder"):
        tm.read_points(tmp_path, one_frame=True)


def test_an_empty_folder_and_an_empty_tile(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no files of points"):
        tm.read_points(tmp_path, one_frame=True)
    ply(tmp_path / "a.ply", block(0, 0))
    (tmp_path / "b.ply").touch()
    with pytest.raises(InputError, match=r"b\.ply: is empty"):
        tm.read_points(tmp_path, one_frame=True)


def test_different_coordinate_systems_are_refused_in_one_line(tmp_path: Path) -> None:
    las(tmp_path / "a.las", block(0, 0), code=25832)
    las(tmp_path / "b.las", block(5, 0), code=25833)
    with pytest.raises(InputError, match=r"a\.las is in EPSG:25832 and b\.las in EPSG:25833; .* convert one of them"):
        tm.read_points(tmp_path, one_frame=True)


@pytest.mark.parametrize("names", [("a.ply", "b.ply"), ("a.las", "b.las"), ("a.ply", "b.pcd")])
def test_the_error_that_asks_for_a_trajectory_names_the_option(tmp_path: Path, names: tuple[str, str]) -> None:
    for name in names:
        write = las if name.endswith("las") else ply
        write(tmp_path / name, block(0, 0))
    with pytest.raises(InputError, match="--one-frame"):
        tm.read_points(tmp_path)


def test_a_file_is_no_folder_of_tiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ply(tmp_path / "a.ply", block(0, 0))
    assert main(["extract", str(tmp_path / "a.ply"), "--one-frame", "-o", str(tmp_path / "a.tmap")]) == 1
    assert "--one-frame is of no use to a PLY file" in capsys.readouterr().err
    ply(tmp_path / "b.ply", block(0, 0))
    assert (
        main(["merge", *(str(tmp_path / name) for name in ("a.ply", "b.ply")), "--one-frame", "-o", str(tmp_path / "out")]) == 1
    )
    assert "--one-frame" in capsys.readouterr().err


@pytest.mark.longer
@pytest.mark.data
def test_the_case_of_four_tiles(case_dir: Path) -> None:
    folder = case_dir / "tiles-one-frame"
    with pytest.raises(InputError, match="--one-frame"):
        tm.read_points(folder)
    cloud = tm.read_points(folder, one_frame=True)
    assert len(cloud) == sum(len(tm.read_points(file)) for file in folder.glob("*.ply"))
    assert len(tm.extract(cloud).rooms) >= 14
