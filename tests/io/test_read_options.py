"""What is common to all formats: units, axes, warnings, refusals."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.samples import box_points
from topomerge.errors import InputError
from topomerge.io import frame, read_chunks, read_points
from topomerge.io.frame import compute_flatness, warn_about
from topomerge.io.points import PointSample
from topomerge.types import VoxelGrid


def save(path: Path, points: np.ndarray) -> Path:
    np.save(path, points)
    return path


def room(x: float, y: float, z: float, step: float = 0.1) -> np.ndarray:
    """(n, 3) points on the six sides of a room."""
    sides = []
    for axis, (u, v) in enumerate([(1, 2), (0, 2), (0, 1)]):
        size = (x, y, z)
        a, b = np.meshgrid(np.arange(0, size[u], step), np.arange(0, size[v], step))
        side = np.zeros((a.size, 3))
        side[:, u], side[:, v] = a.ravel(), b.ravel()
        other = side.copy()
        other[:, axis] = size[axis]
        sides += [side, other]
    return np.concatenate(sides)


@pytest.mark.parametrize("up", list(frame.TURNS))
def test_turns_are_rotations_that_bring_the_axis_up(tmp_path: Path, up: str) -> None:
    rotation = frame.get_axis_rotation(up)
    assert np.linalg.det(rotation) == pytest.approx(1)
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
    np.testing.assert_array_equal(rotation @ axis, (0, 0, 1))
    points = np.random.default_rng(0).normal(size=(20, 3))
    cloud = read_points(save(tmp_path / "a.npy", points), up=up)
    np.testing.assert_allclose(cloud.points, points @ rotation.T, atol=1e-6)


def test_unit_and_scale_come_first(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", box_points() * 1000)
    np.testing.assert_allclose(read_points(path, unit="mm").points, box_points(), atol=1e-5)
    np.testing.assert_allclose(read_points(path, unit="mm", scale=2).points, 2 * box_points(), atol=1e-5)
    assert frame.UNITS["ft"] == pytest.approx(12 * frame.UNITS["in"])


@pytest.mark.parametrize("up", list(frame.TURNS))
def test_grids_and_poses_turn_with_the_points(up: str) -> None:
    cells = np.random.default_rng(0).integers(0, 9, (40, 3))
    grid = VoxelGrid.from_cells(cells, np.array([1.0, -2, 3]), 0.5)
    turned = frame.transform_grid(grid, frame.get_axis_rotation(up), 2.0)
    expected = frame.transform_points(grid.compute_centroids(), frame.get_axis_rotation(up), 2.0)
    assert turned.contains(turned.locate(expected)).all() and len(turned) == len(grid)
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = (1, 2, 3)
    placed = frame.transform_poses(pose, frame.get_axis_rotation(up), 2.0)
    np.testing.assert_allclose(placed[0, :3, 3], frame.transform_points(pose[:, :3, 3], frame.get_axis_rotation(up), 2.0)[0])


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path: Path) -> None:
    points = box_points().astype(float)
    points[3, 0], points[5, 1], points[7, 2] = np.nan, np.inf, 1e39
    cloud = read_points(save(tmp_path / "a.npy", points), up="y")
    assert len(cloud) == len(points) - 3
    assert cloud.warnings == ("3 points were not finite and are left out",)
    chunks = list(read_chunks(tmp_path / "a.npy", chunk=100))
    assert [bool(c.warnings) for c in chunks] == [False] * (len(chunks) - 1) + [True]


def test_one_point_is_a_cloud_and_none_is_an_error(tmp_path: Path) -> None:
    assert len(read_points(save(tmp_path / "a.npy", np.zeros((1, 3))))) == 1
    for points in (np.zeros((0, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(InputError, match="holds no points"):
            read_points(save(tmp_path / "a.npy", points))


def test_options_that_a_format_cannot_use_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", box_points())
    for name, value in (
        ("resolution", 0.05),
        ("extrude", 2.5),
        ("ceiling", True),
        ("doors", True),
        ("poses", "x"),
        ("topic", "x"),
    ):
        with pytest.raises(InputError, match=f"a.npy: --{name} is of no use to a NumPy file, only to "):
            read_points(path, **{name: value})
    assert len(read_points(path, resolution=None, ceiling=False, doors=False)) == len(box_points())


@pytest.mark.parametrize(("factor", "unit"), [(1000, "mm"), (100, "cm")])
def test_wrong_units_are_noticed(tmp_path: Path, factor: float, unit: str) -> None:
    path = save(tmp_path / "a.npy", room(31, 20, 2.7, 0.2) * factor)
    (warning,) = read_points(path).warnings
    assert f"give --unit {unit}" in warning
    assert read_points(path, unit=unit).warnings == ()


@pytest.mark.parametrize("size", [(8, 6, 2.7), (30, 2, 2.7), (2, 30, 2.7), (3, 3, 30), (60, 40, 3.2), (20, 15, 6), (30, 30, 12)])
def test_ordinary_rooms_raise_no_warning(size: tuple[float, float, float]) -> None:
    points = room(*size)
    assert warn_about(points, "z") == []
    walls = points[(points[:, 2] > 0) & (points[:, 2] < size[2])]
    if size[2] < 10:
        assert warn_about(walls, "z") == []


@pytest.mark.parametrize("up", ["y", "x"])
def test_a_lying_building_is_noticed(tmp_path: Path, up: str) -> None:
    lying = room(12, 8, 2.7) @ frame.get_axis_rotation(up)
    path = save(tmp_path / "a.npy", lying)
    (warning,) = read_points(path).warnings
    assert f"give --up {up}" in warning
    assert read_points(path, up=up).warnings == ()


def test_samples_stay_small() -> None:
    sample = PointSample(limit=1000)
    for start in range(0, 100_000, 777):
        sample.add(np.arange(start, start + 777.0)[:, None] * np.ones(3))
    assert 400 <= len(sample.points) <= 1000
    assert sample.points[:, 0].max() > 99_000


@pytest.mark.longer
def test_progress_runs_from_start_to_end(samples: dict[str, Path]) -> None:
    for path in samples.values():
        said: list[float] = []
        read_points(path, resolution=None, progress=lambda share, text, said=said: said.append(share))
        assert said[-1] == 1.0 and said == sorted(said) and all(0 <= s <= 1 for s in said), path.name


def test_formats_that_know_their_frame_say_that_options_are_not_applied(samples: dict[str, Path]) -> None:
    plain, other = read_points(samples["plan.yaml"]), read_points(samples["plan.yaml"], up="y", unit="mm")
    np.testing.assert_array_equal(plain.points, other.points)
    assert any("--unit and --up are not applied" in w for w in other.warnings)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"up": "w"}, "not an axis"),
        ({"unit": "km"}, "not known"),
        ({"scale": 0.0}, "above 0"),
        ({"scale": float("nan")}, "above 0"),
        ({"scale": "2"}, "--scale '2' can't be used; give a number above 0"),
        ({"units": "mm"}, "units is no option of reading; give one of up, unit, scale"),
        ({"spacing": -1.0}, "above 0"),
        ({"chunk": 0}, "1 or more"),
    ],
)
def test_bad_options_are_refused_at_once(samples: dict[str, Path], options: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=re.escape(says)) as refusal:
        read_chunks(samples["table.xyz"], **options)  # type: ignore[arg-type]
    assert str(samples["table.xyz"]) in str(refusal.value) and "\n" not in str(refusal.value)


def test_missing_unknown_empty_and_locked_files(tmp_path: Path) -> None:
    (tmp_path / "a.docx").write_text("x")
    (tmp_path / "empty.ply").touch()
    (tmp_path / "folder.ply").mkdir()
    cases = {"none.ply": "no such file", "a.docx": "one of ply pcd", "empty.ply": "is empty", "folder.ply": "is a folder"}
    cases["a.tmap"] = "is a map already"
    for name, says in cases.items():
        with pytest.raises(InputError, match=says) as caught:
            read_points(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    if os.geteuid() != 0:
        (tmp_path / "locked.ply").write_text("ply\n")
        (tmp_path / "locked.ply").chmod(0)
        with pytest.raises(InputError, match="permissions"):
            read_points(tmp_path / "locked.ply")


def test_a_missing_library_names_the_extra(samples: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    for library, extra in (("laspy", "las"), ("pye57", "e57"), ("ifcopenshell", "ifc")):
        monkeypatch.setitem(sys.modules, library, None)
        name = next(n for n in samples if n.endswith(extra))
        with pytest.raises(InputError, match=rf"pip install topomerge\[{extra}\]"):
            read_points(samples[name])


def test_importing_the_readers_is_cheap() -> None:
    heavy = "open3d laspy pye57 ifcopenshell trimesh PIL plyfile"
    code = f"import sys, topomerge.io; print(*(set('{heavy}'.split()) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_marked_and_sorted_cells_show_the_same_flatness(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(0, (5, 4, 2.5), (3000, 3))
    points[:1500, 2] = 0.04
    marked = compute_flatness(points, *np.percentile(points, (1, 99), axis=0))
    monkeypatch.setattr(frame, "MOST_SLAB_CELLS", 0)
    assert marked == compute_flatness(points, *np.percentile(points, (1, 99), axis=0)) and marked[2] > 0.3
