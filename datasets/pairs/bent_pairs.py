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
from topomerge.datasets.core.builder import Say, make_item, refusal
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.evaluation_pair import sim3_of
from topomerge.datasets.pairs.example import candidate
from topomerge.datasets.pairs.flat import keys, raise_flat, rooms_at, squares
from topomerge.datasets.pairs.grid_pairs import (
    COLUMN_EDGE,
    WEIGHTS,
    GridPair,
    columns_seen,
    free_of,
    grid_arrays,
    grid_of,
    unpacked,
)
from topomerge.datasets.pairs.items import Item, difficulty_of, draw_items, plans_of
from topomerge.datasets.pairs.pairs import draw_frames, visited_places
from topomerge.datasets.pairs.recipe import Library, Recipe, library
from topomerge.datasets.simulation.scanner import moved, scan
from topomerge.datasets.simulation.sensors import Sensor, get_sensor
from topomerge.datasets.simulation.session import session
from topomerge.datasets.simulation.spoils import DRIFT_SPACING, drift_between, drifting, exact_sensor

from topomerge.errors import InputError
from topomerge.io import archive
from topomerge.types import Array, PointCloud, Sim3

LONGEST_BENT_PAIR = 900.0  # s
LEAST_SPACING = 0.06  # m between points: cells are of 0.1 m
BENT_FORMAT = 1  # raise it when the same item gives other bytes
DRIFT_FACTORS = (0.0, 1.0, 2.0, 4.0)
DRAWING = "drawing"
BENT_SENSORS = ("tls", "lidar", "depth", "tablet", "laser2d")
SENSOR_PAIRS = (*combinations_with_replacement(BENT_SENSORS, 2), *((s, DRAWING) for s in BENT_SENSORS))
NEAR_FLOOR = 0.3  # m below a floor at which a place is of that storey


@dataclass(frozen=True, eq=False)
class Undrift:
    """What undoes the drift of a map.

    Args:
        places: (n, 3) in the map's frame, one a cube of half a metre.
        shifts: (n, 3) m to add there.
        rooms: (n,) int32 true room, -1 none.
    """

    places: Array
    shifts: Array
    rooms: Array

    def at(self, points: Array) -> Array:
        """(n, 3) the points (n, 3) without the drift: shifted as the nearest place."""
        if not len(self.places):
            return np.asarray(points, np.float64)
        out: Array = points + self.shifts[cKDTree(self.places).query(points)[1]]
        return out


@dataclass(frozen=True, eq=False)
class BentPair:
    """A pair of grids and what bent them.

    Args:
        frames: building -> map, of a and of b.
        shared: (n,) rooms that both surveyors were in.
        factor: times the usual drift.
    """

    pair: GridPair
    undrift: tuple[Undrift, Undrift]
    frames: tuple[Sim3, Sim3]
    shared: Array
    factor: float


def drifted_scan(
    building: Building, sensor: Sensor | str, factor: float, rooms: Sequence[int] | Array, seed: Sequence[int], frame: Sim3,
    budget: int | None = None,
) -> tuple[PointCloud, Undrift]:  # fmt: skip
    """A scan in its frame with a multiple of the drift, and what undoes it.

    Args:
        seed: of the walk, the rays and the drift: the same for all factors.
        budget: number of rays, as of `scan`.
    """
    kind = drifting(sensor, factor)
    spacing = max(kind.spacing, LEAST_SPACING)
    cloud = scan(building, kind, rooms, np.random.default_rng(seed), spacing, budget)
    straight = scan(building, exact_sensor(kind), rooms, np.random.default_rng(seed), budget=8)  # poses come before rays
    places, shifts = drift_between(cloud, straight)
    turn = Sim3(frame.yaw).matrix[:3, :3]
    undrift = Undrift(frame.apply(places), shifts @ turn.T, true_rooms(building, places + shifts))
    return moved(cloud, frame), undrift


def true_rooms(building: Building, places: Array) -> Array:
    """(n,) int32 the room that each place of the building's frame is in or next to, -1 none."""
    storey = np.searchsorted(building.storeys["floor"] - NEAR_FLOOR, places[:, 2], side="right") - 1
    out = np.full(len(places), -1, np.int32)
    for s in np.unique(storey[storey >= 0]):
        numbers = np.array([i for i, r in enumerate(building.rooms) if r.storey == s])
        rows = np.flatnonzero(storey == s)
        if len(numbers):
            near = rooms_at(places[rows, :2], [building.rooms[i] for i in numbers])
            out[rows] = np.where(near >= 0, numbers[near], -1)
    return out


@dataclass(frozen=True)
class BentItem:
    """Everything that the bytes of one file depend on."""

    item: Item
    factor: float

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        inputs = ["bent", BENT_FORMAT, self.item.name, self.factor]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def bent_recipe(split: str, folder: str, pairs: int) -> Recipe:
    """What the pairs are drawn from.

    Args:
        folder: of the real data; empty: procedural buildings only.
    """
    return Recipe(
        name="bent", split=split, pairs=pairs, seed=16, folder=folder,
        sources={"procedural": 0.7, "campus": 0.3} if folder else {"procedural": 1.0}, kinds=dict(WEIGHTS["kinds"]),
        sensors=dict(WEIGHTS["sensors"]), overlaps=[0.4, 0.6, 0.8], rooms=[6, 14], two_storeys=0.1,
    )  # fmt: skip


