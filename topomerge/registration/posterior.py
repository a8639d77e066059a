"""The verdict as a posterior over named alternatives: this place, or what else could look as it does, under stated priors.

What the user knows (maps of one team, of one building, of one storey) takes alternatives away; what is left shares the odds. So
knowing more never lowers the probability of a pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.landmarks.evidence import LandmarkEvidence
from topomerge.landmarks.likelihood import ALTERNATIVES as POSTERIOR
from topomerge.landmarks.likelihood import WORDS
from topomerge.types import Array

WRONG = POSTERIOR[1:]
KINDS = ("elsewhere", "storey", "wing", "building", "outside")  # what the model of wrong poses tells apart
SAME_PLAN = ("storey", "half")  # places whose walls agree by plan, told by furniture
# Of the pairs that somebody would try, how many are of each kind, and (elsewhere) how often maps that do share a place are laid
# on another one: an assumption, not a measurement; the models are fitted to pairs weighed so.
PRIORS = {"here": 0.5, "elsewhere": 0.1, "storey": 0.08, "half": 0.03, "wing": 0.08, "building": 0.15, "outside": 0.06}
SAME = {
    "nothing": POSTERIOR,
    "building": ("here", "elsewhere", "storey", "half", "wing", "outside"),
    "storey": ("here", "elsewhere", "half", "wing", "outside"),
}
COMMON_WALLS, COMMON_FLOOR = 1.0, 6.0  # m2 of wall columns that meet and of free floor that both saw: below, nothing can be sure
MOST_BY_LANDMARKS = 0.95  # probability of a pose that walls alone do not carry and landmarks do
FEW = 0.5  # probability that so little evidence can carry at most


def check_same(same: str) -> None:
    """Raise InputError for another word than those of `SAME`."""
    if same not in SAME:
        raise InputError(f"same must be {', '.join(SAME)}, not {same!r}")


def compute_posterior(here: float, plan: float, kinds: Mapping[str, Any], x: Array, same: str = "nothing") -> dict[str, float]:
    """Return probability of each of `POSTERIOR`; they sum to 1.

    Args:
        here: probability of this place where nothing is known, against all but another place of the same plan.
        plan: odds of another place of the same plan (`SAME_PLAN`) against this one, beside those that `here` holds.
        kinds: model of what it is if it is not: ``mean``, ``scale`` (F,), ``weight`` (5, F), ``bias`` (5,), of `KINDS`.
        x: (F,) what that model sees.
        same: what the user knows the maps to be of, a key of `SAME`.
    """
    scores = np.array(kinds["weight"]) @ ((x - kinds["mean"]) / kinds["scale"]) + kinds["bias"]
    chances = np.exp(scores - scores.max())
    weight = dict(zip(KINDS, ((1 - here) * chances / chances.sum()).tolist(), strict=True))
    priors = sum(PRIORS[name] for name in SAME_PLAN)
    for name in SAME_PLAN:
        weight[name] = weight.get(name, 0.0) + here * plan * PRIORS[name] / priors
    weight["here"] = here
    possible = {name: weight[name] if name in SAME[same] else 0.0 for name in POSTERIOR}
    total = sum(possible.values())
    return {name: p / total for name, p in possible.items()} if total > 0 else {**dict.fromkeys(POSTERIOR, 0.0), "elsewhere": 1.0}


def limit_posterior(each: Mapping[str, float], most: float) -> dict[str, float]:
    """Return a posterior in which this place has at most the probability `most`; the alternatives get the rest as they share
    theirs."""
    if each["here"] <= most:
        return dict(each)
    rest = 1 - each["here"]
    names = [n for n in WRONG if each[n] > 0] or ["elsewhere"]
    share = {n: each[n] / rest if rest > 0 and each[n] > 0 else 1 / len(names) for n in names}
    return {"here": most, **{n: (1 - most) * share.get(n, 0.0) for n in WRONG}}


def compute_evidence_limit(features: Mapping[str, float]) -> float:
    """Return the most that a pose may be believed for how much both maps show at all."""
    return FEW if features["walls"] < COMMON_WALLS or features["free"] < COMMON_FLOOR else 1.0


def update_posterior(
    each: Mapping[str, float],
    threshold: float,
    landmarks: LandmarkEvidence,
    rivals: Sequence[tuple[float, LandmarkEvidence]] = (),
) -> dict[str, float]:
    """Return a posterior after what landmarks say; what walls alone do not carry gets `MOST_BY_LANDMARKS` at most.

    Args:
        each: by walls and furniture.
        threshold: from which these alone would be believed.
        landmarks: under the pose.
        rivals: other poses, each with its share by walls and what landmarks say of it.
    """
    if not landmarks.factors:
        return dict(each)
    updated = landmarks.apply(each, rivals)
    return limit_posterior(updated, MOST_BY_LANDMARKS) if each["here"] < threshold else updated


def find_threshold(risk: float, curve: Sequence[Sequence[float]]) -> float:
    """Return the probability from which on a merge is believed so that of a thousand pairs, drawn by `PRIORS`, at most `risk` are
    merged falsely.

    Args:
        curve: (threshold, false merges in a thousand), rising thresholds: measured on pairs that were left out.

    Raises:
        InputError: not above 0, or less than any threshold can promise.
    """
    if not 0 < risk <= 1000:
        raise InputError(f"risk must be above 0 and at most 1000 false merges in a thousand pairs, not {risk:g}")
    least = next((threshold for threshold, false in curve if false <= risk), None)
    if least is None:
        raise InputError(f"risk {risk:g}: the lowest measured risk is {min(f for _, f in curve):.2g} in a thousand")
    return float(least)


def describe_posterior(each: Mapping[str, float], threshold: float) -> str:
    """Describe the likeliest alternative: a sentence for a refusal, or nothing where none stands out."""
    if each["here"] >= threshold:
        return ""
    name = max(WRONG, key=lambda n: each[n])
    if each[name] < 0.15:
        return ""
    if name == "storey" and each["here"] + each["storey"] >= threshold:
        both = each["here"] + each["storey"]
        return f"the position is certain ({both:.2f}), the storey is not ({each['here']:.2f} for this one)"
    return f"it could also be {WORDS[name]} ({each[name]:.2f})"
