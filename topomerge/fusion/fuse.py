"""Maps and where they lie -> one map: cells are fused one map after the other, rooms and doors carried over at the end
(seeds 3.3; method 4).

Maps are bent in their own frames, then posed; their cells are resampled on the lattice of the first one (`resampling`).

Maps whose heights were assumed (slices and drawings, extruded) add only what no other map saw: what stands on the floor of a room
would become a wall that fills it. They still say that they saw the cells of others that lie in theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Protocol

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.attributes import find_rooms_at, select_distinct_doors
from topomerge.extraction.cleaning import add_means
from topomerge.extraction.elevations.wall_doors import add_wall_doors
from topomerge.extraction.extract import extract, list_warnings
from topomerge.extraction.navigable import find_free_space
from topomerge.extraction.room_odds import add_room_probabilities
from topomerge.extraction.scan import COARSEST_CELL, FINEST_CELL, Scan
from topomerge.extraction.slices import is_raised
from topomerge.extraction.topology import build_topometric_map
from topomerge.fusion.joined_rooms import JOINED_PARAMETERS, PartFloor, join_rooms, select_part_floor
from topomerge.fusion.resampling import decode_cells, encode_cells, find_wall_copies, resample_cells, transform_means, unite_codes
from topomerge.fusion.transfer import (
    PlacedPart,
    add_carried_odds,
    add_joined_landmarks,
    add_joined_windows,
    add_part_doors,
    add_part_narrows,
    add_part_odds,
    transform_floor,
    transform_part,
    transform_part_landmarks,
    transform_windows,
    vote_rooms,
)
from topomerge.kernels import run_side_by_side
from topomerge.kernels.occupied_cells import OFFSET_STEPS
from topomerge.matching.consistency import find_matches
from topomerge.matching.room_plans import build_room_plans
from topomerge.registration.storeys import is_extruded
from topomerge.types import (
    JOINED,
    LEVELLED,
    Array,
    Deformation,
    Placement,
    Sim3,
    TopometricMap,
    VoxelGrid,
    are_within,
    compute_extent,
    is_level,
)

ALIKE_EDGES = 0.8  # ratio of edge lengths: cells of another map that are not smaller than that keep those of the first
PROVENANCE_BITS = 32  # maps that one bit set tells apart
ASSUMED_MARGIN = 0.3  # m around what other maps saw: there an extruded wall is one of theirs that is a little off
PlacedCells = tuple[Array, Array]  # cells of the joined map that those of a map fill, and which do


class MapSequence(Protocol):
    """Maps that are loaded when they are asked for."""

    def __getitem__(self, k: int, /) -> TopometricMap: ...


def fuse(maps: MapSequence, poses: Sequence[tuple[int, Sim3]], bends: Mapping[int, Deformation] | None = None) -> TopometricMap:
    """Fuse maps in the frame of the first, at its edge length unless another one's cells are clearly finer.

    Each cell carries the bit set of the maps that saw it: bit k for the kth pose; maps that are joined already keep their bits,
    those of the next map follow. What one map saw empty and another one occupied is occupied: what moves (doors, chairs, people)
    stands where it was seen.

    Args:
        maps: loaded one at a time.
        poses: which maps, with T_0k; the first is the identity.
        bends: k -> how map k is bent in its own frame, before it is posed; the others are rigid.

    Raises:
        InputError: more maps than provenance can tell apart.
    """
    parts = [_Part.from_map(maps[k], pose) for k, pose in poses]
    first_bits = np.cumsum([0, *(part.bits for part in parts)])
    if first_bits[-1] > PROVENANCE_BITS:
        raise InputError(
            f"{len(poses)} maps are joined of {first_bits[-1]}; at most {PROVENANCE_BITS} can be told apart in one; merge fewer"
        )
    cells = _JoinedCells(maps[poses[0][0]].grid.origin, _choose_edge(parts))
    order = sorted(range(len(poses)), key=lambda n: parts[n].assumed)  # what was assumed comes last
    placements = [Placement.of(pose, (bends or {}).get(k), maps[k].grid.edge) for k, pose in poses]
    windows, marks = [], {}
    placed_parts: list[PlacedPart] = []
    floors: list[tuple[TopometricMap, PlacedCells]] = []
    for n in order:
        map = maps[poses[n][0]]
        first_room = sum(len(part.table) for part in placed_parts)
        placed = cells.place_cells(map, placements[n])
        cells.add_map(map, placements[n], placed, int(first_bits[n]), first_room, parts[n].assumed and n != order[0])
        floors.append((map, placed[2]))
        windows.append(transform_windows(map, placements[n]))
        placed_parts.append(transform_part(map, placements[n]))
        if len(map.landmarks):
            marks[n] = transform_part_landmarks(map, placements[n], placed_parts[-1].rooms)
    name = JOINED.join(maps[k].source or "map" for k, _ in poses)
    rooms = [part.rooms for part in placed_parts]
    joined = _build_joined(cells, floors, placed_parts, name)
    joined = add_joined_windows(add_part_doors(add_part_odds(joined, rooms), placed_parts), windows)
    if marks:
        joined = add_joined_landmarks(joined, marks, [maps[k].title for k, _ in poses])
    first = maps[poses[0][0]].levelling
    if not is_level(first):  # the frame of the joined map is that of the first one
        joined = replace(joined, parameters={**joined.parameters, LEVELLED: first.tolist()})
    return joined


@dataclass(frozen=True)
class _Part:
    """A map as it is prepared for fusion: number of provenance bits, edge length in the joined frame, m, and whether its
    heights were assumed."""

    bits: int
    edge: float
    assumed: bool

    @classmethod
    def from_map(cls, map: TopometricMap, pose: Sim3) -> _Part:
        bits = 1 if map.provenance is None else max(int(np.bitwise_or.reduce(map.provenance, initial=0)).bit_length(), 1)
        return cls(bits, pose.scale * map.grid.edge, is_extruded(map.grid))


def _choose_edge(parts: Sequence[_Part]) -> float:
    """Choose the edge, m, of the joined cells: of the first map, unless another one's are clearly finer."""
    edge = parts[0].edge
    for part in parts:
        if not part.assumed and part.edge < ALIKE_EDGES * edge:
            edge = part.edge
    return float(np.clip(edge, FINEST_CELL, COARSEST_CELL))


