"""Analytic buildings for the tests of fusion, and their partial maps."""

from __future__ import annotations

import numpy as np

from tests.scenes import HEIGHT, Scene
from topomerge.extraction.cleaning import add_means
from topomerge.types import Sim3, VoxelGrid

MOVE = Sim3(2.1, (7.0, -3.0, 0.4))


def office(furnished: bool = True) -> Scene:
    """A bent corridor with eight rooms of different sizes on both sides, 24 x 14 m, and some furniture."""
    scene = Scene().shell(0, 0, 24, 14)
    scene.wall((0, 6), (18, 6), doors=(2.0, 7.5, 12.0, 16.5)).wall((0, 8), (18, 8), doors=(3.0, 9.0, 15.0))
    for x in (4.5, 9.5, 14.0):
        scene.wall((x, 0), (x, 6))
    for x in (6.0, 12.5):
        scene.wall((x, 8), (x, 14))
    scene.wall((18, 0), (18, 6)).wall((18, 8), (18, 14)).wall((20, 0), (20, 14), doors=(4.0, 10.0))
    if furnished:
        for x, y in ((1, 1), (6, 2), (11, 3.5), (2, 11), (8, 12), (14.5, 10), (21.5, 2), (22, 11.5)):
            scene.box(x, y, 0, x + 1.4, y + 0.8, 0.75)
        scene.box(16, 0.2, 0, 17.5, 0.7, 1.9).box(0.3, 8.4, 0, 0.9, 9.9, 1.9)
    return scene


def doubled(scene: Scene) -> np.ndarray:
    """The same storey above itself."""
    points = scene.points()
    return np.concatenate([points, points + np.array([0, 0, HEIGHT + 0.3], np.float32)])


def part(points: np.ndarray, low=(-1e9, -1e9), high=(1e9, 1e9)) -> np.ndarray:
    """Points within a rectangle, seen from above."""
    return points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)]


def grid_of(points: np.ndarray, frame: Sim3 | None = None, edge: float = 0.1, mean: bool = True) -> VoxelGrid:
    """Cells of points in another frame, with the mean of their points."""
    points = (frame or Sim3()).apply(points)
    base = np.floor(points.min(axis=0) / edge).astype(np.int64)
    cells = np.floor(points / edge).astype(np.int64) - base
    grid = VoxelGrid.from_cells(cells, base * edge, edge)
    return add_means(grid, points) if mean else grid


def off(found: Sim3, true: Sim3, at=(10.0, 7.0, 1.0)) -> tuple[float, float]:
    """Error of T_ab at a point of b's building, given in b's frame, m, and of the yaw, degrees."""
    point = np.array([at])
    turned = (found.yaw - true.yaw + np.pi) % (2 * np.pi) - np.pi
    return float(np.linalg.norm(found.apply(point) - true.apply(point))), float(np.degrees(abs(turned)))
