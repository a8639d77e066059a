"""Laplacians: known spectra, a slow twin of the kernel, and nothing that depends on the order or the frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection

from topomerge.embedding.shapedna import (
    build_graph_laplacian,
    build_surface_laplacian,
    compute_smallest_eigenvalues,
    compute_spectrum,
    normalise_spectra,
    thin_points,
)
from topomerge.kernels.meshes import compute_voronoi_weights
from topomerge.types import Array


def fibonacci_sphere(number: int) -> Array:
    i = np.arange(number) + 0.5
    z, angle = 1 - 2 * i / number, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def box_surface(sides: tuple[int, int, int], step: float) -> Array:
    """Lattice points on the surface of a box, edges and corners among them."""
    n = np.array(sides)
    cells = np.stack(np.meshgrid(*(np.arange(s + 1) for s in sides), indexing="ij"), axis=-1).reshape(-1, 3)
    return cells[((cells == 0) | (cells == n)).any(axis=1)] * step


def box_elements(sides: tuple[int, int, int], step: float, number: int) -> Array:
    """The same by linear finite elements on the lattice's squares, each cut in two."""
    from scipy import sparse

    points = np.round(box_surface(sides, step) / step).astype(int)
    row = {tuple(p): i for i, p in enumerate(points.tolist())}
    triangles = []
    for axis in range(3):
        u, v = np.eye(3, dtype=int)[[a for a in range(3) if a != axis]]
        for p in points.tolist():
            if p[axis] in (0, sides[axis]):
                q = [tuple(np.array(p) + d) for d in (0 * u, u, u + v, v)]
                if all(c in row for c in q):
                    a, b, c, d = (row[c] for c in q)
                    triangles += [(a, b, c), (a, c, d)]
    t = np.array(triangles)
    i, j, w = [], [], []
    for k in range(3):
        a, b, c = points[t[:, k]], points[t[:, k - 1]], points[t[:, k - 2]]
        cotangent = ((b - a) * (c - a)).sum(1) / np.maximum(np.linalg.norm(np.cross(b - a, c - a), axis=1), 1e-9)
        i.append(t[:, k - 1]), j.append(t[:, k - 2]), w.append(cotangent / 2)
    half = sparse.coo_matrix((np.concatenate(w), (np.concatenate(i), np.concatenate(j))), (len(points),) * 2).tocsr()
    both = half + half.T
    mass = np.bincount(t.ravel(), minlength=len(points)) * step**2 / 6
    return compute_smallest_eigenvalues((sparse.diags(np.asarray(both.sum(1)).ravel()) - both, mass), number)


@pytest.mark.longer
def test_sphere_to_one_percent():
    true = np.array([l * (l + 1) for l in range(1, 6) for _ in range(2 * l + 1)])
    eigenvalues = compute_smallest_eigenvalues(build_surface_laplacian(fibonacci_sphere(4000)), len(true))
    assert np.allclose(eigenvalues, true, rtol=0.01)


@pytest.mark.longer
def test_box_to_one_percent():
    coarse, fine = box_elements((20, 16, 12), 0.05, 12), box_elements((40, 32, 24), 0.025, 12)
    true = fine + (fine - coarse) / 3  # the error of linear elements falls with the square of the step
    eigenvalues = compute_smallest_eigenvalues(build_surface_laplacian(box_surface((40, 32, 24), 0.025)), 12)
    assert np.allclose(eigenvalues[:5], true[:5], rtol=0.01) and np.allclose(eigenvalues, true, rtol=0.015)


def test_rectangle_with_free_borders():
    x, y = (a.ravel() for a in np.meshgrid(np.arange(40) * 0.05, np.arange(20) * 0.05, indexing="ij"))
    eigenvalues = compute_smallest_eigenvalues(build_surface_laplacian(np.stack([x, y, 0 * x], axis=1)), 5) / np.pi**2
    true = sorted((m / 2) ** 2 + n**2 for m in range(5) for n in range(4))[1:6]
    assert np.allclose(eigenvalues, true, rtol=0.04)


