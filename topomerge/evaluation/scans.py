"""Scans that rooms, doors and walls are measured on: simulated or read, made once, and kept with what is true of them."""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from topomerge.archive import replace_on_success
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building, Difficulty, find_physical_building
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.pairs.parts import sample_two_parts
from topomerge.datasets.plans.sealed import refuse_file
from topomerge.datasets.real.robot_homes import compute_home_truth
from topomerge.datasets.simulation.floor_truth import TRUTH_CELL, FloorTruth, build_truth, transform_truth
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.sensors import corrupt_cloud, get_sensor, measure_drift, remove_sensor_drift
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.walk import sample_part
from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.types import Array, PointCloud, TopometricMap, TrueRoom, VoxelGrid

SCAN_FORMAT = 4  # raise it when the same case gives other bytes
EDITED_SOURCE = "edited"
COMMON = 0.6  # share of the rooms that the two sessions of a pair have in common
ADRIFT = 1.5  # degrees about every 15 m: three times a hand-held camera's
IPA, IPA_CELL = "grids_ipa_room_segmentation", 0.05
IPA_ABOUT = "image: {image}\nresolution: {cell}\norigin: [0, 0, 0]\noccupied_thresh: 0.0197\nfree_thresh: 0.0197\nnegate: 0\n"
HOMES_FOLDER = "homes_vacuum_robots"
GDC = "utexas_gdc_floors/maps/real"


@dataclass(frozen=True)
class Case:
    """One map that is made.

    Args:
        set: the row of the tables that it belongs to.
        source: edited (a file of `datasets.pairs.edited_truth`; its digest is the seed);
            procedural; r2v, campus, mall, rmf, ipa-plan (plans that are erected and scanned); ifc (models, scanned); ipa, gdc
            (grids, raised); home (vacuum robots' maps); file (anything that can be read; nothing is true about it).
        building: kind of procedural building, or name of the plan, model, grid or file.
        seed: of the building and of the walk.
        rooms: rooms to visit; 0: all.
        difficulty: what differs from the defaults.
        spoil: what is done to the points: sparse, noise, below2, drift.
        day: 1 and 2 are two sessions in one building that have 60 % of their rooms in common; 0: there is one only.
        spacing: m between points; 0: the sensor's.
    """

    set: str
    source: str
    building: str
    sensor: str = ""
    seed: int = 0
    storeys: int = 1
    rooms: int = 0
    difficulty: tuple[tuple[str, float], ...] = ()
    spoil: str = ""
    day: int = 0
    spacing: float = 0.0

    @property
    def place(self) -> str:
        """The physical building that it is a map of: what intervals are drawn over."""
        title = f"{self.building}-{self.seed}" if self.source == "procedural" else self.building
        return find_physical_building(self.source, title)

    @property
    def name(self) -> str:
        """For people and file names."""
        *above, plan = Path(self.building).parts
        plan = plan if self.source != "r2v" else f"{above[-1][-6:]}_{plan}"
        source = self.source if self.source != "procedural" else ""
        parts = [self.set, source, plan, self.seed or "", self.sensor, self.spoil, f"day{self.day}" if self.day else ""]
        return re.sub(r"[^\w.-]+", "_", "-".join(str(w) for w in parts if w))

    @property
    def key(self) -> str:
        """Hash of what the bytes of the scan depend on."""
        same = {"set": "", "thin": 0.0, "turn": 0.0, "shuffle": False, "voxel": 0.0}  # of fields that there were
        inputs = {**asdict(self), **same, "format": SCAN_FORMAT}
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud and what is true about it (None: nothing is), with the true rooms in the building's frame."""

    cloud: PointCloud
    truth: FloorTruth | None
    rooms: tuple[TrueRoom, ...]


def load_scan(case: Case, folder: Path, data: Path | None) -> Scan:
    """Load the scan of a case, from the cache where it has it."""
    path = folder / f"{case.key}.npz" if case.source != EDITED_SOURCE else Path(case.building)
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        scan = make_scan(case, data)
        with replace_on_success(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, **_build_arrays(scan))
    with np.load(path, allow_pickle=False) as file:
        return _build_scan(dict(file))


def _build_arrays(scan: Scan) -> dict[str, Array]:
    cloud, truth = scan.cloud, scan.truth
    out: dict[str, Array] = {"points": cloud.points, "shift": cloud.shift, "source": np.array(cloud.source)}
    if cloud.poses is not None and cloud.pose_of is not None:
        out |= {"poses": cloud.poses, "pose_of": cloud.pose_of}
    if cloud.colors is not None:
        out["colors"] = cloud.colors
    if cloud.free is not None:
        out |= {"free": cloud.free.cells, "free_origin": cloud.free.origin, "free_edge": np.array(cloud.free.edge)}
    if truth is not None:
        out |= {f"truth.{name}": np.asarray(value) for name, value in vars(truth).items()}
    rooms = [{**asdict(r), "polygon": np.round(r.polygon, 4).tolist()} for r in scan.rooms]
    return out | {"rooms": np.array(json.dumps(rooms))}


