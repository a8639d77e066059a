"""Threads of linear algebra."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")


def limit_blas_threads(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, in which NumPy's and SciPy's linear algebra takes one thread; afterwards as many as before.

    Matrices here are small. More threads of BLAS wait for each other, and by waiting busily they take the processor from the
    compiled loops, which use all cores; and sums come out the same on machines with any number of cores. Called from another
    than the main thread, it changes nothing: OpenBLAS is told its number of threads there only.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
