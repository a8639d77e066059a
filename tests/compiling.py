"""Two processes of tests do not compile the same kernel: who comes second waits, and then finds it in numba's cache on disk."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

_held: set[str] = set()  # by this process: a kernel may call another one of its file


@contextmanager
def _alone(source: str) -> Iterator[None]:
    """No other process compiles what is in this file meanwhile."""
    if source in _held:
        yield
        return
    with open(source) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        _held.add(source)
        try:
            yield
        finally:
            _held.discard(source)  # closing the file unlocks it


def compile_once() -> None:
    """From now on this process compiles a function while no other one compiles any of the same file."""
    compile_ = Dispatcher.compile

    def compile_alone(self: Any, signature: Any) -> Any:
        if self.py_func.__module__.partition(".")[0] != "topomerge":
            return compile_(self, signature)
        with global_compiler_lock, _alone(self.py_func.__code__.co_filename):  # in this order: threads compile in turn
            return compile_(self, signature)

    Dispatcher.compile = compile_alone
