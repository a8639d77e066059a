"""Plans of simulated scans of training buildings, each column with its true room and what truly stands there.

    python -m benchmarks.training.training_plans --of network --scans 300     # cache/plans/*.npz, about 1 s of a core each
    python -m benchmarks.training.training_plans --of judge --scans 300       # both go on where they were

What `train_plan_network.py` and `train_judge.py` learn from: the judge hears the network, and must not hear it on scans that it
was trained on. Procedural buildings and, with TOPOMERGE_DATA set, real plans; never one of validation or evaluation. All sensors,
several voxel sizes, spoilt points, and grid maps drawn from the plans with furniture in them, as robots make them; most of them
turned. A file holds what a `StoreyPlan` needs of each storey, `room` (-1 none) and `truth` (`TRUTHS`).
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.procedural import KINDS, make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.plans import splits
from topomerge.datasets.plans.floorplans import Refusal, iter_plans
from topomerge.datasets.simulation.floors import fill
from topomerge.datasets.simulation.scanner import moved, scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.walk import part

from benchmarks.extraction.sources import _drift_of, _exact, _spoilt
from topomerge.errors import InputError
from topomerge.extraction.navigable import navigable_volume
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.plan import columns_of, profile_bands, storey_plan
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import with_raised_slice
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.types import Array, PointCloud, Sim3

CACHE = Path("cache/plans")
SEEDS = {"network": 100_000, "judge": 200_000}  # of the first building; training seeds end at 799,999
TRUTHS = ("inside", "wall", "doorway", "shut", "outside")  # furniture is inside
EDGES = (0.1, 0.1, 0.1, 0.08, 0.15)  # m
SOURCES = {"tls": 0.16, "lidar": 0.16, "depth": 0.12, "tablet": 0.12, "mono": 0.08, "laser2d": 0.2, "drawn": 0.16}
SPOILS = {"": 0.48, "sparse": 0.16, "noise": 0.1, "below2": 0.1, "drift": 0.06, "above": 0.1}  # above: no lower half
ROOMS = (4, 9)  # that are visited: at least, less than
FINE = 0.05  # m, of the rasters of what is true
WALL = 0.4  # m: so far from a room it is wall, further outside
LEVEL = 0.6  # m between a storey and the true floor
LOW = 1.0  # m: lower furniture is in a drawn grid
HUNG = ("leaf", "board", "lamp", "beam", "duct")  # in no drawn grid
KEPT = ("edge", "profile", "wall", "inside", "ceiling")


@dataclass(frozen=True, eq=False)
class Example:
    """A plan with what is true about it."""

    plan: StoreyPlan
    room: Array  # (nx, ny) int16 true room, -1 none
    truth: Array  # (nx, ny) uint8, index into TRUTHS
    visited: Array  # (n,) rooms that the surveyor was in
    source: str  # sensor/where the building is from


def files_of(learner: str) -> list[Path]:
    """Files that the network or the judge learns from."""
    first = SEEDS[learner]
    return [f for f in sorted(CACHE.glob("[0-9]*.npz")) if first <= int(f.stem) < first + 100_000]


def gather(scans: int, first: int) -> None:
    """Examples of so many scans, a file each."""
    CACHE.mkdir(parents=True, exist_ok=True)
    plans = real_plans()
    for seed in range(first, first + scans):
        path = CACHE / f"{seed}.npz"
        if path.exists():
            continue
        try:
            examples = make(seed, plans)
        except InputError as error:
            print(f"{seed}: {error}", flush=True)
            continue
        save(path, examples)
        print(f"{seed}: {[(e.source, *e.room.shape) for e in examples]}", flush=True)


def save(path: Path, examples: list[Example]) -> None:
    """Write one file."""
    arrays: dict[str, Any] = {"count": len(examples)}
    for k, e in enumerate(examples):
        small = {name: getattr(e.plan, name) for name in KEPT}
        small["ceiling"] = np.asarray(small["ceiling"], np.float32)
        arrays |= {f"{name}.{k}": v for name, v in small.items()}
        arrays |= {f"{name}.{k}": getattr(e, name) for name in ("room", "truth", "visited", "source")}
    beside = path.with_name(f"new_{path.name}")
    np.savez_compressed(beside, **arrays)
    os.replace(beside, path)


def load(path: Path) -> list[Example]:
    """Read one file."""
    with np.load(path, allow_pickle=False) as file:
        a = dict(file)
    out = []
    for k in range(int(a["count"])):
        edge, rasters = float(a[f"edge.{k}"]), {name: a[f"{name}.{k}"] for name in ("wall", "inside", "profile", "ceiling")}
        plan = StoreyPlan(np.zeros(2), edge, bands=profile_bands(edge), floor=np.zeros(rasters["wall"].shape), **rasters)
        out.append(Example(plan, a[f"room.{k}"], a[f"truth.{k}"], a[f"visited.{k}"], str(a[f"source.{k}"])))
    return out


def real_plans() -> dict[str, list[Any]]:
    """Training plans of apartments, schools and offices, if there are any."""
    data = os.environ.get("TOPOMERGE_DATA", "")
    out: dict[str, list[Any]] = {}
    for source in ("r2v", "campus") if data else ():
        wanted = set(splits.members("train", source))
        found = iter_plans(Path(data) / splits.FOLDERS[source], wanted)
        out[source] = [plan for _, plan in found if not isinstance(plan, Refusal)][:300]
    return out


def make(seed: int, plans: dict[str, list[Any]]) -> list[Example]:
    """The storeys of one scan."""
    rng = np.random.default_rng(seed)
    difficulty = draw_difficulty(rng)
    source = str(rng.choice(["procedural", "r2v", "campus"], p=[0.55, 0.3, 0.15]))
    sensor = str(rng.choice(list(SOURCES), p=list(SOURCES.values())))
    if plans.get(source):
        building = erect([plans[source][rng.integers(len(plans[source]))]], difficulty, rng, f"{source}-{seed}")
    else:
        floors = 1 if sensor in ("laser2d", "drawn") else int(rng.choice([1, 1, 1, 2]))
        building = make_building(str(rng.choice(KINDS)), seed, floors, difficulty)
    visited = part(building, int(rng.integers(*ROOMS)), rng)
    if sensor == "drawn":
        cloud, shift = drawn(building, visited, rng), None
    else:
        cloud, shift = scanned(building, sensor, visited, rng, seed)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    found = storeys_of(moved(cloud, frame), EDGES[seed % len(EDGES)])
    return [
        Example(plan, *truth_of(building, plan, places, frame, shift), visited, f"{sensor}/{source}") for plan, places in found
    ]


def draw_difficulty(rng: np.random.Generator) -> Difficulty:
    """From tidy to hard, all kinds at once."""
    wide = {"ceiling_spread": 0.4, "furniture": 2.0, "clutter": 1.0, "glass": 0.2, "lamps": 1.0, "beams": 0.5, "columns": 1.0}
    drawn = {name: float(rng.uniform(0, most)) for name, most in (wide | {"slopes": 0.5, "curved": 0.4}).items()}
    ajar = float(rng.uniform(0.4, 0.9))
    lintels = float(rng.choice([0, 0.5, 0.9, 1.0]))
    return Difficulty(**drawn, open=ajar, half=float(rng.uniform(0, 1 - ajar)), lintels=lintels)


def scanned(building: Building, name: str, visited: Array, rng: np.random.Generator, seed: int) -> tuple[PointCloud, Any]:
    """A scan, and places of it with what undoes its drift there (None: it has none)."""
    sensor = get_sensor(name)
    spoil = str(rng.choice(list(SPOILS), p=list(SPOILS.values()))) if sensor.beams != 1 and name != "mono" else ""
    if spoil == "below2" and sensor.lowest > 0:  # hardly anything would be left
        spoil = ""
    if spoil == "drift":
        sensor = replace(sensor, drift=1.0)
    elif rng.random() < 0.6:
        sensor = replace(sensor, drift=0.0, tilt=0.0)
    spacing = max(sensor.spacing, 0.05) if sensor.beams != 1 else None
    cloud = scan(building, sensor, visited, np.random.default_rng(seed), spacing)
    shift = None
    if sensor.drift:
        straight = scan(building, _exact(sensor), visited, np.random.default_rng(seed), budget=8)
        shift = _drift_of(cloud, straight)
    cloud = upper(cloud, building, rng) if spoil == "above" else _spoilt(cloud, building, spoil, rng)
    return replace(cloud, rooms=()), shift


def upper(cloud: PointCloud, building: Building, rng: np.random.Generator) -> PointCloud:
    """The upper half of rooms, as somebody with a tablet captures it; no point lies in the joints of the ceiling's panels."""
    floor = building.storeys["floor"]
    storey = np.clip(np.searchsorted(floor - 0.3, cloud.points[:, 2]) - 1, 0, None)
    height = cloud.points[:, 2] - floor[storey]
    panel, joint = rng.choice([0.6, 0.625, 1.2, 2.4], 2), rng.uniform(0.0, 0.12)
    gap = (np.mod(cloud.points[:, :2] - rng.uniform(0, 1, 2), panel) < joint).any(axis=1) & (height > 2.2)
    kept = (height > rng.uniform(0.9, 1.6)) & ~gap
    pose_of = None if cloud.pose_of is None else cloud.pose_of[kept]
    return replace(cloud, points=cloud.points[kept], labels=None, pose_of=pose_of)