def _build_scan(arrays: dict[str, Array]) -> Scan:
    free = None
    if "free" in arrays:
        free = VoxelGrid.from_cells(arrays["free"], arrays["free_origin"], float(arrays["free_edge"]))
    cloud = PointCloud(
        arrays["points"],
        colors=arrays.get("colors"),
        shift=arrays["shift"],
        poses=arrays.get("poses"),
        pose_of=arrays.get("pose_of"),
        free=free,
        source=str(arrays["source"]),
    )
    truth = {k.removeprefix("truth."): v for k, v in arrays.items() if k.startswith("truth.")}
    rooms = tuple(TrueRoom(**{**r, "polygon": np.array(r["polygon"])}) for r in json.loads(str(arrays["rooms"])))
    return Scan(cloud, FloorTruth(**truth) if truth else None, rooms)


def make_scan(case: Case, data: Path | None) -> Scan:
    """Simulate or read the scan of a case.

    Raises:
        InputError: the real data that it needs is not there, or can't be read.
    """
    if case.source == "procedural":
        return simulate_case(case, make_building(case.building, case.seed, case.storeys, Difficulty(**dict(case.difficulty))))
    if data is None:
        raise InputError("set TOPOMERGE_DATA to the folder of the real data")
    if case.source == "ipa":
        with tempfile.TemporaryDirectory() as folder:  # only white is free in these images: walls may be light grey
            about = Path(folder) / f"{case.building}.yaml"
            about.write_text(IPA_ABOUT.format(image=(data / IPA / f"{case.building}.png").resolve(), cell=IPA_CELL))
            return raise_grid(case, about, _find_ipa_plan(case.building, data))
    if case.source == "gdc":
        floor = data / GDC / case.building
        return raise_grid(case, floor / f"{case.building}.yaml", floor / "locations.yaml")
    if case.source == "home":
        path = data / HOMES_FOLDER / f"{case.building}.json"
        cloud = read_points(path)
        return Scan(cloud, *compute_home_truth(path, cloud.points.astype(np.float64) + cloud.shift))
    if case.source == "file":
        path = data / case.building
        refuse_file(path)
        grid = path.suffix == ".png"
        return Scan(read_points(path, resolution=IPA_CELL if grid else None), None, ())
    if case.source == "ifc":
        from topomerge.datasets.real.ifc import load_model_building

        return simulate_case(case, load_model_building(data / "ifc_buildings" / f"{case.building}.ifc"))
    from topomerge.datasets.buildings.construction import build_building

    plan = find_plan(case.source, case.building, data)
    return simulate_case(
        case, build_building([plan], Difficulty(**dict(case.difficulty)), case.seed, name=case.building, kind=case.source)
    )


def _find_ipa_plan(name: str, data: Path) -> Path:
    """Return the true rooms of a grid, furnished or not."""
    stem = name.removesuffix("_trashbins").removesuffix("_furnitures")
    return data / IPA / f"{stem}_gt_segmentation.png"


@lru_cache(maxsize=64)
def find_plan(source: str, name: str, data: Path) -> Any:
    """Return the plan of that name."""
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans, read_plans
    from topomerge.datasets.plans.splits import FOLDERS

    if source == "ipa-plan":
        return read_plans(_find_ipa_plan(name, data))[0]
    plans = data / FOLDERS[source]
    if source == "r2v":
        return read_plans(f"{plans / 'r2v_annotations.tar.xz'}::{name}")[0]
    if source == "campus":
        return read_plans(next(plans.glob(f"{name}.xml"), plans / f"{name}_updated.xml"))[0]
    return next(plan for n, plan in iter_plans(plans) if n == name and not isinstance(plan, Refusal))


def raise_grid(case: Case, grid: Path, plan: Path) -> Scan:
    """Return a robot's grid with its walls raised, and the rooms and doors of its plan. GDC's list of rooms is not complete."""
    from topomerge.datasets.buildings.construction import build_building
    from topomerge.datasets.plans.floorplans import read_plans

    cloud = read_points(grid)
    building = build_building(read_plans(plan), name=case.building, kind=case.source)
    every = np.ones(len(building.rooms), bool)
    points = cloud.points.astype(np.float64) + cloud.shift
    return Scan(cloud, build_truth(building, every, points, complete=case.source != "gdc"), building.rooms)


