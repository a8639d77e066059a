"""Sparse voxel octree over Morton codes: building and querying (compiled loops behind `extraction.views.visibility`).

Leaves and nodes share one numbering: leaves 0 .. n - 1 are the rows of the grid, then the nodes level by level, the root
last. The children of node n + j are ``child[j] .. child[j + 1] - 1``, its leaves the rows ``span[j]``, and ``box[j]`` the
lowest and highest occupied cell in it: inside the bounds that its Morton prefix gives, and flat where a floor is flat.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topomerge.kernels import run_in_slices

STACK_SIZE = 8 * 22  # room on the stack: every level leaves at most seven siblings behind
LEAST_QUERIES = 64  # of a slice
MOST_BRICKS = 64  # a ball that may touch more than this is searched from the root


class Nodes(NamedTuple):
    """The tree as arrays; `first` (levels + 1,) int64 tells where each level of nodes starts, counted without the leaves."""

    child: NDArray[np.int64]  # (m + 1,)
    span: NDArray[np.int64]  # (m, 2) first row, last row + 1
    box: NDArray[np.int32]  # (m, 6) lowest and highest occupied cell
    codes: NDArray[np.uint64]  # (m,) Morton prefix
    first: NDArray[np.int64]


@njit(cache=True)
def _build_buckets(codes, child, parents, first):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    count = 0
    for i in range(len(codes)):
        parent = codes[i] >> np.uint64(3)
        if count == 0 or parents[count - 1] != parent:
            parents[count], first[count] = parent, child + i
            count += 1
    return count


@njit(cache=True)
def _compute_bounds(cells, child, span, box):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    n = len(cells)
    for j in range(len(span)):
        a, b = child[j], child[j + 1] - 1
        span[j, 0] = a if a < n else span[a - n, 0]
        span[j, 1] = b + 1 if b < n else span[b - n, 1]
        box[j, :3], box[j, 3:] = 1 << 30, -1
        for c in range(a, b + 1):
            for k in range(3):
                box[j, k] = min(box[j, k], cells[c, k] if c < n else box[c - n, k])
                box[j, 3 + k] = max(box[j, 3 + k], cells[c, k] if c < n else box[c - n, 3 + k])


def build(cells: NDArray[np.int32], codes: NDArray[np.uint64]) -> Nodes:
    """Build the nodes over (n, 3) cells in Morton order: codes go into buckets of 8 until one bucket, the root, is left (seeds
    2.2.1)."""
    level, start = codes, 0
    parts: list[tuple[NDArray[Any], NDArray[Any]]] = []
    while len(codes) and (not parts or len(level) > 1):
        parents, first = np.empty(len(level), np.uint64), np.empty(len(level), np.int64)
        count = _build_buckets(level, start, parents, first)
        start, level = start + len(level), parents[:count].copy()
        parts.append((level, first[:count]))
    sizes = np.array([len(p) for p, _ in parts], np.int64)
    child = np.concatenate([f for _, f in parts] + [np.array([start], np.int64)])
    size = int(sizes.sum())
    span, box = np.empty((size, 2), np.int64), np.empty((size, 6), np.int32)
    _compute_bounds(cells, child, span, box)
    prefixes = np.concatenate([p for p, _ in parts]) if parts else np.empty(0, np.uint64)
    return Nodes(child, span, box, prefixes, np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64))


@njit(cache=True, error_model="numpy")
def _descend(child, j, stack, top):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Put the children of node j on the stack, the last row's first; return its new height."""
    for c in range(child[j + 1] - 1, child[j] - 1, -1):
        stack[top] = c
        top += 1
    return top


@njit(cache=True, error_model="numpy")
def _find_bricks(centre, reach, size):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the first and last + 1 of the bricks that an axis of the ball may touch; an empty range where it lies outside."""
    low = min(max(np.ceil(centre - reach), 0.0), 8.0 * size)  # clipped as floats: a far point is no integer
    high = max(min(np.floor(centre + reach), 8.0 * size - 1.0), -1.0)
    first = int(low) >> 3
    return first, max((int(high) >> 3) + 1, first)


@njit(cache=True, error_model="numpy")
def _push_start_nodes(table, first_brick, centre, reach, root, stack):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Put the nodes where a ball query starts on the stack, the last row's first: the few bricks that a small ball can
    touch, which are the third level of the tree and numbered as it is, else the root. Returns how many."""
    stack[0] = root
    x0, x1 = _find_bricks(centre[0], reach, table.shape[0])
    y0, y1 = _find_bricks(centre[1], reach, table.shape[1])
    z0, z1 = _find_bricks(centre[2], reach, table.shape[2])
    if first_brick < 0 or (x1 - x0) * (y1 - y0) * (z1 - z0) > MOST_BRICKS:
        return 1
    top = 0
    for x in range(x0, x1):
        for y in range(y0, y1):
            for z in range(z0, z1):
                if table[x, y, z] < 0:
                    continue
                node, at = first_brick + table[x, y, z], top
                while at and stack[at - 1] < node:
                    stack[at] = stack[at - 1]
                    at -= 1
                stack[at] = node
                top += 1
    return top


