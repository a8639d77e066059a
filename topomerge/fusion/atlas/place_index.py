"""An index of the storeys of an atlas, for `locate`, and the search in it: poses of a single scan are looked for in large cells,
ranked by a few of its columns, and described. What is made of each map once lies in a file beside it, read when it is needed.

| file of a map, `locate/KEY.npz` | content |
|---|---|
| `k.head`, `k.directions` | numbers of storey k, and along which directions its walls line up |
| `k.coarse` | walls and clear floor in large cells along the main direction, by which poses are looked for |
| `k.wall`, `k.inside`, `k.bits`, `k.floor`, `k.ceiling`, `k.rooms` | its plan, and the room of each column |
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy import fft, ndimage

from topomerge import archive
from topomerge.errors import InputError
from topomerge.extraction.plans.storey_plan import HEIGHT_BANDS, StoreyPlan
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.io.maps import load_landmarks, load_map
from topomerge.landmarks.map_search import LandmarkIndex, build_landmark_index
from topomerge.matching.poses import PlanFields, PoseHypothesis, wrap_yaw
from topomerge.registration.judge import Judge
from topomerge.registration.search import find_yaw_candidates
from topomerge.registration.storeys import build_plans
from topomerge.types import Array, Sim3, TopometricMap, are_within, find_room_names

INDEX_FOLDER, INDEX_VERSION, KIND = "locate", 1, "file of an index of places"
ADVICE = "delete the folder `locate` of the atlas, it is made again"
COARSE_CELL = 0.4  # m
ROOM_REACH = 1.0  # m, from a place to the floor of its room
PLANS_AT_ONCE = 96  # storeys whose plans are in memory
HEAD = ("version", "x", "y", "edge", "base_floor", "base_ceiling", "observed", "sliced", "turn", "low_x", "low_y")
HIGHEST_SIDE = 20_000  # columns along a side


@dataclass(frozen=True, eq=False)
class CoarseImage:
    """A storey in large cells, turned so that its walls lie along the axes.

    Args:
        turn: rad, by which the axes of the image are turned in the frame of the map.
        low: (2,) m, of the corner of cell (0, 0) in the turned frame.
        walls, clear: (nx, ny) float32 0..1, share of walls and of floor on which nothing stands.
    """

    turn: float
    low: Array
    walls: Array
    clear: Array


@dataclass(frozen=True, eq=False)
class IndexedStorey:
    """A storey of a map of the index.

    Args:
        map, number: of the map in the index and of the storey in it, lowest first.
        directions: (360,) profile of its walls (`PlanFields.profile`).
        load: gives its plan and the rooms of its columns (nx, ny), -1 none.
    """

    map: int
    number: int
    directions: Array
    coarse: CoarseImage
    load: Callable[[], tuple[PlanFields, Array]]


@dataclass(frozen=True, eq=False)
class IndexedMap:
    """A map of the index.

    Args:
        building: number of the component of the atlas in which it lies.
        pose: of the map in the frame of that.
        load: gives the map.
        rooms: names of its rooms by its landmarks; none where it has no landmarks.
    """

    name: str
    building: int
    pose: Sim3
    load: Callable[[], TopometricMap]
    rooms: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class PlaceIndex:
    """Maps and their storeys, and what their landmarks say."""

    maps: tuple[IndexedMap, ...]
    storeys: tuple[IndexedStorey, ...]
    landmarks: LandmarkIndex

    @classmethod
    def from_maps(cls, maps: Mapping[str, TopometricMap]) -> PlaceIndex:
        """Build an index of maps in memory; each is a building of its own."""
        listed = [IndexedMap(name, k, Sim3(), partial(_get, map), name_rooms(map)) for k, (name, map) in enumerate(maps.items())]
        memory = _Plans()
        storeys = [s for k, map in enumerate(maps.values()) for s in _parse_storeys(k, build_arrays(map), memory, None)]
        return cls(tuple(listed), tuple(storeys), build_landmark_index(list(maps.values())))


class _Plans:
    """The plans that were asked for last."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, int], tuple[PlanFields, Array]] = OrderedDict()

    def get(self, key: tuple[int, int], read: Callable[[], tuple[PlanFields, Array]]) -> tuple[PlanFields, Array]:
        if key not in self._kept:
            self._kept[key] = read()
            while len(self._kept) > PLANS_AT_ONCE:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


