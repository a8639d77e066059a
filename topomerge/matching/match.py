"""Two maps -> which rooms are the same (seeds 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from topomerge.embedding.embedders import DEFAULT
from topomerge.embedding.embedders import embedder as make_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows, TurnedRows
from topomerge.errors import InputError
from topomerge.matching.assignment import assign
from topomerge.matching.consistency import hypotheses, voted_pose
from topomerge.matching.costs import descriptor_costs, similarities, usual_best
from topomerge.matching.growing import align, grow
from topomerge.matching.odds import match_probability
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.result import Matching
from topomerge.matching.room_matcher import RoomOdds, certainty_of_turns, room_odds
from topomerge.matching.scores import assign_certain
from topomerge.matching.unknown_scale import odds_at_best_scale
from topomerge.types import Array, TopometricMap

METHODS = ("consistent", "attention", "growing", "assignment", "thesis")
THESIS: dict[str, Any] = {"laplacian": "graph", "values": 256, "normalise": "first", "k": 1}
LIKELY_MATCH = 0.5  # probability of a match that the best hypothesis lacks
LEAST_CERTAINTY = 0.4  # of a match by attention: the best F1 on validation pairs
MOST_HYPOTHESES = 10


@dataclass(frozen=True)
class GrowingLimits:
    """Of the growing of hypotheses (seeds 3.3).

    Args:
        cost: of a pair; the median of the costs if None.
        error: m by which the alignment of all matched centroids may get worse with a pair.
    """

    cost: float | None = None
    error: float = 2.5


def match(
    a: TopometricMap,
    b: TopometricMap,
    embedder: str | Descriptor = DEFAULT,
    method: str = "consistent",
    *,
    k: int = 0,
    scale_free: bool = False,
    largest_cost: float | None = None,
    growing: GrowingLimits = GrowingLimits(),
    **options: Any,
) -> Matching:
    """Rooms of a that are rooms of b.

    Args:
        embedder: ``"learned"``, ``"engineered"``, ``"shapedna"``, ``"feather"``, the folder of a trained one, or a callable
            map -> (R, D).
        method: ``"consistent"``: sets of matches that one transform explains, by walls and floor; ``"attention"``: what rooms
            look like and how they lie to each other, by a network (`room_matcher`, with the embedder that ships);
            ``"growing"``: from each pair to its neighbours; ``"assignment"``: by cost alone;
            ``"thesis"``: ShapeDNA with one step of context, and growing (embedder and k are the
            thesis' then).
        k: steps of context.
        scale_free: the scale of b is unknown (``"consistent"`` and ``"attention"`` allow for it).
        largest_cost: of the assignment; pairs above it stay alone. Twice the usual cost of a room's best partner if None.
        growing: limits of the growing.
        options: of the embedder.

    Raises:
        InputError: one map twice, a map without rooms, or an unknown method, embedder or option.
    """
    if method not in METHODS:
        raise InputError(f"matching method {method!r}: {', '.join(METHODS)} are possible")
    check(a, b)
    describe = make_embedder("shapedna", **THESIS) if method == "thesis" else make_embedder(embedder, k, **options)
    rows = checked(describe, a), checked(describe, b)
    cost = descriptor_costs(*rows)
    similarity = similarities(cost)
    statistics = {"rooms_a": float(len(a.rooms)), "rooms_b": float(len(b.rooms)), "median_cost": float(np.median(cost))}
    statistics["usual_best_cost"] = usual_best(cost)
    if method == "assignment":
        pairs = assign(cost, 2 * usual_best(cost) if largest_cost is None else largest_cost)
        return Matching(pairs, similarity[tuple(pairs.T)], statistics=statistics)
    odds: tuple[RoomOdds, ...] = ()
    if method in ("attention", "consistent"):
        odds = _odds(describe, rows, b, scale_free, statistics)
    if method == "attention":
        return _by_attention(a, b, odds, statistics)
    if method == "consistent":
        likely = certainty_of_turns(odds) if odds else similarity
        ranked = hypotheses(
            a, b, 1 - likely if odds else cost, likely, scale_free, MOST_HYPOTHESES, statistics.get("scale") if odds else None
        )
        rooms, probability = marginal(a, b, ranked)
    else:  # one hypothesis wins as a whole, as in the thesis
        ranked = _from_growing(a, b, cost, similarity, growing)
        rooms, probability = (ranked[0].rooms, ranked[0].fit) if ranked else (np.zeros((0, 2), np.int64), np.zeros(0))
    return Matching(rooms, probability, ranked[0].transform if ranked else None, ranked, statistics)


def _odds(
    describe: Descriptor, rows: tuple[Rows, Rows], b: TopometricMap, scale_free: bool, statistics: dict[str, float]
) -> tuple[RoomOdds, ...]:
    """Partners of rooms by `room_matcher`; of unknown scale at that at which they are surest, which goes into the statistics."""
    if not scale_free:
        return room_odds(*rows)
    if not hasattr(describe, "at_scales"):
        return ()
    statistics["scale"], odds = odds_at_best_scale(*rows, describe.at_scales(b))
    return odds


def _by_attention(a: TopometricMap, b: TopometricMap, odds: Sequence[RoomOdds], statistics: dict[str, float]) -> Matching:
    """Matches of `room_matcher`, and the pose that most of their doors and middles vote for.

    Raises:
        InputError: the rows are of another embedder.
    """
    if not odds:
        raise InputError("method attention needs the embedder that ships; take method consistent")
    certain = max(odds, key=lambda turned: turned.sureness).certainty
    rooms = assign_certain(certain, LEAST_CERTAINTY)
    pose = voted_pose(a, b, certain, statistics.get("scale"))
    probability = certain[tuple(rooms.T)]
    ranked = () if pose is None else (PoseHypothesis(pose, float(len(rooms)), 1.0, {}, True, rooms, probability),)
    return Matching(rooms, probability, pose, ranked, statistics)


def check(a: TopometricMap, b: TopometricMap) -> None:
    """Refuse what can't be matched.

    Raises:
        InputError: names the map.
    """
    for which, m in (("first", a), ("second", b)):
        if not len(m.rooms):
            raise InputError(f"{m.source or f'the {which} map'}: no rooms in it, nothing can be matched")
    same_cells = len(a.grid) == len(b.grid) and a.grid.cells.tobytes() == b.grid.cells.tobytes()
    if a is b or (same_cells and np.array_equal(a.grid.origin, b.grid.origin) and a.grid.edge == b.grid.edge):
        raise InputError(f"{b.source or 'the second map'}: is the same map as {a.source or 'the first'}; give two different maps")


def checked(describe: Descriptor, map: TopometricMap) -> Rows:
    """What an embedder gives, if it is a finite row for each room, or one for each quarter turn of it.

    Raises:
        InputError: it is not.
    """
    given = describe(map)
    turned = isinstance(given, TurnedRows)
    rows = np.asarray(given.rows if isinstance(given, TurnedRows) else given, np.float64)
    if rows.ndim != 2 + turned or len(rows) != len(map.rooms) or not np.isfinite(rows).all():
        raise InputError(f"the embedder must give a finite row for each of {len(map.rooms)} rooms, not {rows.shape}")
    return replace(given, rows=rows) if isinstance(given, TurnedRows) else rows


def marginal(a: TopometricMap, b: TopometricMap, ranked: tuple[PoseHypothesis, ...]) -> tuple[Array, Array]:
    """Matches of the best hypothesis, and all whose probability over the hypotheses is above 0.5 and that exclude none of those.

    The probability of a match is the sum, over the hypotheses that have it, of theirs times that rooms which fit so are one.
    """
    total: dict[tuple[int, int], float] = {}
    for h in ranked:
        chance = match_probability(a, b, h.rooms, h.fit)
        for (i, j), p in zip(h.rooms.tolist(), chance.tolist(), strict=True):
            total[i, j] = total.get((i, j), 0.0) + h.probability * p
    best = {(i, j) for i, j in ranked[0].rooms.tolist()} if ranked else set()
    taken = ({i for i, _ in best}, {j for _, j in best})
    others = {(i, j) for (i, j), p in total.items() if p > LIKELY_MATCH and i not in taken[0] and j not in taken[1]}
    chosen = sorted(best | others)
    return np.array(chosen, np.int64).reshape(-1, 2), np.array([min(total[p], 1.0) for p in chosen])


def _from_growing(
    a: TopometricMap, b: TopometricMap, cost: Array, similarity: Array, limits: GrowingLimits
) -> tuple[PoseHypothesis, ...]:
    """Hypotheses of the growing; their probability goes with the square of the number of matches."""
    grown = grow(a, b, cost, limits.cost, limits.error)[:MOST_HYPOTHESES]
    weight = np.array([len(p) ** 2 for p in grown], float)
    ranked = []
    for pairs, share in zip(grown, weight / max(weight.sum(), 1.0), strict=True):
        rooms = np.array(pairs, np.int64)
        pose, error = align(a.rooms["centroid"][rooms[:, 0]], b.rooms["centroid"][rooms[:, 1]])
        fit = similarity[tuple(rooms.T)]
        ranked.append(PoseHypothesis(pose, float(len(rooms)), float(share), {"error_m": error}, True, rooms, fit))
    return tuple(ranked)
