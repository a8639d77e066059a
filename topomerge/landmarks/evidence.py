"""What landmarks of two maps say of a pose: a likelihood of each named alternative (issue 51).

Generative assumptions. Each is a number below, stated and not fitted.

- *Here* (the pose is right): where both maps read a sign at one place, both are readings of one string (`text.score_reading`),
  unless the sign was changed in between (`Kind.changed`) or they are two signs side by side. As a whole, the signs of a building
  are all new with `RENEWED`.
- *Any alternative*: a sign at the same place bears a string drawn as often as it stands in these maps and in buildings at large
  (`text.estimate_share`), or a number near the other one. As a whole, the other place repeats all strings of this one with
  `Kind.repeats` (wings that are numbered alike, tags printed from one sheet), or all of its numbers differ by one shift, as
  storeys and wings do.
- How well the readers read is not known, and shared by all signs of the pair: `READERS`.
- A rare string that both maps read at two places far from each other under the pose speaks for another pose, unless it points
  there (`POINTS_THERE`).
- A sign that the other map could have seen and did not read says little (`READS`).

So that no single landmark carries a merge, one agreeing landmark counts `Kind.most` times at most, and all together no more than
one in `Kind.repeats`. The same holds in the limit for robust mixtures in SLAM (Olson and Agarwal 2013, "Inference on networks of
mixtures for robust robot mapping").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.landmarks.sightings import Sightings, build_sightings
from topomerge.landmarks.text import (
    Shift,
    find_shifts,
    is_common,
    quote_text,
    score_neighbour,
    score_reading,
    score_shifted,
)
from topomerge.types import Array, Deformation, Sim3, TopometricMap

ALTERNATIVES = ("here", "elsewhere", "storey", "half", "wing", "building", "outside")
READERS = ((0.002, 0.4), (0.02, 0.3), (0.08, 0.2), (0.2, 0.1))  # error of a character, and how many readers err so
RENEWED = 0.003
SHIFTS = 30.0  # ways in which numbers may be shifted
SHIFTED = {"elsewhere": 0.4, "storey": 0.7, "half": 0.5, "wing": 0.6, "building": 0.2, "outside": 0.2}  # share of such places
NEAR = {"elsewhere": 0.5, "storey": 0.8, "half": 0.5, "wing": 0.6, "building": 0.3, "outside": 0.3}  # numbers near the other's
READS = 0.6  # probability that a map that reads as many signs as the other one reads a sign that it could have seen
MOST_MISSED = 1.0  # log odds that unread signs may cost in all
WORDS_CHANGED = 0.2  # probability that a sign without a number was changed: notices, names of people
TURNED_BY, TURNED = np.radians(60.0), 0.1  # rad by which two headings of one landmark do not differ; times as likely if they do
POINTS_THERE = 0.1  # probability that a rare string far from its place points there, or was put in a wrong place
FAR, MOST_FAR = 6.0, 6.0  # m beyond which two places are two, and log odds that such strings may give in all
RARE = 0.01  # share of the signs, below which a string names one place
PRIOR_SIGNS = 2.0  # signs that weigh as much as what is known of buildings at large
POSE_SIGMA, DRIFT_SIGMA = 0.3, 0.4  # m
GATE = 2.5  # standard deviations within which two signs may be one
STOREY_GATE = 1.9  # m of height
SIDE_BY_SIDE = (0.05, 0.5)  # probability that two signs are two, of which each map missed one: at one point, and at the gate
MOST_PAIRS = 4000  # of landmarks that are compared under a pose
SEEN_WITHIN = 0.6  # m from an occupied cell of the other map: the place is seen
DOUBTED = 0.5  # of what a reader is unsure of, that is nothing like what stands there


@dataclass(frozen=True)
class Kind:
    """What is assumed of landmarks of a kind.

    Args:
        kinds: of both maps that are compared.
        changed: probability that one was changed between two visits.
        repeats: probability that all landmarks of an alternative say what those here say.
        most: times that one landmark may count.
        surest: m, sigma up to which a place is sure enough that another landmark at it contradicts.
        words: one of them, in words.
    """

    kinds: tuple[str, ...]
    changed: float
    repeats: Mapping[str, float]
    most: float
    surest: float
    words: str
    least: float = -np.inf  # log odds that all may cost


def _repeats(elsewhere: float, storey: float, half: float, wing: float, building: float, outside: float) -> dict[str, float]:
    return dict(zip(ALTERNATIVES[1:], (elsewhere, storey, half, wing, building, outside), strict=True))


KINDS = {
    "text": Kind(("text", "name"), 0.02, _repeats(0.005, 0.02, 0.01, 0.02, 0.02, 0.005), 50.0, 1.5, "sign"),
    "tag": Kind(("tag",), 0.02, _repeats(0.002, 0.003, 0.003, 0.003, 0.02, 0.003), 500.0, 1.5, "tag"),
    "name": Kind(("name",), 0.2, _repeats(0.02, 0.1, 0.1, 0.1, 0.05, 0.02), 8.0, 4.0, "room name", -2.0),
    "object": Kind(("object",), 0.5, _repeats(0.1, 0.2, 0.2, 0.2, 0.1, 0.1), 3.0, 1.0, "object", -2.0),
}


@dataclass(frozen=True)
class Witness:
    """Two landmarks that say something of a pose together.

    Args:
        kind: of `KINDS`.
        values: what stands in map a and in map b.
        rows: of the tables of both.
        at: place in the frame of each map, m.
        verdict: "agrees", "contradicts", or "elsewhere": the same string, far away.
    """

    kind: str
    values: tuple[str, str]
    rows: tuple[int, int]
    at: tuple[tuple[float, ...], tuple[float, ...]]
    verdict: str

    def inverse(self) -> Witness:
        """The same with the maps the other way round."""
        return replace(self, values=self.values[::-1], rows=self.rows[::-1], at=self.at[::-1])


@dataclass(frozen=True)
class LandmarkEvidence:
    """What landmarks say of a pose.

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
        """Log-likelihood ratio of each alternative against this place, of all kinds."""
        return {name: sum(f[name] - f["here"] for f in self.factors.values()) for name in ALTERNATIVES}

    def apply(self, posterior: Mapping[str, float]) -> dict[str, float]:
        """Return the posterior over `ALTERNATIVES` after what landmarks say, one factor a kind."""
        ratios = self.compute_likelihoods()
        highest = max((ratios[name] for name in ALTERNATIVES if posterior[name] > 0), default=0.0)
        weight = {name: posterior[name] * float(np.exp(ratios[name] - highest)) for name in ALTERNATIVES}
        total = sum(weight.values())
        return {name: w / total for name, w in weight.items()} if total > 0 else dict(posterior)

    def inverse(self) -> LandmarkEvidence:
        """The same with the maps the other way round."""
        return replace(self, witnesses=tuple(w.inverse() for w in self.witnesses))

    def list_sentences(self) -> list[str]:
        """What agrees and what contradicts, a sentence a kind."""
        return [s for kind in self.factors if (s := describe_witnesses(kind, [w for w in self.witnesses if w.kind == kind]))]

    def serialise(self) -> dict[str, Any]:
        """As plain values, for merge.json."""
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
    """Describe the landmarks of a kind: "signs 2.113 and 2.114 agree; nothing contradicts"; nothing where none testifies."""
    words = KINDS[kind].words if kind in KINDS else kind
    agree, against, away = ([w for w in witnesses if w.verdict == v] for v in ("agrees", "contradicts", "elsewhere"))
    if not (agree or against or away):
        return ""

    def name(listed: Sequence[Witness]) -> str:
        quoted = list(dict.fromkeys(quote_text(w.values[0]) for w in listed))
        if len(quoted) > shown:
            return f"{', '.join(quoted[:shown])} and {len(quoted) - shown} more"
        return " and ".join(filter(None, [", ".join(quoted[:-1]), quoted[-1]]))

    parts = []
    if agree:
        parts.append(f"{words}{'s' * (len(agree) > 1)} {name(agree)} agree{'s' * (len(agree) == 1)}")
    if against:
        pairs = ", ".join(f"{quote_text(w.values[0])} against {quote_text(w.values[1])}" for w in against[:shown])
        more = f" and {len(against) - shown} more" if len(against) > shown else ""
        parts.append(f"{words}s contradict: {pairs}{more}")
    elif agree:
        parts.append("nothing contradicts")
    if away:
        parts.append(f"{words}{'s' * (len(away) > 1)} {name(away)} stand{'s' * (len(away) == 1)} elsewhere in the other map")
    return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class _Associated:
    """Sightings of both maps at one place.

    Args:
        pairs: (p, 2) their numbers.
        apart: (p,) how far apart, as a share of the gate.
        crowd: (p,) how many could be it.
        turned: (p,) bool: they face ways that differ.
    """

    pairs: Array
    apart: Array
    crowd: Array
    turned: Array

    def select(self, rows: Array) -> _Associated:
        """Return some of the pairs, by their numbers."""
        chosen = np.asarray(rows, np.int64)
        return _Associated(self.pairs[chosen], self.apart[chosen], self.crowd[chosen], self.turned[chosen])


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

    def score(self, pose: Sim3, bends: tuple[Deformation | None, Deformation | None] = (None, None)) -> LandmarkEvidence:
        """Return what landmarks say of T_ab, of maps that are bent first."""
        factors, witnesses = {}, []
        for kind in self.kinds:
            factor, seen = SCORES[kind].score(self, pose, bends)
            if any(factor.values()):
                factors[kind] = factor
                witnesses += seen
        return LandmarkEvidence(factors, tuple(witnesses))


