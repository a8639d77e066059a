"""Pairs whose drift is known at every place: what bending of maps is measured on, and what its stiffness is fitted to.

Both maps of a pair drift by a multiple of what is usual of their sensors: the same walks, rays and furniture with 0, 1, 2 and 4
times the drift. Jitter of the poses stays; gravity is misjudged as usual, and not at all where nothing drifts. A drawing does not
drift. The recipe is that of pairs of grids (`grid_pairs`) without flats, which hardly share 80 m2, and without pairs that must
not merge, with more rooms and more in common.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.core.builder import make_item, read_refusal
from topomerge.datasets.core.building import Building, Plan
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.evaluation_pair import convert_to_sim3
from topomerge.datasets.pairs.example import build_candidate
from topomerge.datasets.pairs.flat_maps import compute_cells, encode_rows, extrude_flat, find_rooms
from topomerge.datasets.pairs.grid_pairs import (
    COLUMN_EDGE,
    WEIGHTS,
    GridPair,
    build_grid,
    build_grid_arrays,
    compute_free_grid,
    compute_seen_columns,
    unpack_pair,
)
from topomerge.datasets.pairs.items import Item, Library, Recipe, draw_items, get_difficulty, load_library, select_plans
from topomerge.datasets.pairs.pairs import choose_visited_places, draw_frames
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.sensors import (
    DRIFT_SPACING,
    Sensor,
    get_sensor,
    measure_drift,
    remove_sensor_drift,
    scale_sensor_drift,
)
from topomerge.datasets.simulation.session import simulate_session

from topomerge import archive
from topomerge.errors import InputError
from topomerge.types import Array, LogFn, PointCloud, Sim3

LONGEST_BENT_PAIR = 900.0  # s of a processor
LEAST_SPACING = 0.06  # m between points: cells are of 0.1 m
BENT_FORMAT = 1  # raise it when the same item gives other bytes
DRIFT_FACTORS = (0.0, 1.0, 2.0, 4.0)
DRAWING = "drawing"
BENT_SENSORS = ("tls", "lidar", "depth", "tablet", "laser2d")
SENSOR_PAIRS = (*combinations_with_replacement(BENT_SENSORS, 2), *((s, DRAWING) for s in BENT_SENSORS))
NEAR_FLOOR = 0.3  # m below a floor at which a place is of that storey


@dataclass(frozen=True, eq=False)
class DriftCorrection:
    """The correction that undoes the drift of a map.

    Args:
        places: (n, 3) in the map's frame, one a cube of half a metre.
        shifts: (n, 3) m to add there.
        rooms: (n,) int32 true room, -1 none.
    """

    places: Array
    shifts: Array
    rooms: Array

    def correct(self, points: Array) -> Array:
        """Return the points (n, 3) without the drift: shifted as the nearest place."""
        if not len(self.places):
            return np.asarray(points, np.float64)
        out: Array = points + self.shifts[cKDTree(self.places).query(points)[1]]
        return out


@dataclass(frozen=True, eq=False)
class DriftedPair:
    """A pair of grids and what bent them.

    Args:
        frames: building -> map, of a and of b.
        shared: (n,) rooms that both surveyors were in.
        factor: times the usual drift.
    """

    pair: GridPair
    undrift: tuple[DriftCorrection, DriftCorrection]
    frames: tuple[Sim3, Sim3]
    shared: Array
    factor: float


def simulate_drifted_scan(
    building: Building, sensor: Sensor | str, factor: float, rooms: Sequence[int] | Array, seed: Sequence[int], frame: Sim3,
    budget: int | None = None,
) -> tuple[PointCloud, DriftCorrection]:  # fmt: skip
    """Simulate a scan in its frame with a multiple of the drift, and what undoes it.

    Args:
        seed: of the walk, the rays and the drift: the same for all factors.
        budget: number of rays, as of `scan`.
    """
    kind = scale_sensor_drift(sensor, factor)
    spacing = max(kind.spacing, LEAST_SPACING)
    cloud = scan_building(building, kind, rooms, np.random.default_rng(seed), spacing, budget)
    straight = scan_building(
        building, remove_sensor_drift(kind), rooms, np.random.default_rng(seed), budget=8
    )  # poses come before rays
    places, shifts = measure_drift(cloud, straight)
    turn = Sim3(frame.yaw).matrix[:3, :3]
    undrift = DriftCorrection(frame.apply(places), shifts @ turn.T, find_true_rooms(building, places + shifts))
    return transform_cloud(cloud, frame), undrift


def find_true_rooms(building: Building, places: Array) -> Array:
    """Find the (n,) int32 room that each place of the building's frame is in or next to, -1 none."""
    storey = np.searchsorted(building.storeys["floor"] - NEAR_FLOOR, places[:, 2], side="right") - 1
    out = np.full(len(places), -1, np.int32)
    for s in np.unique(storey[storey >= 0]):
        numbers = np.array([i for i, r in enumerate(building.rooms) if r.storey == s])
        rows = np.flatnonzero(storey == s)
        if len(numbers):
            near = find_rooms(places[rows, :2], [building.rooms[i] for i in numbers])
            out[rows] = np.where(near >= 0, numbers[near], -1)
    return out


