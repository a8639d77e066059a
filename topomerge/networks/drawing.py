"""Classes of the pixels of a drawn floor plan: a convolutional network, trained on plans drawn in many hands
(`train.py task=drawing_segmentation`; beyond the thesis: docs/adr/0032)."""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise

import numpy as np

from topomerge.kernels import run_side_by_side
from topomerge.networks.network import Network, Run, Signature, Tensor, load_shipped_network
from topomerge.types import Array

DRAWING_FILE = "drawing_network.onnx"
DRAWING_CLASSES = ("page", "floor", "wall", "window", "door", "symbol", "stairs", "text")
PAGE, FLOOR, WALL, WINDOW, DOOR, SYMBOL, STAIRS, TEXT = range(len(DRAWING_CLASSES))
STRIDE = 32  # px of a side, of an element of the coarsest level
TILE, MARGIN = 1024, 128  # px: larger pictures are looked at in tiles, which overlap
LOOKS = 2  # at each tile, upright and a quarter turned: two looks err less than one, four hardly less than two

DRAWING_SIGNATURE = Signature(
    "Says what each pixel of a drawn floor plan shows.",
    {"picture": Tensor(("pages", 3, "h", "w"), "red, green and blue, 0 to 1, of pages whose sides are multiples of 32")},
    {"probability": Tensor(("pages", len(DRAWING_CLASSES), "h", "w"), f"of {', '.join(DRAWING_CLASSES)}")},
)


def load_drawing_network() -> Network:
    """Load the network that ships, or the one in its place."""
    return load_shipped_network(DRAWING_FILE, DRAWING_SIGNATURE)


def compute_drawing_probabilities(picture: Array, network: Run | None = None) -> Array:
    """Compute (h, w, 8) float16 probabilities of `DRAWING_CLASSES`.

    Args:
        picture: (h, w, 3) uint8.
        network: the one that ships, if None.
    """
    run = load_drawing_network() if network is None else network
    h, w = picture.shape[:2]
    out = np.empty((h, w, len(DRAWING_CLASSES)), np.float16)
    for top, bottom in _split_side(h):
        for left, right in _split_side(w):
            box = (slice(max(top - MARGIN, 0), min(bottom + MARGIN, h)), slice(max(left - MARGIN, 0), min(right + MARGIN, w)))
            part = picture[box]
            pad = [(0, -part.shape[0] % STRIDE), (0, -part.shape[1] % STRIDE), (0, 0)]
            x = np.pad(part, pad, mode="edge").transpose(2, 0, 1)[None].astype(np.float32) / 255.0
            probability = np.mean(run_side_by_side(partial(_look, x, run), range(LOOKS)), axis=0)
            rows, columns = slice(top - box[0].start, bottom - box[0].start), slice(left - box[1].start, right - box[1].start)
            out[top:bottom, left:right] = probability[0].transpose(1, 2, 0)[rows, columns]
    return out


def _look(x: Array, run: Run, turn: int) -> Array:
    """Return (1, 8, h, w) probabilities of (1, 3, h, w), looked at after so many quarter turns."""
    (probability,) = run(picture=np.ascontiguousarray(np.rot90(x, turn, (2, 3))))
    return np.rot90(probability, -turn, (2, 3))


def _split_side(side: int) -> list[tuple[int, int]]:
    """Return the ends of the tiles of a side."""
    count = max(1, math.ceil(side / TILE))
    ends = np.linspace(0, side, count + 1).astype(int).tolist()
    return list(pairwise(ends))
