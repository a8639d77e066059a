"""Registration of two whole maps by their geometry: search, judge, refine, believe or not (method 3; no rooms, no learning)."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.refine import Surface, refine_pose, surface
from topomerge.fusion.scale import search_scaled
from topomerge.fusion.search import Candidate, View, search
from topomerge.fusion.search import refined as moved
from topomerge.fusion.storey_plan import cell_middles, plans
from topomerge.fusion.verify import MARGIN_CAP, Judge, Ranked, model, probability, rank
from topomerge.fusion.winner_features import closer
from topomerge.types import Array, Sim3, TopometricMap, VoxelGrid

log = logging.getLogger(__name__)
ALTERNATIVES = 10
DRIFTED = (0.5, np.radians(3.0))  # m, rad: a refinement that moves the middle by more has lost its way


@dataclass(frozen=True)
class Alternative:
    """A hypothesis: T_ab, log odds that it is right seen by itself, what it was judged by, and its probability beside all others
    (those of a registration and that none is right sum to 1)."""

    transform: Sim3
    plausibility: float
    features: dict[str, float]
    probability: float = 0.0


@dataclass(frozen=True)
class Registration:
    """Where map b lies in the frame of map a, and whether to believe it.

    Args:
        transform: T_ab of the best hypothesis, believed or not; None where there was none.
        probability: that it is right, calibrated on simulated pairs; 0 without a hypothesis.
        accepted: is the probability above the threshold of the calibration?
        features: what it was judged by (`verify.Judge`, `closer.closer`), with ``margin`` and ``rmse`` (m).
        alternatives: the hypotheses, best first; the first one is the best before its fine registration.
        reason: in words.
        seconds: step -> s.
    """

    transform: Sim3 | None
    probability: float
    accepted: bool
    features: dict[str, float] = field(default_factory=dict)
    alternatives: tuple[Alternative, ...] = ()
    reason: str = ""
    seconds: dict[str, float] = field(default_factory=dict)


Map = TopometricMap | VoxelGrid


@dataclass(frozen=True, eq=False)
class Prepared:
    """What registration needs of a map; made once where a map is registered with several.

    Args:
        views: its storeys, lowest first.
        order: larger maps come first; among equal ones the order is arbitrary, but always the same.
        middle: (3,) of its cells, m.
        surface: makes its points and normals, for the fine registration.
    """

    views: tuple[View, ...]
    order: tuple[int, str]
    middle: Array
    surface: Callable[[], Surface]


def prepare(map: Map, free: VoxelGrid | None = None) -> Prepared:
    """Plans of a map, with what is drawn from them when it is first needed.

    Args:
        free: cells known to be empty; a topometric map brings its own.

    Raises:
        InputError: an empty map.
    """
    grid = _grid(map)
    views = tuple(View(p) for p in plans(map, free))
    return Prepared(views, _order(map), cell_middles(grid).mean(axis=0), lambda: surface(grid))


def register(
    a: Map | Prepared,
    b: Map | Prepared,
    *,
    scale: str = "fixed",
    hypotheses: Sequence[Sim3] = (),
    free: tuple[VoxelGrid | None, VoxelGrid | None] = (None, None),
    yaws: Sequence[float] = (),
    refined: bool = True,
    searched: bool = True,
) -> Registration:
    """The pose of map b in map a's frame. `register(b, a)` gives its inverse.

    Args:
        a, b: topometric maps or occupied cells, or what `prepare` made of them.
        scale: "fixed", or "free" where b's unit may differ (found between 0.5 and 2).
        hypotheses: poses T_ab from matched rooms, tried beside those found by correlation.
        free: cells of a and of b known to be empty; topometric maps bring their own.
        yaws: further turns of b to try, rad.
        refined: finish with the fine registration? Without it the pose is right to a cell.
        searched: look for poses by correlation? Else the hypotheses are all there is.

    Raises:
        InputError: an empty map, or another word for the scale.
    """
    if scale not in ("fixed", "free"):
        raise InputError(f"scale must be fixed or free, not {scale!r}")
    clock = _Clock()
    a, b = (m if isinstance(m, Prepared) else prepare(m, f) for m, f in zip((a, b), free, strict=True))
    clock("plans")
    if b.order < a.order:  # so that nothing depends on which comes first
        turned = [h.inverse() for h in hypotheses], [-y for y in yaws]
        found = register(b, a, scale=scale, hypotheses=turned[0], yaws=turned[1], refined=refined, searched=searched)
        return replace(_inverse(found), seconds={**found.seconds, **clock.seconds})
    first, second = a.views, b.views
    if searched:
        candidates = (search_scaled if scale == "free" else search)(first, second, hypotheses, yaws)
    else:
        candidates = moved(first, second, [Candidate(h, 0.0, True) for h in hypotheses])
    clock("search")
    if not candidates:
        reason = "the maps show no walls that could be compared" if searched else "no two matched rooms could be aligned"
        return Registration(None, 0.0, False, reason=reason, seconds=clock.seconds)
    judge = Judge(first, second)
    ranked = rank(candidates, judge)
    seen = closer(judge, ranked[0][0].pose)
    clock("verify")
    pose, rmse = ranked[0][0].pose, float("nan")
    if refined and not any(v.plan.sliced for v in (*first, *second)):  # a slice has no planes
        pose, rmse = fine(a, b, pose, scale == "free")
    clock("refine")
    return _verdict(ranked, seen, pose, rmse, clock.seconds)


class _Clock:
    """Seconds since the step before."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.before = time.perf_counter()

    def __call__(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step], self.before = now - self.before, now


