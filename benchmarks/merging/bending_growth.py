"""Storeys of any number of rooms, bent as a walk bends them: how long bending takes, beside the rigid registration."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np

from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import sensor_drift
from topomerge.registration.pipeline import register
from topomerge.registration.prepared import prepare
from topomerge.types import Array, Sim3, VoxelGrid

EDGE = 0.1  # m
DEPTH, WALL, DOOR = 5.0, 2.5, 0.9  # m: depth of a room, height of walls, width of doors
WIDTHS = (2.6, 6.0)  # m, of rooms
BEND_LENGTH, BEND_SIZE = 25.0, 0.15  # m: of the waves that bend the second map
REGISTERED = 300  # rooms up to which the rigid registration is timed, too
CORRIDOR = 2.0  # m


def storey(rooms: int, seed: int = 0) -> tuple[Array, Array]:
    """Points (n, 3) of the walls and of the floor of a storey: rows of rooms of random widths, each with a door to a corridor."""
    rng = np.random.default_rng(seed)
    long = max(round(np.sqrt(rooms * 1.5)), 2)
    walls: list[Array] = []
    width = 0.0
    for row, first in enumerate(range(0, rooms, long)):
        count = min(long, rooms - first)
        y = row // 2 * (2 * DEPTH + CORRIDOR) + (DEPTH + CORRIDOR) * (row % 2)
        ends = np.concatenate([[0.0], np.cumsum(rng.uniform(*WIDTHS, count))])
        width = max(width, float(ends[-1]))
        walls += [_line((x, y), (x, y + DEPTH)) for x in ends]
        inner, outer = (y + DEPTH, y) if row % 2 == 0 else (y, y + DEPTH)
        walls.append(_line((0.0, outer), (ends[-1], outer)))
        for left, right in pairwise(ends.tolist()):
            at = left + rng.uniform(0.3, right - left - DOOR - 0.3)
            walls += [_line((left, inner), (at, inner)), _line((at + DOOR, inner), (right, inner))]
    flat = np.concatenate(walls)
    high = float(flat[:, 1].max())
    floor = np.stack(np.meshgrid(np.arange(0, width, EDGE), np.arange(0, high, EDGE), indexing="ij"), axis=-1).reshape(-1, 2)
    levels = np.arange(EDGE / 2, WALL, EDGE)
    up = np.column_stack([np.repeat(flat, len(levels), axis=0), np.tile(levels, len(flat))])
    return up, np.column_stack([floor, np.full(len(floor), -EDGE / 2)])


def _line(start: tuple[float, float], end: tuple[float, float]) -> Array:
    """Points (n, 2) on a wall, two a cell."""
    count = max(int(np.hypot(end[0] - start[0], end[1] - start[1]) / EDGE * 2), 2)
    return np.linspace(start, end, count)


def waved(points: Array) -> Array:
    """The points moved by waves that are long and low: drift without a jump."""
    out = points.copy()
    for k, turn in enumerate((1.0, 0.6)):
        phase = points[:, :2] @ (np.cos(turn + k), np.sin(turn + k)) * 2 * np.pi / (BEND_LENGTH * (1 + k))
        out[:, k] += BEND_SIZE * np.sin(phase)
    return out


def cells_of(points: Array) -> VoxelGrid:
    """Occupied cells of points."""
    low = points.min(axis=0) - EDGE
    return VoxelGrid.from_cells(np.unique(np.floor((points - low) / EDGE).astype(np.int32), axis=0), low, EDGE)


def timed(rooms: int) -> dict[str, Any]:
    """Seconds of processor of preparing, registering and bending a pair of storeys."""
    points = np.concatenate(storey(rooms))
    pose = Sim3(0.4, (3.0, -2.0, 0.1))
    grids = cells_of(points), cells_of(pose.inverse().apply(waved(points)))
    clock = [time.process_time()]
    a, b = (prepare(g) for g in grids)
    clock.append(time.process_time())
    if rooms <= REGISTERED:
        register(a, b)
    clock.append(time.process_time())
    usual = sensor_drift("depth")
    bent = bend(a, b, pose, drift=(usual, usual))
    clock.append(time.process_time())
    seconds = dict(zip(("prepare", "register", "bend"), np.diff(clock).tolist(), strict=True))
    pieces = [len(d) for d in bent.deformations]
    about = {"name": f"{rooms} rooms", "rooms": rooms, "cells": len(grids[0])}
    return {**about, "pieces": pieces, "seconds": seconds, "reason": bent.reason}
