"""Three or more partial maps of a building: each overlaps those before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from topomerge.datasets.core.building import Building, Difficulty
from topomerge.datasets.pairs.drawing import simulate_drawing
from topomerge.datasets.pairs.flat_maps import find_storey, simulate_robot_grid
from topomerge.datasets.pairs.pairs import ROOMS_A_MAP, Atlas, draw_frames, find_common_rooms
from topomerge.datasets.pairs.parts import build_room_graph
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import scale_sensor_drift
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.walk import sample_part

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3

READ_SCALE = 0.03  # standard deviation of the logarithm of a drawing's scale, as it is read off it
FLAT_KINDS = ("grid", "drawing")  # maps of one storey, seen from above


def make_atlas(
    building: Building,
    sensors: Sequence[str] = ("tls", "depth", "lidar"),
    rng: np.random.Generator | int = 0,
    rooms: int = ROOMS_A_MAP,
    scale: bool = False,
    difficulty: Difficulty | None = None,
    source: str = "procedural",
    drifts: Sequence[float] = (),
) -> Atlas:
    """Make one session and one walk for each sensor; each walk starts in a room that an earlier one visited.

    Args:
        sensors: names, two or more, also of `FLAT_KINDS`; they set the number of maps.
        rng: generator or seed; the same seed gives the same points.
        rooms: of each map, at most.
        scale: the scales of all maps but the first are unknown.
        drifts: of each map, times the usual drift of its sensor; empty: the usual one.

    Raises:
        InputError: fewer than two sensors, or a room can't be reached.
    """
    if len(sensors) < 2:
        raise InputError(f"an atlas needs two or more sensors, not {len(sensors)}")
    rng, difficulty = np.random.default_rng(rng), difficulty or Difficulty()
    frames = [
        replace(frame, scale=frame.scale * float(np.exp(rng.normal(0, READ_SCALE)))) if sensor == "drawing" else frame
        for frame, sensor in zip(draw_frames(len(sensors), scale, rng), sensors, strict=True)
    ]
    reachable = sorted(build_room_graph(building))
    maps, visited = [], set[int]()
    for k, (sensor, frame) in enumerate(zip(sensors, frames, strict=True)):
        start = int(rng.choice(sorted(visited) or reachable))
        walked = sample_part(building, rooms, rng, start=start)
        visited |= set(walked.tolist())
        drift = drifts[k] if len(drifts) else 1.0
        maps.append(simulate_partial_map(simulate_session(building, difficulty, rng), sensor, walked, rng, frame, drift))
    return Atlas(
        name=f"{building.name}:{'-'.join(sensors)}",
        maps=tuple(maps),
        truth=tuple(frames[0] @ frame.inverse() for frame in frames),
        shared={(k, m): find_common_rooms(maps[k], maps[m]) for m in range(len(maps)) for k in range(m)},
        sensors=tuple(sensors),
        source=source,
        building=building.name,
        frames=tuple(frames),
    )


def simulate_partial_map(
    building: Building, sensor: str, rooms: Array, rng: np.random.Generator, frame: Sim3, drift: float = 1.0
) -> PointCloud:
    """Simulate rooms of a building as a sensor, a robot with a 2D laser ("grid") or an architect ("drawing") maps them.

    Args:
        sensor: its name, or one of `FLAT_KINDS`: these show one storey, that of most of the rooms; a drawing shows also what lies
            about them.
        frame: of the map.
        drift: times the usual one of the sensor.

    Raises:
        InputError: an unknown name, or a room can't be reached.
    """
    if sensor == "drawing":
        return simulate_drawing(building, rooms, find_storey(building, rooms), rng, frame)
    if sensor == "grid":
        storey = find_storey(building, rooms)
        level = np.array([i for i in rooms.tolist() if building.rooms[i].storey == storey])
        return simulate_robot_grid(building, scale_sensor_drift("laser2d", drift), level, rng, frame)
    return scan_building(building, scale_sensor_drift(sensor, drift), rooms, rng, frame=frame)
