"""Rooms of views, the thesis' way: clusters of views that see the same cells (seeds 2.4 to 2.7)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from topomerge.extraction.convolution import Kernel, build_moore, build_sphere, convolve
from topomerge.extraction.morphology import compute_horizontal_distance_field, label_components, spread_labels
from topomerge.extraction.parameters import ThesisParameters
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.storeys import find_storeys, measure_floor_to_ceiling
from topomerge.extraction.views.visibility import SparseVoxelOctree, Visibility, find_visible_cells
from topomerge.kernels import graphs
from topomerge.kernels import graphs as kernel
from topomerge.progress import Stopwatch
from topomerge.types import Array, VoxelGrid

# Where to look from: local maxima of the horizontal distance field, raised to eye height (seeds 2.4).

CELLS_AT_ONCE = 8192  # whose neighbours are held at a time: some hundred each


def select_optimal_views(navigable: VoxelGrid, radius: float, height: float) -> Array:
    """Return (V, 3) positions, m, from which the map is seen best (seeds 2.4).

    Args:
        navigable: the navigable volume.
        radius: m; larger ones give fewer views.
        height: m above the floor.
    """
    distance = compute_horizontal_distance_field(navigable)
    return raise_views(navigable, navigable.cells[find_local_maxima(navigable, distance, radius)], height)


def find_local_maxima(grid: VoxelGrid, distance: Array, radius: float) -> Array:
    """Return the ascending rows of cells whose distance is not below that of any cell within `radius` m (seeds 2.4.1, HDF_max).

    The octree answers radius(v, r) (seeds 2.2.1).
    """
    octree = SparseVoxelOctree(grid)
    highest = np.empty(len(grid), np.asarray(distance).dtype)
    for begin in range(0, len(grid), CELLS_AT_ONCE):
        block = slice(begin, begin + CELLS_AT_ONCE)
        indptr, rows = octree.find_in_radius_many(grid.cells[block], radius)
        highest[block] = np.maximum.reduceat(distance[rows], indptr[:-1])  # a cell is near itself: none is without neighbours
    return np.flatnonzero(distance >= highest)


def raise_views(navigable: VoxelGrid, cells: Array, height: float) -> Array:
    """Return (v, 3) float64 centroids of (v, 3) cells raised by `height` m: out of the floor, to where one looks from (seeds
    2.4.1)."""
    views = navigable.compute_centroids(cells)
    views[:, 2] += height
    return views


# How alike two views' visibilities are: the Jaccard index (seeds 2.6).


def compute_jaccard_similarity(
    visibility: Visibility,
    threshold: float = 0.0,
    views: Array | None = None,
    reach: float | None = None,
    heights: Array | None = None,
) -> sparse.csr_array:
    """Return (V, V) symmetric matrix of |A and B| / |A or B| of the seen sets, 1 on the diagonal (seeds 2.6).

    Args:
        threshold: smaller similarities are left out (0).
        views: (V, 3) positions, m; with `reach`, only pairs of views at most that far apart are compared.
        reach: twice the range of the visibility: views farther apart can't see the same cell.
        heights: (n,) integer height of each cell; views that see other heights, as on two storeys, need no comparison.
    """
    sizes = visibility.count_cells()
    if views is not None and reach is not None:
        pairs = cKDTree(views).query_pairs(reach, output_type="ndarray")
        first, second = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    else:
        first, second = np.triu_indices(len(visibility), 1)
    # no set of different size can be more alike than the ratio of the sizes: most pairs need no intersection
    smaller, larger = np.minimum(sizes[first], sizes[second]), np.maximum(sizes[first], sizes[second])
    possible = (smaller > 0) & (smaller >= threshold * larger)
    if heights is not None:
        low, high = graphs.compute_extents(visibility.indptr, visibility.words, visibility.masks, heights).T
        possible &= (low[first] <= high[second]) & (low[second] <= high[first])
    first, second = first[possible], second[possible]
    both = graphs.count_intersections(visibility.indptr, visibility.words, visibility.masks, first, second)
    value = both / (sizes[first] + sizes[second] - both)
    similar = (value >= threshold) & (both > 0)
    first, second, value = first[similar], second[similar], value[similar]
    view = np.arange(len(visibility))
    rows, columns = np.concatenate([first, second, view]), np.concatenate([second, first, view])
    values = np.concatenate([value, value, np.ones(len(view))])
    return sparse.csr_array((values, (rows, columns)), shape=(len(view), len(view)))


# Clusters of similar views: the Markov cluster algorithm, its inflation chosen by modularity (seeds 2.6; van Dongen 2000).


def cluster_markov(
    similarity: sparse.csr_array, inflation: float, threshold: float = 1e-4, most: int = 64, rounds: int = 100
) -> Array:
    """Return the cluster of each node of a weighted graph.

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
        indptr, indices, values, chaos = kernel.run_mcl_step(indptr, indices, values, inflation, threshold, most)
        if chaos < 1e-6:
            break
    n = similarity.shape[0]
    settled = sparse.csc_array((values > 1e-3, indices, indptr), shape=(n, n))
    return _renumber_by_first(csgraph.connected_components(settled, directed=False)[1])


