"""Both halves of the sealed grids that robots drew, for the sealed run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.flat import Flat, flat_pair, read_flat
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.sealed import SEALED_FOLDERS, is_sealed_file

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

HALF = 0.65  # share of a robot's grid that each of its halves shows


def robot_halves(data: Path) -> dict[str, tuple[Flat, Flat] | str]:
    """Both halves of each sealed grid of known scale, or why there are none."""
    out: dict[str, tuple[Flat, Flat] | str] = {}
    folder = data / SEALED_FOLDERS["strands"][0]
    for number, path in enumerate(sorted(p for p in folder.rglob("*.yaml") if is_sealed_file(p))):
        try:
            out[path.stem] = cut(read_flat(path), number)
        except InputError as error:
            out[path.stem] = f"{path.stem}: {' '.join(str(error).split())[:100]}"
    return out


def pair_of_halves(name: str, flats: tuple[Flat, Flat], place: str, number: int) -> Pair:
    """A pair of both halves, each in a frame of its own."""
    return flat_pair(name, *flats, Sim3(), ("laser2d", "laser2d"), "strands", place, number)


def cut(flat: Flat, seed: int) -> tuple[Flat, Flat]:
    """Two parts of a floor, each `HALF` of its free floor, cut across at any angle.

    Raises:
        InputError: no free floor.
    """
    if not len(flat.free):
        raise InputError("no free floor in it")
    angle = np.random.default_rng(seed).uniform(0, np.pi)
    across = np.array([np.cos(angle), np.sin(angle)])
    low, high = np.quantile(flat.free @ across, [1 - HALF, HALF])
    return _part(flat, lambda p: p @ across <= high), _part(flat, lambda p: p @ across >= low)


def _part(flat: Flat, inside: Callable[[Array], Array]) -> Flat:
    return replace(flat, walls=flat.walls[inside(flat.walls)], free=flat.free[inside(flat.free)], poses=None)
