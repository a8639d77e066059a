"""Public 3D sets: small files in the owners' formats, with known rooms and known transforms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.pairs.pairs import Pair, is_identity
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.public import cslamd, matterport, rscan, s3dis, scannet
from topomerge.datasets.public import sources as public

from topomerge.errors import InputError
from topomerge.types import Sim3

ROOMS = 6


def box(x: float, wide: float = 3.0, deep: float = 4.0, high: float = 2.5, step: float = 0.2) -> np.ndarray:
    """Points on the floor and the walls of a room."""
    u, v, w = (np.arange(0, size + 1e-9, step) for size in (wide, deep, high))
    floor = np.array([(a, b, 0) for a in u for b in v])
    sides = np.array(
        [(a, b, c) for c in w for a, b in [(a, e) for a in u for e in (0, deep)] + [(e, b) for b in v for e in (0, wide)]]
    )
    return np.concatenate([floor, sides]) + [x, 0, 0]


def row() -> list[np.ndarray]:
    """Rooms side by side, 0.2 m of wall between them, each a little deeper than the one before."""
    return [box(3.2 * k, deep=4.0 + 0.4 * k) for k in range(ROOMS)]


def mesh_text(points: np.ndarray, kind: str = "ply") -> str:
    """A mesh of one tiny triangle a point."""
    corners = (points[:, None] + np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0.01]])).reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    if kind == "obj":
        lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        return "\n".join(lines) + "\n"
    head = f"ply\nformat ascii 1.0\nelement vertex {len(corners)}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    return head + "\n".join([f"{x:.4f} {y:.4f} {z:.4f}" for x, y, z in corners] + [f"3 {a} {b} {c}" for a, b, c in faces]) + "\n"


def only(results) -> Pair:
    """The one pair."""
    (result,) = (r for _, r in results)
    assert isinstance(result, Pair), result
    return result


def refusals(results) -> list[str]:
    """One line each."""
    reasons = [r.reason for _, r in results if isinstance(r, Refusal)]
    assert all("\n" not in r and len(r) < 400 for r in reasons)
    return reasons


def agrees(pair: Pair) -> None:
    """The truth lays each shared room's points of b onto those of a."""
    assert not is_identity(pair.truth)
    moved = pair.truth.apply(pair.b.points.astype(float) + pair.b.shift)
    a = pair.a.points.astype(float) + pair.a.shift
    assert pair.shared
    for i, j in pair.shared:
        mine, theirs = a[pair.a.labels == i], moved[pair.b.labels == j]
        assert len(mine) == len(theirs)
        assert np.abs(mine - theirs).max() < 1e-3


# --- S3DIS