def _verdict(
    ranked: Sequence[Ranked], seen: dict[str, float], pose: Sim3, rmse: float, seconds: dict[str, float]
) -> Registration:
    """The best of ranked hypotheses, refined to `pose`, with its probability and the reason in words."""
    margin = ranked[0][2] - ranked[1][2] if len(ranked) > 1 else MARGIN_CAP
    features = {**ranked[0][1], **seen, "margin": margin, "rmse": rmse}
    chance, every = probability(ranked, seen)
    accepted = chance >= model()["threshold"]
    share = 100 * features["conflict_share"]
    reason = (
        f"{'believed' if accepted else 'not believed'}: {features['walls']:.0f} m2 of walls agree, {features['free']:.0f} m2 of "
        f"free floor seen by both, {share:.1f} % of the walls stand on free floor of the other map"
    )
    others = tuple(Alternative(c.pose, s, f, p) for (c, f, s), p in zip(ranked[:ALTERNATIVES], every, strict=False))
    return Registration(pose, chance, accepted, features, others, reason, seconds)


def _grid(m: Map) -> VoxelGrid:
    return m.grid if isinstance(m, TopometricMap) else m


def _order(m: Map) -> tuple[int, str]:
    """Larger maps come first; among equal ones the order is arbitrary, but always the same."""
    grid = _grid(m)
    digest = hashlib.sha256(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes()).hexdigest()
    return -len(grid), digest


def fine(a: Prepared, b: Prepared, start: Sim3, scaled: bool = False) -> tuple[Sim3, float]:
    """Point-to-plane refinement of T_ab, unless it runs away, and the root mean square distance of the surfaces, m."""
    found = refine_pose(a.surface(), b.surface(), start, scaled)
    middle = b.middle[None]
    moved = float(np.linalg.norm(found.pose.apply(middle) - start.apply(middle)))
    turned = abs((found.pose.yaw - start.yaw + np.pi) % (2 * np.pi) - np.pi)
    if not np.isfinite(found.rmse) or moved > DRIFTED[0] or turned > DRIFTED[1]:
        log.debug("refinement moved %.2f m, %.1f degrees: left out", moved, np.degrees(turned))
        return start, float("nan")
    return found.pose, found.rmse


def _inverse(found: Registration) -> Registration:
    """The same registration seen from the other map."""
    others = tuple(replace(o, transform=o.transform.inverse()) for o in found.alternatives)
    transform = None if found.transform is None else found.transform.inverse()
    return replace(found, transform=transform, alternatives=others)