def score_landmarks(
    a: TopometricMap,
    b: TopometricMap,
    pose_b_to_a: Sim3,
    bends: tuple[Deformation | None, Deformation | None] = (None, None),
) -> LandmarkEvidence:
    """Return what the landmarks of two maps say of where map b lies in map a.

    Args:
        a, b: maps with landmarks; of kinds that only one has nothing is said.
        pose_b_to_a: T_ab.
        bends: how each map is bent in its own frame before.
    """
    return LandmarkScorer(a, b).score(pose_b_to_a, bends)


def score_sightings(
    scorer: LandmarkScorer, pose: Sim3, bends: tuple[Deformation | None, Deformation | None], kind: str
) -> tuple[dict[str, float], list[Witness]]:
    """Score landmarks that stand somewhere and say something: signs, tags, names and objects."""
    a, b = scorer.sightings[kind]
    rules = KINDS[kind]
    if not len(a) or not len(b):
        return dict.fromkeys(ALTERNATIVES, 0.0), []
    at = [s.position if bend is None else _bend(bend, s.position) for s, bend in zip((a, b), bends, strict=True)]
    at[1] = pose.apply(at[1])
    met = associate_sightings(a, b, at, pose, kind)
    met = pick_partners(a, b, met, rules, kind)
    factors = compute_factors(a, b, met, rules, kind)
    far = find_far_partners(a, b, at, met, kind)
    factors["elsewhere"] += min(len(far) * float(-np.log(POINTS_THERE)), MOST_FAR)
    missed = count_missed(scorer, at, met, pose, (a, b)) if kind == "text" else 0.0
    for name in ("elsewhere", "building", "outside"):
        factors[name] += missed
    if rules.least > -np.inf:
        factors["here"] = max(factors["here"], rules.least)
    return factors, _list_witnesses(a, b, met, far, rules, kind)


