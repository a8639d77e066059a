"""What is in each place along a wall: a small convolutional network over its elevation, trained on simulated scans of training
buildings (`train.py task=wall_segmentation`), in NumPy (`numpy_nn`; beyond the thesis: docs/adr/0018).

Two convolutions look at a strip along the wall and across it, the heights as channels; a layer then weighs all depths at once,
and three convolutions along the wall see 1.4 m to both sides, so that a leaf is told from a niche by its width and its frame.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import DEPTHS, STRIP_CHANNELS, WALL_CLASSES
from topomerge.io.weight_files import read_layers, weights_file
from topomerge.numpy_nn import convolution, linear, relu, softmax
from topomerge.types import Array

WALL_NETWORK_FILE = "wall_network.npz"
PLACES = 2  # elements along a strip that have one answer
TAPS, DILATIONS = 5, (1, 2, 4)  # of the convolutions along the wall
ALONG_LAYERS = ("along1", "along2", "along3")


def place_probabilities(strip: Array, network: dict[str, Array] | None = None) -> Array:
    """(n / 2, 7) float32 probability of each of `WALL_CLASSES` along a strip (n, 32, 17), or of several of one length at once
    (k, n, 32, 17); by the weights that ship or others."""
    w = weights() if network is None else network
    x = convolution(np.moveaxis(strip, -1, -3).astype(np.float32), w["a.w"], w["a.b"], PLACES)
    x = np.moveaxis(convolution(x, w["b.w"], w["b.b"]), -3, -1)
    x = relu(linear(x.reshape(*x.shape[:-2], -1), w["depths.w"], w["depths.b"]))
    for name, dilation in zip(ALONG_LAYERS, DILATIONS, strict=True):
        x = relu(linear(neighbours(x, dilation), w[f"{name}.w"], w[f"{name}.b"]))
    return softmax(linear(x, w["out.w"], w["out.b"]))


def neighbours(x: Array, dilation: int) -> Array:
    """(..., n, 5 c) of each row (..., n, c) those around it, `dilation` apart; zeros past the ends."""
    reach, count = TAPS // 2 * dilation, x.shape[-2]
    padded = np.pad(x, [(0, 0)] * (x.ndim - 2) + [(reach, reach), (0, 0)])
    return np.concatenate([padded[..., k * dilation : k * dilation + count, :] for k in range(TAPS)], axis=-1)


def weights() -> dict[str, Array]:
    """The weights that ship, or those in their place (`io.weight_files`)."""
    return read_network(weights_file("topomerge.extraction.elevations", WALL_NETWORK_FILE))


@lru_cache(maxsize=4)
def read_network(path: Path) -> dict[str, Array]:
    """Weights as float32 by their names.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    taps = {"a": 9, "b": 9, "depths": DEPTHS // PLACES, "out": 1} | dict.fromkeys(ALONG_LAYERS, TAPS)
    layers = read_layers(path, "walls", taps)
    if layers["a.w"].shape[0] != 9 * STRIP_CHANNELS or layers["out.w"].shape[1] != len(WALL_CLASSES):
        raise InputError(f"{path}: was trained with other inputs or outputs; install topomerge again")
    return layers
