"""Class probabilities of each column of a plan: a convolutional network, trained on simulated scans of training buildings
(`train.py task=plan_segmentation`; for robots' grids and drawings `task=grid_segmentation`; beyond the thesis: docs/adr/0005).

A U-Net (Ronneberger et al. 2015) over what the plan knows of each column. It sees a few metres around, so that it may take the
legs of a table for furniture, a stub of wall for the jamb of a door, and a gap between two stubs for a doorway.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES, DOORWAY_CLASS, INSIDE_CLASS, StoreyPlan
from topomerge.kernels import run_side_by_side
from topomerge.networks.network import Network, Run, Signature, Tensor, load_network, load_shipped_network
from topomerge.types import Array, are_within

PLAN_NETWORK_FILE = "plan_network.onnx"
GRID_NETWORK_FILE = "grid_network.onnx"  # smaller: larger ones learn how grids are simulated
EVIDENCE_HEIGHTS = ((0.1, 0.5), (0.5, 1.2), (1.2, 2.0), (2.0, 2.4))  # m
EVIDENCE_CHANNELS = 11
COARSEST_STRIDE = 16  # columns a side, of an element of the coarsest level
DOWN_LEVELS = ("a", "b", "c", "d")  # levels of 1/2, 1/4, 1/8, 1/16: each halves and goes on
UP_LEVELS = ("e", "f", "g", "h")  # and back, each beside what went down
SIZE_CHANNEL = EVIDENCE_CHANNELS - 1  # the last one, which is the same everywhere
# One look loses on real homes (IoU .677 to .633), eight looks gain nothing that can be told (docs/adr/0005, 0026).
LOOKS = 4  # at a plan, each a quarter turned
NETWORK_REACH = 4  # strides: the network sees 60 columns to each side
WORTH_PARTING = 0.8  # of a plan's area: its parts are looked at one by one where their boxes have less
SAME_STOREY = 1.2  # m between a drawn door and the floor of its storey
# Surer below a ceiling: from .6 on, stubs of walls beside doors went, too (docs/adr/0005).
FURNITURE_CHANCE = 0.6, 0.95  # of the inside of a room, from which on what looked like wall is none: without and with a ceiling


PLAN_SIGNATURE = Signature(
    "Says what probably stands in each column of a plan.",
    {
        "evidence": Tensor(
            ("plans", EVIDENCE_CHANNELS, "nx", "ny"),
            "of each column, sides multiples of 16: known, wall, how full four bands of heights are (0 to 1), "
            "floor, lintel, ceiling, height of the ceiling less 2.5 m, a column's side times 5, m",
        )
    },
    {"probability": Tensor(("plans", len(COLUMN_CLASSES), "nx", "ny"), f"of {', '.join(COLUMN_CLASSES)}")},
)


def compute_evidence(plan: StoreyPlan) -> Array:
    """Return (nx, ny, 11) float32 of what was seen in each column: known, wall, how full four bands of heights are, floor,
    lintel, ceiling and its height, and how large a column is."""
    levels = []
    for low, high in EVIDENCE_HEIGHTS:
        mask = np.uint64(plan.bands.build_mask(low, high))
        levels.append(np.bitwise_count(plan.profile & mask) / float(np.bitwise_count(mask)))
    seen = ~np.isnan(plan.clear)
    lintel = plan.clear < plan.ceiling - 0.2  # nan: no
    height = np.where(seen, np.clip(plan.clear, 1.9, 4.5) - 2.5, 0.0)
    floor = plan.is_occupied(-0.3, 0.3)
    size = np.full(plan.wall.shape, 5 * plan.edge)
    return np.stack(
        [plan.inside, plan.wall, *levels, floor, lintel, seen, height, size], axis=-1, dtype=np.float32, casting="unsafe"
    )


def compute_column_probabilities(plan: StoreyPlan, network: Run | None = None, looks: int = LOOKS) -> Array:
    """Return (nx, ny, 5) float32 probability of each of `COLUMN_CLASSES` in each column, by the weights that ship or by others.

    The mean over the plan turned by quarters: what the network says of a door hangs on how its walls lie on the columns, and
    where they do by chance, four looks err less than one (docs/adr/0005).

    Args:
        looks: at how many of the four turns it is looked.
    """
    x, margin = np.moveaxis(compute_evidence(plan), -1, 0), COARSEST_STRIDE
    nx, ny = plan.wall.shape
    x = np.pad(x, ((0, 0), (margin, -nx % margin + margin), (margin, -ny % margin + margin)))
    w = load_weights() if network is None else network
    parts = _split_parts(np.asarray(x[:SIZE_CHANNEL].any(axis=0)))
    if parts is None:
        mean = _average_turns(x, w, looks)
    else:
        side = (2 * NETWORK_REACH + 1) * COARSEST_STRIDE
        nothing = np.zeros((EVIDENCE_CHANNELS, side, side), np.float32)
        nothing[SIZE_CHANNEL] = 5 * plan.edge
        mean = np.empty((*x.shape[1:], len(COLUMN_CLASSES)), np.float32)
        mean[:] = _average_turns(nothing, w, looks)[side // 2, side // 2]
        for box, mask in parts:
            mean[box][mask] = _average_turns(x[:, *box], w, looks)[mask]
    return np.ascontiguousarray(mean[margin : margin + nx, margin : margin + ny])


def _average_turns(x: Array, network: Run, looks: int) -> Array:
    """Return (nx, ny, 5) mean probability over (11, nx, ny) evidence turned by the first `looks` quarters."""

    def look(k: int) -> Array:
        return np.rot90(run_network(np.rot90(x, k, (1, 2)), network), -k, (1, 2))

    # One by one: a batch of four takes 15 % longer (docs/adr/0031). The mean of scores before the softmax is no better than
    # that of probabilities (docs/adr/0005).
    mean: Array = np.mean(run_side_by_side(look, range(looks)), axis=0)
    return np.moveaxis(mean, 0, -1)


def _split_parts(known: Array) -> list[tuple[tuple[slice, slice], Array]] | None:
    """Return the parts of a plan between which the network sees nothing: a box, and which of its columns the network sees
    anything from.

    A plan of buildings far apart, or of a long bent corridor, so costs what is in it, not the rectangle around it.

    Args:
        known: (nx, ny) bool, whether anything is known of a column; both sides are multiples of `COARSEST_STRIDE`.

    Returns:
        None where the boxes are nearly as large as the plan.
    """
    step = COARSEST_STRIDE
    blocks = known.reshape(known.shape[0] // step, step, known.shape[1] // step, step).any(axis=(1, 3))
    seen = ndimage.binary_dilation(blocks, np.ones((3, 3)), NETWORK_REACH)
    label, _ = ndimage.label(seen, np.ones((3, 3)))
    parts, size = [], 0
    for number, box in enumerate(ndimage.find_objects(label), 1):
        ends = zip(box, seen.shape, strict=True)
        wide = [slice(max(side.start - NETWORK_REACH, 0), min(side.stop + NETWORK_REACH, end)) for side, end in ends]
        mask = label[tuple(wide)] == number
        columns = slice(wide[0].start * step, wide[0].stop * step), slice(wide[1].start * step, wide[1].stop * step)
        parts.append((columns, mask.repeat(step, 0).repeat(step, 1)))
        size += mask.size
    return parts if size < WORTH_PARTING * seen.size else None


def add_drawn_doors(plan: StoreyPlan, probability: Array, doors: Array) -> Array:
    """Return the probabilities with the doors that a drawing shows: of a doorway the greater of both (docs/adr/0048).

    Args:
        probability: (nx, ny, 5) of each of `COLUMN_CLASSES`.
        doors: (k, 4) places on the floor, m, and how probably the drawing shows a door there.
    """
    at = np.floor((doors[:, :2] - plan.origin) / plan.edge).astype(np.int64)
    here = np.flatnonzero(are_within(at, 0, plan.wall.shape))
    here = here[np.abs(doors[here, 2] - plan.floor[tuple(at[here].T)]) < SAME_STOREY]
    column = np.ravel_multi_index(tuple(at[here].T), plan.wall.shape)
    count = np.bincount(column, minlength=plan.wall.size)
    mean = np.bincount(column, doors[here, 3], plan.wall.size) / np.maximum(count, 1)
    drawn = mean.astype(np.float32).reshape(plan.wall.shape)
    before = probability[..., DOORWAY_CLASS]
    # As evidence of the cut, not as votes for rooms: that gained .02 on flats and lost .01 on schools (docs/adr/0048).
    doorway = np.maximum(before, drawn)
    out = probability * ((1 - doorway) / np.maximum(1 - before, np.float32(1e-6)))[..., None]
    out[..., DOORWAY_CLASS] = doorway
    return out


def remove_furniture(plan: StoreyPlan, probability: Array) -> StoreyPlan:
    """Return the plan without the walls that are probably furniture: the legs of tables in slices and grid maps, cupboards.

    Where a ceiling was seen, most cupboards differ from walls already (`plan`). What touches a wall stays: a blurred wall
    keeps its face.

    Args:
        probability: (nx, ny, 5) of each of `COLUMN_CLASSES`.
    """
    furniture = plan.wall & (probability[..., INSIDE_CLASS] > np.where(np.isnan(plan.ceiling), *FURNITURE_CHANCE))
    furniture &= ~ndimage.binary_dilation(plan.wall & ~furniture, np.ones((3, 3)))
    return replace(plan, wall=plan.wall & ~furniture, inside=plan.inside | furniture)


def run_network(x: Array, network: Run) -> Array:
    """Compute (5, nx, ny) float32 probabilities from (11, nx, ny) evidence; both sides are multiples of 16."""
    (probability,) = network(evidence=x[None])
    return np.asarray(probability[0])


def load_weights(raised: bool = False) -> Network:
    """Load the network that ships, or the one in its place (`archive.find_weights_file`).

    Args:
        raised: that of robots' grids and drawings, whose walls were all raised alike.
    """
    return load_shipped_network(GRID_NETWORK_FILE if raised else PLAN_NETWORK_FILE, PLAN_SIGNATURE)


def read_weights(path: Path) -> Network:
    """Load the network of a file.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    return load_network(path, PLAN_SIGNATURE)