def _bend(bend: Deformation, position: Array) -> Array:
    flat = np.isnan(position[:, 2])
    known = np.where(np.isnan(position), 0.0, position)
    moved = bend.apply(known)
    moved[flat, 2] = np.nan
    return moved


def associate_sightings(a: Sightings, b: Sightings, at: Sequence[Array], pose: Sim3, kind: str) -> _Associated:
    """Find sightings of both maps that may be one: within `GATE` of their uncertainty, and on one storey.

    Args:
        at: positions (n, 3) and (m, 3) of both, in one frame.
    """
    sigma = np.sqrt(a.sigma[:, None] ** 2 + (pose.scale * b.sigma[None]) ** 2 + POSE_SIGMA**2 + DRIFT_SIGMA**2)
    apart = np.hypot(at[0][:, None, 0] - at[1][None, :, 0], at[0][:, None, 1] - at[1][None, :, 1]) / (GATE * sigma)
    level = np.abs(at[0][:, None, 2] - at[1][None, :, 2])
    near = (apart <= 1.0) & ~(level > STOREY_GATE)
    if kind in ("text", "name"):  # of two names, those with numbers are read as signs are
        rooms = a.named[:, None] & b.named[None] & ~(a.numbered[:, None] & b.numbered[None])
        near &= rooms if kind == "name" else ~rooms
    pairs = np.argwhere(near)
    crowd = np.maximum(near.sum(axis=1)[pairs[:, 0]], near.sum(axis=0)[pairs[:, 1]])
    turn = a.heading[pairs[:, 0]] - b.heading[pairs[:, 1]] - pose.yaw
    with np.errstate(invalid="ignore"):
        turned = np.abs(np.angle(np.exp(1j * turn))) > TURNED_BY
    return _Associated(pairs, apart[near], crowd, turned & (kind in ("text", "tag")))


