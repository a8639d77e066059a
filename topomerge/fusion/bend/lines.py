"""Each piece registered by its walls' lines, once it lies within decimetres: point to line, seen from above (method 4).

Columns of a plan are a decimetre wide; the mean of the points in a column of a wall knows it to a centimetre, in scans and in
slices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.fusion.bend.pieces import Pieces
from topomerge.kernels.bend import line_normals, line_steps
from topomerge.matching.plan_fields import PlanFields
from topomerge.types import Array, Sim3

BODY = (0.3, 2.2)  # m above the floor: what stands there is averaged
LINE_REACH, LEAST_ON_LINE = 3, 4  # columns around a point that its line is drawn through, and the least number of points there
STRAIGHT = 0.7  # lines that are less straight are left out: corners
LEAST_FACING = 0.3  # cosine between a line's normal and the way to empty space, from which its side is known
PARTNER_REACH = 3  # columns in which partners are looked for
LINE_SIGMAS = (0.1, 0.06, 0.04, 0.03)  # m, of the robust weights, round by round
INDEPENDENT = 8.0  # columns of a wall whose errors are one
LINE_NOISE = 0.015  # m
LEAST_PARTNERS = 8  # columns of a piece, below which nothing is measured
LINE_FLOOR = (0.003, float(np.radians(0.05)))  # m, rad: no move is known better


@dataclass(frozen=True, eq=False)
class WallLines:
    """The walls of a storey as points with normals.

    Args:
        row: (nx, ny) int32 row of the point in each column of the plan, -1 none.
        points: (w, 2) m, mean of what stands in each column of `PlanFields.walls`.
        normals: (w, 2), towards empty space where `faced`; 0 where no line is.
        faced: (w,) bool.
        straight: (w,) bool, and higher than furniture.
    """

    row: Array
    points: Array
    normals: Array
    faced: Array
    straight: Array


def wall_lines(fields: PlanFields, middles: Array) -> WallLines:
    """The walls of a storey.

    Args:
        middles: (n, 3) m, middle of the points of each cell of the map.
    """
    plan = fields.plan
    row = np.full(plan.wall.shape, -1, np.int32)
    columns = np.argwhere(plan.wall)
    row[plan.wall] = np.arange(len(columns))
    cells = np.floor((middles[:, :2] - plan.origin) / plan.edge + 1e-6).astype(np.int64)
    inside = ((cells >= 0) & (cells < row.shape)).all(axis=1)
    cells, middles = cells[inside], middles[inside]
    at = row[tuple(cells.T)]
    height = middles[:, 2] - plan.floor[tuple(cells.T)]
    chosen = (at >= 0) & (height > BODY[0]) & (height < BODY[1])
    many = np.bincount(at[chosen], minlength=len(columns))[:, None]
    total = np.column_stack([np.bincount(at[chosen], middles[chosen, k], len(columns)) for k in (0, 1)])
    points = np.where(many > 0, total / np.maximum(many, 1), fields.walls)
    normals, straight = line_normals(row, points, columns, LINE_REACH, LEAST_ON_LINE)
    side = (normals * fields.face[plan.wall]).sum(axis=1)
    return WallLines(
        row, points, np.where(side[:, None] < 0, -normals, normals), np.abs(side) > 0.3, (straight >= STRAIGHT) & fields.tall
    )


def measure_lines(
    pieces: Pieces, chosen: Array, lines: WallLines, moves: Array, into: Sim3, onto: tuple[PlanFields, WallLines], sigma: float
) -> tuple[Array, Array, Array, Array]:
    """The chosen pieces of a storey that have partners (k,), their moves (k, 3) in their own frame, the information (k, 3, 3);
    and (2,) sums of weights and of weighted squared distances, m2.

    Args:
        lines: of the pieces' storey, whose walls are rows of `pieces.walls` from the first one of the storey on.
        moves: (n, 3) shift and turn from which to start.
        into: the pieces' frame -> that of the target.
        onto: the storey of the other map.
        sigma: m, of the robust weights.
    """
    fields, target = onto
    first = int(np.flatnonzero(np.isin(pieces.owner, chosen)).min())
    owner = pieces.owner[first : first + len(lines.points)]
    rows = np.flatnonzero(lines.straight)
    rows = rows[np.argsort(owner[rows], kind="stable")]
    start = np.searchsorted(owner[rows], np.append(chosen, chosen[-1] + 1))
    points = into.scale * (lines.points[rows] - pieces.anchors[owner[rows]])
    placed = pieces.anchors[chosen] + moves[chosen, :2]
    places = into.apply(np.column_stack([placed, np.zeros(len(placed))]))[:, :2]
    straight = np.where(target.straight, np.arange(len(target.points)), -1).astype(np.int32)
    row = np.where(target.row >= 0, straight[target.row], -1)
    h, g, partners, sums = line_steps(
        points, lines.normals[rows], lines.faced[rows], start, places, into.yaw + moves[chosen, 2], row, target.points,
        target.normals, target.faced, fields.plan.origin, fields.plan.edge, PARTNER_REACH, sigma,
    )  # fmt: skip
    enough = partners >= LEAST_PARTNERS
    own = np.eye(3)  # the target's frame -> that of the pieces
    own[:2, :2] = into.inverse().matrix[:2, :2]
    there = np.linalg.inv(own)
    h, g = h[enough], g[enough]
    steps = -np.einsum("kij,kj->ki", np.linalg.pinv(h, rcond=1e-4, hermitian=True), g)
    certain = _bounded(h / (INDEPENDENT * LINE_NOISE**2))
    return chosen[enough], moves[chosen[enough]] + steps @ own.T, there.T @ certain @ there, sums[enough].sum(axis=0)


def _bounded(information: Array) -> Array:
    """Information (k, 3, 3) after the floor of what can be known is added to its covariance, in each of its own directions."""
    unit = np.diag([LINE_FLOOR[0], LINE_FLOOR[0], LINE_FLOOR[1]])
    back = np.linalg.inv(unit)
    values, vectors = np.linalg.eigh(unit @ information @ unit)
    values = np.maximum(values, 0)
    bounded = (vectors * (values / (1 + values))[:, None, :]) @ vectors.transpose(0, 2, 1)
    out: Array = back @ bounded @ back
    return out
