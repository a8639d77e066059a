"""Walls unrolled: what stands along, across and above each stretch of a wall, as a room sees it (beyond the thesis).

A strip follows a straight face of a room, from 0.3 m before it to 0.5 m behind it, and goes on past its ends, so that doors in
corners are in it. It is made of the means of the points in small cells: a leaf that lies some centimetres deeper than its wall
shows, of which nothing is left in the cells of a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.extraction.cell_means import cell_middles
from topomerge.kernels.strips import fill_strips
from topomerge.structure.face_points import face_points, wall_columns
from topomerge.structure.floors import room_levels
from topomerge.structure.lines import Line, main_direction, straight_lines
from topomerge.types import Array, TopometricMap, VoxelGrid

ALONG, ACROSS, UPWARDS = 0.05, 0.025, 0.2  # m, of an element
BEFORE, BEHIND = 0.3, 0.5  # m on both sides of a face
LOWEST, HIGHEST = -0.1, 2.5  # m above the floor
PAST_ENDS = 1.2  # m by which a strip goes on past both ends of its face
DEPTHS, BANDS = round((BEFORE + BEHIND) / ACROSS), round((HIGHEST - LOWEST) / UPWARDS)
STRIP_CHANNELS = BANDS + 1  # and where one can walk
FULL = 0.75  # of the cells of a flat surface that make an element full
SIDE_REACH = (0.15, 0.6)  # m from a face: where its room's floor lies
WALL_CLASSES = ("wall", "open", "shut", "window")  # of a place along a wall; where there is no wall, too
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
        strips: (n, 32, 14) float32 0..1 of each place along all strips: how full its elements are across the wall, from before it
            to behind it, in each band of heights; the last channel is where one can walk.
    """

    faces: Array
    first: Array
    strips: Array


def wall_elevations(map: TopometricMap, cells: VoxelGrid) -> Elevations:
    """The faces of all rooms, unrolled.

    Args:
        cells: with the means of their points (`cell_means`), in the map's frame; 5 cm or as fine as there are.
    """
    faces = wall_faces(map)
    sizes = 2 * np.ceil(faces["length"] / ALONG / 2).astype(np.int64)
    frames = np.column_stack([faces["start"] - BEFORE * faces["out"], faces["along"], faces["out"], faces["floor"] + LOWEST])
    step = np.array([ALONG, ACROSS, UPWARDS])
    solid = fill_strips(np.ascontiguousarray(cell_middles(cells)), frames, sizes, (DEPTHS, BANDS), step, TILE)
    floor = map.navigable.centroids()
    standing = map.navigable.properties.get("standing")
    floor = floor if standing is None else floor[standing.astype(bool)]
    frames[:, 6] -= BANDS * UPWARDS / 2 + LOWEST  # one band about the floor
    walk = fill_strips(floor, frames, sizes, (DEPTHS, 1), np.array([ALONG, ACROSS, BANDS * UPWARDS]), TILE)
    flat = ALONG * UPWARDS / cells.edge**2  # cells of a wall that an element holds
    edge = map.navigable.edge
    strips = np.concatenate([solid / (FULL * flat), walk / (FULL * ALONG * ACROSS / edge**2)], axis=2)
    return Elevations(faces, np.concatenate([[0], np.cumsum(sizes)]), np.minimum(strips, 1.0))


def wall_faces(map: TopometricMap) -> Array:
    """(F,) FACE_DTYPE: the straight lines along which the walls that a room sees stand, each with its room on one side."""
    levels = room_levels(map)[0][:, 0]
    rows = []
    for storey in range(len(map.storeys)):
        rooms = np.flatnonzero(map.rooms["storey"] == storey).tolist()
        points = face_points(map, storey)
        columns = [wall_columns(points, r) for r in rooms]
        main = main_direction([line for column in columns for line in straight_lines(*column)])
        for r, column in zip(rooms, columns, strict=True):
            floor = map.navigable.centroids(map.navigable.cells[map.navigable_room == r])[:, :2]
            rows += _room_faces(r, straight_lines(*column, main), floor, float(levels[r]))
    return np.array(rows, FACE_DTYPE)


def _room_faces(room: int, lines: Sequence[Line], floor: Array, level: float) -> list[tuple[object, ...]]:
    """Rows of FACE_DTYPE; lines with no floor of the room beside them are left out."""
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
