"""Points of a partial map, and the rooms that are truly there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from topomerge.types.arrays import Array, require
from topomerge.types.grid import VoxelGrid


@dataclass(frozen=True, eq=False)
class TrueRoom:
    """A room of the truth, not of an estimate: from a building model, a plan or a simulator."""

    name: str
    polygon: Array  # (k, 2) float64, outline of the floor, counter-clockwise, not closed
    floor: float
    ceiling: float
    storey: int = 0
    kind: str = ""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one partial map, z up, in metres.

    Args:
        points: (N, 3) float32.
        shift: (3,) float64; ``points + shift`` are the coordinates of the input file: float32 alone would lose centimetres in a
            national grid.
        colors: (N, 3) uint8.
        labels: (N,) int32, true room of each point (index into `rooms`), -1: none.
        poses: (K, 4, 4) float64, sensor into the file's frame.
        pose_of: (N,) int32, index into `poses`, -1: unknown.
        free: cells that the sensor saw to be empty.
        rooms: the true rooms, where they are known.
        source: file that the points come from.
        warnings: what looked wrong while it was read.
        intensities: (N,) float32, how much of its light came back, in whatever the file counts in.
        upright: z is known to be up, so that nobody needs to level it: of a plan, a building model, a simulated scan.

    Raises:
        ValueError: arrays of other shapes, or points that are no array of numbers.
    """

    points: Array
    shift: Array = field(default_factory=lambda: np.zeros(3))
    colors: Array | None = None
    labels: Array | None = None
    poses: Array | None = None
    pose_of: Array | None = None
    free: VoxelGrid | None = None
    rooms: tuple[TrueRoom, ...] = ()
    source: str = ""
    warnings: tuple[str, ...] = ()
    intensities: Array | None = None
    upright: bool = False

    def __post_init__(self) -> None:
        numbers = isinstance(self.points, np.ndarray) and self.points.dtype.kind in "biuf"
        require(numbers, f"points must be an (N, 3) array of numbers, not {getattr(self.points, 'dtype', type(self.points))}")
        require(self.points.ndim == 2 and self.points.shape[1] == 3, f"points must be (N, 3), not {self.points.shape}")
        for name in ("colors", "labels", "pose_of", "intensities"):
            values = getattr(self, name)
            require(values is None or len(values) == len(self.points), f"{name} must have one row a point")

    def __len__(self) -> int:
        return len(self.points)
