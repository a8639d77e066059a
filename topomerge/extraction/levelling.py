"""Tilted clouds are levelled before anything else is made of them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from topomerge.extraction.tilt import LEAST_PATCHES, SAMPLE, degrees_from_z, find_up, fit_patches, rotation_to_z
from topomerge.types import Array, PointCloud, VoxelGrid, transformed

SLICE_HEIGHT = 0.6  # m: what is flatter is a slice, of which nobody knows how it lay
HELD_POINTS = 4_000_000  # of the first chunks, which are held until they show whether the cloud is tilted: 0.1 GB
BLOCK = 1_000_000  # points that are rotated together
SLICE_QUANTILES = (0.01, 0.99)  # of the heights of points, between which the slice lies
DIGITS = 3  # of the place about which a cloud is rotated, m
AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)  # a cell and its neighbours


class LevelledChunks:
    """The chunks of a cloud, to be read once, rotated about the middle of the first ones where these are tilted.

    Args:
        chunks: of one cloud.

    Once the first chunk was read, `matrix` is the (4, 4) matrix that levels the cloud, None where it is level; `warnings` say so.
    """

    def __init__(self, chunks: Iterable[PointCloud]) -> None:
        self._chunks = chunks
        self.matrix: Array | None = None
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[PointCloud]:
        chunks = iter(self._chunks)
        held: list[PointCloud] = []
        for chunk in chunks:
            held.append(chunk)
            if not isinstance(chunk, PointCloud) or chunk.upright or self._is_settled(held):
                break
        while held:
            yield self._levelled(held.pop(0))
        for chunk in chunks:
            yield self._levelled(chunk)

    def _is_settled(self, held: Sequence[PointCloud]) -> bool:
        """Do the first chunks show enough floors, ceilings and walls to say which way is up, or are they all that is held?"""
        points = np.concatenate([_sample(chunk) for chunk in held])
        low, high = np.nanquantile(points[:, 2], SLICE_QUANTILES) if len(points) else (0.0, 0.0)
        normals = fit_patches(points) if high - low > SLICE_HEIGHT else np.zeros((0, 3))
        if len(normals) < LEAST_PATCHES:
            return sum(map(len, held)) > HELD_POINTS
        up = find_up(points, normals)
        if up is not None:
            finite = points[np.isfinite(points).all(axis=1)]
            self.matrix = rotation_about(np.round(np.median(finite, axis=0), DIGITS), rotation_to_z(up))
            name = f"{held[0].source}: " if held[0].source else ""
            self.warnings.append(f"{name}tilted by {degrees_from_z(up):.1f} degrees: levelled")
        return True

    def _levelled(self, chunk: PointCloud) -> PointCloud:
        return chunk if self.matrix is None or not isinstance(chunk, PointCloud) else levelled_cloud(chunk, self.matrix)


def rotation_about(middle: Array, rotation: Array) -> Array:
    """(4, 4) float64: a rotation (3, 3) about a place (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = middle - rotation @ middle
    return matrix


def levelled_cloud(cloud: PointCloud, matrix: Array) -> PointCloud:
    """The same cloud, its points, its sensor's poses and its free cells moved by a rigid motion (4, 4). True rooms stay."""
    points = np.empty(cloud.points.shape, cloud.points.dtype if cloud.points.dtype.kind == "f" else np.float32)
    for first in range(0, len(points), BLOCK):
        block = slice(first, first + BLOCK)
        points[block] = transformed(matrix, cloud.points[block] + cloud.shift) - cloud.shift
    poses = None if cloud.poses is None else matrix @ np.asarray(cloud.poses, np.float64)
    free = None if cloud.free is None else levelled_grid(cloud.free, matrix)
    return replace(cloud, points=points, poses=poses, free=free)


def levelled_grid(grid: VoxelGrid, matrix: Array) -> VoxelGrid:
    """The cells of a lattice of the same edge length whose middles lie in cells of a grid that is moved by a rigid motion (4, 4);
    without properties."""
    if not len(grid):
        return grid
    back, found = np.linalg.inv(matrix), []
    for first in range(0, len(grid), BLOCK // len(AROUND)):
        middles = grid.centroids(grid.cells[first : first + BLOCK // len(AROUND)])
        moved = np.floor(transformed(matrix, middles) / grid.edge).astype(np.int64)
        near = (moved[:, None] + AROUND).reshape(-1, 3)
        found.append(near[grid.contains(grid.locate(transformed(back, (near + 0.5) * grid.edge)))])
    cells = np.concatenate(found)
    base = cells.min(axis=0)
    return VoxelGrid.from_cells(cells - base, base * grid.edge, grid.edge)


def _sample(chunk: PointCloud) -> Array:
    """Some points of a chunk in the file's coordinates, float64."""
    return np.asarray(chunk.points[:: max(len(chunk) // SAMPLE, 1)] + chunk.shift, np.float64)
