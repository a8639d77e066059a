"""The Voronoi graph of a grid map, and the critical lines across its narrow places (Thrun 1998, as the survey has it)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import Voronoi

from topomerge.types import Array

# m2: a critical point is the narrowest place of the graph for this, divided by its clearance (the authors: 280 cells of 5 cm).
NEIGHBOURHOOD = 0.7
APART = 0.5  # of its clearance that critical points are apart at least
TEETH = 3.0  # cells between the two walls of a point of the graph: below are the teeth of slanted walls


def graph(free: Array) -> tuple[Array, Array, Array]:
    """The Voronoi graph of the occupied cells beside free ones, without its dead ends.

    Args:
        free: (h, w) bool.

    Returns:
        (n, 2) points (row, column), (e, 2) pairs of them, and (e, 2, 2) the two cells that are the nearest to each edge.
    """
    padded = np.pad(free, 1)
    wall = np.argwhere(~padded & ndimage.binary_dilation(padded, np.ones((3, 3)))) - 1.0
    none = np.zeros((0, 2))
    if len(wall) < 4:
        return none, none.astype(int), np.zeros((0, 2, 2))
    cells = Voronoi(wall)
    at = np.rint(cells.vertices).astype(int)
    inside = np.all((at >= 0) & (at < free.shape), axis=1)
    inside[inside] = free[tuple(at[inside].T)]
    ends, walls = np.array(cells.ridge_vertices), wall[cells.ridge_points]
    good = (ends >= 0).all(axis=1)
    good[good] = inside[ends[good]].all(axis=1)
    ends, walls = ends[good], walls[good]
    wide = np.linalg.norm(walls[:, 0] - walls[:, 1], axis=1) > TEETH
    ends, walls = ends[wide], walls[wide]
    stay = _without_dead_ends(ends, len(cells.vertices))
    return cells.vertices, ends[stay], walls[stay]


def _without_dead_ends(ends: Array, count: int) -> Array:
    """(e,) bool edges that remain when every dead end is taken back to the first crossing."""
    stay = np.ones(len(ends), bool)
    crossing = np.bincount(ends.ravel(), minlength=count) >= 3
    while True:
        degree = np.bincount(ends[stay].ravel(), minlength=count)
        loose = (degree == 1) & ~crossing
        dead = stay & loose[ends].any(axis=1)
        if not dead.any():
            return stay
        stay &= ~dead


def critical_lines(free: Array, cell: float) -> list[tuple[Array, Array]]:
    """Rows and columns of the cells of each critical line: from a narrowest point of the graph to its two nearest walls.

    Args:
        free: (h, w) bool.
        cell: m, edge of a cell.
    """
    points, ends, walls = graph(free)
    if not len(ends):
        return []
    middle = points[ends].mean(axis=1)
    clearance = np.linalg.norm(middle - walls[:, 0], axis=1) * cell
    narrow = _narrowest(points * cell, ends, clearance)
    one, two = walls[:, 0] - middle, walls[:, 1] - middle
    cosine = (one * two).sum(axis=1) / np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1), 1e-9)
    lines: list[tuple[Array, Array]] = []
    taken = np.zeros((0, 2))
    for edge in narrow[np.lexsort([narrow, clearance[narrow], np.round(cosine[narrow], 1)])]:  # the straightest first
        near = np.linalg.norm(taken - middle[edge], axis=1) * cell
        if (near < APART * clearance[edge]).any():
            continue
        taken = np.concatenate([taken, middle[edge][None]])
        lines.append(_line(walls[edge, 0], middle[edge], walls[edge, 1], free.shape))
    return lines


def _narrowest(points: Array, ends: Array, clearance: Array) -> Array:
    """Edges that no other edge of the graph within their neighbourhood undercuts; every one of a stretch of even width."""
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    count, edges = len(points), np.arange(len(ends))
    table = sparse.csr_matrix((np.tile(edges, 2), (ends.T.ravel(), ends[:, ::-1].T.ravel())), (count, count))
    out = []
    for edge in edges:
        reach = NEIGHBOURHOOD / 2 / max(clearance[edge], 1e-6)  # to each side
        far = dict.fromkeys(ends[edge].tolist(), 0.0)
        stack, least = list(far), clearance[edge]
        while stack and least >= clearance[edge]:
            at = stack.pop()
            row = slice(table.indptr[at], table.indptr[at + 1])
            for to, via in zip(table.indices[row].tolist(), table.data[row].tolist(), strict=True):
                least = min(least, clearance[via])
                way = far[at] + length[via]
                if way < reach and way < far.get(to, np.inf):
                    far[to] = way
                    stack.append(to)
        if least >= clearance[edge]:
            out.append(edge)
    return np.array(out, int)


def _line(start: Array, middle: Array, end: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Rows and columns of the cells from one wall over the middle to the other."""
    steps = 2 + 3 * int(np.linalg.norm(start - middle) + np.linalg.norm(end - middle))
    way = np.linspace(0, 1, steps)[:, None]
    places = np.concatenate([start + way * (middle - start), middle + way * (end - middle)])
    rows, columns = np.clip(np.rint(places).astype(int), 0, np.array(shape) - 1).T
    return rows, columns
