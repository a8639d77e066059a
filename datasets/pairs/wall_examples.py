"""Walls unrolled as the extraction sees them, with what is truly in them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.layouts import BUILDING_KINDS
from topomerge.datasets.buildings.openings import list_windows
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import BuildReport, BuildRow, BuildSettings, make_item
from topomerge.datasets.core.building import Building, Plan
from topomerge.datasets.pairs.drawing import simulate_grid_map
from topomerge.datasets.pairs.flat_maps import compute_cells, encode_rows
from topomerge.datasets.pairs.items import compute_plan_digest, select_points
from topomerge.datasets.pairs.plan_examples import (
    LONGEST_SCAN,
    PlanItem,
    PlanRecipe,
    Plans,
    build_scans,
    draw_difficulty,
    scan_with_drift,
)
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.sensors import get_sensor, measure_drift, remove_sensor_drift
from topomerge.datasets.simulation.walk import sample_part

from topomerge import archive
from topomerge.archive import convert_to_plain
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import ALONG, DEPTHS, FACE_DTYPE, STRIP_CHANNELS, WALL_CLASSES, Elevations
from topomerge.extraction.extract import cut_rooms, read_navigable
from topomerge.extraction.parameters import PRESETS, DefaultParameters
from topomerge.extraction.plans.storey_plan import ClassifiedStorey
from topomerge.extraction.scan import FINE_CELL
from topomerge.extraction.topology import build_topometric_map
from topomerge.extraction.voxels import voxelise
from topomerge.progress import Stopwatch
from topomerge.types import ROOM_DTYPE, Array, LogFn, PointCloud, Sim3, TopometricMap, VoxelGrid

CUPBOARDS = ("shelf", "cabinet", "wardrobe", "kitchen", "locker")  # kinds of furniture that stand before walls
LEAST_CUPBOARD = 0.75  # m, height
IN_ROOM = 0.1  # m behind a face, at most, is the front of what stands in its room
DEEP = 0.3  # m beside a wall's middle: a strip there is of that wall
ASKEW = 0.26  # sine of the angle between a wall and a strip along it
SAME_FLOOR = 0.6  # m between floors of one storey
DOOR_STATES = {"open": ("open", "none"), "half": ("half",), "shut": ("shut",)}  # of each class


def compute_true_classes(building: Building, walls: Elevations, frame: Sim3, shift: tuple[Array, Array] | None) -> Array:
    """Compute (n,) uint8 index into `WALL_CLASSES` of each place along the walls.

    Args:
        frame: of the map in which the walls are.
        shift: places of the building that drift bent, and what undoes it there (None: none did).
    """
    truth = np.zeros(int(walls.first[-1]), np.uint8)
    if not len(truth):
        return truth
    place = np.arange(len(truth)) - np.repeat(walls.first[:-1], np.diff(walls.first))
    face = walls.faces[np.repeat(np.arange(len(walls.faces)), np.diff(walls.first))]
    at = face["start"] + (place + 0.5)[:, None] * ALONG * face["along"]
    corners = (at, at + 0.01 * face["along"], at + 0.01 * face["out"])
    ends = [frame.inverse().apply(np.column_stack([p, face["floor"]])) for p in corners]
    if shift is not None:
        undone = shift[1][cKDTree(shift[0]).query(ends[0])[1]]
        ends = [p + undone for p in ends]
    at, along, out = ends[0], (ends[1] - ends[0])[:, :2] / 0.01, (ends[2] - ends[0])[:, :2] / 0.01
    holes_of = {"cupboard": list_cupboards(building), "niche": list_niches(building), "window": list_windows(building)}
    holes_of |= {name: _list_doors(building, states) for name, states in DOOR_STATES.items()}
    for name, holes in holes_of.items():
        for x, y, z, direction, width, thickness in holes:
            normal = np.array([np.cos(direction), np.sin(direction)])
            off = at[:, :2] - (x, y)
            across, aside = np.abs(off @ normal), np.abs(off @ (-normal[1], normal[0]))
            within = (across < thickness / 2 + DEEP) & (aside < width / 2) & (np.abs(along @ normal) < ASKEW)
            if name == "niche":  # the wall's other face does not show it
                within &= out @ normal > 0
            elif name == "cupboard":  # nor what stands behind the wall
                within &= -(off * out).sum(axis=1) < thickness / 2 + IN_ROOM
            truth[within & (np.abs(at[:, 2] - z) < SAME_FLOOR)] = WALL_CLASSES.index(name)
    return truth


def list_cupboards(building: Building) -> Sequence[tuple[float, ...]]:
    """List, as `_list_doors`, the furniture that stands before walls and is as high as a table or higher."""
    things = building.things
    tall = np.isin(things["kind"], CUPBOARDS) & (things["size"][:, 2] >= LEAST_CUPBOARD)
    rows = []
    for thing in things[tall]:
        x, y, z = thing["centre"].tolist()
        wide, deep, high = thing["size"].tolist()
        rows.append((x, y, z - high / 2, float(thing["yaw"]) + np.pi / 2, wide, deep))
    return rows


def list_niches(building: Building) -> Sequence[tuple[float, ...]]:
    """List, as `_list_doors`, the recesses of walls."""
    return [(*n["centre"].tolist(), float(n["direction"]), float(n["width"]), float(n["depth"])) for n in building.niches]


def _list_doors(building: Building, states: Sequence[str]) -> Sequence[tuple[float, ...]]:
    """List the middle on the floor (m), direction of the normal (rad), width and thickness (m) of the doors that stand so."""
    doors = building.doors[np.isin(building.doors["state"], states)]
    return [(*d["centre"].tolist(), *(float(d[k]) for k in ("direction", "width", "thickness"))) for d in doors]


WALL_FORMAT = 9  # raise it when the same item gives other bytes: it is part of the files' names
SOURCE_SHARES = {"procedural": 0.6, "r2v": 0.25, "campus": 0.15}
SENSOR_SHARES = {"tls": 0.35, "depth": 0.25, "lidar": 0.2, "tablet": 0.12, "mono": 0.08}
MAP_CELL = 0.1  # m
ROOMS_VISITED = (4, 11)  # at least, less than
FINER = (0.5, 1.0)  # of a sensor's spacing
COARSE_SHARE = 0.15  # of the scans that are seen in the cells of the map
DRAWN_EVERY = 8  # seeds: one is a grid map of the plan, as robots and draughtsmen make them
EXACT_SHARE = 0.5  # of the scans without drift
FRAMES, FRAMELESS = (0.3, 1.0), (0.0, 0.8)  # share of the doors with a frame and handles
SLICE_SHARE, POSED_SHARE = 0.6, 0.6  # of flat maps by a 2D laser, and of these with the sensor's places
LOST_BY_CHANCE, SHARE_LEFT = 0.5, (0.03, 0.3)
SPACING_LEFT = (0.05, 0.2)  # m
NICHES = 0.25  # share of the longer walls with a recess, at most
WALL_ARRAYS = ("first", "strips", "truth", "doors", "faces")
MAP_ARRAYS, ROOMS_HELD = ("edges", "storeys", "navigable_room"), ("storey", "completeness")
NO_WALLS = Elevations(np.zeros(0, FACE_DTYPE), np.zeros(1, np.int64), np.zeros((0, DEPTHS, STRIP_CHANNELS), np.float32))


@dataclass(frozen=True)
class WallItem(PlanItem):
    """As of plans: all that the bytes of one file depend on; is it a slice or a grid map, does it lose most of its points,
    and do its doors mostly have no frame?"""

    flat: bool = False
    sparse: bool = False
    frameless: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return hashlib.sha256(
            json.dumps(["walls", WALL_FORMAT, convert_to_plain(asdict(self))], sort_keys=True).encode()
        ).hexdigest()[:24]


@dataclass(frozen=True, eq=False)
class WallExample:
    """The walls of one scan, with what is true about them.

    Args:
        first: (F + 1,) the first place of each wall.
        strips: (n, 32, 17) uint8, of 255, as of `Elevations`.
        truth: (n,) uint8, index into `WALL_CLASSES`.
        doors: (D, 3) where the true doors are, m, in the map's frame.
        map: the map, without its cells; of the rooms storey and completeness alone, of the edges what the plans show.
        storeys: what probably stands in the columns of its plans.
        faces: (F,) FACE_DTYPE.
        source: sensor/where the building is from.
    """

    first: Array
    strips: Array
    truth: Array
    doors: Array
    map: TopometricMap
    storeys: tuple[ClassifiedStorey, ...]
    faces: Array
    source: str

    @property
    def elevations(self) -> Elevations | None:
        """The walls as the extraction has them; None of a flat map."""
        if not len(self.faces):
            return None
        return Elevations(self.faces, self.first, (self.strips / np.float32(255)).astype(np.float32))


def build_walls(
    recipe: PlanRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None
) -> tuple[list[Path], BuildReport]:
    """Build the files of a set, made where they are missing, in the order of the seeds."""
    return build_scans(recipe, "walls", partial(draw_wall_item, recipe=recipe), make_wall_file, sharing, log_line)


def draw_wall_item(seed: int, plans: Plans, recipe: PlanRecipe) -> WallItem:
    """Draw the item of a seed; `make_walls` draws the same numbers again."""
    rng = np.random.default_rng([seed, 7])
    sparse, frameless = (np.random.default_rng([seed, k]).random() for k in (9, 11))
    kind = recipe.flat, bool(sparse < recipe.sparse), bool(frameless < recipe.frameless)
    source = str(rng.choice(list(SOURCE_SHARES), p=list(SOURCE_SHARES.values())))
    entries = plans.get(source, ())
    if not entries:
        return WallItem(seed, "procedural", 0, "", "", *kind)
    name, plan = entries[int(rng.integers(len(entries)))]
    return WallItem(seed, source, len(entries), name, compute_plan_digest((plan,)), *kind)


def make_wall_file(item: WallItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: build_wall_arrays(item, make_walls(item, plan)), LONGEST_SCAN)


def build_wall_arrays(item: WallItem, example: WallExample) -> dict[str, Array]:
    """Build the arrays of a file."""
    about = {"file": f"{item.name}.npz", **asdict(item), "sources": [example.source]}
    arrays: dict[str, Any] = {name: getattr(example, name) for name in WALL_ARRAYS}
    arrays |= {f"map.{name}": getattr(example.map, name) for name in MAP_ARRAYS}
    arrays |= {f"rooms.{name}": example.map.rooms[name] for name in ROOMS_HELD}
    for k, storey in enumerate(example.storeys):
        arrays[f"plan{k}.classes"] = np.rint(255 * storey.probability).astype(np.uint8)
        arrays[f"plan{k}.frame"] = np.array([*storey.origin, storey.edge, storey.height])
    floor = example.map.navigable
    arrays |= {"floor.cells": floor.cells, "floor.origin": floor.origin, "floor.edge": np.array(floor.edge)}
    return {**arrays, "source": np.array(example.source), "about": np.frombuffer(json.dumps(about).encode(), np.uint8)}


def load_walls(path: Path) -> WallExample:
    """Load the walls of a file.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached walls")
    floor = VoxelGrid.from_cells(arrays["floor.cells"], arrays["floor.origin"], float(arrays["floor.edge"]))
    grid, none = floor.replace_cells(np.zeros((0, 3), np.int32)), np.zeros(0, np.int32)
    edges, storeys, room = (arrays[f"map.{name}"] for name in MAP_ARRAYS)
    rooms = np.zeros(len(arrays["rooms.storey"]), ROOM_DTYPE)
    for name in ROOMS_HELD:
        rooms[name] = arrays[f"rooms.{name}"]
    map = TopometricMap(grid, none, floor, room, rooms, edges, storeys)
    plans = []
    for k in range(sum(name.endswith(".classes") for name in arrays)):
        x, y, edge, height = arrays[f"plan{k}.frame"].tolist()
        plans.append(ClassifiedStorey(arrays[f"plan{k}.classes"] / np.float32(255), np.array([x, y]), edge, height))
    walls = {name: arrays[name] for name in WALL_ARRAYS}
    return WallExample(**walls, map=map, storeys=tuple(plans), source=str(arrays["source"]))


