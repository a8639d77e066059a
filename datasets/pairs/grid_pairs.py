"""Pairs of voxel grids with what is true about them, before any extraction: what the belief in merges is fitted to and judged on.

Every sixth pair has much moved furniture, every eighth glass walls, and a quarter must not merge; from the second set on half of
them must not, most of them hard to tell; the fourth is of 2D slices and other storeys. Made by the builder (`core.builder`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import (
    BuildReport,
    BuildRow,
    BuildSettings,
    build_set,
    check_sharing,
    make_item,
    select_items,
)
from topomerge.datasets.core.building import Plan
from topomerge.datasets.pairs.evaluation_pair import convert_to_sim3
from topomerge.datasets.pairs.example import make_first_pair
from topomerge.datasets.pairs.items import Item, Library, Recipe, check, draw_items, load_library, select_plans
from topomerge.datasets.pairs.pairs import Pair

from topomerge import archive
from topomerge.errors import InputError
from topomerge.extraction.cleaning import add_means
from topomerge.extraction.voxels import voxelise
from topomerge.types import Array, LogFn, PointCloud, Sim3, VoxelGrid

GRID_FORMAT = 2  # raise it when the same item gives other bytes: it is part of the files' names
GRID_EDGE = 0.1  # m
COLUMN_EDGE = 0.2  # m, columns by which the area in common is measured
NOTHING_IN_COMMON = 99.0  # m: nothing is shown by both
POINTS_SHOWN = 200  # points of a room that a map shows
CEILING_BELOW = 0.15  # m: what is that far below a floor is the storey below's ceiling
RAY_STEP = 0.08  # m along a ray
LONGEST_GRID_PAIR = 120.0  # s of a processor
WEIGHTS = {
    "sources": {"procedural": 0.65, "r2v": 0.1, "campus": 0.25},
    "kinds": {
        "office": 3.0, "openplan": 1.0, "apartment": 2.0, "hotel": 2.0, "hospital": 2.0, "school": 2.0, "lab": 1.0, "house": 1.0,
    },
    "sensors": {"tls": 3.0, "lidar": 2.0, "depth": 3.0, "tablet": 1.0, "laser2d": 1.0},
}  # fmt: skip
HARD_SHARES = (
    {"other-building": 0.13, "other-storey": 0.07, "twin-wing": 0.05},
    {"other-building": 0.13, "other-storey": 0.07, "twin-wing": 0.05},
    {"other-building": 0.1, "other-storey": 0.15, "twin-wing": 0.25},
    {"other-storey": 0.6},  # whose second map is a slice
)
SLICED_SET = 3


@dataclass
class GridRecipe:
    """Sets of pairs of grids.

    Args:
        name: of the manifest.
        split: train, validation or test.
        folder: of the real data; empty: procedural buildings only.
        sets: pairs of each set; the set's number is its seed.
        rooms: fewest and most rooms a map.
        sensors: weight of each; empty: `WEIGHTS`.
        drawings: of the first so many pairs of each set, drawings of what they show, and of what they do not (`grid_drawings`).
        strangers: pairs of maps of two pairs.
        limit: only so many of all pairs (`core.builder.select_items`); 0: all.
    """

    name: str = "grids"
    split: str = "train"
    folder: str = ""
    sets: list[int] = field(default_factory=lambda: [220, 100, 160])
    rooms: list[int] = field(default_factory=lambda: [4, 15])
    sensors: dict[str, float] = field(default_factory=dict)
    drawings: list[int] = field(default_factory=lambda: [92, 42, 66])
    strangers: int = 0
    limit: int = 0

    @property
    def manifest(self) -> str:
        """Name of the manifest; one of a part of the set has its own."""
        return f"{self.name}-{self.limit}" if self.limit else self.name


@dataclass(frozen=True, eq=False)
class GridPair:
    """Two voxel grids (property ``mean``: middle of the points of each cell), free cells where rays tell, and the truth.

    `common` is the area, m2, that both maps saw; 0 where they are of two places. `about` tells sensors, kind, building.
    """

    name: str
    a: VoxelGrid
    b: VoxelGrid
    free: tuple[VoxelGrid | None, VoxelGrid | None]
    truth: Sim3 | None
    common: float
    about: dict[str, object]

    @cached_property
    def anchor(self) -> Array:
        """(3,) a point of b in the middle of what both maps saw: drift bends maps, and no pose is right everywhere."""
        cells = self.b.compute_centroids()
        if self.truth is not None:
            a = np.unique(np.floor(self.a.compute_centroids() / 0.5).astype(np.int64), axis=0)
            b = np.floor(self.truth.apply(cells) / 0.5).astype(np.int64)
            key = [k[:, 0] * 2**42 + k[:, 1] * 2**21 + k[:, 2] for k in (a, b)]
            both = np.isin(key[1], key[0])
            cells = cells[both] if both.sum() > 50 else cells
        middle: Array = cells.mean(axis=0)
        return middle


@dataclass(frozen=True)
class GridItem:
    """Everything that the bytes of one file depend on: the item that is simulated, its set and its number in it."""

    item: Item
    set: int
    number: int

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        inputs = ["grids", GRID_FORMAT, self.item.name, self.set, self.number]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def make_recipe(recipe: GridRecipe, number: int) -> Recipe:
    """Return the recipe that the pairs of a set are simulated from."""
    return Recipe(
        name=recipe.name, split=recipe.split, pairs=recipe.sets[number], seed=number, folder=recipe.folder,
        sources=dict(WEIGHTS["sources"] if recipe.folder else {"procedural": 1.0}), kinds=dict(WEIGHTS["kinds"]),
        sensors=dict(recipe.sensors or WEIGHTS["sensors"]), hard=dict(HARD_SHARES[min(number, len(HARD_SHARES) - 1)]),
        overlaps=[0.0, 0.1, 0.25, 0.4, 0.6], rooms=list(recipe.rooms), two_storeys=0.15,
    )  # fmt: skip


def draw_grid_items(recipe: GridRecipe) -> tuple[list[GridItem], Library]:
    """Draw the items of all sets, some made harder, and the plans that they are drawn from.

    Raises:
        InputError: a recipe that nothing can be made of.
    """
    if not any(recipe.sets) or min(recipe.sets) < 0 or len(recipe.sets) > len(HARD_SHARES):
        raise InputError(f"data.sets must be up to {len(HARD_SHARES)} numbers of pairs, not {recipe.sets}")
    items: list[GridItem] = []
    plans: Library = {}
    for number, count in enumerate(recipe.sets):
        if not count:
            continue
        simulated = make_recipe(recipe, number)
        check(simulated)
        plans = plans or load_library(simulated)
        for k, item in enumerate(draw_items(simulated, plans)):
            harder = _increase_difficulty(k, item)
            if number == SLICED_SET:
                harder = replace(harder, sensors=(harder.sensors[0], "laser2d"))
            items.append(GridItem(harder, number, k))
    return select_items(items, recipe.limit), plans


def _increase_difficulty(k: int, item: Item) -> Item:
    difficulty = dict(item.difficulty)
    if k % 6 == 5:
        difficulty |= {"moved": 0.6, "gone": 0.25}
    if k % 8 == 7:
        difficulty |= {"glass": 0.5}
    return replace(item, difficulty=tuple(sorted(difficulty.items())))


def build_grids(
    recipe: GridRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None
) -> tuple[list[Path], BuildReport]:
    """Build the files of all sets, made where they are missing, in the order of their items."""
    check_sharing(sharing)
    items, plans = draw_grid_items(recipe)
    folder = Path(sharing.cache).resolve() / "grids"
    begin, step = sharing.part
    tasks = [(item, list(select_plans(item.item, plans)), str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.manifest}.jsonl", tasks, make_grids, sharing, log_line)
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def make_grids(item: GridItem, plans: Sequence[Sequence[Plan]], folder: str) -> BuildRow:
    """Make an item's file."""

    def make() -> dict[str, Array]:
        about = {"difficulty": dict(item.item.difficulty), "source": item.item.source, "set": item.set, "item": item.number}
        pair, _ = make_first_pair(item.item, plans)
        return build_pair_arrays(pair, {**about, "file": f"{item.name}.npz"})

    return make_item(item.name, folder, make, LONGEST_GRID_PAIR)