def write_area(folder: Path, stray: bool = False) -> Path:
    for k, points in enumerate(row()):
        name = f"office_{k + 1}" if k else "hallway_1"
        room = folder / "Area_1" / name
        (room / "Annotations").mkdir(parents=True)
        rows = "".join(f"{x:.3f} {y:.3f} {z:.3f} 10 20 30\n" for x, y, z in points)
        if k == 2:  # only the objects are there
            half = rows.index("\n", len(rows) // 2) + 1
            (room / "Annotations" / "floor_1.txt").write_text(rows[:half])
            (room / "Annotations" / "wall_1.txt").write_text(rows[half:])
        else:
            (room / f"{name}.txt").write_text(rows.replace("0.200", "0.2\x1000", 1) if stray and k == 0 else rows)
    return folder


def test_s3dis_area_is_cut_into_two_parts_with_rooms_in_common(tmp_path):
    pair = only(public.iter_public_pairs(write_area(tmp_path), "s3dis"))
    agrees(pair)
    assert 0 < pair.overlap < 1
    assert set(pair.visited[0]) != set(pair.visited[1])
    assert {i for i, _ in pair.shared} == set(pair.visited[0]) & set(pair.visited[1])
    again = only(public.iter_public_pairs(tmp_path, "s3dis"))
    np.testing.assert_array_equal(pair.b.points, again.b.points)


def test_s3dis_rooms_become_labels_and_a_stray_byte_is_passed_over(tmp_path):
    cloud = s3dis.read_area(write_area(tmp_path, stray=True) / "Area_1")
    assert [r.name for r in cloud.rooms] == ["hallway_1", *(f"office_{k}" for k in range(2, ROOMS + 1))]
    assert cloud.rooms[0].kind == "corridor"
    assert np.bincount(cloud.labels).tolist() == [len(np.unique(np.round(p, 3), axis=0)) for p in row()]
    assert cloud.rooms[0].polygon.min(axis=0) == pytest.approx([0, 0])
    assert not cloud.warnings


def test_s3dis_damage_costs_one_room_only(tmp_path):
    write_area(tmp_path)
    (tmp_path / "Area_1" / "office_6" / "office_6.txt").write_text("1 2 3 4 5 6\n1 2\n")
    (tmp_path / "Area_2" / "office_1").mkdir(parents=True)
    cloud = s3dis.read_area(tmp_path / "Area_1")
    assert len(cloud.rooms) == ROOMS - 1 and "office_6" in cloud.warnings[0]
    results = list(public.iter_public_pairs(tmp_path, "s3dis"))
    assert [type(r).__name__ for _, r in results] == ["Pair", "Refusal"]
    assert "no room that can be read" in refusals(results)[0]


# --- Matterport3D


def write_house(folder: Path, regions: bool = True, lines: int | None = None, prefix: str = "") -> Path:
    house, rooms = folder / "1pXnuDYAj8r", row()
    (house / "house_segmentations").mkdir(parents=True)
    text = [f"{prefix}H 1pXnuDYAj8r - 0 0 {4 * ROOMS} {ROOMS} 0 0 0 {ROOMS} 0 2 0 0 0 0 0 0 0 0 19 6 3 0 0 0 0 0"]
    text += ["L 0 3 - 5 2 1 0 0 0 9 6 3 0 0 0 0 0", "L 1 3 - 5 2 1 9 0 0 19 6 3 0 0 0 0 0"]
    corners = []
    for k, points in enumerate(rooms):
        low, high = points.min(axis=0), points.max(axis=0)
        bounds = " ".join(f"{v:.2f}" for v in (*low, *high))
        label = "h" if k == 0 else "b"
        text.append(f"R {k} {k // 3} 0 0 {label} 1 1 1 {bounds} 2.5 0 0 0 0")
        text.append(f"S {k} {k} 0 - 1 1 0 0 0 1 {bounds} 0 0 0 0 0")
        around = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        corners += [f"V {4 * k + n} {k} - {x:.2f} {y:.2f} 0 0 0 1 0 0 0" for n, (x, y) in enumerate(around)]
    (house / "house_segmentations" / "1pXnuDYAj8r.house").write_text("\n".join((text + corners)[:lines]) + "\n")
    if regions:
        (house / "region_segmentations").mkdir()
        for k, points in enumerate(rooms):
            (house / "region_segmentations" / f"region{k}.ply").write_text(mesh_text(points))
    else:
        (house / "house_segmentations" / "1pXnuDYAj8r.ply").write_text(mesh_text(np.concatenate(rooms)))
    return folder


@pytest.mark.longer
@pytest.mark.parametrize("regions", [True, False])
@pytest.mark.parametrize("prefix", ["", "ASCII 1.1\n"])
def test_matterport_regions_become_rooms_on_levels(tmp_path, regions, prefix):
    cloud = matterport.read_house(write_house(tmp_path, regions, prefix=prefix) / "1pXnuDYAj8r")
    assert [r.storey for r in cloud.rooms] == [0, 0, 0, 1, 1, 1]
    assert [r.kind for r in cloud.rooms] == ["corridor"] + ["bedroom"] * (ROOMS - 1)
    assert cloud.rooms[1].polygon[2] == pytest.approx([6.2, 4.4])
    for k in range(ROOMS):
        x = cloud.points[cloud.labels == k, 0]
        assert (x.min(), x.max()) == pytest.approx((3.2 * k, 3.2 * k + 3.0), abs=0.02)


@pytest.mark.longer
def test_matterport_pair(tmp_path):
    agrees(only(public.iter_public_pairs(write_house(tmp_path), "matterport")))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: write_house(f, lines=5), "cut short"),
        (lambda f: (write_house(f) / "1pXnuDYAj8r/region_segmentations/region2.ply").unlink(), "no such file"),
        (lambda f: (write_house(f) / "1pXnuDYAj8r/region_segmentations/region2.ply").write_text("ply\nformat"), "PLY"),
        (lambda f: (write_house(f) / "1pXnuDYAj8r/house_segmentations/1pXnuDYAj8r.house").write_text("R 1 2\n"), "no .house"),
    ],
)
def test_matterport_refuses(tmp_path, damage, said):
    damage(tmp_path)
    (reason,) = refusals(public.iter_public_pairs(tmp_path, "matterport"))
    assert said in reason


# --- ScanNet


