"""Label propagation: small islands take the label around them (seeds 2.6)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.convolution import Kernel, convolve
from topomerge.types import Array, VoxelGrid


def propagate_labels(grid: VoxelGrid, labels: Array, neighbourhood: Kernel, rounds: int = 10) -> Array:
    """Give each cell the most common label of its neighbourhood, again and again until nothing changes (seeds 2.6).

    All cells change at once, so two neighbours may swap labels for ever: the rounds also end when the labels are those of two
    rounds ago, and after `rounds` at the latest. A cell keeps its label where that is among the most common.

    Returns:
        (n,) int32.
    """
    before, current = None, np.asarray(labels, np.int32)
    for _ in range(rounds):
        after = convolve(grid, neighbourhood, "most_common", current).astype(np.int32)
        after = np.where(after < 0, current, after)
        if (after == current).all() or (before is not None and (after == before).all()):
            break
        before, current = current, after
    return current
