"""Floors seen from above: robot grids, laser logs and drawings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import Pair, draw_frames, find_common_rooms
from topomerge.datasets.plans.sealed import refuse_file
from topomerge.datasets.simulation.floor_truth import fill
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import Sensor

from topomerge.errors import InputError
from topomerge.io import grid
from topomerge.types import Array, PointCloud, Sim3, TrueRoom, VoxelGrid

WALL_HEIGHT = 2.5  # m of the walls
LASER = 0.3  # m above the floor
FREE_CELL = 0.1  # m of a free cell
FLOOR_NEAR_WALL = 0.5  # m from a wall to the nearest free floor
ROOM_CELL, ROOM_REACH = 0.1, 0.3  # m; a wall belongs to the room that is as near as that


@dataclass(frozen=True, eq=False)
class FlatMap:
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

    def transform(self, frame: Sim3) -> FlatMap:
        """Return the same floor in another frame."""
        poses = self.poses
        if poses is not None:
            poses = np.column_stack([_transform_points(frame, poses[:, :2]), poses[:, 2] + frame.yaw])
        rooms = tuple(transform_room(r, frame) for r in self.rooms)
        walls, free = _transform_points(frame, self.walls), _transform_points(frame, self.free)
        return replace(self, walls=walls, free=free, cell=self.cell * frame.scale, poses=poses, rooms=rooms)


def _transform_points(frame: Sim3, points: Array) -> Array:
    """Return (n, 2) points in another frame."""
    c, s = frame.scale * np.cos(frame.yaw), frame.scale * np.sin(frame.yaw)
    x, y = points.T
    return np.column_stack([c * x - s * y + frame.translation[0], s * x + c * y + frame.translation[1]])


def transform_room(room: TrueRoom, frame: Sim3) -> TrueRoom:
    """Transform a room with its outline into another frame."""
    return replace(room, polygon=_transform_points(frame, room.polygon))


def read_flat(path: Path, resolution: float | None = None, rays: bool = True) -> FlatMap:
    """Read a robot grid: a map_server yaml, or an image whose pixels are so many metres wide.

    Raises:
        InputError: missing or damaged file, or a sealed one.
    """
    refuse_file(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the folder")
    plan = grid.read_yaml(path) if resolution is None else grid.Plan(path, resolution)
    occupied, free, _ = grid.read_pixels(path, plan)
    return build_from_masks(occupied, free, plan.resolution, plan.origin, rays, source=path.name)


def build_from_masks(
    occupied: Array, free: Array, cell: float, origin: Sequence[float] = (0.0, 0.0, 0.0), rays: bool = True, source: str = ""
) -> FlatMap:
    """Build a floor from images (h, w) bool of what stands and what is free, highest row first.

    Args:
        origin: x, y (m) and yaw (rad) of the lower left corner.
    """
    # A ray that met a wall went through free space first: letters and frames drawn beside the map are no walls.
    surface = occupied & ndimage.binary_dilation(~occupied, np.ones((3, 3)))
    surface &= ndimage.distance_transform_edt(~free) * cell < FLOOR_NEAR_WALL
    frame = Sim3(float(origin[2]), (float(origin[0]), float(origin[1]), 0.0))
    at = [np.argwhere(mask)[:, ::-1] for mask in (surface, free)]
    walls, floor = (
        _transform_points(frame, (np.column_stack([x, len(free) - 1 - y]) + 0.5) * cell) for x, y in (a.T for a in at)
    )
    return FlatMap(walls, floor, cell, rays, source=source)


def extrude_flat(flat: FlatMap, z: float = 0.0) -> PointCloud:
    """Return the cloud of a floor at height `z`, m: floor, walls of `WALL_HEIGHT` and, where the sensor's rays went, free
    cells."""
    spacing = max(flat.cell, 0.05)
    levels = np.linspace(0.0, WALL_HEIGHT, round(WALL_HEIGHT / spacing) + 1)
    free, walls = (thin(p, spacing) if flat.cell < 0.9 * spacing else p for p in (flat.free, flat.walls))
    points = np.concatenate([_repeat_at_heights(free, [0.0]), _repeat_at_heights(walls, levels)]) + [0.0, 0.0, z]
    poses = None
    if flat.poses is not None:
        poses = np.array([Sim3(yaw, (x, y, z + LASER)).matrix for x, y, yaw in flat.poses.tolist()])
    rooms = tuple(replace(r, floor=r.floor + z, ceiling=r.ceiling + z) for r in flat.rooms)
    labels = find_rooms(points[:, :2], rooms) if rooms else None
    free_cells = _build_free_grid(flat, z) if flat.rays else None
    return PointCloud(points.astype(np.float32), labels=labels, poses=poses, free=free_cells, rooms=rooms, source=flat.source)


def encode_rows(*sets: Array) -> tuple[Array, ...]:
    """Return one int64 for each row of integers (n, k), the same for the same row in all sets: much faster to compare than
    rows."""
    low = np.min([s.min(axis=0) for s in sets if len(s)], axis=0)
    size = np.max([s.max(axis=0) for s in sets if len(s)], axis=0) - low + 1
    return tuple(np.ravel_multi_index(tuple((s - low).T), tuple(size.tolist())) for s in sets)


def compute_cells(points: Array, cell: float | Array) -> Array:
    """Compute (n, k) int64 cells of points."""
    return np.floor(points / cell).astype(np.int64)


def thin(points: Array, cell: float) -> Array:
    """Keep the first point of each square or cube of a raster."""
    if not len(points):
        return points
    return points[np.sort(np.unique(encode_rows(compute_cells(points, cell))[0], return_index=True)[1])]


def _repeat_at_heights(points: Array, levels: Sequence[float] | Array) -> Array:
    """Return (n * k, 3) points at each of k heights."""
    return np.column_stack([np.tile(points, (len(levels), 1)), np.repeat(levels, len(points))])


def _build_free_grid(flat: FlatMap, z: float) -> VoxelGrid:
    """Build the grid of the cells at the laser's height that hold free floor and no wall."""
    corner = np.concatenate([flat.free, flat.walls]).min(axis=0) - 1.5 * FREE_CELL  # a lattice of this step falls on middles
    free = thin(flat.free - corner, FREE_CELL)
    rows, walls = encode_rows(compute_cells(free, FREE_CELL), compute_cells(flat.walls - corner, FREE_CELL))
    cells = compute_cells(free[~np.isin(rows, walls)], FREE_CELL)
    origin = np.array([*corner, z + LASER - FREE_CELL / 2])
    return VoxelGrid.from_cells(np.column_stack([cells, np.zeros(len(cells), np.int64)]), origin, FREE_CELL)


