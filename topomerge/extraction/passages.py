"""Passages between segments: all evidence of a door in each, gathered before anything is cut (beyond the thesis: docs/adr/0024).

A passage is where two segments meet. What the plan shows of it is measured (`plans.passages`). Here comes what its walls show,
and whether a doorway split a segment there. One score decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.elevations.wall_doors import SUREST, WALL_DOOR_FEATURES, door_candidates, door_chance
from topomerge.extraction.plans.passages import Pair, Passage, door_features, door_probability, pair_of
from topomerge.extraction.segment import Scorer, SegmentedStorey, log_odds, score_by_plan
from topomerge.io.weight_files import read_weights_json
from topomerge.numpy_nn import sigmoid
from topomerge.types import EDGE_DTYPE, Array

# Of a passage, beside the plan: log odds of a doorway that walls show there, on average along it, 0 where they show none or speak
# against one; 0 or 1: a doorway split the segment; log odds of a door by plan and plan network, of scans that show no walls.
EVIDENCE = ("shown", "within", "door")
SCORE_INPUTS = ("constant", "plan", "shown", "within")  # what the score weighs; of the plan its log odds
KINDS = ("walls",)  # of scans that have a model: walls show at heights
PASSAGES_FILE = "passages.json"
MOST_LOG_ODDS = 8.0


def find_passages(storeys: Sequence[SegmentedStorey], walls: StoreyWalls | None, weigh: bool = True) -> list[SegmentedStorey]:
    """Gather the evidence of every passage of all storeys; they come back with it.

    Args:
        walls: None of a scan that shows none at heights.
        weigh: do walls and plan network have a say? Of joined maps the rooms of their parts have it.
    """
    told = _score_doors(storeys, walls) if weigh else {}
    out, first = [], 0
    for storey in storeys:
        passages = {}
        for (a, b), passage in storey.passages.items():
            pair = (a + first, b + first)
            odds, within = told.get(pair, 0.0), float((a, b) in storey.split)
            passages[a, b] = replace(passage, evidence=(0.0, within, odds) if walls is None else (odds, within, 0.0))
        out.append(replace(storey, passages=passages))
        first += storey.count
    return out


def score_passages(x: Array, passages: Sequence[Passage], weights: Array) -> Array:
    """(n,) calibrated probability that a door parts the two sides of each passage, by all evidence.

    Args:
        x: (n, 17) `DOOR_FEATURES` of the sides as they have grown.
        weights: (4,) of `SCORE_INPUTS`.
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
    """(n, 4) `SCORE_INPUTS` of passages.

    Args:
        plan: (n,) log odds of a door by the plan alone.
        evidence: (n, 3) `EVIDENCE`.
    """
    plan = np.clip(plan, -MOST_LOG_ODDS, MOST_LOG_ODDS)
    return np.column_stack([np.ones(len(plan)), plan, evidence[:, :2]])


def _score_doors(storeys: Sequence[SegmentedStorey], walls: StoreyWalls | None) -> dict[Pair, float]:
    """Log odds of the surest doorway that walls show between each two segments, none below 0; of the likeliest door by plan and
    plan network, where no walls show."""
    edges, first = [np.zeros(0, EDGE_DTYPE)], 0
    for storey in storeys:
        edges.append(_edges_of(storey, first))
        first += storey.count
    complete = np.concatenate([np.zeros(0), *(storey.completeness for storey in storeys)])
    candidates = door_candidates(np.concatenate(edges), complete, [storey.classes for storey in storeys], walls)
    if walls is None:
        odds = log_odds(np.clip(door_chance(candidates), SUREST, 1 - SUREST))
    else:
        odds = np.maximum(candidates.features[:, WALL_DOOR_FEATURES.index("wall_mean")], 0)
    told: dict[Pair, float] = {}
    for rooms, value in zip(candidates.edges["rooms"].tolist(), odds.tolist(), strict=True):
        told[pair_of(*rooms)] = max(told.get(pair_of(*rooms), -np.inf), value)
    return told


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
        row["rooms"], row["centre"], row["width"] = np.array(pair) + first, storey.locate_centre(passage), passage.width
        row["direction"], row["open"] = np.arctan2(passage.across[0], -passage.across[1]) % np.pi, True
        row["kind"] = "door"
    return out
