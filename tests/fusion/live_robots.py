"""Two robots in a simulated building, as the messages that they send."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.localisation import simulate_robot
from topomerge.datasets.simulation.walk import sample_part

from topomerge.types import Array, Sim3

FRAMES = {"a": Sim3(), "b": Sim3(2.1, (7.0, -3.0, 0.0))}  # of the building in the frame of each
SEED = 800_123
ROOMS = 6  # that both visit


@cache
def build_office() -> Building:
    """The building that both drive through."""
    return make_building("office", SEED)


@cache
def list_scans(name: str) -> list[tuple[float, Array, Array]]:
    """Time, pose (4, 4) in the robot's frame and points (n, 3) of the sensor, along a walk through the same rooms."""
    building = build_office()
    rooms = sample_part(building, ROOMS, np.random.default_rng(54))
    scans = simulate_robot(building, rooms.tolist(), FRAMES[name], np.random.default_rng([ord(name), 54]))
    return [(0.1 * n, pose, points) for n, (_, pose, points) in enumerate(scans)]


def stamp(time: float) -> dict[str, int]:
    """A time as messages have it."""
    return {"sec": int(time) + 1, "nanosec": round((time % 1) * 1e9)}


def build_odometry(name: str, time: float, pose: Array) -> dict[str, Any]:
    """An Odometry."""
    from scipy.spatial.transform import Rotation

    place, turn = pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    where = {"position": dict(zip("xyz", place, strict=True)), "orientation": dict(zip("xyzw", turn, strict=True))}
    head = {"stamp": stamp(time), "frame_id": f"{name}/odom"}
    return {"header": head, "child_frame_id": f"{name}/base", "pose": {"pose": where}}


def build_cloud(name: str, time: float, points: Array) -> dict[str, Any]:
    """A PointCloud2, as rosbridge writes it."""
    fields = [{"name": axis, "offset": 4 * k, "datatype": 7, "count": 1} for k, axis in enumerate("xyz")]
    shape = {"height": 1, "width": len(points), "point_step": 12, "row_step": 12 * len(points), "is_bigendian": False}
    data = base64.b64encode(points.astype("<f4").tobytes()).decode()
    head = {"stamp": stamp(time), "frame_id": f"{name}/base"}
    return {"header": head, "fields": fields, "data": data, "is_dense": True, **shape}


def iter_messages(scans: int = 1000) -> Iterator[tuple[str, dict[str, Any]]]:
    """Topic and message of both robots, in turn; a scan comes before its pose."""
    both = [list_scans(name)[:scans] for name in FRAMES]
    for n in range(max(map(len, both))):
        for name, of in zip(FRAMES, both, strict=True):
            if n < len(of):
                time, pose, points = of[n]
                yield f"/{name}/points", build_cloud(name, time, points)
                yield f"/{name}/odom", build_odometry(name, time, pose)
