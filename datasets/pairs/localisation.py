"""Sets for `locate`: maps of buildings, single scans and short walks in them at a later session, scans of other buildings, and
robots that map at the same time.

Furniture has moved between the sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.plans.splits import get_seed_range
from topomerge.datasets.simulation.scanner import (
    scan_building,
    scan_from_poses,
    simulate_sensor_poses,
    transform_cloud,
)
from topomerge.datasets.simulation.sensors import get_sensor, remove_sensor_drift
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.walk import Walk, plan_walk, sample_part

from topomerge import archive
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.maps import save_map
from topomerge.types import Array, PointCloud, Sim3

SCANS = ("station", "sweep", "slice", "frame", "walk")
MORE_SCANS = ("turn", "drive")  # what helps where a frame or a slice tells nothing
SENSOR_OF = {"station": "tls", "sweep": "lidar", "slice": "laser2d", "frame": "depth", "walk": "depth"}
SENSOR_OF |= {"turn": "depth", "drive": "laser2d"}
RAYS_OF = {"station": 60_000, "sweep": 32_000, "slice": 1080, "frame": 30_000, "walk": 12_000}  # a pose
RAYS_OF |= {"turn": 12_000, "drive": 1080}
TURNS = 8  # frames of a turn
WALK_LENGTH = 5.0  # m, of a walk and of a drive
WALKED = ("walk", "drive")
SHORTEST = 0.8  # of it, that a walk must have


@dataclass(frozen=True, eq=False)
class SingleScan:
    """A scan, and where it was taken.

    Args:
        cloud: in a frame of its own; its poses are true but for the drift of a walk.
        frame: takes places of the building into that frame.
        place: (3,) m, of its first pose in the building.
        room: in which that is.
    """

    cloud: PointCloud
    frame: Sim3
    place: Array
    room: int


def simulate_single_scan(
    building: Building, kind: str, rooms: Sequence[int], rng: np.random.Generator, frame: Sim3
) -> SingleScan:
    """Simulate a scan of a kind of `SCANS` or `MORE_SCANS` that begins in one of some rooms.

    Args:
        building: as it stands at the time of the scan (`simulate_session`).
        rooms: where it may begin; a walk stays in them where it can.
        frame: of the scan, without its place: that of the first pose becomes the origin.

    Raises:
        InputError: an unknown kind, or rooms in which nobody can stand.
    """
    if kind not in SENSOR_OF:
        raise InputError(f"kind of scan {kind!r}: {', '.join(SENSOR_OF)} are possible")
    sensor, start = get_sensor(SENSOR_OF[kind]), int(rng.choice(list(rooms)))
    walk = plan_walk(building, list(rooms) if kind in WALKED else [start], rng, 0.0)
    poses = _choose_walk_poses(walk, kind, start, rng)
    points, pose_of = scan_from_poses(building, sensor, poses, RAYS_OF[kind], rng)
    if not len(points):
        raise InputError(f"{building.name}: a {kind} in room {start} sees nothing")
    place = poses[0, :3, 3]
    x, y, z = (-replace(frame, translation=(0.0, 0.0, 0.0)).apply(place[None])[0]).tolist()
    frame = replace(frame, translation=(x, y, z))
    cloud = PointCloud(points.astype(np.float32), poses=poses, pose_of=pose_of.astype(np.int32), upright=True)
    return SingleScan(transform_cloud(cloud, frame), frame, place, start)


def _choose_walk_poses(walk: Walk, kind: str, room: int, rng: np.random.Generator) -> Array:
    """Return (K, 4, 4) of the sensor: one in the room, looking anywhere, or all around; or those along `WALK_LENGTH` from
    there."""
    sensor = get_sensor(SENSOR_OF[kind])
    inside = np.flatnonzero(walk.free & (walk.room == room))
    if not len(inside):
        raise InputError(f"nobody can stand in room {room}")
    at = int(rng.choice(inside))
    if kind not in WALKED:
        still = Walk(walk.points[at : at + 1], walk.room[at : at + 1], np.zeros(1, np.int64), np.ones(1, bool))
        return simulate_sensor_poses(still, replace(sensor, step=0.0, turns=TURNS if kind == "turn" else 1), [room], rng)[0]
    long_enough = inside[walk.along[-1] - walk.along[inside] >= SHORTEST * WALK_LENGTH]
    at = int(rng.choice(long_enough)) if len(long_enough) else 0
    end = int(np.searchsorted(walk.along, walk.along[at] + WALK_LENGTH)) + 1
    part = Walk(walk.points[at:end], walk.room[at:end], np.zeros(0, np.int64), walk.free[at:end])
    poses, _ = simulate_sensor_poses(part, sensor, np.unique(part.room).tolist(), rng)
    if not len(poses):
        raise InputError(f"nobody can walk in room {room}")
    return poses


MAPPED_KINDS = ("office", "hospital", "school", "hotel", "lab", "openplan", "apartment", "house")
MAPPED_SENSORS = ("tls", "lidar", "depth", "laser2d", "tls")  # of the maps, in turn
MAPPED_ROOMS = 14  # of a map, at most
HOUSES_FROM = 100  # maps from here on are of houses by light sensors, which takes a second each: they fill large atlases
HOUSE_SENSORS = ("depth", "laser2d")
OTHER_BUILDING_SEEDS = 5_000  # seeds further on: buildings without a map


def draw_building(split: str, number: int, negative: bool = False) -> tuple[Building, Array, np.random.Generator]:
    """Draw a building, the rooms that its map visits, and what draws the rest."""
    first, _ = get_seed_range(split)
    seed = first + 40_000 + number + OTHER_BUILDING_SEEDS * negative
    rng = np.random.default_rng([seed, 54])
    kind = MAPPED_KINDS[number % len(MAPPED_KINDS)] if number < HOUSES_FROM else "house"
    building = make_building(kind, seed, 2 if number % 6 == 5 else 1)
    return building, sample_part(building, MAPPED_ROOMS, rng), rng


def make_located_map(split: str, number: int, folder: Path) -> Path:
    """Make a map with its truth, unless it is there: the frame of the building in it, and how its drift moved each place.

    Maps of other code lie in other folders: what scans and extracts makes the map, as the number does.
    """
    path = folder / compute_code_digest(__name__)[:12] / f"map_{number:03d}.tmap"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    building, rooms, rng = draw_building(split, number)
    names = MAPPED_SENSORS if number < HOUSES_FROM else HOUSE_SENSORS
    sensor = get_sensor(names[number % len(names)])
    (frame,) = draw_frames(1, False, rng)
    session, seed = simulate_session(building, None, rng), int(rng.integers(1 << 31))
    cloud = scan_building(session, sensor, rooms, seed, frame=frame)
    straight = scan_building(session, remove_sensor_drift(sensor), rooms, seed, frame=frame)
    assert cloud.poses is not None and straight.poses is not None
    truth = {"frame": frame.matrix, "places": straight.poses[:, :3, 3], "moved": (cloud.poses - straight.poses)[:, :3, 3]}
    archive.write(truth, path.with_suffix(".truth.npz"))
    save_map(replace(extract(cloud), source=f"{building.name}:{sensor.name}"), path)
    return path


def make_located_scan(split: str, number: int, kind: str, negative: bool) -> SingleScan:
    """Make a scan of the building of a map, or of one without a map."""
    building, rooms, _ = draw_building(split, number, negative)
    for attempt in range(10):
        rng = np.random.default_rng([number, (*SCANS, *MORE_SCANS).index(kind), int(negative), attempt, 541])
        try:
            return simulate_single_scan(
                simulate_session(building, None, rng), kind, rooms.tolist(), rng, *draw_frames(1, False, rng)
            )
        except InputError:
            continue
    raise InputError(f"no {kind} can be made of {building.name}")


@dataclass(frozen=True, eq=False)
class LocatedMap:
    """A map whose place is known.

    Args:
        path: of the map.
        frame: takes places of the building into it.
        places, moved: (n, 3) m, of its sensor in its frame, and by how much drift moved what was seen there.
    """

    path: Path
    frame: Sim3
    places: Array
    moved: Array

    def place_scan(self, scan: SingleScan) -> tuple[Sim3, Array]:
        """Return the true pose of a scan in the map without its drift, and (3,) m that the drift adds there."""
        pose = self.frame @ scan.frame.inverse()
        near = int(np.linalg.norm(self.places - self.frame.apply(scan.place[None]), axis=1).argmin())
        return pose, self.moved[near]


def load_located_map(path: Path) -> LocatedMap:
    """Load the truth of a map that was made."""
    arrays = archive.read(path.with_suffix(".truth.npz"))
    return LocatedMap(path, Sim3.from_matrix(arrays["frame"]), arrays["places"], arrays["moved"])


def simulate_robot(
    building: Building, rooms: Sequence[int], frame: Sim3, rng: np.random.Generator, step: float = 2.0, rays: int = 5000
) -> list[tuple[float, Array, Array]]:
    """Simulate what a robot sees on its way through rooms: m driven, pose (4, 4) in its frame and points (n, 3) of its lidar.

    Args:
        frame: takes places of the building into that of the robot.
        step: m between two scans.
        rays: of a scan.
    """
    sensor = get_sensor("lidar")
    walk = plan_walk(building, list(rooms), rng, 0.0)
    poses, along = simulate_sensor_poses(walk, sensor, range(len(building.rooms)), rng)
    kept = np.unique(np.floor(along / step), return_index=True)[1]
    chosen = poses[kept]
    points, of = scan_from_poses(building, sensor, chosen, rays, rng)
    seen = [(points[of == n] - pose[:3, 3]) @ pose[:3, :3] for n, pose in enumerate(chosen)]
    return [(float(along[k]), frame.matrix @ pose, part) for k, pose, part in zip(kept, chosen, seen, strict=True)]
