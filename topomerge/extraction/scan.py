"""A scan as cells: what is extracted from, and what its file knows beside the points (seeds 2.2)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.cleaning import COARSEST_CELL, coarsen_until_dense
from topomerge.extraction.levelling import LevelledChunks
from topomerge.extraction.voxels import LatticeCells, voxelise
from topomerge.types import Array, Landmarks, PointCloud, VoxelGrid, join_landmarks

FINEST_CELL = 0.02  # m
# In cells of 0.1 m doors show, their frames do not (docs/adr/0018).
FINE_CELL = 0.05  # m: of the cells in which walls are looked at closely
SHORTEST_ROW = 1.0  # m: the cells of any scan, laid in a row, are longer
LEAST_FINE = 2.05  # times as long: a grid of such cells will do, if it has the means of its points
# Clouds are read once, piece by piece: of their points nothing else is held until rooms are known (docs/adr/0018).
MOST_FINE_CELLS = 12_000_000  # 0.7 GB; some 4,000 m2 of floor
MOST_RAYS = 400_000  # of a portion of two million points
MOST_RAYS_HELD = 4_000_000  # of all portions: 0.2 GB


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan as a voxel grid.

    Args:
        grid: occupied cells.
        fine: cells of about `FINE_CELL` with the means of their points, as walls are looked at; None where they are not known.
        rays: (k, 3) places of the sensor and (k, 3) of what it saw from there, m; None where they are unknown.
        free: cells that the file says are empty, or None.
        source: where it comes from.
        warnings: what the user should know.
        crossed: cells that its rays crossed (`navigable.add_crossed_cells`); None where that is unknown.
        levelling: (4, 4) that took the points of a tilted cloud into the frame of the grid; None where it was level.
        raised: is it a robot's grid or a drawing, whose walls were all raised alike (`slices.is_raised`)?
        flat: is it a slice, in which nothing tells walls from what else stands about (`slices.is_slice`)?
        landmarks: of its file, in the frame of the grid.
        drawn_doors: (k, 4) floor on which a drawing shows doors, in that frame: place, m, and probability; None elsewhere.
    """

    grid: VoxelGrid
    fine: VoxelGrid | None = None
    rays: tuple[Array, Array] | None = None
    free: VoxelGrid | None = None
    source: str = ""
    warnings: tuple[str, ...] = ()
    crossed: VoxelGrid | None = None
    levelling: Array | None = None
    raised: bool = False
    flat: bool = False
    landmarks: Landmarks = field(default_factory=Landmarks)
    drawn_doors: Array | None = None

    @property
    def places(self) -> Array:
        """(n, 3) m, where the sensor was, in the order in which it was there; none where that is unknown."""
        if self.rays is None or not len(self.rays[0]):
            return np.zeros((0, 3))
        starts = np.asarray(self.rays[0], np.float64)
        return starts[np.concatenate([[True], (starts[1:] != starts[:-1]).any(axis=1)])]

    def replace_grid(self, grid: VoxelGrid, warning: str) -> Scan:
        """Return the scan with another grid, and with what the user should know about that."""
        return replace(self, grid=grid, warnings=(*self.warnings, warning))


