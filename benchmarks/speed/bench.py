"""Shared by the benchmarks of speed: timing, one line of output a comparison, and a made-up office storey as points."""

from __future__ import annotations

import gc
import resource
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from topomerge.progress import Stopwatch

T = TypeVar("T")
WIDTH, DEPTH, STOREY_HEIGHT = 50.0, 30.0, 3.0  # m: 1,500 m2
ROOMS_A_SIDE = 10  # a side
CORRIDOR = 2.4  # m
DOOR_WIDTH = 1.0  # m


def time_best(fn: Callable[[], Any], repeat: int = 5) -> float:
    """Return the shortest of `repeat` runs, s: the least disturbed one. Call `fn` once before, if it compiles."""
    seconds = []
    for _ in range(repeat):
        gc.collect()  # a peer that returns lists must not pay for the garbage of another
        watch = Stopwatch()
        fn()
        seconds.append(watch.elapsed)
    return min(seconds)


def run_timed(work: Callable[[], T], who: int = resource.RUSAGE_SELF) -> tuple[T, float, float]:
    """Run work: its result, seconds by the clock, and seconds of the processor, of this process or of those that it starts."""
    before, watch = resource.getrusage(who), Stopwatch()
    result = work()
    seconds, after = watch.elapsed, resource.getrusage(who)
    return result, seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def print_line(name: str, ours: float, peer: float) -> str:
    """Print and return `name ours peer ratio`: s with 4 significant digits, ratio = peer / ours (above 1: ours is faster)."""
    if not name or any(c.isspace() for c in name):
        raise ValueError(f"a name of a benchmark must be one word, not {name!r}")
    text = f"{name} {ours:#.4g} {peer:#.4g} {peer / ours:#.4g}"
    print(text, flush=True)
    return text


def _build_walls() -> list[tuple[tuple[float, float], tuple[float, float]]]:
    low, high = DEPTH / 2 - CORRIDOR / 2, DEPTH / 2 + CORRIDOR / 2
    corners = [(0.0, 0.0), (WIDTH, 0.0), (WIDTH, DEPTH), (0.0, DEPTH)]
    walls = list(zip(corners, corners[1:] + corners[:1], strict=True))
    for y in (low, high):
        begin = 0.0
        for x in (np.arange(ROOMS_A_SIDE) + 0.5) * WIDTH / ROOMS_A_SIDE:
            walls.append(((begin, y), (float(x) - DOOR_WIDTH / 2, y)))
            begin = float(x) + DOOR_WIDTH / 2
        walls.append(((begin, y), (WIDTH, y)))
    for i in range(1, ROOMS_A_SIDE):
        x = i * WIDTH / ROOMS_A_SIDE
        walls += [((x, 0.0), (x, low)), ((x, high), (x, DEPTH))]
    return walls


def storey(points: int = 6_000_000, seed: int = 0, noise: float = 0.01) -> np.ndarray:
    """Return (points, 3) float32 on the surfaces of 20 rooms on a corridor, 1,500 m2, evenly by area, with noise (m)."""
    rng = np.random.default_rng(seed)
    walls = [(np.array(a), np.array(b)) for a, b in _build_walls()]
    area = np.array([WIDTH * DEPTH] * 2 + [2 * STOREY_HEIGHT * float(np.linalg.norm(b - a)) for a, b in walls])
    which = rng.choice(len(area), points, p=area / area.sum())
    u, v = rng.random(points), rng.random(points)
    out = np.empty((points, 3), np.float32)
    flat = which < 2
    out[flat] = np.column_stack([u[flat] * WIDTH, v[flat] * DEPTH, which[flat] * STOREY_HEIGHT])
    for i, (a, b) in enumerate(walls):
        here = np.flatnonzero(which == i + 2)
        along = b - a
        side = np.where(rng.random(len(here)) < 0.5, -0.05, 0.05)[:, None]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        out[here] = np.column_stack([a + u[here, None] * along + side * across, v[here] * STOREY_HEIGHT])
    return (out + rng.normal(0, noise, out.shape) + (0.03, 0.03, 0.04)).astype(np.float32)
