"""A simulated walk through a small house, and writers of the files in which robots leave such a walk behind."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.samples import write_ply
from topomerge.types import PointCloud

START = 1_570_513_628.25  # s, when the walk begins; a scan each 0.1 s
PERIOD = 0.1
EDGE = 0.1  # m, of the cells in which walks are compared


@dataclass(frozen=True, eq=False)
class Walk:
    """Scans of one sensor: points of each in the sensor's frame, where it was (z up), and when, s."""

    scans: list[np.ndarray]
    poses: np.ndarray
    times: np.ndarray

    @property
    def world(self) -> list[np.ndarray]:
        """The points of each scan in the fixed frame."""
        return [s.astype(float) @ p[:3, :3].T + p[:3, 3] for s, p in zip(self.scans, self.poses, strict=True)]

    def cloud(self) -> PointCloud:
        """All as one cloud with viewpoints."""
        numbers = np.repeat(np.arange(len(self.scans)), [len(s) for s in self.scans]).astype(np.int32)
        return PointCloud(np.concatenate(self.world).astype(np.float32), poses=self.poses, pose_of=numbers)

    def part(self, count: int) -> Walk:
        """The first scans."""
        return Walk(self.scans[:count], self.poses[:count], self.times[:count])


@cache
def house_walk() -> Walk:
    """A house as a LiDAR on a walk sees it; no point lies within a millimetre of the edge of a cell."""
    from topomerge.datasets.buildings.procedural import make_building
    from topomerge.datasets.simulation.scanner import scan_building

    cloud = scan_building(make_building("house", 3), "lidar", seed=1, spacing=0.06)
    assert cloud.poses is not None and cloud.pose_of is not None
    return _walk(cloud.points.astype(float), cloud.poses, cloud.pose_of)


def room_walk() -> Walk:
    """A room of 4 x 3 x 2.5 m seen from three places, turned and tilted each time."""
    rng = np.random.default_rng(0)
    sides = rng.uniform(0, 1, (3000, 3))
    sides[np.arange(3000), rng.integers(0, 3, 3000)] = rng.integers(0, 2, 3000)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("zyx", [(10, 2, 1), (100, -3, 2), (200, 1, -4)], degrees=True).as_matrix()
    poses[:, :3, 3] = (1, 1, 1.2), (2, 1.5, 1.2), (3, 2, 1.3)
    return _walk(sides * (4, 3, 2.5) + 0.05, poses, rng.integers(0, 3, 3000))


def _walk(points: np.ndarray, poses: np.ndarray, pose_of: np.ndarray) -> Walk:
    off = np.abs(points / EDGE - np.rint(points / EDGE)).min(axis=1) * EDGE > 1e-3
    points, pose_of = points[off], pose_of[off]
    seen = np.unique(pose_of)
    poses = poses[seen]
    rows = [points[pose_of == k] for k in seen]
    scans = [((r - p[:3, 3]) @ p[:3, :3]).astype(np.float32) for r, p in zip(rows, poses, strict=True)]
    return Walk(scans, poses, START + PERIOD * np.arange(len(scans)))


def write_scans(folder: Path, walk: Walk, kind: str = "bin", named: str = "number") -> list[Path]:
    """A file for each scan, named by its number or its time."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, (points, time) in enumerate(zip(walk.scans, walk.times.tolist(), strict=True)):
        seconds, rest = divmod(round(time * 1e9), 10**9)
        stem = {"number": f"{number:06d}", "time": f"{time:.6f}", "nanoseconds": f"{seconds}_{rest:09d}"}[named]
        paths.append(folder / f"{stem}.{kind}")
        write_scan(paths[-1], points)
    return paths


def write_scan(path: Path, points: np.ndarray, viewpoint: np.ndarray | None = None) -> None:
    """One scan; a PCD file may say where it was taken."""
    if path.suffix == ".bin":
        np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(path)
    elif path.suffix == ".ply":
        write_ply(path, points, None, text=False, order="<", kind="f4")
    else:
        place, (x, y, z, w) = (np.zeros(3), (0, 0, 0, 1)) if viewpoint is None else (viewpoint[:3, 3], quaternion(viewpoint))
        head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        head += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {' '.join(f'{v:.17g}' for v in (*place, w, x, y, z))}\n"
        path.write_bytes(f"{head}POINTS {len(points)}\nDATA binary\n".encode() + points.astype("<f4").tobytes())


def quaternion(pose: np.ndarray) -> np.ndarray:
    """x, y, z, w of a pose."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat()


def write_kitti(path: Path, poses: np.ndarray) -> Path:
    """Twelve numbers a line."""
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt="%.17g")
    return path


def write_tum(path: Path, poses: np.ndarray, times: np.ndarray) -> Path:
    """Eight numbers a line, behind a comment."""
    rows = [(t, *p[:3, 3], *quaternion(p)) for t, p in zip(times, poses, strict=True)]
    path.write_text("# time tx ty tz qx qy qz qw\n" + "".join(" ".join(f"{v:.17g}" for v in row) + "\n" for row in rows))
    return path
