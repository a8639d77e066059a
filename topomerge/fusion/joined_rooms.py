"""Rooms of a joined map from those of its parts (method 4; docs/adr/0038).

Rooms of the parts that share their floor are one. What the parts agree on is carried over by the placement. Floor on which they
do not agree is cut anew: where a part has two rooms that another one has as one, where rooms overlap in part, and where rooms
meet of which no part saw both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import edt
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from topomerge.extraction.extract import cut_rooms
from topomerge.extraction.parameters import DefaultParameters
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.extraction.plans.storey_floor import FLOOR_PROPERTIES, join_floor
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.scan import Scan
from topomerge.extraction.segment import LEAST_ROOM
from topomerge.extraction.storeys import find_storeys, measure_floor_to_ceiling
from topomerge.progress import Stopwatch
from topomerge.types import Array, TopometricMap, VoxelGrid, are_within

SAME_SHARE = 0.5  # of the floor of the smaller of two rooms, in the larger one: they are one
DOUBT_SHARE, DOUBT_AREA = 0.1, 1.0  # of it, and m2: of less, walls lie a little off; of more, nobody knows whose it is
PIECE_AREA = 2.0  # m2 of a room that counts as one beside another, or beyond it
LEAST_CONTACT = 0.4  # m of border: shorter ones are no passage
AROUND = 1.0  # m of what is beside floor that is cut anew
JOINED_PARAMETERS = DefaultParameters()
MOST_CARRIED = 0.5  # of a room that is cut anew, on floor that is carried over: it is a glimpse of that


class PartFloor(NamedTuple):
    """The floor of a part's rooms on the lattice of the joined map.

    Args:
        cells: (k, 3) of the joined grid.
        room, area, standing: (k,) of the part.
        room_of_area: (A,) of all areas of the part.
        complete: does it reach the walls? Of a part of the thesis' preset it does not.
    """

    cells: Array
    room: Array
    area: Array
    standing: Array
    room_of_area: Array
    complete: bool


def select_part_floor(part: TopometricMap, cells: Array, rows: Array, grid: VoxelGrid) -> PartFloor:
    """Return the floor of a part's rooms as it lies in the joined grid.

    Args:
        cells, rows: (k, 3) cells of the joined grid that its navigable cells fill, and (k,) which do.
    """
    assert part.navigable_area is not None
    inside = (part.navigable_room[rows] >= 0) & are_within(cells, 0, grid.shape)
    rows, standing = rows[inside], part.navigable.properties.get("standing")
    complete = standing is not None
    stands = np.ones(len(rows), bool) if standing is None else np.asarray(standing, bool)[rows]
    room, area = part.navigable_room[rows].astype(np.int64), part.navigable_area[rows].astype(np.int64)
    return PartFloor(cells[inside], room, area, stands, part.areas["room"], complete)


@dataclass(frozen=True, eq=False)
class CutFloor:
    """Floor cut into rooms, before it is one grid.

    Args:
        cells: (k, 3) of the joined grid.
        tables: FLOOR_PROPERTIES, (k,) of each cell.
        room_of_area: (A,).
        label: (n,) room of each occupied cell of the joined grid, -1 none.
        completeness: (R,) of the rooms.
        fresh: the floor of the rooms that were cut anew, as the extraction gave it; None: there are none.
    """

    cells: Array
    tables: dict[str, Array]
    room_of_area: Array
    label: Array
    completeness: Array
    fresh: Floor | None = None


@dataclass(frozen=True, eq=False)
class JoinedFloor:
    """The floor of a joined map, cut into rooms.

    Args:
        floor: of all storeys.
        member: (n,) room of the joined map that each room of the parts became, -1: it was cut anew.
        share: (n,) of the floor of that room that the part's room covers.
        area_member: (a,) area of the floor that each area of the parts became, -1 as above.
        carried: number of the rooms that were carried over; those that were cut anew follow.
    """

    floor: Floor
    member: Array
    share: Array
    area_member: Array
    carried: int


class _Columns:
    """Columns of the storeys with floor, by their numbers, ascending.

    Args:
        grid: joined cells.
        floors: of the parts.
    """

    def __init__(self, grid: VoxelGrid, floors: Sequence[PartFloor]) -> None:
        self.grid = grid
        cells, stands = (np.concatenate(part) for part in zip(*((f.cells, f.standing) for f in floors), strict=True))
        self.navigable = grid.replace_cells(cells, {"standing": stands})
        above = measure_floor_to_ceiling(grid, self.navigable, JOINED_PARAMETERS.standing_height)
        self.storeys, self.storey = find_storeys(self.navigable, above)
        self.numbers, self.column = np.unique(self.number(self.storey, self.navigable.cells), return_inverse=True)
        self.rows = [self.navigable.find_rows(floor.cells) for floor in floors]  # of the parts' cells

    def number(self, storey: Array, cells: Array) -> Array:
        """Return (k,) numbers of the columns of cells."""
        x, y = cells[:, 0].astype(np.int64), cells[:, 1].astype(np.int64)
        out: Array = (storey.astype(np.int64) * (self.grid.shape[0] + 1) + x) * (self.grid.shape[1] + 1) + y
        return out

    def find(self, numbers: Array) -> Array:
        """Return (k,) which column has a number, -1 none."""
        at = np.minimum(np.searchsorted(self.numbers, numbers), len(self.numbers) - 1)
        return np.where(self.numbers[at] == numbers, at, -1)

    def claim(self, floors: Sequence[PartFloor], values: Sequence[Array]) -> Array:
        """Return (parts, columns) what each part has on its lowest floor in each column, -1 nothing."""
        out = np.full((len(floors), len(self.numbers)), -1, np.int64)
        for claimed, floor, rows, value in zip(out, floors, self.rows, values, strict=True):
            order = np.argsort(-floor.cells[:, 2], kind="stable")  # the lowest is written last
            claimed[self.column[rows[order]]] = value[order]
        return out

    def find_contacts(self, owner: Array) -> tuple[Array, Array]:
        """Return (k, 2) pairs of owners of columns beside each other, and how many of these."""
        pairs = []
        for step in (1, self.grid.shape[1] + 1):
            other = self.find(self.numbers + step)
            both = np.stack([owner, np.where(other >= 0, owner[other], -1)], axis=1)
            pairs.append(np.sort(both[(both >= 0).all(axis=1) & (both[:, 0] != both[:, 1])], axis=1))
        return _count_pairs(np.concatenate(pairs))


def find_common_floor(claims: Array) -> tuple[Array, Array]:
    """Return (k, 2) rooms of two parts that have floor in common, and of how many columns.

    Args:
        claims: (parts, columns) room of each, numbered through all parts, -1 none.
    """
    pairs = [claims[[n, m]][:, (claims[n] >= 0) & (claims[m] >= 0)].T for n, m in combinations(range(len(claims)), 2)]
    return _count_pairs(np.concatenate([np.zeros((0, 2), np.int64), *pairs]))


def _count_pairs(pairs: Array) -> tuple[Array, Array]:
    """Return (k, 2) those of pairs (n, 2) of numbers that there are, ascending, and how often."""
    most = int(pairs.max(initial=0)) + 1
    keys, counts = np.unique(pairs[:, 0] * most + pairs[:, 1], return_counts=True)
    return np.column_stack([keys // most, keys % most]), counts


def unite_rooms(claims: Array, entered: Array, part_of: Array, column: float) -> tuple[Array, Array]:
    """Say which rooms of the parts are one: those that share most of the floor of the smaller one.

    It is doubtful where a part has two rooms of what another one has as one, where rooms overlap in part, and where a room that
    was only looked into reaches beyond one that somebody was in. Two rooms that somebody was in in the same map stay two.

    Args:
        claims: (parts, columns) room of each, numbered through all parts, -1 none.
        entered: (n,) bool of all rooms.
        part_of: (n,) part of each.
        column: m2 of a column.

    Returns:
        (n,) group of each room, and (groups,) bool: doubtful?
    """
    area = np.bincount(claims[claims >= 0], minlength=len(entered)) * column
    pairs, columns = find_common_floor(claims)
    common = columns * column
    share = common / np.maximum(area[pairs].min(axis=1), 1e-9)
    same = share >= SAME_SHARE
    partly = ~same & (share >= DOUBT_SHARE) & (common >= DOUBT_AREA)
    # Else a glimpsed outline of 16 m2 takes a room of 5 m2 (docs/adr/0038).
    beyond = (area[pairs] - common[:, None] >= PIECE_AREA) & ~entered[pairs] & entered[pairs[:, ::-1]]
    doubtful = {int(r) for r in pairs[partly | (same & beyond.any(axis=1))].ravel()}
    group = np.arange(len(entered))
    seen_in = [{int(part_of[r])} if entered[r] else set() for r in range(len(entered))]
    for k in np.lexsort((-common, ~entered[pairs].all(axis=1))):
        a, b = (int(group[r]) for r in pairs[k])
        if a == b or not same[k]:
            continue
        if seen_in[a] & seen_in[b]:
            doubtful |= {int(r) for r in pairs[k]} if entered[pairs[k]].all() else set()
            continue
        group[group == b] = a
        seen_in[a] |= seen_in[b]
    names, group = np.unique(group, return_inverse=True)
    pieces = np.zeros((len(names), int(part_of.max(initial=-1)) + 1), np.int64)
    np.add.at(pieces, (group, part_of), area >= PIECE_AREA)
    # A map that is sure of one large room would take both rooms of a map that glimpsed two (docs/adr/0038).
    doubt = np.asarray((pieces > 1).any(axis=1))
    doubt[group[sorted(doubtful)]] = True
    return group, doubt


def _unite_areas(claims: Array, group_of: Array) -> Array:
    """Return (n,) area of the joined map of each area of the parts: those of one group that share their floor are one."""
    size = np.bincount(claims[claims >= 0], minlength=len(group_of))
    pairs, common = find_common_floor(claims)
    one = (common >= SAME_SHARE * size[pairs].min(axis=1)) & (group_of[pairs[:, 0]] == group_of[pairs[:, 1]])
    i, j = pairs[one].T
    links = coo_array((np.ones(len(i), bool), (i, j)), (len(size), len(size)))
    out: Array = connected_components(links, directed=False)[1]
    return out


def join_rooms(
    grid: VoxelGrid, label: Array, floors: Sequence[PartFloor], tables: Sequence[Array], parts: Sequence[PartRooms]
) -> JoinedFloor:
    """Cut the floor of a joined map into rooms.

    Args:
        grid: joined cells.
        label: (n,) room of a part of each of them, numbered through all parts, -1 none.
        floors, tables, parts: of each part its floor, ROOM_DTYPE, and its rooms as they lie in the joined map.
    """
    first = np.cumsum([0, *(len(table) for table in tables)])
    floors = [
        floor._replace(room=floor.room + n, room_of_area=floor.room_of_area + n) for floor, n in zip(floors, first, strict=False)
    ]
    columns = _Columns(grid, floors)
    claims = columns.claim(floors, [floor.room for floor in floors])
    entered = np.concatenate([table["entered"] for table in tables]) >= 0.5
    part_of = np.repeat(np.arange(len(tables)), np.diff(first))
    group, doubt = unite_rooms(claims, entered, part_of, grid.edge**2)
    best = np.where(claims >= 0, 1.0 + entered[claims], 0.0).argmax(axis=0)  # the first part that was in a room says whose it is
    owner = group[claims[best, np.arange(claims.shape[1])]]
    total = np.bincount(owner, minlength=len(doubt))
    doubt |= (total * grid.edge**2 < LEAST_ROOM) | _find_unknown_borders(columns, owner, group, part_of)
    for floor in floors:
        # Floor of the thesis' preset ends before the walls (docs/adr/0038).
        doubt[group[floor.room]] |= not floor.complete
    number = np.where(doubt, -1, np.cumsum(~doubt) - 1)
    member, owner = number[group], number[owner]
    completeness = np.zeros(int((~doubt).sum()))
    carried = member >= 0
    np.maximum.at(completeness, member[carried], np.concatenate([table["completeness"] for table in tables])[carried])
    cut, area_member = _carry_over(columns, floors, member, owner)
    cut = replace(cut, label=np.append(member, -1)[label], completeness=completeness)
    if doubt.any():
        cut = _add_fresh_rooms(cut, columns, owner, parts)
    share = np.bincount(claims[claims >= 0], minlength=len(group)) / np.maximum(total, 1)[group]
    return JoinedFloor(_build_floor(cut, columns, len(completeness)), member, share, area_member, len(completeness))


def _find_unknown_borders(columns: _Columns, owner: Array, group: Array, part_of: Array) -> Array:
    """Return (groups,) bool: does a group have a border with another one, of which no part has both?"""
    pairs, contact = columns.find_contacts(owner)
    pairs = pairs[contact * columns.grid.edge >= LEAST_CONTACT]
    has = np.zeros((int(part_of.max(initial=-1)) + 1, int(group.max(initial=-1)) + 1), bool)
    has[part_of, group] = True
    out = np.zeros(has.shape[1], bool)
    out[pairs[~(has[:, pairs[:, 0]] & has[:, pairs[:, 1]]).any(axis=0)]] = True
    return out


def _carry_over(columns: _Columns, floors: Sequence[PartFloor], member: Array, owner: Array) -> tuple[CutFloor, Array]:
    """Return the floor on which the parts agree, without labels and completeness, and which area each area of the parts became,
    -1 none.

    Args:
        member: (n,) room of the joined map of each room of the parts, -1: it is cut anew.
        owner: (columns,) likewise of each column.
    """
    first = np.cumsum([0, *(len(floor.room_of_area) for floor in floors)])
    areas = [np.where(floor.area >= 0, floor.area + n, -1) for floor, n in zip(floors, first, strict=False)]
    room_of_area = member[np.concatenate([floor.room_of_area for floor in floors])]
    one = _unite_areas(columns.claim(floors, areas), room_of_area)
    kept, area_member = np.unique(np.where(room_of_area >= 0, one, -1), return_inverse=True)
    area_member -= int((kept < 0).any())
    cells, tables = [], []
    for floor, rows, area in zip(floors, columns.rows, areas, strict=True):
        room = member[floor.room]
        keep = (room >= 0) & (room == owner[columns.column[rows]])
        cells.append(floor.cells[keep])
        each = floor.standing, columns.storey[rows], room, np.append(area_member, -1)[area]
        tables.append([values[keep] for values in each])
    rooms = np.zeros(int(area_member.max(initial=-1)) + 1, np.int64)
    rooms[area_member[area_member >= 0]] = room_of_area[area_member >= 0]
    joined = dict(zip(FLOOR_PROPERTIES, map(np.concatenate, zip(*tables, strict=True)), strict=True))
    return CutFloor(np.concatenate(cells), joined, rooms, np.zeros(0), np.zeros(0)), area_member


def _add_fresh_rooms(cut: CutFloor, columns: _Columns, owner: Array, parts: Sequence[PartRooms]) -> CutFloor:
    """Add to the floor the rooms that are cut anew, where no column has an owner."""
    grid, navigable = columns.grid, columns.navigable
    redone = owner[columns.column] < 0
    near = np.zeros((grid.shape[0], grid.shape[1]), bool)
    near[tuple(navigable.cells[redone, :2].T)] = True
    # The plan network's look was a third of a joined map's time: it looks only where the parts disagree (docs/adr/0038).
    near = edt.edt(~near, parallel=1) * grid.edge <= AROUND
    rows = np.flatnonzero(near[tuple(grid.cells[:, :2].T)])
    standing = redone & navigable.properties["standing"]
    scan = Scan(grid.select_cells(rows))
    walked = navigable.select_cells(standing if standing.any() else redone)
    floor, _ = cut_rooms(scan, walked, JOINED_PARAMETERS, Stopwatch(), parts)
    if not len(floor.cells) or floor.completeness is None:
        return cut
    storey = np.abs(columns.storeys["floor"] - floor.storeys["floor"][:, None]).argmin(axis=1)[floor.storey]
    column = columns.find(columns.number(storey, floor.cells.cells))
    taken = (column >= 0) & (owner[column] >= 0)
    count, first = len(floor.completeness), len(cut.completeness)
    lost = np.bincount(floor.room, taken, count) > MOST_CARRIED * np.bincount(floor.room, minlength=count)
    keep = ~taken & ~lost[floor.room]
    label = cut.label.copy()
    new = np.append(np.where(lost, -1, np.arange(count) + first), -1)[floor.label]
    label[rows] = np.where(label[rows] >= 0, label[rows], new)
    added = floor.cells.properties["standing"], storey, floor.room + first, floor.area + len(cut.room_of_area)
    return CutFloor(
        np.concatenate([cut.cells, floor.cells.cells[keep]]),
        {name: np.concatenate([cut.tables[name], v[keep]]) for name, v in zip(FLOOR_PROPERTIES, added, strict=True)},
        np.concatenate([cut.room_of_area, floor.room_of_area + first]),
        label,
        np.concatenate([cut.completeness, floor.completeness]),
        floor,
    )


def _build_floor(cut: CutFloor, columns: _Columns, carried: int) -> Floor:
    """Return the floor as one grid; of its rooms the first ones are carried over."""
    floor, storeys, of_cell = join_floor(columns.grid, columns.storeys, cut.cells, cut.tables)
    doors, merges = (cut.fresh.door_probability, cut.fresh.merges) if cut.fresh else ({}, ())
    first = len(cut.room_of_area) - (len(cut.fresh.room_of_area) if cut.fresh else 0)
    return Floor(
        cells=floor,
        storeys=storeys,
        storey=of_cell["storey"],
        room=of_cell["room"],
        area=of_cell["area"],
        room_of_area=cut.room_of_area.astype(np.int32),
        label=cut.label.astype(np.int32),
        door_probability={(a + carried, b + carried): p for (a, b), p in doors.items()},
        merges=tuple((a + first, b + first, p) for a, b, p in merges),
        completeness=cut.completeness,
        classified_storeys=cut.fresh.classified_storeys if cut.fresh else (),
    )