def find_rooms(points: Array, rooms: Sequence[TrueRoom]) -> Array:
    """Find (n,) int32 index of the room that points (n, 2) lie in or next to, -1: none."""
    corners = np.concatenate([r.polygon for r in rooms])
    low = corners.min(axis=0) - 1.0
    columns, rows = np.ceil((corners.max(axis=0) + 1.0 - low) / ROOM_CELL).astype(int)
    raster = np.full((int(rows), int(columns)), -1, np.int32)
    for i, room in enumerate(rooms):
        fill(raster, (room.polygon - low) / ROOM_CELL, i)
    far, near = ndimage.distance_transform_edt(raster < 0, return_indices=True)
    raster = np.where(far * ROOM_CELL <= ROOM_REACH, raster[near[0], near[1]], -1)
    cells = compute_cells(points - low, ROOM_CELL)
    inside = ((cells >= 0) & (cells < raster.shape[::-1])).all(axis=1)
    out = np.full(len(points), -1, np.int32)
    out[inside] = raster[cells[inside, 1], cells[inside, 0]]
    return out


def find_storey(building: Building, rooms: Array) -> int:
    """Find the storey on which most of the rooms are."""
    return int(np.bincount([building.rooms[i].storey for i in np.asarray(rooms).tolist()]).argmax())


def label_points(cloud: PointCloud, rooms: Sequence[TrueRoom], storey: int) -> PointCloud:
    """Return the cloud of a storey with the true rooms of its points.

    Args:
        rooms: of the whole building, in the frame of the cloud; those of other storeys lie over or under it.
    """
    here = np.array([i for i, room in enumerate(rooms) if room.storey == storey], np.int32)
    label = find_rooms(cloud.points[:, :2], [rooms[i] for i in here.tolist()])
    return replace(cloud, labels=np.where(label >= 0, here[label], -1).astype(np.int32), rooms=tuple(rooms))


def measure_floor_overlap(a: Array, b: Array, cell: float = 0.2) -> float:
    """Measure Dice of two floors given as points (n, 2) in one frame: twice the common area by the sum of both areas."""
    cells_a, cells_b = (np.unique(k) for k in encode_rows(compute_cells(a, cell), compute_cells(b, cell)))
    return float(2 * np.isin(cells_a, cells_b).sum() / (len(cells_a) + len(cells_b)))


