"""Tilted clouds are levelled before anything else is made of them (beyond the thesis)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from topomerge.kernels.stencil import MOMENTS, sum_in_cubes
from topomerge.types import Array, PointCloud, VoxelGrid, transform_landmarks, transform_points

# Which way is up in a cloud: the normals of its floors and ceilings say so, and its walls are the witnesses (beyond the thesis).
#
# A laser that is mounted askew, or photogrammetry without gravity, tilts a whole map. Small planes are fitted to the points;
# the direction along which most of them lie flat or stand upright is up. A ramp, a sloping roof or a stairway turns floors or
# ceilings, but no walls: a cloud is tilted only where its walls, too, lean by as much and to the same side.

LEAST_TILT = 1.0  # degrees: of real scans that are level 0.7 at most were found; from there on merges suffer
LARGEST_TILT = 25.0  # degrees: beyond, another axis is up, of which `io.frame` warns
SAMPLE = 300_000  # points that are looked at
PATCH_EDGES = (0.4, 0.8)  # m, of the cubes in which planes are fitted; the larger ones where the smaller ones show too few
LEAST_POINTS = 8  # of a patch
FLATNESS = 0.075  # of a patch: rms of its points about its plane, by the edge of its cube
ROUNDNESS, THINNESS = 0.3, 0.33  # of a patch: its width by its length, and its thickness by its width; else a line or a ball
ENOUGH_PATCHES, LEAST_PATCHES = 480, 120  # some 40 and 10 m2 of floors, ceilings and walls in cubes of 0.4 m, seen twice
SEARCH_STEP = 1.0  # degrees
SEARCHED_PATCHES = 2000
FEW_UPS = 64  # directions that are tried together: what is in between stays in the processor's cache
SEARCH_WIDTH = 2.0  # degrees (standard deviation) within which a patch agrees with a direction
REACHES = (6.0, 4.5, 3.0, 3.0, 3.0, 3.0)  # degrees, from where a patch has no say in each round of the least squares
WALL_REACH = 6.0  # degrees by which a wall may miss what is upright, in the file or along the direction found
ACROSS = 0.7  # cosine between the normal of a wall and the side to which a cloud leans: the walls that would lean, too
LEAST_WITNESSES = 40  # such walls
WITNESSED = 0.5  # of the tilt, by which the median of them leans
SURE = 6.0  # times its standard error
LEAST_AGREEMENT = 0.2  # of all patches that agree with the direction found; of clouds of a building 0.3 to 0.85 do


class _Wall(NamedTuple):
    """By how many degrees walls lean to one side: the median, its standard error, and how many walls say so."""

    lean: float
    error: float
    number: int


def find_up(points: Array, normals: Array | None = None) -> Array | None:
    """Find the direction that is up in a tilted cloud.

    Args:
        points: (N, 3) m, z roughly up.
        normals: (n, 3), `fit_patches` of them, where that is known.

    Returns:
        (3,) float64 unit vector, `LEAST_TILT` to `LARGEST_TILT` from z; None where the cloud is level, or nothing says it is not.
    """
    normals = fit_patches(points) if normals is None else normals
    if len(normals) < LEAST_PATCHES:
        return None
    up = _refine_up(normals, _find_most_agreed(normals))
    tilt = measure_degrees_from_z(up)
    if not LEAST_TILT <= tilt <= LARGEST_TILT or _count_agreement(normals, up[None])[0] < LEAST_AGREEMENT * len(normals):
        return None
    walls = _measure_wall_lean(normals, up, tilt)
    witnessed = walls.number >= LEAST_WITNESSES and walls.lean >= max(WITNESSED * tilt, SURE * walls.error)
    if not witnessed:
        return None
    rotation = compute_rotation_to_z(
        up
    )  # borders of cubes that cut noisy planes askew draw their normals to the axes: look once more
    return np.asarray(_refine_up(fit_patches(_sample_points(points) @ rotation.T), np.array([0.0, 0.0, 1.0])) @ rotation)


def measure_degrees_from_z(up: Array) -> float:
    """Return the angle between a unit vector (3,) and z."""
    return float(np.degrees(np.arctan2(np.hypot(up[0], up[1]), up[2])))


def compute_rotation_to_z(up: Array) -> Array:
    """Return (3, 3) float64, the shortest rotation that brings a unit vector above the horizon to z."""
    x, y, z = np.asarray(up, np.float64)
    return np.array([[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]])


def fit_patches(points: Array) -> Array:
    """Return (n, 3) float64 unit normals, of either sign, of the cubes of space whose points (N, 3) lie on a plane.

    Space is cut twice, half an edge apart: a cube that holds both faces of a wall shows no plane.
    """
    sample, normals = _sample_points(points), np.zeros((0, 3))
    for edge in PATCH_EDGES:
        if len(normals) < ENOUGH_PATCHES and len(sample):
            local = sample - np.median(sample, axis=0)
            both = np.concatenate([_fit_planes(local, edge), _fit_planes(local + edge / 2, edge)])
            normals = max(normals, both, key=len)
    return normals


def _sample_points(points: Array) -> Array:
    """Return every n-th point, float64, without what is not finite."""
    sample = np.asarray(points[:: max(len(points) // SAMPLE, 1)], np.float64)
    return sample[np.isfinite(sample).all(axis=1)]


def _fit_planes(points: Array, edge: float) -> Array:
    """Return the normals of the planes in cubes of one edge length, m; points lie around the origin."""
    sums = sum_in_cubes(points, edge)
    sums = sums[sums[:, 0] >= LEAST_POINTS]
    moments = sums[:, 1:] / sums[:, :1]
    covariance = np.empty((len(sums), 3, 3))
    for k, (i, j) in enumerate(MOMENTS):
        covariance[:, i, j] = covariance[:, j, i] = moments[:, 3 + k] - moments[:, i] * moments[:, j]
    values, vectors = np.linalg.eigh(covariance)
    thick, wide, long = np.sqrt(np.maximum(values, 0)).T
    is_plane = (thick <= FLATNESS * edge) & (thick < THINNESS * wide) & (wide >= ROUNDNESS * long)
    return np.asarray(vectors[is_plane][:, :, 0])


def _count_agreement(normals: Array, ups: Array) -> Array:
    """Return (k,) how many patches lie flat or stand upright along each of the directions (k, 3)."""
    count = np.empty(len(ups))
    for first in range(0, len(ups), FEW_UPS):
        block = slice(first, first + FEW_UPS)
        square = (normals @ ups[block].T) ** 2
        off = np.minimum(square, 1 - square)  # squared sines of the angles of walls from upright, of floors from flat
        count[block] = np.exp(off * (-0.5 / np.radians(SEARCH_WIDTH) ** 2)).sum(axis=0)
    return count


def _find_most_agreed(normals: Array) -> Array:
    """Return (3,) the direction within `LARGEST_TILT` of z with which most patches agree."""
    steps = np.tan(np.radians(np.arange(-LARGEST_TILT, LARGEST_TILT + SEARCH_STEP, SEARCH_STEP)))
    x, y = (v.ravel() for v in np.meshgrid(steps, steps))
    ups = np.column_stack([x, y, np.ones(len(x))])
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    ups = ups[ups[:, 2] >= np.cos(np.radians(LARGEST_TILT + SEARCH_STEP))]
    some = normals[:: -(-len(normals) // SEARCHED_PATCHES)]
    return np.asarray(ups[np.argmax(_count_agreement(some, ups))])


def _refine_up(normals: Array, up: Array) -> Array:
    """Return (3,) the direction to which the normals of floors are parallel and those of walls perpendicular: least squares in
    which what is far off has no say."""
    for reach in REACHES:
        sine = np.clip(np.abs(normals @ up), 0, 1)
        off = np.degrees(np.arcsin(sine))
        flat = off > 45
        weight = np.clip(1 - (np.where(flat, 90 - off, off) / reach) ** 2, 0, None) ** 2
        signed = np.where(flat, -weight, weight)  # the sine of what is flat is to be large, that of what is upright small
        up = np.linalg.eigh((normals * signed[:, None]).T @ normals)[1][:, 0]
        up = up if up[2] > 0 else -up
    return up


def _measure_wall_lean(normals: Array, up: Array, tilt: float) -> _Wall:
    """Measure how far the walls lean that would lean with a cloud that is tilted to a direction."""
    side = up[:2] / np.linalg.norm(up[:2])
    towards = normals[:, :2] @ side
    steep = np.sin(np.radians(WALL_REACH + tilt))
    is_wall = (np.abs(normals[:, 2]) < steep) & (np.abs(normals @ up) < steep) & (np.abs(towards) > ACROSS)
    leans = -np.degrees(np.arcsin(normals[is_wall, 2] * np.sign(towards[is_wall])))
    if not len(leans):
        return _Wall(0.0, np.inf, 0)
    return _Wall(float(np.median(leans)), float(1.25 * np.std(leans) / np.sqrt(len(leans))), len(leans))


# Tilted clouds are levelled before anything else is made of them (beyond the thesis).

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
            yield self._level(held.pop(0))
        for chunk in chunks:
            yield self._level(chunk)

    def _is_settled(self, held: Sequence[PointCloud]) -> bool:
        """Return whether the first chunks show enough floors, ceilings and walls to say which way is up, or are all that is
        held."""
        points = np.concatenate([_sample_chunk(chunk) for chunk in held])
        low, high = np.nanquantile(points[:, 2], SLICE_QUANTILES) if len(points) else (0.0, 0.0)
        normals = fit_patches(points) if high - low > SLICE_HEIGHT else np.zeros((0, 3))
        if len(normals) < LEAST_PATCHES:
            return sum(map(len, held)) > HELD_POINTS
        up = find_up(points, normals)
        if up is not None:
            finite = points[np.isfinite(points).all(axis=1)]
            self.matrix = build_rotation_about(np.round(np.median(finite, axis=0), DIGITS), compute_rotation_to_z(up))
            name = f"{held[0].source}: " if held[0].source else ""
            self.warnings.append(f"{name}tilted by {measure_degrees_from_z(up):.1f} degrees: levelled")
        return True

    def _level(self, chunk: PointCloud) -> PointCloud:
        return chunk if self.matrix is None or not isinstance(chunk, PointCloud) else transform_cloud(chunk, self.matrix)


def build_rotation_about(middle: Array, rotation: Array) -> Array:
    """Return (4, 4) float64: a rotation (3, 3) about a place (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = middle - rotation @ middle
    return matrix


def transform_cloud(cloud: PointCloud, matrix: Array) -> PointCloud:
    """Move a cloud, its sensor's poses, free cells and landmarks by a rigid motion (4, 4). True rooms and headings stay."""
    points = np.empty(cloud.points.shape, cloud.points.dtype if cloud.points.dtype.kind == "f" else np.float32)
    for first in range(0, len(points), BLOCK):
        block = slice(first, first + BLOCK)
        points[block] = transform_points(matrix, cloud.points[block] + cloud.shift) - cloud.shift
    poses = None if cloud.poses is None else matrix @ np.asarray(cloud.poses, np.float64)
    free = None if cloud.free is None else transform_grid(cloud.free, matrix)
    landmarks = cloud.landmarks and transform_landmarks(cloud.landmarks, partial(transform_points, matrix))
    drawn = cloud.drawn_doors
    if drawn is not None:
        drawn = np.column_stack([transform_points(matrix, drawn[:, :3]), drawn[:, 3]])
    return replace(cloud, points=points, poses=poses, free=free, landmarks=landmarks, drawn_doors=drawn)


def transform_grid(grid: VoxelGrid, matrix: Array) -> VoxelGrid:
    """Return the cells of a lattice of the same edge length whose middles lie in cells of a grid that is moved by a rigid motion
    (4, 4); without properties."""
    if not len(grid):
        return grid
    back, found = np.linalg.inv(matrix), []
    for first in range(0, len(grid), BLOCK // len(AROUND)):
        middles = grid.compute_centroids(grid.cells[first : first + BLOCK // len(AROUND)])
        moved = np.floor(transform_points(matrix, middles) / grid.edge).astype(np.int64)
        near = (moved[:, None] + AROUND).reshape(-1, 3)
        found.append(near[grid.contains(grid.locate(transform_points(back, (near + 0.5) * grid.edge)))])
    cells = np.concatenate(found)
    base = cells.min(axis=0)
    return VoxelGrid.from_cells(cells - base, base * grid.edge, grid.edge)


def _sample_chunk(chunk: PointCloud) -> Array:
    """Sample some points of a chunk in the file's coordinates, float64."""
    return np.asarray(chunk.points[:: max(len(chunk) // SAMPLE, 1)] + chunk.shift, np.float64)
