"""How likely a room is one, was seen as a whole, was entered, and lies outside: logistic models over `compute_room_features`.

Fitted to simulated scans of training buildings by ``train.py task=compute_room_odds``; the weights stand in `room_odds.json`.
Where the
places of the sensor are known, they say who was where; elsewhere, what of each room was seen. Robots' grids and drawings have
models of their own, as they show neither ceilings nor how high things are, and free floor wherever a ray went.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import edt
import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree

from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.extraction.completeness import WALL_SIGHT
from topomerge.extraction.storeys import measure_floor_to_ceiling
from topomerge.kernels import run_side_by_side
from topomerge.kernels.rays import is_seen_from
from topomerge.numpy_nn import sigmoid
from topomerge.types import ROOM_ODDS, Array, TopometricMap, are_within, compute_extent, select_lowest_of_column

# What tells a room that somebody was in from one that was only looked into: a row of numbers a room, and one of its poses.
#
# From the next room one sees no wall that its own door is in, little of the ceiling, and what stands deep in it thinly. All
# numbers are shares or logarithms, so that they do not change with the frame, and little with the size of a cell.

ROOM_FEATURES = (
    "completeness",  # share of the outline at which a wall was seen
    "log_area",  # of m2
    "log_width",  # of m: twice the area over the outline
    "ceiling",  # share of its floor with something above it
    "map_ceiling",  # the same of all rooms of the map
    "floor_seen",  # share of its floor where a body fits: the rest was hidden, or is under furniture
    "log_density",  # of occupied cells a column, beside the map's mean
    "log_cells",  # of occupied cells a column
    "walls_hidden",  # share of its walls that nobody sees who stands in another room
    "log_hidden",  # of 1 + m of them
    "contact",  # share of its outline beside which the floor of another room goes on
    "between",  # share of its floor that lies between other rooms of the storey: within their convex hull
    "floor_step",  # m that its floor is higher or lower than the storey
)
GRID_FEATURES = (  # of robots' grids and drawings, whose walls were all raised alike
    "completeness",
    "log_area",
    "log_width",
    "floor_seen",
    "walls_hidden",
    "log_hidden",
    "contact",
    "between",
    "open_outline",  # share of its outline beside which there is neither a wall nor the floor of another room: rays end there
    "thin",  # share of its floor that is narrower than a body and its way: single rays
)
POSE_FEATURES = (
    "stood_in",  # 1: a place of the sensor is over its floor
    "own_rays",  # share of what was seen of it that was seen from there
)
SIGHT_CELL = 0.1  # m: finer maps are looked at with about this
VIEWPOINTS = 3.0  # m about a room: from there others look into it
VIEW_STEP = 0.3  # m between them
SIGHT_REACH = 8.0  # m
WALL_BESIDE = 0.2  # m between the floor's edge and a wall
THIN_HALF_WIDTH, THIN_REACH = 0.45, 0.55  # m: floor is thin that is farther than the second from all that is wider than the first
BODY = 1.6  # m: lower things over the floor are no ceiling
POSE_REACH = 0.4  # m beside the floor: places of a sensor in a narrow room, or adrift
POSE_HEIGHTS = (-0.5, 3.0)  # m above the floor
RAYS_OVER_FLOOR = 0.5  # share that begins over the floor of rooms; with fewer the poses are of another frame


@dataclass(frozen=True, eq=False)
class _StoreyFloor:
    """The floor of a storey's rooms from above, (nx, ny) each: room (-1 none), something above?, does a body fit?, a wall?

    Args:
        height: (nx, ny) m of the floor over that of the storey.
        edge: of a column, m.
    """

    room: Array
    ceiling: Array
    standing: Array
    wall: Array
    height: Array
    edge: float


def compute_room_features(map: TopometricMap, names: Sequence[str] = ROOM_FEATURES, asked: Array | None = None) -> Array:
    """Return (R, F) features of a map that need no poses.

    Args:
        names: of `ROOM_FEATURES` and `GRID_FEATURES`.
        asked: (R,) bool, of which rooms all features are asked for; None: of all.
    """
    rooms = map.rooms
    table = {name: np.zeros(len(rooms)) for name in (*ROOM_FEATURES, *GRID_FEATURES)}
    covered = np.zeros((2, len(rooms)))  # columns with a ceiling, and all

    def measure(storey: _StoreyFloor) -> None:  # each writes what is of its own rooms
        hulls = _Hulls(storey)
        for room, window in _iter_windows(storey):
            own = storey.room[window] == room
            covered[:, room] = storey.ceiling[window][own].sum(), own.sum()
            if asked is not None and not asked[room]:
                continue
            table["floor_seen"][room] = storey.standing[window][own].mean()
            table["floor_step"][room] = abs(np.median(storey.height[window][own]))
            table["between"][room] = hulls.measure_share_between(room)
            for name, value in _measure_outline(storey, room, window).items():
                table[name][room] = value

    run_side_by_side(measure, list(_iter_storey_floors(map)))
    columns = np.maximum(covered[1], 1)
    cells = np.maximum(rooms["cells"], 1) / columns
    mean = np.average(cells, weights=columns) if len(rooms) else 1.0
    table["ceiling"] = covered[0] / columns
    table["map_ceiling"][:] = covered[0].sum() / max(covered[1].sum(), 1)
    table["completeness"] = rooms["completeness"]
    table["log_area"] = np.log(np.maximum(rooms["area"], 0.1))
    table["log_density"], table["log_cells"] = np.log(cells / mean), np.log(cells)
    return np.stack([table[name] for name in names], axis=1)


def compute_pose_features(map: TopometricMap, rays: tuple[Array, Array] | None) -> Array | None:
    """Return (R, 2) `POSE_FEATURES`; None where no place of the sensor is known, or most are over no room's floor.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m, in the map's frame.
    """
    if rays is None or not len(map.rooms):
        return None
    starts, ends = (np.asarray(part, np.float64).reshape(-1, 3) for part in rays)
    finite = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
    starts = starts[finite]
    moved = np.append(True, (starts[1:] != starts[:-1]).any(axis=1))[: len(starts)]  # the rays of one place follow each other
    stood = _find_rooms_below(map, starts[moved])[np.cumsum(moved) - 1]
    if not len(stood) or (stood >= 0).mean() < RAYS_OVER_FLOOR:
        return None
    cell = map.grid.find_rows(map.grid.locate(ends[finite]))
    met = np.where(cell >= 0, map.room[cell], -1)
    count = len(map.rooms)
    of_room = np.bincount(met[met >= 0], minlength=count)
    from_within = np.bincount(met[(met >= 0) & (met == stood)], minlength=count)
    entered = np.bincount(stood[stood >= 0], minlength=count) > 0
    return np.stack([entered, from_within / np.maximum(of_room, 1)], axis=1).astype(float)


def _find_rooms_below(map: TopometricMap, places: Array) -> Array:
    """Return (n,) room over whose floor each place is, -1 none."""
    rows = select_lowest_of_column(map.navigable)
    rows = rows[map.navigable_room[rows] >= 0]
    floor = map.navigable.compute_centroids(map.navigable.cells[rows])
    room = np.full(len(places), -1)
    for storey, level in enumerate(map.storeys["floor"]):
        mine = map.rooms["storey"][map.navigable_room[rows]] == storey
        above = (places[:, 2] > level + POSE_HEIGHTS[0]) & (places[:, 2] < level + POSE_HEIGHTS[1])
        if mine.any() and above.any():
            far, nearest = cKDTree(floor[mine, :2]).query(places[above, :2])
            room[above] = np.where(far <= POSE_REACH, map.navigable_room[rows[mine]][nearest], room[above])
    return room


def _iter_storey_floors(map: TopometricMap) -> Iterator[_StoreyFloor]:
    """Yield the storeys that have rooms, lowest first."""
    factor = max(round(SIGHT_CELL / map.grid.edge), 1)
    rows = select_lowest_of_column(map.navigable)
    rows = rows[map.navigable_room[rows] >= 0]
    room = map.navigable_room[rows]
    lowest = map.navigable.select_cells(rows)
    above = measure_floor_to_ceiling(map.grid, lowest, BODY) > 0
    standing = np.asarray(map.navigable.properties.get("standing", np.ones(len(map.navigable), bool)), bool)[rows]
    z, floor_z = map.grid.compute_centroids()[:, 2], lowest.compute_centroids()[:, 2]
    for storey, level in enumerate(map.storeys["floor"]):
        mine = map.rooms["storey"][room] == storey
        if not mine.any():
            continue
        at = lowest.cells[mine][:, :2].astype(np.int64) // factor
        low, high = compute_extent(at)
        low -= 1
        shape, at = high - low + 2, tuple((at - low).T)
        tall = (z > level + WALL_SIGHT[0]) & (z < level + WALL_SIGHT[1])
        filled = map.grid.cells[tall][:, :2].astype(np.int64) // factor - low
        filled = filled[are_within(filled, 0, shape)]
        label, flags, height = np.full(shape, -1), np.zeros((3, *shape), bool), np.zeros(shape)
        label[at], height[at] = room[mine], floor_z[mine] - level
        flags[0][at], flags[1][at] = above[mine], standing[mine]
        flags[2][tuple(filled.T)] = True
        yield _StoreyFloor(label, flags[0], flags[1], flags[2], height, map.grid.edge * factor)


def _iter_windows(storey: _StoreyFloor) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """Yield each room of a storey with the part of the raster from where others look into it."""
    pad = round(VIEWPOINTS / storey.edge)
    for room, box in enumerate(ndimage.find_objects(storey.room + 1)):
        if box is not None:
            x, y = (slice(max(side.start - pad, 0), side.stop + pad) for side in box)
            yield room, (x, y)


def _measure_outline(storey: _StoreyFloor, room: int, window: tuple[slice, slice]) -> dict[str, float]:
    """Measure the outline of a room: what it borders on.

    Args:
        window: the part of the raster from where others look into it; the outline itself is looked for in the room's own box.
    """
    label = storey.room[window]
    free = label >= 0
    reach = max(round(WALL_BESIDE / storey.edge), 1)
    box, corner = _find_box(label == room, reach)
    own = label[box] == room
    near = ndimage.binary_dilation(storey.wall[window][box], np.ones((2 * reach + 1, 2 * reach + 1)))
    end = own & ndimage.binary_dilation(~own, border_value=1)
    contact = end & ndimage.binary_dilation(free[box] & ~own)
    step = max(round(VIEW_STEP / storey.edge), 1)
    views = np.argwhere((free & (label != room))[::step, ::step]) * step
    walls = np.argwhere(end & ~contact & near) + corner
    hidden = ~is_seen_from(free, np.ascontiguousarray(walls), np.ascontiguousarray(views), SIGHT_REACH / storey.edge)
    around = max(int(end.sum()), 1)
    return {
        "log_width": float(np.log(2 * own.sum() / around * storey.edge)),
        "walls_hidden": float(hidden.mean()) if len(walls) else 0.0,
        "log_hidden": float(np.log1p(hidden.sum() * storey.edge)),
        "contact": float(contact.sum() / around),
        "open_outline": float((end & ~contact & ~near).sum() / around),
        "thin": measure_thin_share(own, storey.edge),
    }


def _find_box(mask: Array, margin: int) -> tuple[tuple[slice, slice], Array]:
    """Return the box around a mask (nx, ny) bool that has any, with a margin where there is room for it, and its corner (2,)."""
    x, y = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    low = np.maximum([x[0] - margin, y[0] - margin], 0)
    return (slice(low[0], x[-1] + margin + 1), slice(low[1], y[-1] + margin + 1)), low


def measure_thin_share(own: Array, edge: float) -> float:
    """Measure the share of a room's columns (nx, ny) that are farther than `THIN_REACH` from what is `THIN_HALF_WIDTH` from its
    outline."""
    wide = edt.edt(np.pad(own, 1).view(np.uint8), parallel=1)[1:-1, 1:-1] * edge >= THIN_HALF_WIDTH
    if not wide.any():
        return 1.0
    away = edt.edt((~np.pad(wide, 1)).view(np.uint8), parallel=1)[1:-1, 1:-1] * edge
    return float((away[own] > THIN_REACH).mean())


class _Hulls:
    """Convex hulls of the rooms of a storey."""

    def __init__(self, storey: _StoreyFloor) -> None:
        at = np.argwhere(storey.room >= 0)
        room = storey.room[tuple(at.T)]
        order = np.argsort(room, kind="stable")
        numbers, first = np.unique(room[order], return_index=True)
        self.columns = dict(zip(numbers.tolist(), np.split(at[order].astype(float), first[1:]), strict=True))
        rings = {n: np.concatenate([columns, columns[:1]]) for n, columns in self.columns.items()}  # of two points at least
        self.hulls = {n: shapely.convex_hull(shapely.linestrings(ring)) for n, ring in rings.items()}

    def measure_share_between(self, room: int) -> float:
        """Measure the share of a room's columns within the convex hull of all other rooms."""
        others = [hull for n, hull in self.hulls.items() if n != room]
        if not others:
            return 0.0
        hull = shapely.convex_hull(shapely.geometrycollections(others))
        return float(shapely.contains_xy(hull, self.columns[room]).mean())