def build_flat_pair(
    name: str, a: FlatMap, b: FlatMap, truth: Sim3, sensors: tuple[str, str], source: str, building: str, seed: int | None = None
) -> Pair:
    """Build a pair of floors.

    Args:
        truth: maps b's frame into a's, both as their owners gave them.
        seed: of the frames that both are moved to; None: they stay in the owners' frames, which differ.
    """
    frames = [Sim3(), Sim3()] if seed is None else draw_frames(2, False, np.random.default_rng(seed))
    clouds = [
        extrude_flat(flat.transform(Sim3(f.yaw, (*f.translation[:2], 0.0))), f.translation[2])
        for flat, f in zip((a, b), frames, strict=True)
    ]
    shared = find_common_rooms(*clouds) if a.rooms and b.rooms else ()
    between = frames[0] @ truth @ frames[1].inverse()
    overlap = measure_floor_overlap(a.free, _transform_points(truth, b.free))
    return Pair(name, clouds[0], clouds[1], between, shared, overlap, sensors, source, building)


GRID_CELL = 0.05  # m
GRID_RAYS = 120_000  # of the whole walk
LEAST_HITS = 0.25  # share of the rays in a cell that end there, from which on it is occupied
GRID_MARGIN = 1.0  # m about what was seen
SAMPLES_AT_ONCE = 2_000_000


def simulate_robot_grid(
    building: Building, laser: Sensor, rooms: Array, rng: np.random.Generator, frame: Sim3, cleared: float = np.inf
) -> PointCloud:
    """Simulate the map that a robot makes of the rooms that it drives through, in a frame, with the true rooms of its points.

    Args:
        laser: sees one line.
        cleared: m of each ray that the robot believes: what it met farther away is not drawn, what it crossed before is free.

    Raises:
        InputError: as `scan`.
    """
    cloud = scan_building(building, laser, rooms, rng, budget=GRID_RAYS, frame=frame)
    assert cloud.poses is not None and cloud.pose_of is not None
    starts, ends = cloud.poses[cloud.pose_of, :2, 3], cloud.points[:, :2].astype(np.float64)
    length = np.hypot(*(ends - starts).T)
    met = length <= cleared
    ends = np.where(met[:, None], ends, starts + (ends - starts) * np.minimum(cleared / np.maximum(length, 1e-9), 1)[:, None])
    occupied, free, corner = count_rays(starts, ends, met)
    flat = build_from_masks(occupied[::-1], free[::-1], GRID_CELL, (*corner.tolist(), 0.0), source=f"{building.name}:grid")
    height = float(cloud.poses[0, 2, 3]) - frame.scale * laser.height
    return label_points(extrude_flat(flat, height), cloud.rooms, find_storey(building, rooms))


def count_rays(starts: Array, ends: Array, met: Array | None = None) -> tuple[Array, Array, Array]:
    """Return (rows, columns) bool of occupied and of free cells of `GRID_CELL`, and the corner (2,) m of the first: a cell is
    occupied where at least `LEAST_HITS` of the rays that come to it end (occupancy grids: Elfes 1989), else free where any
    crosses it.

    Args:
        starts, ends: (n, 2) m.
        met: (n,) bool, did the ray meet something at its end? None: all did.
    """
    corner = np.floor((np.minimum(starts.min(axis=0), ends.min(axis=0)) - GRID_MARGIN) / GRID_CELL) * GRID_CELL
    top = np.maximum(starts.max(axis=0), ends.max(axis=0)) + GRID_MARGIN
    columns, rows = np.ceil((top - corner) / GRID_CELL).astype(int).tolist()

    def cell(points: Array) -> Array:
        x, y = np.floor((points - corner) / GRID_CELL).astype(np.int64).T
        return np.asarray(y * columns + x)

    hits = np.bincount(cell(ends if met is None else ends[met]), minlength=rows * columns)
    crossed = np.zeros(rows * columns, np.int64)
    steps = np.ceil(np.hypot(*(ends - starts).T) / GRID_CELL).astype(int)
    limits = np.searchsorted(np.cumsum(steps), np.arange(SAMPLES_AT_ONCE, steps.sum() + SAMPLES_AT_ONCE, SAMPLES_AT_ONCE))
    first = 0
    for last in np.unique(np.minimum(limits + 1, len(steps))).tolist():
        count = steps[first:last]
        ray = np.repeat(np.arange(first, last), count)
        share = (np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)) / steps[ray]
        crossed += np.bincount(cell(starts[ray] + share[:, None] * (ends - starts)[ray]), minlength=rows * columns)
        first = last
    occupied = hits >= np.maximum(LEAST_HITS * (hits + crossed), 1)
    return occupied.reshape(rows, columns), ((crossed > 0) & ~occupied).reshape(rows, columns), corner
