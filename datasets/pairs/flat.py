"""Floors seen from above: robot grids, laser logs and drawings, and the clouds that stand for them in a pair.

Walls are raised and floors laid as `topomerge.io.grid` does it. What a laser crossed is known to be free at the laser's height
only; drawings know no free space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import Pair, draw_frames, seen_by_both
from topomerge.datasets.plans.sealed import refuse_file
from topomerge.datasets.simulation.floors import fill

from topomerge.errors import InputError
from topomerge.io import grid
from topomerge.types import Array, PointCloud, Sim3, TrueRoom, VoxelGrid

WALL_HEIGHT = 2.5  # m of the walls
LASER = 0.3  # m above the floor
FREE_CELL = 0.1  # m of a free cell
FLOOR_NEAR_WALL = 0.5  # m from a wall to the nearest free floor
ROOM_CELL, ROOM_REACH = 0.1, 0.3  # m; a wall belongs to the room that is as near as that


@dataclass(frozen=True, eq=False)
class Flat:
    """One floor of one map, in metres, in its owner's frame.

    Args:
        walls: (n, 2) float64, the surfaces of what stands in the way.
        free: (m, 2) float64, the floor, on a lattice of `cell`.
        cell: m.
        rays: does `free` come from a sensor's rays?
        poses: (K, 3) x, y and heading (rad) of the sensor, or None.
        rooms: true rooms in the same frame.
    """

    walls: Array
    free: Array
    cell: float
    rays: bool = True
    poses: Array | None = None
    rooms: tuple[TrueRoom, ...] = ()
    source: str = ""

    def moved(self, frame: Sim3) -> Flat:
        """The same floor in another frame."""
        poses = self.poses
        if poses is not None:
            poses = np.column_stack([_flat(frame, poses[:, :2]), poses[:, 2] + frame.yaw])
        rooms = tuple(moved_room(r, frame) for r in self.rooms)
        walls, free = _flat(frame, self.walls), _flat(frame, self.free)
        return replace(self, walls=walls, free=free, cell=self.cell * frame.scale, poses=poses, rooms=rooms)


def _flat(frame: Sim3, points: Array) -> Array:
    """(n, 2) points in another frame."""
    c, s = frame.scale * np.cos(frame.yaw), frame.scale * np.sin(frame.yaw)
    x, y = points.T
    return np.column_stack([c * x - s * y + frame.translation[0], s * x + c * y + frame.translation[1]])


def moved_room(room: TrueRoom, frame: Sim3) -> TrueRoom:
    """A room with its outline in another frame."""
    return replace(room, polygon=_flat(frame, room.polygon))


def read_flat(path: Path, resolution: float | None = None, rays: bool = True) -> Flat:
    """A robot grid: a map_server yaml, or an image whose pixels are so many metres wide.

    Raises:
        InputError: missing or damaged file, or a sealed one.
    """
    refuse_file(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the folder")
    plan = grid.read_yaml(path) if resolution is None else grid.Plan(path, resolution)
    occupied, free, _ = grid.read_pixels(path, plan)
    return from_masks(occupied, free, plan.resolution, plan.origin, rays, source=path.name)


def from_masks(
    occupied: Array, free: Array, cell: float, origin: Sequence[float] = (0.0, 0.0, 0.0), rays: bool = True, source: str = ""
) -> Flat:
    """A floor from images (h, w) bool of what stands and what is free, highest row first.

    Args:
        origin: x, y (m) and yaw (rad) of the lower left corner.
    """
    # A ray that met a wall went through free space first: letters and frames drawn beside the map are no walls.
    surface = occupied & ndimage.binary_dilation(~occupied, np.ones((3, 3)))
    surface &= ndimage.distance_transform_edt(~free) * cell < FLOOR_NEAR_WALL
    frame = Sim3(float(origin[2]), (float(origin[0]), float(origin[1]), 0.0))
    at = [np.argwhere(mask)[:, ::-1] for mask in (surface, free)]
    walls, floor = (_flat(frame, (np.column_stack([x, len(free) - 1 - y]) + 0.5) * cell) for x, y in (a.T for a in at))
    return Flat(walls, floor, cell, rays, source=source)


def raise_flat(flat: Flat, z: float = 0.0) -> PointCloud:
    """The cloud of a floor at height `z`, m: floor, walls of `WALL_HEIGHT` and, where the sensor's rays went, free cells."""
    spacing = max(flat.cell, 0.05)
    levels = np.linspace(0.0, WALL_HEIGHT, round(WALL_HEIGHT / spacing) + 1)
    free, walls = (thin(p, spacing) if flat.cell < 0.9 * spacing else p for p in (flat.free, flat.walls))
    points = np.concatenate([_at(free, [0.0]), _at(walls, levels)]) + [0.0, 0.0, z]
    poses = None
    if flat.poses is not None:
        poses = np.array([Sim3(yaw, (x, y, z + LASER)).matrix for x, y, yaw in flat.poses.tolist()])
    rooms = tuple(replace(r, floor=r.floor + z, ceiling=r.ceiling + z) for r in flat.rooms)
    labels = rooms_at(points[:, :2], rooms) if rooms else None
    free_cells = _free(flat, z) if flat.rays else None
    return PointCloud(points.astype(np.float32), labels=labels, poses=poses, free=free_cells, rooms=rooms, source=flat.source)


