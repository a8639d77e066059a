"""Pairs of partial maps of a building, by two sensors on two days, in two frames, with everything known that relates them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.stack import make_twin_wing
from topomerge.datasets.core.building import Building, Difficulty
from topomerge.datasets.pairs.parts import compute_dice, find_twin_rooms, sample_two_parts
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.datasets.simulation.session import simulate_session
from topomerge.datasets.simulation.signs import Reader, draw_numbering, place_signs, read_signs

from topomerge.errors import InputError
from topomerge.types import Array, Landmarks, PointCloud, Sim3

HARD = ("other-building", "other-storey", "twin-wing")
PAIR_KINDS = ("overlap", *HARD)
ROOMS_A_MAP = 15  # a map
MAP_SCALES = (0.5, 2.0)  # a map of unknown scale is larger or smaller by so much
FRAMES_APART = 20.0  # m, frames lie that far apart along x and y
LEAST_TURN = np.radians(3)  # frames are turned against each other by more than this
SEEN_POINTS = 50  # points of a room, from which on a map has seen it
ELSEWHERE = Difficulty(moved=0.5, gone=0.3, doors_moved=1.0)  # furniture of a twin wing


@dataclass(frozen=True, eq=False)
class Pair:
    """Two partial maps, and what is true about them.

    Args:
        name: unique within its source.
        a, b: clouds with `labels` (index into their `rooms`) where the truth knows them, each in a frame of its own.
        truth: T_ab, maps b into a; None where there is none, as the maps are of different buildings.
        shared: (i, j): room i of `a.rooms` is room j of `b.rooms`, and both maps saw it. A match of two extracted rooms is right
            if their true rooms are one of these.
        overlap: share of visited rooms that both visited (Dice), or as good as is known; 0 for hard negatives.
        sensors: of a and of b.
        source: procedural, r2v, utexas, ...: splits are by source and building.
        building: its name within the source.
        kind: one of `PAIR_KINDS`; all but "overlap" are maps of two places.
        visited: rooms of `a.rooms` and of `b.rooms` that the surveyors went into; the others were seen through doors at most.
        frames: building -> cloud, of a and of b, where both come from a building that is known.
    """

    name: str
    a: PointCloud
    b: PointCloud
    truth: Sim3 | None
    shared: tuple[tuple[int, int], ...]
    overlap: float
    sensors: tuple[str, str]
    source: str
    building: str
    kind: str = "overlap"
    visited: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    frames: tuple[Sim3, Sim3] | None = None

    def __post_init__(self) -> None:
        if self.kind not in PAIR_KINDS:
            raise InputError(f"{self.name}: kind of pair {self.kind!r}: {', '.join(PAIR_KINDS)} are possible")
        if not 0 <= self.overlap <= 1:
            raise InputError(f"{self.name}: overlap must be 0 to 1, not {self.overlap}")
        if self.kind != "overlap" and self.shared:
            raise InputError(f"{self.name}: maps of two places share no room")
        if self.truth is not None and is_identity(self.truth):
            raise InputError(f"{self.name}: the true transform is the identity: such a pair tests nothing")
        for i, j in self.shared:
            if not (0 <= i < len(self.a.rooms) and 0 <= j < len(self.b.rooms)):
                raise InputError(f"{self.name}: shared rooms {i}, {j} do not exist")


@dataclass(frozen=True, eq=False)
class Atlas:
    """Three or more partial maps of one building.

    Args:
        maps: n clouds.
        truth: n transforms T_0k; the first is the identity.
        shared: rooms (i of `maps[k].rooms`, j of `maps[l].rooms`) for each (k, l) with k < l.
        frames: n transforms, building -> cloud.
    """

    name: str
    maps: tuple[PointCloud, ...]
    truth: tuple[Sim3, ...]
    shared: dict[tuple[int, int], tuple[tuple[int, int], ...]]
    sensors: tuple[str, ...]
    source: str
    building: str
    frames: tuple[Sim3, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.maps) == len(self.truth) == len(self.sensors) or len(self.maps) < 2:
            raise InputError(f"{self.name}: two or more maps, with a transform and a sensor each")


def is_identity(transform: Sim3) -> bool:
    """Return whether a transform moves nothing."""
    shift = max(map(abs, transform.translation))
    return abs(transform.yaw) < 1e-3 and shift < 0.01 and abs(transform.scale - 1) < 1e-3


@dataclass(frozen=True)
class PairSettings:
    """Which parts of a building two surveyors visit, and with what.

    Args:
        overlap: share of the rooms that both visit (of hard negatives: rooms with the same plan).
        sensors: names, of a and of b.
        rooms: of each map, at most.
        scale: b's scale is unknown.
        hard: None, or one of `HARD`: b is another building, another storey with the same plan, or another wing with nearly the
            same plan (other ends and other furniture, perhaps mirrored: `make_twin_wing`).
        over_stairs: walks lead over stairs, where the building has any (`sample_two_parts`).
    """

    overlap: float = 0.5
    sensors: Sequence[str] = ("tls", "depth")
    rooms: int = ROOMS_A_MAP
    scale: bool = False
    hard: str | None = None
    over_stairs: bool = False

    def __post_init__(self) -> None:
        if self.hard is not None and self.hard not in HARD:
            raise InputError(f"hard negative {self.hard!r}: {', '.join(HARD)} are possible")
        if len(self.sensors) != 2:
            raise InputError(f"a pair needs two sensors, not {len(self.sensors)}")


def make_pair(
    building: Building,
    settings: PairSettings | None = None,
    rng: np.random.Generator | int = 0,
    other: Building | None = None,
    difficulty: Difficulty | None = None,
    source: str = "procedural",
) -> Pair:
    """Make two sessions in a building, each scanned along a walk through a connected part of it.

    Args:
        rng: generator or seed; the same seed gives the same points.
        other: the building of "other-building"; None: one of the same kind with another seed.
        difficulty: of both sessions.

    Raises:
        InputError: the building has no such parts, or a room can't be reached.
    """
    settings, difficulty = settings or PairSettings(), difficulty or Difficulty()
    rng, sensors, hard = np.random.default_rng(rng), settings.sensors, settings.hard
    places, visited = choose_visited_places(building, settings, other, rng)
    frames = draw_frames(2, settings.scale, rng)
    days = (difficulty, ELSEWHERE if hard == "twin-wing" else difficulty)
    a, b = (
        scan_building(simulate_session(place, day, rng), sensor, part, rng, frame=frame)
        for place, part, sensor, frame, day in zip(places, visited, sensors, frames, days, strict=True)
    )
    parts = (tuple(visited[0].tolist()), tuple(visited[1].tolist()))
    return Pair(
        name=f"{building.name}:{sensors[0]}-{sensors[1]}:{round(100 * settings.overlap)}" + (f":{hard}" if hard else ""),
        a=a,
        b=b,
        truth=None if hard in ("other-building", "twin-wing") else frames[0] @ frames[1].inverse(),
        shared=() if hard else find_common_rooms(a, b),
        overlap=0.0 if hard else compute_dice(*parts),
        sensors=(sensors[0], sensors[1]),
        source=source,
        building=building.name,
        kind=hard or "overlap",
        visited=parts,
        frames=(frames[0], frames[1]),
    )


def find_common_rooms(a: PointCloud, b: PointCloud) -> tuple[tuple[int, int], ...]:
    """Find (i, i) of the rooms, numbered alike in both maps, of which both have `SEEN_POINTS` points."""
    seen = [np.bincount(c.labels[c.labels >= 0], minlength=len(c.rooms)) >= SEEN_POINTS for c in (a, b) if c.labels is not None]
    return tuple((int(i), int(i)) for i in np.flatnonzero(np.logical_and.reduce(seen)))


def choose_visited_places(
    building: Building, settings: PairSettings, other: Building | None, rng: np.random.Generator
) -> tuple[tuple[Building, Building], tuple[Array, Array]]:
    """Choose the two buildings of a pair, and the rooms that are visited in each."""
    overlap, rooms, hard = settings.overlap, settings.rooms, settings.hard
    if hard == "other-building":
        other = other or _make_other_building(building)
        a, b = (sample_two_parts(x, rooms, 1.0, rng)[0] for x in (building, other))
        return (building, other), (a, b)
    if hard == "other-storey":
        twins = find_twin_rooms(building)
        a, b = sample_two_parts(building, rooms, overlap, rng, twins)
        return (building, building), (a, np.array(sorted(twins[i] for i in b.tolist())))
    parts = sample_two_parts(building, rooms, overlap, rng, over_stairs=settings.over_stairs)
    return (building, make_twin_wing(building, rng) if hard == "twin-wing" else building), parts


def _make_other_building(building: Building) -> Building:
    """Make a building of the same kind from another seed, of the same split: seeds come in pairs there."""
    if building.seed < 0 or not building.kind:
        raise InputError(f"{building.name}: name the other building of the hard negative")
    parameters = building.parameters
    return make_building(building.kind, building.seed ^ 1, len(building.storeys), Difficulty(**parameters["difficulty"]))


def draw_frames(count: int, scale: bool, rng: np.random.Generator) -> list[Sim3]:
    """Draw random frames, building -> cloud; no two are turned alike. With `scale` all but the first have a scale of their
    own."""
    frames: list[Sim3] = []
    while len(frames) < count:
        low, high = np.log(MAP_SCALES)
        size = float(np.exp(rng.uniform(low, high))) if scale and frames else 1.0
        x, y, z = (rng.uniform(-1, 1, 3) * (FRAMES_APART, FRAMES_APART, 2.0)).round(3).tolist()
        frame = Sim3(float(rng.uniform(-np.pi, np.pi)), (x, y, z), size)
        if all(abs((f.inverse() @ frame).yaw) > LEAST_TURN for f in frames):
            frames.append(frame)
    return frames


def simulate_signs(building: Building, source: Pair | PointCloud, reader: Reader, frame: Sim3 | None = None) -> list[Landmarks]:
    """Read the signs at the doors of the rooms that each map visited, in the frame of its cloud.

    Args:
        frame: building -> cloud, of a single cloud.

    Raises:
        InputError: b is of another building, whose doors are not known.
    """
    if isinstance(source, PointCloud):
        visited = [[] if source.labels is None else np.unique(source.labels[source.labels >= 0]).tolist()]
        frames = [frame or Sim3()]
    elif source.kind == "other-building":
        raise InputError("landmarks: the doors of the other building are not known; leave --hard out, or --landmarks and --signs")
    else:
        assert source.frames is not None
        visited, frames = [list(rooms) for rooms in source.visited], list(source.frames)
    rng = np.random.default_rng([building.seed, 51])
    signs = place_signs(building, draw_numbering(rng), rng)
    return [read_signs(signs, rooms, to_map, reader, rng) for rooms, to_map in zip(visited, frames, strict=True)]