def open_index(folder: str | Path) -> PlaceIndex:
    """Open the index of an atlas; what it lacks is made now, and kept where the folder can be written.

    Raises:
        InputError: no atlas, an empty one, or a damaged file.
    """
    stored = read_atlas(folder)
    if not stored.entries:
        raise InputError(f"{folder}: holds no maps yet; add some with `topomerge atlas add {folder} MAP ...`")
    poses, memory = stored.get_poses(), _Plans()
    maps, storeys, witnesses = [], [], []
    for k, entry in enumerate(stored.entries):
        source, path = stored.folder / entry.file, stored.folder / INDEX_FOLDER / f"{entry.key}.npz"
        building, pose = poses.get(entry.name, (-1 - k, Sim3()))
        witness = load_map(source) if len(load_landmarks(source)[0]) else None
        maps.append(IndexedMap(entry.name, building, pose, partial(load_map, source), name_rooms(witness)))
        arrays = None if path.exists() else _write_arrays(load_map(source), path)
        storeys += _parse_storeys(k, arrays, memory, path)
        witnesses.append(witness)
    _remove_stale({e.key for e in stored.entries}, stored.folder / INDEX_FOLDER)
    return PlaceIndex(tuple(maps), tuple(storeys), build_landmark_index(witnesses))


def name_rooms(map: TopometricMap | None) -> tuple[str, ...]:
    """Name the rooms of a map by its landmarks: "" where none does."""
    return () if map is None or not len(map.landmarks) else tuple(find_room_names(map.landmarks, len(map.rooms)))


def _get(map: TopometricMap) -> TopometricMap:
    return map


def _write_arrays(map: TopometricMap, path: Path) -> dict[str, Array]:
    arrays = build_arrays(map)
    with suppress(InputError, OSError):  # an atlas that may only be read is searched all the same
        path.parent.mkdir(exist_ok=True)
        archive.write(arrays, path, effort=1)
    return arrays


def _remove_stale(keys: set[str], folder: Path) -> None:
    with suppress(OSError):
        for path in folder.glob("*.npz"):
            if path.stem not in keys:
                path.unlink()


def build_arrays(map: TopometricMap) -> dict[str, Array]:
    """Build the arrays of a map's file."""
    arrays: dict[str, Array] = {}
    plans = build_plans(map)
    for k, (plan, rooms) in enumerate(zip(plans, _draw_rooms(map, plans), strict=True)):
        fields = PlanFields(plan)
        coarse = draw_coarse_image(fields)
        levels = [plan.levels[0], plan.levels[1]]
        head = [INDEX_VERSION, *plan.origin, plan.edge, *levels, plan.observed, plan.sliced, coarse.turn, *coarse.low]
        images = np.rint(255 * np.stack([coarse.walls, coarse.clear])).astype(np.uint8)
        stored = {"head": np.array(head, float), "directions": fields.profile.astype(np.float32), "coarse": images}
        stored |= {"wall": plan.wall, "inside": plan.inside, "bits": plan.profile.astype(np.uint32)}
        stored |= {"floor": plan.floor.astype(np.float32), "ceiling": plan.ceiling.astype(np.float32), "rooms": rooms}
        arrays |= {f"{k}.{name}": array for name, array in stored.items()}
    return arrays


def draw_coarse_image(fields: PlanFields) -> CoarseImage:
    """Draw a storey in large cells along its main direction."""
    turn = fields.main_direction if len(fields.walls) else 0.0
    walls, clear = (turn_points(points, -turn) for points in (fields.walls, fields.plan.compute_points(fields.core)))
    both = np.concatenate([walls, clear]) if len(walls) + len(clear) else np.zeros((1, 2))
    low = both.min(axis=0) - COARSE_CELL
    nx, ny = (np.ceil(np.ptp(both, axis=0) / COARSE_CELL).astype(int) + 3).tolist()
    cells = (COARSE_CELL / fields.plan.edge) ** 2
    return CoarseImage(turn, low, draw_points(walls - low, (nx, ny), 3.0), draw_points(clear - low, (nx, ny), cells))


def draw_points(points: Array, size: tuple[int, int], full: float) -> Array:
    """Draw points (n, 2), m, as shares (nx, ny) of so many a cell."""
    cell = np.floor(points / COARSE_CELL).astype(np.int64)
    cell = cell[are_within(cell, 0, size)]
    count = np.bincount(cell[:, 0] * size[1] + cell[:, 1], minlength=size[0] * size[1]).reshape(size)
    return np.minimum(count / full, 1.0).astype(np.float32)