def write_scene(folder: Path, name: str = "scene0000_00") -> Path:
    scene = folder / name
    scene.mkdir(parents=True)
    points = box(0)
    (scene / f"{name}_vh_clean_2.ply").write_text(mesh_text(points))
    segments = np.repeat((points[:, 2] > 0).astype(int), 3).tolist()
    (scene / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"sceneId": name, "segIndices": segments}))
    groups = [
        {"id": 0, "objectId": 0, "segments": [0], "label": "floor"},
        {"id": 1, "objectId": 1, "segments": [1], "label": "wall"},
    ]
    (scene / f"{name}.aggregation.json").write_text(json.dumps({"sceneId": name, "segGroups": groups}))
    turned = "0 -1 0 5 1 0 0 0 0 0 1 -0.5 0 0 0 1"
    (scene / f"{name}.txt").write_text(f"axisAlignment = {turned} \nsceneType = Apartment\nnumDepthFrames = 7\n")
    return folder


def test_scannet_scene_is_aligned_and_its_objects_are_known(tmp_path):
    for name in ("scene0000_00", "scene0000_01", "scene0001_00"):
        write_scene(tmp_path, name)
    scene = scannet.read_scene(tmp_path / "scene0000_00")
    corners = (box(0)[:, None] + np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0.01]])).reshape(-1, 3)
    expected = np.column_stack([5 - corners[:, 1], corners[:, 0], corners[:, 2] - 0.5])
    np.testing.assert_allclose(scene.cloud.points, expected, atol=1e-3)
    assert scene.objects == ("floor", "wall")
    np.testing.assert_array_equal(scene.object_of, np.repeat(box(0)[:, 2] > 0, 3).astype(int))
    assert scene.cloud.rooms[0].kind == "Apartment"
    assert scannet.group_scans_by_place(tmp_path) == {"scene0000": ["scene0000_00", "scene0000_01"]}


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("_vh_clean_2.ply", "ply\nformat ascii 1.0\nelement vertex 9\n", "no end"),
        ("_vh_clean_2.0.010000.segs.json", '{"segIndices": [1, 2', "cut short"),
        ("_vh_clean_2.0.010000.segs.json", '{"segIndices": [1, 2]}', "one version"),
        (".aggregation.json", "{}", "segGroups"),
        (".txt", "axisAlignment = 1 2 3\n", "16 numbers"),
    ],
)
def test_scannet_refuses_one_scene_and_goes_on(tmp_path, file, text, said):
    write_scene(tmp_path, "scene0000_00")
    write_scene(tmp_path, "scene0000_01")
    (tmp_path / "scene0000_00" / f"scene0000_00{file}").write_text(text)
    results = dict(scannet.iter_scenes(tmp_path))
    assert said in results["scene0000_00"].reason
    assert isinstance(results["scene0000_01"], scannet.Scene)


# --- 3RScan

REFERENCE, LATER = "531cff08-0021-28f6-8e08-ba2eeb945e09", "19eda6f4-55aa-29a0-8893-8eac3a4d8193"


def transform(lean: float = 0.0) -> np.ndarray:
    """Of a later scan into the reference."""
    matrix = Sim3(0.7, (1.5, -2.0, 0.1)).matrix
    c, s = np.cos(lean), np.sin(lean)
    matrix[:3, :3] = matrix[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return matrix


def write_rscan(folder: Path, lean: float = 0.0, numbers: object = None) -> Path:
    matrix = transform(lean)
    back = np.linalg.inv(matrix)
    for name, points in ((REFERENCE, box(0)), (LATER, box(0) @ back[:3, :3].T + back[:3, 3])):
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / name / "mesh.refined.v2.obj").write_text(mesh_text(points, "obj"))
    listed = matrix.T.ravel().tolist() if numbers is None else numbers
    scans = [{"reference": LATER, "transform": listed}, {"reference": "not-fetched", "transform": listed}]
    (folder / "3RScan.json").write_text(json.dumps([{"reference": REFERENCE, "type": "train", "scans": scans}]))
    return folder


@pytest.mark.parametrize("lean", [0.0, 0.02])
def test_rscan_truth_is_the_published_transform(tmp_path, lean):
    results = list(public.iter_public_pairs(write_rscan(tmp_path, lean), "rscan"))
    assert "not-fetched" in refusals(results)[0]
    pair = next(r for _, r in results if isinstance(r, Pair))
    assert not is_identity(pair.truth)
    a, b = pair.a.points[::7], pair.truth.apply(pair.b.points)
    from scipy.spatial import cKDTree

    assert np.median(cKDTree(b).query(a)[0]) < 0.01
    assert pair.overlap > 0.9


@pytest.mark.parametrize(
    ("numbers", "said"),
    [([1.0, 2.0], "16 numbers"), ((np.eye(4) * 2).ravel().tolist(), "not rigid"), (transform(0.5).T.ravel().tolist(), "leans")],
)
def test_rscan_refuses_wrong_transforms(tmp_path, numbers, said):
    reasons = refusals(public.iter_public_pairs(write_rscan(tmp_path, numbers=numbers), "rscan"))
    assert any(said in reason for reason in reasons)


