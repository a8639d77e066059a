"""Markov clustering against a dense reference, modularity against its definition, label propagation, rooms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from topomerge.extraction.convolution import build_sphere
from topomerge.extraction.parameters import ThesisParameters
from topomerge.extraction.views.view_rooms import (
    build_navigable_floor,
    cluster_markov,
    cluster_views,
    compute_modularity,
    propagate_labels,
    split_rooms,
)
from topomerge.types import VoxelGrid


def planted(sizes=(12, 7, 20), inside=0.8, between=0.02, seed=0) -> tuple[sparse.csr_array, np.ndarray]:
    """Similarities with planted clusters: high inside, few and low between."""
    rng = np.random.default_rng(seed)
    truth = np.repeat(np.arange(len(sizes)), sizes)
    same = truth[:, None] == truth[None]
    weight = np.where(same, inside, between) * rng.uniform(0.7, 1.0, same.shape)
    weight *= np.where(same, 1, rng.random(same.shape) < 0.3)
    weight = np.triu(weight, 1)
    return sparse.csr_array(weight + weight.T + np.eye(len(truth))), truth


def dense_mcl(similarity: np.ndarray, inflation: float) -> np.ndarray:
    """The algorithm as it is defined, without sparsity or pruning until the end."""
    flow = similarity / similarity.sum(axis=0)
    for _ in range(200):
        flow = (flow @ flow) ** inflation
        flow = flow / flow.sum(axis=0)
    linked = flow > 1e-3
    return sparse.csgraph.connected_components(sparse.csr_array(linked), directed=False)[1]


def same_partition(a, b) -> bool:
    return len(set(zip(np.asarray(a).tolist(), np.asarray(b).tolist(), strict=True))) == len(set(a)) == len(set(b))


@pytest.mark.parametrize("inflation", [1.3, 1.6, 2.0, 2.5])
@pytest.mark.parametrize("seed", range(4))
def test_equals_dense_reference_on_planted_clusters(inflation, seed):
    similarity, truth = planted(seed=seed)
    found = cluster_markov(similarity, inflation)
    assert same_partition(found, dense_mcl(similarity.toarray(), inflation))
    if inflation >= 1.6:
        assert same_partition(found, truth)


def test_order_of_nodes_does_not_matter():
    similarity, _ = planted()
    order = np.random.default_rng(1).permutation(similarity.shape[0])
    shuffled = sparse.csr_array(similarity.toarray()[np.ix_(order, order)])
    assert same_partition(cluster_markov(similarity, 1.7)[order], cluster_markov(shuffled, 1.7))


def test_nodes_without_neighbours_stay_alone():
    assert cluster_markov(sparse.csr_array(np.eye(4)), 1.5).tolist() == [0, 1, 2, 3]
    assert cluster_views(sparse.csr_array((0, 0)), (1.5,))[0].tolist() == []


def test_stored_zeros_are_no_neighbours():
    full = np.zeros((60, 60)) + np.eye(60)
    row, column = np.indices(full.shape)
    stored = sparse.csr_array((full.ravel(), (row.ravel(), column.ravel())), shape=full.shape)
    assert stored.nnz == 3600
    assert len(set(cluster_markov(stored, 1.5).tolist())) == 60
    with pytest.raises(ValueError, match="self loops"):
        cluster_markov(sparse.csr_array((3, 3)), 1.5)


def test_distances_and_low_inflation_are_refused():
    with pytest.raises(ValueError, match="inflation"):
        cluster_markov(sparse.csr_array(np.eye(2)), 1.0)
    with pytest.raises(ValueError, match="negative"):
        cluster_markov(sparse.csr_array(np.array([[1.0, -0.5], [-0.5, 1.0]])), 1.5)


def test_modularity_is_its_definition():
    similarity, truth = planted()
    weight = similarity.toarray() - np.eye(len(truth))
    degree, total = weight.sum(axis=1), weight.sum()
    expected = sum(
        weight[i, j] - degree[i] * degree[j] / total for i in range(len(truth)) for j in range(len(truth)) if truth[i] == truth[j]
    )
    assert compute_modularity(similarity, truth) == pytest.approx(expected / total)
    assert compute_modularity(similarity, np.zeros(len(truth), int)) == pytest.approx(0.0)
    assert compute_modularity(sparse.csr_array(np.eye(3)), np.arange(3)) == 0.0


def test_inflation_of_highest_modularity():
    similarity, truth = planted(sizes=(9, 9, 9, 9))
    cluster, inflation = cluster_views(similarity, ThesisParameters().inflations)
    assert same_partition(cluster, truth) and 1.2 <= inflation <= 2.5


def test_islands_are_absorbed():
    plan = np.zeros((20, 20), int)
    plan[:, 10:] = 1
    plan[4, 4], plan[15, 15] = 1, 0
    grid = VoxelGrid.from_cells(np.argwhere(np.ones((20, 20, 1), bool)).astype(np.int32))
    labels = plan[grid.cells[:, 0], grid.cells[:, 1]]
    after = propagate_labels(grid, labels, build_sphere(0.2, 0.1))
    assert (after == (grid.cells[:, 1] >= 10)).all()


def test_propagation_ends_although_a_checkerboard_swaps_for_ever():
    grid = VoxelGrid.from_cells(np.array([(x, 0, 0) for x in range(8)], np.int32))
    labels = grid.cells[:, 0] % 2
    after = propagate_labels(grid, labels, build_sphere(0.1, 0.1, with_origin=False), rounds=1000)
    assert set(after.tolist()) <= {0, 1}


def test_rooms_are_connected_pieces_of_enough_volume():
    cells = np.array([(x, y, 0) for x in range(30) for y in range(10)], np.int32)
    grid = VoxelGrid.from_cells(cells)
    label = np.where(grid.cells[:, 0] < 12, 0, np.where(grid.cells[:, 0] < 14, 1, 0))
    room = split_rooms(grid, label, 0.1)
    assert sorted(np.bincount(room[room >= 0]).tolist()) == [120, 160]
    assert (room[label == 1] == -1).all()


def test_navigable_cells_take_the_nearest_room():
    grid = VoxelGrid.from_cells(np.array([(0, 0, 0), (9, 0, 0)], np.int32), shape=(10, 1, 3))
    line = grid.replace_cells(np.array([(x, 0, z) for x in range(10) for z in range(2)], np.int32))
    label = build_navigable_floor(grid, np.array([0, 1], np.int32), line, 1.75, 0.3).room
    assert (label == (line.cells[:, 0] >= 5)).all()
