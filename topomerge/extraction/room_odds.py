"""How likely a room is one, was seen as a whole, was entered, and lies outside: logistic models over `room_features`.

Fitted to simulated scans of training buildings by ``train.py task=room_odds``; the weights stand in `room_odds.json`. Where the
places of the sensor are known, they say who was where; elsewhere, what of each room was seen. Robots' grids and drawings have
models of their own, as they show neither ceilings nor how high things are, and free floor wherever a ray went.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.room_features import GRID_FEATURES, POSE_FEATURES, ROOM_FEATURES, pose_features, room_features
from topomerge.io.weight_files import read_weights_json
from topomerge.numpy_nn import sigmoid
from topomerge.types import ROOM_ODDS, Array, TopometricMap

ROOM_ODDS_FILE = "room_odds.json"
ENTERED_BY_POSES = "entered_by_poses"  # the model of `entered` that knows the sensor's places
COVER = ROOM_FEATURES.index("map_ceiling")
STANDARD = ("low", "high", "mean", "scale")  # of the features: what they are clipped to and divided by


class Family(NamedTuple):
    """Models that are fitted to the same scans and share what their features are divided by.

    Args:
        key: in `room_odds.json`; empty: at its top.
        features: names.
        lengths: number of weights of each model.
    """

    key: str
    features: tuple[str, ...]
    lengths: dict[str, int]


_SCAN_LENGTH, _GRID_LENGTH = 1 + 3 * len(ROOM_FEATURES), 1 + 2 * len(GRID_FEATURES)
SCANS = Family(
    "",
    (*ROOM_FEATURES, *POSE_FEATURES),
    {**dict.fromkeys(("confidence", "whole", "entered"), _SCAN_LENGTH), ENTERED_BY_POSES: _SCAN_LENGTH + len(POSE_FEATURES)},
)
OPEN_SCANS = Family("open", ROOM_FEATURES, {"outside": _SCAN_LENGTH})  # of buildings with their surroundings
GRIDS = Family("grids", GRID_FEATURES, dict.fromkeys(ROOM_ODDS, _GRID_LENGTH))
FAMILIES = {"scans": SCANS, "open": OPEN_SCANS, "grids": GRIDS}


def with_room_odds(map: TopometricMap, rays: tuple[Array, Array] | None = None, raised: bool = False) -> TopometricMap:
    """The map with the probabilities of its rooms; those that were probably not entered are `glimpsed`.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m; None where they are unknown.
        raised: is it a robot's grid or a drawing?

    Raises:
        InputError: the weights that ship are damaged.
    """
    rooms = map.rooms.copy()
    weights = room_weights()
    x = room_features(map, GRID_FEATURES if raised else ROOM_FEATURES)
    for family in (GRIDS,) if raised else (SCANS, OPEN_SCANS):
        for name in family.lengths:
            if name in ROOM_ODDS:
                rooms[name] = odds_of(weights, family, name, x)
    poses = None if raised else pose_features(map, rays)
    if poses is not None:
        rooms["entered"] = odds_of(weights, SCANS, ENTERED_BY_POSES, x, poses)
    rooms["glimpsed"] = rooms["entered"] < 0.5
    return replace(map, rooms=rooms)


def odds_of(weights: dict[str, Any], family: Family, name: str, x: Array, poses: Array | None = None) -> Array:
    """(R,) probability by the model of a name.

    Args:
        weights: as `room_weights` gives them.
        x: (R, F) features of the family.
        poses: (R, 2) of `pose_features`, for the model that takes them.
    """
    of_family = weights[family.key] if family.key else weights
    return sigmoid(np.clip(model_inputs(of_family, family, x, poses) @ np.asarray(of_family[name], float), -30, 30))


def model_inputs(standard: dict[str, Any], family: Family, x: Array, poses: Array | None = None) -> Array:
    """(R, 1 + k F) what the models weigh: 1, the features in units of their spread, those times the map's share of ceiling, for
    where no ceiling is seen other things count (not of grids, which have none), and their squares."""
    low, high, mean, scale = (np.asarray(standard[part], float) for part in STANDARD)
    z = (np.clip(x, low, high) - mean) / scale
    by_ceiling = [] if family is GRIDS else [z * (2 * x[:, [COVER]] - 1)]
    columns = [np.ones((len(x), 1)), z, *by_ceiling, z**2]
    return np.concatenate(columns if poses is None else [*columns, poses], axis=1)


def room_weights() -> dict[str, Any]:
    """The weights that are in use.

    Raises:
        InputError: damaged, or fitted to other features.
    """
    weights = read_weights_json("topomerge.extraction", ROOM_ODDS_FILE)
    for family in FAMILIES.values():
        _check(weights.get(family.key, {}) if family.key else weights, family)
    return weights


def _check(weights: Any, family: Family) -> None:
    """Refuse weights of a family that are damaged or were fitted to other features."""
    if not isinstance(weights, dict) or weights.get("features") != list(family.features):
        raise InputError(f"{ROOM_ODDS_FILE}: was fitted to other features: run train.py task=room_odds export=package")
    count = len([name for name in family.features if name not in POSE_FEATURES])
    for name, length in {**dict.fromkeys(STANDARD, count), **family.lengths}.items():
        values = np.array(weights.get(name, ()), float)
        if values.shape != (length,) or not np.isfinite(values).all():
            raise InputError(f"{ROOM_ODDS_FILE}: {name} must be {length} numbers: run train.py task=room_odds export=package")
