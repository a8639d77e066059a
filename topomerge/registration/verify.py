"""Whether to believe a pose: logistic models of what was counted under it, and of how far it is ahead of all others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import betaln

from topomerge.archive import read_weights_json
from topomerge.kernels import run_side_by_side
from topomerge.landmarks.evidence import LandmarkEvidence
from topomerge.matching.poses import PoseHypothesis, PoseTolerance, select_distinct_hypotheses
from topomerge.registration.judge import Judge
from topomerge.registration.posterior import compute_evidence_limit, compute_posterior, limit_posterior, update_posterior
from topomerge.types import Array

JUDGED_FULLY, GLANCE_STEP = 30, 7  # hypotheses that are judged by all columns; more of them by every seventh first
USUAL_CONFLICT, PRIOR_WALLS = 0.15, 1.0  # share of walls on free ground, and m2 of walls that weigh as much as that prior
MARGIN_CAP = 6.0
BASIN = PoseTolerance(1.2, float(np.radians(3.0)), 0.05)  # a worse pose nearer than that is no rival
ENOUGH_FLOOR = 200.0  # m2 of free floor that both maps saw
RIVAL_WALLS = 0.3  # of the walls that the best hypothesis brings together
# Judged by ratios alone, rivals would bring a quarter of the right pairs below .65 (docs/adr/0023).
AMOUNT_COUNTS = 0.5  # of the log odds of rivals that amounts of evidence make: how much can agree depends on how far maps overlap
FURNITURE_STAYS = 0.44  # of the furniture that meets nothing by chance stands at a later visit where it stood
OTHER_FURNITURE = (1.2, 0.04)  # share that another room's furniture meets: so many times that of shifted furniture, and so much
# more, as furniture follows walls
MOST_BY_CHANCE = 0.7  # share of the furniture that meets something wherever it is shifted: more tells nothing
CERTAINTY = 20.0  # of both shares: sum of the parameters of their beta distributions
INDEPENDENT_PIECES = 0.5  # of the pieces of 0.4 m2: a bed is several
Features = Mapping[str, float]

POSE_VECTOR = (
    "ratio", "walls", "conflict", "worst", "free", "opposed", "lift", "met", "missed", "share", "sliced", "sliced_conflict",
    "level", "ceilings",
)  # fmt: skip

QUALITY_NAMES = ("ratio", "conflict", "worst", "opposed", "lift", "sliced_conflict", "level", "ceilings")  # no amounts
QUALITY = [POSE_VECTOR.index(n) for n in QUALITY_NAMES]


def compute_pose_vector(f: Features) -> Array:
    """Return (12,) what the logistic models see of a pose, named `POSE_VECTOR`: amounts in logarithms, clutter weighed by how
    much."""
    amount = f["walls"] + f["conflict"]  # shares of little are drawn towards what is usual: no conflict of nothing is no praise
    shares = f["conflict_share"], f["worst_conflict"]
    conflict, worst = (np.log((s * amount + USUAL_CONFLICT * PRIOR_WALLS) / (amount + PRIOR_WALLS) + 0.01) for s in shares)
    lift = f["met"] - f["chance"]
    clutter, certain = f["clutter"], min(f["ceiling_area"] / 30, 1.0)
    return np.array(
        [
            f["ratio"],
            np.log(f["walls"] + 0.1),
            conflict,
            worst,
            np.log1p(f["free"]),
            f["opposed"],
            lift * np.sqrt(clutter / (clutter + 1)),
            np.log1p(clutter * f["met"]),
            np.log1p(clutter * (1 - f["met"])),
            f["share"],
            f["sliced"],
            f["sliced"] * conflict,
            min(f["level"], 0.5),
            certain * (np.log(f["ceilings"] + 0.02) + 2.7),
        ]
    )


def load_model() -> dict[str, Any]:
    """Load the coefficients and the threshold, fitted on simulated training pairs (`train.py task=merge_belief`): of two models
    each for pairs of maps with heights (``solid``) and for those of which one is a slice or a drawing (``flat``)."""
    return read_weights_json("topomerge.registration", "calibration.json")


def _select_models(f: Features) -> dict[str, Any]:
    """Select the models for pairs with these features: a slice shows no heights and has models of its own."""
    models: dict[str, Any] = load_model()["flat" if f["sliced"] else "solid"]
    return models


def score_plausibility(f: Features) -> float:
    """Return log odds that a pose is right, seen by itself: what hypotheses are ranked by."""
    return _compute_logit(_select_models(f)["pose"], compute_pose_vector(f))


def compute_quality_lag(ranked: Sequence[PoseHypothesis]) -> Array:
    """Return (n,) by how many log odds each hypothesis is behind the first one without the amounts; inf where it explains too
    little to be a rival."""
    fitted = _select_models(ranked[0].features)["pose"]
    vectors = np.array([compute_pose_vector(h.features) for h in ranked])
    quality = vectors[:, QUALITY] @ (np.array(fitted["weight"]) / fitted["scale"])[QUALITY]
    return np.where(vectors[:, 1] >= vectors[0, 1] + np.log(RIVAL_WALLS), quality[0] - quality, np.inf)


def score_bent(f: Features) -> float:
    """Return log odds that a pose is right, seen by itself, once the maps are bent."""
    return _compute_logit(_select_models(f)["bent"], compute_bent_pose_vector(f))


def compute_lead(scores: Array, vectors: Array, weights: Array, scales: Array) -> tuple[float, float, float, float]:
    """Return how far the first of ranked hypotheses is ahead, named `LEAD_VECTOR`: in log odds; in log odds without the amounts,
    of those that explain a share of what it does; in log odds of its share of the odds of all; and its share where the amounts of
    rivals count in part (`AMOUNT_COUNTS`).

    A shift by one room along a row of rooms explains less, but nothing speaks against it: it is nearly as good.
    """
    margin = min(float(scores[0] - scores[1]), MARGIN_CAP) if len(scores) > 1 else MARGIN_CAP
    quality = vectors[:, BENT_QUALITY] @ (weights / scales)[BENT_QUALITY]
    rival = vectors[1:, 1] >= vectors[0, 1] + np.log(RIVAL_WALLS)
    ahead = float(quality[0] - quality[1:][rival].max()) if rival.any() else MARGIN_CAP
    behind = scores - scores[0]
    of_odds = float(1 / np.exp(behind).sum())
    alone = float(np.clip(np.log(of_odds / (1 - of_odds + 1e-3)), -2.0, MARGIN_CAP))
    as_good = AMOUNT_COUNTS * behind + (1 - AMOUNT_COUNTS) * np.minimum(quality - quality[0], 0.0)
    behind[1:] = np.where(rival, np.maximum(behind, as_good)[1:], behind[1:])
    return margin, float(np.clip(ahead, -2.0, MARGIN_CAP)), alone, float(1 / np.exp(behind).sum())


@dataclass(frozen=True)
class Verdict:
    """Probabilities of ranked poses and of their alternatives.

    Args:
        posterior: probability of each of `posterior.POSTERIOR`; they sum to 1.
        each: probability of each of the ranked poses, the first one that of this place (``here``).
        features: of the first pose, all that it was judged by.
        walls: probability of this place without landmarks.
    """

    posterior: dict[str, float]
    each: list[float]
    features: dict[str, float]
    walls: float


def compute_verdict(
    rivals: Sequence[Features], winner: Features, same: str = "nothing", landmarks: Sequence[LandmarkEvidence] = ()
) -> Verdict:
    """Return whether the first of ranked poses is right. At most its share of the odds of all, and at most what so much evidence
    can carry.

    Args:
        rivals: features of each pose once the maps are bent, best first.
        winner: features of the first one, with those of `compute_winner_features`.
        same: what the user knows the maps to be of, a key of `posterior.SAME`.
        landmarks: what they say of each pose; none: nothing.
    """
    models = _select_models(rivals[0])
    scores = np.array([score_bent(f) for f in rivals])
    vectors = np.array([compute_bent_pose_vector(f) for f in rivals])
    leads = compute_lead(scores, vectors, np.array(models["bent"]["weight"]), np.array(models["bent"]["scale"]))
    seen = compute_belief_vector(vectors[0], leads[:3], winner)
    here = float(1 / (1 + np.exp(-_compute_logit(models["winner"], seen))))
    plan = float(compute_plan_odds(models["plan"], compute_plan_vector(winner)[None])[0])
    every = limit_posterior(
        compute_posterior(here, plan, models["kinds"], seen, same), min(leads[3], compute_evidence_limit(winner))
    )
    shares = np.exp(scores - scores[0])
    if not any(e.factors for e in landmarks):
        return Verdict(every, (every["here"] * shares).tolist(), dict(winner), every["here"])
    others = [(float(share / max(shares[1:].sum(), 1e-12)), e) for share, e in zip(shares[1:], landmarks[1:], strict=True)]
    posterior = update_posterior(every, load_model()["threshold"], landmarks[0], others)
    ahead = np.array([e.support - landmarks[0].support for e in landmarks])
    each = posterior["here"] * np.minimum(shares * np.exp(np.minimum(ahead, 30.0)), 1.0)
    return Verdict(posterior, each.tolist(), dict(winner), every["here"])


def compute_belief_vector(bent: Array, leads: Sequence[float], winner: Features) -> Array:
    """Build the input of the models of the best pose, `BELIEF_VECTOR`: the pose after bending (`compute_bent_pose_vector`), its
    lead, and what only it is asked."""
    return np.concatenate(
        [bent, leads, [np.log1p(winner["repeats"])], compute_winner_vector(winner), compute_bend_vector(winner)]
    )


def _compute_logit(fitted: Mapping[str, Any], x: Array) -> float:
    return float(_compute_logits(fitted, x))


def _compute_logits(fitted: Mapping[str, Any], x: Array) -> Array:
    return np.asarray(np.dot((x - fitted["mean"]) / fitted["scale"], fitted["weight"]) + fitted["bias"])


LEAD_VECTOR = ("margin", "ahead", "alone", "repeats")
WINNER_VECTOR = (
    "tall", "crossing", "worst_ratio", "squares", "bad_squares", "in_place", "out_of_place", "kept", "moved_walls", "hanging",
    "fallen", "held",
)  # fmt: skip


USUAL_STRAIN = 0.6  # of joints: the captures of a real floor need as much (development set), which is no evidence against a pose
BEND_VECTOR = ("strain", "doubted")


def compute_bend_vector(f: Features) -> Array:
    """Return (2,) what the model of the best hypothesis sees of the bending, named `BEND_VECTOR`: how much more than in real maps
    the joints give way, and the share of the pieces that were voted out. How far pieces moved is left out: simulated maps drift
    less than real ones, and a model that sees it takes real drift for a wrong pose."""
    return np.array([np.log(max(f["strain"], USUAL_STRAIN)), f["doubted"]])


PLACE_VECTOR = ("place_mean", "place_total", "place_worst")
BENT_POSE_VECTOR = (*POSE_VECTOR, *PLACE_VECTOR)
BENT_QUALITY = [*QUALITY, BENT_POSE_VECTOR.index("place_mean"), BENT_POSE_VECTOR.index("place_worst")]
BELIEF_VECTOR = (*BENT_POSE_VECTOR, *LEAD_VECTOR, *WINNER_VECTOR, *BEND_VECTOR)
PLACE_AREA = 20.0  # m2 of floor that count as one place that tells something by itself


def compute_bent_pose_vector(f: Features) -> Array:
    """Return (17,) what the models see of a pose once the maps are bent, named `BENT_POSE_VECTOR`: places depend on each other,
    so that their log odds do not add up; how much their number counts is fitted."""
    mean = f["place_mean"]
    return np.append(compute_pose_vector(f), [mean, mean * np.log1p(f["place_area"] / PLACE_AREA), f["place_worst"]])


def compute_furniture_log_odds(f: Features) -> float:
    """Compute the log odds that furniture which both maps could see is of one room at two visits and not of two rooms of one
    plan.

    Of n pieces m stand in place: a beta-binomial likelihood of m by what stays over time (`FURNITURE_STAYS`) against that by what
    would meet by chance, measured where all furniture is moved (`compute_winner_features`). The three numbers are the most likely
    ones of
    98 right pairs and 69 of other furniture, from training buildings. Nothing is said where a map shows no furniture.
    """
    n = INDEPENDENT_PIECES * f["pieces"]
    met = min(INDEPENDENT_PIECES * f["in_place"], n)
    by_chance = float(np.clip(f["by_chance"] / max(f["pieces"], 1e-6), 0.0, MOST_BY_CHANCE))
    factor, more = OTHER_FURNITURE
    a, c = CERTAINTY * (by_chance + (1 - by_chance) * FURNITURE_STAYS), CERTAINTY * (factor * by_chance + more)
    b, d = CERTAINTY - a, CERTAINTY - c
    return float(betaln(a + met, b + n - met) - betaln(a, b) - betaln(c + met, d + n - met) + betaln(c, d))


def compute_winner_vector(f: Features) -> Array:
    """Return (12,) what the model of the best hypothesis sees of `compute_winner_features`, named `WINNER_VECTOR`.

    Amounts are those of `ENOUGH_FLOOR` m2 at most: on a floor ten times as large ten times as much is out of place, and says
    no more.
    """
    gain, pieces = max(f["in_place"] - f["by_chance"], 0.0), max(f["pieces"] - f["by_chance"], 0.0)
    part = ENOUGH_FLOOR / (ENOUGH_FLOOR + f["free"])
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


PLAN_VECTOR = ("furniture", "furniture_sliced")


def compute_plan_vector(f: Features) -> Array:
    """Return (2,) what tells a place from another one of the same plan (another storey, the other half of the building), named
    `PLAN_VECTOR`: how much walls agree is no evidence there. Slices see legs in place of furniture, and are weighed apart."""
    furniture, sliced = compute_furniture_log_odds(f), f["sliced"]
    return np.array([furniture * (1 - sliced), furniture * sliced])


def compute_plan_odds(fitted: Mapping[str, Any], x: Array) -> Array:
    """Return (n,) odds of another place of the same plan against this one, of vectors (n, 2) as `compute_plan_vector`: by how
    much they are above those of maps that show no furniture. Where nothing tells, the model of the place has weighed what walls
    say already."""
    # Else 57 of 98 right pairs of the real floor would be believed, not 84 (docs/adr/0023).
    nothing = np.exp(-_compute_logits(fitted, np.zeros_like(x)))
    return np.asarray(np.maximum(np.exp(-_compute_logits(fitted, x)) - nothing, 0.0))


def rank(hypotheses: Sequence[PoseHypothesis], judge: Judge, ranked: Sequence[PoseHypothesis] = ()) -> list[PoseHypothesis]:
    """Return the hypotheses with their features and, as scores, the log odds that each is right, seen by itself; best first, and
    among them those that were ranked before.

    The findings' two-stage rule (shortlist what reaches 0.6 of the best agreement, then least conflict) put the right pose
    first in 76 of 82 training pairs, the logistic model in 80: a flipped plan can agree in more walls than a true overlap.
    """
    lifted = [replace(h, transform=judge.lift_pose(h.transform)) for h in hypotheses]
    if len(lifted) > JUDGED_FULLY:
        glances = run_side_by_side(lambda h: score_plausibility(judge(h.transform, GLANCE_STEP)), lifted)
        lifted = [lifted[k] for k in sorted(range(len(lifted)), key=lambda k: -glances[k])]
    closely = lifted[:JUDGED_FULLY]
    features = run_side_by_side(lambda h: judge(h.transform), closely)
    judged = [*ranked, *(replace(h, features=f, score=score_plausibility(f)) for h, f in zip(closely, features, strict=True))]
    judged.sort(key=lambda h: -h.score)
    return select_distinct_hypotheses(judged, np.append(judge.b[0].middle, 0.0), BASIN)
