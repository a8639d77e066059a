"""Visibility against brute force: every ray against every box, without any traversal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topomerge.extraction.views.view_rooms import compute_jaccard_similarity, vote
from topomerge.extraction.views.visibility import Visibility, find_visible_cells
from topomerge.kernels import graphs as kernel
from topomerge.kernels import rays
from topomerge.types import VoxelGrid


def brute_force(grid: VoxelGrid, view: np.ndarray, radius: float) -> list[int]:
    """Rows seen: the segment to the cell's centre meets no other occupied box (slab method), except the one around the view."""
    origin = (view - grid.origin) / grid.edge
    centre = grid.cells + 0.5
    direction = centre - origin
    seen = []
    for i, d in enumerate(direction):
        if np.linalg.norm(d) * grid.edge > radius:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            t0, t1 = (grid.cells - origin) / d, (grid.cells + 1 - origin) / d
        enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
        around_view = (np.floor(origin) == grid.cells).all(axis=1)
        hit = (enter < leave) & (leave > 0) & (enter < 1.0) & ~around_view
        hit[i] = False
        if not hit.any():
            seen.append(i)
    return seen


def cluttered(seed: int, n: int = 250, size: int = 14) -> VoxelGrid:
    rng = np.random.default_rng(seed)
    floor = np.argwhere(np.ones((size, size, 1), bool))
    cells = np.concatenate([rng.integers(0, size, (n, 3)), floor]).astype(np.int32)
    return VoxelGrid.from_cells(cells, np.array([-0.7, 3.1, 0.2]), 0.1)


@pytest.mark.longer
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.4, 0.9, 5.0]))
def test_same_set_as_brute_force(seed, radius):
    grid = cluttered(seed)
    rng = np.random.default_rng(seed + 1)
    low, high = grid.bounds
    views = rng.uniform(low - 0.3, high + 0.3, (6, 3))  # some outside the grid, some inside occupied cells
    visibility = find_visible_cells(grid, views, radius)
    for v, view in enumerate(views):
        assert visibility.get_rows(v).tolist() == brute_force(grid, view, radius)


def test_sparse_space_is_jumped_over_without_missing_anything():
    rng = np.random.default_rng(5)
    grid = VoxelGrid.from_cells(rng.integers(0, 120, (160, 3)).astype(np.int32), edge=0.1)
    views = rng.uniform(0, 12, (5, 3))
    visibility = find_visible_cells(grid, views, 9.0)
    for v, view in enumerate(views):
        assert visibility.get_rows(v).tolist() == brute_force(grid, view, 9.0)


def test_distance_field_is_chebyshev():
    grid = cluttered(3, 40, 12)
    in_window = ((grid.cells >= (1, 0, 2)) & (grid.cells < (10, 12, 12))).all(axis=1)
    field = rays.compute_distance_field(grid.cells[in_window], np.array([1, 0, 2]), (9, 12, 10))
    cells = np.argwhere(np.ones((9, 12, 10), bool)) + (1, 0, 2)
    expected = np.abs(cells[:, None] - grid.cells[in_window][None]).max(axis=-1).min(axis=1)
    assert (field.ravel() == expected).all()


def test_views_far_apart_come_back_in_their_order():
    blocks = [np.argwhere(np.ones((4, 4, 2), bool)) + (x, 0, 0) for x in (0, 300, 700)]
    grid = VoxelGrid.from_cells(np.concatenate(blocks).astype(np.int32), edge=0.1)
    views = np.array([[70.23, 0.21, 0.71], [0.23, 0.21, 0.71], [30.23, 0.21, 0.71], [50.0, 0.0, 0.5], [70.27, 0.21, 0.71]])
    visibility = find_visible_cells(grid, views, 3.0)
    assert visibility.count_cells().tolist() == [len(visibility.get_rows(v)) for v in range(5)]
    blocks_seen = [np.unique(grid.cells[visibility.get_rows(v), 0] // 100).tolist() for v in range(5)]
    assert blocks_seen == [[7], [0], [3], [], [7]]


def test_no_views():
    visibility = find_visible_cells(cluttered(0), np.zeros((0, 3)), 1.0)
    assert len(visibility) == 0 and visibility.count_cells().tolist() == []


def sets_of(rows: list[list[int]], n: int) -> Visibility:
    """A visibility that sees the given rows."""
    indptr, words, masks = [0], [], []
    for seen in rows:
        for word in sorted({r >> 6 for r in seen}):
            words.append(word)
            masks.append(sum(1 << (r & 63) for r in seen if r >> 6 == word))
        indptr.append(len(words))
    return Visibility(np.array(indptr), np.array(words, np.int32), np.array(masks, np.uint64), n)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.sets(st.integers(0, 300), max_size=60), min_size=1, max_size=8), st.sampled_from([0.0, 0.2]))
def test_jaccard_equals_sets(sets, threshold):
    visibility = sets_of([sorted(s) for s in sets], 301)
    assert [visibility.get_rows(v).tolist() for v in range(len(sets))] == [sorted(s) for s in sets]
    similarity = compute_jaccard_similarity(visibility, threshold).toarray()
    for i, a in enumerate(sets):
        for j, b in enumerate(sets):
            exact = 1.0 if i == j else len(a & b) / max(len(a | b), 1)
            assert similarity[i, j] == pytest.approx(exact if exact >= threshold or i == j else 0.0)
    assert visibility.count_cells().tolist() == [len(s) for s in sets]


@pytest.mark.longer
def test_views_of_other_heights_are_not_compared():
    rows = [[1, 2, 70], [2, 70, 90], [100, 101]]
    heights = np.arange(128) // 64
    visibility = sets_of(rows, 128)
    assert kernel.compute_extents(visibility.indptr, visibility.words, visibility.masks, heights).tolist() == [
        [0, 1],
        [0, 1],
        [1, 1],
    ]
    plain, quick = (compute_jaccard_similarity(visibility, heights=h).toarray() for h in (None, heights))
    assert (plain == quick).all()
    far = np.array([0] * 64 + [5] * 64)
    assert compute_jaccard_similarity(sets_of([[1, 2], [100]], 128), heights=far).toarray().tolist() == [[1, 0], [0, 1]]


def test_only_pairs_within_reach_are_compared():
    visibility = sets_of([[1, 2, 3], [1, 2, 3], [1, 2, 3]], 64)
    similarity = compute_jaccard_similarity(visibility, 0.3, np.array([[0, 0, 0], [1, 0, 0], [9, 0, 0]]), 2.0).toarray()
    assert similarity.tolist() == [[1, 1, 0], [1, 1, 0], [0, 0, 1]]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.sets(st.integers(0, 150), max_size=40), st.integers(0, 3)), min_size=1, max_size=9))
def test_votes_equal_counting(views):
    winner = vote(sets_of([sorted(s) for s, _ in views], 151), np.array([c for _, c in views]))
    for row in range(151):
        votes = [sum(row in s and c == cluster for s, c in views) for cluster in range(4)]
        assert winner[row] == (int(np.argmax(votes)) if max(votes) else -1)