def make_walls(item: WallItem, plan: Plan | None) -> WallExample:
    """Make the walls of one scan."""
    seed = item.seed
    rng = np.random.default_rng([seed, 8])
    frames = FRAMELESS if item.frameless else FRAMES
    difficulty = replace(draw_difficulty(rng), frames=float(rng.uniform(*frames)))
    if not item.flat:  # what a slice shows of a recess is the same wall elsewhere
        difficulty = replace(difficulty, niches=float(np.random.default_rng([seed, 13]).uniform(0, NICHES)))
    if plan is not None:
        building = build_building([plan], difficulty, rng, f"{item.source}-{seed}")
    else:
        building = make_building(str(rng.choice(BUILDING_KINDS)), seed, 1, difficulty)
    visited = sample_part(building, int(rng.integers(*ROOMS_VISITED)), rng)
    name, cloud, shift = (
        _simulate_flat(building, visited, seed, rng) if item.flat else _simulate_scan(building, visited, item, rng)
    )
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)))
    cloud = replace(transform_cloud(thin_cloud(cloud, seed) if item.sparse else cloud, frame), rooms=())
    p, watch = PRESETS["default"], Stopwatch()
    assert isinstance(p, DefaultParameters)
    scan, navigable = read_navigable(cloud, MAP_CELL, p, watch)
    coarse = rng.random() < COARSE_SHARE
    if not item.flat:
        scan = replace(scan, fine=scan.grid if coarse else voxelise(cloud, FINE_CELL))
    floor, seen = cut_rooms(scan, navigable, p, watch)
    map = build_topometric_map(scan.grid, floor, p.standing_height)
    walls = NO_WALLS if seen is None or item.flat else seen.elevations
    if not item.flat and not len(walls.faces):
        raise InputError(f"{seed}: no wall was seen")
    strips, truth = np.rint(255 * walls.strips).astype(np.uint8), compute_true_classes(building, walls, frame, shift)
    doors = building.doors["centre"]
    if shift is not None:
        doors = doors - shift[1][cKDTree(shift[0] + shift[1]).query(doors)[1]]
    source = f"{name}/{item.source}"
    return WallExample(walls.first, strips, truth, frame.apply(doors), map, floor.classified_storeys, walls.faces, source)