def keys(*sets: Array) -> tuple[Array, ...]:
    """One int64 for each row of integers (n, k), the same for the same row in all sets: much faster to compare than rows."""
    low = np.min([s.min(axis=0) for s in sets if len(s)], axis=0)
    size = np.max([s.max(axis=0) for s in sets if len(s)], axis=0) - low + 1
    return tuple(np.ravel_multi_index(tuple((s - low).T), tuple(size.tolist())) for s in sets)


def squares(points: Array, cell: float | Array) -> Array:
    """(n, k) int64 cells of points."""
    return np.floor(points / cell).astype(np.int64)


def thin(points: Array, cell: float) -> Array:
    """The first point of each square or cube of a raster."""
    if not len(points):
        return points
    return points[np.sort(np.unique(keys(squares(points, cell))[0], return_index=True)[1])]


def _at(points: Array, levels: Sequence[float] | Array) -> Array:
    """(n * k, 3) points at each of k heights."""
    return np.column_stack([np.tile(points, (len(levels), 1)), np.repeat(levels, len(points))])


def _free(flat: Flat, z: float) -> VoxelGrid:
    """Cells at the laser's height that hold free floor and no wall."""
    corner = np.concatenate([flat.free, flat.walls]).min(axis=0) - 1.5 * FREE_CELL  # a lattice of this step falls on middles
    free = thin(flat.free - corner, FREE_CELL)
    rows, walls = keys(squares(free, FREE_CELL), squares(flat.walls - corner, FREE_CELL))
    cells = squares(free[~np.isin(rows, walls)], FREE_CELL)
    origin = np.array([*corner, z + LASER - FREE_CELL / 2])
    return VoxelGrid.from_cells(np.column_stack([cells, np.zeros(len(cells), np.int64)]), origin, FREE_CELL)


def rooms_at(points: Array, rooms: Sequence[TrueRoom]) -> Array:
    """(n,) int32 index of the room that points (n, 2) lie in or next to, -1: none."""
    corners = np.concatenate([r.polygon for r in rooms])
    low = corners.min(axis=0) - 1.0
    columns, rows = np.ceil((corners.max(axis=0) + 1.0 - low) / ROOM_CELL).astype(int)
    raster = np.full((int(rows), int(columns)), -1, np.int32)
    for i, room in enumerate(rooms):
        fill(raster, (room.polygon - low) / ROOM_CELL, i)
    far, near = ndimage.distance_transform_edt(raster < 0, return_indices=True)
    raster = np.where(far * ROOM_CELL <= ROOM_REACH, raster[near[0], near[1]], -1)
    cells = squares(points - low, ROOM_CELL)
    inside = ((cells >= 0) & (cells < raster.shape[::-1])).all(axis=1)
    out = np.full(len(points), -1, np.int32)
    out[inside] = raster[cells[inside, 1], cells[inside, 0]]
    return out


def storey_of(building: Building, rooms: Array) -> int:
    """The storey on which most of the rooms are."""
    return int(np.bincount([building.rooms[i].storey for i in np.asarray(rooms).tolist()]).argmax())


def labelled(cloud: PointCloud, rooms: Sequence[TrueRoom], storey: int) -> PointCloud:
    """The cloud of a storey with the true rooms of its points.

    Args:
        rooms: of the whole building, in the frame of the cloud; those of other storeys lie over or under it.
    """
    here = np.array([i for i, room in enumerate(rooms) if room.storey == storey], np.int32)
    label = rooms_at(cloud.points[:, :2], [rooms[i] for i in here.tolist()])
    return replace(cloud, labels=np.where(label >= 0, here[label], -1).astype(np.int32), rooms=tuple(rooms))


def floor_overlap(a: Array, b: Array, cell: float = 0.2) -> float:
    """Dice of two floors given as points (n, 2) in one frame: twice the common area by the sum of both areas."""
    here, there = (np.unique(k) for k in keys(squares(a, cell), squares(b, cell)))
    return float(2 * np.isin(here, there).sum() / (len(here) + len(there)))


def flat_pair(
    name: str, a: Flat, b: Flat, truth: Sim3, sensors: tuple[str, str], source: str, building: str, seed: int | None = None
) -> Pair:
    """A pair of floors.

    Args:
        truth: maps b's frame into a's, both as their owners gave them.
        seed: of the frames that both are moved to; None: they stay in the owners' frames, which differ.
    """
    frames = [Sim3(), Sim3()] if seed is None else draw_frames(2, False, np.random.default_rng(seed))
    clouds = [
        raise_flat(flat.moved(Sim3(f.yaw, (*f.translation[:2], 0.0))), f.translation[2])
        for flat, f in zip((a, b), frames, strict=True)
    ]
    shared = seen_by_both(*clouds) if a.rooms and b.rooms else ()
    between = frames[0] @ truth @ frames[1].inverse()
    overlap = floor_overlap(a.free, _flat(truth, b.free))
    return Pair(name, clouds[0], clouds[1], between, shared, overlap, sensors, source, building)
