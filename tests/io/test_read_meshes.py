"""Meshes and building models: sampled by area, without holes, the same every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.samples import write_ifc
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.ifc import compute_signed_area, trace_outline
from topomerge.kernels.meshes import compute_areas, sample_triangles

MESHES = ["mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb", "mesh.gltf"]
SURFACE = 2 * (4 * 3 + 4 * 2.5 + 3 * 2.5)  # m2 of the box


def random_triangles(count: int, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3, 3)) * size


def test_lattice_density_and_place() -> None:
    triangles = random_triangles(300)
    points, owner = sample_triangles(triangles, 0.05)
    assert len(points) == pytest.approx(compute_areas(triangles).sum() / 0.05**2, rel=0.01)
    np.testing.assert_allclose(np.bincount(owner, minlength=300), compute_areas(triangles) / 0.05**2, atol=60)
    a, b, c = (triangles[owner, i] for i in range(3))
    basis = np.stack([b - a, c - a], axis=2)
    weights = np.stack([np.linalg.lstsq(m, p, rcond=None)[0] for m, p in zip(basis[:500], (points - a)[:500], strict=True)])
    assert (weights > -1e-9).all() and (weights.sum(axis=1) < 1 + 1e-9).all()
    np.testing.assert_allclose(np.einsum("nij,nj->ni", basis[:500], weights), (points - a)[:500], atol=1e-9)


def test_triangles_smaller_than_the_lattice_get_their_share() -> None:
    triangles = random_triangles(200_000, 0.01)
    points, _ = sample_triangles(triangles, 0.05)
    assert len(points) == pytest.approx(compute_areas(triangles).sum() / 0.05**2, rel=0.03)


def test_lattice_leaves_no_holes() -> None:
    square = np.array([[[0, 0, 0], [4, 0, 0], [4, 4, 0]], [[0, 0, 0], [4, 4, 0], [0, 4, 0]]], float)
    points, _ = sample_triangles(square, 0.05)
    filled = np.unique(np.floor(points[:, :2] / 0.1).astype(int), axis=0)
    assert len(filled) >= 0.995 * 40 * 40


def test_degenerate_triangles_give_nothing() -> None:
    flat = np.zeros((4, 3, 3))
    flat[1, 1] = flat[2, 2] = (1, 0, 0)
    flat[3] = np.nan
    points, owner = sample_triangles(flat, 0.05)
    assert len(points) == len(owner) == 0


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_sampled_by_area(samples: dict[str, Path], name: str) -> None:
    up = "z" if name.endswith(("glb", "gltf")) else None  # the sample was written with z up, against the format's rule
    cloud = read_points(samples[name], spacing=0.1, up=up)
    assert len(cloud) == pytest.approx(SURFACE / 0.1**2, rel=0.05)
    np.testing.assert_allclose(cloud.points.min(axis=0), (-2, -1.5, -1.25), atol=1e-6)
    np.testing.assert_allclose(cloud.points.max(axis=0), (2, 1.5, 1.25), atol=1e-6)
    on_a_side = np.isclose(np.abs(cloud.points), (2, 1.5, 1.25), atol=1e-5).any(axis=1)
    assert on_a_side.all()
    np.testing.assert_array_equal(read_points(samples[name], spacing=0.1, up=up).points, cloud.points)


def test_gltf_is_y_up_unless_told(samples: dict[str, Path]) -> None:
    assert np.ptp(read_points(samples["mesh.glb"]).points, axis=0) == pytest.approx((4, 2.5, 3), abs=1e-5)


def test_spacing_is_metres_whatever_the_unit(samples: dict[str, Path]) -> None:
    cloud = read_points(samples["mesh.obj"], unit="cm", spacing=0.001)
    assert len(cloud) == pytest.approx(SURFACE / 0.1**2, rel=0.05)
    assert "smaller than any room" in cloud.warnings[0]


def test_a_mesh_in_the_wrong_unit_is_refused(samples: dict[str, Path]) -> None:
    with pytest.raises(InputError, match="check --unit"):
        read_points(samples["mesh.obj"], scale=10_000)


def test_no_vertex_is_lost_and_colors_are_kept(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    head += (
        "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\nproperty list uchar int vertex_indices\n"
    )
    rows = "0 0 0 9 8 7\n1 0 0 9 8 7\n1 1 0 9 8 7\n0 1 0 9 8 7\n7 7 7 1 2 3\n4 0 1 2 3\n"
    (tmp_path / "a.ply").write_text(head + "end_header\n" + rows)
    cloud = read_points(tmp_path / "a.ply", spacing=0.1)
    assert [7, 7, 7] in cloud.points.tolist()
    assert len(cloud) == pytest.approx(5 + 100, abs=15)
    assert cloud.colors is not None
    assert (cloud.colors[5:] == (9, 8, 7)).all()


def test_obj_with_points_only(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib none.mtl\nv 1 2 3\nv 4 5 6\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.obj").points, [[1, 2, 3], [4, 5, 6]])


def test_outline_of_a_body_with_a_hole_and_of_one_without_floor() -> None:
    ring = np.array([[0, 0], [4, 0], [4, 4], [0, 4], [1, 1], [3, 1], [3, 3], [1, 3]], float)
    faces = [[i, (i + 1) % 4, 4 + i] for i in range(4)] + [[(i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    flat = np.column_stack([ring, np.zeros(8)])
    body = np.concatenate([flat, flat + np.array((0, 0, 3))])
    polygon = trace_outline(body, np.array([*faces, *(np.array(faces)[:, ::-1] + 8)]))
    assert compute_signed_area(polygon) == pytest.approx(16)
    walls = np.array([[0, 1, 8], [1, 9, 8], [1, 2, 9], [2, 10, 9]])
    assert compute_signed_area(trace_outline(body, walls)) == pytest.approx(16)


@pytest.mark.longer
def test_ifc_rooms_walls_and_doors(samples: dict[str, Path]) -> None:
    cloud = read_points(samples["model.ifc"], spacing=0.1)
    built = cloud.points[(cloud.points[:, 0] > 3.999) & (cloud.points[:, 0] < 4.201)]
    np.testing.assert_allclose(built.min(axis=0), (4, 0, 0), atol=1e-4)
    np.testing.assert_allclose(built.max(axis=0), (4.2, 3, 2.5), atol=1e-4)
    wall = 2 * (0.2 * 3 + 0.2 * 2.5 + 3 * 2.5)
    assert len(built) == pytest.approx(wall / 0.1**2, rel=0.1)
    assert any("no floors under 3 of its spaces" in w for w in cloud.warnings)
    floors = [int((np.abs(cloud.points[:, 2] - z) < 1e-3).sum()) for z in (0.0, 2.8)]
    assert floors == pytest.approx([(12 + 9) / 0.1**2, 12 / 0.1**2], rel=0.1)
    rooms = [(r.name, r.kind, r.storey, round(r.floor, 3), round(r.ceiling, 3)) for r in cloud.rooms]
    assert rooms == [("1", "Office", 0, 0, 2.5), ("2", "Hall", 0, 0, 2.5), ("3", "Attic", 1, 2.8, 4.8)]
    assert [compute_signed_area(r.polygon) for r in cloud.rooms] == pytest.approx([12, 9, 12], rel=1e-3)
    assert len(cloud.rooms[1].polygon) == 6
    shut = read_points(samples["model.ifc"], spacing=0.1, doors=True)
    assert shut.points[:, 1].max() == pytest.approx(4.9, abs=1e-4)
    np.testing.assert_array_equal(read_points(samples["model.ifc"], spacing=0.1).points, cloud.points)


@pytest.mark.longer
def test_ifc_floors_are_made_only_where_no_slab_is(tmp_path: Path) -> None:
    write_ifc(tmp_path / "slab.ifc", slab=True)
    cloud = read_points(tmp_path / "slab.ifc", spacing=0.1)
    assert any("no floors under 1 of its spaces" in w for w in cloud.warnings)
    assert int((np.abs(cloud.points[:, 2]) < 1e-3).sum()) == pytest.approx(8.2 * 3 / 0.1**2, rel=0.1)
