"""Compiled inner loops, kept between runs where that is possible: beside the source or in the user's cache folder.

Where neither can be written (an installation by somebody else, a container without a home), numba would refuse to import them
at all: then they are kept in a folder below the system's temporary one.

What an extraction and a merge need is compiled before its first use, by one process a core (`topomerge.kernels.ahead`).
Loops run on all cores through slices of their range: they let go of the interpreter, and numba's own parallel loops take three
times as long to compile.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from numba import config, njit

from topomerge.kernels.ahead import compile_ahead as compile_ahead
from topomerge.kernels.ahead import compile_missing

T = TypeVar("T")
R = TypeVar("R")
SLICES_A_THREAD = 4  # so that threads end at about the same time
_threads = {"count": int(config.NUMBA_NUM_THREADS)}  # type: ignore[attr-defined]
_working: list[Sequence[int]] = []  # of processes that share the cores, which of them work (`share_threads`)


def count_threads() -> int:
    """Return how many threads share a loop: as many as cores, unless `set_thread_count` says otherwise; of processes that share
    the cores, the part of each that works at the moment."""
    sharing = sum(_working[0]) if _working else 1
    return max(_threads["count"] // max(sharing, 1), 1)


def share_threads(working: Sequence[int] | None) -> None:
    """Share the threads with other processes from now on; None: with none.

    Args:
        working: in memory of all of them, 1 of each that works; each writes its own, so that no lock is needed.
    """
    _working[:] = [] if working is None else [working]


def set_thread_count(count: int) -> None:
    """Let so many threads share a loop from now on."""
    _threads["count"] = max(count, 1)


def run_in_slices(function: Callable[..., T], count: int, least: int, *args: Any) -> list[T]:
    """Call function(first, last, *args) for slices of range(count) side by side; return what it returns, in order.

    Args:
        function: lets go of the interpreter; what it writes for one index does not depend on other ones.
        least: of a slice, below which a thread costs more than it saves.
    """
    # Not numba's parallel loops: they take three times as long to compile (docs/adr/0031).
    slices = min(count // least, SLICES_A_THREAD * count_threads())
    if slices < 2 or count_threads() == 1:
        return [function(0, count, *args)]
    borders = [count * k // slices for k in range(slices + 1)]
    with ThreadPoolExecutor(min(slices, count_threads())) as pool:
        return list(pool.map(lambda first, last: function(first, last, *args), borders[:-1], borders[1:]))


def run_side_by_side(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """Return what the function gives for each item, on as many threads as loops have.

    Args:
        function: lets go of the interpreter for most of its time, as loops, large arrays and networks do. A batch of networks
            takes longer than its plans one by one (docs/adr/0031).
    """
    if len(items) < 2 or count_threads() == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(len(items), count_threads())) as pool:
        return list(pool.map(function, items))


def _probe() -> None: ...


def _create_private_folder() -> Path:
    """Create a folder that nobody else can write to: what is kept there is code.

    Raises:
        OSError: there is none.
    """
    folder = Path(tempfile.gettempdir(), f"topomerge-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        reason = "others may write to it; set NUMBA_CACHE_DIR to a folder of yours"
        raise OSError(errno.EPERM, reason, str(folder))
    return folder


try:
    _kept = njit(cache=True)(_probe)  # compiles nothing yet
except RuntimeError:  # no place to keep it
    config.CACHE_DIR = str(_create_private_folder())  # type: ignore[attr-defined]
    _kept = njit(cache=True)(_probe)
compile_missing(Path(_kept.stats.cache_path), count_threads())
