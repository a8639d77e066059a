"""Storeys of two real buildings as robots mapped them, some with nearly one plan (jsk_demos, jsk_maps/raw_maps): for development.

Maps of two storeys must not be merged: they have no truth, and are of kind other-storey. Maps of one storey in several years
share a frame, as each was edited from the one before: the truth is the identity, and they are no independent captures.
Storey 8 was drawn over a copy of storey 7, so that nobody could tell their corridors apart: this pair is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path

from topomerge.datasets.pairs.flat_maps import FlatMap, build_flat_pair, read_flat
from topomerge.datasets.pairs.pairs import Pair

from topomerge.types import Sim3

STOREYS = {"eng2": ("1f", "2f", "3f", "7f", "8f"), "eng8": ("b1f", "1f", "6f")}  # building -> storeys
YEARS = ("eng2-7f_2015", "eng2-7f_2016", "eng2-7f_2019", "eng2-7f")  # maps of one storey
COPIED = {"7f", "8f"}


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of each pair: two storeys of one building, then one storey in two years."""
    read = cache(lambda name: read_flat(folder / f"{name}.yaml"))
    number = 0
    for building, storeys in STOREYS.items():
        for a, b in combinations(storeys, 2):
            if {a, b} != COPIED:
                yield f"{building}-{a}-{b}", partial(make_pair, read, f"{building}-{a}", f"{building}-{b}", number, False)
                number += 1
    for a, b in combinations(YEARS, 2):
        yield f"{a}-{b.removeprefix('eng2-')}", partial(make_pair, read, a, b, number, True)
        number += 1


def make_pair(read: Callable[[str], FlatMap], a: str, b: str, seed: int, one_storey: bool) -> Pair:
    """Make the pair of two maps, each in a frame of its own drawn from the seed."""
    pair = build_flat_pair(f"{a}-{b}", read(a), read(b), Sim3(), ("laser2d", "laser2d"), "storeys", a.partition("-")[0], seed)
    return pair if one_storey else replace(pair, truth=None, kind="other-storey", shared=(), overlap=0.0)