def pick_partners(a: Sightings, b: Sightings, met: _Associated, rules: Kind, kind: str) -> _Associated:
    """Pick of the sightings that may be one a partner of each, the likeliest first; those without one of a like kind drop out."""
    if len(met.pairs) > MOST_PAIRS:
        met = met.select(np.argsort(met.apart, kind="stable")[:MOST_PAIRS])
    middle = READERS[2][0]
    reading = np.array([score_pair(a.keys[i], b.keys[j], middle, kind) for i, j in met.pairs.tolist()])
    same = reading * (1 - met.apart / 4)
    keys = [sorted((a.keys[i], b.keys[j])) for i, j in met.pairs.tolist()]
    order = sorted(range(len(keys)), key=lambda k: (-same[k], met.apart[k], keys[k]))
    taken: tuple[set[int], set[int]] = set(), set()
    chosen = []
    for k in order:
        i, j = met.pairs[k].tolist()
        alike = reading[k] > 1e-3
        sure = max(a.sigma[i], b.sigma[j]) <= rules.surest and (kind != "text" or a.numbered[i] == b.numbered[j])
        if i in taken[0] or j in taken[1] or not (alike or sure):
            continue
        taken[0].add(i)
        taken[1].add(j)
        chosen.append(k)
    return met.select(np.array(chosen))


def score_pair(one: str, other: str, error: float, kind: str) -> float:
    """Return the probability that one landmark, given as `one`, is given as `other` by another reader; in any order."""
    if kind in ("text", "name"):
        return score_reading(one, other, error)
    return 0.9 if one == other else 1e-4 if kind == "tag" else 0.01


def compute_shares(a: Sightings, b: Sightings, pairs: Array) -> Array:
    """Return (p,) how often the strings of pairs stand in these maps, but for the pair itself, and in buildings at large."""
    count: dict[str, int] = {}
    for key in (*a.keys, *b.keys):
        count[key] = count.get(key, 0) + 1
    total = len(a) + len(b) - 2
    out = []
    for i, j in pairs.tolist():
        here = [(a.share[i], a.keys[i]), (b.share[j], b.keys[j])]
        own = 2 if here[0][1] == here[1][1] else 1
        out.append(max((PRIOR_SIGNS * share + count[key] - own) / (PRIOR_SIGNS + total) for share, key in here))
        out[-1] = max(out[-1], min(here[0][0], here[1][0]) / 4)
    return np.minimum(np.array(out, float), 1.0)


def compute_factors(a: Sightings, b: Sightings, met: _Associated, rules: Kind, kind: str) -> dict[str, float]:
    """Compute the log-likelihood of each alternative by sightings at one place, against that of strings drawn by chance."""
    if not len(met.pairs):
        return dict.fromkeys(ALTERNATIVES, 0.0)
    i, j = met.pairs.T
    keys = [(a.keys[p], b.keys[q]) for p, q in met.pairs.tolist()]
    share = compute_shares(a, b, met.pairs)
    sure = 1 - DOUBTED * (1 - a.confidence[i] * b.confidence[j])
    beside = SIDE_BY_SIDE[0] + (SIDE_BY_SIDE[1] - SIDE_BY_SIDE[0]) * met.apart**2
    numbers = a.numbered[i] & b.numbered[j]
    changed = np.where(numbers | (kind != "text"), rules.changed, max(rules.changed, WORDS_CHANGED))
    stays = (1 - changed) * (1 - beside) * sure

    def read(reading: Sequence[float]) -> float:
        times = np.where(met.turned, TURNED, np.minimum(np.array(reading) / (share * met.crowd), rules.most))
        return float(np.log(stays * times + 1 - stays).sum())

    alike = np.minimum(compute_chances(a, b, met.pairs, keys, numbers) / share, rules.most)
    equal = np.array([one == other for one, other in keys])
    shifts = _count_shifts(keys, numbers)
    parts: dict[str, list[float]] = {name: [] for name in ALTERNATIVES}
    for error, weight in READERS:
        same = read([score_pair(s, t, error, kind) for s, t in keys])
        moved = [read([score_shifted(s, t, shift, error) for s, t in keys]) for shift in shifts]
        chance = {name: float(np.log(1 - near + near * np.maximum(alike, equal)).sum()) for name, near in NEAR.items()}
        parts["here"].append(np.log(weight) + np.logaddexp(np.log1p(-RENEWED) + same, np.log(RENEWED) + chance["wing"]))
        for name in ALTERNATIVES[1:]:
            repeats, shifted = rules.repeats[name], SHIFTED[name] if shifts else 0.0
            terms = [np.log(1 - repeats - shifted * (1 - repeats)) + chance[name], np.log(repeats) + same]
            terms += [np.log(shifted * (1 - repeats) / SHIFTS) + m for m in moved]
            parts[name].append(np.log(weight) + float(np.logaddexp.reduce(terms)))
    return {name: float(np.logaddexp.reduce(values)) for name, values in parts.items()}


