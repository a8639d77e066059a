"""Pairs of voxel grids with known transforms for benchmarks of registration, made once and cached (resumable).

``python -m benchmarks.merging.pairs train 400`` simulates pairs of training buildings into ``cache/merge/train``; ``test``
those of
the test split. Every sixth pair has much moved furniture, every eighth glass walls, and a quarter must not merge; from seed 2 on
half of them must not, most of them hard to tell (`MANY`); seed 3 is of 2D slices and other storeys (`SLICES`).
Needs TOPOMERGE_DATA for the buildings from real plans; without it all are procedural.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.example import _first_pair, one_thread, time_limit
from topomerge.datasets.pairs.items import Item, draw_items, plans_of
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.pairs.recipe import Library, Recipe, library

from topomerge.extraction.voxels import voxelise
from topomerge.fusion.cell_means import with_means
from topomerge.io import archive
from topomerge.types import Array, PointCloud, Sim3, VoxelGrid

EDGE = 0.1  # m
COMMON = 0.2  # m, columns by which the area in common is measured
ELSEWHERE = 99.0  # m: nothing is shown by both
SHOWN = 200  # points of a room that a map shows
BELOW = 0.15  # m: what is that far below a floor is the storey below's ceiling
STEP = 0.08  # m along a ray
LONGEST = 120.0  # s a pair
WEIGHTS = {
    "sources": {"procedural": 0.65, "r2v": 0.1, "campus": 0.25},
    "kinds": {"office": 3, "openplan": 1, "apartment": 2, "hotel": 2, "hospital": 2, "school": 2, "lab": 1, "house": 1},
    "sensors": {"tls": 3, "lidar": 2, "depth": 3, "tablet": 1, "laser2d": 1},
    "hard": {"other-building": 0.13, "other-storey": 0.07, "twin-wing": 0.05},
}
MANY = {"other-building": 0.1, "other-storey": 0.15, "twin-wing": 0.25}  # hard negatives from seed 2 on
SLICES = {"other-storey": 0.6}  # hard negatives of seed 3, whose second map is a slice


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
        cells = self.b.centroids()
        if self.truth is not None:
            a = np.unique(np.floor(self.a.centroids() / 0.5).astype(np.int64), axis=0)
            b = np.floor(self.truth.apply(cells) / 0.5).astype(np.int64)
            key = [k[:, 0] * 2**42 + k[:, 1] * 2**21 + k[:, 2] for k in (a, b)]
            both = np.isin(key[1], key[0])
            cells = cells[both] if both.sum() > 50 else cells
        middle: Array = cells.mean(axis=0)
        return middle


def recipe(split: str, pairs: int, seed: int = 0) -> Recipe:
    """What the pairs are drawn from."""
    folder = os.environ.get("TOPOMERGE_DATA", "")
    sources = WEIGHTS["sources"] if folder else {"procedural": 1.0}
    hard = SLICES if seed == 3 else MANY if seed > 1 else WEIGHTS["hard"]
    return Recipe(
        name=f"merge_{split}", split=split, pairs=pairs, seed=seed, folder=folder, sources=dict(sources),
        kinds=dict(WEIGHTS["kinds"]), sensors=dict(WEIGHTS["sensors"]), hard=dict(hard),
        overlaps=[0.0, 0.1, 0.25, 0.4, 0.6], rooms=[4, 15], two_storeys=0.15,
    )  # fmt: skip


def items(split: str, pairs: int, seed: int = 0) -> tuple[list[Item], Library]:
    """The items, some made harder."""
    whole = recipe(split, pairs, seed)
    plans = library(whole)
    drawn = [_harder(i, item) for i, item in enumerate(draw_items(whole, plans))]
    return [replace(d, sensors=(d.sensors[0], "laser2d")) for d in drawn] if seed == 3 else drawn, plans


def _harder(i: int, item: Item) -> Item:
    told = dict(item.difficulty)
    if i % 6 == 5:
        told |= {"moved": 0.6, "gone": 0.25}
    if i % 8 == 7:
        told |= {"glass": 0.5}
    return replace(item, difficulty=tuple(sorted(told.items())))


def grid_of(cloud: PointCloud) -> VoxelGrid:
    """Occupied cells with the middle of their points."""
    return with_means(voxelise(cloud, EDGE), cloud.points.astype(np.float64) + cloud.shift)


def free_of(cloud: PointCloud, grid: VoxelGrid) -> VoxelGrid | None:
    """Cells that the rays of a cloud with poses crossed and that are not occupied."""
    if cloud.poses is None or cloud.pose_of is None:
        return None
    pick = np.flatnonzero(cloud.pose_of >= 0)
    ends = cloud.points[pick].astype(np.float64) + cloud.shift
    starts = cloud.poses[cloud.pose_of[pick], :3, 3]
    length = np.linalg.norm(ends - starts, axis=1)
    seen = []
    for d in np.arange(0.0, length.max(), STEP):
        on = length > d + 2 * grid.edge
        cells = grid.locate(starts[on] + (ends[on] - starts[on]) * (d / length[on])[:, None])
        inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
        seen.append(np.unique(cells[inside], axis=0))
    cells = np.unique(np.concatenate(seen), axis=0)
    return grid.with_cells(cells[~grid.contains(cells)])


def columns_seen(grid: VoxelGrid, free: VoxelGrid | None, into: Sim3, floors: Array) -> Array:
    """Unique (storey, ix, iy) of the columns of which a map knows anything, in another frame."""
    points = [grid.centroids()] + ([free.centroids()] if free is not None else [])
    at = into.apply(np.concatenate(points))
    storey = np.searchsorted(floors - BELOW, at[:, 2]) - 1
    rows = np.column_stack([storey, np.floor(at[:, :2] / COMMON)]).astype(np.int64)
    return np.unique(rows[:, 0] * 2**40 + (rows[:, 1] + 2**18) * 2**20 + rows[:, 2] + 2**18)


def common_area(pair: Pair, a: VoxelGrid, b: VoxelGrid, free: tuple[VoxelGrid | None, VoxelGrid | None]) -> float:
    """Area, m2, of which both maps saw something, on the same storey."""
    if pair.truth is None or pair.kind != "overlap":
        return 0.0
    floors = np.unique(np.round([r.floor for r in pair.a.rooms] or [-1e3], 1))
    both = np.intersect1d(columns_seen(a, free[0], Sim3(), floors), columns_seen(b, free[1], pair.truth, floors))
    return float(len(both) * COMMON**2)


def differs(pair: Pair) -> float | None:
    """Of a twin wing: by how much, m, the outlines of the rooms that both maps show differ at most when one lies on the other.

    Where that is little, nobody can tell the wings apart.
    """
    if pair.kind != "twin-wing":
        return None
    labels = [c.labels if c.labels is not None else np.zeros(0, int) for c in (pair.a, pair.b)]
    seen = [np.bincount(k[k >= 0], minlength=len(pair.a.rooms)) >= SHOWN for k in labels]
    both = np.flatnonzero(np.logical_and.reduce(seen))
    if not len(both):
        return ELSEWHERE
    outlines = [[np.asarray(c.rooms[i].polygon)[:, :2] for i in both] for c in (pair.a, pair.b)]
    turned = [_misfit(np.concatenate(outlines[0]), np.concatenate([p[::k] for p in outlines[1]])) for k in (1, -1)]
    return min(turned)


def _misfit(a: Array, b: Array) -> float:
    """Largest distance of points that belong to each other, after turning and moving b."""
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    turn = np.angle(((p @ (1, 1j)) * np.conj(q @ (1, 1j))).sum())
    return float(np.abs(p @ (1, 1j) - np.exp(1j * turn) * (q @ (1, 1j))).max())


def arrays_of(pair: Pair, told: dict[str, object]) -> dict[str, Array]:
    """What is cached of a pair."""
    grids = [grid_of(c) for c in (pair.a, pair.b)]
    free = tuple(free_of(c, g) if s == "laser2d" else None for c, g, s in zip((pair.a, pair.b), grids, pair.sensors, strict=True))
    common = common_area(pair, grids[0], grids[1], (free[0], free[1]))
    out: dict[str, Array] = {}
    for side, grid, empty in zip("ab", grids, free, strict=True):
        out[f"{side}.cells"], out[f"{side}.origin"] = grid.cells.astype(np.int16), grid.origin
        offset = (grid.properties["mean"] - grid.cell_bounds(grid.cells)[0]) / grid.edge
        out[f"{side}.mean"] = np.clip(offset * 256, 0, 255).astype(np.uint8)
        out[f"{side}.shape"] = np.array(grid.shape)
        if empty is not None:
            out[f"{side}.free"] = empty.cells.astype(np.int16)
    out["truth"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
    known = {k: getattr(pair, k) for k in ("sensors", "kind", "building", "overlap")}
    told = {**told, **known, "common": common, "differs": differs(pair)}
    out["about"] = np.frombuffer(json.dumps(told, sort_keys=True, default=str).encode(), np.uint8)
    return out


def sim3_of(matrix: Array) -> Sim3:
    """The similarity of a (4, 4) matrix."""
    scale = float(matrix[2, 2])
    x, y, z = matrix[:3, 3].tolist()
    return Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), scale)


def load(path: str | Path, mean: bool = False) -> GridPair:
    """A cached pair; `mean`: with the middles of the points of each cell, which maps that were extracted do not have."""
    return unpacked(Path(path).stem, archive.read(path, "cached pair"), mean)


def unpacked(name: str, data: Mapping[str, Array], mean: bool = False) -> GridPair:
    """The pair of the arrays of a file."""
    told = json.loads(data["about"].tobytes())
    grids, free = [], []
    for side in "ab":
        shape = tuple(int(s) for s in data[f"{side}.shape"])
        cells, origin = data[f"{side}.cells"].astype(np.int32), data[f"{side}.origin"]
        middle = origin + (cells + (data[f"{side}.mean"] + 0.5) / 256) * EDGE
        known = {"mean": middle.astype(np.float32)} if mean else {}
        grids.append(VoxelGrid(cells, origin, EDGE, shape, known))  # type: ignore[arg-type]
        empty = data.get(f"{side}.free")
        free.append(None if empty is None else VoxelGrid(empty.astype(np.int32), origin, EDGE, shape))  # type: ignore[arg-type]
    truth = None if np.isnan(data["truth"]).any() else sim3_of(data["truth"])
    return GridPair(name, grids[0], grids[1], (free[0], free[1]), truth, float(told["common"]), told)


def make(split: str, pairs: int, seed: int = 0, cache: str = "cache/merge") -> Iterator[Path]:
    """Make what is missing, one after the other; refused items leave an empty mark so that they are not tried again."""
    todo, plans = items(split, pairs, seed)
    folder = Path(cache) / split
    folder.mkdir(parents=True, exist_ok=True)
    for i, item in enumerate(todo):
        path, refused = folder / f"{seed}_{i:05d}.npz", folder / f"{seed}_{i:05d}.refused"
        if not path.exists() and not refused.exists():
            began = time.perf_counter()
            try:
                with one_thread(), time_limit(LONGEST):
                    told = {"difficulty": dict(item.difficulty), "source": item.source, "item": i}
                    archive.write(arrays_of(_first_pair(item, plans_of(item, plans)), told), path)
                print(f"{path.name} {time.perf_counter() - began:.1f} s", flush=True)
            except Exception as error:  # one bad item never ends a run
                refused.write_text(f"{type(error).__name__}: {error}")
        if path.exists():
            yield path


if __name__ == "__main__":
    which, number = sys.argv[1], int(sys.argv[2])
    for _ in make(which, number, int(sys.argv[3]) if len(sys.argv) > 3 else 0):
        pass