def turn_points(points: Array, yaw: float) -> Array:
    """Turn points (n, 2) about the origin."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _draw_rooms(map: TopometricMap, plans: Sequence[StoreyPlan]) -> Iterable[Array]:
    """Draw the (nx, ny) int16 room of the columns of each plan, -1 none: of the floor that is nearest within `ROOM_REACH`."""
    floor = map.navigable.compute_centroids()
    level = np.array([plan.floor_guess for plan in plans])
    owner = np.abs(floor[:, 2:] - level).argmin(axis=1) if len(floor) else np.zeros(0, int)
    for k, plan in enumerate(plans):
        rooms = np.full(plan.wall.shape, -1, np.int16)
        mine = (owner == k) & (map.navigable_room >= 0)
        cell = np.floor((floor[mine, :2] - plan.origin) / plan.edge).astype(np.int64)
        inside = are_within(cell, 0, rooms.shape)
        rooms[tuple(cell[inside].T)] = map.navigable_room[mine][inside]
        if inside.any():
            away, (i, j) = ndimage.distance_transform_edt(rooms < 0, return_indices=True)
            rooms = np.where(away * plan.edge <= ROOM_REACH, rooms[i, j], -1).astype(np.int16)
        yield rooms


def _parse_storeys(number: int, arrays: Mapping[str, Array] | None, memory: _Plans, path: Path | None) -> list[IndexedStorey]:
    """Return the storeys of a map, of arrays or of its file.

    Raises:
        InputError: the file is damaged, or of another version.
    """
    if arrays is None:
        assert path is not None
        names = archive.list_arrays(path, KIND)
        arrays = archive.read(path, KIND, [n for n in names if n.endswith((".head", ".directions", ".coarse"))])
    storeys = []
    for k in range(sum(name.endswith(".head") for name in arrays)):
        head, directions, images = (_check(arrays, f"{k}.{name}", path) for name in ("head", "directions", "coarse"))
        if head[0] != INDEX_VERSION:
            raise InputError(f"{path}: of another version; {ADVICE}")
        walls, clear = images.astype(np.float32) / 255
        coarse = CoarseImage(float(head[8]), head[9:11].copy(), walls, clear)
        held = {name: arrays[name] for name in arrays if name.startswith(f"{k}.")} if path is None else None
        load = partial(memory.get, (number, k), partial(_read_plan, held, path, k))
        storeys.append(IndexedStorey(number, k, directions.astype(float), coarse, load))
    return storeys


def _read_plan(held: Mapping[str, Array] | None, path: Path | None, k: int) -> tuple[PlanFields, Array]:
    names = [f"{k}.{name}" for name in ("head", "wall", "inside", "bits", "floor", "ceiling", "rooms")]
    arrays = held if held is not None else archive.read(path, KIND, names)  # type: ignore[arg-type]
    head, wall, inside, bits, floor, ceiling, rooms = (_check(arrays, name, path) for name in names)
    if any(a.shape != wall.shape for a in (inside, bits, floor, ceiling, rooms)):
        raise InputError(f"{path}: damaged; {ADVICE}")
    plan = StoreyPlan(
        head[1:3].copy(), float(head[3]), wall, inside, bits, HEIGHT_BANDS, floor.astype(float), ceiling.astype(float),
        levels=(float(head[4]), float(head[5])), observed=int(head[6]), sliced=bool(head[7]),
    )  # fmt: skip
    return PlanFields(plan), rooms


SHAPES = {"head": (np.float64, 1), "directions": (np.float32, 1), "coarse": (np.uint8, 3), "wall": (np.bool_, 2)}
SHAPES |= {"inside": (np.bool_, 2), "bits": (np.uint32, 2), "floor": (np.float32, 2), "ceiling": (np.float32, 2)}
SHAPES |= {"rooms": (np.int16, 2)}


def _check(arrays: Mapping[str, Array], name: str, path: Path | None) -> Array:
    """Return an array of a file, if it is what stands there.

    Raises:
        InputError: it is not.
    """
    kind, dimensions = SHAPES[name.partition(".")[2]]
    array = arrays.get(name)
    good = array is not None and array.dtype == kind and array.ndim == dimensions and max(array.shape) <= HIGHEST_SIDE
    if good and name.endswith(".head"):
        assert array is not None
        known = np.delete(array, [4, 5]) if len(array) == len(HEAD) else np.array([np.nan])
        good = bool(np.isfinite(known).all() and known[3] > 0 and np.isfinite(array[4:6]).any())
    if good and name.endswith(".directions"):
        assert array is not None
        good = len(array) == 360 and bool(np.isfinite(array).all())
    if not good or array is None or (name.endswith(".coarse") and len(array) != 2):
        raise InputError(f"{path}: damaged ({name}); {ADVICE}")
    return array


FARTHEST, CLEAR_WEIGHT, PEAKS = 30.0, 0.75, 16  # m of a scan that is searched by; of a wall on clear floor; of each yaw
FEATURES = (
    "sharp", "agree", "opposed", "conflict", "off", "missed", "blocked", "unlike_ceiling", "furniture", "moved", "level",
)  # fmt: skip
# As logarithms: a wall that was not seen, or a moved cupboard, says little more when it is large (docs/adr/0037).
AGAINST = slice(2, 7)  # of them
MOST_COLUMNS = 400.0  # of walls, of which more tell no more
WALL_ON_CLEAR, CLEAR_ON_WALL = 0.5, 2.0  # of shares of columns, against walls that meet


def search_coarsely(
    storeys: Sequence[IndexedStorey], query: PlanFields, most: int, of_storey: int
) -> list[tuple[float, int, Sim3]]:
    """Search storeys in large cells: score, number of the storey and pose without height, best first.

    Args:
        most: poses, at most.
        of_storey: ... of one storey.
    """
    found: list[tuple[float, int, Sim3]] = []
    turned = _TurnedQuery(query)
    for k, storey in enumerate(storeys):
        own = turned.correlate(storey)
        # Of each storey: right poses that were lost were 80th to 250th of all, but 9th at worst in their own (docs/adr/0037).
        found += [(score, k, pose) for score, pose in sorted(own, key=lambda f: -f[0])[:of_storey]]
    return sorted(found, key=lambda f: (-f[0], f[1]))[:most]


class _TurnedQuery:
    """A scan in large cells, at each turn and size of image once."""

    def __init__(self, query: PlanFields) -> None:
        self.query = query
        self.walls, self.clear = query.walls, query.plan.compute_points(query.core)
        both = np.concatenate([self.walls, self.clear])
        self.reach = min(float(np.hypot(*np.ptp(both, axis=0))), FARTHEST)
        self.cache: dict[tuple[int, tuple[int, int]], tuple[Array, Array, Array, float]] = {}

    def correlate(self, storey: IndexedStorey) -> list[tuple[float, Sim3]]:
        """Return the score, and the pose without height, at the best peaks of each likely yaw."""
        coarse = storey.coarse
        nx, ny = (_find_size(n, self.reach) for n in coarse.walls.shape)
        room = ((0, nx - coarse.walls.shape[0]), (0, ny - coarse.walls.shape[1]))
        walls, clear = (np.pad(image, room) for image in (coarse.walls, coarse.clear))
        near = np.minimum(ndimage.gaussian_filter(walls, 0.6) * 1.6, 1.0)
        agree, against = fft.rfft2(near - CLEAR_WEIGHT * clear), fft.rfft2(walls) * CLEAR_WEIGHT
        found: list[tuple[float, Sim3]] = []
        for yaw in find_yaw_candidates(storey.directions, self.query.profile, 3):
            step = round(float(np.degrees(yaw - coarse.turn))) % 360
            own, free, low, total = self._draw(step, (nx, ny))
            image = fft.irfft2(agree * own - against * free, (nx, ny)) / total
            for score, i, j in _find_peaks(image, coarse.walls.shape):
                shift = coarse.low + np.array([i, j]) * COARSE_CELL - low
                x, y = turn_points(shift[None], coarse.turn)[0].tolist()
                found.append((score, Sim3(wrap_yaw(coarse.turn + np.radians(step)), (x, y, 0.0))))
        return found

    def _draw(self, step: int, size: tuple[int, int]) -> tuple[Array, Array, Array, float]:
        if (step, size) not in self.cache:
            walls, clear = (turn_points(points, np.radians(step)) for points in (self.walls, self.clear))
            low = np.concatenate([walls, clear]).min(axis=0)
            cells = (COARSE_CELL / self.query.plan.edge) ** 2
            drawn = draw_points(walls - low, size, 3.0), draw_points(clear - low, size, cells)
            spectra = [np.conj(fft.rfft2(image)) for image in drawn]
            self.cache[step, size] = (*spectra, low, max(float(drawn[0].sum()), 1.0))  # type: ignore[assignment]
        return self.cache[step, size]


def _find_size(cells: int, reach: float) -> int:
    """Return the size, cells, of an image that holds a storey and a scan beside it; few different ones, so that much is
    shared."""
    return int(fft.next_fast_len(int(np.ceil((cells + reach / COARSE_CELL) / 16)) * 16, real=True))


def _find_peaks(image: Array, shape: tuple[int, ...]) -> list[tuple[float, int, int]]:
    """Return the score and shift, in cells, of the highest peaks; a shift beyond the storey is one back."""
    tops = np.where(image >= ndimage.maximum_filter(image, 3, mode="wrap"), image, -np.inf).ravel()
    best = np.argpartition(-tops, PEAKS)[:PEAKS]
    peaks = []
    for flat in best[np.lexsort((best, -tops[best]))].tolist():
        i, j = divmod(flat, image.shape[1])
        if np.isfinite(tops[flat]):
            peaks.append((float(tops[flat]), i - image.shape[0] * (i > shape[0]), j - image.shape[1] * (j > shape[1])))
    return peaks


def score_roughly(fields: PlanFields, query: PlanFields, poses: Sequence[PoseHypothesis], sample: int) -> list[float]:
    """Score refined poses by some columns: walls that meet, less walls of the scan on the map's clear floor, and less what the
    scan saw to be clear on the map's walls."""
    walls, clear = (points[:: max(len(points) // sample, 1)] for points in (query.walls, query.plan.compute_points(query.core)))
    return [
        pose.score
        - WALL_ON_CLEAR * _measure_share(walls, fields.core, fields, pose.transform)
        - CLEAR_ON_WALL * _measure_share(clear, fields.plan.wall, fields, pose.transform)
        for pose in poses
    ]


def _measure_share(points: Array, mask: Array, fields: PlanFields, pose: Sim3) -> float:
    """Measure the share of points (n, 2) of a scan that lie on columns of a mask."""
    at = turn_points(points, pose.yaw) + pose.translation[:2]
    cells = np.floor((at - fields.plan.origin) / fields.plan.edge).astype(np.int64)
    cells = cells[are_within(cells, 0, mask.shape)]
    return float(mask[cells[:, 0], cells[:, 1]].sum()) / max(len(points), 1)


def compute_features(judge: Judge, hypothesis: PoseHypothesis) -> Array:
    """Compute (11,) `FEATURES` of a refined pose: shares of the scan's walls times the root of their number, as neighbours depend
    on each other, and what floor, ceiling and furniture show.

    Of what speaks against a pose logarithms count: one moved wall is as little as ten.
    """
    pose = hypothesis.transform
    seen, back = judge.tally(pose)
    features = judge(pose)
    column = judge.b[0].plan.edge ** 2
    total = max(float(seen[10]), column)
    root = float(np.sqrt(min(total / column, MOST_COLUMNS)))
    shares = np.array([seen[1], seen[2], seen[3], seen[0] - seen[1:4].sum(), back[0] - back[1] - back[2]]) / total
    clutter, met = seen[6] + back[6], seen[7] + back[7]
    by_chance = (seen[9] + back[9]) / max(float(seen[8] + back[8]), 1e-6)
    lift = float(met - by_chance * clutter) / 0.4
    blocked = (seen[4] - seen[5]) / max(float(seen[4]), 1e-6) * np.sqrt(min(seen[4] / column, 1000.0))
    ceiling = min(features["ceilings"], 0.4) * min(features["ceiling_area"] / 10.0, 1.0)
    rest = [blocked, ceiling, np.sign(lift) * np.log1p(abs(lift)), np.sqrt(max(float(clutter - met), 0.0) / 0.4)]
    found = np.array([hypothesis.score * root, *(shares * root), *rest, min(features["level"], 0.5)])
    found[AGAINST] = np.sign(found[AGAINST]) * np.log1p(np.abs(found[AGAINST]))
    return found