def simulate_case(case: Case, building: Building) -> Scan:
    """Walk through a building and scan it; the scan is in a frame of its own, turned by any angle."""
    seed = [case.seed, 1, case.day]
    rng = np.random.default_rng(seed)
    if case.day:
        building = simulate_session(building, Difficulty(**dict(case.difficulty)), rng)
    visited = _select_visited(case, building)
    sensor = get_sensor(case.sensor)
    if case.spoil == "drift":
        sensor = replace(sensor, drift=ADRIFT)
    spacing = case.spacing or None
    cloud = scan_building(building, sensor, visited, np.random.default_rng(seed), spacing)
    straight = scan_building(
        building, remove_sensor_drift(sensor), visited, np.random.default_rng(seed), budget=8
    )  # poses come before rays
    cloud = corrupt_cloud(cloud, building, case.spoil, rng)
    anchors, drift = (
        measure_drift(cloud, straight) if remove_sensor_drift(sensor) != sensor else (np.zeros((0, 3)), np.zeros((0, 3)))
    )
    truth = build_truth(building, np.isin(np.arange(len(building.rooms)), visited), cloud.points, anchors, drift)
    frame = draw_frames(1, False, np.random.default_rng([*seed, 3]))[0]
    return Scan(replace(transform_cloud(cloud, frame), rooms=()), transform_truth(truth, frame), building.rooms)


def _select_visited(case: Case, building: Building) -> Array:
    """Select the rooms that the surveyor goes into: those asked for, and of several parts of a building the one with most
    rooms."""
    rng = np.random.default_rng([case.seed, 2])
    if case.day:
        return sample_two_parts(building, case.rooms, COMMON, rng)[case.day - 1]
    if case.rooms:
        return sample_part(building, case.rooms, rng)
    inside = np.array([i for i, r in enumerate(building.rooms) if r.kind != "lift"])
    parts = building.find_components()[inside]
    return inside[parts == np.bincount(parts).argmax()]


WIDE = 13.0  # inches


def save_picture(scan: Scan, map: TopometricMap, columns: Array, verdict: Any, title: str, path: Path) -> None:
    """Draw one panel a storey, in the frame of the building."""
    truth = scan.truth
    assert truth is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context():
        mpl.rcdefaults()
        levels, rows, width = columns.shape
        figure = Figure(figsize=(WIDE, levels * (WIDE * rows / width + 0.3) + 0.5))
        FigureCanvasAgg(figure)
        points = truth.transform_to_building(scan.cloud.points.astype(np.float64) + scan.cloud.shift)
        for k, axes in enumerate(figure.subplots(levels, 1, squeeze=False).ravel()):
            draw_storey(axes, scan, map, columns[k], k, verdict, points)
        figure.suptitle(title, fontsize=9)
        figure.tight_layout()
        with replace_on_success(path) as temporary:
            figure.savefig(temporary, format="png", dpi=80)


def draw_storey(axes: Any, scan: Scan, map: TopometricMap, labels: Array, k: int, verdict: Any, points: Array) -> None:
    """Draw a storey: its points, rooms and doors, found and true."""
    truth = scan.truth
    assert truth is not None
    high, (x, y) = truth.origin + np.array(labels.shape[::-1]) * TRUTH_CELL, truth.origin
    extent = (x, high[0], y, high[1])
    image = np.full((*labels.shape, 3), 255, np.uint8)
    if len(map.rooms):
        image[labels >= 0] = assign_room_colours(map)[labels[labels >= 0]]
    z = points[:, 2] - truth.floors[k]
    ij, inside = truth.compute_columns(points[(z > 0.4) & (z < 1.9)])
    dark = np.bincount(ij[inside, 0] * labels.shape[1] + ij[inside, 1], minlength=labels.size).reshape(labels.shape)
    image[dark > (min(np.percentile(dark[dark > 0], 60), dark.max() - 1) if dark.any() else 0)] //= 2
    axes.imshow(image, origin="lower", extent=extent, interpolation="nearest")
    for i, room in enumerate(scan.rooms):
        if room.storey == k:
            requested = bool(truth.visited[i])
            ring = np.concatenate([room.polygon, room.polygon[:1]])
            axes.plot(*ring.T, color="#c00000" if requested else "#999999", linewidth=1.0, linestyle="-" if requested else ":")
            if requested:
                value = verdict.rooms.each[i]
                at = shapely.get_coordinates(shapely.Polygon(room.polygon).buffer(0).point_on_surface())[0]
                axes.text(*at, f"{value:.2f}", fontsize=6, ha="center", color="red" if value < 0.5 else "black", clip_on=True)
    edges = map.edges
    at = truth.transform_to_building(edges["centre"])
    near = np.abs(at[:, 2] - truth.floors[k]) < 1.5
    doors = truth.doors[np.abs(truth.doors[:, 4] - truth.floors[k]) < 1.0]
    axes.scatter(doors[:, 2], doors[:, 3], s=70, facecolors="none", edgecolors="green", linewidths=1.5)
    axes.scatter(*at[near, :2].T, s=12, color="black")
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    axes.tick_params(labelsize=6)
