"""Poses of one map in another that may be right: one type for them, many of them as arrays, and which of several are one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from topomerge.types import Array, Sim3

LARGEST_LOG_ODDS = 7.0


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A pose of map b in the frame of map a that may be right, from its proposal to its verification.

    Args:
        transform: T_ab.
        score: what the last step ranks hypotheses by: the agreement of walls in `fusion.search`, m of walls in
            `matching.consistency`, log odds that it is right, seen by itself, after `fusion.verify.rank`.
        probability: that it is right, beside all others; with "none of them" these sum to 1.
        features: what it was judged by, name -> number.
        from_rooms: was it proposed by matched rooms? Correlation never pushes such a one out.
        rooms: (M, 2) int64 rooms of a and of b that are one room then; a room may be in several.
        fit: (M,) float64 0..1, how well each of these pairs fits (share of floor in common).
    """

    transform: Sim3
    score: float = 0.0
    probability: float = 0.0
    features: Mapping[str, float] = field(default_factory=dict)
    from_rooms: bool = False
    rooms: Array = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    fit: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def log_odds(self) -> float:
        """Of its probability, between -7 and 7."""
        p = float(np.clip(self.probability, 1e-6, 1 - 1e-6))
        return float(np.clip(np.log(p / (1 - p)), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS))


@dataclass(frozen=True, eq=False)
class PoseArrays:
    """H poses u -> scale * R(yaw) u + shift.

    Args:
        yaw: (H,) rad.
        shift: (H, 3) m.
        scale: (H,).
        weight: (H,) how much speaks for each, as the similarity of the rooms that suggested it.
    """

    yaw: Array
    shift: Array
    scale: Array
    weight: Array

    @classmethod
    def of(cls, transforms: Sequence[Sim3]) -> PoseArrays:
        """Given poses, of weight 1."""
        yaw, scale = (np.array([getattr(t, name) for t in transforms], np.float64) for name in ("yaw", "scale"))
        return cls(yaw, np.array([t.translation for t in transforms], np.float64).reshape(-1, 3), scale, np.ones(len(yaw)))

    def __len__(self) -> int:
        return len(self.yaw)

    def take(self, rows: Array) -> PoseArrays:
        """The poses in the given rows."""
        return PoseArrays(self.yaw[rows], self.shift[rows], self.scale[rows], self.weight[rows])

    def transform(self, row: int) -> Sim3:
        """One of the poses, its yaw in [-pi, pi)."""
        x, y, z = self.shift[row].tolist()
        return Sim3(wrapped(float(self.yaw[row])), (x, y, z), float(self.scale[row]))

    def inverse(self) -> PoseArrays:
        """The poses of a in the frame of b."""
        c, s = np.cos(-self.yaw) / self.scale, np.sin(-self.yaw) / self.scale
        x, y, z = self.shift.T
        back = -np.stack([c * x - s * y, s * x + c * y, z / self.scale], axis=1)
        return PoseArrays(-self.yaw, back, 1 / self.scale, self.weight)

    def places(self, point: Array) -> Array:
        """(H, 3) m, where the poses put a point (3,)."""
        c, s = self.scale * np.cos(self.yaw), self.scale * np.sin(self.yaw)
        x, y, z = point
        return np.stack([c * x - s * y, s * x + c * y, self.scale * z], axis=1) + self.shift


def joined_poses(*parts: PoseArrays) -> PoseArrays:
    """The poses of all parts, one after the other."""
    names = ("yaw", "shift", "scale", "weight")
    return PoseArrays(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True)
class PoseTolerance:
    """Poses that differ by less count as one: m in each horizontal direction, rad, logarithm of the scale, m of height."""

    metres: float
    radians: float
    log_scale: float
    height: float = 0.8


def distinct(poses: PoseArrays, point: Array, tolerance: PoseTolerance, number: int | None = None) -> Array:
    """(n,) int64 rows of the first of each group of poses that are one.

    Args:
        poses: best first.
        point: (3,) m, of b, where poses are compared: its middle, as a frame's origin may lie far off.
        tolerance: how near poses are that are one.
        number: of poses after which to stop.
    """
    at = poses.places(point)
    size = np.log(poses.scale)
    selected: list[int] = []
    for row in range(len(poses)):
        rows = np.array(selected, np.int64)
        same = np.abs(at[rows, :2] - at[row, :2]).max(axis=1, initial=0.0) < tolerance.metres
        same &= np.abs(at[rows, 2] - at[row, 2]) < tolerance.height
        same &= np.abs(_wrapped(poses.yaw[rows] - poses.yaw[row])) < tolerance.radians
        same &= np.abs(size[rows] - size[row]) < tolerance.log_scale
        if not same.any():
            selected.append(row)
            if len(selected) == number:
                break
    return np.array(selected, np.int64)


def distinct_hypotheses(hypotheses: Sequence[PoseHypothesis], point: Array, tolerance: PoseTolerance) -> list[PoseHypothesis]:
    """The first of each group of hypotheses whose poses are one. Arguments as of `distinct`."""
    return [hypotheses[row] for row in distinct(PoseArrays.of([h.transform for h in hypotheses]), point, tolerance).tolist()]


def wrapped(yaw: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((yaw + np.pi) % (2 * np.pi) - np.pi)


def _wrapped(angles: Array) -> Array:
    """The same angles in [-pi, pi)."""
    out: Array = (angles + np.pi) % (2 * np.pi) - np.pi
    return out


def pose_difference(p: Sim3, q: Sim3, anchor: Array) -> tuple[float, float, float]:
    """How far two poses are apart: m at the anchor, rad, log scale.

    Args:
        anchor: (3,) m, a point of the moved map: the frame's origin may lie far away, where a small turn is a long way.
    """
    moved = float(np.linalg.norm(p.apply(anchor[None])[0] - q.apply(anchor[None])[0]))
    turned = abs(float((p.yaw - q.yaw + np.pi) % (2 * np.pi) - np.pi))
    return moved, turned, abs(float(np.log(p.scale / q.scale)))
