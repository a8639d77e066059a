"""A grid cut into rooms with the graph of its doors (seeds 2.7), and selections of its rooms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.types.grid import Array, Sim3, VoxelGrid, require
from topomerge.types.landmarks import Landmarks

EDITED = "edits"  # parameter of a corrected map: how many edits made it
LEVELLED = "levelled"  # parameter of a map whose cloud was tilted: the matrix, row by row
ROUNDING = 1e-9  # by which a rotation in a file may miss one


def read_levelling(parameters: Mapping[str, Any]) -> Array:
    """Read the levelling of a map from its parameters.

    Returns:
        (4, 4) float64: a rotation and a translation, m, that take points of the file into the frame of the map; the identity
        where the cloud was level.

    Raises:
        ValueError: something else stands there.
    """
    return np.eye(4) if LEVELLED not in parameters else parse_levelling(parameters[LEVELLED])


def parse_levelling(listed: Any) -> Array:
    """Parse the (4, 4) matrix of a listing; ValueError where it is no rotation and translation."""
    matrix = np.array(listed, np.float64)
    proper = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all()) and bool((matrix[3] == (0, 0, 0, 1)).all())
    require(proper, "a levelling that is none")
    rotation = matrix[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=ROUNDING) and np.linalg.det(rotation) > 0
    require(bool(rigid), "a levelling that is none")
    return matrix


def is_level(levelling: Array) -> bool:
    """Return whether a levelling (4, 4) is none, as that of a cloud that was level."""
    return bool(np.array_equal(levelling, np.eye(4)))


def convert_pose_to_files(pose: Sim3, levelling: Array, into: Array) -> Array:
    """Carry a pose between two maps over to their files.

    Args:
        pose: takes points of the one map into the frame of the other.
        levelling: (4, 4) of the one map.
        into: (4, 4) of the other one.

    Returns:
        (4, 4) float64 that takes points of the one file into the frame of the other.
    """
    if is_level(levelling) and is_level(into):
        return pose.matrix
    out: Array = np.linalg.inv(into) @ pose.matrix @ levelling
    out[3] = 0, 0, 0, 1
    return out


def convert_pose_to_maps(matrix: Array, levelling: Array, into: Array) -> Array:
    """Undo `convert_pose_to_files`: the (4, 4) matrix of the pose between two maps."""
    if is_level(levelling) and is_level(into):
        return matrix
    out: Array = into @ matrix @ np.linalg.inv(levelling)
    return out


def transform_points(matrix: Array, points: Array) -> Array:
    """Apply a matrix (4, 4) to points (n, 3), in float64."""
    with np.errstate(invalid="ignore", over="ignore"):  # points may be nan or infinite
        out: Array = np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return out


JOINED = " + "  # between the sources of a joined map
ROOM_DTYPE = np.dtype(
    [
        ("storey", "i4"),
        ("centroid", "f8", 3),  # of the room's navigable cells, in the input's frame
        ("area", "f8"),  # m2 of navigable floor, seen from above
        ("height", "f8"),  # m, floor to ceiling: median over the floor; 0 where no ceiling was seen
        ("volume", "f8"),  # m3 between floor and ceiling (area times height)
        ("lo", "f8", 3),  # bounding box of the room's cells, in the input's frame
        ("hi", "f8", 3),
        ("cells", "i8"),  # occupied cells
        ("completeness", "f8"),  # share of the floor's outline at which a wall or another room was seen
        ("glimpsed", "?"),  # only looked into, through a door or a window: `entered` is below a half
        ("confidence", "f8"),  # that it is one room: 0..1, as all that follow
        ("whole", "f8"),  # that most of its floor was seen
        ("entered", "f8"),  # that the sensor was in it
        ("outside", "f8"),  # that it lies out of doors: a terrace, a street seen through a window
    ]
)
ROOM_ODDS = ("confidence", "whole", "entered", "outside")  # columns of ROOM_DTYPE that are probabilities
GLIMPSED_SHARE = 0.6  # of its outline, of which less was seen of a room that is mostly unseen
EDGE_DTYPE = np.dtype(
    [
        ("rooms", "i4", 2),
        ("centre", "f8", 3),  # on the floor, in the input's frame
        ("width", "f8"),  # m
        ("height", "f8"),  # m of clear height; 0 where nothing was seen above
        ("direction", "f8"),  # rad, of the wall's normal in the horizontal plane, in [0, pi)
        ("kind", "U8"),  # door | opening | stairs | ramp
        ("open", "?"),  # one could walk through; a shut door joins two rooms, too
        ("half", "?"),  # its leaf stands half open
        ("confidence", "f8"),  # that it is one: 0..1
        ("lower", "f8", 3),  # of stairs and ramps: where they begin and end, in the input's frame; of doors both the centre
        ("upper", "f8", 3),
    ]
)
OLDER_EDGE_DTYPE = np.dtype([(n, EDGE_DTYPE[n]) for n in EDGE_DTYPE.names or () if n != "half"])  # of files until 26 November
AREA_DTYPE = np.dtype(
    [
        ("room", "i4"),
        ("centroid", "f8", 3),  # of its navigable cells, in the input's frame
        ("area", "f8"),  # m2 of navigable floor, seen from above
    ]
)
WINDOW_DTYPE = np.dtype(
    [
        ("rooms", "i4", 2),  # whose wall it is in; the second -1: it leads out of doors, or where nothing was seen
        ("centre", "f8", 3),  # on the floor, in its wall, in the input's frame
        ("width", "f8"),  # m
        ("sill", "f8"),  # m above the floor, where it begins and where it ends; nan: not seen
        ("head", "f8"),
        ("direction", "f8"),  # rad, of the wall's normal in the horizontal plane, in [0, pi)
        ("confidence", "f8"),  # that it is one: 0..1
    ]
)
STOREY_DTYPE = np.dtype([("floor", "f8"), ("ceiling", "f8"), ("area", "f8")])  # m, m (nan: not seen), m2


def classify_door_state(edge: Array) -> str:
    """Classify how a door stands, a row of EDGE_DTYPE: open, half open or shut."""
    return "shut" if not edge["open"] else "half open" if edge["half"] else "open"


def is_mostly_unseen(rooms: Array) -> Array:
    """Return (R,) bool: was less of a room's outline seen than `GLIMPSED_SHARE`? What learned parts were trained with.

    Args:
        rooms: (R,) ROOM_DTYPE.
    """
    return np.asarray(rooms["completeness"] < GLIMPSED_SHARE)


def add_outline_odds(rooms: Array) -> Array:
    """Return the rooms with what the outline alone says of them, for maps of which nothing better is known: those that are mostly
    unseen were only looked into, all are rooms, and none is outside.

    Args:
        rooms: (R,) ROOM_DTYPE; stays as it is.
    """
    rooms = rooms.copy()
    rooms["glimpsed"] = is_mostly_unseen(rooms)
    rooms["confidence"], rooms["outside"] = 1.0, 0.0
    rooms["entered"] = rooms["whole"] = ~rooms["glimpsed"]
    return rooms


@dataclass(frozen=True, eq=False)
class TopometricMap:
    """A voxel grid cut into rooms, with the graph of how one walks between them (seeds 2.7).

    Args:
        grid: occupied cells.
        room: (n,) int32, room of each occupied cell, -1 none.
        navigable: the navigable volume, a grid of the same volume; its cells need not be occupied. In maps of the default preset
            it is the whole floor of the rooms, also under furniture, and its property `standing` says where a body fits.
        navigable_room: (m,) int32, room of each navigable cell, -1 none.
        rooms: (R,) ROOM_DTYPE.
        edges: (E,) EDGE_DTYPE; two rooms that meet in two doors have two edges.
        storeys: (S,) STOREY_DTYPE, lowest first.
        areas: (A,) AREA_DTYPE, the parts of rooms that a narrowing or a wide opening suggests; a room without such has one.
        navigable_area: (m,) int32, area of each navigable cell, -1 none.
        narrows: (N,) EDGE_DTYPE whose `rooms` are two areas of one room.
        windows: (W,) WINDOW_DTYPE, those that the walls show.
        free: cells known to be empty (rays crossed them), of the same origin but perhaps another edge length; or None.
        provenance: (n,) uint32 bit set of the maps that saw each cell, or None for a map of one source.
        source: the file it was made from; of a joined map those of all, with `JOINED` between them.
        parameters: what it was extracted with.
        seconds: step -> s.
        warnings: what the user should know.
        landmarks: signs, tags, radio, pressure, objects and names, in the frame of the map.
    """

    grid: VoxelGrid
    room: Array
    navigable: VoxelGrid
    navigable_room: Array
    rooms: Array
    edges: Array
    storeys: Array
    areas: Array = field(default_factory=lambda: np.zeros(0, AREA_DTYPE))
    navigable_area: Array | None = None
    narrows: Array = field(default_factory=lambda: np.zeros(0, EDGE_DTYPE))
    windows: Array = field(default_factory=lambda: np.zeros(0, WINDOW_DTYPE))
    free: VoxelGrid | None = None
    provenance: Array | None = None
    source: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    landmarks: Landmarks = field(default_factory=Landmarks)

    def __post_init__(self) -> None:
        require(self.room.shape == (len(self.grid),), "room must have one label an occupied cell")
        require(self.navigable_room.shape == (len(self.navigable),), "navigable_room must have one label a cell")
        require(self.rooms.dtype == ROOM_DTYPE, "rooms must have ROOM_DTYPE")
        require(self.edges.dtype == EDGE_DTYPE, "edges must have EDGE_DTYPE")
        require(self.storeys.dtype == STOREY_DTYPE, "storeys must have STOREY_DTYPE")
        require(self.areas.dtype == AREA_DTYPE, "areas must have AREA_DTYPE")
        require(self.narrows.dtype == EDGE_DTYPE, "narrows must have EDGE_DTYPE")
        require(self.windows.dtype == WINDOW_DTYPE, "windows must have WINDOW_DTYPE")
        if self.navigable_area is None:
            object.__setattr__(self, "navigable_area", np.full(len(self.navigable), -1, np.int32))
        assert self.navigable_area is not None
        require(self.navigable_area.shape == (len(self.navigable),), "navigable_area must have one label a cell")
        require(int(self.navigable_area.max(initial=-1)) < len(self.areas), "a cell's area does not exist")
        require(int(self.narrows["rooms"].max(initial=-1)) < len(self.areas), "a narrowing's area does not exist")
        owner = self.areas["room"]
        require(not len(owner) or (owner.min() >= 0 and owner.max() < len(self.rooms)), "an area's room does not exist")
        for labels in (self.room, self.navigable_room):
            if len(labels):
                require(labels.min() >= -1 and labels.max() < len(self.rooms), "a cell's room does not exist")
        ends = self.edges["rooms"]
        require(not len(ends) or (ends.min() >= 0 and ends.max() < len(self.rooms)), "an edge's room does not exist")
        require(bool((ends[:, 0] != ends[:, 1]).all()), "an edge must join two rooms")
        first, second = self.windows["rooms"].T
        require(int(first.min(initial=0)) >= 0 and int(second.min(initial=0)) >= -1, "a window's room does not exist")
        require(int(self.windows["rooms"].max(initial=-1)) < len(self.rooms), "a window's room does not exist")
        require(bool((first != second).all()), "a window must not lead from a room into itself")
        storey = self.rooms["storey"]
        require(not len(storey) or (storey.min() >= 0 and storey.max() < len(self.storeys)), "a room's storey is missing")
        for column, most in (("room", len(self.rooms)), ("storey", len(self.storeys))):
            number = self.landmarks.table[column]
            require(not len(number) or (number.min() >= -1 and number.max() < most), f"a landmark's {column} does not exist")
        require(self.provenance is None or len(self.provenance) == len(self.grid), "provenance: one value a cell")

    @property
    def title(self) -> str:
        """Names of the files that it was made from, without their folders."""
        return JOINED.join(Path(source).name or "map" for source in self.source.split(JOINED))

    @property
    def levelling(self) -> Array:
        """(4, 4) float64 that takes points of its file into the frame of the map: the identity unless the cloud was tilted."""
        return read_levelling(self.parameters)

    @property
    def open_edges(self) -> Array:
        """The edges that one can walk through: what networks and features of rooms see, as a shut door shows in few maps."""
        out: Array = self.edges[self.edges["open"]]
        return out

    def find_cell_storeys(self) -> Array:
        """Return (n,) int32 storey of each occupied cell: its room's, or for a cell without a room the last one whose floor is
        not above it."""
        if not len(self.storeys):
            return np.full(len(self.grid), -1, np.int32)
        level = self.grid.cells[:, 2]
        z = self.grid.origin[2] + (np.arange(int(level.max(initial=0)) + 1) + 0.5) * self.grid.edge
        by_height = np.searchsorted(self.storeys["floor"] - 2 * self.grid.edge, z) - 1
        storey = np.clip(by_height, 0, None).astype(np.int32)[level]
        with_room = self.room >= 0
        storey[with_room] = self.rooms["storey"][self.room[with_room]]
        return storey


def select_rooms(map: TopometricMap, stays: Array) -> TopometricMap:
    """Return the map of some of its rooms, numbered anew in their order.

    Cells of the others are of no room, and their areas, doors and stairs are left out. A window of theirs stays
    where the room on its other side does; it then leads to where nothing was seen. Storeys and landmarks stay.

    Args:
        map: any map.
        stays: (R,) bool.
    """
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1).astype(np.int32)
    of_area = stays[map.areas["room"]]
    area_number = np.append(np.where(of_area, np.cumsum(of_area) - 1, -1), -1).astype(np.int32)
    areas = map.areas[of_area].copy()
    areas["room"] = number[areas["room"]]
    edges = map.edges[stays[map.edges["rooms"]].all(axis=1)].copy()
    narrows = map.narrows[of_area[map.narrows["rooms"]].all(axis=1)].copy()
    edges["rooms"], narrows["rooms"] = number[edges["rooms"]], area_number[narrows["rooms"]]
    windows = map.windows.copy()
    ends = number[windows["rooms"]]
    both = (ends >= 0).all(axis=1, keepdims=True)
    windows["rooms"] = np.where(both, np.sort(ends, axis=1), -np.sort(-ends, axis=1))
    landmarks = map.landmarks.table.copy()
    landmarks["room"] = number[landmarks["room"]]
    assert map.navigable_area is not None
    return replace(
        map,
        room=number[map.room],
        navigable_room=number[map.navigable_room],
        rooms=map.rooms[stays],
        edges=edges,
        areas=areas,
        navigable_area=area_number[map.navigable_area],
        narrows=narrows,
        windows=windows[windows["rooms"][:, 0] >= 0],
        landmarks=replace(map.landmarks, table=landmarks),
    )


def filter_confident(map: TopometricMap, least: float) -> TopometricMap:
    """Return the map without the rooms, doors, stairs and windows that are less likely than `least`; as `select_rooms` has it.

    Args:
        map: any map.
        least: confidence from which on they stay, 0 to 1; 0: the map itself.

    Raises:
        InputError: `least` is no probability.
    """
    if not 0 <= least <= 1:
        raise InputError(f"min_confidence {least}: is no probability; give a number from 0 to 1 (0 keeps everything)")
    if least == 0:
        return map
    edges, windows = (table[table["confidence"] >= least] for table in (map.edges, map.windows))
    return select_rooms(replace(map, edges=edges, windows=windows), map.rooms["confidence"] >= least)
