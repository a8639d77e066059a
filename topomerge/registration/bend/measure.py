"""Pieces of a map registered on another one by themselves: on its plans, then on the lines of its walls (method 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.kernels import run_in_slices
from topomerge.kernels.bend import build_line_equations, compute_wall_gain, estimate_line_normals, score_moves
from topomerge.matching.poses import DISTANCE_CAP, PlanFields, compute_distance
from topomerge.registration.bend.pieces import Pieces
from topomerge.types import Array, Sim3, are_within

SECTORS = 4  # of the directions that walls face; what faces none, or away from all, is compared with all walls
# Without sides, pieces snap to the other face of a wall, 0.15 m off (docs/adr/0014).
FACES_ALIKE = -0.3  # cosine, below which two faces are two sides of a wall
PIECE_POINTS = 200  # wall columns that a piece is registered by
# Furniture is moved between sessions: pieces go by what is higher, where the map looked that high (docs/adr/0014).
LEAST_TALL = 0.2  # share of the walls around a piece, below which all of them are taken
CONTEXT = 1.0  # m around the walls of a piece that are registered with it
MISSED = 0.05  # of a wall's likelihood, where no wall is near
INDIFFERENT = 0.3  # likelihood that speaks neither for nor against
ON_FREE_FLOOR = 1.0  # logarithm by which a wall on free floor is less likely
EVIDENCE = 0.12  # of a column of walls: neighbours are not independent
MOVE_FLOOR = (0.02, float(np.radians(0.2)))  # m, rad: no move is known better
SHIFT_STEP = 0.05  # m, least step of the tried shifts
TURNS = 5  # tried ones
DISTANCE_STEPS = np.linspace(0.0, DISTANCE_CAP, 201)  # m, to which distances are rounded
BODY = (0.3, 2.2)  # m above the floor: what stands there is averaged
LINE_REACH, LEAST_ON_LINE = 3, 4  # columns around a point that its line is drawn through, and the least number of points there
STRAIGHT = 0.7  # lines that are less straight are left out: corners
PARTNER_REACH = 3  # columns in which partners are looked for
LINE_SIGMAS = (0.1, 0.06, 0.04, 0.03)  # m, of the robust weights, round by round
INDEPENDENT = 8.0  # columns of a wall whose errors are one
LINE_NOISE = 0.015  # m
LEAST_PARTNERS = 8  # columns of a piece, below which nothing is measured
LINE_FLOOR = (0.003, float(np.radians(0.05)))  # m, rad: no move is known better


@dataclass(frozen=True)
class Window:
    """Small moves that are tried: shifts up to `shift` m both ways, turns up to `turn` rad, walls as wide as `sigma` m."""

    shift: float
    sigma: float
    turn: float


class Target:
    """A storey that pieces of the other map are registered on."""

    def __init__(self, fields: PlanFields) -> None:
        self.fields = fields
        self.main = fields.main_direction
        self._rasters = _build_rasters(fields, self.main)

    def compute_gain(self, sigma: float) -> tuple[Array, Array]:
        """Return (5, nx, ny) float32 what a wall column that faces each sector, or none, gains there; the corner of the raster,
        m."""
        likelihood = np.log(MISSED + (1 - MISSED) * np.exp(-(DISTANCE_STEPS**2) / (2 * sigma**2))) - np.log(INDIFFERENT)
        level, origin, on_free, seen = self._rasters
        table = np.zeros(256, np.float32)
        table[: len(likelihood)] = EVIDENCE * likelihood
        return compute_wall_gain(level, table, on_free, seen), origin

    def find_sectors(self, faces: Array) -> Array:
        """Return (n,) sector of the faces (n, 2), `SECTORS` where there is none."""
        angle = np.arctan2(faces[:, 1], faces[:, 0]) - self.main
        sector = np.round(angle / (2 * np.pi / SECTORS)).astype(np.int64) % SECTORS
        return np.where(np.abs(faces).max(axis=1) > 0, sector, SECTORS)


def _build_rasters(fields: PlanFields, main: float) -> tuple[Array, Array, Array, Array]:
    """Build, with a rim of `DISTANCE_CAP`: (5, nx, ny) uint8 steps of distance to walls that may face each sector, and to any;
    the corner of the raster, m; (nx, ny) float32 what a wall on free floor loses; and (nx, ny) bool, whether it was seen."""
    rim = int(np.ceil(DISTANCE_CAP / fields.plan.edge))
    wall, face = np.pad(fields.plan.wall, rim), np.pad(fields.face, ((rim, rim), (rim, rim), (0, 0)))
    two_sided = np.abs(face).max(axis=2) == 0
    walls = []
    for k in range(SECTORS):
        angle = main + k * 2 * np.pi / SECTORS
        alike = face @ np.array([np.cos(angle), np.sin(angle)], np.float32) > FACES_ALIKE
        walls.append(wall & (alike | two_sided))
    distance = np.stack([compute_distance(w, fields.plan.edge) for w in (*walls, wall)])
    level = np.round(distance * ((len(DISTANCE_STEPS) - 1) / DISTANCE_CAP)).astype(np.uint8)
    lost = (EVIDENCE * ON_FREE_FLOOR * np.pad(fields.core, rim)).astype(np.float32)
    return level, fields.plan.origin - rim * fields.plan.edge, lost, np.pad(fields.kind != 0, rim)


def sample_walls(pieces: Pieces) -> tuple[Array, Array]:
    """Return rows of walls by which each piece is registered, with those near it, and where each piece's begin: (n + 1,)."""
    rng = np.random.default_rng(0)
    along = np.argsort(pieces.walls[:, 0], kind="stable")  # so that a piece is compared with the walls of its own strip only
    x = pieces.walls[along, 0]
    own = np.split(np.argsort(pieces.owner, kind="stable"), np.cumsum(np.bincount(pieces.owner, minlength=len(pieces)))[:-1])
    rows, start = [], [0]
    for k in range(len(pieces)):
        low, high = pieces.walls[own[k]].min(axis=0) - CONTEXT, pieces.walls[own[k]].max(axis=0) + CONTEXT
        strip = np.sort(along[np.searchsorted(x, low[0]) : np.searchsorted(x, high[0], side="right")])
        y = pieces.walls[strip, 1]
        near = strip[(y >= low[1]) & (y <= high[1]) & (pieces.storey[pieces.owner[strip]] == pieces.storey[k])]
        tall = near[pieces.tall[near]]  # furniture is moved, and no wall
        chosen = tall if len(tall) >= LEAST_TALL * len(near) else near
        if len(chosen) > PIECE_POINTS:
            chosen = np.sort(rng.permutation(chosen)[:PIECE_POINTS])
        rows.append(chosen)
        start.append(start[-1] + len(chosen))
    return np.concatenate(rows) if rows else np.zeros(0, np.int64), np.array(start)


