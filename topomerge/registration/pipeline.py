"""Registration of two whole maps by their geometry: search, verify, refine (method 4; no rooms, no learning).

The best few hypotheses are examined closely: both maps are bent onto each other under each, and ranked again by what they show
then. Drift makes a right pose look worse than it is, and a wrong one hardly better than it was: bending tells them apart where
the rigid maps do not. So the lead over rivals is measured between bent maps, too."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from topomerge.blas import limit_blas_threads
from topomerge.errors import InputError
from topomerge.kernels import count_threads, run_side_by_side
from topomerge.landmarks.evidence import LandmarkEvidence, LandmarkScorer
from topomerge.landmarks.proposals import propose_poses
from topomerge.matching.poses import PoseHypothesis, refine, select_distinct_hypotheses, wrap_yaw
from topomerge.progress import Stopwatch, tell_step
from topomerge.registration.bend.bend import Bend, bend
from topomerge.registration.judge import Judge, compute_winner_features
from topomerge.registration.places import Places, score_places
from topomerge.registration.posterior import check_same
from topomerge.registration.prepared import Map, Prepared, prepare
from topomerge.registration.refine import refine_pose
from topomerge.registration.search import find_height_offsets, find_yaw_candidates, search, search_scaled
from topomerge.registration.verify import (
    BASIN,
    MARGIN_CAP,
    Verdict,
    compute_quality_lag,
    compute_verdict,
    load_model,
    rank,
    score_bent,
)
from topomerge.types import Sim3, TopometricMap, VoxelGrid

AS_GOOD = 1.5  # log odds: less is no lead
TESTIFIED = 3  # hypotheses that are bent, too, of those that landmarks speak for most
# Between rigid maps drift makes the right pose look worse, and wrong ones hardly better: rivals are bent, too. That took the
# real floor from 37 to about 60 believed pairs of 105 (docs/adr/0015).
CLOSELY = 3  # hypotheses that are bent at most, the best ones; and one more that no ratio speaks against
RIGID_FEATURES = {"strain": 0.0, "bent": 0.0, "farthest": 0.0, "doubted": 0.0, "bent_pieces": 0.0, "rmse": float("nan")}
log = logging.getLogger(__name__)
ALTERNATIVES = 10
DRIFTED = (0.5, np.radians(3.0))  # m, rad: a refinement that moves the middle by more has lost its way


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
        landmarks: what these say of it.
    """

    hypothesis: PoseHypothesis
    bend: Bend
    judge: Judge
    places: Places
    features: dict[str, float]
    score: float
    landmarks: LandmarkEvidence = field(default_factory=LandmarkEvidence)

    @property
    def odds(self) -> float:
        """Log odds by which candidates are ranked: of walls and of landmarks."""
        return self.score + self.landmarks.support

    def compute_all_features(self) -> dict[str, float]:
        """Compute all features, with those that only the best candidate needs (`compute_winner_features`)."""
        return {**self.features, **compute_winner_features(self.judge, self.bend.transform)}


def count_repeats(ranked: Sequence[PoseHypothesis]) -> int:
    """Count the other places that ratios speak for nearly as well: more in a building that repeats itself."""
    return int((compute_quality_lag(ranked)[1:] < AS_GOOD).sum())


def build_candidate(
    a: Prepared, b: Prepared, hypothesis: PoseHypothesis, scaled: bool, scorer: LandmarkScorer | None = None
) -> Candidate:
    """Return both maps bent near the pose T_ab of a hypothesis, and what they and their landmarks (`scorer`) show then."""
    bent = bend(a, b, hypothesis.transform, scaled=scaled)
    storeys = bent.bend_storeys(b.storeys)
    judge = Judge(a.storeys, storeys)
    seen = score_places(a.storeys, storeys, bent.transform)
    features = {**judge(bent.transform), **RIGID_FEATURES, **bent.features, **seen.features}
    landmarks = scorer.score(bent.transform, bent.deformations) if scorer else LandmarkEvidence()
    return Candidate(hypothesis, bent, judge, seen, features, score_bent(features), landmarks)


def select_rivals(ranked: Sequence[PoseHypothesis]) -> list[int]:
    """Return which of ranked hypotheses to look at closely: the first, those next to it that are not far behind, and the one that
    ratios speak for most, of those that explain enough: a shift along a row of rooms explains less, but is no worse."""
    near = [k for k, h in enumerate(ranked[:CLOSELY]) if h.score >= ranked[0].score - MARGIN_CAP]
    lag = compute_quality_lag(ranked)
    rest = [k for k in range(1, len(ranked)) if k not in near and lag[k] < MARGIN_CAP / 2]
    return near + sorted(rest, key=lambda k: lag[k])[:1]