@dataclass(frozen=True)
class DriftedItem:
    """Everything that the bytes of one file depend on."""

    item: Item
    factor: float

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        inputs = ["bent", BENT_FORMAT, self.item.name, self.factor]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def make_drifted_recipe(split: str, folder: str, pairs: int) -> Recipe:
    """Return the recipe that the pairs are drawn from.

    Args:
        folder: of the real data; empty: procedural buildings only.
    """
    return Recipe(
        name="bent", split=split, pairs=pairs, seed=16, folder=folder,
        sources={"procedural": 0.7, "campus": 0.3} if folder else {"procedural": 1.0}, kinds=dict(WEIGHTS["kinds"]),
        sensors=dict(WEIGHTS["sensors"]), overlaps=[0.4, 0.6, 0.8], rooms=[6, 14], two_storeys=0.1,
    )  # fmt: skip


def draw_drifted_items(split: str, folder: str, pairs: int) -> tuple[list[Item], Library]:
    """Draw the items of a split, all pairs of sensors in turn, and the plans that they are drawn from."""
    recipe = make_drifted_recipe(split, folder, pairs)
    plans = load_library(recipe)
    items = []
    for k, item in enumerate(draw_items(recipe, plans)):
        sensors = SENSOR_PAIRS[k % len(SENSOR_PAIRS)]
        items.append(replace(item, sensors=sensors, storeys=1 if DRAWING in sensors else item.storeys))
    return items, plans


def iter_drifted_pairs(
    split: str, folder: str, pairs: int, cache: Path, log_line: LogFn = lambda text: None
) -> Iterator[DriftedPair]:
    """Yield the pairs of a split, each with every factor of drift, made where they are not in the cache.

    Args:
        pairs: number of items drawn, of which each is made with all `DRIFT_FACTORS`, or without drift only
            where no sensor drifts; some buildings have no such pair.
        log_line: is told what is made, and what went wrong.
    """
    items, plans = draw_drifted_items(split, folder, pairs)
    cache.mkdir(parents=True, exist_ok=True)
    for item in items:
        maker = DriftedPairMaker(item, list(select_plans(item, plans)))
        for factor in DRIFT_FACTORS if is_drifting(item.sensors) else (0.0,):
            name = DriftedItem(item, factor).name
            path = cache / f"{name}.npz"
            if not path.exists() and not read_refusal(cache, name):
                row = make_item(name, str(cache), partial(maker.build_arrays, factor), LONGEST_BENT_PAIR)
                log_line(f"{'-'.join(item.sensors)} drift {factor:g}: {row.reason or 'made'} in {row.seconds:.0f} s")
            if path.exists():
                yield load_drifted_pair(path)


def is_drifting(sensors: Sequence[str]) -> bool:
    """Return whether any of the sensors drifts. If not, all factors give the same pair."""
    return any(s != DRAWING and get_sensor(s).drift > 0 for s in sensors)


