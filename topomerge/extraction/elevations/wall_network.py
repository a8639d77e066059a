"""What is in each place along a wall: a small convolutional network over its elevation, trained on simulated scans of training
buildings (`train.py task=wall_segmentation`; beyond the thesis: docs/adr/0018).

Two convolutions look at a strip along the wall and across it, the heights as channels; a layer then weighs all depths at once,
and three convolutions along the wall see 1.4 m to both sides, so that a leaf is told from a niche by its width and its frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from topomerge.extraction.elevations.elevation import DEPTHS, STRIP_CHANNELS, WALL_CLASSES
from topomerge.networks.network import Network, Run, load_network, load_shipped_network
from topomerge.networks.signature import Signature, Tensor
from topomerge.types import Array

WALL_NETWORK_FILE = "wall_network.onnx"
PLACES = 2  # elements along a strip that have one answer
TAPS, DILATIONS = 5, (1, 2, 4)  # of the convolutions along the wall


WALL_SIGNATURE = Signature(
    "Says what is in each place along a wall.",
    {"strips": Tensor(("strips", "length", DEPTHS, STRIP_CHANNELS), "0 to 1, along walls (even)")},
    {"probability": Tensor(("strips", "places", len(WALL_CLASSES)), f"of {', '.join(WALL_CLASSES)}, of each two elements")},
)


def place_probabilities(strip: Array, network: Run | None = None) -> Array:
    """Compute (n / 2, 7) float32 probability of each of `WALL_CLASSES` along a strip (n, 32, 17), or of several of one length at
    once (k, n, 32, 17); by the network that ships or another."""
    run = weights() if network is None else network
    several = strip if strip.ndim == 4 else strip[None]
    if not several.shape[0] or not several.shape[1]:
        return np.zeros((*strip.shape[:-3], strip.shape[-3] // PLACES, len(WALL_CLASSES)), np.float32)
    (probability,) = run(strips=several)
    return np.asarray(probability if strip.ndim == 4 else probability[0])


def weights() -> Network:
    """Load the network that ships, or the one in its place (`io.weight_files`)."""
    return load_shipped_network(WALL_NETWORK_FILE, WALL_SIGNATURE)


def read_network(path: Path) -> Network:
    """Load the network of a file.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    return load_network(path, WALL_SIGNATURE)
