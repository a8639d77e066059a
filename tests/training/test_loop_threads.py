"""Batches that threads make come in their order, and no more are made than are needed soon."""

from __future__ import annotations

import time

import pytest

from topomerge.training.loop import prefetch_by_threads


def test_pieces_come_in_the_order_of_their_keys():
    def make(key: int) -> int:
        time.sleep(0.01 * (key % 3))  # later ones are done first
        return key * key

    assert list(prefetch_by_threads(make, range(20), 4)) == [k * k for k in range(20)]


def test_only_what_is_needed_soon_is_made():
    made: list[int] = []
    pieces = prefetch_by_threads(lambda key: made.append(key) or key, range(100), 3)
    assert next(pieces) == 0
    pieces.close()
    assert len(made) <= 5


def test_an_error_comes_where_its_piece_would():
    def make(key: int) -> int:
        if key == 2:
            raise ValueError("two")
        return key

    pieces = prefetch_by_threads(make, range(5), 2)
    assert [next(pieces), next(pieces)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(pieces)
