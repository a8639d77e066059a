"""Evidence of landmarks of two maps for a pose: one factor a kind over the named alternatives, and which landmarks testify.

Where both maps read something at one place, `likelihood` weighs it. Besides:

- A rare string that both maps read at two places far from each other under the pose speaks for another pose, unless it points
  there (`MISPLACED`).
- A sign that the other map could have seen and did not read says little (`READS`): doors that look alike bear some, too.
- A tag that one map has and the other one, which saw the place, has not speaks for another place (`score_missed`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.landmarks.likelihood import (
    ALTERNATIVES,
    GATE,
    KINDS,
    READERS,
    WORDS,
    Associated,
    Kind,
    associate_sightings,
    compute_chances,
    compute_factors,
    compute_prefix_factors,
    compute_shares,
    pick_partners,
    score_pair,
)
from topomerge.landmarks.radio import MOST_RATIO, SAME_STOREY, STOREY_HEIGHT, WRONG, score_radio
from topomerge.landmarks.sightings import Sightings, build_sightings, transform_places
from topomerge.landmarks.text import is_cut_off, is_misread, quote_text
from topomerge.types import Array, Deformation, Landmarks, Sim3, TopometricMap

FALL = 0.12  # hPa a metre
NOISE = 0.06  # hPa, standard deviation of the mean of a place
BAROMETERS = 0.15  # hPa, by which two of them differ (standard deviation)
DRIFT = 1e-4  # hPa a second, of the day
LEVEL = 0.5  # m of height, and
PLACE = 3.0  # m, of a place whose readings are averaged
NEAR = 5.0  # m between a place of a and one of b
CHANGED = 0.2  # probability that a pose on another place pairs two levels
MOST_PLACES = 10.0  # that count as independent: a session's noise is slow
POSSIBLE = (300.0, 1100.0)  # hPa


def score_pressure(a: TopometricMap, b: TopometricMap, pose: Sim3) -> dict[str, float]:
    """Score a pose T_ab by barometric pressure.

    Returns:
        Log likelihood ratio of each alternative of the posterior against this pose ("here": 0), below 0 where pressure speaks for
        this pose. Only "storey" (sessions near each other in time) and "elsewhere" (levels change at other places) are told.
    """
    scores = dict.fromkeys(("here", *WRONG), 0.0)
    places = _average_places(a.landmarks, Sim3()), _average_places(b.landmarks, pose)
    if not len(places[0]) or not len(places[1]):
        return scores
    difference, gap = _pair_places(*places)
    if not len(difference):
        return scores
    share = min(1.0, MOST_PLACES / len(difference))
    step, own = FALL * STOREY_HEIGHT, np.sqrt(2) * NOISE
    if np.isfinite(gap):
        sigma = np.sqrt(own**2 / (len(difference) * share) + BAROMETERS**2 + (DRIFT * gap) ** 2)
        scores["storey"] = _compare(np.array([difference.mean()]), step, sigma, 0.0)
    scores["elsewhere"] = share * _compare(difference - np.median(difference), step, own, 1 - CHANGED)
    return {name: float(np.clip(value, -MOST_RATIO, MOST_RATIO)) for name, value in scores.items()}


def _compare(difference: Array, step: float, sigma: float, same: float) -> float:
    """Return the log likelihood ratio of differences (n,), hPa, that are one step up or down, or 0 with a probability, against
    all 0."""
    one = [-0.5 * ((difference - shift) / sigma) ** 2 for shift in (0.0, -step, step)]
    shares = np.log(np.maximum([same, (1 - same) / 2, (1 - same) / 2], 1e-12))
    return float(np.sum(np.logaddexp.reduce([p + s for p, s in zip(one, shares, strict=True)]) - one[0]))


def _average_places(landmarks: Landmarks, pose: Sim3) -> Array:
    """Return (n, 5) x, y, z (m, under a pose), pressure (hPa) and time (s; nan: not known) of each place."""
    table = landmarks.table[landmarks.is_kind("pressure")]
    good = np.isfinite(table["position"]).all(axis=1) & (table["number"] > POSSIBLE[0]) & (table["number"] < POSSIBLE[1])
    table = table[good]
    if not len(table):
        return np.zeros((0, 5))
    values = np.column_stack([pose.apply(table["position"]), table["number"], table["time"]])
    cell = np.floor(values[:, :3] / (PLACE, PLACE, LEVEL)).clip(-1e9, 1e9).astype(np.int64)
    _, place = np.unique(cell, axis=0, return_inverse=True)
    place = place.ravel()
    return np.column_stack([np.bincount(place, column) for column in values.T]) / np.bincount(place)[:, None]


def _pair_places(a: Array, b: Array) -> tuple[Array, float]:
    """Return the hPa by which b reads more than a at each place of b that a passed, too, and the least time, s, between the
    sessions."""
    stretched = [p[:, :3] * (1, 1, NEAR / SAME_STOREY) for p in (a, b)]
    distance, nearest = cKDTree(stretched[0]).query(stretched[1], distance_upper_bound=NEAR)
    met = np.isfinite(distance)
    first, second = a[nearest[met]], b[met]
    height = first[:, 2] - second[:, 2]
    times = np.abs(first[:, 4] - second[:, 4])
    gap = float(np.median(times[np.isfinite(times)])) if np.isfinite(times).any() else np.inf
    return second[:, 3] - first[:, 3] - FALL * height, gap


READS = 0.6  # probability that a map that reads as many signs as the other one reads a sign that it could have seen
MOST_UNREAD = 1.0  # log odds that unread signs may cost in all
# Shares of the tags in sight that a map may have, alike likely: so a reader that finds most is likelier than one that finds few.
RATES = np.sqrt((np.arange(10) + 0.5) / 10)
MISPLACED = 0.1  # probability that a rare string far from its place points there, or was put in a wrong place
TELLING = float(np.log(3.0))  # log odds, from which on a kind is told to speak for an alternative
FAR, MOST_FAR = 6.0, 6.0  # m beyond which two places are two, and log odds that such strings may give in all
RARE = 0.01  # share of the signs, below which a string names one place
SEEN_AROUND, SEEN_WITHIN = 1.5, 0.6  # m around a landmark of its own map's cells, and of those of the other map from these
SEEN_CELLS, MOST_ASKED = 32, 200  # cells around a landmark, and landmarks of a map, that are asked for
Bends = tuple[Deformation | None, Deformation | None]


@dataclass(frozen=True)
class Witness:
    """Two landmarks that say something of a pose together.

    Args:
        kind: of `KINDS`.
        values: what stands in map a and in map b.
        rows: of the tables of both.
        at: place in the frame of each map, m.
        verdict: "agrees", "contradicts", "cut off": the one may be the other, of which an end is missing, which says little; or
            "elsewhere": the same string, far away.
    """

    kind: str
    values: tuple[str, str]
    rows: tuple[int, int]
    at: tuple[tuple[float, ...], tuple[float, ...]]
    verdict: str

    def inverse(self) -> Witness:
        """Return the same with the maps the other way round."""
        return replace(self, values=self.values[::-1], rows=self.rows[::-1], at=self.at[::-1])


@dataclass(frozen=True)
class LandmarkEvidence:
    """The evidence of landmarks for a pose.

    Args:
        factors: kind -> alternative -> log of how many times as likely as by chance what was read is.
        witnesses: landmarks that agree, contradict, or stand elsewhere.
    """

    factors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    witnesses: tuple[Witness, ...] = ()

    @property
    def support(self) -> float:
        """Log odds of this place against one that has nothing to do with it."""
        return sum(f["here"] - f["outside"] for f in self.factors.values())

    def compute_likelihoods(self) -> dict[str, float]:
        """Compute the log-likelihood ratio of each alternative against this place, of all kinds."""
        return {name: sum(f[name] - f["here"] for f in self.factors.values()) for name in ALTERNATIVES}

    def apply(self, posterior: Mapping[str, float], rivals: Sequence[tuple[float, LandmarkEvidence]] = ()) -> dict[str, float]:
        """Return the posterior over `ALTERNATIVES` after what landmarks say, one factor a kind.

        Args:
            rivals: other poses, each with its share among them and what landmarks say of it: what "elsewhere" may be.
        """
        ratios = self.compute_likelihoods()
        own = sum(f["here"] for f in self.factors.values())
        named = [float(np.log(share / 2)) + sum(f["here"] for f in e.factors.values()) - own for share, e in rivals if share > 0]
        if named:
            ratios["elsewhere"] = float(np.logaddexp(ratios["elsewhere"] - np.log(2), max(named)))
        highest = max((ratios[name] for name in ALTERNATIVES if posterior[name] > 0), default=0.0)
        weight = {name: posterior[name] * float(np.exp(ratios[name] - highest)) for name in ALTERNATIVES}
        total = sum(weight.values())
        return {name: w / total for name, w in weight.items()} if total > 0 else dict(posterior)

    def inverse(self) -> LandmarkEvidence:
        """Return the same with the maps the other way round."""
        return replace(self, witnesses=tuple(w.inverse() for w in self.witnesses))

    def list_sentences(self) -> list[str]:
        """List what agrees and what contradicts, a sentence a kind; the last one tells where nothing contradicts at all."""
        by_kind = {kind: [w for w in self.witnesses if w.kind == kind] for kind in self.factors}
        sentences = [describe_witnesses(kind, of) or describe_factor(kind, self.factors[kind]) for kind, of in by_kind.items()]
        sentences = [text for text in sentences if text]
        verdicts = {w.verdict for of in by_kind.values() for w in of}
        against = any(max(f.values()) - f["here"] > TELLING for f in self.factors.values())
        if "agrees" in verdicts and "contradicts" not in verdicts and not against:
            sentences[-1] += "; nothing contradicts"
        return sentences

    def serialise(self) -> dict[str, Any]:
        """Return plain values, for merge.json."""
        return {
            "factors": {kind: {name: round(v, 4) for name, v in f.items()} for kind, f in self.factors.items()},
            "sentences": self.list_sentences(),
            "witnesses": [
                {"kind": w.kind, "verdict": w.verdict, "values": list(w.values), "rows": list(w.rows),
                 "at": [[None if v != v else round(v, 2) for v in at] for at in w.at]}
                for w in self.witnesses
            ],
        }  # fmt: skip


def describe_witnesses(kind: str, witnesses: Sequence[Witness], shown: int = 3) -> str:
    """Describe the landmarks of a kind: "signs 2.113 and 2.114 agree"; nothing where none testifies."""
    label = KINDS[kind].words if kind in KINDS else kind
    verdicts = ("agrees", "contradicts", "cut off", "elsewhere")
    agree, against, lost, away = ([w for w in witnesses if w.verdict == v] for v in verdicts)
    if not (agree or against or lost or away):
        return ""

    def name(listed: Sequence[Witness]) -> str:
        quoted = list(dict.fromkeys(quote_text(w.values[0]) for w in listed))
        if len(quoted) > shown:
            return f"{', '.join(quoted[:shown])} and {len(quoted) - shown} more"
        return " and ".join(filter(None, [", ".join(quoted[:-1]), quoted[-1]]))

    parts = []
    if agree:
        parts.append(f"{label}{'s' * (len(agree) > 1)} {name(agree)} agree{'s' * (len(agree) == 1)}")
    if against:
        pairs = ", ".join(f"{quote_text(w.values[0])} against {quote_text(w.values[1])}" for w in against[:shown])
        more = f" and {len(against) - shown} more" if len(against) > shown else ""
        parts.append(f"{label}s contradict: {pairs}{more}")
    if lost:
        pairs = ", ".join("{} may be {}".format(*map(quote_text, sorted(w.values, key=len))) for w in lost[:shown])
        more = f" and {len(lost) - shown} more" if len(lost) > shown else ""
        parts.append(f"{label}{'s' * (len(lost) > 1)} cut off: {pairs}{more}")
    if away:
        parts.append(f"{label}{'s' * (len(away) > 1)} {name(away)} stand{'s' * (len(away) == 1)} elsewhere in the other map")
    return "; ".join(parts)


def describe_factor(kind: str, factor: Mapping[str, float]) -> str:
    """Describe what a kind says as a whole, where no single landmark of it does: "radio speaks for the same place"; nothing where
    it hardly tells."""
    label = {"radio": "radio speaks", "pressure": "air pressure speaks"}.get(kind) or f"{KINDS[kind].words}s speak as a whole"
    best, next_best = sorted(factor, key=lambda name: -factor[name])[:2]
    if best == "here":
        return f"{label} for {WORDS[best]}" if factor[best] - factor[next_best] > TELLING else ""
    return f"{label} for {WORDS[best]}" if factor[best] - factor["here"] > TELLING else ""


class LandmarkScorer:
    """Scores poses of two maps by their landmarks; what is the same under each pose is computed once."""

    def __init__(self, a: TopometricMap, b: TopometricMap) -> None:
        self.a, self.b = a, b

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kinds that both maps have."""
        return tuple(kind for kind in SCORES if all(SCORES[kind].asks(m) for m in (self.a, self.b)))

    @cached_property
    def sightings(self) -> dict[str, tuple[Sightings, Sightings]]:
        """Of each kind of `KINDS` that both maps have."""
        of = {k: KINDS[k].kinds for k in self.kinds if k in KINDS}
        return {kind: (build_sightings(self.a, kinds), build_sightings(self.b, kinds)) for kind, kinds in of.items()}

    @cached_property
    def trees(self) -> tuple[cKDTree, cKDTree]:
        """The occupied cells of both maps, to ask what each has seen; of large maps every so many."""
        grids = [m.grid.compute_centroids() for m in (self.a, self.b)]
        return tuple(cKDTree(c[:: max(len(c) // 100_000, 1)]) for c in grids)  # type: ignore[return-value]

    @cached_property
    def around(self) -> dict[str, tuple[Array, Array]]:
        """Of each kind and map (n, SEEN_CELLS, 3) m, the cells around its landmarks, from these; nan: fewer."""
        return {
            kind: (_find_cells_around(a, self.trees[0]), _find_cells_around(b, self.trees[1]))
            for kind, (a, b) in self.sightings.items()
            if KINDS[kind].most_missed
        }

    def measure_seen(self, kind: str, side: int, at: Array, pose: Sim3) -> Array:
        """Measure (n,) the share of the cells around the landmarks of a map, at places of map a, that the other map has, too."""
        cells = self.around[kind][side]
        known = np.isfinite(cells[:, :, 0])
        rows, _ = np.nonzero(known)
        if side == 0:
            places, metre = pose.inverse().apply(at[rows] + cells[known]), pose.scale
        else:
            places, metre = at[rows] + pose.apply(cells[known]) - pose.apply(np.zeros((1, 3))), 1.0
        near = self.trees[1 - side].query(places)[0] * metre
        met = np.bincount(rows[near <= SEEN_WITHIN], minlength=len(cells))
        return np.asarray(met / np.maximum(known.sum(axis=1), 1))

    def score(self, pose: Sim3, bends: Bends = (None, None)) -> LandmarkEvidence:
        """Return what landmarks say of T_ab, of maps that are bent first."""
        factors, witnesses = {}, []
        for kind in self.kinds:
            factor, seen = SCORES[kind].score(self, pose, bends)
            if any(factor.values()):
                factors[kind] = factor
                witnesses += seen
        return LandmarkEvidence(factors, tuple(witnesses))


def _find_cells_around(sightings: Sightings, tree: cKDTree) -> Array:
    """Return (n, SEEN_CELLS, 3) m, the cells of a map around its landmarks, from these; nan where there are fewer."""
    out = np.full((len(sightings), SEEN_CELLS, 3), np.nan)
    placed = (sightings.sigma <= 1.0) & ~sightings.named & np.isfinite(sightings.position[:, 2])
    for k in np.flatnonzero(placed)[:MOST_ASKED].tolist():
        cells = tree.data[sorted(tree.query_ball_point(sightings.position[k], SEEN_AROUND))]
        cells = cells[np.linspace(0, len(cells) - 1, min(len(cells), SEEN_CELLS)).astype(int)]
        out[k, : len(cells)] = cells - sightings.position[k]
    return out


def score_landmarks(
    a: TopometricMap,
    b: TopometricMap,
    pose_b_to_a: Sim3,
    bends: Bends = (None, None),
) -> LandmarkEvidence:
    """Return what the landmarks of two maps say of where map b lies in map a.

    Args:
        a, b: maps with landmarks; of kinds that only one has nothing is said.
        pose_b_to_a: T_ab.
        bends: how each map is bent in its own frame before.
    """
    return LandmarkScorer(a, b).score(pose_b_to_a, bends)


def score_sightings(scorer: LandmarkScorer, pose: Sim3, bends: Bends, kind: str) -> tuple[dict[str, float], list[Witness]]:
    """Score landmarks that stand somewhere and say something: signs, tags, names and objects."""
    a, b = scorer.sightings[kind]
    rules = KINDS[kind]
    if not len(a) or not len(b):
        return dict.fromkeys(ALTERNATIVES, 0.0), []
    at = [s.position if bend is None else transform_places(bend.apply, s.position) for s, bend in zip((a, b), bends, strict=True)]
    at[1] = transform_places(pose.apply, at[1])
    met = associate_sightings(a, b, at, pose, kind)
    met = pick_partners(a, b, met, rules, kind)
    factors = compute_factors(a, b, met, rules, kind)
    if kind == "text":
        prefixes = compute_prefix_factors(a, b, met, at)
        factors = {name: v + prefixes[name] for name, v in factors.items()}
    far = find_far_partners(a, b, at, met, kind)
    factors["elsewhere"] += min(len(far) * float(-np.log(MISPLACED)), MOST_FAR)
    unread = count_unread(scorer, at, met, pose, (a, b)) if kind == "text" else 0.0
    for name in ("elsewhere", "building", "outside"):
        factors[name] += unread
    if rules.most_missed:
        missed = score_missed(scorer, at, met, pose, kind)
        factors = {name: v + missed * (name != "here") for name, v in factors.items()}
    if rules.least > -np.inf:
        factors["here"] = max(factors["here"], rules.least)
    return factors, _list_witnesses(a, b, met, far, rules, kind)


def find_far_partners(a: Sightings, b: Sightings, at: Sequence[Array], met: Associated, kind: str) -> list[tuple[int, int]]:
    """Find rare strings that stand once in each map, at places that are far from each other under the pose."""
    if kind not in ("text", "tag"):
        return []
    used = set(met.pairs[:, 0].tolist()), set(met.pairs[:, 1].tolist())
    once = []
    for s in (a, b):
        count: dict[str, int] = {}
        for key in s.keys:
            count[key] = count.get(key, 0) + 1
        once.append({key: k for k, key in enumerate(s.keys) if count[key] == 1 and (kind == "tag" or s.share[k] < RARE)})
    far = []
    for key in sorted(once[0].keys() & once[1].keys()):
        i, j = once[0][key], once[1][key]
        away = float(np.hypot(*(at[0][i] - at[1][j])[:2]))
        if i not in used[0] and j not in used[1] and away > FAR + GATE * (a.sigma[i] + b.sigma[j]):
            far.append((i, j))
    return far


def count_unread(
    scorer: LandmarkScorer, at: Sequence[Array], met: Associated, pose: Sim3, sightings: tuple[Sightings, Sightings]
) -> float:
    """Return the log odds for a place that has nothing to do with this one of signs that one map read and the other one could
    have seen and did not, as `READS` has it of maps that read equally many signs on equally large a map."""
    density = [len(s) / max(len(m.grid), 1) for s, m in zip(sightings, (scorer.a, scorer.b), strict=True)]
    back, total = pose.inverse(), 0.0
    for side in (0, 1):
        own, other = sightings[side], 1 - side
        free = np.setdiff1d(np.flatnonzero((own.sigma <= 1.0) & ~own.named & np.isfinite(at[side][:, 2])), met.pairs[:, side])
        if not len(free):
            continue
        places = at[side][free] if other == 0 else back.apply(at[side][free])
        seen = float((scorer.trees[other].query(places)[0] <= SEEN_WITHIN).sum())
        reads = READS * min(density[other] / density[side], 1.0)
        total += seen * float(np.log((1 - reads / 3) / (1 - reads)))
    return min(total, MOST_UNREAD)


def score_missed(scorer: LandmarkScorer, at: Sequence[Array], met: Associated, pose: Sim3, kind: str) -> float:
    """Return the log odds for another place of landmarks that one map has and the other one does not, though it saw the place.

    A landmark that both maps could read was read by the one, the other, or both. How many each reads of those in sight is not
    known (`RATES`), and told by those that both read. At another place the landmarks of each map have nothing to do with each
    other.
    """
    first, second = RATES[:, None], RATES[None]
    both = first + second - first * second  # probability that a landmark is in a map at all
    usual = len(met.pairs) * np.log(first * second / both)
    missed = np.zeros_like(usual)
    for side, misses in enumerate((1 - second, 1 - first)):
        seen = scorer.measure_seen(kind, side, at[side], pose)
        alone = np.setdiff1d(np.flatnonzero(seen > 0), met.pairs[:, side])
        missed += np.log1p(seen[alone, None, None] * (misses * (first + second) / both - 1)).sum(axis=0)
    total = np.logaddexp.reduce(usual, axis=None) - np.logaddexp.reduce(usual + missed, axis=None)
    return float(np.clip(total, 0.0, KINDS[kind].most_missed))


def _list_witnesses(
    a: Sightings, b: Sightings, met: Associated, far: Sequence[tuple[int, int]], rules: Kind, kind: str
) -> list[Witness]:
    share, keys = compute_shares(a, b, met.pairs), [(a.keys[i], b.keys[j]) for i, j in met.pairs.tolist()]
    numbers = a.numbered[met.pairs[:, 0]] & b.numbered[met.pairs[:, 1]]
    probability = np.clip(compute_chances(a, b, met.pairs, keys, numbers) / share, 1.0, rules.most)
    out = []
    for k, (i, j) in enumerate(met.pairs.tolist()):
        times = sum(weight * score_pair(*keys[k], error, kind) / share[k] for error, weight in READERS)
        sure = max(a.sigma[i], b.sigma[j]) <= rules.surest
        if met.turned[k] or (sure and times < probability[k] / 2):
            same = kind == "text" and not met.turned[k]
            if same and is_misread(*keys[k]):
                continue
            lost = same and is_cut_off(*keys[k])
            out.append(_build_witness(a, b, i, j, kind, "cut off" if lost else "contradicts"))
        elif times > 2 * (1.0 if keys[k][0] == keys[k][1] else probability[k]):
            out.append(_build_witness(a, b, i, j, kind, "agrees"))
    return out + [_build_witness(a, b, i, j, kind, "elsewhere") for i, j in far]


def _build_witness(a: Sightings, b: Sightings, i: int, j: int, kind: str, verdict: str) -> Witness:
    at = tuple(a.position[i].tolist()), tuple(b.position[j].tolist())
    return Witness(kind, (a.values[i], b.values[j]), (int(a.rows[i]), int(b.rows[j])), at, verdict)


Score = Callable[[LandmarkScorer, Sim3, Bends], tuple[dict[str, float], list[Witness]]]


@dataclass(frozen=True)
class Testimony:
    """How landmarks of a kind are scored.

    Args:
        asks: has a map any of the kind?
        score: scorer, T_ab and how the maps are bent -> log-likelihood of each alternative, and the landmarks that testify.
    """

    asks: Callable[[TopometricMap], bool]
    score: Score


def _build_testimony(kind: str) -> Testimony:
    def score(scorer: LandmarkScorer, pose: Sim3, bends: Bends) -> tuple[dict[str, float], list[Witness]]:
        return score_sightings(scorer, pose, bends, kind)

    return Testimony(lambda map: bool(map.landmarks.is_kind(*KINDS[kind].kinds).any()), score)


def score_radio_testimony(scorer: LandmarkScorer, pose: Sim3, bends: Bends) -> tuple[dict[str, float], list[Witness]]:
    """Score readings of radio, against another building's, which say the same under every pose."""
    return _compare_with_building(score_radio(scorer.a, scorer.b, pose)), []


def score_pressure_testimony(scorer: LandmarkScorer, pose: Sim3, bends: Bends) -> tuple[dict[str, float], list[Witness]]:
    """Score readings of air pressure."""
    return _compare_with_building(score_pressure(scorer.a, scorer.b, pose)), []


def _compare_with_building(scores: Mapping[str, float]) -> dict[str, float]:
    return {name: scores[name] - scores["building"] for name in ALTERNATIVES}


SCORES = {kind: _build_testimony(kind) for kind in KINDS} | {
    "radio": Testimony(lambda map: bool(map.landmarks.is_kind("radio").any()), score_radio_testimony),
    "pressure": Testimony(lambda map: bool(map.landmarks.is_kind("pressure").any()), score_pressure_testimony),
}  # a further kind is a line here
