"""How far a link between two components is believed: all that the pairs of their maps show, weighed once (method 4; ADR 22).

A link says where one component lies in another. Each pair of maps across the two is a source of evidence: it names placements
with the probabilities of its own registration. A third map that lies in neither component is a source, too, as its registrations
with both maps of the link name placements. The link is weighed against each rival placement that any source names, and against
none:

- Of sources that name both placements, or were never registered, the strongest one counts. A look-alike is one to all maps that
  see it, so that the others repeat what it says.
- Sources that see the rival placement and do not name it add up: there would be something to name.
- Sources that do not see it, that name the link with less than they leave to none, and all that only say that the maps share a
  place at all, add `CLOSING_GAIN` at most. A source that names the link and not the rival never counts against the link.
- Walls on free floor count against the placement under which they stand there, each place once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from topomerge.fusion.atlas.pairs import DRIFT_LIMITS, Check, Checks, is_same_pose, sum_places
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Array, Sim3

# Log odds that agreement may add where no rival is named: of wrong registrations, one in e ** 1.5 (.22) is taken for a place that
# looks the same to all of its maps. An assumption, as the priors of `registration.posterior`, where storeys and wings are .36 of
# it.
CLOSING_GAIN = 1.5
PRIOR_SAME_PLACE = 4.0  # log odds against a registration giving just this place by chance
NOT_NAMED = 0.1  # least share of what a pair's best pose leaves that belongs to placements no hypothesis names
LEAST_SHARE = 1e-6
WEIGHED_ALREADY = -2.0  # log odds: what a registration that names a placement has weighed itself, unless it is more
LOOK_ALIKE_LIMITS = (1.5, np.radians(10.0), 0.1)  # m, rad, log scale: as near to a rival a poor fit is the same look-alike
LEAST_RIVAL = 0.01  # of a source's share of the link: rivals with less change nothing
MOST_RIVALS = 5  # placements that a link is weighed against
Hypotheses = Mapping[tuple[int, int], tuple[PoseHypothesis, ...]]
Poses = Mapping[int, Sim3]


@dataclass(frozen=True)
class Link:
    """A hypothesis that was taken, or rejected.

    Args:
        maps: i and j; `hypothesis` is the pose T_ij.
        log_odds: that it is right, with what all maps say that it brings over each other.
        against: the pair that spoke most against it, if any did.
    """

    maps: tuple[int, int]
    hypothesis: PoseHypothesis
    log_odds: float
    against: tuple[int, int] | None = None

    @property
    def probability(self) -> float:
        """Of `log_odds`."""
        return float(1 / (1 + np.exp(-np.clip(self.log_odds, -30, 30))))


def compute_shares(hypotheses: Sequence[PoseHypothesis]) -> tuple[list[float], float]:
    """Return the probabilities of ranked hypotheses of a pair and of none of them; they sum to 1, and the first one keeps its
    own."""
    best = float(np.clip(hypotheses[0].probability, LEAST_SHARE, 1 - LEAST_SHARE))
    others = sum(h.probability for h in hypotheses[1:])
    left = (1 - best) * (1 - NOT_NAMED)
    scale = min(left / others, 1.0) if others > 0 else 0.0
    shares = [best, *(max(h.probability * scale, LEAST_SHARE) for h in hypotheses[1:])]
    return shares, max(1 - sum(shares), (1 - best) * NOT_NAMED)


def compute_support(log_odds: float) -> float:
    """Compute the support for a pose by a registration of the same place, from its own log odds; 0 to 3."""
    return float(np.clip(log_odds + PRIOR_SAME_PLACE, 0.0, 3.0))


def place_component(a: Poses, b: Poses, pair: tuple[int, int], pose: Sim3) -> Sim3:
    """Compute the pose of component b in component a if map j of b lies at T_ij in map i of a; in any order."""
    i, j = pair
    if i not in a:
        i, j, pose = j, i, pose.inverse()
    return a[i] @ pose @ b[j].inverse()


@dataclass(frozen=True, eq=False)
class Source:
    """A source of placements of two maps (i < j).

    Args:
        named: poses T_ij with their shares.
        none: share of no placement that is named.
        direct: is it the registration of the two maps? Else it goes by way of another map.
    """

    pair: tuple[int, int]
    named: tuple[tuple[Sim3, float], ...]
    none: float
    direct: bool = True


class LinkEvidence:
    """Scores links between components.

    Args:
        maps: all that may take part.
        hypotheses: by pair (i < j), most probable first; pairs may be added.
    """

    def __init__(self, maps: Sequence[int], hypotheses: Hypotheses, checks: Checks) -> None:
        self.maps, self.hypotheses, self.checks = maps, hypotheses, checks
        self._composed: dict[tuple[int, int, int], tuple[tuple[object, object], Source | None]] = {}

    def score_link(
        self,
        a: Poses,
        b: Poses,
        pair: tuple[int, int],
        h: PoseHypothesis,
        move: Sim3 | None = None,
        least: float = -np.inf,
    ) -> Link:
        """Return a link between two components, with what all their maps show of it.

        Args:
            pair: i and j of the link, one in each component.
            h: a hypothesis of that pair.
            move: where component b lies in a; by the hypothesis if None.
            least: log odds below which it does not matter how low they are.
        """
        return _LinkScorer(self, a, b, pair, h, place_component(a, b, pair, h.transform) if move is None else move).score(least)

    def bound_log_odds(self, pair: tuple[int, int], h: PoseHypothesis) -> float:
        """Return the log odds of a hypothesis of a pair where everything else speaks for it and all its rivals are ruled out."""
        shares, none = compute_shares(self.hypotheses[pair])
        named = next((s for s, other in zip(shares, self.hypotheses[pair], strict=True) if other is h), LEAST_SHARE)
        return float(np.log(named / none)) + CLOSING_GAIN

    def is_same_pose(self, i: int, j: int, p: Sim3, q: Sim3, limits: tuple[float, float, float] = DRIFT_LIMITS) -> bool:
        """Return whether two poses T_ij are one, where the maps overlap."""
        return is_same_pose(p, q, self.checks.locate_place(i, j, p).mean(axis=0), limits)

    def get_source(self, i: int, j: int) -> Source:
        """Return the placements that the registration of maps i < j names; none where there is none."""
        ranked = self.hypotheses.get((i, j), ())
        if not ranked:
            return Source((i, j), (), 1.0)
        shares, none = compute_shares(ranked)
        return Source((i, j), tuple((h.transform, share) for h, share in zip(ranked, shares, strict=True)), none)

    def get_composed_source(self, i: int, j: int, k: int) -> Source | None:
        """Return the placements of maps i < j by the registrations of both with map k: each pose of the one with each of the
        other."""
        of = tuple(self.hypotheses.get((min(m, k), max(m, k))) for m in (i, j))
        if (i, j, k) not in self._composed or any(p is not q for p, q in zip(self._composed[i, j, k][0], of, strict=True)):
            self._composed[i, j, k] = (of[0], of[1]), self._compose_source(i, j, k)
        return self._composed[i, j, k][1]

    def _compose_source(self, i: int, j: int, k: int) -> Source | None:
        first, second = self._list_poses(i, k), self._list_poses(k, j)
        if not first or not second:
            return None
        merged: list[tuple[Sim3, float]] = []
        for (p, share), (q, other) in product(first, second):
            pose = p @ q
            same = next((n for n, (named, _) in enumerate(merged) if self.is_same_pose(i, j, named, pose)), None)
            if same is None:
                merged.append((pose, share * other))
            else:
                merged[same] = (merged[same][0], merged[same][1] + share * other)
        return Source((i, j), tuple(merged), max(1 - sum(share for _, share in merged), LEAST_SHARE), direct=False)

    def _list_poses(self, i: int, j: int) -> list[tuple[Sim3, float]]:
        """Return the T_ij of maps in any order, with their shares."""
        named = self.get_source(min(i, j), max(i, j)).named
        return [(pose if i < j else pose.inverse(), share) for pose, share in named]


class _LinkScorer:
    """One link while it is weighed."""

    def __init__(self, evidence: LinkEvidence, a: Poses, b: Poses, pair: tuple[int, int], h: PoseHypothesis, move: Sim3) -> None:
        self.evidence, self.a, self.b, self.pair, self.h, self.move = evidence, a, b, pair, h, move
        self._into = {k: pose.inverse() for k, pose in (*a.items(), *b.items())}
        self._poses: dict[tuple[tuple[int, int], Sim3], Sim3] = {}
        self._checks: dict[tuple[tuple[int, int], Sim3], Check] = {}
        self._shares: dict[Source, float | None] = {}  # of the placement of the link
        self.sources = [evidence.get_source(min(i, j), max(i, j)) for i in a for j in b]
        i, j = min(pair), max(pair)
        composed = (evidence.get_composed_source(i, j, k) for k in evidence.maps if k not in a and k not in b)
        self.composed = [way for way in composed if way is not None]

    def score(self, least: float) -> Link:
        """Return the link with its log odds, or some below the least ones, and the pair that spoke most against it."""
        costs = self._sum_contradictions(self.move)
        costly: list[tuple[float, tuple[int, int] | None]] = [(-cost, pair) for pair, cost in costs[1].items()]
        against = min(costly, default=(0.0, None), key=lambda entry: entry[0])
        log_odds = [self._compute_any_log_odds() - costs[0]]
        for rival in self._list_rivals() if log_odds[0] >= least else ():
            if log_odds[-1] < least:
                break
            ahead, loudest = self._compute_lead(rival)
            log_odds.append(ahead - costs[0] + self._sum_contradictions(rival)[0])
            against = min(against, loudest, key=lambda entry: entry[0])
        left = np.logaddexp.reduce(-np.array(log_odds))
        return Link(self.pair, self.h, -float(left), against[1])

    def _compute_pose(self, pair: tuple[int, int], move: Sim3) -> Sim3:
        """Return the T_ij of a pair (i < j) across, if component b lies so in a."""
        if (pair, move) not in self._poses:
            i, j = pair
            one, two = (i, j) if i in self.a else (j, i)
            pose = self._into[one] @ move @ self.b[two]
            self._poses[pair, move] = pose if one == i else pose.inverse()
        return self._poses[pair, move]

    def _compute_share(self, source: Source) -> float | None:
        """Compute the share of a source for the placement of the link; None where it does not name it."""
        if source not in self._shares:
            pose, named = self._compute_pose(source.pair, self.move), None
            if source.direct and source.pair == self.pair:  # the link itself, even if others moved it a little
                pose = self.h.transform
                named = next((share for p, share in source.named if p is pose), None)
            self._shares[source] = self._find_nearest_share(source, pose) if named is None else named
        return self._shares[source]

    def _find_nearest_share(self, source: Source, pose: Sim3, limits: tuple[float, float, float] = DRIFT_LIMITS) -> float | None:
        return next((share for p, share in source.named if self.evidence.is_same_pose(*source.pair, p, pose, limits)), None)

    def _compute_rival_share(self, source: Source, rival: Sim3) -> float | None:
        """Compute the share of a source for a rival placement or a poor fit near it, without its share for the link itself."""
        own, pose = self._compute_pose(source.pair, self.move), self._compute_pose(source.pair, rival)
        others = [(p, share) for p, share in source.named if not self.evidence.is_same_pose(*source.pair, p, own)]
        near = [share for p, share in others if self.evidence.is_same_pose(*source.pair, p, pose, LOOK_ALIKE_LIMITS)]
        return max(near, default=None)

    def _check(self, pair: tuple[int, int], move: Sim3) -> Check:
        if (pair, move) not in self._checks:
            self._checks[pair, move] = self.evidence.checks(*pair, self._compute_pose(pair, move))
        return self._checks[pair, move]

    def _compute_any_log_odds(self) -> float:
        """Compute the log odds of the placement against none at all: of the surest registration that names it, and what others
        add."""
        odds, supports = [], []
        for source in (*self.sources, *self.composed):
            share = self._compute_share(source)
            support = 0.0 if share is None else compute_support(float(np.log(share / max(1 - share, LEAST_SHARE))))
            if source.direct and source.pair != self.pair:
                support = max(support, self._check(source.pair, self.move).log_odds)
            supports.append(max(support, 0.0) if source.pair != self.pair or not source.direct else 0.0)
            odds += [float(np.log(share / source.none))] if share is not None and source.direct else []
        # Not their sum: pairs share the gaps and the noise of a map, and four wrong ones of .7 would make .97 (docs/adr/0022).
        return max(odds, default=0.0) + min(sum(supports), CLOSING_GAIN)

    def _sum_contradictions(self, move: Sim3) -> tuple[float, dict[tuple[int, int], float]]:
        """Sum the evidence of walls on free floor against a placement, each place once; and the cost of each pair by itself."""
        costs: dict[tuple[int, int], float] = {}
        places: list[tuple[Array, float]] = []
        for source in self.sources:
            check = self._check(source.pair, move)
            named = (
                self._compute_share(source)
                if move is self.move
                else self._find_nearest_share(source, self._compute_pose(source.pair, move))
            )
            if check.log_odds >= (WEIGHED_ALREADY if named is not None else 0.0):
                continue
            costs[source.pair] = -check.log_odds
            first = source.pair[0]
            frame = self.a[first] if first in self.a else move @ self.b[first]
            middles = [np.array(c.middle) for c in check.conflicts] or [np.zeros(3)]
            places += [(frame.apply(m[None])[0], -check.log_odds / len(middles)) for m in middles]
        return sum_places(places), costs

    def _list_rivals(self) -> list[Sim3]:
        """List the other placements that sources name, those with the largest shares."""
        named = [
            (share, source, pose)
            for source in (*self.sources, *self.composed)
            for pose, share in source.named
            if share >= (self._compute_share(source) or source.none) * LEAST_RIVAL
        ]
        rivals: list[Sim3] = []
        for _, source, pose in sorted(named, key=lambda entry: (-entry[0], entry[1].pair)):
            i, j = source.pair
            if len(rivals) == MOST_RIVALS or (source.direct and source.pair == self.pair and pose is self.h.transform):
                continue
            known = (self._compute_pose(source.pair, move) for move in (self.move, *rivals))
            if not any(self.evidence.is_same_pose(i, j, pose, other) for other in known):
                rivals.append(place_component(self.a, self.b, source.pair, pose))
        return rivals

    def _compute_lead(self, rival: Sim3) -> tuple[float, tuple[float, tuple[int, int] | None]]:
        """Compute the log odds of the placement against a rival one by what sources name; and the most that a pair says for the
        rival."""
        named: list[tuple[float, bool, bool]] = []  # log odds, is the placement that loses named, too, is it seen
        loudest: tuple[float, tuple[int, int] | None] = (0.0, None)
        doubtful = any(
            source.pair == self.pair and self._compute_rival_share(source, rival) is not None for source in self.sources
        )
        for source in (*self.sources, *self.composed):
            shares = self._compute_share(source), self._compute_rival_share(source, rival)
            if doubtful and not source.direct and shares[1] is None:
                continue  # a rival that the pair itself names may be among what is composed, too far off to be known again
            seen = [not source.direct or self._check(source.pair, move).overlap for move in (self.move, rival)]
            if source.named:
                odds = float(np.log((shares[0] or source.none) / (shares[1] or source.none)))
                if shares[0] is not None and shares[1] is None:
                    least = min(compute_support(float(np.log(shares[0] / max(1 - shares[0], LEAST_SHARE)))), CLOSING_GAIN)
                    if odds < least:  # what is left to none is spread over all that is not named, and is not this rival's
                        odds, seen = least, [False, False]
            else:
                log_odds = [np.clip(self._check(source.pair, move).log_odds, 0.0, CLOSING_GAIN) for move in (self.move, rival)]
                odds = float(log_odds[0] - log_odds[1])
            loser = int(odds > 0)
            named.append((odds, shares[loser] is not None or (seen[loser] and not source.named), seen[loser]))
            if source.direct and odds < loudest[0]:
                loudest = odds, source.pair
        # Not their mean: true links would lose by each pair that hardly overlaps (docs/adr/0022).
        gains = [weigh(((sign * odds, both, seen) for odds, both, seen in named)) for sign in (1.0, -1.0)]
        return gains[0] - gains[1], loudest


def weigh(sources: Iterable[tuple[float, bool, bool]]) -> float:
    """Sum the log odds of all sources for a placement against another one.

    Args:
        sources: log odds (those of 0 and less are left out); does the source name the other placement, too; does it see it?
    """
    positive = sorted((s for s in sources if s[0] > 0), reverse=True)
    if not positive:
        return 0.0
    independent = sum(odds for odds, both, seen in positive if seen and not both)
    dependent = [(odds, both) for odds, both, seen in positive if both or not seen]
    unseen = sum(odds for odds, both in dependent[1:] if not both)
    return independent + (dependent[0][0] if dependent else 0.0) + min(unseen, CLOSING_GAIN)


def split_component(component: Poses, links: Iterable[Link], link: Link) -> tuple[dict[int, Sim3], dict[int, Sim3]]:
    """Return the two components that a link holds together: that of its first map, and the other one."""
    side, left = {link.maps[0]}, [other.maps for other in links if other is not link]
    grown = True
    while grown:
        new = {k for pair in left if side & set(pair) for k in pair} - side
        side |= new
        grown = bool(new)
    return {k: p for k, p in component.items() if k in side}, {k: p for k, p in component.items() if k not in side}
