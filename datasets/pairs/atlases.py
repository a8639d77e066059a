"""Three or more partial maps of a building: each overlaps those before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.pairs import ROOMS_A_MAP, Atlas, draw_frames, seen_by_both
from topomerge.datasets.pairs.parts import room_graph
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.session import session
from topomerge.datasets.simulation.walk import part

from topomerge.errors import InputError


def make_atlas(
    building: Building,
    sensors: Sequence[str] = ("tls", "depth", "lidar"),
    rng: np.random.Generator | int = 0,
    rooms: int = ROOMS_A_MAP,
    scale: bool = False,
    difficulty: Difficulty | None = None,
    source: str = "procedural",
) -> Atlas:
    """One session and one walk for each sensor; each walk starts in a room that an earlier one visited.

    Args:
        sensors: names, two or more; they set the number of maps.
        rng: generator or seed; the same seed gives the same points.
        rooms: of each map, at most.
        scale: the scales of all maps but the first are unknown.

    Raises:
        InputError: fewer than two sensors, or a room can't be reached.
    """
    if len(sensors) < 2:
        raise InputError(f"an atlas needs two or more sensors, not {len(sensors)}")
    rng, difficulty = np.random.default_rng(rng), difficulty or Difficulty()
    frames = draw_frames(len(sensors), scale, rng)
    reachable = sorted(room_graph(building))
    maps, visited = [], set[int]()
    for sensor, frame in zip(sensors, frames, strict=True):
        start = int(rng.choice(sorted(visited) or reachable))
        walked = part(building, rooms, rng, start=start)
        visited |= set(walked.tolist())
        maps.append(scan(session(building, difficulty, rng), sensor, walked, rng, frame=frame))
    return Atlas(
        name=f"{building.name}:{'-'.join(sensors)}",
        maps=tuple(maps),
        truth=tuple(frames[0] @ frame.inverse() for frame in frames),
        shared={(k, m): seen_by_both(maps[k], maps[m]) for m in range(len(maps)) for k in range(m)},
        sensors=tuple(sensors),
        source=source,
        building=building.name,
    )
