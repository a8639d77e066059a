"""From clusters of views to labels of cells (seeds 2.6)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.views.visibility import Visibility
from topomerge.kernels import sets
from topomerge.types import Array


def vote(visibility: Visibility, cluster: Array) -> Array:
    """(n,) int32: for each cell the cluster of which the most views see it; of equals the smallest number, -1 if none does."""
    winner = np.full(visibility.cells, -1, np.int32)
    order = np.argsort(cluster, kind="stable")
    sets.most_votes(visibility.indptr, visibility.words, visibility.masks, order, np.asarray(cluster, np.int64), winner)
    return winner
