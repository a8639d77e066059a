"""Passages between segments: all evidence of a door in each, gathered before anything is cut (beyond the thesis: docs/adr/0024).

A passage is where two segments meet. What the plan shows of it is measured (`plans.passages`). Here comes what its walls show,
what the plan network sees about it, and whether the sensor was carried through it. One score decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.elevations.wall_doors import SUREST, WALL_DOOR_FEATURES, door_candidates, door_chance
from topomerge.extraction.plans.door_classifier import door_probability
from topomerge.extraction.plans.passages import Pair, Passage, door_features, pair_of
from topomerge.extraction.segment import Scorer, SegmentedStorey, find_segments, log_odds, score_by_plan
from topomerge.extraction.walked_doors import SENSOR_HEIGHT, WAY_STEP
from topomerge.io.weight_files import read_weights_json
from topomerge.numpy_nn import sigmoid
from topomerge.types import EDGE_DTYPE, Array

# Of a passage, beside the plan: log odds of a door by walls, plan network and plan together (`door_chance`), and of a doorway
# that walls show there, on average along it; 0 or 1: the sensor was carried through, a doorway split the segment.
EVIDENCE = ("door", "shown", "walked", "within")
# What the score weighs: log odds by the plan, of a doorway that walls show, and against a door where somebody walked; 0 or 1.
SCORE_INPUTS = ("constant", "plan", "shown", "walked without door", "within")
KINDS = ("walls",)  # of scans that have a model: walls show at heights
PASSAGES_FILE = "passages.json"
MOST_LOG_ODDS = 8.0
WAY_SAMPLE = 0.05  # m along the sensor's way


def find_passages(
    storeys: Sequence[SegmentedStorey],
    walls: StoreyWalls | None,
    places: Array,
    weigh: bool = True,
) -> list[SegmentedStorey]:
    """Gather the evidence of every passage of all storeys; they come back with it.

    Args:
        walls: None of a scan that shows none at heights.
        places: (n, 3) m, where the sensor was, in its order; may be empty.
        weigh: do walls and plan network have a say? Of joined maps the rooms of their parts have it.
    """
    door, shown = _score_doors(storeys, walls) if weigh else ({}, {})
    walked = find_crossings(storeys, places)
    out, first = [], 0
    for storey in storeys:
        passages = {}
        for (a, b), passage in storey.passages.items():
            pair = (a + first, b + first)
            flags = float(pair in walked), float((a, b) in storey.split)
            evidence = (door.get(pair, 0.0), shown.get(pair, 0.0), *flags)
            passages[a, b] = replace(passage, evidence=evidence)
        out.append(replace(storey, passages=passages))
        first += storey.count
    return out


def score_passages(x: Array, passages: Sequence[Passage], weights: Array) -> Array:
    """(n,) calibrated probability that a door parts the two sides of each passage, by all evidence.

    Args:
        x: (n, 17) `DOOR_FEATURES` of the sides as they have grown.
        weights: (5,) of `SCORE_INPUTS`.
    """
    evidence = np.array([passage.evidence for passage in passages], float)
    return sigmoid(compute_inputs(log_odds(door_probability(x)), evidence) @ weights)


def choose_scorer(walls: bool) -> Scorer:
    """The score of a scan's passages: by all evidence; of slices, raised plans and joined maps by plan and parts.

    Args:
        walls: does the scan show walls at heights, and is it of one map?

    Raises:
        InputError: the weights that ship are damaged.
    """
    if not walls:
        return score_by_plan
    weights = np.array(read_weights_json("topomerge.extraction", PASSAGES_FILE).get("walls", ()), float)
    if weights.shape != (len(SCORE_INPUTS),) or not np.isfinite(weights).all():
        numbers = f"walls must be {len(SCORE_INPUTS)} numbers"
        raise InputError(f"{PASSAGES_FILE}: {numbers}: run train.py task=passages export=package")
    return partial(score_passages, weights=weights)


def compute_inputs(plan: Array, evidence: Array) -> Array:
    """(n, 5) `SCORE_INPUTS` of passages.

    Args:
        plan: (n,) log odds of a door by the plan alone.
        evidence: (n, 4) `EVIDENCE`.
    """
    plan = np.clip(plan, -MOST_LOG_ODDS, MOST_LOG_ODDS)
    door, shown, walked, within = evidence.T
    return np.column_stack([np.ones(len(plan)), plan, np.maximum(shown, 0), walked * np.minimum(door, 0), within])


def find_crossings(storeys: Sequence[SegmentedStorey], places: Array) -> set[Pair]:
    """Find the pairs of segments between which the sensor was carried."""
    places = np.asarray(places, np.float64)
    places = places[np.isfinite(places).all(axis=1)]
    if len(places) < 2:
        return set()
    step = np.hypot(*(places[1:] - places[:-1])[:, :2].T)
    ways = []
    for a, b, length in zip(places[:-1], places[1:], step.tolist(), strict=True):
        if length <= WAY_STEP:
            ways.append(a + np.linspace(0, 1, max(int(np.ceil(length / WAY_SAMPLE)), 1), endpoint=False)[:, None] * (b - a))
        ways.append(np.full((0 if length <= WAY_STEP else 1, 3), np.nan))
    way = np.concatenate([*ways, places[-1:]])
    broken = np.isnan(way[:, 0])
    segment = find_segments(storeys, np.where(broken[:, None], -1e9, way), SENSOR_HEIGHT)
    segment[broken] = -2
    segment = segment[segment != -1]
    change = (segment[1:] != segment[:-1]) & (segment[1:] >= 0) & (segment[:-1] >= 0)
    return {pair_of(int(a), int(b)) for a, b in zip(segment[:-1][change], segment[1:][change], strict=True)}


def _score_doors(storeys: Sequence[SegmentedStorey], walls: StoreyWalls | None) -> tuple[dict[Pair, float], dict[Pair, float]]:
    """Log odds of the likeliest door between each two segments, of all that anything shows; and of the surest doorway that walls
    show."""
    edges, first = [np.zeros(0, EDGE_DTYPE)], 0
    for storey in storeys:
        edges.append(_edges_of(storey, first))
        first += storey.count
    complete = np.concatenate([np.zeros(0), *(storey.completeness for storey in storeys)])
    candidates = door_candidates(np.concatenate(edges), complete, [storey.classes for storey in storeys], walls)
    chance = np.clip(door_chance(candidates), SUREST, 1 - SUREST)
    mean = candidates.features[:, WALL_DOOR_FEATURES.index("wall_mean")]
    door: dict[Pair, float] = {}
    shown: dict[Pair, float] = {}
    for rooms, odds, seen in zip(
        candidates.edges["rooms"].tolist(), np.log(chance / (1 - chance)).tolist(), mean.tolist(), strict=True
    ):
        pair = pair_of(*rooms)
        door[pair] = max(door.get(pair, -np.inf), odds)
        shown[pair] = max(shown.get(pair, 0.0), seen)
    return door, shown


def _edges_of(storey: SegmentedStorey, first: int) -> Array:
    """EDGE_DTYPE of a storey's passages, between segments numbered from `first` on."""
    out = np.zeros(len(storey.passages), EDGE_DTYPE)
    if not len(out):
        return out
    peak = np.zeros(storey.count)
    inside = storey.segment >= 0
    np.maximum.at(peak, storey.segment[inside], storey.clearance[inside])
    area = storey.areas
    pairs = list(storey.passages)
    x = np.array([door_features(storey.passages[p], peak[list(p)], area[list(p)]) for p in pairs])
    out["confidence"] = door_probability(x)
    for row, pair in zip(out, pairs, strict=True):
        passage = storey.passages[pair]
        row["rooms"], row["centre"], row["width"] = np.array(pair) + first, storey.centre_of(passage), passage.width
        row["direction"], row["open"] = np.arctan2(passage.across[0], -passage.across[1]) % np.pi, True
        row["kind"] = "door"
    return out
