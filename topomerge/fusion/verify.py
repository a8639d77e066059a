"""How well two whole maps agree under a pose, and whether to believe it (findings: free space and the amount of evidence decide)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources

import numpy as np
from scipy import ndimage

from topomerge.fusion.evidence import BODY
from topomerge.fusion.search import MARGIN, Candidate, View, pairs_at
from topomerge.kernels import align
from topomerge.types import Array, Sim3

NEAR = 0.15  # m: walls that near are one
SAMPLE = 40_000  # columns of a storey that are judged; of larger ones so many
INNER = 0.4  # m from walls, whose noise is no clutter
BODY_BITS = (1 << BODY[1]) - (1 << BODY[0])
SLICE_BITS = 0b111 << 2  # 0 to 0.75 m above the floor: where the lasers of robots look
SHORTLIST = 0.6  # of the best agreement
Features = Mapping[str, float]


class Judge:
    """Counts what the columns of two maps meet in each other."""

    def __init__(self, a: Sequence[View], b: Sequence[View]) -> None:
        self.a, self.b = a, b
        self._sides: dict[tuple[int, int], tuple[Side, Side]] = {}

    def __call__(self, pose: Sim3) -> dict[str, float]:
        """Features of a pose. Areas, and walls as areas of columns, in m2; shares of 1."""
        out = np.zeros((2, 11))
        back = pose.inverse()
        gaps = [0.0]
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            if (id(v), id(w)) not in self._sides:
                self._sides[id(v), id(w)] = (Side(v, w), Side(w, v))
            p, q = self._sides[id(v), id(w)]
            out[0] += q.tally(p, pose)
            out[1] += p.tally(q, back) * pose.scale**2
            seen = [h for h in ((v.plan.floor, w.plan.floor), (v.plan.ceiling, w.plan.ceiling)) if np.isfinite(h).all()]
            gaps += [abs(h - (pose.scale * k + pose.translation[2])) for h, k in seen]
        return _features(out, max(gaps))

    def ceilings(self, pose: Sim3) -> tuple[float, float]:
        """How unlike the ceilings are where both maps saw free ground: mean deviation from their median difference, m, and the
        area, m2. Storeys of one plan often differ in nothing else."""
        found = []
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            if not (np.isfinite(v.plan.ceiling) and np.isfinite(w.plan.ceiling)):
                continue
            rows = np.argwhere(w.plan.free & np.isfinite(w.plan.height))[:: max(len(w.walls) // 5000, 1)]
            at = np.column_stack([w.plan.origin + (rows + 0.5) * w.plan.cell, np.zeros(len(rows))])
            there = np.floor((pose.apply(at)[:, :2] - v.plan.origin) / v.plan.cell).astype(np.int64)
            inside = ((there >= 0) & (there < v.plan.wall.shape)).all(axis=1)
            i, j = there[inside].T
            gap = v.plan.height[i, j] - pose.scale * w.plan.height[tuple(rows[inside].T)]
            gap = gap[np.isfinite(gap) & v.plan.free[i, j]]
            if len(gap):
                found.append(np.minimum(np.abs(gap - np.median(gap)), 0.4))
        every = np.concatenate(found) if found else np.zeros(0)
        return (float(every.mean()), len(every) * self.b[0].plan.cell ** 2) if len(every) else (0.0, 0.0)


class Side:
    """The columns of a view as far as another map looked at the same heights.

    Clutter counts only where it is solid, and free ground next to it only where it is clean: noise is no furniture.
    """

    def __init__(self, view: View, other: View) -> None:
        self.view = view
        kind = view.kind.copy()
        common = SLICE_BITS if other.plan.sliced else view.plan.bands & other.plan.bands & BODY_BITS
        if common and not view.plan.sliced:
            kind[(kind == align.CLUTTER) & ((view.plan.bits & np.uint32(common)) == 0)] = align.FREE
        many = ndimage.uniform_filter((kind == align.CLUTTER).astype(np.float32), 3) * 9
        clutter = kind == align.CLUTTER
        solid = clutter & (many > 4.5)
        kind[clutter & ~solid] = align.HAZE
        self.kind = kind
        self.open = (solid | ((kind == align.FREE) & (many < 1.5))) & (view.to_wall >= INNER)
        rows = np.argwhere(kind > 0)
        self.weight = view.plan.cell**2 * max(len(rows) / SAMPLE, 1.0)
        if len(rows) > SAMPLE:
            rows = rows[np.sort(np.random.default_rng(0).permutation(len(rows))[:SAMPLE])]
        at = (rows[:, 0], rows[:, 1])
        self.points = view.plan.origin + (rows + 0.5) * view.plan.cell
        self.kinds, self.faces, self.inner = kind[at], view.face[at], self.open[at]

    def tally(self, on: Side, pose: Sim3) -> Array:
        """(11,) of `align.tally`, m2."""
        at = np.array([*pose.translation[:2], pose.yaw, np.log(pose.scale)])
        v = on.view
        seen = (on.kind, v.to_wall, v.to_any, v.face, on.open, v.plan.origin, v.plan.cell)
        found: Array = align.tally(self.points, self.kinds, self.faces, self.inner, *seen, at, NEAR, MARGIN)
        return found * self.weight


def _features(t: Array, level: float) -> dict[str, float]:
    both = t.sum(axis=0)
    chance = both[9] / max(both[8], 1e-6)  # of a free column to meet clutter
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
        "chance": chance,
        "clutter_lift": met - chance,
        "share": max(t[k, 1] / max(t[k, 10], 1e-6) for k in (0, 1)),
        "level": level,
    }


def rank(candidates: Sequence[Candidate], judge: Judge) -> list[tuple[Candidate, dict[str, float]]]:
    """Two stages: what reaches `SHORTLIST` of the best agreement, least conflict first; then the rest by agreement.

    A hard weight on conflict breaks when furniture moved or walls are glass; this rule does not (findings).
    """
    judged = [(c, judge(c.pose)) for c in candidates]
    best = max((f["walls"] for _, f in judged), default=0.0)
    listed = [p for p in judged if p[1]["walls"] >= SHORTLIST * best]
    rest = [p for p in judged if p[1]["walls"] < SHORTLIST * best]
    listed.sort(key=lambda p: p[1]["conflict_share"])
    rest.sort(key=lambda p: -p[1]["walls"])
    return listed + rest
