"""Moves of the pieces of two maps from what was measured between them: robust sparse least squares (method 4).

Variables are a shift, a turn and, where the scale is free, the logarithm of a scale for each piece, all in one frame. Joints hold
neighbouring pieces of one map together, as stiff as its sensor drifts; measurements say how a place of one map lies on the other
one, with graduated non-convexity (Yang et al. 2020, RA-L 5(2); Geman-McClure), so that a wrong one does not drag the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from topomerge.kernels.graphs import compute_selected_inverse
from topomerge.types import Array

UNKNOWNS = 4  # of a piece: shift x, y, turn, logarithm of the scale
SETTLED_WEIGHTS = 0.005  # change of the weights, below which no further round is needed
CONVEX_ROUNDS = 10  # of graduated non-convexity
OUTLIER = 9.0  # square of the misfit, in standard deviations, from which a measurement is doubted
FIXED = 1e-9  # variance of what may not move


@dataclass(frozen=True, eq=False)
class Joints:
    """Neighbouring pieces: (j, 2) numbers, and (j, 4) standard deviations of the differences of their moves at the place between
    them: m, m, rad, logarithm of the scale."""

    pieces: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Measurements:
    """How places lie apart.

    Args:
        piece: (m,) the piece that was measured.
        places: (m, 2) where, m.
        others: (m, q) pieces of the other map, and shares (m, q) of what they have to say there; 0 none.
        moves: (m, 3) shift and turn of the piece against the others.
        information: (m, 3, 3).
    """

    piece: Array
    places: Array
    others: Array
    shares: Array
    moves: Array
    information: Array


@dataclass(frozen=True, eq=False)
class SettledMoves:
    """Moves that settled, and what is computed of them when it is asked for: inverting costs more than solving.

    Args:
        moves: (n, 4).
        weights: (m,) 0..1 of each measurement.
        squares: (j, 4) squared misfit of each joint in each unknown, in variances.
        factor: of the normal equations.
        jointed: rows of the joints, of the unknowns that may move.
        free: (u,) those unknowns, of 4 n.
    """

    moves: Array
    weights: Array
    squares: Array
    factor: SuperLU
    jointed: sparse.csr_matrix
    free: Array

    @property
    def strain(self) -> Array:
        """(j,) squared misfit of each joint, in variances."""
        out: Array = self.squares.sum(axis=1)
        return out

    @property
    def expected_strain(self) -> Array:
        """(j, 4) what the squares are expected to be, as far as the moves are uncertain."""
        left = np.asarray(self.jointed.multiply(self.jointed @ self._inverse).sum(axis=1)).reshape(-1, UNKNOWNS)
        return self.squares + left

    @cached_property
    def covariance(self) -> Array:
        """(n, 3, 3) of shift and turn of each piece."""
        count, inverse = len(self.moves), self._inverse.tocoo()
        piece, unknown = np.divmod(self.free, UNKNOWNS)
        out = np.tile(FIXED * np.eye(UNKNOWNS), (count, 1, 1))
        own = piece[inverse.row] == piece[inverse.col]
        i, j = inverse.row[own], inverse.col[own]
        out[piece[i], unknown[i], unknown[j]] = inverse.data[own]
        return out[:, :3, :3]

    @cached_property
    def _inverse(self) -> sparse.csr_matrix:
        """(u, u) inverse of the normal equations where their factor has entries: at all joints, and at each piece."""
        return _invert_factor(self.factor)


# Not GTSAM: on the same factors it lies 0.2 to 0.3 mm beside and takes 3.6 to 5 times as long, for 110 MB (docs/adr/0014).
def settle(anchors: Array, joints: Joints, measured: Measurements, prior: Array) -> SettledMoves:
    """Solve for the moves of all pieces.

    Args:
        anchors: (n, 2) m.
        prior: (n, 4) standard deviations of the moves by themselves; 0: does not move.
    """
    n = len(anchors)
    free = np.flatnonzero(prior.ravel() > 0)
    jointed = _build_joint_rows(anchors, joints)[:, free]
    held = jointed.T @ jointed + sparse.diags(1 / np.maximum(prior.ravel()[free], 1e-9) ** 2)
    rows = _build_measured_rows(anchors, measured)[:, free]
    roots = _compute_roots(measured.information)
    whitened = _multiply_blocks(roots, rows)
    owner = np.repeat(np.arange(len(measured.piece)), np.diff(whitened.indptr[::3]))  # the measurement of each entry
    aims = np.einsum("mij,mj->mi", roots, measured.moves)
    weights, moves = np.ones(len(aims)), np.zeros(len(free))
    # Graduated non-convexity: at first all measurements count, so that no early misfit votes a right one out.
    relaxed = 0.0
    for k in range(CONVEX_ROUNDS):
        scaled = _replace_values(whitened, whitened.data * weights[owner]).T
        factor = _factor(held + scaled @ whitened)
        moves = factor.solve(scaled @ aims.ravel())
        misfit = (whitened @ moves).reshape(-1, 3) - aims
        chi = (misfit**2).sum(axis=1)
        relaxed = max(2 * chi.max(initial=0) / OUTLIER, 1.0) if k == 0 else max(relaxed / 1.6, 1.0)
        before, weights = weights, (relaxed * OUTLIER / (chi + relaxed * OUTLIER)) ** 2
        if relaxed == 1.0 and np.abs(weights - before).max(initial=0.0) < SETTLED_WEIGHTS:
            break
    squares = (jointed @ moves).reshape(-1, UNKNOWNS) ** 2
    every = np.zeros(n * UNKNOWNS)
    every[free] = moves
    return SettledMoves(every.reshape(n, UNKNOWNS), weights, squares, factor, jointed, free)


def _factor(normal: sparse.spmatrix) -> SuperLU:
    """Factor the normal equations, which are symmetric and positive: their order is chosen once for rows and columns."""
    return splu(normal.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _invert_factor(factor: SuperLU) -> sparse.csr_matrix:
    """Return the inverse of what was factored, where the factor has entries; everywhere if rows and columns were ordered
    differently."""
    lower, order = factor.L, factor.perm_c
    lower.sort_indices()
    if np.array_equal(order, factor.perm_r):
        values = compute_selected_inverse(lower.indptr, lower.indices, lower.data, factor.U.diagonal())
        if not np.isnan(values[:1]).any():
            half = sparse.csc_matrix((values, lower.indices, lower.indptr), lower.shape)
            return (half + sparse.tril(half, -1).T).tocsr()[order][:, order]
    return sparse.csr_matrix(factor.solve(np.eye(len(order))))


def _compute_roots(information: Array) -> Array:
    """Return (m, 3, 3) R with R^T R the information."""
    values, vectors = np.linalg.eigh(information)
    out: Array = np.sqrt(np.maximum(values, 0))[:, :, None] * vectors.transpose(0, 2, 1)
    return out


def _build_effect(place: Array, anchors: Array) -> Array:
    """Return (m, 4, 4) how moves of pieces show at places: shift there, turn, scale."""
    x, y = (place - anchors).T
    out = np.tile(np.eye(4), (len(x), 1, 1))
    out[:, 0, 2], out[:, 1, 2] = -y, x
    out[:, 0, 3], out[:, 1, 3] = x, y
    return out


def _build_sparse(blocks: Array, rows: Array, pieces: Array, shape: tuple[int, int]) -> sparse.csr_matrix:
    """Return blocks (m, r, 4) as a sparse matrix: block k in rows r * rows[k].. and at piece pieces[k]; those at one place are
    added."""
    _, high, wide = blocks.shape
    i = (high * rows)[:, None, None] + np.arange(high)[None, :, None] + np.zeros((1, 1, wide), int)
    j = (UNKNOWNS * pieces)[:, None, None] + np.arange(wide)[None, None, :] + np.zeros((1, high, 1), int)
    return sparse.csr_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape)


def _multiply_blocks(blocks: Array, rows: sparse.csr_matrix) -> sparse.csr_matrix:
    """Multiply blocks (m, 3, 3) along the diagonal by a sparse matrix of 3 m rows."""
    many = len(blocks)
    first = 3 * np.arange(many)[:, None, None]
    columns = first + np.arange(3)[None, None, :] + np.zeros((1, 3, 1), int)
    starts = 3 * np.arange(3 * many + 1)
    return sparse.csr_matrix((blocks.ravel(), columns.ravel(), starts), (3 * many, 3 * many)) @ rows


def _replace_values(matrix: sparse.csr_matrix, values: Array) -> sparse.csr_matrix:
    """Put other values at the same places."""
    return sparse.csr_matrix((values, matrix.indices, matrix.indptr), matrix.shape)


def _build_joint_rows(anchors: Array, joints: Joints) -> sparse.csr_matrix:
    """Return the differences of moves at the places between pieces, in standard deviations."""
    many = len(joints.pieces)
    middle = anchors[joints.pieces].mean(axis=1).reshape(-1, 2)
    ends = joints.pieces.T.ravel()
    signs = np.repeat([1.0, -1.0], many)[:, None, None]
    blocks = signs * _build_effect(np.tile(middle, (2, 1)), anchors[ends]) / np.tile(joints.sigma, (2, 1))[:, :, None]
    return _build_sparse(blocks, np.tile(np.arange(many), 2), ends, (UNKNOWNS * many, UNKNOWNS * len(anchors)))


def _build_measured_rows(anchors: Array, measured: Measurements) -> sparse.csr_matrix:
    """Build the rows of the shift and turn of the measured pieces against the others."""
    many, count = measured.others.shape
    pieces = np.concatenate([measured.piece, measured.others.T.ravel()])
    shares = np.concatenate([np.ones(many), -measured.shares.T.ravel()])
    places = np.tile(measured.places, (1 + count, 1))
    blocks = shares[:, None, None] * _build_effect(places, anchors[pieces])[:, :3]
    return _build_sparse(blocks, np.tile(np.arange(many), 1 + count), pieces, (3 * many, UNKNOWNS * len(anchors)))