ROOM_ODDS_FILE = "room_odds.json"
ENTERED_BY_POSES = "entered_by_poses"  # the model of `entered` that knows the sensor's places
COVER = ROOM_FEATURES.index("map_ceiling")
STANDARD = ("low", "high", "mean", "scale")  # of the features: what they are clipped to and divided by


class Family(NamedTuple):
    """Models that are fitted to the same scans and share what their features are divided by.

    Args:
        key: in `room_odds.json`; empty: at its top.
        features: names.
        lengths: number of weights of each model.
    """

    key: str
    features: tuple[str, ...]
    lengths: dict[str, int]


_SCAN_LENGTH, _GRID_LENGTH = 1 + 3 * len(ROOM_FEATURES), 1 + 2 * len(GRID_FEATURES)
SCANS = Family(
    "",
    (*ROOM_FEATURES, *POSE_FEATURES),
    {**dict.fromkeys(("confidence", "whole", "entered"), _SCAN_LENGTH), ENTERED_BY_POSES: _SCAN_LENGTH + len(POSE_FEATURES)},
)
OPEN_SCANS = Family("open", ROOM_FEATURES, {"outside": _SCAN_LENGTH})  # of buildings with their surroundings
GRIDS = Family("grids", GRID_FEATURES, dict.fromkeys(ROOM_ODDS, _GRID_LENGTH))
FAMILIES = {"scans": SCANS, "open": OPEN_SCANS, "grids": GRIDS}