def select_testified(ranked: Sequence[PoseHypothesis], scorer: LandmarkScorer) -> list[int]:
    """Return which of ranked hypotheses landmarks speak for most, with what walls say of each."""
    support = [scorer.score(h.transform).support for h in ranked]
    odds = [h.score + s for h, s in zip(ranked, support, strict=True)]
    return [k for k in sorted(range(len(ranked)), key=lambda k: -odds[k])[:TESTIFIED] if support[k] > 0]


def build_candidates(
    a: Prepared,
    b: Prepared,
    ranked: Sequence[PoseHypothesis],
    scaled: bool,
    bent: dict[int, Candidate] | None = None,
    scorer: LandmarkScorer | None = None,
) -> list[Candidate]:
    """Return the hypotheses worth it, each with the maps bent, best first; those that end in one pose once.

    Args:
        bent: id of a hypothesis -> what was made of it before; new ones are added.
        scorer: of landmarks, where both maps have some.
    """
    bent = {} if bent is None else bent
    closely = select_rivals(ranked)
    if scorer is not None:
        closely += [k for k in select_testified(ranked, scorer) if k not in closely]
    near = [ranked[k] for k in closely]
    # Bending is half of the time of a registration: it is not done again when rooms propose further poses (docs/adr/0021).
    new = [h for h in near if id(h) not in bent]
    built = run_side_by_side(lambda h: build_candidate(a, b, h, scaled, scorer), new)
    bent |= {id(h): candidate for h, candidate in zip(new, built, strict=True)}
    examined = sorted((bent[id(h)] for h in near), key=lambda c: -c.odds)
    examined[0].features["repeats"] = float(count_repeats(ranked))  # asked of the best one only
    moved = [replace(c.hypothesis, transform=c.bend.transform) for c in examined]
    single = {id(h) for h in select_distinct_hypotheses(moved, np.append(b.storeys[0].middle, 0.0), BASIN)}
    return [c for c, h in zip(examined, moved, strict=True) if id(h) in single]


@dataclass(frozen=True)
class FallbackProposals:
    """Poses T_ab that are made only where the best pose there is without them is less probable than `below`."""

    make: Callable[[], Sequence[Sim3]]
    below: float

    def inverse(self) -> FallbackProposals:
        """Return the proposals of the maps the other way round."""
        return replace(self, make=lambda: _invert_poses(self.make()))


@dataclass(frozen=True)
class Registration:
    """Where map b lies in the frame of map a, and whether to believe it.

    Args:
        transform: T_ab of the best hypothesis, believed or not; None where there was none.
        probability: that it is right, calibrated on simulated pairs; 0 without a hypothesis.
        accepted: is the probability above the threshold of the calibration?
        features: what it was judged by (`Judge`, `compute_winner_features`), with ``margin`` and ``rmse`` (m).
        alternatives: the hypotheses, best first, their scores the log odds of each seen by itself (`verify.rank`); the first one
            is the best before its fine registration.
        reason: in words.
        seconds: step -> s.
        bend: how the maps are bent onto each other under the transform; None where a rigid pose was asked for.
        posterior: probability of this place and of each named alternative (`registration.posterior`); they sum to 1.
        places: what both maps show of each place that they share under it, and how much that speaks for it.
        landmarks: what signs, tags and the like say of it.
        walls: the probability without landmarks.
    """

    transform: Sim3 | None
    probability: float
    accepted: bool
    features: dict[str, float] = field(default_factory=dict)
    alternatives: tuple[PoseHypothesis, ...] = ()
    reason: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    bend: Bend | None = None
    places: Places | None = None
    posterior: dict[str, float] = field(default_factory=dict)
    landmarks: LandmarkEvidence = field(default_factory=LandmarkEvidence)
    walls: float = 0.0