def test_rscan_without_a_transform_and_without_a_list(tmp_path):
    write_rscan(tmp_path)
    scenes = json.loads((tmp_path / "3RScan.json").read_text())
    del scenes[0]["scans"][0]["transform"]
    (tmp_path / "3RScan.json").write_text(json.dumps(scenes))
    assert "hidden test set" in refusals(public.iter_public_pairs(tmp_path, "rscan"))[0]
    (tmp_path / "3RScan.json").write_text("[{")
    assert "cut short" in refusals(public.iter_public_pairs(tmp_path, "rscan"))[0]


def test_rscan_transform_in_millimetres():
    matrix = transform()
    matrix[:3, 3] *= 1000
    np.testing.assert_allclose(rscan.read_transform(matrix.T.ravel().tolist(), "x"), transform(), atol=1e-9)


# --- CSD

POSES = (
    "bathroom2study [(0.919967,0.0083013),(0.00338598,4.66536),(-0.39198,0.062948),(-0.00113867,-1.08955)]\n"
    "turret2sittingroom [(1,0),(0,0),(0,0),(0,0)]\n"
)


def write_csd(folder: Path, poses: str = POSES) -> Path:
    (folder / "Flat" / "meshes").mkdir(parents=True)
    (folder / "Flat" / "global_poses.txt").write_text(poses)
    for k, name in enumerate(("bathroom2study", "turret2sittingroom")):
        points = np.concatenate(row()[k : k + 3])
        down = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])  # y points down
        (folder / "Flat" / "meshes" / f"{name}.ply").write_text(mesh_text(down))
    return folder


def test_csd_pair_stands_upright(tmp_path):
    pair = only(public.iter_public_pairs(write_csd(tmp_path), "cslamd"))
    assert not is_identity(pair.truth)
    assert np.ptp(pair.a.points[:, 2]) == pytest.approx(2.4, abs=0.05)
    from scipy.spatial import cKDTree

    moved = pair.truth.apply(pair.b.points)
    near = cKDTree(pair.a.points).query(moved)[0] < 0.02
    assert 0.5 < near.mean() < 0.8  # two of the three rooms are in both


def test_csd_global_poses_are_rigid(tmp_path):
    poses = cslamd.read_poses(write_csd(tmp_path) / "Flat" / "global_poses.txt")
    np.testing.assert_allclose(poses["turret2sittingroom"], np.eye(4))
    turn = poses["bathroom2study"][:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(46.2, abs=0.3)


def test_dual_quaternion_turns_then_moves():
    real, shift = np.array([np.cos(0.3), 0, 0, np.sin(0.3)]), np.array([1.0, 2.0, 3.0])
    w, v = real[0], real[1:]
    dual = np.array([-shift @ v, *(w * shift + np.cross(shift, v))]) / 2  # 1/2 t q
    matrix = cslamd.convert_dual_quaternion(real, dual)
    np.testing.assert_allclose(matrix, Sim3(0.6, (1, 2, 3)).matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("poses", "said"), [("bathroom2study [(1,0),(0,0)]\n", "line 1"), (POSES.replace("turret", "tower"), "no mesh of")]
)
def test_csd_refuses(tmp_path, poses, said):
    assert any(said in r for r in refusals(public.iter_public_pairs(write_csd(tmp_path, poses), "cslamd")))


# --- all of them


@pytest.mark.parametrize("source", public.PUBLIC_SOURCES)
def test_a_folder_of_something_else_is_refused_in_one_line(tmp_path, source):
    (tmp_path / "holiday.jpg").write_bytes(b"\xff\xd8")
    assert len(refusals(public.iter_public_pairs(tmp_path, source))) == 1
    with pytest.raises(InputError):
        public.iter_public_pairs(tmp_path / "nothing", source)


def test_an_unknown_source_is_refused(tmp_path):
    with pytest.raises(InputError, match="s3dis"):
        public.iter_public_pairs(tmp_path, "kitti")


def test_parts_are_connected_and_overlap():
    chain = {k: {n for n in (k - 1, k + 1) if 0 <= n < 9} for k in range(9)}
    for seed in range(20):
        a, b = public.sample_two_parts(chain, np.random.default_rng(seed))
        assert set(a) & set(b) and set(a) - set(b) and set(b) - set(a)
        assert all(np.diff(part).max(initial=1) == 1 for part in (a, b))
    with pytest.raises(InputError, match="hang together"):
        public.sample_two_parts({0: {1}, 1: {0}}, np.random.default_rng(0))
