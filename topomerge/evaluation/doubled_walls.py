"""Walls that a joined map has twice: where two maps drift apart, each brings its own copy of a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from topomerge.matching.room_plans import DIRECTION_BLUR, room_plans
from topomerge.types import Array, TopometricMap

WITHIN = (0.1, 0.6)  # m: what is free between a wall and its copy, at least, and from middle to middle, at most
PARALLEL = np.radians(25.0)  # two walls that differ by less
ACROSS = np.radians(55.0)  # between the wall and the way to its copy, at least: the other end of a doorway is no copy


def doubled_columns(first: Array, second: Array, seen: Array, edge: float) -> Array:
    """(nx, ny) bool columns of the walls of a map that another map shows a second time: a parallel wall of the other one stands
    within `WITHIN` where this map has none, the other one has none here, and what lies between the two was looked into. (Where
    it was not, the two are the faces of one thick wall, seen from its two sides.)

    Args:
        first, second: (nx, ny) bool walls of the two maps, on one raster.
        seen: (nx, ny) bool columns of which the floor, or free space, was seen.
        edge: m, of a column.
    """
    out = np.zeros(first.shape, bool)
    if not first.any() or not second.any():
        return out
    distance, nearest = ndimage.distance_transform_edt(~second, return_indices=True)
    distance *= edge
    near = first & (distance >= WITHIN[0] + 0.99 * edge) & (distance <= WITHIN[1] + 0.01 * edge)
    here = np.argwhere(near)
    there = nearest[:, near].T
    alone = ~ndimage.binary_dilation(first, np.ones((3, 3)))[tuple(there.T)]
    normals = [_normals(walls) for walls in (first, second)]
    apart = there - here
    n, m = normals[0][tuple(here.T)], normals[1][tuple(there.T)]
    parallel = np.abs(np.angle(np.exp(2j * (n - m)))) <= 2 * PARALLEL
    across = np.abs(np.angle(np.exp(2j * (n - np.arctan2(apart[:, 1], apart[:, 0]))))) <= 2 * (np.pi / 2 - ACROSS)
    between = np.zeros(len(here), bool)
    for share in (0.35, 0.5, 0.65):
        at = tuple(np.rint(here + share * apart).astype(int).T)
        between |= seen[at] & ~first[at] & ~second[at]
    out[tuple(here[alone & parallel & across & between].T)] = True
    return out


def _normals(walls: Array) -> Array:
    """(nx, ny) rad, across the wall, modulo pi."""
    image = ndimage.gaussian_filter(walls.astype(np.float32), DIRECTION_BLUR)
    slope = ndimage.sobel(image, 0) + 1j * ndimage.sobel(image, 1)
    square = slope**2
    mean = ndimage.gaussian_filter(square.real, DIRECTION_BLUR) + 1j * ndimage.gaussian_filter(square.imag, DIRECTION_BLUR)
    return np.asarray(np.angle(mean) / 2)


def doubled_walls(joined: TopometricMap) -> float:
    """Share of a joined map's wall columns that stand there twice (`doubled_columns`); nan without walls.

    Args:
        joined: with the provenance of its cells.
    """
    if joined.provenance is None:
        return float("nan")
    whole = room_plans(joined)
    seen = np.stack([plan.occupied(-0.3, 0.25) for plan in whole.plans]) if whole.plans else np.zeros((0, 0, 0), bool)
    bits = int(np.bitwise_or.reduce(joined.provenance, initial=0)).bit_length()
    walls = [_walls_of(joined, bit) for bit in range(bits)]
    doubled = np.zeros(whole.walls.shape, bool)
    for i, mine in enumerate(walls):
        for j, other in enumerate(walls):
            for s in range(len(doubled)) if i != j else ():
                doubled[s] |= doubled_columns(mine[s], other[s], seen[s], whole.edge)
    every = whole.walls | np.logical_or.reduce(walls)
    return float((doubled & every).sum() / every.sum()) if every.any() else float("nan")


def _walls_of(joined: TopometricMap, bit: int) -> Array:
    """(S, nx, ny) bool walls of what one map saw."""
    assert joined.provenance is not None
    chosen = (joined.provenance >> np.uint32(bit) & np.uint32(1)) > 0
    grid, room = joined.grid.subset(chosen), joined.room[chosen]
    return room_plans(replace(joined, grid=grid, room=room, provenance=None, free=None)).walls
