"""Match two maps: which rooms are the same (seeds 3.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from topomerge.archive import convert_to_plain
from topomerge.embedding.learned import DEFAULT
from topomerge.embedding.learned import build_embedder as make_embedder
from topomerge.embedding.quarter_turns import (
    Descriptor,
    Rows,
    TurnedRows,
    YawProbability,
    estimate_turns,
    is_same_yaw,
    merge_yaws,
    select_credible,
)
from topomerge.errors import InputError
from topomerge.matching.assignment import (
    align,
    assign,
    assign_certain,
    compute_descriptor_costs,
    compute_similarities,
    compute_usual_best_cost,
    grow,
)
from topomerge.matching.consistency import compute_match_probability, find_voted_pose, propose_hypotheses
from topomerge.matching.poses import PoseHypothesis
from topomerge.matching.room_matcher import RoomOdds, combine_turn_certainties, compute_room_odds, find_best_scale
from topomerge.types import EDITED, LEVELLED, Array, Sim3, TopometricMap, convert_pose_to_files, is_level


def _build_empty_rooms() -> Array:
    return np.zeros((0, 2), np.int64)


@dataclass(frozen=True, eq=False)
class Matching:
    """Rooms of map a that are rooms of map b.

    Args:
        rooms: (M, 2) int64, ascending; most rooms are in one row at most, one that is cut in two in the other map is in two.
        probability: (M,) float64.
        transform: T_ab of the best hypothesis; None where rooms were matched without geometry.
        alternatives: all hypotheses, best first (the first one is that of `transform`).
        statistics: of the cost matrix and the search.
        turns: how the frame of b may be turned to stand as that of a, likeliest first; none where rows tell nothing of turns.
    """

    rooms: Array = field(default_factory=_build_empty_rooms)
    probability: Array = field(default_factory=lambda: np.zeros(0))
    transform: Sim3 | None = None
    alternatives: tuple[PoseHypothesis, ...] = ()
    statistics: Mapping[str, float] = field(default_factory=dict)
    turns: tuple[YawProbability, ...] = ()

    @property
    def fitting_turns(self) -> tuple[YawProbability, ...]:
        """The fewest turns of which one is the true one with probability 0.9: several, where a plan is symmetric."""
        return select_credible(self.turns)

    def __post_init__(self) -> None:
        if self.rooms.shape != (len(self.probability), 2):
            raise ValueError(f"rooms must be (M, 2) with a probability each, not {self.rooms.shape}")


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
    """Return rooms of a that are rooms of b.

    Args:
        embedder: ``"learned"``, ``"engineered"``, ``"shapedna"``, ``"feather"``, the run or file of a trained one, or a callable
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
    rows = embed_rooms(describe, a), embed_rooms(describe, b)
    cost = compute_descriptor_costs(*rows)
    similarity = compute_similarities(cost)
    statistics = {"rooms_a": float(len(a.rooms)), "rooms_b": float(len(b.rooms)), "median_cost": float(np.median(cost))}
    statistics["usual_best_cost"] = compute_usual_best_cost(cost)
    if method == "assignment":
        pairs = assign(cost, 2 * compute_usual_best_cost(cost) if largest_cost is None else largest_cost)
        return Matching(pairs, similarity[tuple(pairs.T)], statistics=statistics, turns=find_turns(rows, ()))
    odds: tuple[RoomOdds, ...] = ()
    if method in ("attention", "consistent"):
        odds = _compute_odds(describe, rows, b, scale_free, statistics)
    if method == "attention":
        return _match_by_attention(a, b, odds, statistics)
    turns = find_turns(rows, odds)
    if method == "consistent":
        likely = combine_turn_certainties(odds) if odds else similarity
        ranked = propose_hypotheses(
            a, b, 1 - likely if odds else cost, likely, scale_free, MOST_HYPOTHESES, statistics.get("scale") if odds else None
        )
        rooms, probability = select_marginal_matches(a, b, ranked)
        turns = weigh_turns(turns, ranked)
    else:  # one hypothesis wins as a whole, as in the thesis
        ranked = _grow_ranked_hypotheses(a, b, cost, similarity, growing)
        rooms, probability = (ranked[0].rooms, ranked[0].fit) if ranked else (np.zeros((0, 2), np.int64), np.zeros(0))
    return Matching(rooms, probability, ranked[0].transform if ranked else None, ranked, statistics, turns)