def drawn(building: Building, visited: Array, rng: np.random.Generator) -> PointCloud:
    """A grid map of the visited rooms, as robots and draughtsmen make them, its walls raised as those of a file are."""
    room, truth, low = truth_rasters(building, 0)
    thin = float(rng.uniform(0.1, 0.3))
    solid = near(np.isin(room, visited), thin) & np.isin(truth, (TRUTHS.index("wall"), TRUTHS.index("shut")))
    free = np.isin(room, visited) | (truth == TRUTHS.index("doorway")) & near(np.isin(room, visited), 0.3)
    legs = rng.random() < 0.6  # a laser sees the legs of tables, a draughtsman the tables
    for thing in building.things[~np.isin(building.things["kind"], HUNG)]:
        if thing["centre"][2] - thing["size"][2] / 2 < building.storeys["floor"][0] + LOW:
            for box in footprints(thing, legs and thing["kind"] in ("desk", "meeting", "dining", "table", "chair")):
                fill(solid, (box - low) / FINE, 1)
    solid &= near(np.isin(room, visited), 0.3)
    solid |= free & (rng.random(free.shape) < rng.choice([0.0, 0.002]))
    levels = np.arange(0.0, 2.4 + 1e-6, 0.1)
    walls, floor = ((np.argwhere(m)[:, ::-1] + 0.5) * FINE + low for m in (solid, free & ~solid))
    points = np.column_stack([np.repeat(walls, len(levels), axis=0), np.tile(levels, len(walls))])
    points = np.concatenate([points, np.column_stack([floor, np.zeros(len(floor))])])
    return PointCloud((points + [0, 0, building.storeys["floor"][0]]).astype(np.float32))


