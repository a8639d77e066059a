"""Gravity-aligned similarities: what brings one map into the frame of another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.types.arrays import Array, require

ROUNDING = 1e-6  # by which a matrix may miss a similarity that keeps the vertical, times the size of its numbers


@dataclass(frozen=True)
class Sim3:
    """A gravity-aligned similarity: p -> scale * Rz(yaw) p + translation."""

    yaw: float = 0.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        values = (self.yaw, *self.translation, self.scale)
        require(all(np.isfinite(v) for v in values) and self.scale > 0, f"not a similarity: {values}")

    @staticmethod
    def from_matrix(matrix: Array) -> Sim3:
        """Read the similarity of a (4, 4) matrix.

        Raises:
            ValueError: it is none that keeps the vertical.
        """
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or matrix[2, 2] <= 0:
            raise ValueError("a transform that is none")
        x, y, z = matrix[:3, 3].tolist()
        pose = Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), float(matrix[2, 2]))
        if not np.allclose(pose.matrix, matrix, rtol=0, atol=ROUNDING * max(pose.scale, 1.0)):
            raise ValueError("a transform that is none")
        return pose

    @property
    def matrix(self) -> Array:
        """(4, 4) float64."""
        c, s = self.scale * np.cos(self.yaw), self.scale * np.sin(self.yaw)
        m = np.eye(4)
        m[:2, :2] = ((c, -s), (s, c))
        m[2, 2] = self.scale
        m[:3, 3] = self.translation
        return m

    def apply(self, points: Array) -> Array:
        """Transform (n, 3) points."""
        m = self.matrix
        return np.asarray(points, np.float64) @ m[:3, :3].T + m[:3, 3]

    def inverse(self) -> Sim3:
        """The similarity that undoes this one."""
        back = Sim3(-self.yaw, (0.0, 0.0, 0.0), 1.0 / self.scale)
        x, y, z = (-back.apply(np.array([self.translation]))[0]).tolist()
        return Sim3(-self.yaw, (x, y, z), 1.0 / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        x, y, z = self.apply(np.array([other.translation]))[0].tolist()
        yaw = (self.yaw + other.yaw + np.pi) % (2 * np.pi) - np.pi
        return Sim3(float(yaw), (x, y, z), self.scale * other.scale)