def find_turns(rows: tuple[Rows, Rows], odds: Sequence[RoomOdds]) -> tuple[YawProbability, ...]:
    """Return how likely each turn is by `room_matcher`, or by rows alone where it has no say."""
    a, b = rows
    if not odds and isinstance(a, TurnedRows) and isinstance(b, TurnedRows):
        return merge_yaws([(turn.yaw, turn.probability) for turn in estimate_turns(a, b)])
    return merge_yaws([(turned.yaw, turned.probability) for turned in odds])


def weigh_turns(turns: Sequence[YawProbability], ranked: Sequence[PoseHypothesis]) -> tuple[YawProbability, ...]:
    """Return turns with the evidence of walls in their probabilities: that of the hypotheses so turned, and a share of what is
    left for none of them."""
    rest = max(1 - sum(h.probability for h in ranked), 0.0) / max(len(turns), 1)
    walls = [sum(h.probability for h in ranked if is_same_yaw(h.transform.yaw, turn.yaw)) + rest for turn in turns]
    weight = np.array([turn.probability for turn in turns]) * walls
    if not weight.sum():
        return tuple(turns)
    return merge_yaws([(turn.yaw, float(p)) for turn, p in zip(turns, weight / weight.sum(), strict=True)])


def _compute_odds(
    describe: Descriptor, rows: tuple[Rows, Rows], b: TopometricMap, scale_free: bool, statistics: dict[str, float]
) -> tuple[RoomOdds, ...]:
    """Compute the partners of rooms by `room_matcher`; of unknown scale at that at which they are surest, which goes into the
    statistics."""
    if not scale_free:
        return compute_room_odds(*rows)
    if not hasattr(describe, "at_scales"):
        return ()
    statistics["scale"], odds = find_best_scale(*rows, describe.at_scales(b))
    return odds


def _match_by_attention(a: TopometricMap, b: TopometricMap, odds: Sequence[RoomOdds], statistics: dict[str, float]) -> Matching:
    """Return the matches of `room_matcher` at the likeliest turn, and the pose that most of their doors and middles vote for; how
    probable a match is, is the mean over turns.

    Raises:
        InputError: the rows are of another embedder.
    """
    if not odds:
        raise InputError("method attention needs the embedder that ships; take method consistent")
    likeliest = max(odds, key=lambda turned: turned.probability)
    rooms = assign_certain(likeliest.certainty, LEAST_CERTAINTY)
    pose = find_voted_pose(a, b, likeliest.certainty, statistics.get("scale"))
    probability = combine_turn_certainties(odds)[tuple(rooms.T)]
    ranked = () if pose is None else (PoseHypothesis(pose, float(len(rooms)), 1.0, {}, True, rooms, probability),)
    return Matching(rooms, probability, pose, ranked, statistics, find_turns((np.zeros(0), np.zeros(0)), odds))


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


def embed_rooms(describe: Descriptor, map: TopometricMap) -> Rows:
    """Embed a map and check the result: a finite row for each room, or one for each quarter turn of it.

    Raises:
        InputError: it is not.
    """
    given = describe(map)
    turned = isinstance(given, TurnedRows)
    rows = np.asarray(given.rows if isinstance(given, TurnedRows) else given, np.float64)
    if rows.ndim != 2 + turned or len(rows) != len(map.rooms) or not np.isfinite(rows).all():
        raise InputError(f"the embedder must give a finite row for each of {len(map.rooms)} rooms, not {rows.shape}")
    return replace(given, rows=rows) if isinstance(given, TurnedRows) else rows


def select_marginal_matches(a: TopometricMap, b: TopometricMap, ranked: tuple[PoseHypothesis, ...]) -> tuple[Array, Array]:
    """Return the matches of the best hypothesis, and all whose probability over the hypotheses is above 0.5 and that exclude none
    of those.

    The probability of a match is the sum, over the hypotheses that have it, of theirs times that rooms which fit so are one.
    """
    total: dict[tuple[int, int], float] = {}
    for h in ranked:
        probability = compute_match_probability(a, b, h.rooms, h.fit)
        for (i, j), p in zip(h.rooms.tolist(), probability.tolist(), strict=True):
            total[i, j] = total.get((i, j), 0.0) + h.probability * p
    best = {(i, j) for i, j in ranked[0].rooms.tolist()} if ranked else set()
    taken = ({i for i, _ in best}, {j for _, j in best})
    others = {(i, j) for (i, j), p in total.items() if p > LIKELY_MATCH and i not in taken[0] and j not in taken[1]}
    chosen = sorted(best | others)
    return np.array(chosen, np.int64).reshape(-1, 2), np.array([min(total[p], 1.0) for p in chosen])


