"""Which maps of an atlas each is registered with: all others where they are few, else those on which it lies best, coarsely, of
those that its rooms look most like."""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np

from topomerge.fusion.atlas.coarse import coarse_key, coarse_log_odds
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.neighbours import most_alike
from topomerge.fusion.atlas.workers import CoarseTask, Workers, lay_coarsely
from topomerge.fusion.inputs import FEW_MAPS

COARSE_PARTNERS = 40  # maps that a map's rooms look most like, on which it is laid coarsely
MOST_PARTNERS = 5  # of these and of those that name it, the ones on which it lies best
LIKELY_PARTNERS = 2  # that its rooms look most like, however it lies: drift spoils a coarse pose


def partners_of(
    maps: Maps,
    linked: Iterable[tuple[int, int]] = (),
    scale: str = "fixed",
    end: float = np.inf,
    workers: Workers | None = None,
) -> tuple[list[list[int]], bool]:
    """For each map those that it may be registered with, best first, and whether all was looked at. A map without rooms names the
    largest ones.

    Args:
        linked: pairs that may be registered however they look.
        end: `time.perf_counter` after which nothing is laid coarsely any more; pairs that were not come last.
        workers: lay maps that are files; None: this process does.
    """
    count = len(maps)
    named = _named(maps)
    sets = [set(of) for of in named]
    for k, of in enumerate(named):
        for m in of:
            sets[m].add(k)
    if workers is not None and count > 2:
        _lay_all(maps, named, scale, workers)
    odds, complete = _laid(maps, named, scale, end)
    chosen = {_pair(*pair) for pair in linked}
    for k in range(count):
        best = sorted(sets[k], key=lambda m, k=k: (-odds.get(_pair(k, m), -np.inf), m))  # type: ignore[misc]
        chosen |= {_pair(k, m) for m in (best if count <= FEW_MAPS else best[:MOST_PARTNERS] + named[k][:LIKELY_PARTNERS])}
    partners: list[dict[int, float]] = [{} for _ in range(count)]
    for i, j in sorted(chosen):
        partners[i][j] = partners[j][i] = odds.get((i, j), -np.inf)
    return [[m for _, m in sorted((-likely, m) for m, likely in of.items())] for of in partners], complete


def _named(maps: Maps) -> list[list[int]]:
    """For each map those that its rooms look most like, most alike first; all others where they are few."""
    count = len(maps)
    if count <= FEW_MAPS:
        return [[m for m in range(count) if m != k] for k in range(count)]
    largest = sorted(range(count), key=lambda k: -maps.area(k))
    named = most_alike([maps.rows(k) for k in range(count)], COARSE_PARTNERS)
    return [list(of) or [m for m in largest if m != k][:COARSE_PARTNERS] for k, of in enumerate(named)]


def _laid(maps: Maps, named: list[list[int]], scale: str, end: float) -> tuple[dict[tuple[int, int], float], bool]:
    """Log odds of the pairs; those are all, if time allowed and there is a choice. Map by map, so that few are in memory; those
    that look most alike first, if time may end."""
    ranks: dict[tuple[int, int], int] = {}
    for k, of in enumerate(named):
        for rank, m in enumerate(of):
            ranks[_pair(k, m)] = min(rank, ranks.get(_pair(k, m), rank))
    odds: dict[tuple[int, int], float] = {}
    for i, j in sorted(ranks, key=lambda pair: ranks[pair] if np.isfinite(end) else 0) if len(maps) > 2 else ():
        if time.perf_counter() >= end:
            return odds, False
        odds[i, j] = coarse_log_odds(maps, i, j, scale)
    return odds, True


def _lay_all(maps: Maps, named: list[list[int]], scale: str, workers: Workers) -> None:
    """Let workers lay maps that are files on each other, where that was not done before: each on all later ones at once."""
    files = [maps.file(k) for k in range(len(maps))]
    later: dict[int, list[int]] = {}
    for i, j in sorted({_pair(k, m) for k, of in enumerate(named) for m in of}):
        if files[i] and files[j] and coarse_key(maps, i, j) not in maps.memory.coarse:
            later.setdefault(i, [i]).append(j)
    laid = list(later.values())
    tasks = [CoarseTask(tuple(filter(None, (files[k] for k in of))), tuple(maps.keys[k] for k in of), scale) for of in laid]
    for number, odds in workers(lay_coarsely, tasks) if tasks else ():
        for k, log_odds in zip(laid[number][1:], odds, strict=True):
            maps.memory.coarse[coarse_key(maps, laid[number][0], k)] = log_odds


def _pair(i: int, j: int) -> tuple[int, int]:
    return min(i, j), max(i, j)
