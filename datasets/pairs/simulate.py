"""`topomerge simulate`: one or two partial maps of a procedural building as files, with the truth and a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.pairs import ROOMS_A_MAP, Pair, PairSettings, draw_frames, make_pair
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.session import session
from topomerge.datasets.simulation.walk import part

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3, TrueRoom

TRUTH_FORMAT = 1
Output = tuple[Path, Callable[[Path], None]]


def simulate(
    kind: str = "office",
    seed: int = 7,
    storeys: int = 1,
    sensors: Sequence[str] = ("tls", "depth"),
    overlap: float = 0.4,
    rooms: int | None = None,
    scale: bool = False,
    hard: str | None = None,
) -> tuple[Building, Pair | PointCloud, Sim3]:
    """A building with a pair of maps of it, or with one cloud where one sensor is given; and the frame of the first cloud.

    Args:
        kind, seed, storeys: of the building (`make_building`); "other-storey" takes two storeys at least, with one plan.
        rooms: of each map at most; None: 15 of a pair, all of a single cloud.
        scale: the scale of the second map is unknown.

    Raises:
        InputError: as `make_building` and `make_pair`; no sensors or more than two.
    """
    if not 1 <= len(sensors) <= 2:
        raise InputError(f"give one or two sensors, not {len(sensors)}")
    for sensor in sensors:
        get_sensor(sensor)
    if rooms is not None and rooms < 1:
        raise InputError(f"a map must have 1 room or more, not {rooms}")
    same_plan = hard == "other-storey"
    building = make_building(kind, seed, max(storeys, 2) if same_plan else storeys, Difficulty(differ=0.0) if same_plan else None)
    rng = np.random.default_rng([seed, 1])
    if len(sensors) == 2:
        pair = make_pair(building, PairSettings(overlap, sensors, ROOMS_A_MAP if rooms is None else rooms, scale, hard), rng)
        assert pair.frames is not None
        return building, pair, pair.frames[0]
    if hard or scale:
        raise InputError("hard negatives and free scale need two sensors")
    visited = None if rooms is None else part(building, rooms, rng)
    (frame,) = draw_frames(1, False, rng)
    cloud = scan(session(building, None, rng), sensors[0], visited, rng, frame=frame)
    return building, cloud, frame


def outputs(building: Building, made: Pair | PointCloud, frame: Sim3, folder: Path) -> list[Output]:
    """The files of a simulation, and what writes each."""
    from topomerge.datasets.pairs.picture import save_picture

    clouds = {"a": made} if isinstance(made, PointCloud) else {"a": made.a, "b": made.b}
    files: list[Output] = [(folder / f"{name}.ply", partial(save_cloud, cloud)) for name, cloud in clouds.items()]
    files.append((folder / "truth.json", partial(save_truth, building, made, frame)))
    files.append((folder / "plan.png", partial(save_picture, building, made, frame)))
    return files


def save_cloud(cloud: PointCloud, path: Path) -> None:
    """Write x y z (float, m) and the true room (int, -1: none) of each point as binary PLY."""
    rows = np.zeros(len(cloud), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("room", "<i4")])
    for axis, name in enumerate("xyz"):
        rows[name] = cloud.points[:, axis]
    rows["room"] = -1 if cloud.labels is None else cloud.labels
    head = ["ply", "format binary_little_endian 1.0", "comment simulated by topomerge, metres, z up"]
    head += [f"element vertex {len(rows)}", *(f"property float {n}" for n in "xyz"), "property int room", "end_header"]
    with path.open("wb") as file:
        file.write(("\n".join(head) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def save_truth(building: Building, made: Pair | PointCloud, frame: Sim3, path: Path) -> None:
    """Write `truth` as JSON."""
    from topomerge.io.listing import json_text

    path.write_text(json_text(truth(building, made, frame)), encoding="utf-8")


def truth(building: Building, made: Pair | PointCloud, frame: Sim3) -> dict[str, Any]:
    """What is true about the files, as plain values; everything of a map is in the frame of its cloud.

    `T_ab` (4 x 4, row-major) maps points of b into the frame of a; null for maps of two buildings.
    """
    from topomerge.io.listing import plain

    listing: dict[str, Any] = {"format": TRUTH_FORMAT, "building": building.name, "seed": building.seed}
    if isinstance(made, PointCloud):
        return plain({**listing, "maps": [_map(building, made, frame, "a.ply", ())]})
    pair, transform = made, made.truth
    assert pair.frames is not None
    listing |= {
        "kind": pair.kind,
        "overlap": pair.overlap,
        "T_ab": None if transform is None else transform.matrix,
        "yaw_deg": None if transform is None else np.degrees(transform.yaw),
        "scale": pair.frames[0].scale / pair.frames[1].scale,
        "shared": sorted(set(pair.visited[0]) & set(pair.visited[1])) if pair.kind == "overlap" else [],
        "seen_by_both": [i for i, _ in pair.shared],
    }
    b = None if pair.kind == "other-building" else building  # the doors of another building are not at hand
    maps = [
        _map(building, pair.a, pair.frames[0], "a.ply", pair.visited[0]),
        _map(b, pair.b, pair.frames[1], "b.ply", pair.visited[1]),
    ]
    return plain({**listing, "maps": maps})


def _map(building: Building | None, cloud: PointCloud, frame: Sim3, name: str, visited: tuple[int, ...]) -> dict[str, Any]:
    place, _, sensor = cloud.source.rpartition(":")
    return {
        "file": name,
        "building": place,
        "sensor": sensor,
        "points": len(cloud),
        "visited": visited or None,
        "rooms": [_room(i, room) for i, room in enumerate(cloud.rooms)],
        "doors": [] if building is None else [_door(d, frame) for d in building.doors],
    }


def _room(i: int, room: TrueRoom) -> dict[str, Any]:
    entry = {"id": i, "name": room.name, "kind": room.kind, "storey": room.storey}
    return entry | {"floor": round(room.floor, 4), "ceiling": round(room.ceiling, 4), "polygon": room.polygon.round(4)}


def _door(door: Array, frame: Sim3) -> dict[str, Any]:
    size = {"width": round(float(door["width"] * frame.scale), 4), "height": round(float(door["height"] * frame.scale), 4)}
    return {"rooms": door["rooms"], "centre": frame.apply(door["centre"][None])[0].round(4), **size, "state": str(door["state"])}
