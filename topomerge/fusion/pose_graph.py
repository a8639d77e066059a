"""Hypotheses of pairs -> sets of maps that lie in one frame (method 4: agreement around cycles).

Links are taken in the order of their probability, as in a maximum spanning tree, but each is weighed before by all that the maps
show which it would bring over each other (`link_evidence`). What contradicts better evidence is rejected, and named. Maps that no
hypothesis joins, by others or directly, show nothing of each other: each set of maps that may come together is assembled by
itself, and only anew when more of its pairs were registered.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from topomerge.fusion.atlas.link_evidence import (
    Hypotheses,
    Link,
    LinkEvidence,
    Poses,
    compute_support,
    place_component,
    split_component,
)
from topomerge.fusion.atlas.pairs import Check, Checks
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Array, Sim3

POSE_GRAPH_ROUNDS = 30
HALF_WEIGHT_GAP = 0.15  # m: a measurement that is off by this counts half (Cauchy)
LEAST_STEP = 1e-7  # m and rad: a smaller step ends the search
FREE_AT_FIXED_SCALE = np.array([True, True, True, True, False])  # x, y, z, yaw; not the logarithm of the scale
Of = TypeVar("Of")
BELIEVED = 0.5  # probability
EXCHANGE_GAIN = 0.5  # log odds by which another link must be better to take a link's place
HEAVIEST_WALLS = 20.0  # m2 of walls in common, above which a measurement counts no more


@dataclass(frozen=True, eq=False)
class Measured:
    """A measured pose of a pair.

    Args:
        maps: i and j.
        pose: T_ij.
        points: (k, 3) float64 of map j, in the place that both maps saw, m.
        weight: how much it counts; of amounts of evidence.
    """

    maps: tuple[int, int]
    pose: Sim3
    points: Array
    weight: float = 1.0


def compute_residual(edge: Measured, poses: Mapping[int, Sim3]) -> float:
    """Compute the root mean square misfit of a measurement over its points, m."""
    i, j = edge.maps
    gap = poses[i].apply(edge.pose.apply(edge.points)) - poses[j].apply(edge.points)
    return float(np.sqrt((gap**2).sum(axis=1).mean()))


def optimise(
    start: Mapping[int, Sim3], edges: Sequence[Measured], scaled: bool = False, anchor: int | None = None
) -> dict[int, Sim3]:
    """Return poses that agree best with all measurements.

    Args:
        start: map -> T_0k, near the solution (of a spanning tree).
        edges: measurements between maps of `start`.
        scaled: are the scales free, too?
        anchor: the map that keeps its pose; the first one of `start` by default.
    """
    names = list(start)
    anchor = names[0] if anchor is None else anchor
    moving = [name for name in names if name != anchor]
    free = np.array(FREE_AT_FIXED_SCALE if not scaled else [True] * 5)
    width = int(free.sum())
    place = {name: width * k for k, name in enumerate(moving)}
    poses = dict(start)
    for _ in range(POSE_GRAPH_ROUNDS if edges and moving else 0):
        h, g = 1e-9 * np.eye(width * len(moving)), np.zeros(width * len(moving))
        for edge in edges:
            _add_measurement(edge, poses, place, free, h, g)
        step = np.linalg.solve(h, -g)
        for name, at in place.items():
            poses[name] = _moved(poses[name], step[at : at + width])
        if np.abs(step).max() < LEAST_STEP:
            break
    return poses


def _add_measurement(
    edge: Measured, poses: Mapping[int, Sim3], place: Mapping[int, int], free: Array, h: Array, g: Array
) -> None:
    """Add a measurement to the normal equations."""
    i, j = edge.maps
    points_i, points_j = edge.pose.apply(edge.points), edge.points
    gap = poses[i].apply(points_i) - poses[j].apply(points_j)
    off = float(np.sqrt((gap**2).sum(axis=1).mean()))
    weight = edge.weight / (1 + (off / HALF_WEIGHT_GAP) ** 2) / len(points_j)
    parts = []
    for name, points, sign in ((i, points_i, 1.0), (j, points_j, -1.0)):
        if name in place:
            parts.append((place[name], sign * _compute_jacobian(poses[name], points)[:, :, free].reshape(-1, int(free.sum()))))
    flat = gap.reshape(-1)
    for at, jac in parts:
        rows = slice(at, at + jac.shape[1])
        g[rows] += weight * jac.T @ flat
        for other, jac_other in parts:
            h[rows, other : other + jac_other.shape[1]] += weight * jac.T @ jac_other


def _compute_jacobian(pose: Sim3, points: Array) -> Array:
    """Return (k, 3, 5) of the placed points by x, y, z, yaw and the logarithm of the scale."""
    turned = pose.apply(points) - np.array(pose.translation)
    jacobian = np.zeros((len(points), 3, 5))
    jacobian[:, [0, 1, 2], [0, 1, 2]] = 1.0
    jacobian[:, 0, 3], jacobian[:, 1, 3] = -turned[:, 1], turned[:, 0]
    jacobian[:, :, 4] = turned
    return jacobian


def _moved(pose: Sim3, step: Array) -> Sim3:
    x, y, z = (np.array(pose.translation) + step[:3]).tolist()
    grown = pose.scale * float(np.exp(step[4])) if len(step) > 4 else pose.scale
    yaw = float((pose.yaw + step[3] + np.pi) % (2 * np.pi) - np.pi)
    return Sim3(yaw, (x, y, z), grown)


def iter_map_sets(
    count: int, joining: Collection[tuple[int, int]], of_pairs: Mapping[tuple[int, int], Of]
) -> Iterator[tuple[tuple[int, ...], dict[tuple[int, int], Of]]]:
    """Yield sets of maps that pairs join, directly or by others, each with what there is of the pairs within it.

    Args:
        count: of the maps.
        joining: pairs of maps, by their numbers.
        of_pairs: pair -> anything.
    """
    pairs = np.array(sorted(joining), np.int64).reshape(-1, 2)
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    owner = connected_components(links, directed=False)[1].tolist()
    members: dict[int, list[int]] = {}
    within: dict[int, dict[tuple[int, int], Of]] = {}
    for k in range(count):
        members.setdefault(owner[k], []).append(k)
    for (i, j), of in of_pairs.items():
        if owner[i] == owner[j]:
            within.setdefault(owner[i], {})[i, j] = of
    for n, maps in members.items():
        yield tuple(maps), within.get(n, {})


@dataclass(eq=False)
class Assembly:
    """Components: each a dictionary map -> pose in the component's frame; and the links that hold them."""

    components: list[dict[int, Sim3]]
    links: list[Link] = field(default_factory=list)
    rejected: list[Link] = field(default_factory=list)

    def find_component(self, k: int) -> dict[int, Sim3]:
        """Return the component of a map."""
        return next(c for c in self.components if k in c)


