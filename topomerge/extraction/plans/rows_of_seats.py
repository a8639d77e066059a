"""Rows of seats and of shelves in slices and robots' grids: free-standing pieces of wall that repeat themselves side by side
(beyond the thesis). In 3D they are lower than walls; where all that stands looks alike, their pattern is what tells them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
DOOR_GAP, GOES_ON = 1.6, (0.3, 0.6)  # m: what goes on so long behind gaps as wide as a door, at one end and the other, is a wall
LEAST_BESIDE = 10  # columns at the unknown outside of the building: a piece that has them is part of its shell
PAST_ROWS = 0.5  # m past their ends, within which what stands alone between rows belongs to them
SEAT_HEIGHTS = (0.1, 4.0)  # m above the floor, of what is taken out of the profile
EIGHT_AROUND = np.ones((3, 3))


def without_rows(plan: StoreyPlan) -> StoreyPlan:
    """The plan without rows of seats or shelves: their columns, and what they enclose, are the inside of a room where nothing
    stands.

    Args:
        plan: of a slice, a robot's grid or a drawing; heights tell more where there are any.
    """
    rows = rows_of_seats(plan.wall, plan.inside, plan.edge)
    if not rows.any():
        return plan
    standing = plan.profile.dtype.type(plan.bands.mask(*SEAT_HEIGHTS))
    profile = np.where(rows, plan.profile & ~standing, plan.profile)
    return replace(plan, wall=plan.wall & ~rows, inside=plan.inside | rows, profile=profile)


def rows_of_seats(wall: Array, inside: Array, edge: float) -> Array:
    """(nx, ny) bool: columns of the rows, and those that they enclose.

    Args:
        wall, inside: (nx, ny) bool, as of `StoreyPlan`.
        edge: m, of a column.
    """
    label, _ = ndimage.label(wall, EIGHT_AROUND)
    alone = []
    for number, box in enumerate(ndimage.find_objects(label), 1):
        if max(b.stop - b.start for b in box) * edge >= LEAST_PART:
            piece = _Piece.of(np.argwhere(label[box] == number) + [b.start for b in box], edge)
            alone += [piece] if piece.width <= ROW_WIDTH and piece.length >= LEAST_PART else []
    alone = _without_walls(alone, _shell(label, inside), edge)
    rows = [r for r in _rows(alone, edge) if r.length >= ROW_LENGTH and r.width <= ROW_WIDTH]
    out = np.zeros(wall.shape, bool)
    for chain in _chains(rows):
        for piece in _belonging([rows[k] for k in chain], alone, edge):
            out[tuple(piece.columns.T)] = True
    return ndimage.binary_fill_holes(out) if out.any() else out


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
        at = (columns + 0.5) * edge
        about = at - at.mean(axis=0)
        _, axes = np.linalg.eigh(about.T @ about)
        low, high = (about @ axes).min(axis=0), (about @ axes).max(axis=0)
        width, length = (high - low + edge).tolist()
        return cls(columns, at.mean(axis=0) + axes @ (low + high) / 2, axes[:, 1], length, width)


class _Beside(NamedTuple):
    """Of n pieces against one (n,): are they parallel to it, how far their middles lie along it and across, m, and the means of
    its length and of its width with theirs."""

    parallel: Array
    along: Array
    across: Array
    length: Array
    width: Array


def _links(pieces: Sequence[_Piece], linked: Callable[[_Beside, int], Array]) -> tuple[Array, Array]:
    """(n,) group of each piece by which of them are linked, either way, and how far across its nearest link lies, m.

    One piece at a time: thousands of pieces of a large map make no table of all pairs.

    Args:
        linked: of a piece's neighbours and its number, (n,) bool.
    """
    middle, direction = np.array([p.middle for p in pieces]), np.array([p.along for p in pieces])
    sides = np.array([[p.length, p.width] for p in pieces])
    nearest, pairs = np.full(len(pieces), np.inf), []
    for i in range(len(pieces)):
        apart, (x, y) = middle - middle[i], direction[i]
        parallel = np.abs(direction @ direction[i]) > np.cos(ROW_TURN)
        past, off = np.abs(apart @ direction[i]), np.abs(apart[:, 0] * y - apart[:, 1] * x)
        others = linked(_Beside(parallel, past, off, *(sides + sides[i]).T / 2), i)
        others[i] = False
        others = np.flatnonzero(others)
        pairs.append(np.column_stack([np.full(len(others), i), others]))
        nearest[i] = off[others].min(initial=np.inf)
    table = np.concatenate(pairs) if pairs else np.zeros((0, 2), np.int64)
    graph = coo_matrix((np.ones(len(table)), tuple(table.T)), (len(pieces),) * 2)
    return connected_components(graph, directed=False)[1], nearest


def _shell(label: Array, inside: Array) -> Array:
    """(nx, ny) bool: walls that are connected to those around the building, beyond which nothing is known.

    Args:
        label: (nx, ny) number of each connected piece of wall, 0 none.
    """
    unknown, _ = ndimage.label(np.pad((label == 0) & ~inside, 1, constant_values=True))
    outside = ndimage.binary_dilation(unknown == unknown[0, 0], EIGHT_AROUND)[1:-1, 1:-1]
    beside = np.bincount(label[outside], minlength=int(label.max()) + 1) >= LEAST_BESIDE
    beside[0] = False
    return np.asarray(beside[label])


def _without_walls(pieces: Sequence[_Piece], shell: Array, edge: float) -> list[_Piece]:
    """Pieces but for those that are parts of a wall with doors: in line with others, behind gaps as wide as doors, they go on to
    the shell at both ends. A row looks at the side of a wall, which is thin, or at an aisle."""
    out: list[_Piece] = []
    for line in _lines(pieces, DOOR_GAP):
        runs = _runs_beyond(_Piece.of(np.concatenate([p.columns for p in line]), edge), shell, edge)
        out += [] if min(runs) >= GOES_ON[0] and max(runs) >= GOES_ON[1] else line
    return out


def _runs_beyond(piece: _Piece, wall: Array, edge: float) -> list[float]:
    """m of wall in line with a piece past each of its ends, as far as a door and the longer `GOES_ON`."""
    steps = np.arange(edge / 2, DOOR_GAP + GOES_ON[1], edge)
    across = np.array([-piece.along[1], piece.along[0]])
    out = []
    for way in (-1, 1):
        line = piece.middle + way * (piece.length / 2 + steps)[:, None] * piece.along
        at = np.floor((line[:, None] + np.array([-edge, 0.0, edge])[:, None] * across) / edge).astype(np.int64)
        there = ((at >= 0) & (at < wall.shape)).all(axis=-1)
        at = np.where(there[..., None], at, 0)
        full = np.pad(there & wall[at[..., 0], at[..., 1]], ((1, 1), (0, 0))).T.ravel()
        ends = np.flatnonzero(np.diff(full.astype(np.int8))).reshape(-1, 2)
        out.append(float((ends[:, 1] - ends[:, 0]).max(initial=0)) * edge)
    return out


def _lines(pieces: Sequence[_Piece], gap: float) -> list[list[_Piece]]:
    """Pieces that lie in one line, at most `gap` m from each other."""
    group, _ = _links(pieces, lambda b, i: b.parallel & (b.across < IN_LINE[0]) & (b.along - b.length < gap))
    return [[pieces[i] for i in np.flatnonzero(group == k).tolist()] for k in np.unique(group)]


def _rows(pieces: Sequence[_Piece], edge: float) -> list[_Piece]:
    """Pieces, those in one line as one: a laser sees a row in parts."""
    return [_Piece.of(np.concatenate([p.columns for p in line]), edge) for line in _lines(pieces, IN_LINE[1])]


def _chains(rows: Sequence[_Piece]) -> Iterator[Array]:
    """Which rows follow each other at one step."""
    if len(rows) < LEAST_ROWS:
        return
    length = np.array([r.length for r in rows])

    def follows(beside: _Beside, i: int) -> Array:
        shared = np.minimum(beside.length - beside.along, np.minimum(length, length[i]))
        aisle = beside.across - beside.width
        near = (aisle > AISLE[0]) & (aisle < AISLE[1])
        return beside.parallel & near & (shared >= ROW_OVERLAP * np.maximum(length, length[i]))

    group, nearest = _links(rows, follows)
    for k in np.flatnonzero(np.bincount(group) >= LEAST_ROWS).tolist():
        chain = np.flatnonzero(group == k)
        step = float(np.median(nearest[chain]))
        even = chain[np.abs(nearest[chain] - step) <= UNEVEN * step]
        if len(even) >= LEAST_ROWS:
            yield _continued(rows, even, step)


def _continued(rows: Sequence[_Piece], chain: Array, step: float) -> Array:
    """The chain with the rows that follow at its step, of which the sensor saw less, or, in front, more."""
    length = np.array([r.length for r in rows])
    longest = LONGER_ROW * float(length[chain].max())

    def next_to(beside: _Beside, i: int) -> Array:
        shorter = np.minimum(length, length[i])
        shared = np.minimum(beside.length - beside.along, shorter) >= ROW_OVERLAP * shorter
        return beside.parallel & shared & (np.abs(beside.across - step) <= SAME_STEP * step) & (length <= longest)

    group, _ = _links(rows, next_to)
    return np.flatnonzero(np.isin(group, group[chain]) & (length <= longest))


def _belonging(rows: Sequence[_Piece], alone: Sequence[_Piece], edge: float) -> list[_Piece]:
    """The rows of a chain, and what else stands alone between them."""
    along = np.array([r.along * np.sign(r.along @ rows[0].along) * r.length for r in rows]).sum(axis=0)
    along /= np.linalg.norm(along)
    axes = np.column_stack([along, [-along[1], along[0]]]) * edge
    at = np.concatenate([r.columns for r in rows]) @ axes
    low, high = at.min(axis=0) - (PAST_ROWS, 0), at.max(axis=0) + (PAST_ROWS, 0)
    between = [p for p in alone if ((p.columns @ axes >= low) & (p.columns @ axes <= high)).all()]
    return [*rows, *between]