@limit_blas_threads
def register(
    a: Map | Prepared,
    b: Map | Prepared,
    *,
    scale: str = "fixed",
    proposed: Sequence[Sim3] | FallbackProposals = (),
    free: tuple[VoxelGrid | None, VoxelGrid | None] = (None, None),
    searched: bool = True,
    rigid: bool = False,
    same: str = "nothing",
) -> Registration:
    """Estimate the pose of map b in map a's frame. `register(b, a)` gives its inverse.

    Args:
        a, b: topometric maps or occupied cells, or what `prepare` made of them.
        scale: "fixed", or "free" where b's unit may differ (looked for between 0.5 and 2).
        proposed: poses T_ab of matched rooms: their yaws are searched, too, and they are tried beside what the correlation
            finds; or a fallback, whose poses are tried, if at all, after that.
        free: cells of a and of b known to be empty; topometric maps bring their own.
        searched: look for poses by correlation? Else the proposed ones are all there is.
        rigid: give the best rigid pose? Else both maps are bent, too. They are judged as bent all the same: drift is no
            contradiction.
        same: "nothing", "building" or "storey": both maps are known to be of one (`posterior.SAME`).

    Raises:
        InputError: an empty map, or another word for the scale or for what is known.
    """
    check_same(same)
    if scale not in ("fixed", "free"):
        raise InputError(f"scale must be fixed or free, not {scale!r}")
    clock = Stopwatch()
    tell_step(0.0, "draw plans")
    # More than half of the pose's time goes into each map by itself (docs/adr/0050).
    a, b = run_side_by_side(lambda k: _prepare_completely((a, b)[k], free[k]), (0, 1))
    clock.lap("plans")
    if b.order < a.order:  # so that nothing depends on which comes first
        poses = proposed.inverse() if isinstance(proposed, FallbackProposals) else _invert_poses(proposed)
        swapped = register(b, a, scale=scale, proposed=poses, searched=searched, rigid=rigid, same=same)
        return replace(_invert_registration(swapped), seconds={**swapped.seconds, **clock.seconds})
    pair = _Pair(a, b, scale == "free", clock)
    fallback, first = (proposed, ()) if isinstance(proposed, FallbackProposals) else (None, proposed)
    # Without the search rivals are missing, and wrong places are believed (docs/adr/0021).
    if searched:
        pair.search([*first, *pair.propose_by_landmarks()])
    else:
        pair.add(first)
    probability = pair.score_candidates(same)
    # Walls first: on 800 rooms their search takes 1.3 s, rows and matching of rooms 55 s, and rooms hardly ever decide
    # (docs/adr/0021).
    if fallback is not None and probability < fallback.below:
        tell_step(0.6, "match rooms")
        pair.add(fallback.make())
        pair.score_candidates(same)
    if pair.verdict is None:
        reason = "the maps show no walls that could be compared" if searched else "no two matched rooms could be aligned"
        return Registration(None, 0.0, False, reason=reason, seconds=clock.seconds)
    return replace(pair.build_registration(pair.verdict, rigid), seconds=clock.seconds)


def _prepare_completely(map: Map | Prepared, free: VoxelGrid | None) -> Prepared:
    """Prepare a map for registration; where several threads share loops, completely, beside the other map."""
    if isinstance(map, Prepared):
        return map
    prepared = prepare(map, free)
    return prepared.complete() if count_threads() > 1 else prepared


class _Pair:
    """Two maps while they are registered: their hypotheses, ranked, and those that were looked at closely."""

    def __init__(self, a: Prepared, b: Prepared, scaled: bool, clock: Stopwatch) -> None:
        self.a, self.b, self.scaled, self.clock = a, b, scaled, clock
        self.judge = Judge(a.storeys, b.storeys)
        self.ranked: list[PoseHypothesis] = []
        self.looked: list[Candidate] = []
        self.bent: dict[int, Candidate] = {}
        self.verdict: Verdict | None = None
        self.scorer: LandmarkScorer | None = None
        if a.has_landmarks and b.has_landmarks:
            one, other = a.load(), b.load()
            if isinstance(one, TopometricMap) and isinstance(other, TopometricMap):
                self.scorer = LandmarkScorer(one, other)

    def propose_by_landmarks(self) -> list[Sim3]:
        """Return the poses T_ab that landmarks propose."""
        if self.scorer is None:
            return []
        plans = self.a.storeys, self.b.storeys
        yaws = find_yaw_candidates(plans[0][0].profile, plans[1][0].profile) if all(plans) else []
        heights = find_height_offsets([v.plan for v in plans[0]], [w.plan for w in plans[1]])
        return propose_poses(self.scorer, self.scaled, yaws, [] if self.scaled else heights)

    def search(self, poses: Sequence[Sim3]) -> None:
        """Add hypotheses of the correlation, and of given poses T_ab."""
        tell_step(0.1, "search poses")
        self._rank((search_scaled if self.scaled else search)(self.a.storeys, self.b.storeys, poses))

    def add(self, poses: Sequence[Sim3]) -> None:
        """Add given poses T_ab, moved to where the walls meet."""
        self.clock.lap("match")
        proposals = [PoseHypothesis(pose, from_rooms=True) for pose in poses]
        self._rank(refine(self.a.storeys, self.b.storeys, proposals, self.scaled))

    def _rank(self, hypotheses: Sequence[PoseHypothesis]) -> None:
        self.clock.lap("search")
        self.ranked = rank(hypotheses, self.judge, self.ranked)
        self.clock.lap("verify")

    def score_candidates(self, same: str) -> float:
        """Look closely at the best hypotheses there are; the probability of the best one."""
        if not self.ranked:
            return 0.0
        tell_step(0.4, "bend the maps under the best poses and judge them")
        self.looked = build_candidates(self.a, self.b, self.ranked, self.scaled, self.bent, self.scorer)
        seen, evidence = [c.features for c in self.looked], [c.landmarks for c in self.looked]
        self.verdict = compute_verdict(seen, self.looked[0].compute_all_features(), same, evidence)
        self.clock.lap("bend")
        return self.verdict.each[0]

    def build_registration(self, verdict: Verdict, rigid: bool) -> Registration:
        """Return the best hypothesis, finely registered, with what was said of it."""
        tell_step(0.8, "refine the pose")
        bent, rmse = _refine_candidate(self.a, self.b, self.looked[0], self.scaled, rigid)
        self.clock.lap("refine")
        registration = _build_registration(self.ranked, self.looked, verdict)
        features = {**registration.features, "rmse": rmse}
        return replace(registration, transform=bent.transform, features=features, bend=None if rigid else bent)