def _simulate_flat(building: Building, visited: Array, seed: int, rng: np.random.Generator) -> tuple[str, PointCloud, Any]:
    """Simulate, as `_simulate_scan`, by a 2D laser or as a grid map."""
    if rng.random() >= SLICE_SHARE:
        return "drawn", simulate_grid_map(building, visited, rng), None
    cloud, shift = scan_with_drift(building, "laser2d", visited, rng, seed)
    return "laser2d", cloud if rng.random() < POSED_SHARE else replace(cloud, poses=None, pose_of=None), shift


def _simulate_scan(building: Building, visited: Array, item: WallItem, rng: np.random.Generator) -> tuple[str, PointCloud, Any]:
    """Return how a building was seen, its cloud, and places of it with what undoes its drift there (None: it has none)."""
    sensor, seed = get_sensor(str(rng.choice(list(SENSOR_SHARES), p=list(SENSOR_SHARES.values())))), item.seed
    if seed % DRAWN_EVERY == DRAWN_EVERY - 1:
        return "drawn", simulate_grid_map(building, visited, rng), None
    if rng.random() < EXACT_SHARE:
        sensor = replace(sensor, drift=0.0, tilt=0.0)
    spacing = sensor.spacing * float(rng.uniform(*FINER))
    cloud = scan_building(building, sensor, visited, np.random.default_rng(seed), spacing)
    if not sensor.drift:
        return sensor.name, cloud, None
    straight = scan_building(building, remove_sensor_drift(sensor), visited, np.random.default_rng(seed), budget=8)
    return sensor.name, cloud, measure_drift(cloud, straight)


def thin_cloud(cloud: PointCloud, seed: int) -> PointCloud:
    """Return a cloud that lost most of its points: by chance, or one stays in a cell of a grid, as files are made smaller."""
    rng = np.random.default_rng([seed, 10])
    if rng.random() < LOST_BY_CHANCE:
        return select_points(cloud, rng.random(len(cloud)) < np.exp(rng.uniform(*np.log(SHARE_LEFT))))
    cells = encode_rows(compute_cells(cloud.points, float(rng.uniform(*SPACING_LEFT))))[0]
    return select_points(cloud, np.sort(np.unique(cells, return_index=True)[1]))