@dataclass(frozen=True, eq=False)
class DriftedPairMaker:
    """Makes an item's pair with any factor of drift; its building is erected once."""

    item: Item
    plans: Sequence[tuple[Plan, ...]]

    @cached_property
    def place(self) -> tuple[Building, tuple[Array, Array], list[Sim3]]:
        """The building of the first candidate that has such a pair, the rooms visited in each map, and their frames.

        Raises:
            InputError: no candidate has one.
        """
        refused: InputError | None = None
        for k in range(len(self.item.buildings)):
            rng = np.random.default_rng([self.item.seed, k])
            try:
                building, _ = build_candidate(self.item, k, self.plans)
                (first, _), visited = choose_visited_places(building, self.item.pair_settings, None, rng)
                return first, visited, draw_frames(2, False, rng)
            except InputError as error:
                refused = error
        raise refused or InputError("an item without buildings")

    def simulate_map(self, side: int, factor: float) -> tuple[PointCloud, DriftCorrection]:
        """Simulate a map of the pair and what undoes its drift."""
        building, visited, frames = self.place
        sensor, frame = self.item.sensors[side], frames[side]
        if sensor == DRAWING:
            flat = draw(building).transform(replace(frame, translation=(*frame.translation[:2], 0.0)))
            cloud = extrude_flat(flat, frame.translation[2] + float(building.storeys["floor"][0]))
            places = cloud.points[thin_rows(cloud.points)].astype(np.float64)
            return cloud, DriftCorrection(
                places, np.zeros(places.shape), find_true_rooms(building, frame.inverse().apply(places))
            )
        seed = [self.item.seed, side]
        day = simulate_session(building, get_difficulty(self.item), np.random.default_rng(seed))
        return simulate_drifted_scan(day, sensor, factor, visited[side], seed, frame)

    def build_arrays(self, factor: float) -> dict[str, Array]:
        """Build the arrays that are cached."""
        building, visited, frames = self.place
        maps = [self.simulate_map(side, factor) for side in (0, 1)]
        truth = frames[0] @ frames[1].inverse()
        out: dict[str, Array] = {"truth": truth.matrix, "frames": np.stack([f.matrix for f in frames])}
        grids, free = [], []
        for side, (cloud, undrift), sensor in zip("ab", maps, self.item.sensors, strict=True):
            grids.append(build_grid(cloud))
            free.append(compute_free_grid(cloud, grids[-1]) if sensor == "laser2d" else None)
            out |= build_grid_arrays(side, grids[-1], free[-1])
            out |= {f"{side}.places": undrift.places.astype(np.float32), f"{side}.rooms": undrift.rooms}
            out |= {f"{side}.shifts": undrift.shifts.astype(np.float32)}
        rooms = [np.arange(len(building.rooms)) if s == DRAWING else v for s, v in zip(self.item.sensors, visited, strict=True)]
        out["shared"] = np.intersect1d(rooms[0], rooms[1])
        floors = building.storeys["floor"] + frames[0].translation[2]
        seen = [compute_seen_columns(g, f, into, floors) for g, f, into in zip(grids, free, (Sim3(), truth), strict=True)]
        about = {
            "sensors": self.item.sensors,
            "kind": "overlap",
            "building": building.name,
            "source": self.item.source,
            "overlap": self.item.overlap,
            "common": len(np.intersect1d(seen[0], seen[1])) * COLUMN_EDGE**2,
            "factor": factor,
        }
        out["about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
        return out


def thin_rows(points: Array) -> Array:
    """Return rows of one point a cube of half a metre."""
    return np.unique(encode_rows(compute_cells(points, DRIFT_SPACING))[0], return_index=True)[1]


def load_drifted_pair(path: Path) -> DriftedPair:
    """Load a cached pair."""
    data = archive.read(path, "bent pair")
    pair = unpack_pair(path.stem, data)
    a, b = (
        DriftCorrection(data[f"{s}.places"].astype(float), data[f"{s}.shifts"].astype(float), data[f"{s}.rooms"]) for s in "ab"
    )
    frames = convert_to_sim3(data["frames"][0]), convert_to_sim3(data["frames"][1])
    assert frames[0] is not None and frames[1] is not None
    return DriftedPair(pair, (a, b), (frames[0], frames[1]), data["shared"], float(str(pair.about["factor"])))
