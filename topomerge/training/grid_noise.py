"""Noise of robots' grids: walls that are bent, thin or in part unseen, things and rows of seats on the floor (docs/adr/0005)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from topomerge.types import Array

SQUARE = np.ones((3, 3))
MOST_THINGS = 14
KNOWN_CHANNEL, WALL_CHANNEL, FULL_CHANNELS, GROUND_CHANNEL, TOP_CHANNEL = 0, 1, (2, 3, 4, 5, 8), 6, 9  # of `evidence`
WALL_TOP = -0.6  # of walls that are raised, in the last of these


def with_grid_noise(x: Array, room: Array, rng: np.random.Generator) -> Array:
    """(n, n, 11) evidence of a crop of a grid, changed.

    Args:
        x: as of `plan_network.evidence`; room: (n, n) bool, truly inside of a room: things stand there.
    """
    inside, wall = x[..., KNOWN_CHANNEL] > 0, x[..., WALL_CHANNEL] > 0
    if rng.random() < 0.35:
        inside, wall = _bent(inside, wall, rng)
    if rng.random() < 0.5:
        wall = wall & ndimage.binary_dilation(inside, SQUARE)  # the cells that a ray meets
    if rng.random() < 0.5:
        inside, wall = _with_things(inside, wall, room, rng)
    if rng.random() < 0.12:
        rows = _rows_of_seats(inside & room, rng) & ndimage.binary_erosion(room, SQUARE, 2)
        inside, wall = inside & ~rows, wall | rows
    if rng.random() < 0.5:
        wall = wall & ~_patches(wall.shape, rng.uniform(0.05, 0.5), rng)
    if rng.random() < 0.3:
        inside = inside & ~_patches(wall.shape, rng.uniform(0.01, 0.15), rng)
    if rng.random() < 0.25:
        inside = inside & ndimage.binary_erosion(inside | wall, SQUARE)
    if rng.random() < 0.3:
        wall = wall | (inside & (rng.random(wall.shape) < rng.uniform(0.0005, 0.006)))
    return _as_evidence(x, inside & ~wall, wall)


def _as_evidence(x: Array, inside: Array, wall: Array) -> Array:
    out = x.copy()
    out[..., KNOWN_CHANNEL], out[..., WALL_CHANNEL], out[..., GROUND_CHANNEL] = inside, wall, inside | wall
    out[..., list(FULL_CHANNELS)] = wall[..., None]
    out[..., TOP_CHANNEL] = np.where(wall, WALL_TOP, 0.0)
    return out


def _smooth(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Array:
    field = ndimage.gaussian_filter(rng.standard_normal(shape), sigma, mode="wrap")
    return np.asarray(field / field.std())


def _patches(shape: tuple[int, ...], share: float, rng: np.random.Generator) -> Array:
    """(n, n) bool, smooth patches that cover a share of a crop."""
    field = _smooth(shape, rng.uniform(1, 5), rng)
    return np.asarray(field > np.quantile(field, 1 - share))


def _bent(inside: Array, wall: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Moved by a column or so, differently from place to place."""
    at = np.indices(inside.shape)
    moved = [a + _smooth(inside.shape, rng.uniform(1.5, 6), rng) * rng.uniform(0.2, 1.0) for a in at]
    i, j = (np.clip(np.rint(m), 0, n - 1).astype(int) for m, n in zip(moved, inside.shape, strict=True))
    return inside[i, j], wall[i, j]


def _with_things(inside: Array, wall: Array, room: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Boxes on the floor, full, hollow, or unseen altogether."""
    inside, wall = inside.copy(), wall.copy()
    places = np.argwhere(ndimage.binary_erosion(inside & room, SQUARE))
    for _ in range(int(rng.integers(1, MOST_THINGS)) if len(places) else 0):
        middle = places[rng.integers(len(places))]
        size = rng.integers(1, 9, 2) if rng.random() < 0.6 else rng.integers(1, 3, 2)
        box = tuple(slice(max(int(m - s // 2), 0), int(m + s - s // 2)) for m, s in zip(middle, size, strict=True))
        there, rim = room[box], np.ones(room[box].shape, bool)
        kind = int(rng.integers(3))
        rim[1:-1, 1:-1] = kind == 0
        inside[box] &= ~there
        if kind < 2:
            wall[box] |= there & rim
    return inside, wall


def _rows_of_seats(floor: Array, rng: np.random.Generator) -> Array:
    """(n, n) bool, parallel rows, whole or of single seats, somewhere on a large floor."""
    places = np.argwhere(ndimage.binary_erosion(floor, SQUARE, 6))
    if not len(places):
        return np.zeros(floor.shape, bool)
    i, j = np.indices(floor.shape) - places[rng.integers(len(places))][:, None, None]
    turn = rng.uniform(0, np.pi) if rng.random() < 0.5 else 0.0
    u, v = i * np.cos(turn) + j * np.sin(turn), j * np.cos(turn) - i * np.sin(turn)
    rows = (np.abs(u) < rng.integers(10, 45) / 2) & (np.abs(v) < rng.integers(12, 50) / 2)
    rows &= u % rng.uniform(6, 12) < rng.uniform(1, 3)
    if rng.random() < 0.6:
        rows &= v % rng.uniform(5, 9) < rng.uniform(2, 5)
    return np.asarray(rows)
