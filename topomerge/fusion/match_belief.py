"""How likely two rooms that `match` names are one, with what both maps show under the pose that it proposes, and with how the two
rooms lie on each other there.

Logistic models of what matching says and of the network of places, fitted by ``train.py task=match_belief``; their weights stand
in `match_belief.json`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.matching.consistency import measure_common_floor
from topomerge.matching.match import Matching
from topomerge.matching.poses import PlanFields
from topomerge.matching.room_plans import build_room_plans
from topomerge.numpy_nn import sigmoid
from topomerge.registration.places import MOST_ODDS, Places, score_places
from topomerge.registration.storeys import build_plans
from topomerge.registration.verify import PLACE_AREA
from topomerge.types import Array, TopometricMap

BELIEF_FILE = "match_belief.json"
BELIEVED_METHODS = ("attention",)  # that are told better so; walls decide for "consistent", whose odds are as good without
BELIEF_NAMES = ("constant", "matching", "places", "room", "overlap", "overlap_placed")
SUREST = 1e-3  # probabilities of matching are that far from 0 and 1 at least
ROOM_RIM = 1.5  # m around a room from which places speak for it, too: a tile is wider than most walls are apart
SAME_FLOOR = 1.0  # m


def update_match_probabilities(matching: Matching, a: TopometricMap, b: TopometricMap, method: str) -> Matching:
    """Return the same matches, with probabilities that the places of both maps have a say in.

    Those of other methods than `BELIEVED_METHODS`, or without a pose, or of maps without cells, stay as they are.

    Raises:
        InputError: the weights are damaged.
    """
    if method not in BELIEVED_METHODS or matching.transform is None or not len(matching.rooms):
        return matching
    if not len(a.grid) or not len(b.grid):
        return matching
    x = compute_belief_features(matching, a, b, find_places(matching, a, b))
    return replace(matching, probability=1 / (1 + np.exp(-np.clip(x @ load_belief_weights(method), -50, 50))))


def find_places(matching: Matching, a: TopometricMap, b: TopometricMap) -> Places:
    """Cut out the places that both maps show under the pose of a matching, and score each."""
    assert matching.transform is not None
    storeys = [[PlanFields(plan) for plan in build_plans(map)] for map in (a, b)]
    return score_places(storeys[0], storeys[1], matching.transform)


def load_belief_weights(method: str) -> Array:
    """Return (6,) weights of `BELIEF_NAMES` for one of `BELIEVED_METHODS`.

    Raises:
        InputError: the file holds none of that length.
    """
    weights = np.array(read_weights_json("topomerge.fusion", BELIEF_FILE).get(method, ()), float)
    if weights.shape != (len(BELIEF_NAMES),) or not np.isfinite(weights).all():
        requested = f"{method} must be {len(BELIEF_NAMES)} numbers"
        raise InputError(f"{BELIEF_FILE}: {requested}: run train.py task=match_belief export=package")
    return weights


def compute_belief_features(matching: Matching, a: TopometricMap, b: TopometricMap, seen: Places) -> Array:
    """Return (M, 6) of each match: 1, log odds by matching, what all places say, what those around the room of a say (mean log
    odds; 0 of none), share 0..1 of the floor of the smaller room that lies on the other, and that share times the probability of
    all places: rooms lie on each other under many a wrong pose."""
    whole_features = seen.features
    p = np.clip(matching.probability, SUREST, 1 - SUREST)
    whole = np.full(len(p), whole_features["place_mean"] * np.log1p(whole_features["place_area"] / PLACE_AREA))
    around = np.array([average_room_places(seen, a, room) for room in matching.rooms[:, 0].tolist()])
    shared = measure_shared_floor(matching, a, b)
    return np.column_stack([np.ones(len(p)), np.log(p / (1 - p)), whole, around, shared, shared * sigmoid(whole)])


def measure_shared_floor(matching: Matching, a: TopometricMap, b: TopometricMap) -> Array:
    """Return (M,) share 0..1 of the floor of the smaller room of each match that lies on the other's under the pose."""
    assert matching.transform is not None
    plans, (i, j) = (build_room_plans(a), build_room_plans(b)), matching.rooms.T
    area = np.minimum(plans[0].areas[i], plans[1].areas[j] * matching.transform.scale**2)
    common = measure_common_floor(matching.transform, plans)[i, j]
    return np.asarray(np.clip(common / np.maximum(area, 1e-9), 0, 1))


def average_room_places(seen: Places, a: TopometricMap, room: int) -> float:
    """Return mean log odds of the places in and around a room of a, by the m2 that both maps saw of each; 0 of none."""
    middle, row = seen.crops.middle, a.rooms[room]
    near = ((middle[:, :2] > row["lo"][:2] - ROOM_RIM) & (middle[:, :2] < row["hi"][:2] + ROOM_RIM)).all(axis=1)
    near &= np.abs(middle[:, 2] - a.storeys["floor"][row["storey"]]) < SAME_FLOOR
    area = seen.crops.area[near]
    return float(np.average(np.clip(seen.log_odds[near], -MOST_ODDS, MOST_ODDS), weights=area)) if len(area) else 0.0