def add_room_probabilities(
    map: TopometricMap, rays: tuple[Array, Array] | None = None, raised: bool = False, asked: Array | None = None
) -> TopometricMap:
    """Return the map with the probabilities of its rooms; those that were probably not entered are `glimpsed`.

    Args:
        rays: (k, 3) places of the sensor and (k, 3) of what it saw, m; None where they are unknown.
        raised: is it a robot's grid or a drawing?
        asked: (R,) bool, of which rooms; those of the others are known. None: of all.

    Raises:
        InputError: the weights that ship are damaged.
    """
    rooms = map.rooms.copy()
    weights = load_room_weights()
    asked = np.ones(len(rooms), bool) if asked is None else asked
    x = compute_room_features(map, GRID_FEATURES if raised else ROOM_FEATURES, asked)
    for family in (GRIDS,) if raised else (SCANS, OPEN_SCANS):
        for name in family.lengths:
            if name in ROOM_ODDS:
                rooms[name] = np.where(asked, compute_probability(weights, family, name, x), rooms[name])
    poses = None if raised else compute_pose_features(map, rays)
    if poses is not None:
        rooms["entered"] = np.where(asked, compute_probability(weights, SCANS, ENTERED_BY_POSES, x, poses), rooms["entered"])
    rooms["glimpsed"] = rooms["entered"] < 0.5
    return replace(map, rooms=rooms)