def bent_items(split: str, folder: str, pairs: int) -> tuple[list[Item], Library]:
    """The items of a split, all pairs of sensors in turn, and the plans that they are drawn from."""
    recipe = bent_recipe(split, folder, pairs)
    plans = library(recipe)
    items = []
    for k, item in enumerate(draw_items(recipe, plans)):
        sensors = SENSOR_PAIRS[k % len(SENSOR_PAIRS)]
        items.append(replace(item, sensors=sensors, storeys=1 if DRAWING in sensors else item.storeys))
    return items, plans


def bent_pairs(split: str, folder: str, pairs: int, cache: Path, say: Say = lambda text: None) -> Iterator[BentPair]:
    """The pairs of a split, each with every factor of drift, made where they are not in the cache.

    Args:
        pairs: number of items drawn, of which each is made with all `DRIFT_FACTORS`, or without drift only
            where no sensor drifts; some buildings have no such pair.
        say: is told what is made, and what went wrong.
    """
    items, plans = bent_items(split, folder, pairs)
    cache.mkdir(parents=True, exist_ok=True)
    for item in items:
        made = BentMaker(item, list(plans_of(item, plans)))
        for factor in DRIFT_FACTORS if drifts(item.sensors) else (0.0,):
            name = BentItem(item, factor).name
            path = cache / f"{name}.npz"
            if not path.exists() and not refusal(cache, name):
                row = make_item(name, str(cache), partial(made.arrays, factor), LONGEST_BENT_PAIR)
                say(f"{'-'.join(item.sensors)} drift {factor:g}: {row.reason or 'made'} in {row.seconds:.0f} s")
            if path.exists():
                yield load_bent(path)


def drifts(sensors: Sequence[str]) -> bool:
    """Does any of the sensors drift? If not, all factors give the same pair."""
    return any(s != DRAWING and get_sensor(s).drift > 0 for s in sensors)


@dataclass(frozen=True, eq=False)
class BentMaker:
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
                building, _ = candidate(self.item, k, self.plans)
                (first, _), visited = visited_places(building, self.item.pair_settings, None, rng)
                return first, visited, draw_frames(2, False, rng)
            except InputError as error:
                refused = error
        raise refused or InputError("an item without buildings")

    def map(self, side: int, factor: float) -> tuple[PointCloud, Undrift]:
        """A map of the pair and what undoes its drift."""
        building, visited, frames = self.place
        sensor, frame = self.item.sensors[side], frames[side]
        if sensor == DRAWING:
            flat = draw(building).moved(replace(frame, translation=(*frame.translation[:2], 0.0)))
            cloud = raise_flat(flat, frame.translation[2] + float(building.storeys["floor"][0]))
            places = cloud.points[thinned(cloud.points)].astype(np.float64)
            return cloud, Undrift(places, np.zeros(places.shape), true_rooms(building, frame.inverse().apply(places)))
        seed = [self.item.seed, side]
        day = session(building, difficulty_of(self.item), np.random.default_rng(seed))
        return drifted_scan(day, sensor, factor, visited[side], seed, frame)

    def arrays(self, factor: float) -> dict[str, Array]:
        """What is cached."""
        building, visited, frames = self.place
        maps = [self.map(side, factor) for side in (0, 1)]
        truth = frames[0] @ frames[1].inverse()
        out: dict[str, Array] = {"truth": truth.matrix, "frames": np.stack([f.matrix for f in frames])}
        grids, free = [], []
        for side, (cloud, undrift), sensor in zip("ab", maps, self.item.sensors, strict=True):
            grids.append(grid_of(cloud))
            free.append(free_of(cloud, grids[-1]) if sensor == "laser2d" else None)
            out |= grid_arrays(side, grids[-1], free[-1])
            out |= {f"{side}.places": undrift.places.astype(np.float32), f"{side}.rooms": undrift.rooms}
            out |= {f"{side}.shifts": undrift.shifts.astype(np.float32)}
        rooms = [np.arange(len(building.rooms)) if s == DRAWING else v for s, v in zip(self.item.sensors, visited, strict=True)]
        out["shared"] = np.intersect1d(rooms[0], rooms[1])
        floors = building.storeys["floor"] + frames[0].translation[2]
        seen = [columns_seen(g, f, into, floors) for g, f, into in zip(grids, free, (Sim3(), truth), strict=True)]
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


def thinned(points: Array) -> Array:
    """Rows of one point a cube of half a metre."""
    return np.unique(keys(squares(points, DRIFT_SPACING))[0], return_index=True)[1]


def load_bent(path: Path) -> BentPair:
    """A cached pair."""
    data = archive.read(path, "bent pair")
    pair = unpacked(path.stem, data)
    a, b = (Undrift(data[f"{s}.places"].astype(float), data[f"{s}.shifts"].astype(float), data[f"{s}.rooms"]) for s in "ab")
    frames = sim3_of(data["frames"][0]), sim3_of(data["frames"][1])
    assert frames[0] is not None and frames[1] is not None
    return BentPair(pair, (a, b), (frames[0], frames[1]), data["shared"], float(str(pair.about["factor"])))
