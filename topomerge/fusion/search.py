"""Candidate poses of one map in another: heights from floors, yaw from wall directions, translation by correlation (method 4).

Free space decides: walls on walls count for a pose, walls of one map on seen-empty ground of the other against it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.fusion.correlation import SEARCH, Correlator
from topomerge.fusion.yaw_candidates import distinct_yaws, yaw_candidates
from topomerge.matching.plan_fields import PlanFields
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.refinement import refine, storeys_at
from topomerge.types import Sim3


def height_offsets(a: Sequence[StoreyPlan], b: Sequence[StoreyPlan], scale: float = 1.0) -> list[float]:
    """z offsets, m, that bring a storey of b to one of a: by their floors, or by their ceilings where a floor was not seen."""
    offsets: list[float] = []
    for p in a:
        for q in b:
            floors, ceilings = ((p.levels[k], q.levels[k]) for k in (0, 1))
            guesses = (p.floor_guess, q.floor_guess)
            of_a, of_b = next((pair for pair in (floors, ceilings) if np.isfinite(pair).all()), guesses)
            offset = of_a - scale * of_b
            if all(abs(offset - other) > SEARCH.height_gap for other in offsets):
                offsets.append(float(offset))
    return offsets


def search(
    a: Sequence[PlanFields], b: Sequence[PlanFields], proposed: Sequence[Sim3] = (), yaws: Sequence[float] = ()
) -> list[PoseHypothesis]:
    """Hypotheses of T_ab of known scale, refined, best first.

    Args:
        a, b: the storeys of the two maps.
        proposed: poses of matched rooms, refined beside those of the correlation.
        yaws: further yaws to try, rad.
    """
    hypotheses = [PoseHypothesis(pose, from_rooms=True) for pose in proposed]
    for offset in height_offsets([v.plan for v in a], [w.plan for w in b]):
        for v, w in storeys_at(a, b, offset):
            if min(len(v.walls), len(w.walls)) < SEARCH.least_walls:
                continue
            correlator = Correlator(v, w)
            for yaw in distinct_yaws([*yaw_candidates(v.profile, w.profile), *yaws, *(pose.yaw for pose in proposed)]):
                for score, x, y in correlator.translations(yaw):
                    hypotheses.append(PoseHypothesis(Sim3(yaw, (x, y, offset)), score))
    return refine(a, b, strongest(hypotheses))


def strongest(hypotheses: list[PoseHypothesis]) -> list[PoseHypothesis]:
    """Those of rooms, and of the others the best `SEARCH.hypotheses`, best first."""
    ordered = sorted(hypotheses, key=lambda h: (not h.from_rooms, -h.score))
    return ordered[: SEARCH.hypotheses + sum(h.from_rooms for h in hypotheses)]
