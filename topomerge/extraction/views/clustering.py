"""Clusters of similar views: the Markov cluster algorithm, its inflation chosen by modularity (seeds 2.6; van Dongen 2000)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from topomerge.kernels import mcl as kernel
from topomerge.types import Array


def markov_clusters(
    similarity: sparse.csr_array, inflation: float, threshold: float = 1e-4, most: int = 64, rounds: int = 100
) -> Array:
    """Cluster of each node of a weighted graph.

    Flow expands (M @ M) and inflates (entries to the power of `inflation`) until it settles; nodes whose flow ends at the same
    attractors form a cluster. The weights must be similarities: fed distances, the flow seeks out the unlike.

    Args:
        similarity: (V, V) symmetric, not negative, with self loops on the diagonal.
        inflation: above 1; larger gives smaller clusters.
        threshold: flow below it is pruned.
        most: entries of a column; smaller ones go.
        rounds: at most so many steps.

    Returns:
        (V,) int64, numbered by first node.
    """
    if inflation <= 1:
        raise ValueError(f"inflation must be above 1, not {inflation}")
    if similarity.nnz and similarity.data.min() < 0:
        raise ValueError("similarities must not be negative")
    flow = sparse.csc_array(similarity.astype(np.float64))
    flow.sum_duplicates()
    flow.eliminate_zeros()
    if (np.diff(flow.indptr) == 0).any():
        raise ValueError("a node has no similarity at all: the diagonal must hold self loops")
    flow.sort_indices()
    sums = np.asarray(flow.sum(axis=0)).ravel()
    indptr, indices = flow.indptr.astype(np.int64), flow.indices.astype(np.int32)
    values = flow.data / np.repeat(sums, np.diff(indptr))
    for _ in range(rounds):
        indptr, indices, values, chaos = kernel.step(indptr, indices, values, inflation, threshold, most)
        if chaos < 1e-6:
            break
    n = similarity.shape[0]
    settled = sparse.csc_array((values > 1e-3, indices, indptr), shape=(n, n))
    return _by_first(csgraph.connected_components(settled, directed=False)[1])


def modularity(similarity: sparse.csr_array, cluster: Array) -> float:
    """Share of the weight inside clusters beyond what random edges would put there (Newman 2004); self loops left out."""
    graph = sparse.coo_array(similarity)
    off = graph.row != graph.col
    row, col, weight = graph.row[off], graph.col[off], graph.data[off]
    total = weight.sum()
    if total == 0:
        return 0.0
    inside = weight[cluster[row] == cluster[col]].sum() / total
    degree = np.bincount(cluster[row], weight, int(cluster.max()) + 1) / total
    return float(inside - (degree**2).sum())


def cluster_views(similarity: sparse.csr_array, inflations: Sequence[float]) -> tuple[Array, float]:
    """Clusters at the inflation of highest modularity, and that inflation; the smaller one of equals (seeds 2.6).

    Args:
        similarity: (V, V) symmetric, with ones on the diagonal.
        inflations: that are tried, ascending; the seeds' range is 1.2 to 2.5.
    """
    if not similarity.shape[0]:
        return np.zeros(0, np.int64), float(inflations[0])
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # the compiled step lets go of the interpreter
        clusters = list(pool.map(lambda inflation: markov_clusters(similarity, inflation), inflations))
    quality = np.round([modularity(similarity, cluster) for cluster in clusters], 9)
    best = int(np.argmax(quality))
    return clusters[best], float(inflations[best])


def _by_first(labels: Array) -> Array:
    """Labels numbered in the order in which they first occur."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.ravel()]