def build_grid(cloud: PointCloud) -> VoxelGrid:
    """Build occupied cells with the middle of their points, rounded as in the files that are cached."""
    return add_means(voxelise(cloud, GRID_EDGE), cloud.points.astype(np.float64) + cloud.shift)


def compute_free_grid(cloud: PointCloud, grid: VoxelGrid) -> VoxelGrid | None:
    """Compute cells that the rays of a cloud with poses crossed and that are not occupied."""
    if cloud.poses is None or cloud.pose_of is None:
        return None
    pick = np.flatnonzero(cloud.pose_of >= 0)
    ends = cloud.points[pick].astype(np.float64) + cloud.shift
    starts = cloud.poses[cloud.pose_of[pick], :3, 3]
    length = np.linalg.norm(ends - starts, axis=1)
    seen = []
    for d in np.arange(0.0, length.max(), RAY_STEP):
        on = length > d + 2 * grid.edge
        cells = grid.locate(starts[on] + (ends[on] - starts[on]) * (d / length[on])[:, None])
        inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
        seen.append(np.unique(cells[inside], axis=0))
    cells = np.unique(np.concatenate(seen), axis=0)
    return grid.replace_cells(cells[~grid.contains(cells)])


def compute_seen_columns(grid: VoxelGrid, free: VoxelGrid | None, into: Sim3, floors: Array) -> Array:
    """Compute unique (storey, ix, iy) of the columns of which a map knows anything, in another frame."""
    points = [grid.compute_centroids()] + ([free.compute_centroids()] if free is not None else [])
    at = into.apply(np.concatenate(points))
    storey = np.searchsorted(floors - CEILING_BELOW, at[:, 2]) - 1
    rows = np.column_stack([storey, np.floor(at[:, :2] / COLUMN_EDGE)]).astype(np.int64)
    return np.unique(rows[:, 0] * 2**40 + (rows[:, 1] + 2**18) * 2**20 + rows[:, 2] + 2**18)


