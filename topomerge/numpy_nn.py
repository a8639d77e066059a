"""Layers of neural networks in NumPy: the networks that ship are run with them, so that nobody waits for torch to be imported.

Each network keeps its architecture (`embedding.learned`, `extraction.plans.plan_network`, `extraction.plans.passages`);
the functions compute in the type of what they are given. Matrices of weights are (in, out) here; torch keeps them (out, in).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topomerge.kernels.convolve import rectified
from topomerge.types import Array

LEAKY_SLOPE = 0.2  # of the leaky rectifier below 0 (Velickovic et al. 2018)
LAYER_NORM_EPSILON = 1e-5  # added to the variance, as torch does


def linear(x: Array, weight: Array, bias: Array | None = None) -> Array:
    """(..., in) @ (in, out) + (out,)."""
    out: Array = x @ weight
    return out if bias is None else out + bias


def relu(x: Array) -> Array:
    """What is below 0 becomes 0."""
    return np.maximum(x, 0)


def leaky_relu(x: Array) -> Array:
    """What is below 0 becomes `LEAKY_SLOPE` of it."""
    return np.where(x > 0, x, LEAKY_SLOPE * x)


def sigmoid(x: Array) -> Array:
    """Logits as probabilities."""
    return np.asarray(1 / (1 + np.exp(-x)))


def softmax(logits: Array) -> Array:
    """Logits as probabilities that sum to 1 along the last axis."""
    weight = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def layer_norm(x: Array, weight: Array, bias: Array) -> Array:
    """Rows (n, c) of mean 0 and variance 1, then times a weight (c,) plus a bias (c,) (Ba et al. 2016)."""
    away = x - x.mean(axis=1, keepdims=True)
    out: Array = away / np.sqrt((away**2).mean(axis=1, keepdims=True) + LAYER_NORM_EPSILON) * weight + bias
    return out


def perceptron(x: Array, layers: Sequence[tuple[Array, Array]]) -> Array:
    """(n, in) -> (n, out): linear layers (weight, bias), rectified between each other."""
    for k, (weight, bias) in enumerate(layers):
        x = linear(relu(x) if k else x, weight, bias)
    return x


def convolution(x: Array, weight: Array, bias: Array, stride: int = 1) -> Array:
    """An image (c, nx, ny) float32 -> (k, nx / stride, ny / stride) float32, or several (n, c, nx, ny) at once: 3 x 3, rectified,
    with zeros around.

    Args:
        weight: (9 c, k), by place in the window, then channel.
        bias: (k,).
        stride: divides both sides.
    """
    images = x[None] if x.ndim == 3 else x
    kernel = weight.reshape(3, 3, images.shape[1], -1).transpose(3, 2, 0, 1)
    out = rectified(images, kernel, bias, stride)
    return out[0] if x.ndim == 3 else out


def segment_sum(values: Array, index: Array, count: int) -> Array:
    """(count, c) sums of the rows (n, c) that have each index (n,); 0 where there is none."""
    out = np.zeros((count, values.shape[1]), values.dtype)
    np.add.at(out, index, values)
    return out


def segment_mean(values: Array, index: Array, count: int) -> Array:
    """(count, c) means likewise."""
    out: Array = segment_sum(values, index, count) / np.maximum(np.bincount(index, minlength=count), 1)[:, None]
    return out


def segment_max(values: Array, index: Array, count: int) -> Array:
    """(count, c) largest of values of 0 and more likewise."""
    out = np.zeros((count, values.shape[1]), values.dtype)
    np.maximum.at(out, index, values)
    return out


def segment_softmax(scores: Array, index: Array, count: int) -> Array:
    """(n, h) softmax of scores (n, h) among the rows with the same index."""
    largest = np.full((count, scores.shape[1]), -np.inf, scores.dtype)
    np.maximum.at(largest, index, scores)
    weight = np.exp(scores - largest[index])
    out: Array = weight / segment_sum(weight, index, count)[index]
    return out
