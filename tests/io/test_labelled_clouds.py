"""Classes of points as landmarks: clusters no larger than a piece of furniture, of PLY and LAS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from topomerge.io import read_chunks, read_points, sightings
from topomerge.io.sightings import ObjectFinder
from topomerge.types import Landmarks

CHAIRS = np.array([(1.0, 1.0, 0.4), (3.0, 2.0, 0.4)])


def furnished() -> tuple[np.ndarray, np.ndarray]:
    """A room of 5 x 4 m with two chairs (7), a lamp (70), and a wall and a floor of classes of their own."""
    rng = np.random.default_rng(0)
    floor = rng.uniform((0, 0, 0), (5, 4, 0.01), (20_000, 3))
    wall = rng.uniform((0, 0, 0), (5, 0.01, 2.5), (15_000, 3))
    chairs = [rng.uniform(middle - (0.25, 0.25, 0.4), middle + (0.25, 0.25, 0.4), (800, 3)) for middle in CHAIRS]
    lamp = rng.uniform((2.4, 1.9, 2.2), (2.6, 2.1, 2.4), (200, 3))
    stray = np.array([(4.5, 3.5, 1.0)])
    parts, classes = [floor, wall, *chairs, lamp, stray], (2, 6, 7, 7, 70, 70)
    return np.concatenate(parts), np.repeat(classes, [len(part) for part in parts])


def write_labelled_ply(
    path: Path, points: np.ndarray, classes: np.ndarray, name: str, text: bool = False, kind: str = "int"
) -> None:
    head = f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex {len(points)}\n"
    head += f"property float x\nproperty float y\nproperty float z\nproperty {kind} {name}\nend_header\n"
    code = {"int": "<i4", "float": "<f4", "uchar": "u1"}[kind]
    rows = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("class", code)])
    rows["x"], rows["y"], rows["z"], rows["class"] = *points.T, classes
    lines = "".join(f"{x:.4f} {y:.4f} {z:.4f} {k:g}\n" for x, y, z, k in rows.tolist())
    path.write_bytes(head.encode() + (lines.encode() if text else rows.tobytes()))


def assert_furniture(found: Landmarks | None, values: list[str]) -> None:
    assert found is not None and found.is_kind("object").all() and found.sources == ("classes of points",)
    assert sorted(found.get_values()) == values
    chairs = found.table["position"][found.get_values() == "class 7"]
    if len(chairs):
        assert chairs[np.argsort(chairs[:, 0])] == pytest.approx(CHAIRS, abs=0.05)
        assert (found.table["sigma"] < 0.3).all()


@pytest.mark.parametrize("name", ["label", "classification", "scalar_Classification"])
@pytest.mark.parametrize("kind", ["int", "float", "uchar"])
def test_classes_of_ply(tmp_path: Path, name: str, kind: str) -> None:
    points, classes = furnished()
    write_labelled_ply(tmp_path / "a.ply", points, classes, name, kind=kind)
    assert_furniture(read_points(tmp_path / "a.ply").landmarks, ["class 7", "class 7", "class 70"])


def test_classes_of_text_of_portions_and_of_another_frame(tmp_path: Path) -> None:
    points, classes = furnished()
    write_labelled_ply(tmp_path / "a.ply", points, classes, "label", text=True)
    chunks = list(read_chunks(tmp_path / "a.ply", chunk=3000))
    assert all(chunk.landmarks is None for chunk in chunks[:-1])
    assert_furniture(chunks[-1].landmarks, ["class 7", "class 7", "class 70"])
    write_labelled_ply(tmp_path / "b.ply", points[:, [0, 2, 1]] * (1000, 1000, -1000), classes, "label")
    assert_furniture(read_points(tmp_path / "b.ply", up="y", unit="mm").landmarks, ["class 7", "class 7", "class 70"])


def test_classes_of_las_beyond_the_standard(tmp_path: Path) -> None:
    """2, 6 and 7 are ground, buildings and noise of ASPRS; 70 is the user's."""
    laspy = pytest.importorskip("laspy")
    points, classes = furnished()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-4)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.classification = classes
    for name in ("a.las", "a.laz"):
        cloud.write(tmp_path / name)
        assert_furniture(read_points(tmp_path / name).landmarks, ["class 70"])
    cloud.classification = np.minimum(classes, 7)
    cloud.write(tmp_path / "b.las")
    assert read_points(tmp_path / "b.las").landmarks is None


def test_values_that_are_no_classes(tmp_path: Path) -> None:
    """Fractions, nan and negative numbers are none; thousands of them number things, not classes."""
    points, classes = furnished()
    for wrong in (classes + 0.5, np.full(len(points), np.nan), np.full(len(points), -1.0), np.full(len(points), 1e30)):
        write_labelled_ply(tmp_path / "a.ply", points, wrong, "label", kind="float")
        assert read_points(tmp_path / "a.ply").landmarks is None
    write_labelled_ply(tmp_path / "a.ply", points, np.arange(len(points)) // 30, "label")
    assert read_points(tmp_path / "a.ply").landmarks is None


def test_cells_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sightings, "MOST_OBJECT_CELLS", 1000)
    finder = ObjectFinder()
    rng = np.random.default_rng(0)
    for _ in range(3):
        finder.add(rng.uniform(0, 100, (2000, 3)), np.ones(2000, int))
    assert finder.is_full and len(finder.find_objects("a")) == 0
    again = ObjectFinder()
    for _ in range(50):  # the same cells over and over
        again.add(rng.uniform(0, 0.6, (500, 3)), np.ones(500, int))
    assert not again.is_full and len(again.find_objects("a")) == 1


def test_classes_at_the_ends_of_the_world_are_apart(recwarn):
    """A fuzzed cloud had points so far apart that their cells could not be numbered."""
    keys = np.array([[1, 0, 0, 0], [1, 2**40, 2**40, 2**40]], np.int64)
    assert len(set(sightings._label_clusters(keys).tolist())) == 2 and not recwarn.list