def measure(
    pieces: Pieces, sampled: tuple[Array, Array], chosen: Array, moves: Array, into: Sim3, target: Target, window: Window
) -> tuple[Array, Array]:
    """Measure the moves (k, 3) of the chosen pieces onto a storey of the other map, shift and turn in the pieces' frame, and
    their information (k, 3, 3); no more than what the window allows.

    Args:
        chosen: (k,) pieces.
        moves: (n, 3) where they are tried from.
        into: the pieces' frame -> that of the target.
    """
    rows, start = sampled
    spans = [rows[start[k] : start[k + 1]] for k in chosen]
    every = np.concatenate(spans) if spans else np.zeros(0, np.int64)
    firsts = np.cumsum([0, *(len(s) for s in spans)])
    about = pieces.anchors[np.repeat(chosen, np.diff(firsts))]
    turn = np.array([[np.cos(into.yaw), -np.sin(into.yaw)], [np.sin(into.yaw), np.cos(into.yaw)]])
    points = into.scale * (pieces.walls[every] - about)
    sector = target.find_sectors(pieces.faces[every] @ turn.T)
    placed = pieces.anchors[chosen] + moves[chosen, :2]
    places = np.ascontiguousarray(into.apply(np.column_stack([placed, np.zeros(len(placed))]))[:, :2])
    shift = window.shift * into.scale
    step = max(shift / 8, SHIFT_STEP)
    shifts = np.arange(-np.round(shift / step), np.round(shift / step) + 1) * step
    yaws = np.linspace(-window.turn, window.turn, TURNS)
    gain, origin = target.compute_gain(window.sigma)
    turns, edge = into.yaw + moves[chosen, 2], target.fields.plan.edge

    def score(first: int, last: int) -> Array:
        of, ends = slice(first, last), firsts[first : last + 1]
        scores: Array = score_moves(points, sector, ends, places[of], turns[of], yaws, shifts, gain, origin, edge)
        return scores

    scores = np.concatenate(run_in_slices(score, len(chosen), 1))
    mean, information = _fit_gaussian(scores, shifts, yaws)
    back = np.eye(3)
    back[:2, :2] = turn.T / into.scale
    inverse = np.linalg.inv(back)
    return moves[chosen] + mean @ back.T, inverse.T @ information @ inverse


