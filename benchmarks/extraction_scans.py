"""Scans for the benchmark of the extraction, made once and kept under ``cache/scans/``, each with what is true about it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.building import Building
from topomerge.datasets.buildings import make_building
from topomerge.datasets.difficulty import Difficulty
from topomerge.datasets.judge import Truth, draw_rooms, judged
from topomerge.datasets.pairs import draw_frames
from topomerge.datasets.scanner import moved, scan
from topomerge.datasets.sensors import get_sensor
from topomerge.datasets.session import session
from topomerge.datasets.walk import part

from topomerge.types import Array, PointCloud, Sim3, TrueRoom, VoxelGrid

FORMAT = 1  # raise it when the same case gives other bytes
ANCHOR = 0.5  # m between places whose drift is kept


@dataclass(frozen=True)
class Case:
    """One scan.

    Args:
        set: the table's row that it belongs to.
        source: procedural, r2v, campus (plans that are erected), ifc, ipa, gdc (grids, raised or scanned), file.
        building: kind of procedural building, or name of the plan, model, grid or file.
        rooms: rooms to visit; 0: all.
        difficulty: what differs from the defaults.
        spoil: what is done to the points: sparse, noise, below2, drift.
        day: another session of the same building, for consistency; 0 is the first.
    """

    set: str
    source: str
    building: str
    sensor: str = "tls"
    seed: int = 0
    storeys: int = 1
    rooms: int = 0
    difficulty: tuple[tuple[str, float], ...] = ()
    spoil: str = ""
    day: int = 0

    @property
    def place(self) -> str:
        """The building that it is a scan of: what intervals are drawn over."""
        return f"{self.source}/{self.building}/{self.seed}"

    @property
    def name(self) -> str:
        """For people and file names."""
        plan = "_".join(Path(self.building).parts[-2:])[-24:]
        words = [self.set, self.source if self.source != "procedural" else "", plan, self.seed or "", self.sensor, self.spoil]
        words += [f"day{self.day}" if self.day else ""]
        return "-".join(str(w).replace(" ", "_") for w in words if w)

    @property
    def key(self) -> str:
        """Hash of what the scan's bytes depend on."""
        inputs = {**asdict(self), "set": "", "format": FORMAT}
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud and what is true about it (None: nothing is), with the true rooms in the building's frame."""

    cloud: PointCloud
    truth: Truth | None
    rooms: tuple[TrueRoom, ...]


def load(case: Case, folder: Path, data: Path | None) -> Scan:
    """The scan of a case, from the cache where it has it."""
    path = folder / f"{case.key}.npz"
    if not path.exists():
        from topomerge.io.atomic import replacing

        folder.mkdir(parents=True, exist_ok=True)
        made = make(case, data)
        with replacing(path) as beside, open(beside, "wb") as file:
            np.savez(file, allow_pickle=False, **_arrays(made))
    with np.load(path, allow_pickle=False) as file:
        return _scan(dict(file))


def make(case: Case, data: Path | None) -> Scan:
    """Simulate or read a case."""
    if case.source in ("procedural", "r2v", "campus", "mall", "rmf"):
        return simulated(case, building_of(case, data))
    raise ValueError(f"unknown source {case.source}")


def building_of(case: Case, data: Path | None) -> Building:
    """The building of a simulated case."""
    difficulty = Difficulty(**dict(case.difficulty))
    if case.source == "procedural":
        return make_building(case.building, case.seed, case.storeys, difficulty)
    from topomerge.datasets.erect import erect

    if data is None:
        raise FileNotFoundError("set TOPOMERGE_DATA to the folder of the real data")
    return erect([plan_of(case.source, case.building, data)], difficulty, case.seed, name=case.building, kind=case.source)


@lru_cache(maxsize=64)
def plan_of(source: str, name: str, data: Path) -> Any:
    """The plan of that name."""
    from topomerge.datasets.floorplans import Refusal, iter_plans, read_plans
    from topomerge.datasets.splits import FOLDERS

    folder = data / FOLDERS[source]
    if source == "r2v":
        return read_plans(f"{folder / 'r2v_annotations.tar.xz'}::{name}")[0]
    if source == "campus":
        return read_plans(folder / f"{name}.xml")[0]
    return next(plan for n, plan in iter_plans(folder) if n == name and not isinstance(plan, Refusal))


