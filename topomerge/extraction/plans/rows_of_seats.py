"""Rows of seats and of shelves in slices and robots' grids: free-standing pieces of wall that repeat themselves side by side
(beyond the thesis). In 3D they are lower than walls; where all that stands looks alike, their pattern is what tells them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array

ROW_LENGTH, ROW_WIDTH = 1.0, 1.0  # m: a row is at least so long, and no wider
LEAST_ROWS = 4  # side by side; two faces of a wall and two leaves are fewer
AISLE = (0.25, 1.4)  # m of floor between two rows: narrower than any row of rooms
ROW_TURN = np.radians(8.0)  # by which neighbouring rows may differ
ROW_OVERLAP = 0.6  # of the longer of two neighbouring rows, that lies beside the other one
UNEVEN = 0.3  # of the median step from row to row, by which steps may differ
SAME_STEP, LONGER_ROW = 0.15, 1.5  # share of the step, and times the longest row, by which one beyond them may differ
IN_LINE, LEAST_PART = (0.3, 1.0), 0.5  # m across and along, between parts of one row, and how long such a part is
NEXT_ROW, PAST_ROWS = 1.25, 0.5  # steps beyond the rows, and m past their ends, within which what stands alone belongs to them
SEAT_HEIGHTS = (0.1, 4.0)  # m above the floor, of what is taken out of the profile
EIGHT_AROUND = np.ones((3, 3))


def without_rows(plan: StoreyPlan) -> StoreyPlan:
    """The plan without rows of seats or shelves: their columns, and what they enclose, are the inside of a room where nothing
    stands.

    Args:
        plan: of a slice, a robot's grid or a drawing; heights tell more where there are any.
    """
    rows = rows_of_seats(plan.wall, plan.edge)
    if not rows.any():
        return plan
    standing = plan.profile.dtype.type(plan.bands.mask(*SEAT_HEIGHTS))
    profile = np.where(rows, plan.profile & ~standing, plan.profile)
    return replace(plan, wall=plan.wall & ~rows, inside=plan.inside | rows, profile=profile)


def rows_of_seats(wall: Array, edge: float) -> Array:
    """(nx, ny) bool: columns of the rows, and those that they enclose.

    Args:
        wall: (nx, ny) bool.
        edge: m, of a column.
    """
    label, _ = ndimage.label(wall, EIGHT_AROUND)
    pieces = [_Piece.of(np.argwhere(label[box] == k + 1) + [b.start for b in box], edge) for k, box in _boxes(label)]
    alone = [p for p in pieces if p.width <= ROW_WIDTH]
    rows = [r for r in _rows(alone, edge) if r.length >= ROW_LENGTH and r.width <= ROW_WIDTH]
    out = np.zeros(wall.shape, bool)
    for chain, step in _chains(rows):
        for piece in _belonging([rows[k] for k in chain], alone, step, edge):
            out[tuple(piece.columns.T)] = True
    return ndimage.binary_fill_holes(out) if out.any() else out


def _boxes(label: Array) -> Iterator[tuple[int, tuple[slice, slice]]]:
    return enumerate(ndimage.find_objects(label))


@dataclass(frozen=True, eq=False)
class _Piece:
    """A piece of wall: its columns (n, 2), its middle (2,) m, the direction of its longer side (2,) unit, and its sides, m."""

    columns: Array
    middle: Array
    along: Array
    length: float
    width: float

    @classmethod
    def of(cls, columns: Array, edge: float) -> _Piece:
        """That of given columns of `edge` m."""
        at = columns * edge
        about = at - at.mean(axis=0)
        _, axes = np.linalg.eigh(about.T @ about)
        low, high = (about @ axes).min(axis=0), (about @ axes).max(axis=0)
        width, length = (high - low + edge).tolist()
        return cls(columns, at.mean(axis=0) + axes @ (low + high) / 2, axes[:, 1], length, width)


class _Beside(NamedTuple):
    """Of every two of n pieces (n, n): are they parallel, how far the one's middle lies along and across the other, m, and the
    mean of their lengths and of their widths."""

    parallel: Array
    along: Array
    across: Array
    length: Array
    width: Array

    @classmethod
    def of(cls, pieces: Sequence[_Piece]) -> _Beside:
        """Those of given ones."""
        middle, along = np.array([p.middle for p in pieces]), np.array([p.along for p in pieces])
        sides = np.array([[p.length, p.width] for p in pieces])
        apart = middle[None] - middle[:, None]
        past = np.abs((apart * along[:, None]).sum(axis=2))
        off = np.abs(apart[..., 0] * along[:, None, 1] - apart[..., 1] * along[:, None, 0])
        mean = (sides[:, None] + sides[None]) / 2
        return cls(np.abs(along @ along.T) > np.cos(ROW_TURN), past, off, mean[..., 0], mean[..., 1])


def _rows(pieces: Sequence[_Piece], edge: float) -> list[_Piece]:
    """Pieces, those in one line as one: a laser sees a row in parts."""
    parts = [p for p in pieces if p.length >= LEAST_PART]
    if not parts:
        return []
    beside = _Beside.of(parts)
    line = beside.parallel & (beside.across < IN_LINE[0]) & (beside.along - beside.length < IN_LINE[1])
    group = connected_components(coo_matrix(line & line.T), directed=False)[1]
    return [_Piece.of(np.concatenate([parts[i].columns for i in np.flatnonzero(group == k)]), edge) for k in np.unique(group)]


def _chains(rows: Sequence[_Piece]) -> Iterator[tuple[Array, float]]:
    """Rows that follow each other at one step, and that step, m."""
    if len(rows) < LEAST_ROWS:
        return
    beside = _Beside.of(rows)
    length = np.array([r.length for r in rows])
    shared = np.minimum(beside.length - beside.along, np.minimum(length[:, None], length))
    aisle = beside.across - beside.width
    follows = beside.parallel & (shared >= ROW_OVERLAP * np.maximum(length[:, None], length))
    follows &= (aisle > AISLE[0]) & (aisle < AISLE[1])
    follows &= follows.T
    group = connected_components(coo_matrix(follows), directed=False)[1]
    nearest = np.where(follows, beside.across, np.inf).min(axis=1)
    for k in np.flatnonzero(np.bincount(group) >= LEAST_ROWS).tolist():
        chain = np.flatnonzero(group == k)
        step = float(np.median(nearest[chain]))
        even = chain[np.abs(nearest[chain] - step) <= UNEVEN * step]
        if len(even) >= LEAST_ROWS:
            yield _continued(even, step, beside, length), step


def _continued(chain: Array, step: float, beside: _Beside, length: Array) -> Array:
    """The chain with the rows that follow at its step, of which the sensor saw less, or, in front, more."""
    shorter = np.minimum(length[:, None], length)
    shared = np.minimum(beside.length - beside.along, shorter) >= ROW_OVERLAP * shorter
    next_to = beside.parallel & shared & (np.abs(beside.across - step) <= SAME_STEP * step)
    while True:
        rows = next_to[chain].any(axis=0) & (length <= LONGER_ROW * length[chain].max())
        longer = np.union1d(chain, np.flatnonzero(rows))
        if len(longer) == len(chain):
            return longer
        chain = longer


def _belonging(rows: Sequence[_Piece], alone: Sequence[_Piece], step: float, edge: float) -> list[_Piece]:
    """The rows of a chain, and what else stands alone between them, or where the next one would be: rows of which little was
    seen. What is longer than the rows is a wall."""
    along = rows[0].along
    axes = np.column_stack([along, [-along[1], along[0]]])
    reach = np.array([PAST_ROWS, NEXT_ROW * step])
    extents = np.array([[(p.columns * edge @ axes).min(axis=0), (p.columns * edge @ axes).max(axis=0)] for p in alone])
    at = np.concatenate([r.columns for r in rows]) * edge @ axes
    low, high = at.min(axis=0), at.max(axis=0)
    while True:
        inside = (extents[:, 0] >= low - reach).all(axis=1) & (extents[:, 1] <= high + reach).all(axis=1)
        if not inside.any():
            return list(rows)
        lower = np.minimum(low, extents[inside, 0].min(axis=0))
        upper = np.maximum(high, extents[inside, 1].max(axis=0))
        if (lower[1], upper[1]) == (low[1], high[1]):
            return [*rows, *(p for p, within in zip(alone, inside, strict=True) if within)]
        low, high = np.array([low[0], lower[1]]), np.array([high[0], upper[1]])
