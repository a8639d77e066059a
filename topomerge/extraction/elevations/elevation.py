"""Walls unrolled: what stands along, across and above each stretch of a wall, as a room sees it (beyond the thesis).

A strip follows a straight face of a room, from 0.3 m before it to 0.5 m behind it, and goes on past its ends, so that doors in
corners are in it. It is made of the means of the points in small cells: a leaf that lies some centimetres deeper than its wall
shows, of which nothing is left in the cells of a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.cleaning import cell_middles
from topomerge.io.weight_files import read_layers, weights_file
from topomerge.kernels.strips import fill_strips
from topomerge.numpy_nn import convolution, linear, relu, softmax
from topomerge.structure.lines import Line
from topomerge.types import Array, VoxelGrid

ALONG, ACROSS, UPWARDS = 0.05, 0.025, 0.2  # m, of an element
BEFORE, BEHIND = 0.3, 0.5  # m on both sides of a face
LOWEST, HIGHEST = -0.1, 2.5  # m above the floor
PAST_ENDS = 1.2  # m by which a strip goes on past both ends of its face
DEPTHS, BANDS = round((BEFORE + BEHIND) / ACROSS), round((HIGHEST - LOWEST) / UPWARDS)
FREE_HEIGHTS = ((0.3, 0.6), (1.0, 1.3), (1.7, 2.0))  # m above the floor, at which rays are looked for
FREE_ALONG, FREE_ACROSS = 2, 4  # elements that share an answer: cells that rays crossed are longer
STRIP_CHANNELS = BANDS + 1 + len(FREE_HEIGHTS)  # and where one can walk, and where rays went
FULL = 0.75  # of the cells of a flat surface that make an element full
SIDE_REACH = (0.15, 0.6)  # m from a face: where its room's floor lies
# Of a place along a wall: a door that stands open, is shut, a window, a door that stands half open, a recess, and what stands
# before the wall; "wall" where there is none, too.
WALL_CLASSES = ("wall", "open", "shut", "window", "half", "niche", "cupboard")
TILE = 1.0  # m: squares in which faces are looked up
FACE_DTYPE = np.dtype(
    [
        ("room", "i4"),
        ("start", "f8", 2),  # where its strip begins, m, in the map's frame
        ("along", "f8", 2),  # unit
        ("out", "f8", 2),  # unit, away from the room
        ("length", "f8"),  # m, of the strip
        ("floor", "f8"),  # m
    ]
)


@dataclass(frozen=True, eq=False)
class Elevations:
    """The walls of a map, unrolled.

    Args:
        faces: (F,) FACE_DTYPE.
        first: (F + 1,) the first element of each strip in `strips`.
        strips: (n, 32, 17) float32 0..1 of each place along all strips: how full its elements are across the wall, from before it
            to behind it, in each band of heights; then where one can walk, and where rays went at three heights (0 everywhere
            where the sensor's places are unknown).
    """

    faces: Array
    first: Array
    strips: Array


def unroll(faces: Array, navigable: VoxelGrid, cells: VoxelGrid, crossed: VoxelGrid | None = None) -> Elevations:
    """Unroll faces (F,) FACE_DTYPE.

    Args:
        navigable: the navigable volume; of one with the property `standing`, the cells where a body fits.
        cells: with the means of their points (`cell_means`), in the map's frame; 5 cm or as fine as there are.
        crossed: cells that rays crossed and in which nothing stands; None: unknown.
    """
    sizes = 2 * np.ceil(faces["length"] / ALONG / 2).astype(np.int64)
    frames = np.column_stack([faces["start"] - BEFORE * faces["out"], faces["along"], faces["out"], faces["floor"] + LOWEST])
    step = np.array([ALONG, ACROSS, UPWARDS])
    solid = fill_strips(np.ascontiguousarray(cell_middles(cells)), frames, sizes, (DEPTHS, BANDS), step, TILE)
    floor = navigable.centroids()
    standing = navigable.properties.get("standing")
    floor = floor if standing is None else floor[standing.astype(bool)]
    frames[:, 6] -= BANDS * UPWARDS / 2 + LOWEST  # one band about the floor
    walk = fill_strips(floor, frames, sizes, (DEPTHS, 1), np.array([ALONG, ACROSS, BANDS * UPWARDS]), TILE)
    flat = ALONG * UPWARDS / cells.edge**2  # cells of a wall that an element holds
    rays = crossed_places(crossed, faces, sizes)
    strips = np.concatenate([solid / (FULL * flat), walk / (FULL * ALONG * ACROSS / navigable.edge**2), rays], axis=2)
    return Elevations(faces, np.concatenate([[0], np.cumsum(sizes)]), np.minimum(strips, 1.0))


def crossed_places(crossed: VoxelGrid | None, faces: Array, sizes: Array) -> Array:
    """(n, 32, 3) float32 share of the heights of each of `FREE_HEIGHTS` at which rays went through an element.

    Args:
        crossed: as of `wall_elevations`.
        faces: (F,) FACE_DTYPE; sizes: (F,) places of their strips, even.
    """
    out = np.zeros((int(sizes.sum()), DEPTHS, len(FREE_HEIGHTS)), np.float32)
    if crossed is None or not len(crossed) or not len(out):
        return out
    pairs = sizes // FREE_ALONG
    face = faces[np.repeat(np.arange(len(faces)), pairs)]
    place = (np.arange(len(face)) - np.repeat(np.cumsum(pairs) - pairs, pairs) + 0.5) * (FREE_ALONG * ALONG)
    depth = (np.arange(DEPTHS // FREE_ACROSS) + 0.5) * (FREE_ACROSS * ACROSS) - BEFORE
    level = (face["start"] + place[:, None] * face["along"])[:, None] + depth[:, None] * face["out"][:, None]
    for k, heights in enumerate(FREE_HEIGHTS):
        went = np.zeros(level.shape[:2], np.float32)
        for z in heights:
            at = np.concatenate([level, np.broadcast_to((face["floor"] + z)[:, None, None], (*level.shape[:2], 1))], axis=2)
            went += crossed.contains(crossed.locate(at.reshape(-1, 3))).reshape(went.shape) / np.float32(len(heights))
        out[..., k] = went.repeat(FREE_ALONG, axis=0).repeat(FREE_ACROSS, axis=1)
    return out


def face_rows(room: int, lines: Sequence[Line], floor: Array, level: float) -> list[tuple[object, ...]]:
    """Rows of FACE_DTYPE along lines; those with no floor (n, 2) m of the room beside them are left out."""
    rows: list[tuple[object, ...]] = []
    for line in lines:
        at = floor - line.middle
        t, off = at @ line.along, at @ line.across
        beside = (t > line.start) & (t < line.end) & (np.abs(off) > SIDE_REACH[0]) & (np.abs(off) < SIDE_REACH[1])
        left = int((off[beside] > 0).sum())
        if not beside.any():
            continue
        out = -line.across if 2 * left > beside.sum() else line.across
        start = line.middle + (line.start - PAST_ENDS) * line.along
        rows.append((room, start, line.along, out, line.length + 2 * PAST_ENDS, level))
    return rows


# What is in each place along a wall: a small convolutional network over its elevation, trained on simulated scans of training
# buildings (`train.py task=wall_segmentation`), in NumPy (`numpy_nn`; beyond the thesis: docs/adr/0018).
#
# Two convolutions look at a strip along the wall and across it, the heights as channels; a layer then weighs all depths at once,
# and three convolutions along the wall see 1.4 m to both sides, so that a leaf is told from a niche by its width and its frame.

WALL_NETWORK_FILE = "wall_network.npz"
PLACES = 2  # elements along a strip that have one answer
TAPS, DILATIONS = 5, (1, 2, 4)  # of the convolutions along the wall
ALONG_LAYERS = ("along1", "along2", "along3")


def place_probabilities(strip: Array, network: dict[str, Array] | None = None) -> Array:
    """(n / 2, 7) float32 probability of each of `WALL_CLASSES` along a strip (n, 32, 17), or of several of one length at once
    (k, n, 32, 17); by the weights that ship or others."""
    w = weights() if network is None else network
    x = convolution(np.moveaxis(strip, -1, -3).astype(np.float32), w["a.w"], w["a.b"], PLACES)
    x = np.moveaxis(convolution(x, w["b.w"], w["b.b"]), -3, -1)
    x = relu(linear(x.reshape(*x.shape[:-2], -1), w["depths.w"], w["depths.b"]))
    for name, dilation in zip(ALONG_LAYERS, DILATIONS, strict=True):
        x = relu(linear(neighbours(x, dilation), w[f"{name}.w"], w[f"{name}.b"]))
    return softmax(linear(x, w["out.w"], w["out.b"]))


def neighbours(x: Array, dilation: int) -> Array:
    """(..., n, 5 c) of each row (..., n, c) those around it, `dilation` apart; zeros past the ends."""
    reach, count = TAPS // 2 * dilation, x.shape[-2]
    padded = np.pad(x, [(0, 0)] * (x.ndim - 2) + [(reach, reach), (0, 0)])
    return np.concatenate([padded[..., k * dilation : k * dilation + count, :] for k in range(TAPS)], axis=-1)


def weights() -> dict[str, Array]:
    """The weights that ship, or those in their place (`io.weight_files`)."""
    return read_network(weights_file("topomerge.extraction.elevations", WALL_NETWORK_FILE))


@lru_cache(maxsize=4)
def read_network(path: Path) -> dict[str, Array]:
    """Weights as float32 by their names.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    taps = {"a": 9, "b": 9, "depths": DEPTHS // PLACES, "out": 1} | dict.fromkeys(ALONG_LAYERS, TAPS)
    layers = read_layers(path, "walls", taps)
    if layers["a.w"].shape[0] != 9 * STRIP_CHANNELS or layers["out.w"].shape[1] != len(WALL_CLASSES):
        raise InputError(f"{path}: was trained with other inputs or outputs; install topomerge again")
    return layers