def compute_chances(a: Sightings, b: Sightings, pairs: Array, keys: Sequence[tuple[str, str]], numbers: Array) -> Array:
    """Return (p,) the probability that a place that looks like this one has the string of b where this one has that of a.

    It is a number near it, or the same word where the word stands in every building.
    """
    out = []
    for (i, j), (one, other), number in zip(pairs.tolist(), keys, numbers.tolist(), strict=True):
        common = one == other and not number and (is_common(a.values[i]) or is_common(b.values[j]))
        out.append(score_neighbour(one, other) if number else float(common))
    return np.array(out, float)


def _count_shifts(keys: Sequence[tuple[str, str]], numbers: Array, most: int = 3) -> list[Shift]:
    """The shifts that turn most numbers of a into those of b."""
    count: dict[Shift, int] = {}
    for (one, other), number in zip(keys, numbers.tolist(), strict=True):
        for shift in find_shifts(one, other) if number else ():
            count[shift] = count.get(shift, 0) + 1
    return sorted(count, key=lambda s: (-count[s], s[0], abs(s[1]), sorted(s[2])))[:most]


def find_far_partners(a: Sightings, b: Sightings, at: Sequence[Array], met: _Associated, kind: str) -> list[tuple[int, int]]:
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


def count_missed(
    scorer: LandmarkScorer, at: Sequence[Array], met: _Associated, pose: Sim3, sightings: tuple[Sightings, Sightings]
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
    return min(total, MOST_MISSED)


def _list_witnesses(
    a: Sightings, b: Sightings, met: _Associated, far: Sequence[tuple[int, int]], rules: Kind, kind: str
) -> list[Witness]:
    share = compute_shares(a, b, met.pairs)
    out = []
    for k, ((i, j), rarity) in enumerate(zip(met.pairs.tolist(), share.tolist(), strict=True)):
        times = [score_pair(a.keys[i], b.keys[j], error, kind) / rarity for error, _ in READERS]
        if met.turned[k]:
            out.append(_build_witness(a, b, i, j, kind, "contradicts"))
        elif max(times) > 2.0 and (a.keys[i] == b.keys[j] or times[2] > 2.0):
            out.append(_build_witness(a, b, i, j, kind, "agrees"))
        elif max(times[:3]) < 0.5 and max(a.sigma[i], b.sigma[j]) <= rules.surest:
            out.append(_build_witness(a, b, i, j, kind, "contradicts"))
    return out + [_build_witness(a, b, i, j, kind, "elsewhere") for i, j in far]


def _build_witness(a: Sightings, b: Sightings, i: int, j: int, kind: str, verdict: str) -> Witness:
    at = tuple(a.position[i].tolist()), tuple(b.position[j].tolist())
    return Witness(kind, (a.values[i], b.values[j]), (int(a.rows[i]), int(b.rows[j])), at, verdict)


Score = Callable[[LandmarkScorer, Sim3, tuple[Deformation | None, Deformation | None]], tuple[dict[str, float], list[Witness]]]


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
    def score(
        scorer: LandmarkScorer, pose: Sim3, bends: tuple[Deformation | None, Deformation | None]
    ) -> tuple[dict[str, float], list[Witness]]:
        return score_sightings(scorer, pose, bends, kind)

    return Testimony(lambda map: bool(map.landmarks.is_kind(*KINDS[kind].kinds).any()), score)


SCORES = {kind: _build_testimony(kind) for kind in KINDS}  # a further kind is a line here
