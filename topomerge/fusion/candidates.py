"""The best few hypotheses, looked at closely: both maps bent onto each other under each, and ranked anew by what they show then.

Drift makes a right pose look worse than it is, and a wrong one hardly better than it was: bending tells them apart where the
rigid maps do not. So the lead over rivals is measured between bent maps, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topomerge.fusion.bend.bend import Bend, bend
from topomerge.fusion.evidence.places import Places, places
from topomerge.fusion.judge import Judge
from topomerge.fusion.prepared import Prepared
from topomerge.fusion.verify import BASIN, MARGIN_CAP, bent_score, quality_lag
from topomerge.fusion.winner_features import winner_features
from topomerge.matching.poses import PoseHypothesis, distinct_hypotheses

AS_GOOD = 1.5  # log odds: less is no lead
CLOSELY = 3  # hypotheses that are bent at most, the best ones; and one more that no ratio speaks against
RIGID_FEATURES = {"strain": 0.0, "bent": 0.0, "farthest": 0.0, "doubted": 0.0, "bent_pieces": 0.0, "rmse": float("nan")}


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis, and both maps bent onto each other under it.

    Args:
        hypothesis: before bending.
        bend: near its pose.
        judge: of the bent maps.
        places: what both maps show, one place after another.
        features: of `Judge` and `Bend`, and of the places.
        score: log odds that it is right, seen by itself.
    """

    hypothesis: PoseHypothesis
    bend: Bend
    judge: Judge
    places: Places
    features: dict[str, float]
    score: float

    def closely(self) -> dict[str, float]:
        """What is asked of the best one only (`winner_features`), and all other features."""
        return {**self.features, **winner_features(self.judge, self.bend.transform)}


def repeats(ranked: Sequence[PoseHypothesis]) -> int:
    """How many other places of the maps ratios speak for nearly as well: of a building that repeats itself, more."""
    return int((quality_lag(ranked)[1:] < AS_GOOD).sum())


def candidate(a: Prepared, b: Prepared, hypothesis: PoseHypothesis, scaled: bool) -> Candidate:
    """Both maps bent near the pose T_ab of a hypothesis, and what they show then."""
    bent = bend(a, b, hypothesis.transform, scaled=scaled)
    storeys = bent.storeys(b.storeys)
    judge = Judge(a.storeys, storeys)
    seen = places(a.storeys, storeys, bent.transform)
    features = {**judge(bent.transform), **RIGID_FEATURES, **bent.features, **seen.features}
    return Candidate(hypothesis, bent, judge, seen, features, bent_score(features))


def rivals(ranked: Sequence[PoseHypothesis]) -> list[int]:
    """Which of ranked hypotheses to look at closely: the first, those next to it that are not far behind, and the one that ratios
    speak for most, of those that explain enough: a shift along a row of rooms explains less, but is no worse."""
    near = [k for k, h in enumerate(ranked[:CLOSELY]) if h.score >= ranked[0].score - MARGIN_CAP]
    lag = quality_lag(ranked)
    rest = [k for k in range(1, len(ranked)) if k not in near and lag[k] < MARGIN_CAP / 2]
    return near + sorted(rest, key=lambda k: lag[k])[:1]


def candidates(
    a: Prepared, b: Prepared, ranked: Sequence[PoseHypothesis], scaled: bool, bent: dict[int, Candidate] | None = None
) -> list[Candidate]:
    """The hypotheses worth it, each with the maps bent, best first; those that end in one pose once.

    Args:
        bent: id of a hypothesis -> what was made of it before; new ones are added.
    """
    bent = {} if bent is None else bent
    near = [ranked[k] for k in rivals(ranked)]
    bent |= {id(h): candidate(a, b, h, scaled) for h in near if id(h) not in bent}
    looked = sorted((bent[id(h)] for h in near), key=lambda c: -c.score)
    looked[0].features["repeats"] = float(repeats(ranked))  # asked of the best one only
    moved = [replace(c.hypothesis, transform=c.bend.transform) for c in looked]
    single = {id(h) for h in distinct_hypotheses(moved, np.append(b.storeys[0].middle, 0.0), BASIN)}
    return [c for c, h in zip(looked, moved, strict=True) if id(h) in single]
