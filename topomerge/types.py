"""The nouns of the library: frozen dataclasses over arrays, validated when they are made.

Conventions: z is up, lengths are metres, angles radians. Poses are float64, points float32 about a float64 shift. ``T_ab`` maps
points of map b into the frame of map a. A room label of -1 means "no room".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topomerge.kernels import lookup, morton, stencil

Array = NDArray[Any]

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
        ("glimpsed", "?"),  # most of the outline was not seen: looked into through a door or a window
    ]
)
EDGE_DTYPE = np.dtype(
    [
        ("rooms", "i4", 2),
        ("centre", "f8", 3),  # on the floor, in the input's frame
        ("width", "f8"),  # m
        ("height", "f8"),  # m of clear height; 0 where nothing was seen above
        ("direction", "f8"),  # rad, of the wall's normal in the horizontal plane, in [0, pi)
        ("kind", "U8"),  # door | opening | stairs | ramp
        ("open", "?"),  # one could walk through; a shut door joins two rooms, too
        ("confidence", "f8"),  # that it is one: 0..1
        ("lower", "f8", 3),  # of stairs and ramps: where they begin and end, in the input's frame; of doors both the centre
        ("upper", "f8", 3),
    ]
)
AREA_DTYPE = np.dtype(
    [
        ("room", "i4"),
        ("centroid", "f8", 3),  # of its navigable cells, in the input's frame
        ("area", "f8"),  # m2 of navigable floor, seen from above
    ]
)
STOREY_DTYPE = np.dtype([("floor", "f8"), ("ceiling", "f8"), ("area", "f8")])  # m, m (nan: not seen), m2


def _extent(cells: Array) -> tuple[Array, Array]:
    columns = cells.T  # a reduction along the rows is four times slower
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True, eq=False)
class TrueRoom:
    """A room that is known, not estimated: from a building model, a plan or a simulator."""

    name: str
    polygon: Array  # (k, 2) float64, outline of the floor, counter-clockwise, not closed
    floor: float
    ceiling: float
    storey: int = 0
    kind: str = ""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of one partial map, z up, in metres.

    ``points + shift`` are the coordinates of the input file: float32 alone would lose centimetres in a national grid.
    """

    points: Array  # (N, 3) float32
    shift: Array = field(default_factory=lambda: np.zeros(3))  # (3,) float64
    colors: Array | None = None  # (N, 3) uint8
    labels: Array | None = None  # (N,) int32, true room of each point (index into `rooms`), -1: none
    poses: Array | None = None  # (K, 4, 4) float64, sensor into the file's frame
    pose_of: Array | None = None  # (N,) int32, index into `poses`, -1: unknown
    free: VoxelGrid | None = None  # cells known to be empty
    rooms: tuple[TrueRoom, ...] = ()
    source: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check(self.points.ndim == 2 and self.points.shape[1] == 3, f"points must be (N, 3), not {self.points.shape}")
        for name in ("colors", "labels", "pose_of"):
            values = getattr(self, name)
            _check(values is None or len(values) == len(self.points), f"{name} must have one row a point")

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Occupied cells of a regular grid with properties (seeds 2.2).

    Cells are unique, not negative and stand in Morton order; ``origin`` is the seeds' V_min and ``edge`` their e_l.

    Args:
        cells: (n, 3) int32, sorted by Morton code (see `from_cells` for cells in any order).
        origin: (3,) float64, the corner of cell (0, 0, 0).
        edge: edge length of a cell, m.
        shape: number of cells along each axis; V_max = origin + shape * edge.
        properties: name -> (n, ...) array.
    """

    cells: Array
    origin: Array
    edge: float
    shape: tuple[int, int, int]
    properties: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check(self.edge > 0 and np.isfinite(self.edge), f"edge length must be above 0 m, not {self.edge}")
        _check(np.shape(self.origin) == (3,) and bool(np.isfinite(self.origin).all()), f"origin must be (3,), not {self.origin}")
        _check(self.cells.ndim == 2 and self.cells.shape[1] == 3, f"cells must be (n, 3), not {self.cells.shape}")
        _check(self.cells.dtype == np.int32, f"cells must be int32, not {self.cells.dtype}")
        _check(all(0 < s <= morton.LIMIT for s in self.shape), f"grid shape {self.shape} is outside 1..{morton.LIMIT}")
        if len(self.cells):
            low, high = _extent(self.cells)
            _check(bool((low >= 0).all() and (high < self.shape).all()), f"cells {low}..{high} outside {self.shape}")
            _check(bool((self.codes[1:] > self.codes[:-1]).all()), "cells must be unique and in Morton order")
        for name, values in self.properties.items():
            _check(len(values) == len(self.cells), f"property {name} must have one row a cell")

    @staticmethod
    def from_cells(
        cells: Array,
        origin: Array | None = None,
        edge: float = 0.1,
        shape: tuple[int, int, int] | None = None,
        properties: Mapping[str, Array] | None = None,
    ) -> VoxelGrid:
        """A grid from cells in any order; repeated cells are kept once, with the properties of their first mention."""
        cells = np.asarray(cells).reshape(-1, 3)
        if len(cells):  # before the codes: they hold 21 bits an axis, and a cell beyond would take the place of another
            _check(np.issubdtype(cells.dtype, np.integer), f"cells must be integers, not {cells.dtype}")
            low, high = _extent(cells)
            _check(bool((low >= 0).all() and (high < morton.LIMIT).all()), f"cells {low}..{high} not in 0..{morton.LIMIT}")
        cells = np.ascontiguousarray(cells, np.int32)
        first = morton.unique_rows(morton.encode(cells))
        kept = np.ascontiguousarray(cells[first])
        if shape is None:
            shape = tuple(int(s) + 1 for s in high) if len(kept) else (1, 1, 1)  # type: ignore[assignment]
        assert shape is not None
        origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
        return VoxelGrid(kept, origin, edge, shape, {k: v[first] for k, v in (properties or {}).items()})

    def __len__(self) -> int:
        return len(self.cells)

    @cached_property
    def codes(self) -> Array:
        """(n,) uint64 Morton codes, ascending."""
        return morton.encode(self.cells)

    @cached_property
    def _bricks(self) -> tuple[Array, Array]:
        return lookup.build(self.cells, self.shape)

    @cached_property
    def _columns(self) -> Array:
        return stencil.columns(self.cells, *self._bricks)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """V_min and V_max, m."""
        return self.origin, self.origin + np.asarray(self.shape) * self.edge

    def cell_bounds(self, cells: Array) -> tuple[Array, Array]:
        """Corners v_min and v_max of cells, m."""
        low = self.origin + np.asarray(cells) * self.edge
        return low, low + self.edge

    def centroids(self, cells: Array | None = None) -> Array:
        """(n, 3) float64 centres v_c of the given cells, or of all."""
        return self.origin + (np.asarray(self.cells if cells is None else cells) + 0.5) * self.edge

    def locate(self, points: Array) -> Array:
        """(n, 3) int64 cells v_p that hold the given points; outside the bounds they are negative or beyond `shape`."""
        return np.floor((np.asarray(points, np.float64) - self.origin) / self.edge).astype(np.int64)

    def rows(self, cells: Array) -> Array:
        """(m,) int64 row of each given cell, -1 where it is not occupied."""
        return lookup.rows(*self._bricks, np.ascontiguousarray(cells, np.int64).reshape(-1, 3))

    def contains(self, cells: Array) -> Array:
        """(m,) bool: is the cell occupied?"""
        return self.rows(cells) >= 0

    def subset(self, mask: Array) -> VoxelGrid:
        """The same volume with only the masked cells (bool mask or ascending row numbers)."""
        kept = np.ascontiguousarray(self.cells[mask])
        return replace(self, cells=kept, properties={k: v[mask] for k, v in self.properties.items()})

    def with_cells(self, cells: Array, properties: Mapping[str, Array] | None = None) -> VoxelGrid:
        """Other cells (any order) of the same volume."""
        return VoxelGrid.from_cells(cells, self.origin, self.edge, self.shape, properties)

    def coarser(self, factor: int) -> VoxelGrid:
        """The cells, `factor` times as long, in which one or more of these lie; without properties."""
        x, y, z = (-(-s // factor) for s in self.shape)
        return VoxelGrid.from_cells(self.cells // factor, self.origin, self.edge * factor, (x, y, z))

    def with_properties(self, **properties: Array) -> VoxelGrid:
        """The same cells with more properties."""
        grid = replace(self, properties={**self.properties, **properties})
        for index in ("_bricks", "_columns"):  # of the cells, which stay: don't make it twice
            if index in self.__dict__:
                grid.__dict__[index] = self.__dict__[index]
        return grid


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
        free: cells known to be empty (rays crossed them), of the same origin but perhaps another edge length; or None.
        provenance: (n,) uint32 bit set of the maps that saw each cell, or None for a map of one source.
        source: the file it was made from.
        parameters: what it was extracted with.
        seconds: step -> s.
        warnings: what the user should know.
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
    free: VoxelGrid | None = None
    provenance: Array | None = None
    source: str = ""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check(self.room.shape == (len(self.grid),), "room must have one label an occupied cell")
        _check(self.navigable_room.shape == (len(self.navigable),), "navigable_room must have one label a cell")
        _check(self.rooms.dtype == ROOM_DTYPE, "rooms must have ROOM_DTYPE")
        _check(self.edges.dtype == EDGE_DTYPE, "edges must have EDGE_DTYPE")
        _check(self.storeys.dtype == STOREY_DTYPE, "storeys must have STOREY_DTYPE")
        _check(self.areas.dtype == AREA_DTYPE, "areas must have AREA_DTYPE")
        _check(self.narrows.dtype == EDGE_DTYPE, "narrows must have EDGE_DTYPE")
        if self.navigable_area is None:
            object.__setattr__(self, "navigable_area", np.full(len(self.navigable), -1, np.int32))
        assert self.navigable_area is not None
        _check(self.navigable_area.shape == (len(self.navigable),), "navigable_area must have one label a cell")
        _check(int(self.navigable_area.max(initial=-1)) < len(self.areas), "a cell's area does not exist")
        _check(int(self.narrows["rooms"].max(initial=-1)) < len(self.areas), "a narrowing's area does not exist")
        owner = self.areas["room"]
        _check(not len(owner) or (owner.min() >= 0 and owner.max() < len(self.rooms)), "an area's room does not exist")
        for labels in (self.room, self.navigable_room):
            if len(labels):
                _check(labels.min() >= -1 and labels.max() < len(self.rooms), "a cell's room does not exist")
        ends = self.edges["rooms"]
        _check(not len(ends) or (ends.min() >= 0 and ends.max() < len(self.rooms)), "an edge's room does not exist")
        _check(bool((ends[:, 0] != ends[:, 1]).all()), "an edge must join two rooms")
        storey = self.rooms["storey"]
        _check(not len(storey) or (storey.min() >= 0 and storey.max() < len(self.storeys)), "a room's storey is missing")
        _check(self.provenance is None or len(self.provenance) == len(self.grid), "provenance: one value a cell")

    def storey_of_cells(self) -> Array:
        """(n,) int32 storey of each occupied cell: its room's, or for a cell without a room the last one whose floor is
        not above it."""
        if not len(self.storeys):
            return np.full(len(self.grid), -1, np.int32)
        z = self.grid.centroids()[:, 2]
        by_height = np.searchsorted(self.storeys["floor"] - 2 * self.grid.edge, z) - 1
        storey = np.clip(by_height, 0, None).astype(np.int32)
        with_room = self.room >= 0
        storey[with_room] = self.rooms["storey"][self.room[with_room]]
        return storey


@dataclass(frozen=True)
class Sim3:
    """A gravity-aligned similarity: p -> scale * Rz(yaw) p + translation."""

    yaw: float = 0.0
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        values = (self.yaw, *self.translation, self.scale)
        _check(all(np.isfinite(v) for v in values) and self.scale > 0, f"not a similarity: {values}")

    @property
    def matrix(self) -> Array:
        """(4, 4) float64."""
        c, s = self.scale * np.cos(self.yaw), self.scale * np.sin(self.yaw)
        m = np.eye(4)
        m[:2, :2] = ((c, -s), (s, c))
        m[2, 2] = self.scale
        m[:3, 3] = self.translation
        return m

    def apply(self, points: Array) -> Array:
        """Transform (n, 3) points."""
        m = self.matrix
        return np.asarray(points, np.float64) @ m[:3, :3].T + m[:3, 3]

    def inverse(self) -> Sim3:
        """The similarity that undoes this one."""
        back = Sim3(-self.yaw, (0.0, 0.0, 0.0), 1.0 / self.scale)
        x, y, z = (-back.apply(np.array([self.translation]))[0]).tolist()
        return Sim3(-self.yaw, (x, y, z), 1.0 / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        x, y, z = self.apply(np.array([other.translation]))[0].tolist()
        yaw = (self.yaw + other.yaw + np.pi) % (2 * np.pi) - np.pi
        return Sim3(float(yaw), (x, y, z), self.scale * other.scale)
