"""Small scorers of a few weights, in NumPy: logistic ones and a perceptron. Networks are run by `topomerge.networks`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topomerge.types import Array


def sigmoid(x: Array) -> Array:
    """Return logits as probabilities."""
    return np.asarray(1 / (1 + np.exp(-x)))


def softmax(logits: Array) -> Array:
    """Return logits as probabilities that sum to 1 along the last axis."""
    weight = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def apply_mlp(x: Array, layers: Sequence[tuple[Array, Array]]) -> Array:
    """Return (n, in) -> (n, out): linear layers (weight (in, out), bias (out,)), rectified between each other."""
    for k, (weight, bias) in enumerate(layers):
        x = (np.maximum(x, 0) if k else x) @ weight + bias
    return x
