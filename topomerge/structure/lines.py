"""Lines and directions along which points seen from above line up.

Lines: a Hough transform, the strongest line first, each then fitted. Directions: a profile over half a turn, and the sharpest
directions in it; lines that are fitted tell theirs more exactly (`estimate_main_direction`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from topomerge.kernels.rasters import find_strongest_line, weigh_by_distance
from topomerge.types import Array

HOUGH_TURN = np.radians(3.0)
HOUGH_BIN = 0.04  # m
LINE_REACH = 0.07  # m: points this near to a line of the transform are its own
LEAST_LINE = 0.35  # m of wall on a line
LINE_GAP = 1.5  # m: a longer gap parts two lines
DENSE = 0.35  # share of a line's length that is wall: things that line up by chance are fewer
FIT_SCALE = 0.015  # m: points this far off count half
FIT_SCALES = np.array([0.05, 0.03, *[FIT_SCALE] * 5])  # m, of the rounds before the last
MOST_LINES = 80  # of a room
ALIGNED, SHORT_ALIGNED = np.radians(1.5), np.radians(7.0)  # lines this near to a main direction have it
SHORT_LINE = 1.5  # m
OFF_LINE = 0.04  # m, by which a line may leave its points at its ends when it is turned into a main direction


@dataclass(frozen=True)
class Line:
    """A straight line of points: through `middle` (2,) m, along `along` (2,) unit, from `start` to `end` m from the middle.

    `weight` is how many metres of wall were seen on it; of a line that is only concluded, 0.
    """

    middle: Array
    along: Array
    start: float
    end: float
    weight: float = 0.0

    @property
    def length(self) -> float:
        """m."""
        return self.end - self.start

    @property
    def across(self) -> Array:
        """(2,) unit, to its left."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def ends(self) -> Array:
        """(2, 2) m."""
        return self.middle + np.outer([self.start, self.end], self.along)


def detect_lines(points: Array, weights: Array, main: float | None = None) -> list[Line]:
    """Return lines among points, the longest support first.

    Args:
        points: (n, 2) m.
        weights: (n,) m of wall that each point stands for.
        main: rad, a direction that lines nearly along or across it are turned into; None: no such.
    """
    lines: list[Line] = []
    angles = np.arange(round(np.pi / HOUGH_TURN)) * HOUGH_TURN + (main or 0.0)
    left = np.arange(len(points))
    while len(left) > 2 and len(lines) < MOST_LINES:
        rows = _find_strongest_run(points[left], weights[left], angles)
        if weights[left[rows]].sum() < LEAST_LINE:
            break
        line = _fit_line(points[left[rows]], weights[left[rows]], main)
        own = _find_near_points(points[left], line)
        weight = float(weights[left[own]].sum())
        if weight >= max(DENSE * line.length, LEAST_LINE / 2):
            lines.append(replace(line, weight=weight))
        kept = np.ones(len(left), bool)
        kept[own] = kept[rows] = False
        left = left[kept]
    return lines


def estimate_main_direction(lines: list[Line]) -> float | None:
    """Estimate the direction, rad in [0, pi/2), along or across which most metres of lines run; None without any."""
    if not lines:
        return None
    turn = np.array([np.arctan2(line.along[1], line.along[0]) for line in lines]) % (np.pi / 2)
    length = np.array([line.length for line in lines])
    apart = (turn[:, None] - turn[None] + np.pi / 4) % (np.pi / 2) - np.pi / 4
    best = int(((np.abs(apart) < ALIGNED) * length[:, None]).sum(axis=0).argmax())
    near = np.abs(apart[:, best]) < ALIGNED
    return float((turn[best] + np.average(apart[near, best], weights=length[near] ** 3)) % (np.pi / 2))


def _find_strongest_run(points: Array, weights: Array, angles: Array) -> Array:
    """Return the rows of the points of the run that holds most: of a direction and an offset across it."""
    middle = points.mean(axis=0)
    local = points - middle
    angle, offset = find_strongest_line(local, weights, angles, HOUGH_BIN)
    across = local @ (-np.sin(angle), np.cos(angle))
    rows = np.flatnonzero(np.abs(across - offset) <= LINE_REACH)
    t = local[rows] @ (np.cos(angle), np.sin(angle))
    order = np.argsort(t, kind="stable")
    gaps = np.flatnonzero(np.diff(t[order]) > LINE_GAP)
    runs = np.split(rows[order], gaps + 1) if len(gaps) else [rows[order]]
    return max(runs, key=lambda run: float(weights[run].sum()))


