"""Is a narrowing of the floor a door? A small network trained on simulated buildings (`train.py task=door_classification`).

The findings' rule (a passage that has less than 0.7 of the narrower side's width is a door) leaves open what a lintel, a wall in
line with the opening or a step of the ceiling say; these are weighed by what simulated scans of training buildings show.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.plans.passages import DOOR_FEATURES
from topomerge.io.weight_files import weights_file
from topomerge.numpy_nn import perceptron, sigmoid
from topomerge.types import Array

DOOR_CLASSIFIER_FILE = "door_classifier.json"


def door_probability(x: Array) -> Array:
    """(n,) probability that a door parts the two sides of each narrowing, from its (n, 17) features."""
    weights = read_classifier(weights_file("topomerge.extraction.plans", DOOR_CLASSIFIER_FILE))
    h = (np.clip(x, weights["low"], weights["high"]) - weights["mean"]) / weights["scale"]
    return sigmoid(perceptron(h, weights["layers"])[:, 0])


@lru_cache(maxsize=4)
def read_classifier(path: Path) -> dict[str, Any]:
    """Range, mean and scale of the features, and (weight, bias) of each layer.

    Raises:
        InputError: damaged, or trained with other features.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        arrays: dict[str, Any] = {key: np.array(values[key], float) for key in ("low", "high", "mean", "scale")}
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise ValueError("not finite")
        layers = [(np.array(w, float), np.array(b, float)) for w, b in values["layers"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: is no door classifier ({reason}); install topomerge again") from error
    if tuple(values["features"]) != DOOR_FEATURES:
        raise InputError(f"{path}: was trained with other features: run train.py task=door_classification export=package")
    return {**arrays, "layers": layers}
