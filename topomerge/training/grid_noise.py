"""Noise of robots' grids and drawings in crops of plans: walls that waver, furniture, gaps, for many crops at once.

What happens to a crop is drawn on the host. What happens to its columns is computed where the crops are; their random numbers
are hashes of a crop's seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from topomerge.training.hashed_random import draw_normal, draw_uniforms
from topomerge.types import Array

MOST_THINGS = 13  # of furniture in a crop
KNOWN_CHANNEL, WALL_CHANNEL, FULL_CHANNELS, GROUND_CHANNEL, TOP_CHANNEL = 0, 1, (2, 3, 4, 5, 8), 6, 9  # of `evidence`
WALL_TOP = -0.6  # of walls that are raised, in the last of these
MOVED_ROWS, MOVED_COLUMNS, WALL_GAPS, FLOOR_GAPS, SPECKS = range(1, 6)  # streams of random numbers of a crop


def add_grid_noise(x: Tensor, room: Tensor, rng: np.random.Generator) -> Tensor:
    """Return (n, side, side, 11) evidence of crops of grids, changed.

    Args:
        x: as of `plan_network.compute_evidence`.
        room: (n, side, side) bool, truly inside of a room: things stand there.
    """
    inside, wall, count = x[..., KNOWN_CHANNEL] > 0, x[..., WALL_CHANNEL] > 0, len(x)
    draws = rng.random((8, count))
    seed = torch.from_numpy(rng.integers(0, 1 << 62, count)).to(x.device)
    index = torch.arange(room[0].numel(), device=x.device).view(room.shape[1:])

    def choose(number: int, share: float) -> Tensor:
        return torch.from_numpy(np.flatnonzero(draws[number] < share)).to(x.device)

    def draw_fields(rows: Tensor, stream: int, low: float, high: float) -> Tensor:
        white = draw_normal(seed[rows][:, None, None], stream, index)
        return smooth_fields(white, _send(rng.uniform(low, high, count), x)[rows])

    def draw_patches(rows: Tensor, stream: int, low: float, high: float) -> Tensor:
        share = _send(rng.uniform(low, high, count), x)[rows]
        return cut_share(draw_fields(rows, stream, 1.0, 5.0), share)

    rows = choose(0, 0.35)  # walls move by a column or so, differently from place to place
    moved = []
    for stream in (MOVED_ROWS, MOVED_COLUMNS):
        length = _send(rng.uniform(0.2, 1.0, count), x)[rows, None, None]
        moved.append(length * draw_fields(rows, stream, 1.5, 6.0))
    inside[rows], wall[rows] = (warp(which[rows], moved[0], moved[1]) for which in (inside, wall))
    rows = choose(1, 0.5)
    wall[rows] &= dilate(inside[rows])  # the cells that a ray meets
    rows = choose(2, 0.5)
    inside[rows], wall[rows] = add_furniture(inside[rows], wall[rows], room[rows], _draw_boxes(rng, count, rows, x))
    rows = choose(3, 0.12)
    seats = draw_seat_rows(inside[rows] & room[rows], _draw_seats(rng, count, rows, x)) & erode(room[rows], 2)
    inside[rows], wall[rows] = inside[rows] & ~seats, wall[rows] | seats
    rows = choose(4, 0.5)
    wall[rows] &= ~draw_patches(rows, WALL_GAPS, 0.05, 0.5)
    rows = choose(5, 0.3)
    inside[rows] &= ~draw_patches(rows, FLOOR_GAPS, 0.01, 0.15)
    rows = choose(6, 0.25)
    inside[rows] &= erode(inside[rows] | wall[rows], 1)
    rows = choose(7, 0.3)
    share = _send(rng.uniform(0.0005, 0.006, count), x)[rows, None, None]
    wall[rows] |= inside[rows] & (draw_uniforms(seed[rows][:, None, None], SPECKS, index) < share)
    return _convert_to_evidence(x, inside & ~wall, wall)


def _send(numbers: Array, like: Tensor) -> Tensor:
    """Return float32 numbers where a tensor is."""
    return torch.from_numpy(np.asarray(numbers, np.float32)).to(like.device)


def _convert_to_evidence(x: Tensor, inside: Tensor, wall: Tensor) -> Tensor:
    out = x.clone()
    out[..., KNOWN_CHANNEL], out[..., WALL_CHANNEL], out[..., GROUND_CHANNEL] = inside.to(x), wall.to(x), (inside | wall).to(x)
    for channel in FULL_CHANNELS:
        out[..., channel] = wall.to(x)
    out[..., TOP_CHANNEL] = wall.to(x) * WALL_TOP
    return out


def dilate(mask: Tensor) -> Tensor:
    """Return (n, h, w) bool, the mask and its neighbours, diagonal ones too."""
    return functional.max_pool2d(mask[:, None].float(), 3, 1, 1)[:, 0] > 0


def erode(mask: Tensor, steps: int) -> Tensor:
    """Return (n, h, w) bool without what is within so many columns of anything else, the outside included."""
    other = functional.pad((~mask)[:, None].float(), (steps,) * 4, value=1.0)
    return functional.max_pool2d(other, 2 * steps + 1, 1)[:, 0] == 0


def smooth_fields(white: Tensor, sigma: Tensor) -> Tensor:
    """Return white noise (n, h, w) smoothed by Gaussians of (n,) standard deviations, columns, periodic; its own is 1."""
    if not len(white):  # of which some libraries make no transform
        return white
    first, last = (torch.fft.fftfreq(n, device=white.device) ** 2 for n in white.shape[1:])
    square = first[:, None] + last[None, : white.shape[2] // 2 + 1]
    transfer = (-2 * math.pi**2 * sigma[:, None, None] ** 2 * square).exp()
    field = torch.fft.irfft2(torch.fft.rfft2(white) * transfer, s=white.shape[1:])
    return field / field.std(dim=(1, 2), correction=0, keepdim=True)


def cut_share(fields: Tensor, share: Tensor) -> Tensor:
    """Return (n, h, w) bool, the highest of each field, which cover (n,) shares of it."""
    flat = fields.flatten(1)
    rank = ((1 - share) * (flat.shape[1] - 1)).long()
    return fields > flat.sort(dim=1).values.gather(1, rank[:, None])[:, :, None]


def warp(mask: Tensor, down: Tensor, across: Tensor) -> Tensor:
    """Return (n, h, w) masks of which each column is that so many columns away."""
    n, height, width = mask.shape
    i = (torch.arange(height, device=mask.device)[:, None] + down).round().long().clamp(0, height - 1)
    j = (torch.arange(width, device=mask.device) + across).round().long().clamp(0, width - 1)
    return mask.flatten(1).gather(1, (i * width + j).flatten(1)).view(n, height, width)


def pick_places(mask: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows and columns (n, k) of columns of masks (n, h, w), by uniform numbers (n, k); of an empty mask anything."""
    order = mask.flatten(1).cumsum(dim=1)
    total = order[:, -1:]
    chosen = torch.minimum((draws * total).long() + 1, total)
    flat = torch.searchsorted(order, chosen).clamp(max=order.shape[1] - 1)
    return flat // mask.shape[2], flat % mask.shape[2]