def _fit_gaussian(scores: Array, shifts: Array, yaws: Array) -> tuple[Array, Array]:
    """Return the means (k, 3) and information (k, 3, 3) of the moves that scores (k, Y, S, S) leave likely, beyond that of the
    window."""
    y, x, z = np.meshgrid(yaws, shifts, shifts, indexing="ij")
    moves = np.column_stack([x.ravel(), z.ravel(), y.ravel()])
    flat = scores.reshape(len(scores), -1)
    likely = np.exp(flat - flat.max(axis=1, keepdims=True))
    likely /= likely.sum(axis=1, keepdims=True)
    mean = likely @ moves
    squares = (moves[:, :, None] * moves[:, None, :]).reshape(-1, 9)
    spread = (likely @ squares).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    window = np.linalg.inv(1.2 * np.diag(moves.var(axis=0)))
    information = np.linalg.inv(spread + np.diag(np.array([MOVE_FLOOR[0], MOVE_FLOOR[0], MOVE_FLOOR[1]]) ** 2)) - window
    values, vectors = np.linalg.eigh(information)
    out: Array = (vectors * np.maximum(values, 0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return mean, out


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


def build_wall_lines(fields: PlanFields, middles: Array) -> WallLines:
    """Return the walls of a storey.

    Args:
        middles: (n, 3) m, middle of the points of each cell of the map.
    """
    plan = fields.plan
    row = np.full(plan.wall.shape, -1, np.int32)
    columns = np.ascontiguousarray(np.argwhere(plan.wall))
    row[plan.wall] = np.arange(len(columns))
    cells = np.floor((middles[:, :2] - plan.origin) / plan.edge + 1e-6).astype(np.int64)
    inside = are_within(cells, 0, row.shape)
    cells, middles = cells[inside], middles[inside]
    at = row[tuple(cells.T)]
    height = middles[:, 2] - plan.floor[tuple(cells.T)]
    chosen = (at >= 0) & (height > BODY[0]) & (height < BODY[1])
    many = np.bincount(at[chosen], minlength=len(columns))[:, None]
    total = np.column_stack([np.bincount(at[chosen], middles[chosen, k], len(columns)) for k in (0, 1)])
    points = np.where(many > 0, total / np.maximum(many, 1), fields.walls)
    normals, straight = estimate_line_normals(row, points, columns, LINE_REACH, LEAST_ON_LINE)
    side = (normals * fields.face[plan.wall]).sum(axis=1)
    return WallLines(
        row, points, np.where(side[:, None] < 0, -normals, normals), np.abs(side) > 0.3, (straight >= STRAIGHT) & fields.tall
    )


def measure_lines(
    pieces: Pieces, chosen: Array, lines: WallLines, moves: Array, into: Sim3, onto: tuple[PlanFields, WallLines], sigma: float
) -> tuple[Array, Array, Array, Array]:
    """Return the chosen pieces of a storey that have partners (k,), their moves (k, 3) in their own frame, the information (k, 3,
    3); and (2,) sums of weights and of weighted squared distances, m2.

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
    places = np.ascontiguousarray(into.apply(np.column_stack([placed, np.zeros(len(placed))]))[:, :2])
    straight = np.where(target.straight, np.arange(len(target.points)), -1).astype(np.int32)
    row = np.where(target.row >= 0, straight[target.row], -1)
    h, g, partners, sums = build_line_equations(
        points, lines.normals[rows], lines.faced[rows], start, places, into.yaw + moves[chosen, 2], row, target.points,
        target.normals, target.faced, fields.plan.origin, fields.plan.edge, PARTNER_REACH, sigma,
    )  # fmt: skip
    enough = partners >= LEAST_PARTNERS
    own = np.eye(3)  # the target's frame -> that of the pieces
    own[:2, :2] = into.inverse().matrix[:2, :2]
    inverse = np.linalg.inv(own)
    h, g = h[enough], g[enough]
    steps = -np.einsum("kij,kj->ki", np.linalg.pinv(h, rcond=1e-4, hermitian=True), g)
    certain = _bound_information(h / (INDEPENDENT * LINE_NOISE**2))
    return chosen[enough], moves[chosen[enough]] + steps @ own.T, inverse.T @ certain @ inverse, sums[enough].sum(axis=0)


def _bound_information(information: Array) -> Array:
    """Return the information (k, 3, 3) after the floor of what can be known is added to its covariance, in each of its own
    directions."""
    unit = np.diag([LINE_FLOOR[0], LINE_FLOOR[0], LINE_FLOOR[1]])
    back = np.linalg.inv(unit)
    values, vectors = np.linalg.eigh(unit @ information @ unit)
    values = np.maximum(values, 0)
    bounded = (vectors * (values / (1 + values))[:, None, :]) @ vectors.transpose(0, 2, 1)
    out: Array = back @ bounded @ back
    return out
