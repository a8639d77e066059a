"""Linear algebra takes one thread where the compiled loops need the cores."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from topomerge.blas import one_blas_thread


def blas_threads() -> set[int]:
    assert np.eye(2).any()  # loads a library of linear algebra
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    @one_blas_thread
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


@pytest.mark.parametrize("first_ends_first", [True, False])
def test_functions_that_call_each_other_or_overlap_give_the_threads_back(first_ends_first: bool) -> None:
    """The second begins while the first one holds one thread: as many as before the first must be there in the end."""
    begun, ending = (Event(), Event()), (Event(), Event())

    @one_blas_thread
    def inner() -> set[int]:
        return blas_threads()

    @one_blas_thread
    def work(number: int) -> set[int]:
        threads = inner()
        begun[number].set()
        assert ending[number].wait(60)
        return threads

    with threadpool_limits(2, user_api="blas"), ThreadPoolExecutor(2) as pool:
        before, results = blas_threads(), []
        for number in (0, 1):
            results.append(pool.submit(work, number))
            assert begun[number].wait(60)
        for number in (0, 1) if first_ends_first else (1, 0):
            ending[number].set()
            assert results[number].result() == {1}
        assert blas_threads() == before
