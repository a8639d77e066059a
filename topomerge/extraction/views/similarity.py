"""How alike two views' visibilities are: the Jaccard index (seeds 2.6)."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from topomerge.extraction.views.visibility import Visibility
from topomerge.kernels import sets
from topomerge.types import Array


def jaccard_similarity(
    visibility: Visibility,
    threshold: float = 0.0,
    views: Array | None = None,
    reach: float | None = None,
    heights: Array | None = None,
) -> sparse.csr_array:
    """(V, V) symmetric matrix of |A and B| / |A or B| of the seen sets, 1 on the diagonal (seeds 2.6).

    Args:
        threshold: smaller similarities are left out (0).
        views: (V, 3) positions, m; with `reach`, only pairs of views at most that far apart are compared.
        reach: twice the range of the visibility: views farther apart can't see the same cell.
        heights: (n,) integer height of each cell; views that see other heights, as on two storeys, need no comparison.
    """
    sizes = visibility.sizes()
    if views is not None and reach is not None:
        pairs = cKDTree(views).query_pairs(reach, output_type="ndarray")
        first, second = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    else:
        first, second = np.triu_indices(len(visibility), 1)
    # no set of different size can be more alike than the ratio of the sizes: most pairs need no intersection
    smaller, larger = np.minimum(sizes[first], sizes[second]), np.maximum(sizes[first], sizes[second])
    possible = (smaller > 0) & (smaller >= threshold * larger)
    if heights is not None:
        low, high = sets.extents(visibility.indptr, visibility.words, visibility.masks, heights).T
        possible &= (low[first] <= high[second]) & (low[second] <= high[first])
    first, second = first[possible], second[possible]
    both = sets.intersections(visibility.indptr, visibility.words, visibility.masks, first, second)
    value = both / (sizes[first] + sizes[second] - both)
    similar = (value >= threshold) & (both > 0)
    first, second, value = first[similar], second[similar], value[similar]
    view = np.arange(len(visibility))
    rows, columns = np.concatenate([first, second, view]), np.concatenate([second, first, view])
    values = np.concatenate([value, value, np.ones(len(view))])
    return sparse.csr_array((values, (rows, columns)), shape=(len(view), len(view)))