class Assembler:
    """Builds assemblies of `count` maps from the hypotheses of their pairs.

    Args:
        hypotheses: by pair, most probable first; pairs may be added between two assemblies.
        limit: log odds from which a link is believed.
        scaled: are the scales free, too?
        maps: their numbers, if they are others than those from 0 on.
    """

    def __init__(
        self,
        count: int,
        hypotheses: Hypotheses,
        checks: Checks,
        limit: float,
        scaled: bool = False,
        maps: Sequence[int] | None = None,
    ) -> None:
        self.maps: Sequence[int] = range(count) if maps is None else maps
        self.hypotheses, self.checks, self.limit, self.scaled = hypotheses, checks, limit, scaled
        self.evidence = LinkEvidence(self.maps, hypotheses, checks)
        self._settled: dict[tuple[Hashable, ...], tuple[dict[int, Sim3], list[Measured]]] = {}
        self._built: dict[tuple[int, ...], tuple[set[tuple[int, int]], Assembly]] = {}  # of sets of maps, with their pairs

    def build(self) -> Assembly:
        """Return the most probable assembly without contradictions."""
        built = {}
        candidates = {pair for pair, _ in self._list_candidates(set())}
        for maps, within in iter_map_sets(len(self.maps), candidates, self.hypotheses):
            pairs, assembly = self._built.get(maps, (set(), None))
            if assembly is None or pairs != set(within):
                part = Assembler(0, within, self.checks, self.limit, self.scaled, maps)
                part._settled = self._settled
                assembly = part._assemble()
            built[maps] = set(within), assembly
        self._built = built
        whole = Assembly([])
        for _, assembly in built.values():
            whole.components += assembly.components
            whole.links += assembly.links
            whole.rejected += assembly.rejected
        return whole

    def _assemble(self) -> Assembly:
        """Assemble, as `build`, all maps at once."""
        banned: set[tuple[int, int]] = set()
        while True:  # ends: each time one more pair is banned
            assembly = self._grow(banned)
            self._exchange(assembly)
            links = self._rescore_links(assembly)
            weak = [link for link in links if link.log_odds < self.limit]
            if not weak:
                break
            banned.add(min(weak, key=lambda link: link.log_odds).maps)
        assembly.links = links
        assembly.rejected = self._list_rejected(assembly)
        return assembly

    def _list_candidates(self, banned: set[tuple[int, int]]) -> list[tuple[tuple[int, int], PoseHypothesis]]:
        """List the hypotheses that could be believed if everything else spoke for them, most probable first."""
        candidates = [(pair, h) for pair, hs in self.hypotheses.items() if pair not in banned for h in hs]
        candidates = [(pair, h) for pair, h in candidates if self.evidence.bound_log_odds(pair, h) >= self.limit]
        return sorted(candidates, key=lambda e: (-e[1].log_odds, e[0]))

    def _grow(self, banned: set[tuple[int, int]]) -> Assembly:
        assembly = Assembly([{k: Sim3()} for k in self.maps])
        candidates = self._list_candidates(banned)
        refused: dict[int, tuple[Poses, Poses]] = {}  # by the components that stood there then, and mostly still do
        changed = True
        while changed:
            changed = False
            for n, (pair, h) in enumerate(candidates):
                a, b = assembly.find_component(pair[0]), assembly.find_component(pair[1])
                if a is b or (n in refused and refused[n][0] is a and refused[n][1] is b):
                    continue
                link = self.evidence.score_link(a, b, pair, h, least=self.limit)
                if link.log_odds >= self.limit:
                    self._join(assembly, a, b, link)
                    changed = True
                    break
                refused[n] = a, b
        return assembly

    def _join(self, assembly: Assembly, a: dict[int, Sim3], b: dict[int, Sim3], link: Link) -> None:
        """Bring component b into a's frame, and settle all poses."""
        move = place_component(a, b, link.maps, link.hypothesis.transform)
        joined = {**a, **{k: move @ pose for k, pose in b.items()}}
        assembly.components = [c for c in assembly.components if c is not a and c is not b]
        assembly.links.append(link)
        assembly.components.append(self.settle(joined, assembly.links)[0])

    def _rescore_links(self, assembly: Assembly) -> list[Link]:
        """Return the links as they are seen now that everything is in its place."""
        return [self._rescore(assembly, link) for link in assembly.links]

    def _rescore(self, assembly: Assembly, link: Link) -> Link:
        a, b = split_component(assembly.find_component(link.maps[0]), assembly.links, link)
        return self.evidence.score_link(a, b, link.maps, link.hypothesis, Sim3())

    def _iter_contradicted(self, assembly: Assembly) -> Iterator[tuple[tuple[int, int], PoseHypothesis]]:
        """Yield the best hypotheses of pairs that lie elsewhere in their component."""
        for (i, j), hypotheses in sorted(self.hypotheses.items()):
            poses = assembly.find_component(i)
            if not hypotheses or j not in poses or hypotheses[0].probability < BELIEVED:
                continue
            if not self.evidence.is_same_pose(i, j, hypotheses[0].transform, poses[i].inverse() @ poses[j]):
                yield (i, j), hypotheses[0]

    def _exchange(self, assembly: Assembly) -> None:
        """Put contradicted hypotheses in the place of links, where everything agrees better then."""
        for _ in range(2 * len(self.maps)):
            change = next(self._iter_exchanges(assembly), None)
            if change is None:
                return
            old, new, (a, b) = change
            assembly.components = [c for c in assembly.components if old.maps[0] not in c] + [a, b]
            assembly.links = [link for link in assembly.links if link is not old]
            first, second = (a, b) if new.maps[0] in a else (b, a)
            self._join(assembly, first, second, new)

    def _iter_exchanges(self, assembly: Assembly) -> Iterator[tuple[Link, Link, tuple[dict[int, Sim3], dict[int, Sim3]]]]:
        for pair, h in self._iter_contradicted(assembly):
            for link in assembly.links:
                component = assembly.find_component(link.maps[0])
                a, b = split_component(component, assembly.links, link) if pair[0] in component else ({}, {})
                first, second = (a, b) if pair[0] in a else (b, a)
                if pair[0] not in first or pair[1] not in second:
                    continue
                then = self.evidence.score_link(first, second, pair, h, least=self.limit)
                if then.log_odds < self.limit:
                    continue
                now = self._rescore(assembly, link)
                if then.log_odds >= max(now.log_odds + EXCHANGE_GAIN, self.limit):
                    yield link, then, (a, b)

    def _list_rejected(self, assembly: Assembly) -> list[Link]:
        """List the hypotheses that were believed by themselves and contradict the rest."""
        rejected = [
            Link(pair, h, -h.log_odds, self._find_weakest_link(assembly, pair)) for pair, h in self._iter_contradicted(assembly)
        ]
        for (i, j), hypotheses in sorted(self.hypotheses.items()):
            a, b = assembly.find_component(i), assembly.find_component(j)
            if a is not b and hypotheses and hypotheses[0].log_odds >= self.limit:
                rejected.append(self.evidence.score_link(a, b, (i, j), hypotheses[0]))
        return rejected

    def _find_weakest_link(self, assembly: Assembly, pair: tuple[int, int]) -> tuple[int, int] | None:
        """Return the link on the way between two maps that says most against their hypothesis."""
        component = assembly.find_component(pair[0])
        links = [link for link in assembly.links if link.maps[0] in component]
        between = [link for link in links if len(set(pair) & set(split_component(component, assembly.links, link)[0])) == 1]
        return min(between, key=lambda link: link.log_odds).maps if between else None

    def settle(self, poses: Poses, links: Sequence[Link], fine: bool = False) -> tuple[dict[int, Sim3], list[Measured]]:
        """Return poses of a component that agree best with all that is measured between its maps, and that."""
        within = tuple((link.maps, link.hypothesis.transform) for link in links if link.maps[0] in poses)
        best = ((p, h) for p, of in self.hypotheses.items() for h in of[:1] if p[0] in poses and p[1] in poses)
        claims = tuple((pair, h.transform, h.probability) for pair, h in best)
        question = (tuple(poses.items()), within, claims, fine)
        if question not in self._settled:  # the same is asked again whenever one more pair was registered
            edges = list(self._iter_measured(poses, links, fine))
            self._settled[question] = optimise(poses, edges, self.scaled, min(poses)), edges
        solved, edges = self._settled[question]
        return dict(solved), edges

    def _iter_measured(self, poses: Poses, links: Sequence[Link], fine: bool) -> Iterator[Measured]:
        link_poses = {link.maps: link.hypothesis.transform for link in links}
        names = sorted(poses)
        for i in names:
            for j in (k for k in names if k > i):
                check = self.checks(i, j, poses[i].inverse() @ poses[j])
                if (i, j) in link_poses and not check.overlap:
                    check = Check(link_poses[i, j], 0.0, True, {"walls": 1.0})
                if check.overlap and ((i, j) in link_poses or self._is_supported(i, j, poses[i].inverse() @ poses[j], check)):
                    pose = self.checks.refine_pose(i, j, check.pose) if fine else check.pose
                    weight = float(np.clip(check.features["walls"], 0.5, HEAVIEST_WALLS))
                    yield Measured((i, j), pose, self.checks.locate_place(i, j, pose), weight)

    def _is_supported(self, i: int, j: int, pose: Sim3, check: Check) -> bool:
        """Return whether a pair (i < j) speaks for T_ij, by its walls or by its own registration."""
        best = next(iter(self.hypotheses.get((i, j), ())), None)
        same = best is not None and self.evidence.is_same_pose(i, j, best.transform, pose)
        return check.log_odds > 0 or (same and best is not None and compute_support(best.log_odds) > 0)