def _draw_boxes(rng: np.random.Generator, count: int, rows: Tensor, like: Tensor) -> Tensor:
    """Draw furniture: (rows, MOST_THINGS, 5) place of its middle among all, sizes, kind, and whether it is there."""
    shape = (count, MOST_THINGS)
    small = rng.random(shape) >= 0.6
    sizes = [np.where(small, rng.integers(1, 3, shape), rng.integers(1, 9, shape)) for _ in range(2)]
    used = np.arange(MOST_THINGS) < rng.integers(1, MOST_THINGS + 1, (count, 1))
    return _send(np.stack([rng.random(shape), *sizes, rng.integers(3, size=shape), used], axis=-1), like)[rows]


def add_furniture(inside: Tensor, wall: Tensor, room: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Add boxes on the floor: full (kind 0), hollow (1), or unseen altogether (2).

    Args:
        inside, wall, room: (n, h, w) bool; boxes: (n, k, 5) as drawn.
    """
    place, *sizes, kind, used = boxes.unbind(dim=2)
    free = erode(inside & room, 1)
    middles = pick_places(free, place)
    present = (used > 0) & free.flatten(1).any(dim=1, keepdim=True)
    within, core = [], []
    for middle, size, side in zip(middles, sizes, room.shape[1:], strict=True):
        at = torch.arange(side, device=room.device)
        low = (middle - size.long() // 2).clamp(min=0)[..., None]
        high = (middle + size.long() - size.long() // 2).clamp(max=side)[..., None]
        within.append((at >= low) & (at < high))
        core.append((at > low) & (at < high - 1))
    box = within[0][..., None] & within[1][:, :, None] & present[..., None, None]
    hollow = core[0][..., None] & core[1][:, :, None] & (kind == 1)[..., None, None]
    standing = (box & ~hollow & (kind < 2)[..., None, None]).any(dim=1)
    return inside & ~(box.any(dim=1) & room), wall | (standing & room)


def _draw_seats(rng: np.random.Generator, count: int, rows: Tensor, like: Tensor) -> Sequence[Tensor]:
    """Draw rows of seats: place of their middle, turn, length and depth of them all, gaps and depth of rows, and of seats."""
    turn = np.where(rng.random(count) < 0.5, rng.uniform(0, np.pi, count), 0.0)
    ends = [rng.integers(10, 45, count) / 2, rng.integers(12, 50, count) / 2]
    of_rows = [rng.uniform(6, 12, count), rng.uniform(1, 3, count)]
    of_seats = [rng.uniform(5, 9, count), rng.uniform(2, 5, count)]
    of_seats[1] = np.where(rng.random(count) < 0.6, of_seats[1], np.inf)  # else rows are whole
    return _send(np.stack([rng.random(count), turn, *ends, *of_rows, *of_seats]), like)[:, rows, None, None].unbind()


def draw_seat_rows(floor: Tensor, seats: Sequence[Tensor]) -> Tensor:
    """Draw (n, h, w) bool, parallel rows, whole or of single seats, somewhere on large floors (n, h, w).

    Args:
        seats: (n, 1, 1) each, as drawn.
    """
    place, turn, half_depth, half_length, gap, depth, pitch, width = seats
    large = erode(floor, 6)
    i0, j0 = pick_places(large, place[..., 0])
    i = torch.arange(floor.shape[1], device=floor.device)[:, None] - i0[..., None]
    j = torch.arange(floor.shape[2], device=floor.device) - j0[..., None]
    u, v = i * turn.cos() + j * turn.sin(), j * turn.cos() - i * turn.sin()
    rows = (u.abs() < half_depth) & (v.abs() < half_length) & (u.remainder(gap) < depth) & (v.remainder(pitch) < width)
    return rows & large.flatten(1).any(dim=1)[:, None, None]