@pytest.mark.parametrize("sides", [(12, 9, 7), (30, 4, 3)])
def test_solid_box_of_cells_has_the_known_spectrum(sides: tuple[int, int, int]):
    cells = np.argwhere(np.ones(sides, bool)) + 5
    waves = [4 * np.sin(np.pi * np.arange(n) / (2 * n)) ** 2 for n in sides]
    true = np.sort(np.add.outer(np.add.outer(waves[0], waves[1]), waves[2]).ravel())[1:31]
    assert np.allclose(compute_smallest_eigenvalues(build_graph_laplacian(cells), 30), true, rtol=1e-4)


def test_sparse_and_dense_solvers_agree():
    cells = np.argwhere(np.ones((10, 8, 6), bool))
    laplacian = build_graph_laplacian(cells)
    assert np.allclose(compute_smallest_eigenvalues(laplacian, 10), np.linalg.eigvalsh(laplacian[0].toarray())[1:11], rtol=1e-5)


@pytest.mark.parametrize("kind", ["graph", "surface"])
def test_order_turns_and_moves_change_nothing(kind: str):
    rng = np.random.default_rng(3)
    shell = np.ones((24, 16, 12), bool)
    shell[1:-1, 1:-1, 1:-1] = False
    cells = np.argwhere(shell)
    turned = np.stack([40 - cells[:, 1], cells[:, 0], cells[:, 2]], axis=1)[rng.permutation(len(cells))]
    first, second = (compute_spectrum(c.astype(np.int32), 0.1, kind, 20, 0.1, 20_000) for c in (cells, turned))
    assert np.allclose(first, second, rtol=1e-4 if kind == "graph" else 0.03)  # a lattice has no one Delaunay triangulation


def test_a_surface_depends_little_on_its_sampling():
    rng = np.random.default_rng(1)
    dense = box_surface((60, 45, 25), 0.1)
    spectra = []
    for share in (1.0, 0.6):
        some = dense[rng.random(len(dense)) < share]
        spectra.append(compute_smallest_eigenvalues(build_surface_laplacian(thin_points(some, 0.25)), 10))
    assert np.allclose(*normalise_spectra(np.array(spectra), "weyl"), rtol=0.06)


def test_too_few_cells_are_padded():
    cells = np.argwhere(np.ones((3, 3, 2), bool)).astype(np.int32)
    eigenvalues = compute_spectrum(cells, 0.1, "graph", 256, 0.1, 20_000)
    assert eigenvalues.shape == (256,) and np.isfinite(eigenvalues).all()
    assert (np.diff(eigenvalues) >= 0).all() and eigenvalues[-1] > eigenvalues[17]


def test_normalised():
    values = np.array([[2.0, 4.0, 6.0], [0.0, 0.0, 0.0]])
    assert np.allclose(normalise_spectra(values, "weyl"), [[1, 2, 3], [0, 0, 0]])
    assert np.allclose(normalise_spectra(values, "first"), [[1, 2, 3], [0, 0, 0]])


def test_kernel_is_its_slow_twin():
    rng = np.random.default_rng(0)
    ring = np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))], axis=1)
    flat = ring[None] * rng.uniform(0.8, 1.6, (20, 8, 1))
    area, weight = compute_voronoi_weights(flat, np.full(20, 1.2))
    for k in range(20):
        planes = np.concatenate([flat[k], -0.5 * (flat[k] ** 2).sum(1, keepdims=True)], axis=1)
        frame = np.array([(1, 0, -2.4), (-1, 0, -2.4), (0, 1, -2.4), (0, -1, -2.4)])
        corners = HalfspaceIntersection(np.concatenate([planes, frame]), np.zeros(2)).intersections
        assert area[k] == pytest.approx(ConvexHull(corners).volume)
        for j in range(8):
            on = corners[abs(corners @ planes[j, :2] + planes[j, 2]) < 1e-9]
            side = np.ptp(on @ np.array([-flat[k, j, 1], flat[k, j, 0]])) / np.linalg.norm(flat[k, j]) if len(on) > 1 else 0.0
            assert weight[k, j] == pytest.approx(side / np.linalg.norm(flat[k, j]), abs=1e-9)