def measure_common_area(pair: Pair, a: VoxelGrid, b: VoxelGrid, free: tuple[VoxelGrid | None, VoxelGrid | None]) -> float:
    """Measure the area, m2, of which both maps saw something, on the same storey."""
    if pair.truth is None or pair.kind != "overlap":
        return 0.0
    floors = np.unique(np.round([r.floor for r in pair.a.rooms] or [-1e3], 1))
    both = np.intersect1d(compute_seen_columns(a, free[0], Sim3(), floors), compute_seen_columns(b, free[1], pair.truth, floors))
    return float(len(both) * COLUMN_EDGE**2)


def measure_wing_difference(pair: Pair) -> float | None:
    """Measure, m, how far the outlines of rooms in a twin wing differ at most when one map lies on the other.

    Where that is little, nobody can tell the wings apart.
    """
    if pair.kind != "twin-wing":
        return None
    labels = [c.labels if c.labels is not None else np.zeros(0, int) for c in (pair.a, pair.b)]
    seen = [np.bincount(k[k >= 0], minlength=len(pair.a.rooms)) >= POINTS_SHOWN for k in labels]
    both = np.flatnonzero(np.logical_and.reduce(seen))
    if not len(both):
        return NOTHING_IN_COMMON
    outlines = [[np.asarray(c.rooms[i].polygon)[:, :2] for i in both] for c in (pair.a, pair.b)]
    turned = [measure_outline_misfit(np.concatenate(outlines[0]), np.concatenate([p[::k] for p in outlines[1]])) for k in (1, -1)]
    return min(turned)


def measure_outline_misfit(a: Array, b: Array) -> float:
    """Measure the largest distance of points that belong to each other, after turning and moving b."""
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    turn = np.angle(((p @ (1, 1j)) * np.conj(q @ (1, 1j))).sum())
    return float(np.abs(p @ (1, 1j) - np.exp(1j * turn) * (q @ (1, 1j))).max())


def build_pair_arrays(pair: Pair, about: dict[str, object]) -> dict[str, Array]:
    """Build the cached arrays of a pair."""
    grids = [build_grid(c) for c in (pair.a, pair.b)]
    free = tuple(
        compute_free_grid(c, g) if s == "laser2d" else None for c, g, s in zip((pair.a, pair.b), grids, pair.sensors, strict=True)
    )
    common = measure_common_area(pair, grids[0], grids[1], (free[0], free[1]))
    out: dict[str, Array] = {}
    for side, grid, empty in zip("ab", grids, free, strict=True):
        out |= build_grid_arrays(side, grid, empty)
    out["truth"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
    of_pair = {k: getattr(pair, k) for k in ("sensors", "kind", "building", "overlap")}
    about = {**about, **of_pair, "common": common, "differs": measure_wing_difference(pair)}
    out["about"] = np.frombuffer(json.dumps(about, sort_keys=True, default=str).encode(), np.uint8)
    return out


def build_grid_arrays(side: str, grid: VoxelGrid, empty: VoxelGrid | None) -> dict[str, Array]:
    """Build the cached arrays of a map: occupied cells with the middles of their points, and empty cells where they are known."""
    out = {f"{side}.cells": grid.cells.astype(np.int16), f"{side}.origin": grid.origin, f"{side}.shape": np.array(grid.shape)}
    out[f"{side}.mean"] = grid.properties["offset"]
    if empty is None:
        return out
    out[f"{side}.shape"] = np.maximum(grid.shape, empty.shape)  # floor may be seen past the last wall
    return {**out, f"{side}.free": empty.cells.astype(np.int16)}


def load_grids(path: str | Path) -> GridPair:
    """Load a cached pair."""
    return unpack_pair(Path(path).stem, archive.read(path, "cached pair"))


def unpack_pair(name: str, data: Mapping[str, Array]) -> GridPair:
    """Return the pair of the arrays of a file."""
    about = json.loads(data["about"].tobytes())
    grids, free = [], []
    for side in "ab":
        shape = tuple(int(s) for s in data[f"{side}.shape"])
        cells, origin = data[f"{side}.cells"].astype(np.int32), data[f"{side}.origin"]
        grids.append(VoxelGrid(cells, origin, GRID_EDGE, shape, {"offset": data[f"{side}.mean"]}))  # type: ignore[arg-type]
        empty = data.get(f"{side}.free")
        free.append(None if empty is None else VoxelGrid(empty.astype(np.int32), origin, GRID_EDGE, shape))  # type: ignore[arg-type]
    truth = convert_to_sim3(data["truth"])
    return GridPair(name, grids[0], grids[1], (free[0], free[1]), truth, float(about["common"]), about)
