"""Linear algebra takes one thread where the compiled loops need the cores."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from topomerge.blas import limit_blas_threads


def blas_threads() -> set[int]:
    assert np.eye(2).any()  # loads a library of linear algebra
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    @limit_blas_threads
    def work(number: int, *, fails: bool = False) -> tuple[int, set[int]]:
        """What it does."""
        if fails:
            raise ValueError("no")
        return number, blas_threads()

    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert work(3) == (3, {1}) and blas_threads() == before
        with pytest.raises(ValueError, match="no"):
            work(3, fails=True)
        assert blas_threads() == before and max(before) == 2
    assert work.__doc__ == "What it does."
