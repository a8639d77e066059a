"""Threads of linear algebra."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from threading import Lock
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
R = TypeVar("R")
_lock = Lock()
_limits: list[threadpool_limits] = []  # of the functions that have begun since none ran
_ended = 0  # of these


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function, in which NumPy's and SciPy's linear algebra takes one thread; afterwards as many as before.

    Matrices here are small. More threads of BLAS wait for each other, and by waiting busily they take the processor from the
    compiled loops, which use all cores; and sums come out the same on machines with any number of cores. Such functions may
    call each other, and run in several threads at once.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _limited():
            return function(*args, **kwargs)

    return limited


@contextmanager
def _limited() -> Iterator[None]:
    """Some libraries count threads for the process, others for the thread that asks: so each function sets its own limits, and
    what was before the first one is set again after the last one."""
    global _ended
    with _lock:
        limits = threadpool_limits(1, user_api="blas")
        _limits.append(limits)
    try:
        yield
    finally:
        with _lock:
            limits.restore_original_limits()
            _ended += 1
            if _ended == len(_limits):
                _limits[0].restore_original_limits()
                _limits.clear()
                _ended = 0
