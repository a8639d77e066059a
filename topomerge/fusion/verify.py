"""How well two whole maps agree under a pose, and whether to believe it: free space and the amount of evidence decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.fusion.search import MARGIN, Candidate, View, distinct, pairs_at
from topomerge.fusion.storey_plan import BODY
from topomerge.io.weight_files import read_weights_json
from topomerge.kernels import align
from topomerge.types import Array, Sim3

NEAR = 0.15  # m: walls that near are one
SAMPLE = 40_000  # columns of a storey that are judged; of larger ones so many
FULLY, GLANCE = 30, 7  # candidates that are judged by all columns; the others by every seventh
USUAL, FEW = 0.15, 1.0  # share of walls on free ground, and m2 of walls that weigh as much as that prior
INNER = 0.3  # m from walls, whose noise is no clutter
BODY_BITS = (1 << BODY[1]) - (1 << BODY[0])
SLICE_BITS = 0b111 << 2  # 0 to 0.75 m above the floor: where the lasers of robots look
BLOCK = 12  # columns
MARGIN_CAP = 6.0
BASIN = (1.2, np.radians(3.0), 0.05)  # m, rad, log scale: a worse pose nearer than that is no rival
ENOUGH = 200.0  # m2 of free floor that both maps saw
RIVAL = 0.3  # of the walls that the best hypothesis brings together
Features = Mapping[str, float]
Ranked = tuple[Candidate, dict[str, float], float]  # a hypothesis, its features, log odds that it is right, seen by itself


class Judge:
    """Counts what the columns of two maps meet in each other."""

    def __init__(self, a: Sequence[View], b: Sequence[View]) -> None:
        self.a, self.b = a, b
        self._sides: dict[tuple[int, int], tuple[Side, Side]] = {}
        self._rows: dict[int, Array] = {}
        self._steps: dict[int, int] = {}

    def __call__(self, pose: Sim3, every: int = 1) -> dict[str, float]:
        """Features of a pose. Areas, and walls as areas of columns, in m2; shares of 1. `every`: only so many of the columns."""
        out = self.tally(pose, every)
        gaps = [0.0]
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            heights = [(v.plan.floor, w.plan.floor), (v.plan.ceiling, w.plan.ceiling)]
            if pose.scale != 1.0:  # a drawing of unknown scale was raised by a height of nobody's measuring
                heights.pop()
            seen = [h for h in heights if np.isfinite(h).all()]
            gaps += [abs(h - (pose.scale * k + pose.translation[2])) for h, k in seen]
        unlike, area = self._ceilings(pose, every)
        sliced = any(v.plan.sliced for v in (*self.a, *self.b))
        known = {"sliced": float(sliced), "ceilings": unlike, "ceiling_area": area}
        return {**_features(out, max(gaps)), **known}

    def tally(self, pose: Sim3, every: int = 1) -> Array:
        """(2, 11) of `align.tally`, m2 in a's frame: of the columns of b, and of those of a; of every n-th one, times n."""
        out = np.zeros((2, 11))
        back = pose.inverse()
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            if (id(v), id(w)) not in self._sides:
                self._sides[id(v), id(w)] = (Side(v, w), Side(w, v))
            p, q = self._sides[id(v), id(w)]
            out[0] += q.tally(p, pose, every) * pose.scale**2
            out[1] += p.tally(q, back, every)
        return out

    def _ceilings(self, pose: Sim3, every: int = 1) -> tuple[float, float]:
        """How unlike the ceilings are where both maps saw free ground: mean deviation from their median difference, m, and the
        area, m2. Storeys of one plan often differ in nothing else."""
        found, area = [], 0.0
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            if not (np.isfinite(v.plan.ceiling) and np.isfinite(w.plan.ceiling)):
                continue
            gap, at = self._gap(v, w, pose, every)
            if len(gap):
                found.append(np.minimum(np.abs(_smooth(gap, at) - np.median(gap)), 0.4))
                area += len(gap) * w.plan.cell**2 * self._steps[id(w)] * every
        return (float(np.concatenate(found).mean()), area) if found else (0.0, 0.0)

    def lifted(self, pose: Sim3) -> Sim3:
        """The pose raised so that ceilings meet, where the floor of a map was not seen: rooms' ceilings differ in height, so that
        the storey's alone is no good measure."""
        gaps = []
        for v, w in pairs_at(self.a, self.b, pose.translation[2], pose.scale):
            if np.isfinite([v.plan.ceiling, w.plan.ceiling]).all() and not np.isfinite([v.plan.floor, w.plan.floor]).all():
                gaps.append(self._gap(v, w, pose)[0] - pose.translation[2])
        every = np.concatenate(gaps) if gaps else np.zeros(0)
        if len(every) < 50:
            return pose
        x, y, z = pose.translation
        return replace(pose, translation=(x, y, z + float(np.clip(np.median(every), -1.2, 1.2))))

    def _gap(self, v: View, w: View, pose: Sim3, every: int = 1) -> tuple[Array, Array]:
        """(n,) m by which the ceilings of a lie above those of b before any shift, where both saw free ground; and the columns
        (n, 2) of a."""
        under = self._under(w)[::every]
        c, s = pose.scale * np.cos(pose.yaw), pose.scale * np.sin(pose.yaw)
        x, y = under[:, 0], under[:, 1]
        i = np.floor((c * x - s * y + pose.translation[0] - v.plan.origin[0]) / v.plan.cell).astype(np.int64)
        j = np.floor((s * x + c * y + pose.translation[1] - v.plan.origin[1]) / v.plan.cell).astype(np.int64)
        inside = (i >= 0) & (j >= 0) & (i < v.plan.wall.shape[0]) & (j < v.plan.wall.shape[1])
        i, j, under = i[inside], j[inside], under[inside]
        gap = v.plan.high[i, j] - pose.scale * under[:, 2]
        if np.isfinite([v.plan.floor, w.plan.floor]).all():  # drift and tilt raise both
            gap -= v.plan.low[i, j] - pose.scale * under[:, 3]
        kept = np.isfinite(gap) & v.plan.free[i, j]
        return gap[kept], np.column_stack([i[kept], j[kept]])

    def _under(self, view: View) -> Array:
        """(n, 4) place, ceiling and floor, m, of some of the free columns under a ceiling."""
        if id(view) not in self._rows:
            p = view.plan
            rows = np.argwhere(p.free & np.isfinite(p.high))
            self._steps[id(view)] = max(len(rows) // 3000, 1)
            rows = rows[:: self._steps[id(view)]]
            at = (rows[:, 0], rows[:, 1])
            self._rows[id(view)] = np.column_stack([p.origin + (rows + 0.5) * p.cell, p.high[at], p.low[at]])
        return self._rows[id(view)]


def _smooth(values: Array, columns: Array) -> Array:
    """The median of the values in each block of `BLOCK` columns a side: rooms differ in height, lamps and noise do not count."""
    block = columns // BLOCK
    _, owner = np.unique(block[:, 0] << 32 | block[:, 1], return_inverse=True)
    order = np.lexsort((values, owner))
    start = np.searchsorted(owner[order], np.arange(owner.max() + 1))
    middle = (start + np.append(start[1:], len(values))) // 2
    smooth: Array = values[order][middle][owner]
    return smooth


class Side:
    """The columns of a view as far as another map looked at the same heights.

    Clutter counts only where it is solid, and free ground next to it only where it is clean: noise is no furniture.
    """

    def __init__(self, view: View, other: View) -> None:
        self.view = view
        kind = view.kind.copy()
        common = SLICE_BITS if other.plan.sliced else view.plan.bands & other.plan.bands & BODY_BITS
        flat = view.plan.sliced or other.plan.sliced  # slices tell nothing of heights
        self.bits = np.ones_like(view.plan.bits) if flat else view.plan.bits & np.uint32(common)
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
        self.kinds, self.faces, self.inner, self.filled = kind[at], view.face[at], self.open[at], self.bits[at]
        self._parts: dict[int, tuple[Array, ...]] = {}

    def _some(self, every: int) -> tuple[Array, ...]:
        """Every n-th of the columns."""
        if every not in self._parts:
            whole = (self.points, self.kinds, self.faces, self.inner, self.filled)
            self._parts[every] = tuple(np.ascontiguousarray(x[::every]) for x in whole)
        return self._parts[every]

    def tally(self, on: Side, pose: Sim3, every: int) -> Array:
        """(11,) of `align.tally`, m2."""
        at = np.array([*pose.translation[:2], pose.yaw, np.log(pose.scale)])
        v = on.view
        seen = (on.kind, v.to_wall, v.to_any, v.face, on.open, on.bits, v.plan.origin, v.plan.cell)
        points, kinds, faces, inner, filled = self._some(every)
        found: Array = align.tally(points, kinds, faces, inner, filled, *seen, at, NEAR, MARGIN)
        return found * self.weight * every


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


VECTOR = (
    "ratio", "walls", "conflict", "worst", "free", "opposed", "lift", "met", "missed", "share", "sliced", "sliced_conflict",
    "level", "ceilings",
)  # fmt: skip

QUALITY = [VECTOR.index(n) for n in ("ratio", "conflict", "worst", "opposed", "lift", "sliced_conflict", "level", "ceilings")]


def vector(f: Features) -> Array:
    """(14,) what the logistic models see of a pose, named `VECTOR`: amounts in logarithms, clutter weighed by how much."""
    amount = f["walls"] + f["conflict"]  # shares of little are drawn towards what is usual: no conflict of nothing is no praise
    shares = f["conflict_share"], f["worst_conflict"]
    conflict, worst = (np.log((s * amount + USUAL * FEW) / (amount + FEW) + 0.01) for s in shares)
    lift = f["met"] - f["chance"]
    many, known = f["clutter"], min(f["ceiling_area"] / 30, 1.0)
    return np.array(
        [
            f["ratio"],
            np.log(f["walls"] + 0.1),
            conflict,
            worst,
            np.log1p(f["free"]),
            f["opposed"],
            lift * np.sqrt(many / (many + 1)),
            np.log1p(many * f["met"]),
            np.log1p(many * (1 - f["met"])),
            f["share"],
            f["sliced"],
            f["sliced"] * conflict,
            min(f["level"], 0.5),
            known * (np.log(f["ceilings"] + 0.02) + 2.7),
        ]
    )


def model() -> dict[str, Any]:
    """Coefficients and the threshold, fitted on simulated training pairs (`train.py task=merge_belief`): of two models each for
    pairs of maps with heights (``solid``) and for those of which one is a slice or a drawing (``flat``)."""
    return read_weights_json("topomerge.fusion", "calibration.json")


def _models(f: Features) -> dict[str, Any]:
    """What pairs with these features are judged by: a slice shows no heights, and is another matter."""
    found: dict[str, Any] = model()["flat" if f["sliced"] else "solid"]
    return found


def plausibility(f: Features) -> float:
    """Log odds that a pose is right, seen by itself: what hypotheses are ranked by."""
    return _logit(_models(f)["pose"], vector(f))


def lead(scores: Array, vectors: Array, weights: Array, scales: Array) -> tuple[float, float, float, float]:
    """How far the first of ranked hypotheses is ahead, named `LEAD`: in log odds; in log odds without the amounts, of those that
    explain a share of what it does; in log odds of its share of the odds of all; and that share.

    A shift by one room along a row of rooms explains less, but nothing speaks against it: it is as good.
    """
    margin = min(float(scores[0] - scores[1]), MARGIN_CAP) if len(scores) > 1 else MARGIN_CAP
    quality = vectors[:, QUALITY] @ (weights / scales)[QUALITY]
    rival = vectors[1:, 1] >= vectors[0, 1] + np.log(RIVAL)
    ahead = float(quality[0] - quality[1:][rival].max()) if rival.any() else MARGIN_CAP
    share = float(1 / np.exp(scores - scores[0]).sum())
    alone = float(np.clip(np.log(share / (1 - share + 1e-3)), -2.0, MARGIN_CAP))
    return margin, float(np.clip(ahead, -2.0, MARGIN_CAP)), alone, share


def probability(ranked: Sequence[Ranked], closer: Features) -> tuple[float, list[float]]:
    """Probability that the first of ranked hypotheses is right, at most its share of the odds of all; and of each of them.

    Args:
        closer: what `closer.closer` found about the first one.
    """
    models = _models(ranked[0][1])
    pose = models["pose"]
    vectors = np.array([vector(f) for _, f, _ in ranked])
    scores = np.array([s for _, _, s in ranked])
    leads = lead(scores, vectors, np.array(pose["weight"]), np.array(pose["scale"]))
    odds = _logit(models["winner"], np.concatenate([vectors[0], leads[:3], closer_vector({**ranked[0][1], **closer})]))
    shares = np.exp(scores - scores[0]) / np.exp(scores - scores[0]).sum()
    first = min(1 / (1 + np.exp(-odds)), leads[3])
    every = first * shares / shares[0]
    return float(first), every.tolist()


def _logit(fitted: Mapping[str, Any], x: Array) -> float:
    return float(np.dot((x - fitted["mean"]) / fitted["scale"], fitted["weight"]) + fitted["bias"])


LEAD = ("margin", "ahead", "alone")
CLOSER = (
    "tall", "crossing", "worst_ratio", "squares", "bad_squares", "in_place", "out_of_place", "kept", "moved_walls", "hanging",
    "fallen", "held",
)  # fmt: skip


def closer_vector(f: Features) -> Array:
    """(12,) what the model of the best hypothesis sees of `closer.closer`, named `CLOSER`.

    Amounts are those of `ENOUGH` m2 at most: on a floor ten times as large ten times as much is out of place, and says no more.
    """
    gain, pieces = max(f["in_place"] - f["by_chance"], 0.0), max(f["pieces"] - f["by_chance"], 0.0)
    part = ENOUGH / (ENOUGH + f["free"])
    return np.array(
        [
            np.log(part * f["tall_conflict"] + 0.05),
            np.log(f["crossing"] + 0.1),
            f["worst_ratio"],
            np.log1p(f["squares"]),
            f["bad_squares"],
            np.log1p(part * gain),
            np.log1p(part * (pieces - gain)),
            gain / (pieces + 1.0),
            np.log(f["moved_walls"] + 0.004),
            np.log1p(part * f["hanging_met"]),
            np.log1p(part * (f["hanging"] - f["hanging_met"])),
            f["hanging_met"] / (f["hanging"] + 1.0),
        ]
    )


def rank(candidates: Sequence[Candidate], judge: Judge) -> list[Ranked]:
    """(candidate, features, plausibility), best first.

    The findings' two-stage rule (shortlist what reaches 0.6 of the best agreement, then least conflict) put the right pose
    first in 76 of 82 training pairs, the logistic model in 80: a flipped plan can agree in more walls than a true overlap.
    """
    lifted = [replace(c, pose=judge.lifted(c.pose)) for c in candidates]
    if len(lifted) > FULLY:
        lifted.sort(key=lambda c: -plausibility(judge(c.pose, GLANCE)))
    judged = [(c, f, plausibility(f)) for c, f in ((c, judge(c.pose)) for c in lifted[:FULLY])]
    judged.sort(key=lambda j: -j[2])
    kept = {id(c) for c in distinct((c for c, _, _ in judged), np.append(judge.b[0].middle, 0.0), BASIN)}
    return [j for j in judged if id(j[0]) in kept]
