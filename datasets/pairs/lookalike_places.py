"""Where look-alikes are taken: two places made to be alike, the rooms that are visited in each, and the poses at which one lies
on the other.

Kinds (`LOOKALIKES`): ``shifted-row``, parts of a row of equal rooms, some rooms apart; ``modules``, parts of two of the
equal modules of a building, two rooms or more each; ``hotel-corridors``, two corridors of one hotel or ward; ``same-room``,
two rooms of one size; ``mirror``, a part of a building and its own mirror image; ``storeys``, parts of two storeys of one
plan, of which half have columns and ends of walls at other places; ``point-symmetric``, the two halves of a building that
lies on itself when it is turned by half.

Furniture (`FURNISHED`): ``same``, thing by thing; ``clutter``, the same but for what lies on the floor; ``other``, furnished
anew; ``empty``, none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.signal import fftconvolve
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.layouts import PROFILES
from topomerge.datasets.buildings.modules import (
    EQUAL,
    ROOM_KINDS,
    AddedThing,
    ModuleRow,
    copy_furniture,
    draw_module,
    find_module_rooms,
    make_row,
    replace_clutter,
    replace_furniture,
    replace_things,
)
from topomerge.datasets.buildings.procedural import is_connected, make_building, make_plans
from topomerge.datasets.buildings.stack import stretch_building
from topomerge.datasets.core.building import SURFACES, Building, Difficulty, Plan, Point
from topomerge.datasets.core.solids import triangulate_boxes
from topomerge.datasets.pairs.parts import CONNECTING
from topomerge.datasets.simulation.floor_truth import fill
from topomerge.datasets.simulation.walk import sample_part

from topomerge.types import Array, Sim3

LOOKALIKES = ("shifted-row", "hotel-corridors", "same-room", "mirror", "modules", "storeys", "point-symmetric")
FURNISHED = ("same", "clutter", "other", "empty")
MOST_ROOMS_SEEN = 12  # rooms of a map of a row
INNER_SHARE = 0.6  # of the rows: neither map visits an end
MIRROR_CELL = 0.2  # m, raster on which a mirror image is laid
CORRIDOR_KINDS = ("hotel", "hotel", "hospital")  # of buildings with corridors that look alike
ROOMS_MIRRORED = (1, 1, 1, 2, 3, 4)  # of a map
LEAST_AREA = 8.0  # m2 of a room to start from
MIRRORED_KINDS = ("office", "hotel", "hospital", "school", "lab", "apartment", "house")  # of buildings
FEW_THINGS, ORDINARY_THINGS = 0.25, 1.2  # density of the furniture of storeys and halves: from few pieces a room to a usual one
ROOMS_OF_STOREY = (4, 14)  # fewest and most rooms that a map of a storey visits
SAME_PART, ALTERED = 0.3, 0.5  # shares of the storeys whose maps visit the same rooms; that have pilasters at other places
PILASTERS = (0.02, 0.06)  # a metre of wall, fewest and most
PILASTER_WIDTH, PILASTER_DEPTH = (0.25, 0.8), (0.2, 0.5)  # m
HALVES_TRIED = 20
HALF_SHAPES = ("single", "double")  # of corridors that reach the end of their building


@dataclass(frozen=True, eq=False)
class LookalikePlaces:
    """Two places made to be alike.

    Args:
        buildings: of a and of b; one and the same, or two of one plan.
        visited: rooms of each.
        poses: b's coordinates -> a's, such that one lies on the other where it should not; with what is true among them they are
            all that look right.
        same: are both in one building, in one frame, so that the identity is true?
        repeats: does each map show two equal modules or more, so that the repetition can be seen in a map by itself?
    """

    buildings: tuple[Building, Building]
    visited: tuple[Array, Array]
    poses: tuple[Sim3, ...]
    same: bool = False
    repeats: bool = False


def sample_places(kind: str, furniture: str, seed: int) -> LookalikePlaces:
    """Sample the places of a pair of a kind of `LOOKALIKES`; the same arguments give the same buildings."""
    rng = np.random.default_rng([seed, LOOKALIKES.index(kind), FURNISHED.index(furniture)])
    difficulty = Difficulty(
        furniture=0.0 if furniture == "empty" else float(rng.uniform(0.8, 1.6)),
        clutter=0.0 if furniture == "empty" else float(rng.uniform(0.3, 1.2)),
        lintels=float(rng.random() < 0.7),
        open=float(rng.uniform(0.5, 0.8)),
    )
    return PLACES_OF[kind](kind, furniture, seed, difficulty, rng)


def _sample_row(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Sample parts of a row: of a row of rooms (at most half of it) or of one of modules."""
    layout = str(rng.choice(["room", "ensuite"] if kind == "shifted-row" else ["pair", "suite"]))
    count = int(rng.integers(6, 11)) if kind == "shifted-row" else 9
    row = make_row(draw_module(layout, rng), count, difficulty, seed, f"{kind}-{seed}")
    most = max(MOST_ROOMS_SEEN // len(find_module_rooms(row.module, 0)), 1)
    seen = min(int(rng.integers(2, 5)) if kind == "shifted-row" else 1 + int(rng.random() < 0.3), most, count // 2)
    ends = int(rng.random() < INNER_SHARE)  # modules at each end that neither map visits
    apart = int(rng.integers(1 if kind == "shifted-row" else seen, count - seen - 2 * ends + 1))
    first = int(rng.integers(ends, count - seen - apart - ends + 1))
    starts = [first, first + apart] if rng.random() < 0.5 else [first + apart, first]
    building = _furnish_row(row, furniture, difficulty, rng)
    visited = [np.flatnonzero((row.module >= s) & (row.module < s + seen)) for s in starts]
    poses = compute_row_poses(row, starts[0], starts[1], seen)
    return LookalikePlaces((building, building), (visited[0], visited[1]), poses, same=True, repeats=seen > 1)


def compute_row_poses(row: ModuleRow, first: int, second: int, seen: int) -> tuple[Sim3, ...]:
    """Return the poses by whole periods, but the true one, that lay a module of b on one of a: each shows `seen`, from `first`
    and from `second` on."""
    shifts = [first - second + k for k in range(1 - seen, seen)]
    return tuple(Sim3(0.0, (k * row.period, 0.0, 0.0)) for k in shifts if k)


def _furnish_row(row: ModuleRow, furniture: str, difficulty: Difficulty, rng: np.random.Generator) -> Building:
    """Furnish the row; an inner module is furnished and copied, as those at the ends are longer."""
    building, density, clutter = row.building, difficulty.furniture, difficulty.clutter
    if furniture == "other":
        return replace_furniture(building, range(len(building.rooms)), density, clutter, rng)
    building = replace_furniture(building, find_module_rooms(row.module, 1), density, clutter, rng)
    for k in (k for k in range(row.count) if k != 1):
        building = copy_furniture(
            building, find_module_rooms(row.module, 1), find_module_rooms(row.module, k), np.array([(k - 1) * row.period, 0.0])
        )
    return replace_clutter(building, range(len(building.rooms)), clutter, rng) if furniture == "clutter" else building


def _sample_corridors(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Return a corridor with rooms beside it, and another one like it elsewhere: the same plan a second time."""
    a = make_building(str(rng.choice(CORRIDOR_KINDS)), seed, 1, difficulty, str(rng.choice(["single", "double"])))
    rooms = sample_part(a, int(rng.integers(4, 8)), rng, start=_find_largest_corridor(a))
    return LookalikePlaces((a, _vary_furniture(a, furniture, rooms, difficulty, rng)), (rooms, rooms), (Sim3(),))


def _sample_same_room(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Sample one room of a size, and another one."""
    wide, deep = np.round(rng.uniform([4.0, 3.6], [9.0, 7.5]), 2).tolist()
    draft = Draft(round(float(rng.uniform(0.1, 0.2)), 2), rng)
    room = draft.add_box((0.0, 0.0), (wide, deep), str(rng.choice([*ROOM_KINDS, "openplan", "storage"])))
    sides = shapely.box(0.0, 0.0, wide, deep).exterior
    door = shapely.LineString(np.asarray(sides.coords)[[1, 2]])
    draft.cut(door, 0.95, "door", round(float(rng.uniform(0.2, 0.8)), 2))
    draft.add_windows(room, 1.4, 0.9, 2.4)
    height = round(float(rng.uniform(3.0, 3.6)), 2)
    equal = replace(EQUAL, furniture=difficulty.furniture, clutter=difficulty.clutter)
    a = build_building([draft.build_plan(height, round(height - 0.5, 2))], equal, rng, f"{kind}-{seed}", "room")
    a, rooms = replace(a, seed=seed), np.array([0])
    b = _vary_furniture(a, furniture, rooms, difficulty, rng)
    return LookalikePlaces((a, b), (rooms, rooms), (Sim3(), Sim3(np.pi, (wide, deep, 0.0))))


def _mirror(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Return a part of a building and its mirror image."""
    a = make_building(str(rng.choice(MIRRORED_KINDS)), seed, 1, difficulty)
    rooms = sample_part(a, int(rng.choice(ROOMS_MIRRORED)), rng, start=_sample_room(a, rng))
    b = stretch_building(_vary_furniture(a, furniture, rooms, difficulty, rng), 0, lambda x: x, mirrored=True)
    return LookalikePlaces((a, b), (rooms, rooms), tuple(estimate_overlay_pose(a, b, rooms, yaw) for yaw in (0.0, np.pi)))


def _draw_storeys(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Draw parts of two storeys of one plan. They begin in one corridor, where there is one."""
    difficulty = replace(difficulty, furniture=_draw_density(furniture, rng))
    a = make_building(str(rng.choice(MIRRORED_KINDS)), seed, 1, difficulty)
    start = _find_largest_corridor(a) if rng.random() < 0.7 else _sample_room(a, rng)
    visited = [sample_part(a, int(rng.integers(*ROOMS_OF_STOREY)), rng, start=start)]
    visited.append(
        visited[0] if rng.random() < SAME_PART else sample_part(a, int(rng.integers(*ROOMS_OF_STOREY)), rng, start=start)
    )
    b = _vary_furniture(a, furniture, np.arange(len(a.rooms)), difficulty, rng)
    if rng.random() < ALTERED:
        share = float(rng.uniform(*PILASTERS))
        a, b = add_pilasters(a, share, rng), add_pilasters(b, share, rng)
    return LookalikePlaces((a, b), (visited[0], visited[1]), (Sim3(),))


def _draw_halves(kind: str, furniture: str, seed: int, difficulty: Difficulty, rng: np.random.Generator) -> LookalikePlaces:
    """Draw parts of the two halves of a building that half a turn lays on itself; each has furniture of its own."""
    difficulty = replace(difficulty, furniture=_draw_density(furniture, rng), curved=0.0)
    for _ in range(HALVES_TRIED):
        profile = replace(PROFILES[str(rng.choice(MIRRORED_KINDS))], shapes=HALF_SHAPES)
        half = make_plans(profile, 1, difficulty, rng)[0]
        whole, middle = mirror_by_point(half)
        building = replace(build_building([whole], difficulty, rng, f"{kind}-{seed}", "halves"), seed=seed)
        if is_connected(building):
            break
    count = len(half.rooms)
    starts = [int(np.argmax([shapely.Polygon(r.polygon).area * (r.kind == "corridor") for r in half.rooms]))] * 2
    rooms = [int(rng.integers(*ROOMS_OF_STOREY)) for _ in range(2)]
    first, second = (
        sample_part(building, n, rng, start=s + k * count) for k, (n, s) in enumerate(zip(rooms, starts, strict=True))
    )
    visited = (first[first < count], second[second >= count])
    x, y = (2 * middle).tolist()
    return LookalikePlaces((building, building), visited, (Sim3(np.pi, (x, y, 0.0)),), same=True)


def mirror_by_point(half: Plan) -> tuple[Plan, Array]:
    """Return a plan and its image by half a turn about the end of its corridor, joined there by an opening; and that point (2,),
    m.

    The building lies on itself when it is turned by half a turn about the point.
    """
    corridor = max((r for r in half.rooms if r.kind == "corridor"), key=lambda r: float(r.polygon[:, 0].max()))
    wall = next((o.thickness for o in half.openings), 0.2)
    corners = np.concatenate([r.polygon for r in half.rooms])
    end = corridor.polygon[corridor.polygon[:, 0] > corridor.polygon[:, 0].max() - 0.05]
    low, high = end[:, 1].min(), end[:, 1].max()
    middle = np.array([corners[:, 0].max() + wall / 2, (low + high) / 2])

    def turn(point: Point) -> Point:
        x, y = (2 * middle - np.array(point)).tolist()
        return x, y

    rooms = tuple(replace(r, name=f"{r.name} turned", polygon=2 * middle - r.polygon) for r in half.rooms)
    walls = tuple(replace(w, start=turn(w.start), end=turn(w.end)) for w in half.walls)
    openings = tuple(replace(o, start=turn(o.start), end=turn(o.end)) for o in half.openings)
    at = float(middle[0])
    reach = (high - low) / 2 - 0.05
    join = replace(half.openings[0], kind="opening", start=(at, middle[1] - reach), end=(at, middle[1] + reach), thickness=wall)
    join = replace(join, bottom=0.0, top=0.0, state="")
    kept = tuple(o for o in half.openings if not _is_near(o.start, o.end, middle))
    turned = tuple(o for o in openings if not _is_near(o.start, o.end, middle))
    every = (*kept, *turned, join)
    return replace(half, rooms=half.rooms + rooms, walls=half.walls + walls, openings=every, flights=()), middle


def _is_near(start: Point, end: Point, middle: Array) -> bool:
    """Return whether an opening lies where the two halves are joined."""
    return shapely.LineString([start, end]).distance(shapely.Point(middle)) < 0.6


def add_pilasters(building: Building, share: float, rng: np.random.Generator) -> Building:
    """Add pillars and ends of walls along the walls of a building's rooms, `share` of them a metre, clear of doors."""
    added = []
    clear = shapely.union_all([shapely.Point(*d["centre"][:2]).buffer(d["width"] / 2 + 0.5) for d in building.doors])
    for number, room in enumerate(building.rooms):
        shape = shapely.orient_polygons(shapely.Polygon(room.polygon))
        for _ in range(rng.poisson(share * shape.length)):
            line, at = shape.exterior, float(rng.uniform(0, shape.length))
            wide, deep = float(rng.uniform(*PILASTER_WIDTH)), float(rng.uniform(*PILASTER_DEPTH))
            p, q = (np.array(line.interpolate((at + d) % shape.length).coords[0]) for d in (0.0, wide))
            if np.hypot(*(q - p)) < 0.99 * wide:  # around a corner
                continue
            along = (q - p) / wide
            middle = (p + q) / 2 + deep / 2 * np.array([-along[1], along[0]])  # outlines run with the room to their left
            yaw, tall = float(np.arctan2(along[1], along[0])), room.ceiling - room.floor
            vertices, triangles = triangulate_boxes(
                np.array([[0, 0, tall / 2, wide, deep, tall]]), np.array([*middle, room.floor]), yaw
            )
            footprint = shapely.MultiPoint(vertices[:, :2]).convex_hull
            if footprint.intersects(clear) or footprint.intersection(shape).area < 0.9 * footprint.area:
                continue
            centre = (*middle.tolist(), room.floor + tall / 2)
            row = ("column", number, -1, centre, (wide, deep, tall), yaw, tuple(middle.tolist()), False)
            added.append(AddedThing(row, vertices, triangles, SURFACES.index("column")))
    return replace_things(building, np.zeros(len(building.things), bool), added)


def _draw_density(furniture: str, rng: np.random.Generator) -> float:
    return 0.0 if furniture == "empty" else float(rng.uniform(FEW_THINGS, ORDINARY_THINGS))


def _find_largest_corridor(building: Building) -> int:
    areas = [shapely.Polygon(r.polygon).area if r.kind == "corridor" else 0.0 for r in building.rooms]
    return int(np.argmax(areas))


PLACES_OF: dict[str, Callable[[str, str, int, Difficulty, np.random.Generator], LookalikePlaces]] = {
    "shifted-row": _sample_row, "modules": _sample_row, "hotel-corridors": _sample_corridors, "same-room": _sample_same_room,
    "mirror": _mirror,
    "storeys": _draw_storeys, "point-symmetric": _draw_halves,
}  # fmt: skip


def _vary_furniture(a: Building, furniture: str, rooms: Array, difficulty: Difficulty, rng: np.random.Generator) -> Building:
    """Return the same plan a second time."""
    every = range(len(a.rooms)) if furniture == "clutter" else rooms
    if furniture == "other":
        return replace_furniture(a, every, difficulty.furniture, difficulty.clutter, rng)
    return replace_clutter(a, every, difficulty.clutter, rng) if furniture == "clutter" else a


def _sample_room(building: Building, rng: np.random.Generator) -> int:
    """Return a room that is no corridor and not tiny."""
    fits = [i for i, r in enumerate(building.rooms) if r.kind not in CONNECTING and shapely.Polygon(r.polygon).area > LEAST_AREA]
    return int(rng.choice(fits))


def estimate_overlay_pose(a: Building, b: Building, rooms: Array, yaw: float) -> Sim3:
    """Return the pose b -> a of a turn at which the floors of these rooms lie on each other the most."""
    turn = Sim3(yaw)
    floors = []
    for building, pose in ((a, Sim3()), (b, turn)):
        floors.append([pose.apply(np.pad(building.rooms[i].polygon, ((0, 0), (0, 1))))[:, :2] for i in rooms.tolist()])
    lows = [np.concatenate(f).min(axis=0) for f in floors]
    masks = []
    for low, polygons in zip(lows, floors, strict=True):
        size = np.ceil((np.concatenate(polygons).max(axis=0) - low) / MIRROR_CELL).astype(int) + 1
        masks.append(np.zeros(size[::-1].tolist(), np.float32))
        for polygon in polygons:
            fill(masks[-1], (polygon - low) / MIRROR_CELL, 1)
    both = fftconvolve(masks[0], masks[1][::-1, ::-1])
    row, column = np.unravel_index(int(np.round(both, 3).argmax()), both.shape)
    offset = (np.array([column, row]) - np.array(masks[1].shape[::-1]) + 1) * MIRROR_CELL
    x, y = (lows[0] + offset - lows[1]).tolist()
    return Sim3(yaw, (x, y, 0.0))
