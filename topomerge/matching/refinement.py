"""Poses moved to where the walls of one map lie on those of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.kernels import align
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.poses import PoseHypothesis, PoseTolerance, distinct_hypotheses, wrapped
from topomerge.types import Array, Sim3

SAME_POSE = PoseTolerance(0.4, float(np.radians(2.0)), 0.03)


@dataclass(frozen=True)
class RefineSettings:
    """Args:
    sigmas: m, of the weights of walls by their distance, round by round.
    rounds: of each sigma.
    sample: wall columns that a pose is refined by, at most.
    same_level: m by which floors of one storey may differ.
    unseen_level: m, likewise where a floor was not seen: its guess may be off by more.
    same_pose: refined poses that are nearer are one.
    """

    sigmas: tuple[float, ...] = (0.3, 0.15, 0.08)
    rounds: int = 5
    sample: int = 1500
    same_level: float = 0.5
    unseen_level: float = 1.2
    same_pose: PoseTolerance = SAME_POSE


REFINE = RefineSettings()


def storeys_at(
    a: Sequence[PlanFields], b: Sequence[PlanFields], offset: float, scale: float = 1.0
) -> list[tuple[PlanFields, PlanFields]]:
    """The storeys of a and of b that lie on one level under an offset of heights, m, and a scale of b."""
    pairs = []
    for v in a:
        for w in b:
            unseen = not np.isfinite((v.plan.levels[0], w.plan.levels[0])).all() or v.plan.sliced or w.plan.sliced
            gap = abs(v.plan.floor_guess - (scale * w.plan.floor_guess + offset))
            if gap < (REFINE.unseen_level if unseen else REFINE.same_level):
                pairs.append((v, w))
    return pairs


def refine(
    a: Sequence[PlanFields], b: Sequence[PlanFields], hypotheses: Sequence[PoseHypothesis], scaled: bool = False
) -> list[PoseHypothesis]:
    """Hypotheses moved to where b's walls lie on those of a, without duplicates; the best first, by the share of walls that meet.

    Those under which no storeys lie on one level are left out.

    Args:
        a, b: the storeys of the two maps.
        scaled: is the scale refined, too?
    """
    moved: list[PoseHypothesis] = []
    levels: dict[float, list[PoseHypothesis]] = {}
    for hypothesis in hypotheses:
        levels.setdefault(hypothesis.transform.translation[2], []).append(hypothesis)
    for offset, group in levels.items():
        pairs = [p for p in storeys_at(a, b, offset, group[0].transform.scale) if len(p[0].walls) and len(p[1].walls)]
        if pairs:
            moved += _refined(*max(pairs, key=lambda p: min(len(p[0].walls), len(p[1].walls))), group, scaled)
    moved.sort(key=lambda h: -h.score)
    return distinct_hypotheses(moved, np.append(b[0].middle, 0.0), REFINE.same_pose)


def _refined(v: PlanFields, w: PlanFields, group: Sequence[PoseHypothesis], scaled: bool) -> list[PoseHypothesis]:
    """The hypotheses of one offset of heights, moved by the walls of one storey of each map."""
    walls = w.walls
    if len(walls) > REFINE.sample:
        walls = walls[np.random.default_rng(0).permutation(len(walls))[: REFINE.sample]]
    middle = walls.mean(axis=0)
    start = np.array([[*_placed(h.transform, middle), h.transform.yaw, np.log(h.transform.scale)] for h in group])
    field = (*v.field, v.plan.edge)
    about = np.ascontiguousarray(walls - middle)
    poses, score = align.refine(about, *field, start, np.array(REFINE.sigmas), REFINE.rounds, scaled)
    moved = []
    for hypothesis, (x, y, yaw, size), value in zip(group, poses, score, strict=True):
        turned = Sim3(wrapped(yaw), (0.0, 0.0, 0.0), float(np.exp(size)))
        at = np.array([x, y]) - _placed(turned, middle)
        transform = replace(turned, translation=(float(at[0]), float(at[1]), hypothesis.transform.translation[2]))
        moved.append(replace(hypothesis, transform=transform, score=float(value) / len(walls)))
    return moved


def _placed(transform: Sim3, point: Array) -> Array:
    """(2,) m, where a transform puts a point (2,)."""
    out: Array = transform.apply(np.array([[*point, 0.0]]))[0, :2]
    return out