def _invert_poses(poses: Sequence[Sim3]) -> list[Sim3]:
    return [pose.inverse() for pose in poses]


def _refine_candidate(a: Prepared, b: Prepared, best: Candidate, scaled: bool, rigid: bool) -> tuple[Bend, float]:
    """Return the bending of the best candidate with its pose by surfaces (all of it where the maps stay rigid, else its height),
    and the root mean square distance of the surfaces, m. A slice has no planes, and stays as it is."""
    bent = best.bend
    if any(v.plan.sliced for v in (*a.storeys, *b.storeys)):
        return bent, best.features["rmse"]
    aligned, misfit = refine_by_surfaces(a, b, best.hypothesis.transform, scaled)
    if rigid or bent.reason:
        return replace(bent, transform=aligned), misfit
    pose = bent.transform  # bending is level: floors and ceilings say how high
    height = aligned.translation[2] + (aligned.scale - pose.scale) * float(b.middle[2])  # there, where scales differ
    return replace(bent, transform=replace(pose, translation=(*pose.translation[:2], height))), best.features["rmse"]


def _build_registration(ranked: Sequence[PoseHypothesis], examined: Sequence[Candidate], verdict: Verdict) -> Registration:
    """Return the best of the candidates, with its probability and the reason in words."""
    best, probability = examined[0], verdict.each[0]
    margin = min(best.odds - examined[1].odds, MARGIN_CAP) if len(examined) > 1 else MARGIN_CAP
    features = {**verdict.features, "rigid_conflict_share": best.hypothesis.features["conflict_share"], "margin": margin}
    accepted = probability >= load_model()["threshold"]
    share = 100 * features["conflict_share"]
    reason = (
        f"{'believed' if accepted else 'not believed'}: {features['walls']:.0f} m2 of walls agree, {features['free']:.0f} m2 of "
        f"free floor seen by both, {share:.1f} % of the walls stand on free floor of the other map"
    )
    closely = {id(c.hypothesis) for c in examined}
    others = [replace(c.hypothesis, score=c.odds, probability=p) for c, p in zip(examined, verdict.each, strict=True)]
    last = others[-1].score  # of those that were not looked at closely, the lag behind the best one is all that is known
    for h in ranked:
        if id(h) not in closely:
            lag = max(ranked[0].score - h.score, best.odds - last)
            others.append(replace(h, score=best.odds - lag, probability=float(probability * np.exp(-lag))))
    pose, alternatives = best.bend.transform, tuple(others[:ALTERNATIVES])
    evidence = {"posterior": verdict.posterior, "landmarks": best.landmarks, "walls": verdict.walls}
    return Registration(pose, probability, accepted, features, alternatives, reason, places=best.places, **evidence)  # type: ignore[arg-type]


def refine_by_surfaces(a: Prepared, b: Prepared, start: Sim3, scaled: bool = False) -> tuple[Sim3, float]:
    """Refine T_ab point to plane, unless it runs away; return also the root mean square distance of the surfaces, m."""
    moved = refine_pose(a.surface, b.surface, start, scaled)
    shift = float(np.linalg.norm(moved.pose.apply(b.middle[None]) - start.apply(b.middle[None])))
    turn = abs(wrap_yaw(moved.pose.yaw - start.yaw))
    if not np.isfinite(moved.rmse) or shift > DRIFTED[0] or turn > DRIFTED[1]:
        log.debug("refinement moved %.2f m, %.1f degrees: left out", shift, np.degrees(turn))
        return start, float("nan")
    return moved.pose, moved.rmse


def _invert_registration(registration: Registration) -> Registration:
    """Return the same registration seen from the other map."""
    others = tuple(replace(h, transform=h.transform.inverse()) for h in registration.alternatives)
    transform = None if registration.transform is None else registration.transform.inverse()
    bent = registration.bend and registration.bend.inverse()
    seen = registration.places
    if seen is not None and registration.transform is not None:
        seen = seen.inverse(registration.transform)
    evidence = registration.landmarks.inverse()
    return replace(registration, transform=transform, alternatives=others, bend=bent, places=seen, landmarks=evidence)
