"""Points and occupied cells of a partial map (seeds 2.2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from topomerge.types.landmarks import Landmarks

Array = NDArray[Any]
LogFn = Callable[[str], None]  # is called with a line of progress
AXIS_LIMIT = 1 << 21  # cells along an axis: what the codes of `topomerge.kernels.voxels` hold


def require(condition: bool, message: str, *values: object) -> None:
    """Refuse what a type can't hold.

    Args:
        message: of the error; in place of each {} comes one of the values, which are printed only then.

    Raises:
        ValueError: the condition does not hold.
    """
    if not condition:
        raise ValueError(message.format(*values))


def wrap_to_turn(angle: Any, turn: float) -> Any:
    """Return the same angle, rad, in [0, turn): the remainder of next to nothing below 0 is `turn` itself by rounding, which is
    0."""
    rest = np.asarray(angle, float) % turn
    return np.where(rest < turn, rest, 0.0)


def compute_extent(cells: Array) -> tuple[Array, Array]:
    """Return the least and the largest of (n, d) cells or points along each axis; along rows it would take ten times as long."""
    columns = cells.T
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def are_within(cells: Array, low: Any, high: Any) -> Array:
    """Return (...,) bool: is low <= cell < high along each axis, of (..., d) whole numbers? One axis after the other, which takes
    a fifth as long as `all` of each row."""
    inside = np.ones(cells.shape[:-1], bool)
    for axis, bounds in enumerate(zip(*(np.broadcast_to(side, cells.shape[-1]).tolist() for side in (low, high)), strict=True)):
        inside &= (cells[..., axis] >= bounds[0]) & (cells[..., axis] < bounds[1])
    return inside


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Occupied cells of a regular grid with properties (seeds 2.2).

    Cells are unique, not negative and stand in Morton order; ``origin`` is the seeds' V_min and ``edge`` their e_l.

    Args:
        cells: (n, 3) int32, sorted by Morton code (see `from_cells` for cells in any order).
        origin: (3,) float64, the corner of cell (0, 0, 0).
        edge: edge length of a cell, m.
        shape: number of cells along each axis; V_max = origin + shape * edge.
        properties: name -> (n, ...) array.
    """

    cells: Array
    origin: Array
    edge: float
    shape: tuple[int, int, int]
    properties: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(self.edge > 0 and np.isfinite(self.edge), "edge length must be above 0 m, not {}", self.edge)
        whole = np.shape(self.origin) == (3,) and bool(np.isfinite(self.origin).all())
        require(whole, "origin must be (3,), not {}", self.origin)
        require(self.cells.ndim == 2 and self.cells.shape[1] == 3, "cells must be (n, 3), not {}", self.cells.shape)
        require(self.cells.dtype == np.int32, "cells must be int32, not {}", self.cells.dtype)
        fits = all(0 < s <= AXIS_LIMIT for s in self.shape)
        require(fits, "grid shape {} is outside 1..{}", self.shape, AXIS_LIMIT)
        if len(self.cells):
            low, high = compute_extent(self.cells)
            require(bool((low >= 0).all() and (high < self.shape).all()), "cells {}..{} outside {}", low, high, self.shape)
            require(bool((self.codes[1:] > self.codes[:-1]).all()), "cells must be unique and in Morton order")
        for name, values in self.properties.items():
            require(len(values) == len(self.cells), "property {} must have one row a cell", name)

    @staticmethod
    def from_cells(
        cells: Array,
        origin: Array | None = None,
        edge: float = 0.1,
        shape: tuple[int, int, int] | None = None,
        properties: Mapping[str, Array] | None = None,
    ) -> VoxelGrid:
        """Build a grid from cells in any order; a repeated cell comes once, with the properties of their first mention."""
        cells = np.asarray(cells).reshape(-1, 3)
        if len(cells):  # before the codes: they hold 21 bits an axis, and a cell beyond would take the place of another
            require(np.issubdtype(cells.dtype, np.integer), "cells must be integers, not {}", cells.dtype)
            low, high = compute_extent(cells)
            inside = bool((low >= 0).all() and (high < AXIS_LIMIT).all())
            require(inside, "cells {}..{} not in 0..{}", low, high, AXIS_LIMIT)
        from topomerge.kernels import voxels  # here: numba takes a fifth of a second, and files are opened before

        cells = np.ascontiguousarray(cells, np.int32)
        codes = voxels.encode(cells)
        first = voxels.find_unique_rows(codes)
        unique_cells = np.ascontiguousarray(cells[first])
        if shape is None:
            shape = tuple(int(s) + 1 for s in high) if len(unique_cells) else (1, 1, 1)  # type: ignore[assignment]
        assert shape is not None
        origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
        chosen = {k: v[first] for k, v in (properties or {}).items()}
        return VoxelGrid._build(codes[first], unique_cells, origin, edge, shape, chosen)

    @staticmethod
    def from_codes(
        codes: Array, origin: Array, edge: float, shape: tuple[int, int, int], properties: Mapping[str, Array] | None = None
    ) -> VoxelGrid:
        """Return a grid of ascending Morton codes, (n,) uint64."""
        from topomerge.kernels import voxels

        return VoxelGrid._build(codes, voxels.decode(codes), origin, edge, shape, properties or {})

    @staticmethod
    def _build(codes: Array, *values: Any) -> VoxelGrid:
        """Build a grid of the fields' values, whose codes are known: they are not computed again."""
        grid = object.__new__(VoxelGrid)
        grid.__dict__["codes"] = codes
        grid.__init__(*values)  # type: ignore[misc]
        return grid

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def codes(self) -> Array:
        """(n,) uint64 Morton codes, ascending."""
        from topomerge.kernels import voxels

        return voxels.encode(self.cells)

    @cached_property
    def _bricks(self) -> tuple[Array, Array]:
        from topomerge.kernels import voxels

        return voxels.build(self.cells, self.shape)

    @cached_property
    def _columns(self) -> Array:
        from topomerge.kernels import stencil

        return stencil.build_columns(self.cells, *self._bricks)

    @cached_property
    def _lowest_of_column(self) -> Array:
        rows = np.flatnonzero(~self.contains(self.cells.astype(np.int64) - (0, 0, 1)))
        rows.flags.writeable = False  # all who ask share it
        return rows

    @property
    def bounds(self) -> tuple[Array, Array]:
        """V_min and V_max, m."""
        return self.origin, self.origin + np.asarray(self.shape) * self.edge

    def compute_cell_bounds(self, cells: Array) -> tuple[Array, Array]:
        """Return the corners v_min and v_max of cells, m."""
        low = self.origin + np.asarray(cells) * self.edge
        return low, low + self.edge

    def compute_centroids(self, cells: Array | None = None) -> Array:
        """Return (n, 3) float64 centres v_c of the given cells, or of all."""
        return self.origin + (np.asarray(self.cells if cells is None else cells) + 0.5) * self.edge

    def locate(self, points: Array) -> Array:
        """Return (n, 3) int64 cells v_p that hold the given points; outside the bounds they are negative or beyond `shape`."""
        return np.floor((np.asarray(points, np.float64) - self.origin) / self.edge).astype(np.int64)

    def find_rows(self, cells: Array) -> Array:
        """Return (m,) int64 row of each given cell, -1 where it is not occupied."""
        from topomerge.kernels import voxels

        return voxels.find_rows(*self._bricks, np.ascontiguousarray(cells, np.int64).reshape(-1, 3))

    def contains(self, cells: Array) -> Array:
        """Return (m,) bool: is the cell occupied?"""
        return self.find_rows(cells) >= 0

    def select_cells(self, mask: Array) -> VoxelGrid:
        """Return the same volume with only the masked cells (bool mask or ascending row numbers)."""
        cells = np.ascontiguousarray(self.cells[mask])
        chosen = {k: v[mask] for k, v in self.properties.items()}
        return VoxelGrid._build(self.codes[mask], cells, self.origin, self.edge, self.shape, chosen)

    def replace_cells(self, cells: Array, properties: Mapping[str, Array] | None = None) -> VoxelGrid:
        """Return other cells (any order) of the same volume."""
        return VoxelGrid.from_cells(cells, self.origin, self.edge, self.shape, properties)

    def coarsen(self, factor: int) -> VoxelGrid:
        """Return the cells, `factor` times as long, in which one or more of these lie; without properties."""
        x, y, z = (-(-s // factor) for s in self.shape)
        return VoxelGrid.from_cells(self.cells // factor, self.origin, self.edge * factor, (x, y, z))

    def assign_properties(self, **properties: Array) -> VoxelGrid:
        """Return the same cells with more properties."""
        named = {**self.properties, **properties}
        grid = VoxelGrid._build(self.codes, self.cells, self.origin, self.edge, self.shape, named)
        for index in ("_bricks", "_columns"):  # of the cells, which stay: don't make it twice
            if index in self.__dict__:
                grid.__dict__[index] = self.__dict__[index]
        return grid


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
        landmarks: signs, tags, radio, pressure, objects and names in the file's frame, m; of portions the last one has them.
        drawn_doors: (k, 4) floor on which a drawing shows doors: place, m, and how probably; likewise.

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
    landmarks: Landmarks | None = None
    drawn_doors: Array | None = None

    def __post_init__(self) -> None:
        numbers = isinstance(self.points, np.ndarray) and self.points.dtype.kind in "biuf"
        require(numbers, f"points must be an (N, 3) array of numbers, not {getattr(self.points, 'dtype', type(self.points))}")
        require(self.points.ndim == 2 and self.points.shape[1] == 3, f"points must be (N, 3), not {self.points.shape}")
        for name in ("colors", "labels", "pose_of", "intensities"):
            values = getattr(self, name)
            require(values is None or len(values) == len(self.points), f"{name} must have one row a point")

    def __len__(self) -> int:
        return len(self.points)


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
        """Return the similarity that undoes this one."""
        back = Sim3(-self.yaw, (0.0, 0.0, 0.0), 1.0 / self.scale)
        x, y, z = (-back.apply(np.array([self.translation]))[0]).tolist()
        return Sim3(-self.yaw, (x, y, z), 1.0 / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        x, y, z = self.apply(np.array([other.translation]))[0].tolist()
        yaw = (self.yaw + other.yaw + np.pi) % (2 * np.pi) - np.pi
        return Sim3(float(yaw), (x, y, z), self.scale * other.scale)


def select_lowest_of_column(navigable: VoxelGrid) -> Array:
    """Return the ascending rows of the cells that have no cell right below them: the floor proper, without its upward dilation.
    They are found once; who asks again gets the same array."""
    return navigable._lowest_of_column