def _grow_ranked_hypotheses(
    a: TopometricMap, b: TopometricMap, cost: Array, similarity: Array, limits: GrowingLimits
) -> tuple[PoseHypothesis, ...]:
    """Return the hypotheses of the growing; their probability goes with the square of the number of matches."""
    grown = grow(a, b, cost, limits.cost, limits.error)[:MOST_HYPOTHESES]
    weight = np.array([len(p) ** 2 for p in grown], float)
    ranked = []
    for pairs, share in zip(grown, weight / max(weight.sum(), 1.0), strict=True):
        rooms = np.array(pairs, np.int64)
        pose, error = align(a.rooms["centroid"][rooms[:, 0]], b.rooms["centroid"][rooms[:, 1]])
        fit = similarity[tuple(rooms.T)]
        ranked.append(PoseHypothesis(pose, float(len(rooms)), float(share), {"error_m": error}, True, rooms, fit))
    return tuple(ranked)


MATCHING_FORMAT = 1


def serialise_matching(matching: Matching, a: TopometricMap, b: TopometricMap) -> dict[str, Any]:
    """Return rooms with their probabilities and all hypotheses; matrices are row-major and map points of the file of b into
    the frame of that of a."""
    rows = zip(matching.rooms.tolist(), matching.probability.tolist(), strict=True)
    listing = {
        "format": MATCHING_FORMAT,
        "maps": [describe_map(m) for m in (a, b)],
        "matches": [{"rooms": rooms, "probability": round(p, 4)} for rooms, p in rows],
        "hypotheses": [
            _serialise_hypothesis(h, convert_pose_to_files(h.transform, b.levelling, a.levelling)) for h in matching.alternatives
        ],
        "turns": [{"yaw": turn.yaw, "probability": round(turn.probability, 4)} for turn in matching.turns],
        "statistics": dict(matching.statistics),
    }
    out: dict[str, Any] = convert_to_plain(listing)
    return out


def describe_map(map: TopometricMap) -> dict[str, Any]:
    """Describe a map for a listing of several: its file, rooms and storeys, its corrections, and how it was levelled."""
    levelled = {} if is_level(map.levelling) else {LEVELLED: map.levelling.tolist()}
    edited = {EDITED: map.parameters[EDITED]} if EDITED in map.parameters else {}
    return {"source": map.source, "rooms": len(map.rooms), "storeys": len(map.storeys), **edited, **levelled}


def _serialise_hypothesis(h: PoseHypothesis, matrix: Array) -> dict[str, Any]:
    return {
        "probability": round(h.probability, 4),
        "score": round(h.score, 3),
        "transform": {"matrix": matrix.tolist(), "scale": h.transform.scale, "yaw": h.transform.yaw},
        "rooms": h.rooms.tolist(),
        "evidence": dict(h.features),
    }


def format_matching(matching: Matching, a: TopometricMap, b: TopometricMap) -> str:
    """Return the table that `topomerge match` prints."""
    lines = [f"{len(matching.rooms)} matches of {len(a.rooms)} and {len(b.rooms)} rooms"]
    if len(matching.rooms):
        lines += ["", "room a  area m2   room b  area m2   probability"]
    for (i, j), p in zip(matching.rooms.tolist(), matching.probability.tolist(), strict=True):
        lines.append(f"{i:>6}  {a.rooms['area'][i]:>7.1f}   {j:>6}  {b.rooms['area'][j]:>7.1f}   {p:>11.2f}")
    if matching.alternatives:
        lines += ["", "hypothesis  probability  matches  yaw deg        x        y        z  scale"]
    for k, h in enumerate(matching.alternatives[:5]):
        numbers = "  ".join(f"{v:>7.2f}" for v in h.transform.translation)
        yaw = math.degrees(h.transform.yaw)
        lines.append(f"{k:>10}  {h.probability:>11.2f}  {len(h.rooms):>7}  {yaw:>7.1f}  {numbers}  {h.transform.scale:>5.3f}")
    return "\n".join([*lines, *format_turns(matching)])


COUNT_WORDS = {2: "two", 3: "three", 4: "four"}


def format_turns(matching: Matching) -> list[str]:
    """Return a line that names the turns that fit, where more than one does."""
    degrees = sorted(round(math.degrees(turn.yaw)) for turn in matching.fitting_turns)
    if len(degrees) < 2:
        return []
    named = f"{', '.join(map(str, degrees[:-1]))} and {degrees[-1]}"
    return ["", f"{COUNT_WORDS.get(len(degrees), str(len(degrees)))} turns fit ({named} degrees)"]
