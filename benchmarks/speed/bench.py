"""Shared by the benchmarks: timing, and one line of output a comparison."""

from __future__ import annotations

import gc
from collections.abc import Callable
from time import perf_counter
from typing import Any


def best(fn: Callable[[], Any], repeat: int = 5) -> float:
    """Shortest of `repeat` runs, s: the least disturbed one. Call `fn` once before, if it compiles."""
    seconds = []
    for _ in range(repeat):
        gc.collect()  # a peer that returns lists must not pay for the garbage of another
        start = perf_counter()
        fn()
        seconds.append(perf_counter() - start)
    return min(seconds)


def line(name: str, ours: float, peer: float) -> str:
    """Print and return `name ours peer ratio`: s with 4 significant digits, ratio = peer / ours (above 1: ours is faster)."""
    if not name or any(c.isspace() for c in name):
        raise ValueError(f"a name of a benchmark must be one word, not {name!r}")
    text = f"{name} {ours:#.4g} {peer:#.4g} {peer / ours:#.4g}"
    print(text, flush=True)
    return text
