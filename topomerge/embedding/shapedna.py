"""Spectral descriptors of rooms: ShapeDNA."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from topomerge.blas import limit_blas_threads
from topomerge.embedding.quarter_turns import Descriptor, collect_room_cells
from topomerge.errors import InputError
from topomerge.kernels.meshes import compute_voronoi_weights
from topomerge.types import Array, TopometricMap, VoxelGrid

Laplacian = tuple[sparse.csr_matrix, Array]  # stiffness (n, n), mass (n,)
TANGENT_NEIGHBOURS = 18
CELL_STEPS = np.eye(3, dtype=np.int64)
DENSE_UNKNOWNS = 400  # from so many unknowns on the sparse solver is quicker


def build_graph_laplacian(cells: Array) -> Laplacian:
    """Build L = D - A of the 6-neighbourhood of cells (n, 3), with masses of 1 (thesis): eigenvalues have no unit."""
    grid = VoxelGrid.from_cells(cells - cells.min(axis=0))
    first, second = [], []
    for step in CELL_STEPS:
        rows = grid.find_rows(grid.cells + step)
        first.append(np.flatnonzero(rows >= 0))
        second.append(rows[rows >= 0])
    return _build_stiffness(np.concatenate(first), np.concatenate(second), None, len(grid)), np.ones(len(grid))


def build_surface_laplacian(points: Array) -> Laplacian:
    """Build the Laplace-Beltrami operator of a sampled surface (n, 3), in 1/m2: Voronoi cells in the tangent planes of the
    points.

    On a flat sample the weights are the cotangents of its Delaunay triangulation, as in the finite elements of ShapeDNA (Reuter
    et al. 2006); where two points see their common side differently, the mean is taken. Borders are free (Neumann).
    """
    count = min(TANGENT_NEIGHBOURS, len(points) - 1)
    distance, near = cKDTree(points).query(points, count + 1)
    distance, near = distance[:, 1:], near[:, 1:]
    away = points[near] - points[:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    flat = np.einsum("nki,nij->nkj", away, axes[:, :, 1:])
    flat *= (distance / np.maximum(np.linalg.norm(flat, axis=2), 1e-9))[:, :, None].clip(1.0, 2.0)  # around edges: as if unfolded
    area, weight = compute_voronoi_weights(np.ascontiguousarray(flat), distance[:, : min(4, count)].mean(axis=1))
    first, k = np.nonzero(weight)
    return _build_stiffness(first, near[first, k], weight[first, k] / 2, len(points)), np.maximum(area, 1e-6 * area.mean())


def _build_stiffness(first: Array, second: Array, weight: Array | None, count: int) -> sparse.csr_matrix:
    values = np.ones(len(first)) if weight is None else weight
    half = sparse.coo_matrix((values, (first, second)), shape=(count, count)).tocsr()
    both = half + half.T
    return sparse.diags(np.asarray(both.sum(axis=1)).ravel()) - both


@limit_blas_threads
def compute_smallest_eigenvalues(laplacian: Laplacian, number: int) -> Array:
    """Compute up to `number` smallest eigenvalues above 0, ascending, of the largest connected part. Needs memory for n times
    `number`.

    Shift-invert about a point just below 0 (the matrix itself is singular), with one thread: more of them only get in each
    other's way here.
    """
    from scipy.sparse.linalg import eigsh

    stiffness, mass = laplacian
    _, part = connected_components(stiffness, directed=False)
    part_rows = np.flatnonzero(part == np.argmax(np.bincount(part)))
    stiffness, mass = stiffness[part_rows][:, part_rows], mass[part_rows]
    root = 1 / np.sqrt(mass)
    matrix = sparse.csc_matrix(sparse.diags(root) @ stiffness @ sparse.diags(root))
    requested = min(number + 1, len(part_rows))
    if len(part_rows) <= max(DENSE_UNKNOWNS, 2 * requested + 1):
        values = np.linalg.eigvalsh(matrix.toarray())[:requested]
    else:
        usual = float(matrix.diagonal().mean()) / len(part_rows)  # of the order of the first eigenvalues
        start = np.random.default_rng(0).standard_normal(len(part_rows))
        values = np.sort(eigsh(matrix, requested, sigma=-usual, v0=start, return_eigenvectors=False, tol=1e-10))
    return np.maximum(values[1:], 0.0)


LAPLACIANS = ("surface", "graph")
NORMALISATIONS = ("weyl", "first", "none")
SHAPE_LEAST_CELLS = 8  # cells: fewer have no shape


def build_shapedna(
    laplacian: str = "surface", values: int = 32, normalise: str = "weyl", spacing: float = 0.25, largest: int = 5000
) -> Descriptor:
    """Return the descriptor: (R, values) float64, ascending in each row.

    Args:
        laplacian: ``"graph"``: of the 6-neighbourhood of the cells (thesis: 256 values); ``"surface"``: of the surface that the
            cells lie on, which depends less on how they were sampled.
        values: how many; a room with fewer cells gets the rest by Weyl's law.
        normalise: ``"weyl"``: by the slope of value over number, so that size falls out; ``"first"``: by the first one;
            ``"none"``: 1/m2 of the surface, no unit of the graph.
        spacing: m; the surface is described by one point in each cube of this size, so that walls two cells thick are one.
        largest: cells of the graph, or points of the surface; of more, coarser ones are taken: the time grows faster than their
            number, and the smallest eigenvalues hardly change.

    Raises:
        InputError: an option is unknown, or below its least value.
    """
    if laplacian not in LAPLACIANS:
        raise InputError(f"Laplacian {laplacian!r}: {', '.join(LAPLACIANS)} are possible")
    if normalise not in NORMALISATIONS:
        raise InputError(f"normalisation {normalise!r}: {', '.join(NORMALISATIONS)} are possible")
    if values < 1 or not spacing > 0 or largest < 100:
        raise InputError(f"ShapeDNA needs 1 value or more, spacing above 0 and 100 cells, not {values}, {spacing} and {largest}")

    def describe(map: TopometricMap) -> Array:
        out = np.zeros((len(map.rooms), values))
        for room, cells in enumerate(collect_room_cells(map)):
            if len(cells) >= SHAPE_LEAST_CELLS:
                out[room] = compute_spectrum(cells, map.grid.edge, laplacian, values, spacing, largest)
        return normalise_spectra(out, normalise)

    return describe


def compute_spectrum(cells: Array, edge: float, laplacian: str, values: int, spacing: float, largest: int) -> Array:
    """Return (values,) smallest eigenvalues above 0 of one room's cells (n, 3); the last ones by Weyl's law if there are too
    few."""
    if laplacian == "graph":
        while len(cells) > largest:
            halved = cells // 2
            cells = halved[_find_firsts(halved)[0]]
        eigenvalues = compute_smallest_eigenvalues(build_graph_laplacian(cells), values)
    else:
        points = thin_points((cells + 0.5) * edge, spacing)
        while len(points) > largest:
            spacing *= max(float(np.sqrt(len(points) / largest)), 1.05)
            points = thin_points((cells + 0.5) * edge, spacing)
        eigenvalues = compute_smallest_eigenvalues(build_surface_laplacian(points), values)
    if not len(eigenvalues):
        return np.zeros(values)
    number = np.arange(1, values + 1)
    slope = _fit_slope(eigenvalues[None])[0]
    return np.concatenate([eigenvalues, np.maximum(slope * number[len(eigenvalues) :], eigenvalues[-1])])


def thin_points(points: Array, spacing: float) -> Array:
    """Return the middle of the points (n, 3) in each cube of a grid that is laid over them; all points if hardly any would be
    left."""
    cube = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    first, of = _find_firsts(cube)
    if len(first) < SHAPE_LEAST_CELLS:
        return points
    sums = np.stack([np.bincount(of, points[:, a]) for a in range(3)], axis=1)
    return sums / np.bincount(of)[:, None]


def _find_firsts(cells: Array) -> tuple[Array, Array]:
    """Return the first row of each different cell (n, 3), in the order of x, y, z, and the number of its cell for each row: as
    `np.unique` of rows, which takes ten times as long."""
    low = cells.min(axis=0)
    wide = (np.ptp(cells, axis=0) + 1).astype(np.int64)
    x, y, z = (cells - low).astype(np.int64).T
    _, first, of = np.unique((x * wide[1] + y) * wide[2] + z, return_index=True, return_inverse=True)
    return first, of


def normalise_spectra(values: Array, how: str) -> Array:
    """Return rows of eigenvalues made independent of size; rows of zeros stay."""
    if how == "none":
        return values
    unit = values[:, 0] if how == "first" else _fit_slope(values)
    return values / np.where(unit > 0, unit, 1.0)[:, None]


def _fit_slope(values: Array) -> Array:
    """Return the slope of the line through the origin that fits value over number: on a surface 4 pi / area, by Weyl's law."""
    number = np.arange(1, values.shape[1] + 1)
    return (values @ number) / (number @ number)