def footprints(thing: Any, legs: bool) -> list[Array]:
    """What stands on the floor: rectangles (4, 2)."""
    half = thing["size"][:2] / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    boxes = [corners * half]
    if legs and half.max() > 0.3:
        leg = np.minimum(0.05, half)
        boxes = [corners * leg + c * (half - leg) for c in corners]
    turn = Sim3(float(thing["yaw"])).matrix[:2, :2]
    return [box @ turn.T + thing["centre"][:2] for box in boxes]


def near(mask: Array, reach: float) -> Array:
    """Cells of a fine raster that are no further from a mask than this."""
    from scipy import ndimage

    return np.asarray(ndimage.distance_transform_edt(~mask) * FINE <= reach) if mask.any() else mask


def storeys_of(cloud: PointCloud, edge: float) -> list[tuple[StoreyPlan, Array]]:
    """The plans of a scan as the extraction makes them, and the places (nx, ny, 3) of their columns' floors."""
    p = PRESETS["default"]
    scan, navigable = navigable_volume(with_raised_slice(read_scan(cloud, edge, p.sparse)), p)
    grid = scan.grid
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, p.standing_height))
    out = []
    for k in range(len(storeys)):
        if (storey == k).any():
            plan = storey_plan(grid, navigable, storey, k)
            low, base = columns_of(plan, grid)
            columns = np.stack(np.meshgrid(*(np.arange(n) for n in plan.wall.shape), indexing="ij"), axis=-1) + low
            cells = np.concatenate([columns, np.full((*plan.wall.shape, 1), np.median(base))], axis=-1)
            out.append((plan, grid.origin + (cells + 0.5) * grid.edge))
    return out


