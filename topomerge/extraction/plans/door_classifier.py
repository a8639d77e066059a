"""Is a narrowing of the floor a door? A small network trained on simulated buildings (benchmarks/training/train_judge.py).

The findings' rule (a passage that has less than 0.7 of the narrower side's width is a door) leaves open what a lintel, a wall in
line with the opening or a step of the ceiling say; these are weighed by what simulated scans of training buildings show.
"""

from __future__ import annotations

import json
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np

from topomerge.extraction.plans.passages import FEATURES
from topomerge.numpy_nn import perceptron, sigmoid
from topomerge.types import Array

FILE = "door_classifier.json"


def door_probability(x: Array) -> Array:
    """(n,) probability that a door parts the two sides of each narrowing, from its (n, 17) features."""
    weights = _weights()
    h = (np.clip(x, weights["low"], weights["high"]) - weights["mean"]) / weights["scale"]
    return sigmoid(perceptron(h, weights["layers"])[:, 0])


@lru_cache(maxsize=1)
def _weights() -> dict[str, Any]:
    about = json.loads(resources.files("topomerge.extraction.plans").joinpath(FILE).read_text())
    if tuple(about["features"]) != FEATURES:
        raise ValueError(f"{FILE} was trained with other features: run benchmarks/training/train_judge.py")
    arrays = {key: np.array(about[key]) for key in ("low", "high", "mean", "scale")}
    return {**arrays, "layers": [(np.array(w), np.array(b)) for w, b in about["layers"]]}