def _fit_line(points: Array, weights: Array, main: float | None) -> Line:
    """Return the line through most of the points."""
    middle, along = _fit_least_squares(points, weights)
    t = (points - middle) @ along
    length = float(np.ptp(t))
    if main is not None:
        turn = np.arctan2(along[1], along[0])
        off = (turn - main + np.pi / 4) % (np.pi / 2) - np.pi / 4
        straight = abs(off) < ALIGNED and abs(off) * length / 2 < OFF_LINE
        if straight or (length < SHORT_LINE and abs(off) < SHORT_ALIGNED):
            along = np.array([np.cos(turn - off), np.sin(turn - off)])
            middle, _ = _fit_least_squares(points, weights, along)
            t = (points - middle) @ along
    near = np.abs((points - middle) @ (-along[1], along[0])) < 3 * FIT_SCALE
    t = t[near] if near.any() else t
    return Line(middle, along, float(t.min()), float(t.max()))


def _fit_least_squares(points: Array, weights: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Return a point and the direction of the line, points far off counting less (Cauchy); the direction may be given."""
    given = np.zeros(2) if along is None else along
    weight = weigh_by_distance(points, weights, given, FIT_SCALES)
    middle = weight @ points / weight.sum()
    if along is None:
        along = np.linalg.svd((points - middle) * np.sqrt(weight)[:, None], full_matrices=False)[2][0]
    return middle, along


def _find_near_points(points: Array, line: Line) -> Array:
    local = points - line.middle
    t, off = local @ line.along, local @ line.across
    return np.flatnonzero((np.abs(off) < LINE_REACH) & (t > line.start - LINE_REACH) & (t < line.end + LINE_REACH))


DIRECTION_STEP = 0.5  # degrees, of the direction profile
TURN_STEPS = (np.radians(1.0), np.radians(0.1))  # in which the direction of walls is sought
MOST_DIRECTIONS, DIRECTIONS_APART = 3, np.radians(10.0)  # of walls that are told apart
OTHER_DIRECTION = 0.15  # of the sharpness of the first direction, beyond what any has, that another one must have
MOST_WALLS = 6000  # columns whose direction is taken
DIRECTION_BIN = 0.1  # m, into which walls are projected


def compute_direction_profile(walls: Array, edge: float, most: int = 6000) -> Array:
    """Return (360,) float64: for each direction in steps of 0.5 degrees, how much the walls' projection across it is heaped
    up."""
    if not len(walls):
        return np.zeros(int(180 / DIRECTION_STEP))
    rng = np.random.default_rng(0)
    points = walls if len(walls) <= most else walls[rng.permutation(len(walls))[:most]]
    points = points - points.mean(axis=0) + rng.uniform(-edge / 2, edge / 2, points.shape)  # else the raster lines up at 0 and 90
    angles = np.radians(np.arange(0, 180, DIRECTION_STEP))
    across = points @ np.stack([-np.sin(angles), np.cos(angles)])
    rows = np.floor(across / 0.2).astype(np.int64)
    rows -= rows.min()
    width = int(rows.max()) + 1
    flat = (rows + np.arange(len(angles)) * width).ravel()
    heaps = np.bincount(flat, minlength=len(angles) * width).reshape(len(angles), width).astype(float)
    sharp: Array = (heaps**2).sum(axis=1) / len(points)
    return np.clip(sharp - np.median(sharp), 0, None)


def estimate_wall_directions(walls: Array) -> tuple[float, ...]:
    """Return directions in [0, pi/2), rad, along which walls (n, 2), m, line up, the sharpest first: there they fall into
    the fewest, fullest bins of both axes; 0 without any walls."""
    if not len(walls):
        return (0.0,)
    walls = walls[np.linspace(0, len(walls) - 1, min(len(walls), MOST_WALLS)).astype(int)]
    walls = walls - walls.mean(axis=0)
    turns = np.arange(-45, 45) * TURN_STEPS[0]
    sharpness = np.array([_measure_sharpness(walls, float(turn)) for turn in turns])
    excess = sharpness - np.median(sharpness)
    around = ndimage.maximum_filter1d(sharpness, 2 * round(DIRECTIONS_APART / TURN_STEPS[0]) - 1, mode="wrap")
    peaks = np.flatnonzero((sharpness == around) & (excess >= OTHER_DIRECTION * excess.max()))
    best = peaks[np.argsort(-sharpness[peaks], kind="stable")[:MOST_DIRECTIONS]]
    return tuple(_refine_direction(walls, float(turns[k])) % (np.pi / 2) for k in best)


def _refine_direction(walls: Array, turn: float) -> float:
    around = round(TURN_STEPS[0] / TURN_STEPS[1])
    turns = turn + np.arange(-around, around) * TURN_STEPS[1]
    return float(turns[int(np.argmax([_measure_sharpness(walls, float(near)) for near in turns]))])


def _measure_sharpness(walls: Array, turn: float) -> float:
    """Return the sum of squares of how many walls fall into each bin of both axes; bins are blurred, so that none is cut in
    two."""
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    total = 0.0
    for values in (walls @ rotation).T:
        counts = np.bincount(np.floor((values - values.min()) / DIRECTION_BIN).astype(np.int64)).astype(float)
        total += float((counts**2).sum() + (counts[1:] * counts[:-1]).sum())
    return total