def truth_of(building: Building, plan: StoreyPlan, places: Array, frame: Sim3, shift: Any) -> tuple[Array, Array]:
    """True room and `TRUTHS` of each column of a plan."""
    from scipy.spatial import cKDTree

    at = frame.inverse().apply(places.reshape(-1, 3))
    if shift is not None:
        at = at + shift[1][cKDTree(shift[0]).query(at)[1]]
    floors = building.storeys["floor"]
    storey = int(np.argmin(np.abs(floors - np.median(at[:, 2]))))
    room, truth, low = truth_rasters(building, storey)
    ij = np.floor((at[:, 1::-1] - low[::-1]) / FINE).astype(np.int64)
    ok = ((ij >= 0) & (ij < room.shape)).all(axis=1)
    of = np.full(len(at), -1, np.int16), np.full(len(at), TRUTHS.index("outside"), np.uint8)
    for values, raster in zip(of, (room, truth), strict=True):
        values[ok] = raster[tuple(ij[ok].T)]
    return of[0].reshape(plan.wall.shape), of[1].reshape(plan.wall.shape)


def truth_rasters(building: Building, storey: int) -> tuple[Array, Array, Array]:
    """(rows, columns) true room and index into `TRUTHS` of a storey, in cells of `FINE`, and their origin (m)."""
    floor = building.storeys["floor"][storey]
    rooms = {i: r.polygon for i, r in enumerate(building.rooms) if abs(r.floor - floor) <= LEVEL}
    corners = np.concatenate(list(rooms.values()))
    low = corners.min(axis=0) - 2.0
    columns, rows = np.ceil((corners.max(axis=0) + 2.0 - low) / FINE).astype(int)
    room = np.full((rows, columns), -1, np.int16)
    for i, polygon in rooms.items():
        fill(room, (polygon - low) / FINE, i)
    truth = np.full(room.shape, TRUTHS.index("outside"), np.uint8)
    truth[near(room >= 0, WALL)] = TRUTHS.index("wall")
    truth[room >= 0] = TRUTHS.index("inside")
    for door in building.doors[np.abs(building.doors["centre"][:, 2] - floor) <= LEVEL]:
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
        along = np.array([-normal[1], normal[0]]) * door["width"] / 2
        deep = normal * (max(float(door["thickness"]), 0.15) / 2 + 0.05)
        box = door["centre"][:2] + np.array([along + deep, along - deep, -along - deep, deep - along])
        fill(truth, (box - low) / FINE, TRUTHS.index("shut" if door["state"] == "shut" else "doorway"))
    return room, truth, low


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", choices=list(SEEDS), required=True, help="who learns from them")
    parser.add_argument("--scans", type=int, default=300)
    arguments = parser.parse_args()
    gather(arguments.scans, SEEDS[arguments.of])