@njit(cache=True, error_model="numpy")
def _find_in_ball(cells, child, span, box, centre, square, top, stack, out, fill):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Find the rows of the cells whose squared distance to `centre` (in cells) is at most `square`, below the `top` nodes on the
    stack; return how many."""
    n, count = len(cells), 0
    x, y, z = centre[0], centre[1], centre[2]
    while top:
        top -= 1
        j = stack[top] - n
        ax, ay, az = box[j, 0] - x, box[j, 1] - y, box[j, 2] - z
        bx, by, bz = box[j, 3] - x, box[j, 4] - y, box[j, 5] - z
        dx, dy, dz = max(ax, -bx, 0.0), max(ay, -by, 0.0), max(az, -bz, 0.0)
        if dx * dx + dy * dy + dz * dz > square:
            continue
        dx, dy, dz = max(-ax, bx), max(-ay, by), max(-az, bz)
        if dx * dx + dy * dy + dz * dz <= square:
            if fill:
                for r in range(span[j, 0], span[j, 1]):
                    out[count + r - span[j, 0]] = r
            count += span[j, 1] - span[j, 0]
        elif child[j] < n:
            for r in range(child[j], child[j + 1]):
                dx, dy, dz = cells[r, 0] - x, cells[r, 1] - y, cells[r, 2] - z
                if dx * dx + dy * dy + dz * dz <= square:
                    if fill:
                        out[count] = r
                    count += 1
        else:
            top = _descend(child, j, stack, top)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _query_balls(begin, end, tree, centres, reach, indptr, out, fill):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    cells, child, span, box, table, first_brick = tree
    root, stack = len(cells) + len(span) - 1, np.empty(STACK_SIZE, np.int64)
    for i in range(begin, end):
        part = out[indptr[i] : indptr[i + 1]] if fill else out
        top = _push_start_nodes(table, first_brick, centres[i], reach, root, stack)
        count = _find_in_ball(cells, child, span, box, centres[i], reach * reach, top, stack, part, fill)
        if not fill:
            indptr[i + 1] = count


@njit(cache=True, error_model="numpy")
def _collect_in_box(cells, child, span, box, low, high, stack, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Collect the rows of the cells low <= cell < high into `out`; return how many."""
    n, count, top = len(cells), 0, 1
    stack[0] = n + len(span) - 1
    while top:
        top -= 1
        j = stack[top] - n
        outside, inside = False, True
        for k in range(3):
            outside |= box[j, k] >= high[k] or box[j, 3 + k] < low[k]
            inside &= low[k] <= box[j, k] and box[j, 3 + k] < high[k]
        if outside:
            continue
        if inside:
            for r in range(span[j, 0], span[j, 1]):
                out[count] = r
                count += 1
        elif child[j] < n:
            for r in range(child[j], child[j + 1]):
                if low[0] <= cells[r, 0] < high[0] and low[1] <= cells[r, 1] < high[1] and low[2] <= cells[r, 2] < high[2]:
                    out[count] = r
                    count += 1
        else:
            top = _descend(child, j, stack, top)
    return count


def find_in_box(cells: NDArray[np.int32], nodes: Nodes, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return ascending rows of the cells low <= cell < high."""
    out = np.empty(len(cells), np.int64)
    if not len(cells):
        return out
    stack = np.empty(STACK_SIZE, np.int64)
    return out[: _collect_in_box(cells, *nodes[:3], low, high, stack, out)].copy()


def find_in_balls(
    cells: NDArray[np.int32], nodes: Nodes, table: NDArray[np.int32], centres: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the CSR (indptr, ascending rows) of the cells within `radius` of (q, 3) centres, all in cells; `table` is
    `voxels.build`'s."""
    indptr = np.zeros(len(centres) + 1, np.int64)
    rows = np.empty(0, np.int64)
    if not len(cells):
        return indptr, rows
    first_brick = len(cells) + int(nodes.first[2]) if len(nodes.first) > 3 else -1
    tree = (cells, *nodes[:3], table, first_brick)
    for fill in (False, True):
        if fill:
            np.cumsum(indptr, out=indptr)
            rows = np.empty(indptr[-1], np.int64)
        run_in_slices(_query_balls, len(centres), LEAST_QUERIES, tree, centres, radius, indptr, rows, fill)
    return indptr, rows