def compute_modularity(similarity: sparse.csr_array, cluster: Array) -> float:
    """Return share of the weight inside clusters beyond what random edges would put there (Newman 2004); self loops left out."""
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
    """Return the clusters at the inflation of highest modularity, and that inflation; the smaller one of equals (seeds 2.6).

    Args:
        similarity: (V, V) symmetric, with ones on the diagonal.
        inflations: that are tried, ascending; the seeds' range is 1.2 to 2.5.
    """
    if not similarity.shape[0]:
        return np.zeros(0, np.int64), float(inflations[0])
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:  # the compiled step lets go of the interpreter
        clusters = list(pool.map(lambda inflation: cluster_markov(similarity, inflation), inflations))
    quality = np.round([compute_modularity(similarity, cluster) for cluster in clusters], 9)
    best = int(np.argmax(quality))
    return clusters[best], float(inflations[best])


def _renumber_by_first(labels: Array) -> Array:
    """Return labels numbered in the order in which they first occur."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.ravel()]


# From clusters of views to labels of cells (seeds 2.6).


def vote(visibility: Visibility, cluster: Array) -> Array:
    """Return (n,) int32: for each cell the cluster of which the most views see it; of equals the smallest number, -1 if none
    does."""
    winner = np.full(visibility.cells, -1, np.int32)
    order = np.argsort(cluster, kind="stable")
    graphs.find_most_voted(visibility.indptr, visibility.words, visibility.masks, order, np.asarray(cluster, np.int64), winner)
    return winner


# Label propagation: small islands take the label around them (seeds 2.6).


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


# From labels of cells to rooms: connected pieces (seeds 2.6, 2.7).


def split_rooms(grid: VoxelGrid, labels: Array, least_volume: float) -> Array:
    """Return number the connected pieces of each label that hold at least `least_volume` m3 of occupied cells (seeds 2.6, 2.7).

    Smaller pieces belong to no room.

    Args:
        labels: (n,) int, -1 for none.
        least_volume: the thesis' 128 cells of 0.1 m are 0.128 m3.

    Returns:
        (n,) int32, numbered from 0 in Morton order, -1 for none.
    """
    piece = label_components(grid, build_moore(), labels)
    size = np.bincount(piece[piece >= 0])
    large = size * grid.edge**3 >= least_volume - 1e-9
    number = np.where(large, np.cumsum(large) - 1, -1)
    room = np.where(piece >= 0, number[np.maximum(piece, 0)], -1) if len(size) else np.full(len(grid), -1)
    return room.astype(np.int32)


# Rooms on the floor: which room the navigable cells belong to (seeds 2.7).


def build_navigable_floor(grid: VoxelGrid, room: Array, navigable: VoxelGrid, body_height: float, body_width: float) -> Floor:
    """Return the navigable volume as the floor of rooms that are sets of occupied cells (seeds 2.7).

    A navigable cell has the room of the occupied cell in its place, otherwise that of the nearest navigable cell.

    Args:
        room: (n,) room of each occupied cell.
        body_height, body_width: of the body that the navigable volume was made for, m.
    """
    row = grid.find_rows(navigable.cells)
    label = np.where(row >= 0, room[np.maximum(row, 0)], -1)
    label = spread_labels(navigable, label).astype(np.int32)
    storeys, storey = find_storeys(navigable, measure_floor_to_ceiling(grid, navigable, body_height))
    none = np.full(len(navigable), -1, np.int32)
    return Floor(navigable, storeys, storey, label, none, np.zeros(0, np.int32), room, body_width)


# Rooms of views: clusters of views that see the same cells (seeds 2.4 to 2.6).


def segment_views(grid: VoxelGrid, navigable: VoxelGrid, p: ThesisParameters, watch: Stopwatch) -> Floor:
    """Cut the floor into rooms as the thesis does; the chosen inflation is among the floor's parameters.

    Args:
        grid: occupied cells.
        navigable: the navigable volume.
        p: parameters of the thesis.
        watch: measures each step.
    """
    watch.begin("views", 0.4)
    views = select_optimal_views(navigable, p.view_radius, p.view_height)  # 2.4
    watch.begin("visibility", 0.45)
    visibility = find_visible_cells(grid, views, p.range, watch.build_part_progress(0.45, 0.65))  # 2.5
    watch.begin("similarity", 0.65)
    similarity = compute_jaccard_similarity(visibility, p.least_similarity, views, 2 * p.range, grid.cells[:, 2])  # 2.6
    watch.begin("clusters", 0.75)
    cluster, inflation = cluster_views(similarity, p.inflations)
    watch.begin("rooms", 0.85)
    labels = vote(visibility, cluster)
    labels = propagate_labels(grid, labels, build_sphere(p.propagation_cells, 1.0), p.propagation_rounds)
    room = split_rooms(grid, labels, p.least_volume)
    floor = build_navigable_floor(grid, room, navigable, p.standing_height, p.body_width)
    return replace(floor, chosen_parameters={"inflation": inflation})
