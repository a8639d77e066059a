"""Look-alikes: pairs of maps of places made to be alike that must not be merged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from topomerge.datasets.buildings.furniture import compute_footprints
from topomerge.datasets.core.builder import (
    BuildReport,
    BuildRow,
    BuildSettings,
    build_set,
    check_sharing,
    make_item,
    select_items,
)
from topomerge.datasets.core.building import Building, Difficulty
from topomerge.datasets.core.solids import build_rotation
from topomerge.datasets.pairs.grid_pairs import GRID_FORMAT, LONGEST_GRID_PAIR, WEIGHTS, build_pair_arrays, unpack_pair
from topomerge.datasets.pairs.lookalike_places import FURNISHED, LOOKALIKES, LookalikePlaces, sample_places
from topomerge.datasets.pairs.pairs import Pair, draw_frames
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.floor_truth import fill
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.signs import (
    Reader,
    change_signs,
    draw_numbering,
    draw_other_numbering,
    place_signs,
    read_signs,
)

from topomerge.errors import InputError
from topomerge.types import Array, Landmarks, LogFn, Sim3, VoxelGrid

RULE_CELL = 0.1  # m
WALL_INSIDE, THING_APART = 0.3, 0.3  # m
WALLS_TELL, FITTED_TELLS, FURNITURE_TELLS, LEAST_FURNITURE = 1.0, 0.5, 0.3, 1.5  # m, m2, share, m2
SMALLEST_THING = 0.2  # m2 of its footprint
SHOWN_ABOVE = 0.2  # m by which a thing must reach into what a sensor shows
PASSING = ("leaf", "clutter", "person", "plant", "armchair")  # things that tell nothing
MARGIN = 1.0  # m around the rooms
COMPARABLE = 0.5  # share of the largest area that both show, from which on a pose counts


@dataclass(frozen=True, eq=False)
class VisiblePlace:
    """A place as it stood when it was scanned, and what the map shows of it.

    Args:
        building: after `session`.
        seen: (n, 2) columns, m, of which the map knows anything, in the building's coordinates.
        sensor: its name.
    """

    building: Building
    seen: Array
    sensor: str


@dataclass(frozen=True, eq=False)
class _PlaceRasters:
    """Rasters (rows, columns) of one place in a frame: floor with doorways, columns that are shown, furniture, fixtures."""

    floor: Array
    shown: Array
    movable: Array
    fitted: Array
    walls: Array  # (n, 2) row and column of points along the outlines


def measure_differences(a: VisiblePlace, b: VisiblePlace, pose: Sim3) -> dict[str, float]:
    """Measure the amounts by which two places differ when b's coordinates are mapped into a's; ``common``: m2 that both maps
    show."""
    corners = np.concatenate([r.polygon for r in a.building.rooms])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    shape = tuple(np.ceil((high - low)[::-1] / RULE_CELL).astype(int).tolist())
    lowest = max(get_sensor(s.sensor).lowest for s in (a, b)) + SHOWN_ABOVE
    first, second = (_rasterize_place(s, t, low, shape, lowest) for s, t in ((a, Sim3()), (b, pose)))
    both = first.shown & second.shown
    walls = fitted = stray = standing = 0.0
    for one, other in ((first, second), (second, first)):
        inside = ndimage.distance_transform_edt(other.floor) * RULE_CELL >= WALL_INSIDE
        rows, columns = one.walls.T
        walls += float((inside & both)[rows, columns].sum()) * RULE_CELL
        clear = other.floor & both & (ndimage.distance_transform_edt(~(other.movable | other.fitted)) * RULE_CELL > THING_APART)
        fitted += float((one.fitted & clear).sum()) * RULE_CELL**2
        stray += float((one.movable & clear).sum()) * RULE_CELL**2
        standing += float((one.movable & other.floor & both).sum()) * RULE_CELL**2
    share = stray / standing if standing >= LEAST_FURNITURE else 0.0
    common = float((both & first.floor & second.floor).sum()) * RULE_CELL**2
    rounded = {"walls": walls, "fitted": fitted, "furniture": share, "standing": standing, "common": common}
    return {name: round(value, 2) for name, value in rounded.items()}


def is_distinguishable(amount: Mapping[str, float]) -> bool:
    """Return whether the amounts of one pose tell the places apart."""
    return compute_strength(amount) >= 1.0


def compute_strength(amount: Mapping[str, float]) -> float:
    """Compute the largest amount in units of what tells."""
    return max(amount["walls"] / WALLS_TELL, amount["fitted"] / FITTED_TELLS, amount["furniture"] / FURNITURE_TELLS)


def evaluate_poses(a: VisiblePlace, b: VisiblePlace, poses: Sequence[Sim3]) -> tuple[bool, dict[str, Any], Sim3 | None]:
    """Return whether the pair is tellable, the amounts of the pose at which it differs least, and that pose. Without one that
    both maps show anything of, nothing is alike: tellable, no amounts."""
    rows = [(measure_differences(a, b, pose), pose) for pose in poses]
    most = max((r["common"] for r, _ in rows), default=0.0)
    alike = [(r, p) for r, p in rows if r["common"] >= COMPARABLE * most and r["common"] > 0]
    if not alike:
        return True, {}, None
    amount, pose = min(alike, key=lambda k: compute_strength(k[0]))
    return is_distinguishable(amount), amount, pose


def _rasterize_place(shown: VisiblePlace, pose: Sim3, low: Array, shape: tuple[int, ...], lowest: float) -> _PlaceRasters:
    building = shown.building

    def cells(points: Array) -> Array:
        flat = np.asarray(points, np.float64).reshape(-1, 2)
        return (pose.apply(np.pad(flat, ((0, 0), (0, 1))))[:, :2] - low) / RULE_CELL

    def drawn(polygons: Sequence[Array]) -> Array:
        out = np.zeros(shape, bool)
        for polygon in polygons:
            fill(out, cells(polygon), 1)
        return out

    doorways = [_build_doorway(d) for d in building.doors]
    rooms = [r.polygon for r in building.rooms]
    edges = np.concatenate([_sample_outline(p) for p in rooms])
    openings, outline = drawn(doorways), np.floor(cells(edges)[:, ::-1]).astype(np.int64)
    outline = outline[((outline >= 0) & (outline < shape)).all(axis=1)]
    openings = ndimage.binary_dilation(openings, iterations=1)
    outline = outline[~openings[tuple(outline.T)]]
    seen = np.zeros(shape, bool)
    at = np.floor(cells(shown.seen)[:, ::-1]).astype(np.int64)
    at = at[((at >= 0) & (at < shape)).all(axis=1)]
    seen[tuple(at.T)] = True
    things = building.things[~np.isin(building.things["kind"], PASSING)]
    floors = np.array([r.floor for r in building.rooms])[things["room"]] if len(things) else np.zeros(0)
    top = things["centre"][:, 2] + things["size"][:, 2] / 2 - floors
    things = things[(things["size"][:, 0] * things["size"][:, 1] >= SMALLEST_THING) & (top >= lowest)]
    boxes = [compute_footprints(t["centre"][None, :2], t["yaw"][None], t["size"].tolist())[0] for t in things]
    movable, fitted = ([p for p, t in zip(boxes, things, strict=True) if t["movable"] == m] for m in (True, False))
    floor = drawn([*rooms, *doorways])
    return _PlaceRasters(floor, ndimage.binary_dilation(seen, np.ones((5, 5))), drawn(movable), drawn(fitted), outline)


def _build_doorway(door: Array) -> Array:
    """Return (4, 2) floor of a doorway."""
    half = np.array([door["thickness"] / 2 + 0.05, door["width"] / 2])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return np.asarray(corners @ build_rotation(float(door["direction"])) + door["centre"][:2])


def _sample_outline(polygon: Array) -> Array:
    """Return (n, 2) points along a closed outline, a cell apart."""
    ends = np.roll(polygon, -1, axis=0)
    pieces = []
    for p, q in zip(polygon, ends, strict=True):
        steps = max(round(float(np.hypot(*(q - p))) / RULE_CELL), 1)
        pieces.append(p + (np.arange(steps) + 0.5)[:, None] / steps * (q - p))
    return np.concatenate(pieces)


LOOKALIKE_FORMAT = 1  # raise it when the same item gives other bytes: it is part of the files' names
LEAST_SHARED = 1.0  # m2 of the same place that both maps show, from which on a pair has a truth
POINT_SPACING = 0.06  # m between points of a scan, at least: the grids' cells are 0.1 m
SENSORS_OF = {"storeys": {**WEIGHTS["sensors"], "laser2d": 4.0}}  # robots' grids are of storeys whose corridors have one plan
DAY = Difficulty(moved=0.03, gone=0.02, doors_moved=0.3, people=0.1)  # what a day changes
MONTHS = Difficulty(moved=0.15, gone=0.1, doors_moved=0.3, people=0.1)  # between two visits of one place
FURNITURE_SHARES = {
    "shifted-row": (0.5, 0.2, 0.15, 0.15),
    "hotel-corridors": (0.4, 0.35, 0.1, 0.15),
    "same-room": (0.05, 0.05, 0.75, 0.15),
    "mirror": (0.55, 0.05, 0.25, 0.15),
    "modules": (0.2, 0.15, 0.5, 0.15),
    "storeys": (0.0, 0.05, 0.8, 0.15),
    "point-symmetric": (0.0, 0.0, 0.85, 0.15),
}  # of `FURNISHED`


@dataclass
class LookalikeRecipe:
    """A set of look-alikes.

    Args:
        name: of the manifest.
        split: train, validation or test: from whose seeds the buildings come.
        pairs: of each kind of `lookalike_places.LOOKALIKES`.
        sensors: weight of each; empty: `grid_pairs.WEIGHTS`.
        scaled: share of the pairs whose second map has an unknown scale.
        again: of each kind, so many beside: the first one of the two places, visited a second time. They belong together; without
            them whatever is learned takes the look of these buildings for a sign of look-alikes.
        seed: of the draw of the set.
        limit: only so many of all pairs (`core.builder.select_items`); 0: all.
    """

    name: str = "lookalikes"
    split: str = "train"
    pairs: dict[str, int] = field(default_factory=dict)
    sensors: dict[str, float] = field(default_factory=dict)
    scaled: float = 0.1
    seed: int = 0
    again: dict[str, int] = field(default_factory=dict)
    limit: int = 0

    @property
    def manifest(self) -> str:
        """Name of the manifest; one of a part of the set has its own."""
        return f"{self.name}-{self.limit}" if self.limit else self.name


@dataclass(frozen=True)
class LookalikeItem:
    """Everything that the bytes of one file depend on.

    Args:
        number: of the pair within its kind.
        seed: of the building, from the seeds of its split.
        furniture: one of `FURNISHED`.
        scaled: has b an unknown scale?
        again: are both maps of one place?
    """

    kind: str
    number: int
    seed: int
    furniture: str
    sensors: tuple[str, str]
    scaled: bool
    again: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        values = list(vars(self).values())
        inputs = ["lookalikes", LOOKALIKE_FORMAT, GRID_FORMAT, *(values if self.again else values[:-1])]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def draw_lookalike_items(recipe: LookalikeRecipe) -> list[LookalikeItem]:
    """Draw the items of a set, kinds in turn; a longer set of a kind begins with the shorter one.

    Raises:
        InputError: an unknown kind, sensor or split, or numbers out of range.
    """
    for kind, count in (*recipe.pairs.items(), *recipe.again.items()):
        if kind not in LOOKALIKES or count < 0:
            raise InputError(f"data.pairs.{kind}: {count}: give a number of pairs of {', '.join(LOOKALIKES)}")
    if not any((*recipe.pairs.values(), *recipe.again.values())) or not 0 <= recipe.scaled <= 1:
        raise InputError("data.pairs: give pairs of a kind or more, and data.scaled from 0 to 1")
    first, last = splits.get_seed_range(recipe.split)
    out = []
    both = ((recipe.pairs, False), (recipe.again, True))
    rows = [
        (n, k, repeated)
        for of, repeated in both
        for n in range(max(of.values(), default=0))
        for k in LOOKALIKES
        if n < of.get(k, 0)
    ]
    for number, kind, repeated in rows:
        rng = np.random.default_rng([recipe.seed, LOOKALIKES.index(kind), number])
        sensors = dict(recipe.sensors or SENSORS_OF.get(kind, WEIGHTS["sensors"]))
        names = sorted(sensors)
        weights = np.array([sensors[get_sensor(name).name] for name in names])
        a, b = rng.choice(len(names), 2, p=weights / weights.sum()).tolist()
        furniture = str(rng.choice(FURNISHED, p=FURNITURE_SHARES[kind]))
        seed, scaled = int(rng.integers(first, last + 1)), bool(rng.random() < recipe.scaled)
        out.append(LookalikeItem(kind, number, seed, furniture, (names[a], names[b]), scaled, repeated))
    return out


def build_lookalikes(
    recipe: LookalikeRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None
) -> tuple[list[Path], BuildReport]:
    """Build the files of a set, made where they are missing, in the order of their items."""
    check_sharing(sharing)
    folder = Path(sharing.cache).resolve() / "grids"
    items = select_items(draw_lookalike_items(recipe), recipe.limit)
    begin, step = sharing.part
    tasks = [(item, None, str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.manifest}.jsonl", tasks, make_lookalike, sharing, log_line)
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def make_lookalike(item: LookalikeItem, given: None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: build_lookalike_arrays(item), LONGEST_GRID_PAIR)


def build_lookalike_arrays(item: LookalikeItem) -> dict[str, Array]:
    """Build the arrays of a pair: places, two days, two scans, and who could tell."""
    places = sample_places(item.kind, item.furniture, item.seed)
    if item.again:
        first, rooms = places.buildings[0], places.visited[0]
        places = replace(places, buildings=(first, first), visited=(rooms, rooms), poses=(), same=True)
    rng = np.random.default_rng([item.seed, item.number, LOOKALIKES.index(item.kind)])
    frames = draw_frames(2, item.scaled, rng)
    days = [simulate_session(building, MONTHS if item.again else DAY, rng) for building in places.buildings]
    clouds = [
        scan_building(day, name, rooms, rng, max(get_sensor(name).spacing, POINT_SPACING), frame=frame)
        for day, name, rooms, frame in zip(days, item.sensors, places.visited, frames, strict=True)
    ]
    truth = frames[0] @ frames[1].inverse()
    kind = "overlap" if places.same else "other-building"
    pair = Pair(
        f"{item.kind}-{item.seed}", clouds[0], clouds[1], truth if places.same else None, (), 0.0, item.sensors, "procedural",
        f"{item.kind}-{item.seed}", kind,
    )  # fmt: skip
    arrays = build_pair_arrays(pair, {"source": "procedural", "set": LOOKALIKES.index(item.kind), "item": item.number})
    about = json.loads(arrays["about"].tobytes())
    grids = unpack_pair(item.name, arrays)
    seen = [
        compute_seen_columns(g, f, frame.inverse()) for g, f, frame in zip((grids.a, grids.b), grids.free, frames, strict=True)
    ]
    shown = [VisiblePlace(day, columns, name) for day, columns, name in zip(days, seen, item.sensors, strict=True)]
    about |= _describe_distinguishability(shown, places, frames) | _describe_overlap(about["common"], seen)
    if about["kind"] != "overlap":
        arrays["truth"] = np.full((4, 4), np.nan)
    about |= {"lookalike": item.kind, "furniture": item.furniture, "scaled": item.scaled, "file": f"{item.name}.npz"}
    arrays["about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
    return arrays


RELATION_OF = {
    "storeys": ("storey",),
    "hotel-corridors": ("storey", "wing"),
    "same-room": ("row",),
    "mirror": ("wing", "building"),
}
NUMBERED_ALIKE = 0.03  # of the places that are two: they bear the same numbers


def read_lookalike_signs(item: LookalikeItem, reader: Reader) -> tuple[Landmarks, Landmarks]:
    """Read the signs of the places of an item by two visitors, each in the frame of its map (`build_lookalike_arrays`).

    They are a switch: the arrays of the item stay as they are. Places that are two are numbered as such; few of them alike.
    """
    places = sample_places(item.kind, item.furniture, item.seed)
    buildings, visited = places.buildings, places.visited
    frames = draw_frames(2, item.scaled, np.random.default_rng([item.seed, item.number, LOOKALIKES.index(item.kind)]))
    rng = np.random.default_rng([item.seed, item.number, LOOKALIKES.index(item.kind), 51, int(item.again)])
    numbering = draw_numbering(rng)
    one = place_signs(buildings[0], numbering, rng)
    if item.again:
        visited, other = (visited[0], visited[0]), one
    elif places.same:
        other = one
    else:
        relation = str(rng.choice(RELATION_OF[item.kind]))
        alike = rng.random() < NUMBERED_ALIKE
        other = place_signs(buildings[1], numbering if alike else draw_other_numbering(numbering, relation, rng), rng)
    read = [
        read_signs(signs, rooms.tolist(), frame, reader, rng)
        for signs, rooms, frame in zip((one, change_signs(other, rng)), visited, frames, strict=True)
    ]
    return read[0], read[1]


def compute_seen_columns(grid: VoxelGrid, free: VoxelGrid | None, back: Sim3) -> Array:
    """Compute (n, 2) columns of which a map knows anything, m, in the building's coordinates."""
    points = np.concatenate([grid.compute_centroids(), *([free.compute_centroids()] if free is not None else [])])
    return np.unique(np.round(back.apply(points)[:, :2], 1), axis=0)


def _describe_distinguishability(shown: list[VisiblePlace], places: LookalikePlaces, frames: list[Sim3]) -> dict[str, Any]:
    """Describe who could tell, by what, and where they are alike."""
    tellable, amount, pose = evaluate_poses(shown[0], shown[1], places.poses)
    alike = None if pose is None else (frames[0] @ pose @ frames[1].inverse()).matrix.round(6).tolist()
    return {"tellable": tellable, "amount": amount, "alike": alike, "repeats": places.repeats}


def _describe_overlap(common: float, seen: list[Array]) -> dict[str, Any]:
    """Return the kind of the pair, and the share of what both maps show of one place; hardly anything is nothing."""
    if common < LEAST_SHARED:
        return {"kind": "lookalike", "overlap": 0.0, "common": 0.0}
    mean = (len(seen[0]) + len(seen[1])) / 2 * 0.01
    return {"kind": "overlap", "overlap": round(min(common / mean, 1.0), 3)}
