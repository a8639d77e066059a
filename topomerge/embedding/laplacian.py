"""Laplacians of a room: of the graph of its cells, and of the surface that its points lie on; and their smallest eigenvalues."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from topomerge.blas import one_blas_thread
from topomerge.kernels.voronoi import voronoi_weights
from topomerge.types import Array, VoxelGrid

Laplacian = tuple[sparse.csr_matrix, Array]  # stiffness (n, n), mass (n,)
TANGENT_NEIGHBOURS = 18
CELL_STEPS = np.eye(3, dtype=np.int64)
DENSE_UNKNOWNS = 400  # from so many unknowns on the sparse solver is quicker


def graph_laplacian(cells: Array) -> Laplacian:
    """L = D - A of the 6-neighbourhood of cells (n, 3), with masses of 1 (thesis): eigenvalues have no unit."""
    grid = VoxelGrid.from_cells(cells - cells.min(axis=0))
    first, second = [], []
    for step in CELL_STEPS:
        rows = grid.rows(grid.cells + step)
        first.append(np.flatnonzero(rows >= 0))
        second.append(rows[rows >= 0])
    return _stiffness(np.concatenate(first), np.concatenate(second), None, len(grid)), np.ones(len(grid))


def surface_laplacian(points: Array) -> Laplacian:
    """Laplace-Beltrami operator of a sampled surface (n, 3), in 1/m2: Voronoi cells in the tangent planes of the points.

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
    area, weight = voronoi_weights(np.ascontiguousarray(flat), distance[:, : min(4, count)].mean(axis=1))
    first, k = np.nonzero(weight)
    return _stiffness(first, near[first, k], weight[first, k] / 2, len(points)), np.maximum(area, 1e-6 * area.mean())


def _stiffness(first: Array, second: Array, weight: Array | None, count: int) -> sparse.csr_matrix:
    values = np.ones(len(first)) if weight is None else weight
    half = sparse.coo_matrix((values, (first, second)), shape=(count, count)).tocsr()
    both = half + half.T
    return sparse.diags(np.asarray(both.sum(axis=1)).ravel()) - both


@one_blas_thread
def smallest_eigenvalues(laplacian: Laplacian, number: int) -> Array:
    """Up to `number` smallest eigenvalues above 0, ascending, of the largest connected part. Needs memory for n times `number`.

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
    wanted = min(number + 1, len(part_rows))
    if len(part_rows) <= max(DENSE_UNKNOWNS, 2 * wanted + 1):
        values = np.linalg.eigvalsh(matrix.toarray())[:wanted]
    else:
        usual = float(matrix.diagonal().mean()) / len(part_rows)  # of the order of the first eigenvalues
        start = np.random.default_rng(0).standard_normal(len(part_rows))
        values = np.sort(eigsh(matrix, wanted, sigma=-usual, v0=start, return_eigenvectors=False, tol=1e-10))
    return np.maximum(values[1:], 0.0)
