"""Walls unrolled: what stands along, across and above each stretch of a wall, as a room sees it (beyond the thesis).

A strip follows a straight face of a room, from 0.3 m before it to 0.5 m behind it, and goes on past its ends, so that doors in
corners are in it. It is made of the means of the points in small cells: a leaf that lies some centimetres deeper than its wall
shows, of which nothing is left in the cells of a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.extraction.cleaning import compute_cell_means
from topomerge.kernels.images import fill_strips
from topomerge.networks.network import Network, Run, Signature, Tensor, load_network, load_shipped_network
from topomerge.structure.lines import Line
from topomerge.types import Array, VoxelGrid

# Finer across than along: a shut leaf may lie only 3 cm deeper than its wall (docs/adr/0018).
ALONG, ACROSS, UPWARDS = 0.05, 0.025, 0.2  # m, of an element
# Both sides in one strip: furniture hides half of a wall from one side (docs/adr/0018).
BEFORE, BEHIND = 0.3, 0.5  # m on both sides of a face
LOWEST, HIGHEST = -0.1, 2.5  # m above the floor
# So that doors in corners are in the strip (docs/adr/0018).
PAST_ENDS = 1.2  # m by which a strip goes on past both ends of its face
DEPTHS, BANDS = round((BEFORE + BEHIND) / ACROSS), round((HIGHEST - LOWEST) / UPWARDS)
# Behind a shut leaf no ray went (docs/adr/0018).
FREE_HEIGHTS = ((0.3, 0.6), (1.0, 1.3), (1.7, 2.0))  # m above the floor, at which rays are looked for
FREE_ALONG, FREE_ACROSS = 2, 4  # elements that share an answer: cells that rays crossed are longer
STRIP_CHANNELS = BANDS + 1 + len(FREE_HEIGHTS)  # and where one can walk, and where rays went
FULL = 0.75  # of the cells of a flat surface that make an element full
SIDE_REACH = (0.15, 0.6)  # m from a face: where its room's floor lies
# Of a place along a wall: a door that stands open, is shut, a window, a door that stands half open, a recess, and what stands
# before the wall; "wall" where there is none, too.
# Niches and cupboards are classes only to keep them from doors; they count as wall (docs/adr/0018).
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
        cells: with the means of their points (`compute_cell_means`), in the map's frame; 5 cm or as fine as there are.
        crossed: cells that rays crossed and in which nothing stands; None: unknown.
    """
    sizes = 2 * np.ceil(faces["length"] / ALONG / 2).astype(np.int64)
    frames = np.column_stack([faces["start"] - BEFORE * faces["out"], faces["along"], faces["out"], faces["floor"] + LOWEST])
    step = np.array([ALONG, ACROSS, UPWARDS])
    solid = fill_strips(np.ascontiguousarray(compute_cell_means(cells)), frames, sizes, (DEPTHS, BANDS), step, TILE)
    floor = navigable.compute_centroids()
    standing = navigable.properties.get("standing")
    floor = floor if standing is None else floor[standing.astype(bool)]
    frames[:, 6] -= BANDS * UPWARDS / 2 + LOWEST  # one band about the floor
    walk = fill_strips(floor, frames, sizes, (DEPTHS, 1), np.array([ALONG, ACROSS, BANDS * UPWARDS]), TILE)
    flat = ALONG * UPWARDS / cells.edge**2  # cells of a wall that an element holds
    strips = np.empty((len(solid), DEPTHS, STRIP_CHANNELS), np.float32)
    np.divide(solid, FULL * flat, out=strips[..., :BANDS])
    np.divide(walk, FULL * ALONG * ACROSS / navigable.edge**2, out=strips[..., BANDS : BANDS + 1])
    strips[..., BANDS + 1 :] = measure_crossed_places(crossed, faces, sizes)
    return Elevations(faces, np.concatenate([[0], np.cumsum(sizes)]), np.minimum(strips, 1.0, out=strips))


def measure_crossed_places(crossed: VoxelGrid | None, faces: Array, sizes: Array) -> Array:
    """Return (n, 32, 3) float32 share of the heights of each of `FREE_HEIGHTS` at which rays went through an element.

    Args:
        crossed: as of `unroll`.
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


def build_face_rows(room: int, lines: Sequence[Line], floor: Array, level: float) -> list[tuple[object, ...]]:
    """Return rows of FACE_DTYPE along lines; those with no floor (n, 2) m of the room beside them are left out."""
    rows: list[tuple[object, ...]] = []
    for line in lines:
        at = floor - line.middle
        t, off = at @ line.along, at @ line.across
        near = (t > line.start) & (t < line.end) & (np.abs(off) > SIDE_REACH[0]) & (np.abs(off) < SIDE_REACH[1])
        left = int((off[near] > 0).sum())
        if not near.any():
            continue
        out = -line.across if 2 * left > near.sum() else line.across
        start = line.middle + (line.start - PAST_ENDS) * line.along
        rows.append((room, start, line.along, out, line.length + 2 * PAST_ENDS, level))
    return rows


# What is in each place along a wall: a small convolutional network over its elevation, trained on simulated scans of training
# buildings (`train.py task=wall_segmentation`; beyond the thesis: docs/adr/0018).
#
# Two convolutions look at a strip along the wall and across it, the heights as channels; a layer then weighs all depths at once,
# and three convolutions along the wall see 1.4 m to both sides, so that a leaf is told from a niche by its width and its frame.

WALL_NETWORK_FILE = "wall_network.onnx"
PLACES = 2  # elements along a strip that have one answer
TAPS, DILATIONS = 5, (1, 2, 4)  # of the convolutions along the wall
WALL_SIGNATURE = Signature(
    "Says what is in each place along a wall.",
    {"strips": Tensor(("strips", "length", DEPTHS, STRIP_CHANNELS), "0 to 1, along walls (even)")},
    {"probability": Tensor(("strips", "places", len(WALL_CLASSES)), f"of {', '.join(WALL_CLASSES)}, of each two elements")},
)


def compute_place_probabilities(strip: Array, network: Run | None = None) -> Array:
    """Compute (n / 2, 7) float32 probability of each of `WALL_CLASSES` along a strip (n, 32, 17), or of several of one length at
    once (k, n, 32, 17); by the network that ships or another."""
    run = weights() if network is None else network
    several = strip if strip.ndim == 4 else strip[None]
    if not several.shape[0] or not several.shape[1]:
        return np.zeros((*strip.shape[:-3], strip.shape[-3] // PLACES, len(WALL_CLASSES)), np.float32)
    (probability,) = run(strips=several)
    return np.asarray(probability if strip.ndim == 4 else probability[0])


def weights() -> Network:
    """Load the network that ships, or the one in its place (`archive.find_weights_file`)."""
    return load_shipped_network(WALL_NETWORK_FILE, WALL_SIGNATURE)


def read_network(path: Path) -> Network:
    """Load the network of a file.

    Raises:
        InputError: not the network that this version knows, or damaged.
    """
    return load_network(path, WALL_SIGNATURE)
