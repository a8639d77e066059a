"""Two apartments, each captured four times with a depth-sensing phone and drawn once (Halmstad Robot Maps; Shahbandi 2019).

The owner marked key points in all maps, in pixels from the lower left corner, and which of them are the same: the truth is the
similarity that fits them best. It has a scale, as the drawings are not to scale and the captures differ by up to 3 %. Metres per
pixel are not published; `PIXEL` makes rooms and doors of a plausible size.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.flat_maps import FlatMap, build_flat_pair, read_flat
from topomerge.datasets.pairs.pairs import Pair

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

PIXEL = 0.02  # m
LARGEST_LISTING = 10 << 20  # bytes of the list of pairs


def iter_pairs(folder: Path, pixel: float = PIXEL) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of every pair of maps of one place; of the two orders in which a pair is listed, the first.

    Args:
        pixel: m.

    Raises:
        InputError: the list of pairs is missing or damaged.
    """
    path = folder / "ground_truth_pairs.json"
    if not path.is_file() or path.stat().st_size > LARGEST_LISTING:
        raise InputError(f"{path}: no such file, or far too large; copy the data set again")
    try:
        listed = json.loads(path.read_bytes())
        points = {name: np.array(p, float).reshape(-1, 2) for name, p in listed["keypoints_px"].items()}
        truths = [(str(p["a"]), str(p["b"]), np.array(p["idx"], int).reshape(-1, 2)) for p in listed["pairs"]]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: is not a list of key points and pairs ({error}); copy it again") from error
    read, done = cache(partial(_read, folder, pixel)), set()
    for a, b, same in truths:
        if frozenset((a, b)) not in done:
            done.add(frozenset((a, b)))
            yield f"{a}-{b}", partial(_load_pair, read, {n: p * pixel for n, p in points.items()}, a, b, same)


def _load_pair(read: Callable[[str], FlatMap], points: dict[str, Array], a: str, b: str, same: Array) -> Pair:
    """Load one pair, in the owner's frames: they differ."""
    maps = read(a), read(b)
    try:
        truth = fit_points(*(points[n][same[:, k]] for k, n in enumerate((a, b))))
    except (KeyError, IndexError) as error:
        raise InputError(f"{a}-{b}: a key point is missing ({error}); copy the list of pairs again") from error
    sensors = tuple("drawing" if n.endswith("layout") else "phone" for n in (a, b))
    return build_flat_pair(f"{a}-{b}", *maps, truth, (sensors[0], sensors[1]), "halmstad", a.split("_")[0])


def _read(folder: Path, pixel: float, name: str) -> FlatMap:
    drawn = name.endswith("layout")
    path = folder / "maps" / name.split("_")[0] / ("layout" if drawn else "pseudo_occupancy") / f"{name}.png"
    return read_flat(path, pixel, rays=not drawn)


def fit_points(a: Array, b: Array) -> Sim3:
    """Fit the similarity that maps points b (n, 2) onto a (n, 2) with the least squares.

    Raises:
        InputError: fewer than two points, or all in one place.
    """
    x, y = (p @ [1, 1j] for p in (b, a))  # a plane similarity is one product and one sum of complex numbers
    spread = float((np.abs(x - x.mean()) ** 2).sum()) if len(x) > 1 else 0.0
    if not spread > 0:
        raise InputError("a similarity needs two points that differ")
    turn = (np.conj(x - x.mean()) * (y - y.mean())).sum() / spread
    shift = y.mean() - turn * x.mean()
    return Sim3(float(np.angle(turn)), (float(shift.real), float(shift.imag), 0.0), float(abs(turn)))
