"""Likelihood of landmarks at one place under each named alternative (issue 51).

Generative assumptions. Each is a number below, stated and not fitted.

- *Here* (the pose is right): where both maps read a sign at one place, both are readings of one string (`text.score_reading`),
  unless the sign was changed in between (`Kind.changed`) or they are two signs side by side. As a whole, the signs of a building
  are all new, or all numbers shifted, with `RENEWED`.
- *Any alternative*: a sign at the same place bears a string drawn as often as it stands in these maps and in buildings at large
  (`text.estimate_share`), or a number near the other one. As a whole, the other place repeats all strings of this one with
  `Kind.repeats` (wings that are numbered alike, tags printed from one sheet), or all of its numbers differ by one shift, as
  storeys and wings do.
- A tag that the other map saw the place of and does not have was missed by its reader, if the pose is right; how many tags of
  those in sight each reader finds is not known (`evidence.RATES`).
- How well the readers read is not known, and shared by all signs of the pair: `READERS`.

So that no single landmark carries a merge, one agreeing landmark counts `Kind.most` times at most, and all together no more than
one in `Kind.repeats`. The same holds in the limit for robust mixtures in SLAM (Olson and Agarwal 2013, "Inference on networks of
mixtures for robust robot mapping").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.landmarks.sightings import TURNED_BY, Sightings
from topomerge.landmarks.text import (
    Shift,
    find_shifts,
    is_common,
    is_leading,
    score_neighbour,
    score_reading,
    score_shifted,
)
from topomerge.types import Array, Sim3

WORDS = {
    "here": "the same place",
    "elsewhere": "another place in these maps",
    "storey": "another storey with the same plan",
    "half": "the other half of the building, which half a turn lays on this one",
    "wing": "a wing, module or room that looks the same",
    "building": "another building",
    "outside": "a place outside the other map",
}
ALTERNATIVES = tuple(WORDS)
READERS = ((0.002, 0.4), (0.02, 0.3), (0.08, 0.2), (0.2, 0.1))  # error of a character, and how many readers err so
RENEWED = 0.003
# Share of the shifted numbers that are shifted just so: a character that tells the storey or the wing, the count, anything else.
LEADING = {"storey": 0.1, "wing": 0.06}
COUNTED = {"elsewhere": 0.04, "half": 0.04, "wing": 0.04}
OTHERWISE = 0.01
SHIFTED = {"elsewhere": 0.4, "storey": 0.7, "half": 0.5, "wing": 0.6, "building": 0.2, "outside": 0.2}  # share of such places
NEAR = {"elsewhere": 0.5, "storey": 0.8, "half": 0.5, "wing": 0.6, "building": 0.3, "outside": 0.3}  # numbers near the other's
WORDS_CHANGED = 0.2  # probability that a sign without a number was changed: notices, names of people
TURNED = 0.1  # times as likely are two readings of one landmark whose headings differ
PRIOR_SIGNS = 2.0  # signs that weigh as much as what is known of buildings at large
POSE_SIGMA, DRIFT_SIGMA = 0.3, 0.4  # m
GATE = 2.5  # standard deviations within which two signs may be one
STOREY_GATE = 1.9  # m of height
SIDE_BY_SIDE = (0.05, 0.5)  # probability that two signs are two, of which each map missed one: at one point, and at the gate
SAME_PREFIX = {"here": 0.95, "elsewhere": 0.9, "storey": 0.05, "half": 0.9, "wing": 0.6, "building": 0.3, "outside": 0.5}
ONE_STYLE, PREFIX_READ, LONG_NUMBER = 0.8, 0.8, 3  # share of buildings with such numbers, that a character is right, characters
MOST_PREFIXES = 100  # numbers of a map that are asked how they begin
MOST_PAIRS = 4000  # of landmarks that are compared under a pose
DOUBTED = 0.5  # of what a reader is unsure of, that is nothing like what stands there


@dataclass(frozen=True)
class Kind:
    """Assumptions about landmarks of a kind.

    Args:
        kinds: of both maps that are compared.
        changed: probability that one was changed between two visits.
        repeats: probability that all landmarks of an alternative say what those here say.
        most: times that one landmark may count.
        surest: m, sigma up to which a place is sure enough that another landmark at it contradicts.
        words: one of them, in words.
        least: log odds that all may cost.
        most_missed: log odds that those may cost which one map has and the other one, which saw the place, has not. Tags hang
            anywhere; doors bear signs at every place that looks alike.
    """

    kinds: tuple[str, ...]
    changed: float
    repeats: Mapping[str, float]
    most: float
    surest: float
    words: str
    least: float = -np.inf
    most_missed: float = 0.0


def _repeats(elsewhere: float, storey: float, half: float, wing: float, building: float, outside: float) -> dict[str, float]:
    return dict(zip(ALTERNATIVES[1:], (elsewhere, storey, half, wing, building, outside), strict=True))


KINDS = {
    "text": Kind(("text", "name"), 0.02, _repeats(0.005, 0.02, 0.01, 0.02, 0.02, 0.005), 50.0, 1.5, "sign"),
    "tag": Kind(("tag",), 0.02, _repeats(0.002, 0.003, 0.003, 0.003, 0.02, 0.003), 500.0, 1.5, "tag", most_missed=6.0),
    "name": Kind(("name",), 0.2, _repeats(0.02, 0.1, 0.1, 0.1, 0.05, 0.02), 8.0, 4.0, "room name", -2.0),
    "object": Kind(("object",), 0.5, _repeats(0.1, 0.2, 0.2, 0.2, 0.1, 0.1), 3.0, 1.0, "object", -2.0),
}


@dataclass(frozen=True, eq=False)
class Associated:
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

    def select(self, rows: Array) -> Associated:
        """Return some of the pairs, by their numbers."""
        chosen = np.asarray(rows, np.int64)
        return Associated(self.pairs[chosen], self.apart[chosen], self.crowd[chosen], self.turned[chosen])


def associate_sightings(a: Sightings, b: Sightings, at: Sequence[Array], pose: Sim3, kind: str) -> Associated:
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
    return Associated(pairs, apart[near], crowd, turned & (kind in ("text", "tag")))


def pick_partners(a: Sightings, b: Sightings, met: Associated, rules: Kind, kind: str) -> Associated:
    """Pick, of the sightings that may be one, a partner of each, the likeliest first; those without one of a like kind drop
    out."""
    if len(met.pairs) > MOST_PAIRS:
        met = met.select(np.argsort(met.apart, kind="stable")[:MOST_PAIRS])
    middle = READERS[2][0]
    reading = np.array([score_pair(a.keys[i], b.keys[j], middle, kind) for i, j in met.pairs.tolist()])
    same = reading * (1 - met.apart / 4) * np.where(met.turned, TURNED, 1.0)  # of a room with two doors, the one of this door
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


def compute_factors(a: Sightings, b: Sightings, met: Associated, rules: Kind, kind: str) -> dict[str, float]:
    """Compute the log-likelihood of each alternative by sightings at one place, against that of strings drawn by chance."""
    if not len(met.pairs):
        return dict.fromkeys(ALTERNATIVES, 0.0)
    i, j = met.pairs.T
    keys = [(a.keys[p], b.keys[q]) for p, q in met.pairs.tolist()]
    share = compute_shares(a, b, met.pairs)
    sure = 1 - DOUBTED * (1 - a.confidence[i] * b.confidence[j])
    proximity = SIDE_BY_SIDE[0] + (SIDE_BY_SIDE[1] - SIDE_BY_SIDE[0]) * met.apart**2
    numbers = a.numbered[i] & b.numbered[j]
    changed = np.where(numbers | (kind != "text"), rules.changed, max(rules.changed, WORDS_CHANGED))
    stays = (1 - changed) * (1 - proximity) * sure

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
        probability = {name: float(np.log(1 - near + near * np.maximum(alike, equal)).sum()) for name, near in NEAR.items()}
        kept = [np.log1p(-RENEWED) + same, np.log(RENEWED / 2) + probability["wing"]]
        kept += [np.log(RENEWED / 2 * OTHERWISE) + m for m in moved]
        parts["here"].append(np.log(weight) + float(np.logaddexp.reduce(kept)))
        for name in ALTERNATIVES[1:]:
            repeats, shifted = rules.repeats[name], SHIFTED[name] if shifts else 0.0
            terms = [np.log(1 - repeats - shifted * (1 - repeats)) + probability[name], np.log(repeats) + same]
            tables = [(LEADING if is_leading(s) else COUNTED if s[0] == "count" else {}).get(name, OTHERWISE) for s in shifts]
            terms += [np.log(shifted * (1 - repeats) * way) + m for way, m in zip(tables, moved, strict=True)]
            parts[name].append(np.log(weight) + float(np.logaddexp.reduce(terms)))
    return {name: float(np.logaddexp.reduce(values)) for name, values in parts.items()}


def compute_prefix_factors(a: Sightings, b: Sightings, met: Associated, at: Sequence[Array]) -> dict[str, float]:
    """Compute the log-likelihood of each alternative by how the numbers begin that only one map read.

    Numbers of one storey begin with its digit or the wing's letter (`ONE_STYLE`), and of two storeys with two (`SAME_PREFIX`).
    Nothing is said of maps whose signs lie on several storeys.
    """
    first: list[list[str]] = []
    heights: list[float] = []
    for side, own in enumerate((a, b)):
        free = np.setdiff1d(np.flatnonzero(own.numbered & np.isfinite(at[side][:, 2])), met.pairs[:, side]).tolist()
        free = [k for k in free if len(own.keys[k]) >= LONG_NUMBER][:MOST_PREFIXES]
        first.append([own.keys[k][0] for k in free])
        heights += at[side][free, 2].tolist()
    if not all(first) or np.ptp(heights) > STOREY_GATE:
        return dict.fromkeys(ALTERNATIVES, 0.0)
    letters = sorted({*"0123456789", *first[0], *first[1]})
    wrong = (1 - PREFIX_READ) / (len(letters) - 1)
    fits = [np.array([np.prod([PREFIX_READ if c == p else wrong for c in of]) for p in letters]) for of in first]
    same = float((fits[0] * fits[1]).mean())
    other = (float(fits[0].mean() * fits[1].mean()) * len(letters) - same) / (len(letters) - 1)
    drawn = (1 - ONE_STYLE) * len(letters) ** -float(len(heights))
    parts = {name: np.log(ONE_STYLE * (share * same + (1 - share) * other) + drawn) for name, share in SAME_PREFIX.items()}
    return {name: float(part - parts["outside"]) for name, part in parts.items()}


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
    """List the shifts that turn most numbers of a into those of b: `most`, and one that is as good as the last of them
    backwards."""
    count: dict[Shift, int] = {}
    for (one, other), number in zip(keys, numbers.tolist(), strict=True):
        for shift in find_shifts(one, other) if number else ():
            count[shift] = count.get(shift, 0) + 1

    def rank(shift: Shift) -> tuple[int, str, int, list[str]]:
        return -count[shift], shift[0], abs(shift[1]), sorted(shift[2])  # the same for both orders of the maps

    ranked = sorted(count, key=rank)
    return [shift for shift in ranked if rank(shift) <= rank(ranked[min(most, len(ranked)) - 1])]