def simulated(case: Case, building: Building) -> Scan:
    """Walk through a building and scan it, in a turned frame."""
    seed = [case.seed, 1, case.day]
    rng = np.random.default_rng(seed)
    building = session(building, Difficulty(**dict(case.difficulty)), rng) if case.day else building
    inside = np.array([i for i, r in enumerate(building.rooms) if r.kind != "lift"])
    visited = part(building, case.rooms, np.random.default_rng([case.seed, 2])) if case.rooms else inside
    sensor = get_sensor(case.sensor)
    if case.spoil == "drift":
        sensor = replace(sensor, drift=1.5)
    cloud = scan(building, sensor, visited, np.random.default_rng(seed))
    straight = cloud
    if sensor.drift or sensor.tilt:  # poses are drawn before the drift is
        straight = scan(building, replace(sensor, drift=0.0, tilt=0.0), visited, np.random.default_rng(seed), budget=8)
    cloud = _spoilt(cloud, building, case.spoil, rng)
    anchors, drift = _drift_of(cloud, straight)
    raster, origin = draw_rooms(building.rooms, building.storeys["floor"])
    height = building.storeys["ceiling"] - building.storeys["floor"]
    real = Truth(
        raster=raster,
        origin=origin,
        visited=np.isin(np.arange(len(building.rooms)), visited),
        floors=building.storeys["floor"],
        height=height,
        doors=np.column_stack([building.doors["rooms"], building.doors["centre"]]).astype(float).reshape(-1, 5),
        edges=building.edges(),
        matrix=np.eye(4),
        anchors=anchors,
        drift=drift,
    )
    real = replace(real, raster=judged(raster, origin, real.floors, height, real.place(cloud.points)))
    frame = draw_frames(1, False, np.random.default_rng([*seed, 3]))[0]
    return Scan(replace(moved(cloud, frame), rooms=()), in_frame(real, frame), building.rooms)


def in_frame(truth: Truth, frame: Sim3) -> Truth:
    """The truth of a scan that was moved by a frame (building -> scan)."""
    turn = Sim3(frame.yaw).matrix[:3, :3] * frame.scale
    anchors = frame.apply(truth.anchors) if len(truth.anchors) else truth.anchors
    matrix = truth.matrix @ frame.inverse().matrix
    return replace(truth, matrix=matrix, anchors=anchors, drift=truth.drift @ turn.T)


def _drift_of(cloud: PointCloud, straight: PointCloud) -> tuple[Array, Array]:
    """Places of the cloud, one a cube of `ANCHOR`, and what undoes the drift there."""
    if straight is cloud or straight.poses is None or cloud.poses is None or cloud.pose_of is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    back = straight.poses @ np.linalg.inv(cloud.poses)
    points = cloud.points.astype(np.float64)
    undone = np.einsum("nij,nj->ni", back[cloud.pose_of, :3, :3], points) + back[cloud.pose_of, :3, 3]
    cell, of, count = np.unique(np.floor(points / ANCHOR).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()

    def mean(values: Array) -> Array:
        return np.stack([np.bincount(of, values[:, k], len(cell)) for k in range(3)], axis=1) / count[:, None]

    return mean(points), mean(undone - points)


def _spoilt(cloud: PointCloud, building: Building, spoil: str, rng: np.random.Generator) -> PointCloud:
    """The cloud after what is done to its points."""
    points, kept = cloud.points, np.ones(len(cloud), bool)
    if spoil == "sparse":
        kept = rng.random(len(points)) < 0.05
    elif spoil == "below2":
        floor = building.storeys["floor"]
        storey = np.clip(np.searchsorted(floor - 0.3, points[:, 2]) - 1, 0, None)
        kept = points[:, 2] < floor[storey] + 2.0
    elif spoil == "noise":
        points = points + rng.normal(0, 0.04, points.shape).astype(np.float32)
    pose_of = None if cloud.pose_of is None else cloud.pose_of[kept]
    return replace(cloud, points=points[kept], labels=None, pose_of=pose_of)


def _arrays(scan: Scan) -> dict[str, Array]:
    cloud, truth = scan.cloud, scan.truth
    out: dict[str, Array] = {"points": cloud.points, "shift": cloud.shift, "source": np.array(cloud.source)}
    if cloud.poses is not None and cloud.pose_of is not None:
        out |= {"poses": cloud.poses, "pose_of": cloud.pose_of}
    if cloud.free is not None:
        out |= {"free": cloud.free.cells, "free_origin": cloud.free.origin, "free_edge": np.array(cloud.free.edge)}
    if truth is not None:
        out |= {f"truth.{name}": np.asarray(value) for name, value in vars(truth).items()}
    rooms = [{**asdict(r), "polygon": np.round(r.polygon, 4).tolist()} for r in scan.rooms]
    return out | {"rooms": np.array(json.dumps(rooms))}


def _scan(arrays: dict[str, Array]) -> Scan:
    free = None
    if "free" in arrays:
        free = VoxelGrid.from_cells(arrays["free"], arrays["free_origin"], float(arrays["free_edge"]))
    cloud = PointCloud(
        arrays["points"],
        shift=arrays["shift"],
        poses=arrays.get("poses"),
        pose_of=arrays.get("pose_of"),
        free=free,
        source=str(arrays["source"]),
    )
    known = {k.removeprefix("truth."): v for k, v in arrays.items() if k.startswith("truth.")}
    rooms = tuple(TrueRoom(**{**r, "polygon": np.array(r["polygon"])}) for r in json.loads(str(arrays["rooms"])))
    return Scan(cloud, Truth(**known) if known else None, rooms)

