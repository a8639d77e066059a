"""What is asked of the best hypothesis only: do walls agree everywhere and in both directions, and does furniture stand in place?

A wing with nearly the same plan, or the storey above, agrees with a map in most of its walls. What tells it apart is local: ends
that are longer, walls as high as the room in the midst of free ground, furniture that never stands where it should.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.fusion.judge import SAME_WALL, Judge
from topomerge.kernels import align
from topomerge.kernels.bend import shifted_sums
from topomerge.matching.plan_fields import FREE_MARGIN, PlanFields
from topomerge.matching.refinement import storeys_at
from topomerge.types import Array, Sim3

WALL_RUN = 0.8  # m, length from which walls on free ground are no noise
SQUARE_SIDE = 3.0  # m, side of the squares in which walls are compared
SQUARE_WALLS = 0.3  # m2 of walls in a square, below which it tells nothing
AGREES, DISAGREES = 0.7, 0.4  # share of a square's walls that agree
FURNITURE_SHIFT = 0.8  # m, by which furniture is moved to see what meets by chance
WINDOW_SIDE = 6.0  # m, side of the squares that are moved by themselves
WINDOW_SHIFTS = (0.4, 3.0, 0.1)  # m: least, most, step; less may be drift
WINDOW_WALLS = 0.6  # m2 of walls in such a square
WINDOW_SIGMA = 0.15  # m
FURNITURE_PIECE = 0.4  # m2 of a piece of furniture
HANGING_PIECE = 0.3  # m2 of a lamp or a piece of a beam


def winner_features(judge: Judge, pose: Sim3) -> dict[str, float]:
    """Further features of a pose: m2, shares, and numbers of squares and of pieces of furniture."""
    walls = np.zeros((0, 6))
    conflict, back = np.zeros(2), pose.inverse()
    main = np.radians(float(judge.a[0].profile.argmax()) / 2)
    moved = np.zeros(2)
    for v, w in storeys_at(judge.a, judge.b, pose.translation[2], pose.scale):
        for source, target, move, side in ((w, v, pose, 0), (v, w, back, 1)):
            rows, stuck = _walls(source, target, move)
            moved += _moved(rows, target, main if side == 0 else main - pose.yaw)
            rows[:, 5] *= (pose.scale if side == 0 else 1.0) ** 2
            if side == 1:  # all in the frame of a
                rows[:, :2] = source.walls
            else:
                rows[:, 4] += pose.yaw
            walls = np.concatenate([walls, rows])
            conflict[side] += stuck * (pose.scale if side == 0 else 1.0) ** 2
    shares = _shares(walls, float(conflict.sum()), main)
    shares["moved_walls"] = float(moved[0] / max(moved[1], 1e-6))
    return {**shares, **_furniture(judge, pose), **_overhead(judge, pose)}


def _walls(source: PlanFields, target: PlanFields, move: Sim3) -> tuple[Array, float]:
    """(n, 6) of each wall column: place in the other map, is it on known ground, does it agree, direction, m2; and the m2 of high
    walls in runs that stand on free ground."""
    points = source.walls
    at = move.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    cells = np.floor((at - target.plan.origin) / target.plan.edge).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < target.plan.wall.shape)).all(axis=1))
    i, j = np.where(inside[:, None], cells, 0).T
    near = inside & (target.to_wall[i, j] <= SAME_WALL)
    seen = inside & (near | (target.kind[i, j] != 0))
    clash = inside & (target.kind[i, j] == align.FREE_STATE) & (target.to_any[i, j] >= FREE_MARGIN)
    area = source.plan.edge**2
    rows = np.column_stack([at, seen, near, source.directions, np.full(len(at), area)])
    mask = np.zeros(source.plan.wall.shape, bool)
    mask[source.plan.wall] = clash & source.tall
    label, _ = ndimage.label(mask, np.ones((3, 3), int))
    long = 0.0
    for number, box in enumerate(ndimage.find_objects(label), 1):
        if max(s.stop - s.start for s in box) * source.plan.edge >= WALL_RUN:
            long += float((label[box] == number).sum())
    return rows, long * area


def _moved(rows: Array, target: PlanFields, main: float) -> Array:
    """How much more of the walls would agree if each square were moved along one of the main directions by itself, m2, and how
    much there is of them: a longer end fits only after such a move, and furniture or noise hardly fit better."""
    rows = rows[rows[:, 2] > 0]
    steps = np.arange(*WINDOW_SHIFTS)
    steps = np.concatenate([[0.0], steps, -steps])
    axes = np.array([[np.cos(main), np.sin(main)], [-np.sin(main), np.cos(main)]])
    shifts = np.concatenate([steps[:, None] * axes[0], steps[1:, None] * axes[1]])
    fitting = np.exp(-((target.to_wall / WINDOW_SIGMA) ** 2) / 2)
    out = np.zeros(2)
    for offset in (0.0, 0.5):
        square = np.floor(rows[:, :2] @ axes.T / WINDOW_SIDE + offset).astype(np.int64)
        _, owner = np.unique(square[:, 0] << 32 | (square[:, 1] & 0xFFFFFFFF), return_inverse=True)
        area = np.bincount(owner, weights=rows[:, 5], minlength=1)
        plan = target.plan
        fit = shifted_sums(rows[:, :2], rows[:, 5], owner, len(area), shifts, fitting, plan.origin, plan.edge)
        compared = area >= WINDOW_WALLS
        gain = np.maximum(fit[1:].max(axis=0) - fit[0], 0.0)
        out += gain[compared].sum(), area[compared].sum()
    return out


def _shares(walls: Array, conflict: float, main: float) -> dict[str, float]:
    seen, near = (walls[:, k] * walls[:, 5] for k in (2, 3))
    across = np.abs(np.sin(walls[:, 4] - main)) > np.sqrt(0.5)
    agree = [float(near[side].sum()) / 2 for side in (across, ~across)]
    ratio = [float((near[side].sum() + 0.5) / (seen[side].sum() + 1.0)) for side in (across, ~across)]
    block = np.floor(walls[:, :2] / SQUARE_SIDE).astype(np.int64)
    _, owner = np.unique(block[:, 0] << 32 | (block[:, 1] & 0xFFFFFFFF), return_inverse=True)
    both = [np.bincount(owner, weights=x, minlength=1) for x in (seen, near)]
    compared = both[0] >= SQUARE_WALLS
    share = both[1][compared] / both[0][compared]
    return {
        "tall_conflict": conflict / 2,
        "crossing": min(agree),
        "worst_ratio": min(ratio),
        "squares": float((share >= AGREES).sum()),
        "bad_squares": float((share < DISAGREES).sum() / max(compared.sum(), 1)),
    }


def _overhead(judge: Judge, pose: Sim3) -> dict[str, float]:
    """Pieces of what hangs from ceilings (lamps, beams, ducts) that hang in the other map, too, and of all that both maps would
    show: it stays when furniture moves, and no storey has that of another. Counted for the map that shows less: the other one may
    look higher."""
    pieces, back = np.zeros((2, 2)), pose.inverse()
    for v, w in storeys_at(judge.a, judge.b, pose.translation[2], pose.scale):
        for side, (source, target, move) in enumerate(((w, v, pose), (v, w, back))):
            rows = np.argwhere(source.hung == 2)
            if not len(rows):
                continue
            at = np.column_stack([source.plan.origin + (rows + 0.5) * source.plan.edge, np.zeros(len(rows))])
            cells = np.floor((move.apply(at)[:, :2] - target.plan.origin) / target.plan.edge).astype(np.int64)
            cells = cells[((cells >= 1) & (cells < np.array(target.hung.shape) - 1)).all(axis=1)]
            around = np.stack([target.hung[cells[:, 0] + i, cells[:, 1] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
            seen = (around > 0).sum(axis=0) > 4
            met = (around[:, seen] == 2).any(axis=0)
            pieces[side] += np.array([met.sum(), seen.sum()]) * source.plan.edge**2 / HANGING_PIECE
    met, total = pieces[pieces[:, 1].argmin()].tolist()
    return {"hanging": total, "hanging_met": met}


def _furniture(judge: Judge, pose: Sim3) -> dict[str, float]:
    """How many pieces of furniture stand in place, of how many, and how many would by chance: where all is moved
    by `FURNITURE_SHIFT`.

    Counted for the map that shows less of it: a tablet that looks up sees no desks, and missing desks are no evidence then.
    """
    pieces = np.zeros((9, 2, 2))
    steps = [(0.0, 0.0)] + [(FURNITURE_SHIFT * np.cos(t), FURNITURE_SHIFT * np.sin(t)) for t in np.arange(8) * np.pi / 4]
    x, y, z = pose.translation
    for k, (dx, dy) in enumerate(steps):
        pieces[k] = judge.tally(Sim3(pose.yaw, (x + dx, y + dy, z), pose.scale))[:, 6:8] / FURNITURE_PIECE
    pieces = pieces[:, pieces[0, :, 0].argmin()]
    share = pieces[1:, 1].sum() / max(pieces[1:, 0].sum(), 1e-6)
    return {"pieces": float(pieces[0, 0]), "in_place": float(pieces[0, 1]), "by_chance": float(share * pieces[0, 0])}
