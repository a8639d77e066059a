"""What probably stands in each column of a plan: a small convolutional network, trained on simulated scans of training buildings
(`train.py task=plan_segmentation`), in NumPy (`numpy_nn`; beyond the thesis: docs/adr/0005).

A U-Net (Ronneberger et al. 2015) over what the plan knows of each column. It sees a few metres around, so that it may take the
legs of a table for furniture, a stub of wall for the jamb of a door, and a gap between two stubs for a doorway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.io.weight_files import weights_file
from topomerge.numpy_nn import convolution, linear, softmax
from topomerge.types import Array

FILE = "plan_network.npz"
CLASSES = ("inside", "wall", "doorway", "shut", "outside")  # furniture is inside
HEIGHTS = ((0.1, 0.5), (0.5, 1.2), (1.2, 2.0), (2.0, 2.4))  # m
CHANNELS = 11
STRIDE = 16  # of the coarsest level
DOWN = ("a", "b", "c", "d")  # levels of 1/2, 1/4, 1/8, 1/16: each halves and goes on
UP = ("e", "f", "g", "h")  # and back, each beside what went down
FURNITURE = 0.6, 0.95  # probability of the inside of a room from which what looked like wall is none: without and with a ceiling
DOORWAY, WALL = 0.3, 0.02  # probabilities: less of a door and more of a wall around it, and a passage leads through a wall
AROUND = 0.3  # m


def evidence(plan: StoreyPlan) -> Array:
    """(nx, ny, 11) float32 of what was seen in each column: known, wall, how full four bands of heights are, floor, lintel,
    ceiling and its height, and how large a column is."""
    levels = []
    for low, high in HEIGHTS:
        mask = np.uint64(plan.bands.mask(low, high))
        levels.append(np.bitwise_count(plan.profile & mask) / float(np.bitwise_count(mask)))
    seen = ~np.isnan(plan.clear)
    lintel = plan.clear < plan.ceiling - 0.2  # nan: no
    height = np.where(seen, np.clip(plan.clear, 1.9, 4.5) - 2.5, 0.0)
    floor = plan.occupied(-0.3, 0.3)
    size = np.full(plan.wall.shape, 5 * plan.edge)
    return np.stack(
        [plan.inside, plan.wall, *levels, floor, lintel, seen, height, size], axis=-1, dtype=np.float32, casting="unsafe"
    )


def segment(plan: StoreyPlan) -> Array:
    """(nx, ny, 5) float32 probability of each of `CLASSES`."""
    x = evidence(plan)
    nx, ny = x.shape[:2]
    x = np.pad(x, ((STRIDE, -nx % STRIDE + STRIDE), (STRIDE, -ny % STRIDE + STRIDE), (0, 0)))
    score = forward(x, weights())[STRIDE : STRIDE + nx, STRIDE : STRIDE + ny]
    return softmax(score)


def without_furniture(plan: StoreyPlan, chance: Array) -> StoreyPlan:
    """The plan without the walls that are probably furniture: the legs of tables in slices and grid maps, cupboards.

    Where a ceiling was seen it told most cupboards from walls already (`plan`). What touches a wall stays: a blurred wall
    keeps its face.
    """
    furniture = plan.wall & (chance[..., 0] > np.where(np.isnan(plan.ceiling), *FURNITURE))
    furniture &= ~ndimage.binary_dilation(plan.wall & ~furniture, np.ones((3, 3)))
    return replace(plan, wall=plan.wall & ~furniture, inside=plan.inside | furniture)


@dataclass(frozen=True, eq=False)
class Told:
    """What the network says of a storey, in the frame of the map.

    Args:
        chance: (nx, ny, 5) probability of each of `CLASSES`.
        origin: (2,) m, lower corner of the first column.
        edge: m, of a column.
        height: m, of the floor.
    """

    chance: Array
    origin: Array
    edge: float
    height: float


def through_wall(told: Sequence[Told], centre: Array) -> bool:
    """Does a passage at `centre` (3,) lead through a wall: none of its columns is of a door, and some are of a wall?"""
    if not told:
        return False
    here = min(told, key=lambda t: abs(t.height - float(centre[2])))
    reach = max(int(AROUND / here.edge), 1)
    low = np.floor((centre[:2] - here.origin) / here.edge).astype(np.int64) - reach
    box = tuple(slice(max(k, 0), max(k + 2 * reach + 1, 0)) for k in low.tolist())
    near = here.chance[box]
    return bool(near.size and near[..., 2:4].sum(axis=-1).max() < DOORWAY and near[..., 1].mean() > WALL)


def forward(x: Array, w: dict[str, Array]) -> Array:
    """(nx, ny, 5) float32 scores from (nx, ny, 11) evidence; both sides are multiples of 16."""
    skips = [x]
    for name in DOWN:
        x = convolution(x, w[f"{name}1.w"], w[f"{name}1.b"], 2)
        x = convolution(x, w[f"{name}2.w"], w[f"{name}2.b"])
        skips.append(x)
    x = skips.pop()
    for name in UP:
        x = np.concatenate([x.repeat(2, axis=0).repeat(2, axis=1), skips.pop()], axis=-1)
        x = convolution(x, w[f"{name}1.w"], w[f"{name}1.b"])
    return linear(x, w["out.w"], w["out.b"])


def weights() -> dict[str, Array]:
    """The weights that ship, or those in their place (`io.weight_files`)."""
    return read_weights(weights_file("topomerge.extraction.plans", FILE))


@lru_cache(maxsize=4)
def read_weights(path: Path) -> dict[str, Array]:
    """Weights as float32 by their names.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name].astype(np.float32) for name in file.files}
    except Exception as error:  # zip, header and data each have their own errors
        raise InputError(f"{path}: is no network of plans ({error}); install topomerge again") from error
    names = [f"{n}{k}" for n in DOWN for k in (1, 2)] + [f"{n}1" for n in UP]
    channels = dict.fromkeys(names, 9) | {"out": 1}
    for name, taps in channels.items():
        w, b = found.get(f"{name}.w"), found.get(f"{name}.b")
        fits = w is not None and b is not None and w.ndim == 2 and not w.shape[0] % taps and b.shape == w.shape[1:]
        if not fits or not np.isfinite(found[f"{name}.w"]).all() or not np.isfinite(found[f"{name}.b"]).all():
            raise InputError(f"{path}: is no network of plans (layer {name}); install topomerge again")
    if found["a1.w"].shape[0] != 9 * CHANNELS or found["out.w"].shape[1] != len(CLASSES):
        raise InputError(f"{path}: was trained with other inputs or answers; install topomerge again")
    return found
