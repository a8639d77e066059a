"""One walk in every form in which it may come: as scans and poses, as a bag, as one cloud with viewpoints."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.io.bags import walk_messages, write_bag
from tests.io.walks import EDGE, Walk, house_walk, write_kitti, write_scans, write_tum
from topomerge.extraction import scan as scan_module
from topomerge.extraction.extract import extract
from topomerge.extraction.scan import read_scan
from topomerge.io import read_chunks
from topomerge.io.depth_images import PosedScan, iter_pieces
from topomerge.io.piece import BLOCK_POINTS
from topomerge.types import PointCloud, TopometricMap, VoxelGrid


def sources(folder: Path, walk: Walk) -> dict[str, Path]:
    """The walk as KISS-ICP's users, GLIM's users and robots have it."""
    write_scans(folder / "numbered", walk)
    write_kitti(folder / "numbered" / "poses.txt", walk.poses)
    write_scans(folder / "timed", walk, "ply", "nanoseconds")
    write_tum(folder / "timed" / "traj_lidar.txt", walk.poses, walk.times)
    paths = {name: folder / name for name in ("numbered", "timed")}
    if find_spec("rosbags") is not None:
        paths["tf"] = write_bag(folder / "tf", "mcap", walk_messages(walk))
        paths["odometry"] = write_bag(folder / "odometry", "bag", walk_messages(walk, "odometry"))
    return paths


@pytest.mark.longer
def test_the_same_cells_and_the_same_rooms(tmp_path: Path) -> None:
    """What a walk shows does not depend on the file: cells, rays, rooms, and the free space that its rays cross."""
    walk = house_walk()
    expected = extract(walk.cloud(), voxel_size=EDGE)
    assert len(expected.rooms) >= 4 and expected.free is not None
    for name, path in sources(tmp_path, walk).items():
        scan = read_scan(read_chunks(path, chunk=20_000), EDGE)
        np.testing.assert_array_equal(scan.grid.cells, expected.grid.cells, err_msg=name)
        assert scan.warnings == () and scan.rays is not None
        np.testing.assert_allclose(np.concatenate(scan.rays[0]), walk_rays(walk).ravel(), atol=1e-5, err_msg=name)
        if name in ("timed", "tf"):
            assert_same_map(extract(read_chunks(path), voxel_size=EDGE), expected)


def walk_rays(walk: Walk) -> np.ndarray:
    """(n, 3) where the ray of each point starts."""
    cloud = walk.cloud()
    assert cloud.poses is not None
    places: np.ndarray = cloud.poses[cloud.pose_of][:, :3, 3]
    return places


def assert_same_map(map: TopometricMap, expected: TopometricMap) -> None:
    assert map.free is not None and expected.free is not None
    np.testing.assert_array_equal(map.free.cells, expected.free.cells)
    np.testing.assert_array_equal(map.rooms["cells"], expected.rooms["cells"])
    np.testing.assert_allclose(map.rooms["centroid"], expected.rooms["centroid"], atol=1e-6)
    np.testing.assert_array_equal(map.edges["rooms"], expected.edges["rooms"])


@pytest.mark.longer
def test_free_space_is_what_the_rays_crossed() -> None:
    """Half-way along each ray is free space, or something that was met from elsewhere; views from guessed places miss some."""
    walk = house_walk()
    cloud = walk.cloud()
    halfway = (walk_rays(walk) + cloud.points) / 2
    free = []
    for source in (cloud, PointCloud(cloud.points)):
        map = extract(source, voxel_size=EDGE)
        assert map.free is not None
        occupied = VoxelGrid.from_cells(np.unique(map.grid.cells // 2, axis=0), map.grid.origin, 2 * EDGE)
        free.append(np.mean(map.free.contains(map.free.locate(halfway)) | occupied.contains(occupied.locate(halfway))))
    assert free[0] == 1.0 > free[1]


def test_many_small_scans_come_in_few_pieces() -> None:
    """The pieces, and what is held between them, do not grow with the number of scans."""
    asked = []

    def scans():
        for number in range(3000):
            asked.append(number)
            yield PosedScan(np.ones((500, 3)), np.eye(4), done=number / 3000)

    handed = []
    for piece in iter_pieces(scans()):
        handed.append(len(piece.points))
        assert len(asked) * 500 - sum(handed) == 0, "no scan is read before it is wanted"
    assert len(handed) == 4 and max(handed) < BLOCK_POINTS + 500


def test_rays_of_a_long_walk_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long, at most so many rays are held, spread over all of it."""
    monkeypatch.setattr(scan_module, "MOST_RAYS_HELD", 3000)
    rng = np.random.default_rng(0)

    def chunks():
        for number in range(40):
            pose = np.eye(4)[None].copy()
            pose[0, 0, 3] = number
            yield PointCloud(rng.uniform(0, 5, (1000, 3)).astype(np.float32), poses=pose, pose_of=np.zeros(1000, np.int32))

    rays = read_scan(chunks(), EDGE).rays
    assert rays is not None and len(rays[0]) == len(rays[1])
    assert 1000 < len(rays[0]) <= 3000
    counts = np.bincount(rays[0][:, 0].astype(int), minlength=40)
    assert counts.min() >= 0.5 * counts.max() > 0
