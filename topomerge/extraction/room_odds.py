"""How likely a room is one, was seen as a whole, was entered, and lies outside: logistic models over `room_features`.

Fitted to simulated scans of training buildings by ``train.py task=room_odds``; the weights stand in `room_odds.json`. Where the
places of the sensor are known, they say who was where; elsewhere, what of each room was seen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.room_features import POSE_FEATURES, ROOM_FEATURES, pose_features, room_features
from topomerge.io.weight_files import read_weights_json
from topomerge.numpy_nn import sigmoid
from topomerge.types import ROOM_ODDS, Array, TopometricMap

ROOM_ODDS_FILE = "room_odds.json"
ENTERED_BY_POSES = "entered_by_poses"  # the model of `entered` that knows the sensor's places
COVER = ROOM_FEATURES.index("map_ceiling")
MODEL_LENGTHS = {name: 1 + 3 * len(ROOM_FEATURES) for name in ROOM_ODDS}
MODEL_LENGTHS |= {ENTERED_BY_POSES: 1 + 3 * len(ROOM_FEATURES) + len(POSE_FEATURES)}
STANDARD = ("low", "high", "mean", "scale")  # of the features: what they are clipped to and divided by


def with_room_odds(map: TopometricMap, rays: tuple[Array, Array] | None = None) -> TopometricMap:
    """The map with the probabilities of its rooms; those that were probably not entered are `glimpsed`.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m; None where they are unknown.

    Raises:
        InputError: the weights that ship are damaged.
    """
    rooms = map.rooms.copy()
    weights = room_weights()
    x, poses = room_features(map), pose_features(map, rays)
    for name in ROOM_ODDS:
        rooms[name] = odds_of(weights, name, x)
    if poses is not None:
        rooms["entered"] = odds_of(weights, ENTERED_BY_POSES, x, poses)
    rooms["glimpsed"] = rooms["entered"] < 0.5
    return replace(map, rooms=rooms)


def odds_of(weights: dict[str, Any], name: str, x: Array, poses: Array | None = None) -> Array:
    """(R,) probability by the model of a name.

    Args:
        weights: as `room_weights` gives them.
        x: (R, 13) of `room_features`.
        poses: (R, 2) of `pose_features`, for the model that takes them.
    """
    return sigmoid(np.clip(model_inputs(weights, x, poses) @ np.asarray(weights[name], float), -30, 30))


def model_inputs(weights: dict[str, Any], x: Array, poses: Array | None = None) -> Array:
    """(R, 40 or 42) what the models weigh: 1, the features in units of their spread, those times the map's share of ceiling, for
    where no ceiling is seen other things count, and their squares."""
    low, high, mean, scale = (np.asarray(weights[part], float) for part in STANDARD)
    z = (np.clip(x, low, high) - mean) / scale
    columns = [np.ones((len(x), 1)), z, z * (2 * x[:, [COVER]] - 1), z**2]
    return np.concatenate(columns if poses is None else [*columns, poses], axis=1)


def room_weights() -> dict[str, Any]:
    """The weights that are in use.

    Raises:
        InputError: damaged, or fitted to other features.
    """
    weights = read_weights_json("topomerge.extraction", ROOM_ODDS_FILE)
    if weights.get("features") != [*ROOM_FEATURES, *POSE_FEATURES]:
        raise InputError(f"{ROOM_ODDS_FILE}: was fitted to other features: run train.py task=room_odds export=package")
    lengths = {**dict.fromkeys(STANDARD, len(ROOM_FEATURES)), **MODEL_LENGTHS}
    for name, length in lengths.items():
        values = np.array(weights.get(name, ()), float)
        if values.shape != (length,) or not np.isfinite(values).all():
            raise InputError(f"{ROOM_ODDS_FILE}: {name} must be {length} numbers: run train.py task=room_odds export=package")
    return weights
