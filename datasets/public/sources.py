"""Public 3D sets whose terms forbid passing them on, read as their owners publish them.

| source | folder | pairs |
|---|---|---|
| `s3dis` | `Area_1` ... with a folder a room | two connected parts of an area |
| `matterport` | a folder a house | two connected parts of a house |
| `rscan` | `3RScan.json` and a folder a scan | a scan of a room and one of a later day |
| `cslamd` | `FlatMap`, `House`, `Lab`, `Priory` | two sequences of a building |
| `scannet` | a folder a scan | none: no truth is published; `scannet.group_scans_by_place` groups the scans of a place |

Each is a module `topomerge.datasets.public.<source>` with a function ``pairs(folder)``, which gives the name and the maker of
each pair, as the sources of `datasets.real` do. `cslamd` maps an assumption or two; see there.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree
from topomerge.datasets.pairs.flat_maps import measure_floor_overlap, thin
from topomerge.datasets.pairs.pairs import Pair, draw_frames, find_common_rooms
from topomerge.datasets.pairs.parts import compute_dice
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.plans.sealed import refuse_building
from topomerge.datasets.real.sources import collect
from topomerge.datasets.simulation.scanner import transform_cloud

from topomerge.errors import InputError
from topomerge.types import Array, PointCloud, Sim3, TrueRoom

PUBLIC_SOURCES = ("s3dis", "matterport", "rscan", "cslamd")
POINT_SPACING = 0.05  # m between the points that are kept
LARGEST_JSON = 500 << 20  # bytes
NEIGHBOUR_DISTANCE = 0.35  # m; rooms with points that near each other are neighbours
TOUCHING_POINTS = 5  # points that must be that near
PART_SHARE = 0.6  # share of the rooms that each of two parts has at most
LEAST_ROOMS_TO_CUT = 4  # rooms that can be cut into two parts


def iter_public_pairs(folder: str | Path, source: str) -> Iterator[tuple[str, Pair | Refusal]]:
    """Yield every pair of a set; what is missing, damaged or sealed is a `Refusal`, and the rest goes on.

    Raises:
        InputError: no such folder or source.
    """
    if source not in PUBLIC_SOURCES:
        raise InputError(f"source {source!r}: {', '.join(PUBLIC_SOURCES)} are possible")
    if not Path(folder).is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds the data set")
    return collect(source, _guard_sealed(source, import_module(f"topomerge.datasets.public.{source}").iter_pairs(Path(folder))))


def _guard_sealed(source: str, makers: Iterator[tuple[str, Callable[[], Pair]]]) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the makers, of which those of sealed buildings refuse."""
    for name, make in makers:
        yield name, partial(_make_if_unsealed, source, name, make)


def _make_if_unsealed(source: str, name: str, make: Callable[[], Pair]) -> Pair:
    refuse_building(source, name)
    return make()


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        InputError: missing, far too large, or damaged.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; copy the data set again")
    if path.stat().st_size > LARGEST_JSON:
        raise InputError(f"{path}: has {path.stat().st_size >> 20} MB and the limit is {LARGEST_JSON >> 20} MB")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, or cut short ({str(error)[:80]}); copy it again") from error


def join_rooms(parts: Sequence[tuple[TrueRoom, Array]], source: str) -> PointCloud:
    """Join rooms and their points (n, 3) into one cloud, thinned to `POINT_SPACING`."""
    thinned = [thin(points, POINT_SPACING) for _, points in parts]
    points = np.concatenate(thinned)
    shift = np.round(points.mean(axis=0), 0) if np.abs(points).max() > 1000 else np.zeros(3)
    labels = np.repeat(np.arange(len(parts)), [len(p) for p in thinned]).astype(np.int32)
    rooms = tuple(room for room, _ in parts)
    return PointCloud((points - shift).astype(np.float32), shift, labels=labels, rooms=rooms, source=source)


def compute_hull(points: Array) -> Array:
    """Compute (k, 2) convex outline of points, counter-clockwise: where no outline is published."""
    shape = shapely.convex_hull(shapely.multipoints(points[:, :2]))
    if shape.geom_type != "Polygon":
        raise InputError("its points lie on one line; no room has this shape")
    return np.asarray(shapely.normalize(shape).exterior.coords)[-2::-1].copy()