def read_scan(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud],
    voxel_size: float,
    least_neighbours: float = 0.0,
    level: bool = False,
) -> Scan:
    """Return points -> cells, so large that surfaces hold together (seeds 2.2). A grid is taken as it is.

    Args:
        source: a cloud, chunks of one, (N, 3) points, or occupied cells.
        voxel_size: edge length of a cell, m (a grid keeps its own).
        least_neighbours: that the median cell has, of 26; the cells are doubled until it has them. 0: never.
        level: rotate the points of a tilted cloud first, and what else its file knows (`levelling`).

    Raises:
        InputError: no finite point, hardly any cells, an absurd extent, cells of a size that shows no rooms and doors, or a path,
            a list or an array of another shape in place of points.
    """
    if isinstance(source, str | Path):
        raise InputError(f"{source}: extract takes points, not the name of a file; read it with read_points or read_chunks")
    edge = source.edge if isinstance(source, VoxelGrid) else voxel_size
    if not (isinstance(edge, int | float) and FINEST_CELL <= edge <= COARSEST_CELL):
        size = f"a number between {FINEST_CELL} and {COARSEST_CELL} (m)"
        raise InputError(f"voxel size must be {size} to find rooms and doors, not {edge!r}")
    if isinstance(source, VoxelGrid):
        return Scan(source, source if "offset" in source.properties and edge <= LEAST_FINE * FINE_CELL else None)
    # Whole parts: cells are summed from the fine ones, so that points are looked at once (docs/adr/0044).
    parts = max(round(edge / FINE_CELL), 1)
    fine = LatticeCells(edge / parts, MOST_FINE_CELLS) if parts > 1 else None
    clouds = [_build_cloud(source)] if isinstance(source, np.ndarray) else [source] if isinstance(source, PointCloud) else source
    levelled = LevelledChunks(clouds) if level else None
    chunks = _Chunks(clouds if levelled is None else levelled)
    with add_reasons(chunks.warnings):
        grid = voxelise(chunks, edge, chunks.warnings, fine)
        if len(grid) * edge < SHORTEST_ROW:
            cells = f"{len(grid)} cell{'s' * (len(grid) != 1)} of {edge:g} m"
            raise InputError(f"too few points, or all in one place: they lie in {cells}; check the file and --unit")
    close = fine.select_within(grid) if fine is not None else grid
    if close is None:
        chunks.warnings.append("the scan is large: doors are read off its plan alone, not off its walls")
    if least_neighbours:
        grid = coarsen_until_dense(grid, least_neighbours, chunks.warnings)
    landmarks = join_landmarks(chunks.landmarks)
    scan = Scan(grid, close, chunks.rays, chunks.free, chunks.source, tuple(chunks.warnings), landmarks=landmarks)
    scan = replace(scan, drawn_doors=chunks.drawn_doors)
    return scan if levelled is None else replace(scan, levelling=levelled.matrix, warnings=(*levelled.warnings, *scan.warnings))


def _build_cloud(points: Array) -> PointCloud:
    """Return a cloud of an array from the user."""
    try:
        return PointCloud(points)
    except ValueError as error:
        raise InputError(f"extract: {error}; give x, y and z of each point, in metres") from error


@contextmanager
def add_reasons(warnings: Sequence[str]) -> Iterator[None]:
    """Add to an error of the input what looked wrong before it: that is often the reason."""
    try:
        yield
    except InputError as error:
        if not warnings:
            raise
        raise InputError(f"{error} (and {'; '.join(warnings)})") from error


class _Chunks:
    """The chunks of a cloud, to be read once; it gathers what they know beside their points."""

    def __init__(self, chunks: Iterable[PointCloud]) -> None:
        self.chunks = chunks
        self.source = ""
        self.free: VoxelGrid | None = None
        self.warnings: list[str] = []
        self.landmarks: list[Landmarks] = []
        self.drawn_doors: Array | None = None
        self._rays: list[tuple[Array, Array]] = []
        self._step = 1  # of the rays, every one or every second, fourth ... is held

    def __iter__(self) -> Iterator[PointCloud]:
        """Yield the chunks."""
        for chunk in self.chunks:
            if not isinstance(chunk, PointCloud):
                kind = type(chunk).__name__
                raise InputError(f"extract takes a cloud, chunks of one or an (N, 3) array of points, not a sequence of {kind}")
            self.source = chunk.source
            self.free = chunk.free or self.free
            self.warnings += [w for w in chunk.warnings if w not in self.warnings]
            self.landmarks += [] if chunk.landmarks is None else [chunk.landmarks]
            self.drawn_doors = self.drawn_doors if chunk.drawn_doors is None else chunk.drawn_doors
            if chunk.poses is not None and chunk.pose_of is not None and len(chunk):
                self._add_rays(*_select_rays(chunk, chunk.poses, chunk.pose_of))
            yield chunk

    def _add_rays(self, starts: Array, ends: Array) -> None:
        """Take rays in; where there are too many, every second one goes, so that a walk may be of any length."""
        self._rays.append((np.ascontiguousarray(starts[:: self._step]), np.ascontiguousarray(ends[:: self._step])))
        while sum(len(part) for part, _ in self._rays) > MOST_RAYS_HELD:
            self._step *= 2
            self._rays = [(a[::2].copy(), b[::2].copy()) for a, b in self._rays]

    @property
    def rays(self) -> tuple[Array, Array] | None:
        if not self._rays:
            return None
        starts, ends = (np.concatenate(part) for part in zip(*self._rays, strict=True))
        return starts, ends


def _select_rays(cloud: PointCloud, poses: Array, pose_of: Array) -> tuple[Array, Array]:
    """Return places of the sensor and of what it saw, m: an even selection of the points whose pose is known."""
    rows = np.arange(0, len(cloud), max(len(cloud) // MOST_RAYS, 1))
    rows = rows[pose_of[rows] >= 0]
    return poses[pose_of[rows], :3, 3], cloud.points[rows] + cloud.shift