def compute_probability(weights: dict[str, Any], family: Family, name: str, x: Array, poses: Array | None = None) -> Array:
    """Return (R,) probability by the model of a name.

    Args:
        weights: as `load_room_weights` gives them.
        x: (R, F) features of the family.
        poses: (R, 2) of `compute_pose_features`, for the model that takes them.
    """
    of_family = weights[family.key] if family.key else weights
    return sigmoid(np.clip(build_model_inputs(of_family, family, x, poses) @ np.asarray(of_family[name], float), -30, 30))


def build_model_inputs(standard: dict[str, Any], family: Family, x: Array, poses: Array | None = None) -> Array:
    """Return (R, 1 + k F) what the models weigh: 1, the features in units of their spread, those times the map's share of
    ceiling, for where no ceiling is seen other things count (not of grids, which have none), and their squares."""
    low, high, mean, scale = (np.asarray(standard[part], float) for part in STANDARD)
    z = (np.clip(x, low, high) - mean) / scale
    by_ceiling = [] if family is GRIDS else [z * (2 * x[:, [COVER]] - 1)]
    columns = [np.ones((len(x), 1)), z, *by_ceiling, z**2]
    return np.concatenate(columns if poses is None else [*columns, poses], axis=1)


def load_room_weights() -> dict[str, Any]:
    """Return the weights that are in use.

    Raises:
        InputError: damaged, or fitted to other features.
    """
    weights = read_weights_json("topomerge.extraction", ROOM_ODDS_FILE)
    for family in FAMILIES.values():
        _check(weights.get(family.key, {}) if family.key else weights, family)
    return weights


def _check(weights: Any, family: Family) -> None:
    """Refuse weights of a family that are damaged or were fitted to other features."""
    if not isinstance(weights, dict) or weights.get("features") != list(family.features):
        raise InputError(f"{ROOM_ODDS_FILE}: was fitted to other features: run train.py task=room_odds export=package")
    count = len([name for name in family.features if name not in POSE_FEATURES])
    for name, length in {**dict.fromkeys(STANDARD, count), **family.lengths}.items():
        values = np.array(weights.get(name, ()), float)
        if values.shape != (length,) or not np.isfinite(values).all():
            raise InputError(f"{ROOM_ODDS_FILE}: {name} must be {length} numbers: run train.py task=room_odds export=package")