def iter_part_pairs(
    folders: Sequence[Path], read: Callable[[Path], PointCloud], source: str
) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of a pair of parts of each building, which `read` gives as a labelled cloud."""
    for folder in folders:
        yield folder.name, partial(_make_part_pair, folder, read, source)


def _make_part_pair(folder: Path, read: Callable[[Path], PointCloud], source: str) -> Pair:
    return cut_pair(read(folder), folder.name, source, "matterport", zlib.crc32(folder.name.encode()))


def cut_pair(cloud: PointCloud, name: str, source: str, sensor: str, seed: int) -> Pair:
    """Cut two connected parts of a labelled cloud in random frames, a third to a half of their rooms in common, as in the thesis.

    Raises:
        InputError: too few rooms that hang together.
    """
    rng = np.random.default_rng(seed)
    a, b = sample_two_parts(find_room_neighbours(cloud), rng)
    frames = draw_frames(2, False, rng)
    maps = [transform_cloud(_select_rooms(cloud, part), frame) for part, frame in zip((a, b), frames, strict=True)]
    truth = frames[0] @ frames[1].inverse()
    one, other = maps
    shared, visited, both = find_common_rooms(one, other), (tuple(a), tuple(b)), (frames[0], frames[1])
    return Pair(name, one, other, truth, shared, compute_dice(a, b), (sensor, sensor), source, name, visited=visited, frames=both)


def _select_rooms(cloud: PointCloud, rooms: Sequence[int]) -> PointCloud:
    assert cloud.labels is not None
    in_rooms = np.isin(cloud.labels, rooms)
    return replace(cloud, points=cloud.points[in_rooms], labels=cloud.labels[in_rooms])


def find_room_neighbours(cloud: PointCloud) -> dict[int, set[int]]:
    """Find room -> rooms that lie side by side with it, through a thin wall or a door; rooms without points are left out."""
    assert cloud.labels is not None
    trees = {int(i): cKDTree(thin(cloud.points[cloud.labels == i], 0.1)) for i in np.unique(cloud.labels[cloud.labels >= 0])}
    out: dict[int, set[int]] = {i: set() for i in trees}
    for i, tree in trees.items():
        for j, other in trees.items():
            if (
                i < j
                and (tree.maxes + NEIGHBOUR_DISTANCE >= other.mins).all()
                and (other.maxes + NEIGHBOUR_DISTANCE >= tree.mins).all()
            ):
                near = np.isfinite(other.query(tree.data, distance_upper_bound=NEIGHBOUR_DISTANCE)[0])
                if near.sum() >= TOUCHING_POINTS:
                    out[i].add(j)
                    out[j].add(i)
    return out


def sample_two_parts(neighbours: dict[int, set[int]], rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Sample two connected sets of rooms that share a connected core.

    Raises:
        InputError: fewer than `LEAST_ROOMS_TO_CUT` rooms hang together.
    """
    whole = max((grow(neighbours, [i], len(neighbours), rng) for i in sorted(neighbours)), key=len, default=[])
    if len(whole) < LEAST_ROOMS_TO_CUT:
        raise InputError(f"only {len(whole)} rooms hang together; {LEAST_ROOMS_TO_CUT} are needed to cut two parts")
    count = max(int(PART_SHARE * len(whole)), 2)
    for _ in range(50):
        a = grow(neighbours, [int(rng.choice(whole))], count, rng)
        edge = [i for i in a if neighbours[i] - set(a)]
        inside = {i: neighbours[i] & set(a) for i in a}
        core = grow(inside, [int(rng.choice(edge))], max(count // 2, 1), rng)
        open_rooms = {i: neighbours[i] - (set(a) - set(core)) for i in neighbours if i not in set(a) - set(core)}
        b = grow(open_rooms, core, count, rng)
        if len(b) > len(core):
            return sorted(a), sorted(b)
    raise InputError("its rooms can't be cut into two parts that overlap")


def grow(neighbours: dict[int, set[int]], start: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """Grow connected rooms from those given, up to `count` of them."""
    out = list(start)
    while len(out) < count:
        edge = sorted(set().union(*(neighbours[i] for i in out)) - set(out))
        if not edge:
            break
        out.append(edge[int(rng.integers(len(edge)))])
    return out


def build_framed_pair(
    a: PointCloud, b: PointCloud, published: Sim3, name: str, source: str, building: str, sensor: str, seed: int
) -> Pair:
    """Build two clouds whose relation (b into a) is `published`, moved into random frames."""
    frames = draw_frames(2, False, np.random.default_rng(seed))
    truth = frames[0] @ published @ frames[1].inverse()
    flat = [c.points[:, :2].astype(np.float64) + c.shift[:2] for c in (a, b)]
    placed = published.apply(np.column_stack([flat[1], np.zeros(len(flat[1]))]))[:, :2]
    clouds = transform_cloud(a, frames[0]), transform_cloud(b, frames[1])
    return Pair(name, *clouds, truth, (), measure_floor_overlap(flat[0], placed), (sensor, sensor), source, building)
