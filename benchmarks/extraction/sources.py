"""Makes the scans of the extraction's benchmark: simulated in procedural, erected and modelled buildings, or read from files."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.pairs.parts import two_parts
from topomerge.datasets.plans.sealed import refuse_file
from topomerge.datasets.real.robot_homes import home_truth
from topomerge.datasets.simulation.floor_truth import in_frame, truth_of
from topomerge.datasets.simulation.scanner import moved, scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.session import session
from topomerge.datasets.simulation.spoils import drift_between, exact_sensor, spoilt
from topomerge.datasets.simulation.walk import part

from benchmarks.extraction.scans import Case, Scan
from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array

COMMON = 0.6  # share of the rooms that the two sessions of a pair have in common
ADRIFT = 1.5  # degrees about every 15 m: three times a hand-held camera's
IPA, IPA_CELL = "grids_ipa_room_segmentation", 0.05
IPA_ABOUT = "image: {image}\nresolution: {cell}\norigin: [0, 0, 0]\noccupied_thresh: 0.0197\nfree_thresh: 0.0197\nnegate: 0\n"
HOMES_FOLDER = "homes_vacuum_robots"
GDC = "utexas_gdc_floors/maps/real"


def make(case: Case, data: Path | None) -> Scan:
    """Simulate or read the scan of a case.

    Raises:
        InputError: the real data that it needs is not there, or can't be read.
    """
    if case.source == "procedural":
        return simulated(case, make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty))))
    if data is None:
        raise InputError("set TOPOMERGE_DATA to the folder of the real data")
    if case.source == "ipa":
        with tempfile.TemporaryDirectory() as folder:  # only white is free in these images: walls may be light grey
            about = Path(folder) / f"{case.building}.yaml"
            about.write_text(IPA_ABOUT.format(image=(data / IPA / f"{case.building}.png").resolve(), cell=IPA_CELL))
            return raised(case, about, _ipa_plan(case.building, data))
    if case.source == "gdc":
        folder = data / GDC / case.building
        return raised(case, folder / f"{case.building}.yaml", folder / "locations.yaml")
    if case.source == "home":
        path = data / HOMES_FOLDER / f"{case.building}.json"
        cloud = read_points(path)
        return Scan(cloud, *home_truth(path, cloud.points.astype(np.float64) + cloud.shift))
    if case.source == "file":
        path = data / case.building
        refuse_file(path)
        grid = path.suffix == ".png"
        return Scan(read_points(path, resolution=IPA_CELL if grid else None), None, ())
    if case.source == "ifc":
        from topomerge.datasets.real.ifc import model_building

        return simulated(case, model_building(data / "ifc_buildings" / f"{case.building}.ifc"))
    from topomerge.datasets.buildings.erect import erect

    plan = plan_of(case.source, case.building, data)
    return simulated(case, erect([plan], Difficulty(**dict(case.difficulty)), case.seed, name=case.building, kind=case.source))


def _ipa_plan(name: str, data: Path) -> Path:
    """The true rooms of a grid, furnished or not."""
    stem = name.removesuffix("_trashbins").removesuffix("_furnitures")
    return data / IPA / f"{stem}_gt_segmentation.png"


@lru_cache(maxsize=64)
def plan_of(source: str, name: str, data: Path) -> Any:
    """The plan of that name."""
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans, read_plans
    from topomerge.datasets.plans.splits import FOLDERS

    if source == "ipa-plan":
        return read_plans(_ipa_plan(name, data))[0]
    folder = data / FOLDERS[source]
    if source == "r2v":
        return read_plans(f"{folder / 'r2v_annotations.tar.xz'}::{name}")[0]
    if source == "campus":
        return read_plans(next(folder.glob(f"{name}.xml"), folder / f"{name}_updated.xml"))[0]
    return next(plan for n, plan in iter_plans(folder) if n == name and not isinstance(plan, Refusal))


def raised(case: Case, grid: Path, plan: Path) -> Scan:
    """A robot's grid with its walls raised, and the rooms and doors of its plan. GDC's list of rooms is not complete."""
    from topomerge.datasets.buildings.erect import erect
    from topomerge.datasets.plans.floorplans import read_plans

    cloud = read_points(grid)
    building = erect(read_plans(plan), name=case.building, kind=case.source)
    every = np.ones(len(building.rooms), bool)
    points = cloud.points.astype(np.float64) + cloud.shift
    return Scan(cloud, truth_of(building, every, points, complete=case.source != "gdc"), building.rooms)


def simulated(case: Case, building: Building) -> Scan:
    """Walk through a building and scan it; the scan is in a frame of its own, turned by any angle."""
    seed = [case.seed, 1, case.day]
    rng = np.random.default_rng(seed)
    if case.day:
        building = session(building, Difficulty(**dict(case.difficulty)), rng)
    visited = _visited(case, building)
    sensor = replace(get_sensor(case.sensor), shades=case.shades)
    if case.spoil == "drift":
        sensor = replace(sensor, drift=ADRIFT)
    spacing = case.spacing or None
    cloud = scan(building, sensor, visited, np.random.default_rng(seed), spacing)
    straight = scan(building, exact_sensor(sensor), visited, np.random.default_rng(seed), budget=8)  # poses come before rays
    cloud = spoilt(cloud, building, case.spoil, rng)
    anchors, drift = drift_between(cloud, straight) if exact_sensor(sensor) != sensor else (np.zeros((0, 3)), np.zeros((0, 3)))
    truth = truth_of(building, np.isin(np.arange(len(building.rooms)), visited), cloud.points, anchors, drift)
    frame = draw_frames(1, False, np.random.default_rng([*seed, 3]))[0]
    return Scan(replace(moved(cloud, frame), rooms=()), in_frame(truth, frame), building.rooms)


def _visited(case: Case, building: Building) -> Array:
    """Rooms that the surveyor goes into: those asked for, and of several parts of a building the one with most rooms."""
    rng = np.random.default_rng([case.seed, 2])
    if case.day:
        return two_parts(building, case.rooms, COMMON, rng)[case.day - 1]
    if case.rooms:
        return part(building, case.rooms, rng)
    inside = np.array([i for i, r in enumerate(building.rooms) if r.kind != "lift"])
    parts = building.parts()[inside]
    return inside[parts == np.bincount(parts).argmax()]