class _JoinedCells:
    """Cells that are joined so far: their Morton codes, ascending, which maps saw them, the room of a map that they are of
    (numbered through all maps, -1 none), and where in them their points lie on average (0..1), as how many points say; codes of
    the free cells, which are twice as long.

    Args:
        origin: (3,) m, corner of cell (0, 0, 0).
        edge: of the cells, m.
    """

    def __init__(self, origin: Array, edge: float) -> None:
        self.origin, self.edge = origin, edge
        self.codes = self.free_codes = np.zeros(0, np.uint64)
        self.provenance = np.zeros(0, np.uint32)
        self.room = np.zeros(0, np.int64)
        self.means: Array = np.zeros((0, 3))
        self.points: Array = np.zeros(0)

    def place_cells(self, map: TopometricMap, placement: Placement) -> list[PlacedCells]:
        """Return for the occupied, the free and the navigable cells of a map which cells (k, 3) of the lattice they fill, and the
        row (k,) of one that does. The lattice of free cells is twice as wide."""
        grids = (map.grid, self.edge), (map.free, 2 * self.edge), (map.navigable, self.edge)
        none = np.zeros((0, 3), np.int64), np.zeros(0, np.int64)

        def place(asked: tuple[VoxelGrid | None, float]) -> PlacedCells:
            grid, edge = asked
            return none if grid is None else resample_cells(grid, placement, self.origin, edge)

        return run_side_by_side(place, grids)

    def add_map(
        self,
        map: TopometricMap,
        placement: Placement,
        placed: Sequence[PlacedCells],
        first_bit: int,
        first_room: int,
        assumed: bool,
    ) -> None:
        """Add a map whose cells are placed; of one whose heights were assumed only what no other saw."""
        provenance = np.ones(len(map.grid), np.uint32) if map.provenance is None else map.provenance.astype(np.uint32)
        cells, rows = placed[0]
        provenance = provenance[rows] << np.uint32(first_bit)
        room = map.room[rows].astype(np.int64)
        room = np.where(room >= 0, room + first_room, -1)
        means, points = transform_means(map.grid, placement, rows, cells, self.origin, self.edge)
        # Walls that were raised from a slice are a guess: they go where no other map has any near (docs/adr/0020).
        if assumed and len(cells):
            added = self._is_occupied(cells) | ~(self._is_surveyed(cells) | self._is_seen_through(cells))
            cells, provenance, room, means, points = cells[added], provenance[added], room[added], means[added], points[added]
        free_cells = None if map.free is None else placed[1][0]
        if free_cells is not None and len(self.free_codes) and len(cells):
            occupied = decode_cells(self.codes)
            copy_of = find_wall_copies((occupied, decode_cells(self.free_codes)), (cells, free_cells), self.edge)
            cells = np.where(copy_of[:, None] >= 0, occupied[copy_of], cells)
            points = np.where(copy_of >= 0, 0.0, points)  # they lie beside the wall
        self._add(cells, provenance, room, means, points)
        if free_cells is not None:
            self.free_codes = unite_codes(self.free_codes, encode_cells(free_cells))

    def _add(self, cells: Array, provenance: Array, room: Array, means: Array, points: Array) -> None:
        before, new = len(self.codes), encode_cells(cells)
        codes = unite_codes(self.codes, new)
        row = np.searchsorted(codes, np.concatenate([self.codes, new]))
        self.codes = codes
        joined = np.zeros(len(self.codes), np.uint32)
        np.bitwise_or.at(joined, row, np.concatenate([self.provenance, provenance]))
        self.provenance = joined
        labels = np.full(len(self.codes), -1)
        labels[row[before:]] = room
        kept = self.room >= 0
        labels[row[:before][kept]] = self.room[kept]
        self.room = labels
        means, points = np.concatenate([self.means, means]), np.concatenate([self.points, points])
        # Means of both maps: so a wall lies within 6 mm of its points and is registered as well as one of a scan (docs/adr/0014).
        self.points = np.bincount(row, points, len(joined))
        total = np.column_stack([np.bincount(row, points * means[:, k], len(joined)) for k in range(3)])
        self.means = np.where(self.points[:, None] > 0, total / np.maximum(self.points, 1e-9)[:, None], 0.5)

    def convert_means(self) -> Array:
        """Return (n, 3) where the points of each cell lie on average, never on its border: rounding may take that for the next
        cell."""
        steps = np.minimum(self.means * OFFSET_STEPS, OFFSET_STEPS - 1).astype(np.int64)
        middles: Array = self.origin + (decode_cells(self.codes) + (steps + 0.5) / OFFSET_STEPS) * self.edge
        return middles

    def _is_occupied(self, cells: Array) -> Array:
        """Return (n,) bool: is a cell there already?"""
        return np.isin(encode_cells(cells), self.codes)

    def _is_seen_through(self, cells: Array) -> Array:
        """Return (n,) bool: do cells lie where rays went?"""
        return np.isin(encode_cells(cells // 2), self.free_codes)

    def _is_surveyed(self, cells: Array) -> Array:
        """Return (n,) bool: have the columns of cells, at the heights between the lowest and the highest of them, anything
        near?"""
        occupied = decode_cells(self.codes)
        low, high = cells[:, 2].min(), cells[:, 2].max()
        occupied = occupied[(occupied[:, 2] >= low - 3) & (occupied[:, 2] <= high + 3)]
        if not len(occupied):
            return np.zeros(len(cells), bool)
        corner, last = compute_extent(np.concatenate([occupied[:, :2], cells[:, :2]]))
        shape = last - corner + 1
        mask = np.zeros(shape, bool)
        mask[tuple((occupied[:, :2] - corner).T)] = True
        mask = ndimage.binary_dilation(mask, iterations=max(round(ASSUMED_MARGIN / self.edge), 1))
        surveyed: Array = mask[tuple((cells[:, :2] - corner).T)]
        return surveyed


def _build_joined(
    joined: _JoinedCells, placed_cells: Sequence[tuple[TopometricMap, PlacedCells]], parts: Sequence[PlacedPart], name: str
) -> TopometricMap:
    """Build the map of rooms and narrowings of what was joined, and doors where rooms were cut anew.

    Args:
        placed_cells: the maps, with the cells that their floor fills.
        parts: the same maps as they lie in the joined one.
    """
    cells = decode_cells(joined.codes)
    base = 2 * (compute_extent(cells)[0] // 2)  # even: free cells are twice as long
    tables: dict[str, Array] = {"provenance": joined.provenance, "room": joined.room}
    grid = VoxelGrid.from_cells(cells - base, joined.origin + base * joined.edge, joined.edge, properties=tables)
    provenance, label = grid.properties["provenance"], grid.properties["room"]
    grid = replace(grid, properties={})
    floors = [select_part_floor(map, lattice - base, rows, grid) for map, (lattice, rows) in placed_cells]
    if any(len(floor.cells) for floor in floors):
        map = _carry_rooms(grid, label, floors, parts)
        map = replace(map, source=name)
    else:
        # No part has a room that could be carried over (docs/adr/0038).
        map = extract(grid, name=name, carve=False)
        # Floors that the extraction assumes under slices are cells that no map saw.
        rows = grid.find_rows(grid.locate(map.grid.compute_centroids()))
        provenance = np.where(rows >= 0, provenance[rows], 0).astype(np.uint32)
    free = _build_free_space(joined, grid, base)
    if free is None:
        free = find_free_space(Scan(grid), map.navigable, JOINED_PARAMETERS.range)
    # Not before: doors that are read off the means of two maps are worse than those of the plan and of the maps (docs/adr/0014).
    middles = map.grid if not joined.points.any() else add_means(map.grid, joined.convert_means(), joined.points)
    return replace(map, grid=middles, provenance=provenance, free=free)


def _build_free_space(joined: _JoinedCells, grid: VoxelGrid, base: Array) -> VoxelGrid | None:
    """Build the grid of cells that a part saw empty and none occupied; None where no part knows any.

    Args:
        base: (3,) cell of the lattice at the corner of the grid.
    """
    if not len(joined.free_codes):
        return None
    free_cells = decode_cells(joined.free_codes) - base // 2
    free_cells = free_cells[are_within(free_cells, 0, -(-np.array(grid.shape) // 2))]
    x, y, z = (-(-s // 2) for s in grid.shape)
    free = VoxelGrid.from_cells(free_cells, grid.origin, 2 * grid.edge, (x, y, z))
    return free.select_cells(~grid.coarsen(2).contains(free.cells))


def _carry_rooms(grid: VoxelGrid, label: Array, floors: Sequence[PartFloor], parts: Sequence[PlacedPart]) -> TopometricMap:
    """Return the joined map with the rooms of its parts, and those that were cut anew; doors only of these.

    Args:
        label: (n,) room of a part of each cell, numbered through all parts, -1 none.
    """
    tables, p = [part.table for part in parts], JOINED_PARAMETERS
    found = join_rooms(grid, label, floors, tables, [part.rooms for part in parts])
    map = build_topometric_map(grid, found.floor, p.standing_height, found.carried)
    number = _number_anew(found.floor.room, map.navigable_room)
    member = np.where(found.member >= 0, number[found.member], -1)
    map, known = add_carried_odds(map, tables, member, found.share)
    map = add_room_probabilities(map, raised=is_raised(grid), asked=~known)
    # None for walls: faces of two maps differ by more than a leaf lies back, so doors read off them are worse (docs/adr/0014).
    map = select_distinct_doors(add_wall_doors(map, found.floor.classified_storeys, None))
    assert map.navigable_area is not None
    area = np.append(_number_anew(found.floor.area, map.navigable_area), -1)[found.area_member]
    narrows = np.concatenate([part.narrows for part in parts])
    first = np.repeat(np.cumsum([0, *(len(floor.room_of_area) for floor in floors)])[:-1], [len(part.narrows) for part in parts])
    narrows["rooms"] = area[narrows["rooms"] + first[:, None]]
    map = add_part_narrows(map, narrows)
    parameters = {**asdict(p), "voxel_size": grid.edge, "preset": "default"}
    return replace(map, parameters=parameters, warnings=tuple(list_warnings(map)))


def _number_anew(old: Array, new: Array) -> Array:
    """Return (n + 1,) new number of each old one, -1 where there is none."""
    out = np.full(int(old.max(initial=-1)) + 2, -1)
    out[old] = new
    out[-1] = -1
    return out


def match_common_rooms(
    a: TopometricMap,
    b: TopometricMap,
    transform: Sim3,
    bends: tuple[Deformation | None, Deformation | None] = (None, None),
) -> tuple[Array, Array]:
    """Return (M, 2) rooms of a and of b that are one room under T_ab, and (M,) 0..1 how much of their floor they share.

    A room that is cut in two in the other map is in two rows.

    Args:
        bends: of a and of b, each in its own frame; T_ab lays bent b on bent a.
    """
    if not len(a.rooms) or not len(b.rooms):
        return np.zeros((0, 2), np.int64), np.zeros(0)
    to, moved = Placement.of(Sim3(), bends[0]), Placement.of(transform, bends[1])
    bent = to.bend is not None or moved.bend is not None
    return find_matches(
        transform,
        (build_room_plans(a), build_room_plans(b)),
        (lambda p: to.invert_points(moved.transform_points(p))) if bent else None,
    )


def find_joined_rooms(part: TopometricMap, joined: TopometricMap, pose: Sim3, bend: Deformation | None = None) -> Array:
    """Return (R,) room of the joined map in which most of the floor of each room of a part lies, -1 none.

    Args:
        pose: of the part in the joined map.
        bend: of the part, in its own frame, before it is posed; None: rigid.
    """
    floor, part_room = transform_floor(part, Placement.of(pose, bend))
    return vote_rooms(part_room, find_rooms_at(joined, floor), len(part.rooms))
