"""The network that says which rooms of two maps are one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from topomerge.archive import find_weights_file
from topomerge.embedding.quarter_turns import (
    FACTS,
    QUARTERS,
    Rows,
    Turn,
    TurnedRows,
    compute_shares,
    estimate_turns,
)
from topomerge.errors import InputError
from topomerge.kernels.registration import sum_votes
from topomerge.networks.network import WEIGHTS_PACKAGE, Run, Signature, Tensor, load_network, read_card
from topomerge.types import Array

MATCHER_FILE = "room_matcher.onnx"
ATTENTION_HEADS = 4
# Displacements, not coordinates: maps are turned to their walls, so that these are the same in both (docs/adr/0017).
RINGS = np.array([0.0, 2.0, 4.0, 7.0, 11.0, 16.0, 24.0])  # m: how far another room is
RING_WIDTH = (0.5, 0.3)  # m, and share of the ring's distance
WAY_SOFT = 3.0  # m, at which half of the way to a room is told by its direction
CLIMB_UNIT = 3.0  # m
WAY_FACTS = 2 + len(RINGS) + 1
AGREEMENT = (1.5, 5.0)  # m by which ways that agree differ at most
VOTE_UNIT = 3.0  # votes are logarithms of 1 + so many times their sum
LEVEL_GAP = 0.8  # m: storeys of ways that agree differ by less
VOTERS = 3  # pairs of rooms that vote, times the number of rooms of both maps,
MOST_VOTERS = 2000  # and at most
# Pairs of rooms grow with the product of both maps (docs/adr/0017).
MOST_VOTED = 20_000  # pairs of rooms that are voted for, the likeliest ones
FIRST_SHARPNESS = 25.0  # that cosines are multiplied with for the first votes
LIKENESS_SCALE = 10.0  # that likeness is multiplied with, times what is learned
LEAST_TURN = 1e-4  # probability of a turn by rows alone, below which the network does not look at it
UNUSUAL = 4.0  # standard deviations by which a fact differs from what is usual, at most
MOST_SIZE = 4096  # of a network; more is a mistake, or a file that was made to take all memory


@dataclass(frozen=True, eq=False)
class Matcher:
    """The network, and what is to be known to run it.

    Args:
        run: as of `build_signature`.
        width: numbers of a room within the network.
        stages: that it has.
        embedder: hash of the embedder whose rows it takes.
    """

    run: Run
    width: int
    stages: int
    embedder: str


@dataclass(frozen=True, eq=False)
class RoomsSeen:
    """Inputs of the network from the rooms of a map.

    Args:
        rows: (R, 4 D) of length 1, of the map as it is turned (`TurnedRows.flatten`).
        places: (R, 2) m, middles of the rooms in the direction of the walls.
        heights: (R,) m.
        facts: (R, FACTS).
    """

    rows: Array
    places: Array
    heights: Array
    facts: Array


@dataclass(frozen=True, eq=False)
class RoomOdds:
    """Which room of the other map is each room?

    Args:
        rows: (R_a, R_b + 1) probability of each partner of each room of a, in the last place none.
        columns: (R_b, R_a + 1) likewise of the rooms of b.
        quarters: quarter turns by which b stands in a, beyond the directions of walls.
        yaw: rad, by which the frame of b is turned.
        probability: of this turn.
    """

    rows: Array
    columns: Array
    quarters: int = 0
    yaw: float = 0.0
    probability: float = 1.0

    @property
    def certainty(self) -> Array:
        """(R_a, R_b) geometric mean of the probabilities that j is i's partner and i is j's."""
        out: Array = np.sqrt(self.rows[:, :-1] * self.columns[:, :-1].T)
        return out

    @property
    def confidence(self) -> float:
        """Sum of the squares of all certainties: one sure match tells more than several doubtful ones."""
        return float((self.certainty**2).sum())


def compute_room_odds(a: Rows, b: Rows, likeliest: bool = False) -> tuple[RoomOdds, ...]:
    """Compute the partners of the rooms of two maps at each turn of the second one that may be true (`match_turns`); none where
    the rows are not those of the embedder that the network was trained with, or a map has no rooms. Which map is given first
    changes nothing.

    Args:
        likeliest: only at the turn that is likeliest by rows alone.

    Raises:
        InputError: the network is damaged.
    """
    matcher = load_matcher_weights()
    for rows in (a, b):
        # Rows of another embedder mean something else: the weights name theirs by its hash (docs/adr/0017).
        if not isinstance(rows, TurnedRows) or not len(rows) or rows.facts is None or rows.embedder != matcher.embedder:
            return ()
    assert isinstance(a, TurnedRows) and isinstance(b, TurnedRows)
    if _compute_order_key(b) < _compute_order_key(a):  # rows are read as they are turned: the second map as the first one stands
        return tuple(
            RoomOdds(odds.columns, odds.rows, -odds.quarters % QUARTERS, -odds.yaw, odds.probability)
            for odds in match_turns(b, a, matcher, likeliest)
        )
    return match_turns(a, b, matcher, likeliest)


def match_turns(a: TurnedRows, b: TurnedRows, matcher: Matcher, likeliest: bool = False) -> tuple[RoomOdds, ...]:
    """Run the network at each turn that is not unlikely by rows alone. What it is sure of is evidence: the logarithm of a turn's
    probability by rows (`estimate_turns`) and the confidence at it add up.

    Args:
        a, b: rows with facts.
        likeliest: only at the likeliest turn.
    """
    turns = estimate_turns(a, b)
    if likeliest:
        turns = (max(turns, key=lambda turn: turn.probability),)
    turns = tuple(turn for turn in turns if turn.probability >= LEAST_TURN)
    found = [_match_turn(turn, matcher) for turn in turns]
    # At wrong turns no room has a partner; the network was trained with such pairs, so that its confidence tells (docs/adr/0017).
    evidence = np.log([turn.probability for turn in turns]) + [odds.confidence for odds in found]
    return tuple(replace(odds, probability=float(p)) for odds, p in zip(found, compute_shares(evidence), strict=True))


def _match_turn(turn: Turn, matcher: Matcher) -> RoomOdds:
    odds = run_network(build_rooms_seen(turn.a), build_rooms_seen(turn.b, turn.quarters), matcher)
    return replace(odds, quarters=turn.quarters, yaw=turn.yaw)


def _compute_order_key(rows: TurnedRows) -> tuple[int, float]:
    """Return the order key of two maps, the same whichever is given first."""
    assert rows.facts is not None
    return len(rows), float(rows.facts.sum())


def combine_turn_certainties(odds: Sequence[RoomOdds]) -> Array:
    """Return (R_a, R_b) certainty of pairs, the mean over turns."""
    out: Array = np.sum([turned.probability * turned.certainty for turned in odds], axis=0)
    return out


def build_rooms_seen(rows: TurnedRows, quarters: int = 0) -> RoomsSeen:
    """Return a map that is turned by so many quarter turns.

    Args:
        rows: with facts.
    """
    assert rows.facts is not None
    turned = (rows.places @ np.array([1, 1j])) * 1j**quarters
    places = np.stack([turned.real, turned.imag], axis=1)
    return RoomsSeen(rows.flatten(quarters), places - places.mean(axis=0), rows.facts[:, -1], rows.facts)


def run_network(a: RoomsSeen, b: RoomsSeen, matcher: Matcher) -> RoomOdds:
    """Run the network on two maps as they are turned, stage by stage: before each of them, pairs of rooms vote
    (`compute_agreement`)."""
    feeds: dict[str, Array] = {}
    for side, map in (("a", a), ("b", b)):
        feeds |= {f"rows_{side}": map.rows, f"facts_{side}": map.facts, f"places_{side}": map.places - map.places.mean(axis=0)}
        feeds |= {f"heights_{side}": map.heights - map.heights.mean(), f"state_{side}": np.zeros((len(map.rows), matcher.width))}
    likely = compute_first_guess(a.rows @ b.rows.T)
    # One stage a call, as pairs of rooms vote between two of them, in a compiled loop (docs/adr/0025).
    for stage in range(matcher.stages):
        feeds |= {"stage": np.arange(matcher.stages) == stage, "votes": compute_agreement(likely, a, b)}
        feeds["state_a"], feeds["state_b"], rows, columns = matcher.run(**feeds)
        likely = np.sqrt(rows[:, :-1] * columns[:, :-1].T)
    return RoomOdds(rows.astype(float), columns.astype(float))


def compute_first_guess(cosine: Array) -> Array:
    """Return (R_a, R_b) how likely each pair of rooms is by their rows alone: what votes in the first stage."""
    from scipy.special import softmax

    likely: Array = np.sqrt(softmax(FIRST_SHARPNESS * cosine, axis=1) * softmax(FIRST_SHARPNESS * cosine, axis=0))
    return likely


def compute_agreement(likely: Array, a: RoomsSeen, b: RoomsSeen) -> Array:
    """Return (R_a, R_b, 2) how much of a matching agrees with each pair of rooms on the way from one map to the other.

    Args:
        likely: (R_a, R_b) how likely each pair is.
    """
    n, m = likely.shape
    out = np.zeros((n * m, len(AGREEMENT)))
    way = (a.places[:, None] - b.places[None]).reshape(-1, 2).astype(np.float64)
    rise = (a.heights[:, None] - b.heights[None]).ravel().astype(np.float64)
    order = np.argsort(-likely, axis=None, kind="stable")
    voters, voted = order[: min(VOTERS * (n + m), MOST_VOTERS)], np.sort(order[:MOST_VOTED])
    room = np.stack(np.divmod(np.arange(n * m), m), axis=1)
    probability = likely.ravel().astype(np.float64)
    out[voted] = np.log1p(VOTE_UNIT * sum_votes(way, rise, room, probability, voted, voters, np.array(AGREEMENT), LEVEL_GAP))
    return out.reshape(n, m, len(AGREEMENT))


@lru_cache(maxsize=8)
def build_signature(numbers: int, width: int, stages: int) -> Signature:
    """Describe a network that matches rooms.

    Args:
        numbers: of a room's rows, 4 D.
        width: numbers of a room within the network.
        stages: of the network, the first of which has no attention.
    """
    inputs = {"stage": Tensor((stages,), "1 for the one to run, else 0; the first one has no attention", "int64")}
    for side in "ab":
        rooms = f"rooms_{side}"
        inputs |= {
            f"rows_{side}": Tensor((rooms, numbers), "rows of the embedder for four quarter turns"),
            f"facts_{side}": Tensor((rooms, FACTS), "logarithms of what is known of rooms, dustbin, height in m"),
            f"places_{side}": Tensor((rooms, 2), "m, middles of the rooms in the direction of the walls"),
            f"heights_{side}": Tensor((rooms,), "m"),
            f"state_{side}": Tensor((rooms, width), "what the stage before gave; the first one reads none"),
        }
    inputs["votes"] = Tensor(("rooms_a", "rooms_b", len(AGREEMENT)), "log(1 + 3 times the votes of pairs that are moved alike)")
    outputs = {f"next_{side}": Tensor((f"rooms_{side}", width), "state of the rooms after the stage") for side in "ab"}
    for name, side in (("rows", "a"), ("columns", "b")):
        outputs[name] = Tensor((f"rooms_{side}", "partners"), "probability that a room of the other map is it, then that none is")
    return Signature("Says which rooms of two maps are one; each call runs one stage.", inputs, outputs)


def load_matcher_weights() -> Matcher:
    """Load the network that ships, or the one in its place (`archive.find_weights_file`)."""
    return read_matcher(find_weights_file(WEIGHTS_PACKAGE, MATCHER_FILE))


def read_matcher(path: Path) -> Matcher:
    """Load the network of a file.

    Raises:
        InputError: another file, or a damaged one.
    """
    card = read_card(path)
    try:
        numbers, width = int(card["inputs"]["rows_a"]["shape"][1]), int(card["settings"]["width"])
        stages, embedder = int(card["settings"]["layers"]) + 1, str(card["data"]["embedder"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: its card is of no network that matches rooms ({error}); copy both files again") from error
    if not 0 < width <= MOST_SIZE or not 0 < stages <= MOST_SIZE:
        raise InputError(f"{path}: its card is of no network that matches rooms (width {width}); copy both files again")
    return Matcher(load_network(path, build_signature(numbers, width, stages)), width, stages, embedder)


COARSE_SCALES = tuple(np.exp(np.linspace(np.log(0.5), np.log(2.0), 8)).tolist())  # steps of a fifth: crops still look alike
FINE_STEP = COARSE_SCALES[1] / COARSE_SCALES[0]
RowsAt = Callable[[float], Rows]


def find_best_scale(of_a: Rows, of_b: Rows, rows_at: RowsAt) -> tuple[float, tuple[RoomOdds, ...]]:
    """Return the metres that the unit of the second map is taken for, and the partners of the rooms of both maps at each likely
    turn then; 1 and none where the rows are of an embedder for which there is no such network.

    Args:
        of_a: rows of the first map, whose scale is known.
        of_b: rows of the second one as it is.
        rows_at: scale -> rows of the second one (`LearnedEmbedder.at_scales`).
    """
    if not compute_room_odds(of_a, of_b, likeliest=True):
        return 1.0, ()
    rows: dict[float, Rows] = {}

    def compute_confidence(scale: float) -> float:
        """Compute the confidence at the turn that is likeliest by rows alone: all of them take longer."""
        rows[scale] = rows[scale] if scale in rows else rows_at(scale)
        return compute_room_odds(of_a, rows[scale], likeliest=True)[0].confidence

    best = max(COARSE_SCALES, key=compute_confidence)
    best = max([best, best / FINE_STEP**0.5, best * FINE_STEP**0.5], key=compute_confidence)
    return best, compute_room_odds(of_a, rows[best])
