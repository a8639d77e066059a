"""Scans that learned parts of the extraction are trained with: an item is a seed, and the real plan that it draws, if any.

All sensors, several difficulties, spoilt points, and grid maps drawn from the plans with furniture in them, as robots make them;
most of them turned.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.profiles import BUILDING_KINDS
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.items import digest
from topomerge.datasets.pairs.plan_truth import drawn_map
from topomerge.datasets.pairs.robot_grid import robot_grid
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.spoils import drift_between, exact_sensor, spoilt, upper_half
from topomerge.datasets.simulation.walk import part

from topomerge.io.listing import plain
from topomerge.types import Array, PointCloud, Sim3

PLAN_FORMAT = 3  # raise it when the same item gives other bytes: it is part of the files' names
SOURCE_SHARES = {"procedural": 0.55, "r2v": 0.3, "campus": 0.15}
SENSOR_SHARES = {"tls": 0.16, "lidar": 0.16, "depth": 0.12, "tablet": 0.12, "mono": 0.08, "laser2d": 0.2, "drawn": 0.16}
# Of what robots and draughtsmen leave: grids of 2D lasers, drawings, and slices.
FLAT_SOURCE_SHARES = {"procedural": 0.35, "r2v": 0.5, "campus": 0.15}
FLAT_SENSOR_SHARES = {"robot": 0.5, "drawn": 0.3, "laser2d": 0.2}
SPOIL_SHARES = {"": 0.48, "sparse": 0.16, "noise": 0.1, "below2": 0.1, "drift": 0.06, "above": 0.1}  # above: no lower half
ROOMS_VISITED = (4, 9)  # at least, less than
Plans = Mapping[str, Sequence[tuple[str, Plan]]]


@dataclass(frozen=True)
class PlanItem:
    """Everything that the bytes of one file depend on: the seed, where the building is from, of how many plans one was drawn,
    which, and its digest; and is it a slice, a grid or a drawing?"""

    seed: int
    source: str
    candidates: int
    plan: str
    digest: str
    flat: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of the plans that are made from them."""
        return self.named(PLAN_FORMAT)

    def named(self, version: int) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return hashlib.sha256(json.dumps([version, plain(asdict(self))], sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan of an item.

    Args:
        visited: (n,) rooms that the surveyor was in.
        cloud: in the building's frame.
        shift: places of it with what undoes its drift there; None: it has none.
        frame: in which it is looked at.
    """

    building: Building
    sensor: str
    visited: Array
    cloud: PointCloud
    shift: Any
    frame: Sim3


def scan_of_item(item: PlanItem, plan: Plan | None) -> SimulatedScan:
    """Simulate the scan of an item.

    Args:
        plan: the real plan that it names; None: its building is procedural.
    """
    seed = item.seed
    rng = np.random.default_rng(seed)
    difficulty = draw_difficulty(rng)
    source, sensor = draw_source(rng, item.flat)
    if plan is not None:
        rng.integers(item.candidates)  # which plan: drawn already
        building = erect([plan], difficulty, rng, f"{source}-{seed}")
    else:
        floors = 1 if sensor in FLAT_SENSOR_SHARES else int(rng.choice([1, 1, 1, 2]))
        building = make_building(str(rng.choice(BUILDING_KINDS)), seed, floors, difficulty)
    visited = part(building, int(rng.integers(*ROOMS_VISITED)), rng)
    if sensor == "drawn":
        cloud, shift = drawn_map(building, visited, rng), None
    elif sensor == "robot":
        cloud, shift = replace(robot_grid(building, get_sensor("laser2d"), visited, rng, Sim3()), rooms=(), labels=None), None
    else:
        cloud, shift = scanned(building, sensor, visited, rng, seed)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    return SimulatedScan(building, sensor, visited, cloud, shift, frame)


def draw_item(seed: int, plans: Plans, flat: bool = False) -> PlanItem:
    """The item of a seed; `make_examples` draws the same numbers again.

    Args:
        flat: a slice, a robot's grid or a drawing.
    """
    rng = np.random.default_rng(seed)
    draw_difficulty(rng)
    source, _ = draw_source(rng, flat)
    entries = plans.get(source, ())
    if not entries:
        return PlanItem(seed, "procedural", 0, "", "", flat)
    name, plan = entries[int(rng.integers(len(entries)))]
    return PlanItem(seed, source, len(entries), name, digest((plan,)), flat)


def draw_source(rng: np.random.Generator, flat: bool) -> tuple[str, str]:
    """Where a building is from, and by which sensor it is seen."""
    sources, sensors = (FLAT_SOURCE_SHARES, FLAT_SENSOR_SHARES) if flat else (SOURCE_SHARES, SENSOR_SHARES)
    source = str(rng.choice(list(sources), p=list(sources.values())))
    return source, str(rng.choice(list(sensors), p=list(sensors.values())))


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
    spoil = str(rng.choice(list(SPOIL_SHARES), p=list(SPOIL_SHARES.values()))) if sensor.beams != 1 and name != "mono" else ""
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
        straight = scan(building, exact_sensor(sensor), visited, np.random.default_rng(seed), budget=8)
        shift = drift_between(cloud, straight)
    cloud = upper_half(cloud, building, rng) if spoil == "above" else spoilt(cloud, building, spoil, rng)
    return replace(cloud, rooms=()), shift
