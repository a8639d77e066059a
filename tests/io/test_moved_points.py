"""Points of a file written elsewhere: every format, in blocks, to a millimetre also in a national grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import topomerge.io.ply as ply_reader
from tests.io.octrees import room_tree, write_copc, write_potree
from tests.samples import box_colors, box_points
from topomerge.errors import InputError
from topomerge.io import transformed_points
from topomerge.io.points import read_points
from topomerge.io.transformed_points import LAS_STEP, choose_suffix, save_transformed_points
from topomerge.types import Array, Sim3

GRID = np.array([482_113.25, 5_412_777.5, 311.0])  # m, a place in a national grid
POSE = Sim3(0.3, (17.123, -40.456, 1.789))


def bow(points: Array) -> Array:
    """A move that is no rigid one."""
    out = np.array(points, np.float64)
    out[:, 1] += 0.05 * np.sin(out[:, 0])
    return POSE.apply(out)


def exact(path: Path) -> Array:
    """(n, 3) float64 coordinates as they stand in a LAS or a PLY file."""
    if path.suffix != ".ply":
        import laspy

        las = laspy.read(path)
        return np.stack([np.asarray(v) for v in (las.x, las.y, las.z)], axis=1)
    from plyfile import PlyData

    rows = PlyData.read(str(path))["vertex"].data
    return np.stack([np.asarray(rows[axis], np.float64) for axis in "xyz"], axis=1)


FORMATS = ["little.ply", "ascii.ply", "big.ply", "binary.pcd", "table.csv", "array.npz", "cloud.las", "cloud.laz", "cloud.e57"]


@pytest.mark.longer
@pytest.mark.parametrize("name", FORMATS)
def test_points_of_every_format_are_moved(samples: dict[str, Path], tmp_path: Path, name: str) -> None:
    source = samples[name]
    before = read_points(source)
    target = tmp_path / f"a{choose_suffix(source)}"
    done = save_transformed_points(source, target, bow, POSE.apply(np.zeros((1, 3)))[0])
    after = read_points(target)
    assert (done.written, done.beyond) == (len(before), 0) and len(after) == len(before)
    requested = bow(before.points.astype(np.float64) + before.shift)
    assert np.abs(exact(target) - requested).max() < 1e-4
    assert np.array_equal(before.colors, after.colors) if before.colors is not None else after.colors is None
    assert [p.name for p in tmp_path.iterdir()] == [target.name]


def test_an_octree_is_moved_as_laz(tmp_path: Path) -> None:
    """Moved points no longer lie where the octree of a COPC file says; folders of octrees become PLY."""
    import laspy

    sources = [write_copc(tmp_path / "a.copc.laz", room_tree()), write_potree(tmp_path / "potree", room_tree())]
    for source, suffix in zip(sources, (".laz", ".ply"), strict=True):
        target = tmp_path / f"moved{choose_suffix(source)}"
        assert target.suffix == suffix and save_transformed_points(source, target, bow, np.zeros(3)).written == len(
            room_tree().points
        )
        assert np.abs(exact(target) - bow(read_points(source).points.astype(np.float64))).max() < 1e-3
    with laspy.open(tmp_path / "moved.laz") as reader:
        assert [record.user_id for record in reader.header.vlrs] == ["laszip encoded"] or not reader.header.vlrs


@pytest.mark.parametrize("suffix", [".las", ".laz", ".npy"])
def test_a_national_grid_keeps_its_millimetres(tmp_path: Path, suffix: str) -> None:
    points = box_points(2000).astype(np.float64) + GRID
    source, target = tmp_path / f"a{suffix}", tmp_path / f"b{choose_suffix(f'a{suffix}')}"
    if suffix == ".npy":
        np.save(source, points)
    else:
        write_rich_las(source, points)
    move = Sim3(0.01, (0.25, 0.5, 0.125))
    about = Sim3(0, tuple(GRID.tolist())) @ move @ Sim3(0, tuple((-GRID).tolist()))
    save_transformed_points(source, target, about.apply, GRID)
    assert np.abs(exact(target) - about.apply(points)).max() < 5e-4
    assert np.abs(read_points(target).points + read_points(target).shift - about.apply(points)).max() < 1e-3


def write_rich_las(path: Path, points: Array) -> None:
    """With all that scanners put beside coordinates, and the name of a coordinate system."""
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    header.add_extra_dim(laspy.ExtraBytesParams(name="ring", type=np.uint16))
    header.vlrs.append(WktCoordinateSystemVlr('PROJCS["somewhere"]'))
    header.vlrs.append(laspy.VLR("surveyor", 7, "by hand", b"notes"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    n = len(points)
    las.intensity, las.classification, las.ring = np.arange(n) % 60_000, np.arange(n) % 7, np.arange(n) % 64
    las.gps_time = np.arange(n) * 0.25
    las.red, las.green, las.blue = box_colors(n).astype(np.uint16).T * 257
    las.write(str(path))


@pytest.mark.parametrize(("suffix", "same_frame"), [(".las", False), (".laz", True)])
def test_las_keeps_its_dimensions(tmp_path: Path, suffix: str, same_frame: bool) -> None:
    import laspy

    source, target = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write_rich_las(source, box_points(900).astype(np.float64) + GRID)
    save_transformed_points(source, target, lambda p: p + [0, 0, 1], GRID, same_frame=same_frame)
    a, b = laspy.read(source), laspy.read(target)
    for name in ("intensity", "classification", "ring", "gps_time", "red", "green", "blue"):
        assert np.array_equal(np.asarray(a[name]), np.asarray(b[name])), name
    assert np.allclose(np.asarray(b.z), np.asarray(a.z) + 1, atol=LAS_STEP)
    assert b.header.point_count == 900 and np.allclose(b.header.maxs, [np.max(b.x), np.max(b.y), np.max(b.z)])
    users = [record.user_id for record in b.header.vlrs]
    assert "surveyor" in users and ("LASF_Projection" in users) == same_frame
    again = tmp_path / f"c{suffix}"
    save_transformed_points(source, again, lambda p: p + [0, 0, 1], GRID, same_frame=same_frame)
    assert again.read_bytes() == target.read_bytes()


def test_points_beyond_the_reach_of_las_are_counted(tmp_path: Path) -> None:
    import laspy

    points = box_points(600).astype(np.float64) + GRID
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.01), np.zeros(3)
    las = laspy.LasData(header)
    points[7] = 0
    las.x, las.y, las.z = points.T
    las.write(str(tmp_path / "a.las"))
    done = save_transformed_points(tmp_path / "a.las", tmp_path / "b.las", lambda p: p, GRID)
    assert (done.written, done.beyond) == (599, 1)
    assert np.abs(exact(tmp_path / "b.las") - np.delete(points, 7, axis=0)).max() < 0.006


def test_unit_and_axis_are_those_of_reading(tmp_path: Path) -> None:
    points = box_points(600).astype(np.float64)
    write_rich_las(tmp_path / "a.las", points * 1000)
    np.save(tmp_path / "a.npy", points * 1000)
    for name, target in (("a.las", "b.las"), ("a.npy", "b.ply")):
        save_transformed_points(tmp_path / name, tmp_path / target, lambda p: p, np.zeros(3), unit="mm", up="y", same_frame=True)
        assert np.allclose(exact(tmp_path / target), points[:, (0, 2, 1)] * (1, -1, 1), atol=2e-4)
    import laspy

    assert "LASF_Projection" not in [record.user_id for record in laspy.read(tmp_path / "b.las").header.vlrs]


def test_points_are_moved_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import topomerge.io.las as las_reader

    write_rich_las(tmp_path / "a.las", box_points(950).astype(np.float64))
    np.save(tmp_path / "a.npy", box_points(950))
    for module in (transformed_points, las_reader, ply_reader):
        monkeypatch.setattr(module, "BLOCK_POINTS", 200)
    for name, target in (("a.las", "b.las"), ("a.npy", "b.ply")):
        sizes: list[int] = []

        def move(points: Array, sizes: list[int] = sizes) -> Array:
            sizes.append(len(points))
            return bow(points)

        shares: list[float] = []
        save_transformed_points(
            tmp_path / name, tmp_path / target, move, np.zeros(3), progress=lambda s, _, x=shares: x.append(s)
        )
        assert sizes == [200, 200, 200, 200, 150] and shares == sorted(shares) and shares[-1] == 1.0
        assert np.abs(exact(tmp_path / target) - bow(box_points(950))).max() < 2e-4


def test_colours_that_come_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an E57 file whose second scan only has colours."""
    from topomerge.io.piece import Piece

    points, colors = box_points(300), box_colors(300)

    def pieces(path: Path, options: object) -> object:
        yield Piece(points[:100])
        yield Piece(points[100:], colors[100:], done=1.0)

    monkeypatch.setattr(ply_reader, "read", pieces)
    monkeypatch.setattr(transformed_points, "BLOCK_POINTS", 100)
    (tmp_path / "a.ply").write_bytes(b"ply")
    assert save_transformed_points(tmp_path / "a.ply", tmp_path / "b.ply", lambda p: p, np.zeros(3)).written == 300
    monkeypatch.undo()
    cloud = read_points(tmp_path / "b.ply")
    assert np.array_equal(cloud.points, points) and not cloud.colors[:100].any()
    assert np.array_equal(cloud.colors[100:], colors[100:])


def test_what_cannot_be_read_leaves_nothing(tmp_path: Path, samples: dict[str, Path]) -> None:
    for name, suffix in (("cloud.las", ".las"), ("little.ply", ".ply")):
        (tmp_path / f"cut{suffix}").write_bytes(samples[name].read_bytes()[:-500])
        with pytest.raises(InputError, match="cut short"):
            save_transformed_points(tmp_path / f"cut{suffix}", tmp_path / f"b{suffix}", lambda p: p, np.zeros(3))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.las", "cut.ply"]
