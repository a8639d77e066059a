"""What colours say of each place along a wall, on top of its shape: a small network that is trained on painted scans of training
buildings (`train.py task=wall_colours`), in NumPy (beyond the thesis: docs/adr/0018).

A shut door that is flush with its wall has no depth, but mostly a colour, a frame or a handle. The network reads the colours of
a stretch and what its shape says (`wall_network`), and changes the scores of that. Scans without colours are not changed.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.special import softmax

from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import BANDS, WALL_CLASSES
from topomerge.extraction.elevations.wall_network import DILATIONS, PLACES, TAPS
from topomerge.io.weight_files import read_layers, weights_file
from topomerge.types import Array

COLOUR_NETWORK_FILE = "colour_network.npz"
ALONG_LAYERS = ("along1", "along2", "along3")
COLOUR_CHANNELS = 4  # of `Elevations.colours`
LEAST_CHANCE = 1e-4  # probability: what shape says is not taken for surer
COLOUR_CLASSES = ("wall", "open", "shut", "window")  # that colours tell apart: the first ones of `WALL_CLASSES`
INPUTS = PLACES * BANDS * COLOUR_CHANNELS + len(COLOUR_CLASSES)


def coarse_classes(classes: Array) -> Array:
    """(n / 2, 4) float32 probability of each of `COLOUR_CLASSES`: half-open doors are open, niches and cupboards are wall.

    Args:
        classes: (n / 2, 7) of `WALL_CLASSES`.
    """
    out = np.array(classes[:, : len(COLOUR_CLASSES)], np.float32)
    out[:, WALL_CLASSES.index("open")] += classes[:, WALL_CLASSES.index("half")]
    out[:, WALL_CLASSES.index("wall")] += classes[:, WALL_CLASSES.index("niche")] + classes[:, WALL_CLASSES.index("cupboard")]
    return out


def colour_inputs(colours: Array, classes: Array) -> tuple[Array, Array]:
    """(n / 2, 108) float32 what the network reads of each place, and (n / 2, 4) the scores that it changes.

    Args:
        colours: (n, 13, 4) of a strip, n even.
        classes: (n / 2, 4) probability of each of `COLOUR_CLASSES` by its shape.
    """
    scores = np.log(np.maximum(classes, LEAST_CHANCE)).astype(np.float32)
    return np.hstack([colours.reshape(len(scores), -1).astype(np.float32), scores]), scores


def with_colours(colours: Array, classes: Array, network: dict[str, Array] | None = None) -> Array:
    """(n / 2, 4) float32 probability of each of `COLOUR_CLASSES` by shape and colours; where no colour was seen, as it was.

    Args:
        colours, classes: as of `colour_inputs`.
        network: weights; None: those that ship.
    """
    seen = np.asarray(colours[..., 0].reshape(len(classes), -1).any(axis=1))
    if not seen.any():
        return classes
    w = weights() if network is None else network
    x, scores = colour_inputs(colours, classes)
    x = np.maximum(x @ w["in.w"] + w["in.b"], 0)
    for name, dilation in zip(ALONG_LAYERS, DILATIONS, strict=True):
        x = np.maximum(neighbours(x, dilation) @ w[f"{name}.w"] + w[f"{name}.b"], 0)
    return np.where(seen[:, None], softmax(scores + x @ w["out.w"] + w["out.b"], axis=-1), classes).astype(np.float32)


def neighbours(x: Array, dilation: int) -> Array:
    """(..., n, 5 c) of each row (..., n, c) those around it, `dilation` apart; zeros past the ends."""
    reach, count = TAPS // 2 * dilation, x.shape[-2]
    padded = np.pad(x, [(0, 0)] * (x.ndim - 2) + [(reach, reach), (0, 0)])
    return np.concatenate([padded[..., k * dilation : k * dilation + count, :] for k in range(TAPS)], axis=-1)


def weights() -> dict[str, Array]:
    """The weights that ship, or those in their place (`io.weight_files`)."""
    return read_network(weights_file("topomerge.extraction.elevations", COLOUR_NETWORK_FILE))


@lru_cache(maxsize=4)
def read_network(path: Path) -> dict[str, Array]:
    """Weights as float32 by their names.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    layers = read_layers(path, "colours of walls", {"in": INPUTS, "out": 1} | dict.fromkeys(ALONG_LAYERS, TAPS))
    if layers["in.w"].shape[0] != INPUTS or layers["out.w"].shape[1] != len(COLOUR_CLASSES):
        raise InputError(f"{path}: was trained with other inputs or outputs; install topomerge again")
    return layers
