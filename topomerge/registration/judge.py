"""How well two whole maps agree under a pose: what the columns of one meet in the other, and what only the best pose is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.storey_plan import HEIGHT_BANDS
from topomerge.kernels import registration
from topomerge.kernels.bend import sum_shifted_values
from topomerge.matching.poses import FREE_MARGIN, PlanFields, pair_storeys
from topomerge.types import Array, Sim3, are_within

SAME_WALL = 0.15  # m: walls that near are one
JUDGED_COLUMNS = 40_000  # of a storey; of larger ones so many
INNER_REACH = 0.3  # m from walls, whose noise is no clutter
SLICE_BITS = HEIGHT_BANDS.build_mask(0.0, 0.75)  # where the lasers of robots look
CEILING_BLOCK = 12  # columns
LEAST_LIFTS = 50  # columns under both ceilings, by which a pose is raised
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


class Judge:
    """Counts what the columns of two maps meet in each other."""

    def __init__(self, a: Sequence[PlanFields], b: Sequence[PlanFields]) -> None:
        self.a, self.b = a, b
        self._sides: dict[tuple[int, int], tuple[Side, Side]] = {}
        self._rows: dict[int, Array] = {}
        self._steps: dict[int, int] = {}

    def __call__(self, pose: Sim3, step: int = 1) -> dict[str, float]:
        """Compute the features of a pose. Areas, and walls as areas of columns, in m2; shares of 1. `step`: only so many of the
        columns."""
        counts = self.tally(pose, step)
        gaps = [0.0]
        for v, w in pair_storeys(self.a, self.b, pose.translation[2], pose.scale):
            heights = list(zip(v.plan.levels, w.plan.levels, strict=True))
            if pose.scale != 1.0:  # a drawing of unknown scale was raised by a height of nobody's measuring
                heights.pop()
            seen = [h for h in heights if np.isfinite(h).all()]
            gaps += [abs(h - (pose.scale * k + pose.translation[2])) for h, k in seen]
        unlike, area = self._compare_ceilings(pose, step)
        sliced = any(v.plan.sliced for v in (*self.a, *self.b))
        return {**_features(counts, max(gaps)), "sliced": float(sliced), "ceilings": unlike, "ceiling_area": area}

    def tally(self, pose: Sim3, step: int = 1) -> Array:
        """Return (2, 11) of `kernels.registration.tally`, m2 in a's frame: of the columns of b, and of those of a; of every n-th
        one, times n."""
        out = np.zeros((2, 11))
        back = pose.inverse()
        for v, w in pair_storeys(self.a, self.b, pose.translation[2], pose.scale):
            if (id(v), id(w)) not in self._sides:
                self._sides[id(v), id(w)] = (Side(v, w), Side(w, v))
            p, q = self._sides[id(v), id(w)]
            out[0] += q.tally(p, pose, step) * pose.scale**2
            out[1] += p.tally(q, back, step)
        return out

    def _compare_ceilings(self, pose: Sim3, step: int = 1) -> tuple[float, float]:
        """Return how unlike the ceilings are where both maps saw free ground: mean deviation from their median difference, m, and
        the area, m2. Storeys of one plan often differ in nothing else."""
        deviations, area = [], 0.0
        for v, w in pair_storeys(self.a, self.b, pose.translation[2], pose.scale):
            if not (np.isfinite(v.plan.levels[1]) and np.isfinite(w.plan.levels[1])):
                continue
            gap, at = self._measure_ceiling_gap(v, w, pose, step)
            if len(gap):
                deviations.append(np.minimum(np.abs(_smooth_blocks(gap, at) - np.median(gap)), 0.4))
                area += len(gap) * w.plan.edge**2 * self._steps[id(w)] * step
        return (float(np.concatenate(deviations).mean()), area) if deviations else (0.0, 0.0)

    def lift_pose(self, pose: Sim3) -> Sim3:
        """Return the pose raised so that ceilings meet, where the floor of a map was not seen: rooms' ceilings differ in height,
        so that the storey's alone is no good measure."""
        gaps = []
        for v, w in pair_storeys(self.a, self.b, pose.translation[2], pose.scale):
            floors, ceilings = (np.isfinite([v.plan.levels[k], w.plan.levels[k]]).all() for k in (0, 1))
            if ceilings and not floors:
                gaps.append(self._measure_ceiling_gap(v, w, pose)[0] - pose.translation[2])
        lifts = np.concatenate(gaps) if gaps else np.zeros(0)
        if len(lifts) < LEAST_LIFTS:
            return pose
        x, y, z = pose.translation
        return replace(pose, translation=(x, y, z + float(np.clip(np.median(lifts), -1.2, 1.2))))

    def _measure_ceiling_gap(self, v: PlanFields, w: PlanFields, pose: Sim3, step: int = 1) -> tuple[Array, Array]:
        """Return (n,) m by which the ceilings of a lie above those of b before any shift, where both saw free ground; and the
        columns (n, 2) of a."""
        under = self._sample_ceilings(w)[::step]
        c, s = pose.scale * np.cos(pose.yaw), pose.scale * np.sin(pose.yaw)
        x, y = under[:, 0], under[:, 1]
        i = np.floor((c * x - s * y + pose.translation[0] - v.plan.origin[0]) / v.plan.edge).astype(np.int64)
        j = np.floor((s * x + c * y + pose.translation[1] - v.plan.origin[1]) / v.plan.edge).astype(np.int64)
        inside = (i >= 0) & (j >= 0) & (i < v.plan.wall.shape[0]) & (j < v.plan.wall.shape[1])
        i, j, under = i[inside], j[inside], under[inside]
        gap = v.plan.ceiling_height[i, j] - pose.scale * under[:, 2]
        if np.isfinite([v.plan.levels[0], w.plan.levels[0]]).all():  # drift and tilt raise both
            gap -= v.plan.floor_height[i, j] - pose.scale * under[:, 3]
        compared = np.isfinite(gap) & v.plan.free[i, j]
        return gap[compared], np.column_stack([i[compared], j[compared]])

    def _sample_ceilings(self, fields: PlanFields) -> Array:
        """Return (n, 4) place, ceiling and floor, m, of some of the free columns under a ceiling."""
        if id(fields) not in self._rows:
            p = fields.plan
            rows = np.argwhere(p.free & np.isfinite(p.ceiling))
            self._steps[id(fields)] = max(len(rows) // 3000, 1)
            rows = rows[:: self._steps[id(fields)]]
            at = (rows[:, 0], rows[:, 1])
            self._rows[id(fields)] = np.column_stack([p.origin + (rows + 0.5) * p.edge, p.ceiling_height[at], p.floor_height[at]])
        return self._rows[id(fields)]


def _smooth_blocks(values: Array, columns: Array) -> Array:
    """Return the median of the values in each block of `CEILING_BLOCK` columns a side: rooms differ in height, lamps do not
    count."""
    block = columns // CEILING_BLOCK
    _, owner = np.unique(block[:, 0] << 32 | block[:, 1], return_inverse=True)
    order = np.lexsort((values, owner))
    start = np.searchsorted(owner[order], np.arange(owner.max() + 1))
    middle = (start + np.append(start[1:], len(values))) // 2
    smooth: Array = values[order][middle][owner]
    return smooth


class Side:
    """The columns of a storey as far as another map looked at the same heights.

    Clutter counts only where it is solid, and free ground next to it only where it is clean: noise is no furniture.
    """

    def __init__(self, fields: PlanFields, other: PlanFields) -> None:
        self.fields = fields
        kind = fields.kind.copy()
        common = SLICE_BITS if other.plan.sliced else fields.plan.observed & other.plan.observed
        flat = fields.plan.sliced or other.plan.sliced  # slices tell nothing of heights
        self.bits = np.ones_like(fields.plan.profile) if flat else fields.plan.profile & np.uint32(common)
        if common and not fields.plan.sliced:
            kind[(kind == registration.CLUTTER_STATE) & ((fields.plan.profile & np.uint32(common)) == 0)] = (
                registration.FREE_STATE
            )
        clutter_around = ndimage.uniform_filter((kind == registration.CLUTTER_STATE).astype(np.float32), 3) * 9
        clutter = kind == registration.CLUTTER_STATE
        solid = clutter & (clutter_around > 4.5)
        kind[clutter & ~solid] = registration.HAZE_STATE
        self.kind = kind
        self.open = (solid | ((kind == registration.FREE_STATE) & (clutter_around < 1.5))) & (fields.to_wall >= INNER_REACH)
        rows = np.argwhere(kind > 0)
        self.weight = fields.plan.edge**2 * max(len(rows) / JUDGED_COLUMNS, 1.0)
        if len(rows) > JUDGED_COLUMNS:
            # A fixed seed: the same maps have the same verdict.
            rows = rows[np.sort(np.random.default_rng(0).permutation(len(rows))[:JUDGED_COLUMNS])]
        at = (rows[:, 0], rows[:, 1])
        self.points = fields.plan.origin + (rows + 0.5) * fields.plan.edge
        self.kinds, self.faces, self.inner, self.filled = kind[at], fields.face[at], self.open[at], self.bits[at]
        self._parts: dict[int, tuple[Array, ...]] = {}

    def _sample_columns(self, step: int) -> tuple[Array, ...]:
        """Return every n-th of the columns."""
        if step not in self._parts:
            columns = (self.points, self.kinds, self.faces, self.inner, self.filled)
            self._parts[step] = tuple(np.ascontiguousarray(x[::step]) for x in columns)
        return self._parts[step]

    def tally(self, on: Side, pose: Sim3, step: int) -> Array:
        """Return (11,) of `kernels.registration.tally`, m2."""
        at = np.array([*pose.translation[:2], pose.yaw, np.log(pose.scale)])
        v = on.fields
        seen = (on.kind, v.to_wall, v.to_any, v.face, on.open, on.bits, v.plan.origin, v.plan.edge)
        points, kinds, faces, inner, filled = self._sample_columns(step)
        counts: Array = registration.tally(points, kinds, faces, inner, filled, *seen, at, SAME_WALL, FREE_MARGIN)
        return counts * self.weight * step


def _features(t: Array, level: float) -> dict[str, float]:
    both = t.sum(axis=0)
    by_chance = both[9] / max(both[8], 1e-6)  # of a free column to meet clutter
    met = both[7] / max(both[6], 1e-6)
    return {
        "walls": both[1] / 2,
        "ratio": both[1] / max(both[0], 1e-6),
        "opposed": both[2] / max(both[1] + both[2], 1e-6),
        "conflict": both[3] / 2,
        "conflict_share": both[3] / max(both[1] + both[3], 1e-6),
        "worst_conflict": max(t[k, 3] / max(t[k, 1] + t[k, 3], 1e-6) for k in (0, 1)),
        "free": both[5] / 2,
        "clutter": both[6] / 2,
        "met": met,
        "chance": by_chance,
        "clutter_lift": met - by_chance,
        "share": max(t[k, 1] / max(t[k, 10], 1e-6) for k in (0, 1)),
        "level": level,
    }


def compute_winner_features(judge: Judge, pose: Sim3) -> dict[str, float]:
    """Return further features of a pose: m2, shares, and numbers of squares and of pieces of furniture."""
    walls = np.zeros((0, 6))
    conflict, back = np.zeros(2), pose.inverse()
    main = judge.a[0].main_direction
    moved = np.zeros(2)
    for v, w in pair_storeys(judge.a, judge.b, pose.translation[2], pose.scale):
        for source, target, move, side in ((w, v, pose, 0), (v, w, back, 1)):
            rows, stuck = _compare_walls(source, target, move)
            moved += _moved(rows, target, main if side == 0 else main - pose.yaw)
            rows[:, 5] *= (pose.scale if side == 0 else 1.0) ** 2
            if side == 1:  # all in the frame of a
                rows[:, :2] = source.walls
            else:
                rows[:, 4] += pose.yaw
            walls = np.concatenate([walls, rows])
            conflict[side] += stuck * (pose.scale if side == 0 else 1.0) ** 2
    shares = _compute_shares(walls, float(conflict.sum()), main)
    shares["moved_walls"] = float(moved[0] / max(moved[1], 1e-6))
    return {**shares, **_count_furniture(judge, pose), **_count_overhead(judge, pose)}


def _compare_walls(source: PlanFields, target: PlanFields, move: Sim3) -> tuple[Array, float]:
    """Return (n, 6) of each wall column: place in the other map, is it on known ground, does it agree, direction, m2; and the m2
    of high walls in runs that stand on free ground."""
    points = source.walls
    at = move.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    cells = np.floor((at - target.plan.origin) / target.plan.edge).astype(np.int64)
    inside = are_within(cells, 0, target.plan.wall.shape)
    i, j = np.where(inside[:, None], cells, 0).T
    near = inside & (target.to_wall[i, j] <= SAME_WALL)
    seen = inside & (near | (target.kind[i, j] != 0))
    clash = inside & (target.kind[i, j] == registration.FREE_STATE) & (target.to_any[i, j] >= FREE_MARGIN)
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
    """Return how much more of the walls would agree if each square were moved along one of the main directions by itself, m2, and
    how much there is of them: a longer end fits only after such a move, and furniture or noise hardly fit better."""
    rows = rows[rows[:, 2] > 0]
    places, weights = np.ascontiguousarray(rows[:, :2]), np.ascontiguousarray(rows[:, 5])
    steps = np.arange(*WINDOW_SHIFTS)
    steps = np.concatenate([[0.0], steps, -steps])
    axes = np.array([[np.cos(main), np.sin(main)], [-np.sin(main), np.cos(main)]])
    shifts = np.concatenate([steps[:, None] * axes[0], steps[1:, None] * axes[1]])
    fitting = np.exp(-((target.to_wall / WINDOW_SIGMA) ** 2) / 2)
    out = np.zeros(2)
    for offset in (0.0, 0.5):
        square = np.floor(places @ axes.T / WINDOW_SIDE + offset).astype(np.int64)
        _, owner = np.unique(square[:, 0] << 32 | (square[:, 1] & 0xFFFFFFFF), return_inverse=True)
        area = np.bincount(owner, weights, minlength=1)
        plan = target.plan
        fit = sum_shifted_values(places, weights, owner, len(area), shifts, fitting, plan.origin, plan.edge)
        compared = area >= WINDOW_WALLS
        gain = np.maximum(fit[1:].max(axis=0) - fit[0], 0.0)
        out += gain[compared].sum(), area[compared].sum()
    return out


def _compute_shares(walls: Array, conflict: float, main: float) -> dict[str, float]:
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


def _count_overhead(judge: Judge, pose: Sim3) -> dict[str, float]:
    """Count the pieces of what hangs from ceilings (lamps, beams, ducts) that hang in the other map, too, and of all that both
    maps would show: it stays when furniture moves, and no storey has that of another. Counted for the map that shows less: the
    other one may look higher."""
    pieces, back = np.zeros((2, 2)), pose.inverse()
    for v, w in pair_storeys(judge.a, judge.b, pose.translation[2], pose.scale):
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


def _count_furniture(judge: Judge, pose: Sim3) -> dict[str, float]:
    """Count how many pieces of furniture stand in place, of how many, and how many would by chance: where all is moved by
    `FURNITURE_SHIFT`.

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
