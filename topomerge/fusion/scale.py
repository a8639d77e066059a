"""Unknown scale: found from the spacing of walls along their two main directions, before any position is known (method 4).

Projected across a direction, walls are heaps on a line. Two maps of one building have the same heaps, shifted and stretched; the
stretch that correlates best in both directions is cheap to find, as everything has one dimension only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft, ndimage

from topomerge.fusion.correlation import SEARCH, Correlator
from topomerge.fusion.search import height_offsets, strongest
from topomerge.fusion.yaw_candidates import distinct_yaws, yaw_candidates
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.refinement import refine
from topomerge.types import Array, Sim3

TRIED_SCALES = (0.5, 2.0)  # least and greatest that is looked for
SCALE_STEP = 0.01  # of the logarithm
HEAP_BIN = 0.1  # m
HEAP_SIGMAS = (0.15, 1.0)  # m: heaps are sharper than the second and no sharper than the first
SCALE_YAWS = 40  # of yaw and scale that are correlated in the plane
PER_SCALE_YAW = 4
SHARED_SCALES = 0.2  # of the logarithm: nearer scales share images that are large enough for all of them
PROJECTED_WALLS = 4000  # wall columns that are projected


def search_scaled(
    a: Sequence[PlanFields], b: Sequence[PlanFields], proposed: Sequence[Sim3] = (), yaws: Sequence[float] = ()
) -> list[PoseHypothesis]:
    """Hypotheses of T_ab with their scale, refined, best first. Arguments as of `search.search`."""
    hypotheses = [PoseHypothesis(pose, from_rooms=True) for pose in proposed]
    pairs = [(v, w) for v in a for w in b if min(len(v.walls), len(w.walls)) >= SEARCH.least_walls]
    pairs.sort(key=lambda p: -min(len(p[0].walls), len(p[1].walls)))
    for v, w in pairs[:4]:
        turns = distinct_yaws([*yaw_candidates(v.profile, w.profile, 5), *yaws, *(pose.yaw for pose in proposed)])
        correlators: dict[float, Correlator] = {}
        for _, yaw, scale in scale_candidates(v, w, turns)[:SCALE_YAWS]:
            offset = height_offsets([v.plan], [w.plan], scale)[0]
            upper = float(np.exp(np.ceil(np.log(scale) / SHARED_SCALES) * SHARED_SCALES))
            if upper not in correlators:  # half of the time is what concerns map a alone
                correlators[upper] = Correlator(v, w, upper)
            for score, x, y in correlators[upper].translations(yaw, PER_SCALE_YAW, scale):
                share = score / max(np.sqrt(len(v.walls) * len(w.walls)) * scale, 1.0)  # larger maps meet more walls
                hypotheses.append(PoseHypothesis(Sim3(yaw, (x, y, offset), scale), share))
    best = refine(a, b, strongest(hypotheses), True)
    return [h for h in best if h.from_rooms or TRIED_SCALES[0] <= h.transform.scale <= TRIED_SCALES[1]]  # refinement may run away


def scale_candidates(v: PlanFields, w: PlanFields, yaws: Sequence[float]) -> list[tuple[float, float, float]]:
    """(score, yaw, scale) whose wall spacings agree, best first; for each yaw the separate peaks over the scale."""
    logs = np.arange(np.log(TRIED_SCALES[0]), np.log(TRIED_SCALES[1]) + SCALE_STEP, SCALE_STEP)
    main = np.radians(float(v.profile.argmax()) / 2)
    axes = np.array([[np.cos(main), -np.sin(main)], [np.sin(main), np.cos(main)]])  # columns: along and across
    first, second = _sample(v.walls), _sample(w.walls)
    span = np.hypot(*np.ptp(first, axis=0)) + TRIED_SCALES[1] * np.hypot(*np.ptp(second, axis=0))
    size = fft.next_fast_len(int(span / HEAP_BIN) + 16, real=True)
    fixed = [np.conj(fft.rfft(_heaps((first - first.min(axis=0)) @ axes[:, k : k + 1], size)[0])) for k in (0, 1)]
    candidates = []
    for yaw in yaws:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = second @ np.array([[c, s], [-s, c]])
        score = np.zeros(len(logs))
        for k in (0, 1):
            heaps = _heaps((turned @ axes[:, k])[:, None] * np.exp(logs), size)
            score += fft.irfft(fft.rfft(heaps, axis=1) * fixed[k], size, axis=1).max(axis=1)
        wide = ndimage.maximum_filter1d(score, 7)
        for i in np.flatnonzero(score >= wide):
            candidates.append((float(score[i]), float(yaw), float(np.exp(logs[i]))))
    return sorted(candidates, reverse=True)


def _sample(walls: Array) -> Array:
    return walls if len(walls) <= PROJECTED_WALLS else walls[np.random.default_rng(0).permutation(len(walls))[:PROJECTED_WALLS]]


def _heaps(at: Array, size: int) -> Array:
    """(S, size) how much higher than around it the projections (n, S), m, are heaped up; unit norm."""
    columns = np.floor((at - at.min(axis=0)) / HEAP_BIN).astype(np.int64)
    flat = (columns + np.arange(at.shape[1]) * size).ravel()
    counts = np.bincount(flat, minlength=at.shape[1] * size).reshape(at.shape[1], size).astype(np.float64)
    sharp, blunt = (ndimage.gaussian_filter1d(counts, s / HEAP_BIN, axis=1, mode="constant") for s in HEAP_SIGMAS)
    heaps = np.clip(sharp - blunt, 0.0, None)
    out: Array = heaps / np.maximum(np.linalg.norm(heaps, axis=1, keepdims=True), 1e-9)
    return out
