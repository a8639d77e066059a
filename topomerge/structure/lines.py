"""Straight lines along which points seen from above line up: a Hough transform, the strongest line first, each then fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

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
    """rad in [0, pi/2), along or across which most metres of lines run; None without any."""
    if not lines:
        return None
    turn = np.array([np.arctan2(line.along[1], line.along[0]) for line in lines]) % (np.pi / 2)
    length = np.array([line.length for line in lines])
    apart = (turn[:, None] - turn[None] + np.pi / 4) % (np.pi / 2) - np.pi / 4
    best = int(((np.abs(apart) < ALIGNED) * length[:, None]).sum(axis=0).argmax())
    near = np.abs(apart[:, best]) < ALIGNED
    return float((turn[best] + np.average(apart[near, best], weights=length[near] ** 3)) % (np.pi / 2))


def _find_strongest_run(points: Array, weights: Array, angles: Array) -> Array:
    """Rows of the points of the run that holds most: of a direction and an offset across it."""
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
    """The line through most of the points."""
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
    """A point and the direction of the line, points far off counting less (Cauchy); the direction may be given."""
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
