"""A map while it is edited: arrays that edits change, what stands where, and rooms that are cut, joined and measured again."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from topomerge.extraction.landmarks import BELOW_FLOOR, find_rooms_of_doors
from topomerge.extraction.landmarks import ROOM_REACH as MARK_REACH
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.storeys import measure_floor_to_ceiling
from topomerge.extraction.topology import SAME_DOOR_DISTANCE, find_edges, measure_room
from topomerge.types import AREA_DTYPE, Array, Landmarks, TopometricMap, VoxelGrid, select_rooms

ROOM_REACH = 1.0  # m between a place and the floor of its room, seen from above
LEVEL_REACH = 0.6  # m by which it may lie above or below that floor
LINE_REACH = (0.0, 0.3, 0.6, 1.0, 1.5, 2.5)  # m by which a line is prolonged at both ends until it parts a room
LEAST_PART = 0.2  # m2 of floor of either side
MIXED_SHARE = 0.1  # of the crossings of one side's floor that lie on the other: of more, the line ends within it
HALF_NEIGHBOURS = np.array([(1, 0), (0, 1), (1, 1), (1, -1)])
WEIGHED = ("completeness", "whole", "outside")  # columns of rooms that are means over the floor


class EditError(Exception):
    """An edit does not fit the map: a sentence that says why."""


class Draft:
    """A map that is edited. Rooms keep their numbers until `build_map`; new ones are counted on.

    Args:
        map: is left as it is.
    """

    def __init__(self, map: TopometricMap) -> None:
        self.map = map
        self.grid, self.navigable = map.grid, map.navigable
        self.room, self.floor_room = map.room.copy(), map.navigable_room.copy()
        assert map.navigable_area is not None
        self.floor_area = map.navigable_area.copy()
        self.rooms, self.edges, self.windows = map.rooms.copy(), map.edges.copy(), map.windows.copy()
        self.areas, self.narrows = map.areas.copy(), map.narrows.copy()
        self.landmarks: Landmarks = map.landmarks
        self.gone: set[int] = set()
        given, default = map.parameters, PRESETS["default"]
        numbers = [given.get(name, getattr(default, name)) for name in ("stem_height", "body_height", "body_width")]
        stem, body, width = (float(v) if isinstance(v, int | float) else 0.0 for v in numbers)
        self.standing_height = stem + body
        self.body_width = width if given.get("preset") == "thesis" or "least_similarity" in given else 0.0

    # What stands where.

    def find_floor(self, place: Array, reach: float = ROOM_REACH) -> Array:
        """Find the rows of cells of rooms' floors about a place (3,) m, the nearest from above first."""
        edge = self.navigable.edge
        wide, high = int(np.ceil(reach / edge)), int(np.ceil(LEVEL_REACH / edge))
        steps = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in (wide, wide, high)), indexing="ij"), -1).reshape(-1, 3)
        rows = self.navigable.find_rows(self.navigable.locate(place[None]) + steps)
        rows = rows[rows >= 0]
        rows = rows[self.floor_room[rows] >= 0]
        apart = self.navigable.compute_centroids(self.navigable.cells[rows]) - place
        far = np.hypot(apart[:, 0], apart[:, 1])
        near = far <= reach
        order = np.lexsort((rows[near], np.abs(apart[near, 2]), far[near]))
        out: Array = rows[near][order]
        return out

    def find_room(self, place: Array) -> int:
        """Find the room at a place (3,) m.

        Raises:
            EditError: there is none.
        """
        rows = self.find_floor(place)
        if not len(rows):
            raise EditError(f"there is no room at {format_place(place)}")
        return int(self.floor_room[rows[0]])

    def find_rooms(self, places: Array) -> list[int]:
        """Find the rooms at places (n, 3) m, each once, ascending.

        Raises:
            EditError: at one there is none.
        """
        return sorted({self.find_room(place) for place in places})

    def find_edge(self, place: Array) -> int:
        """Find the row of the door, opening or stairs at a place (3,) m.

        Raises:
            EditError: there is none.
        """
        return find_nearest_row(self.edges, place, "door")

    def find_window(self, place: Array) -> int:
        """Find the row of the window at a place (3,) m.

        Raises:
            EditError: there is none.
        """
        return find_nearest_row(self.windows, place, "window")

    # Rooms that are cut and joined.

    def split_room(self, room: int, line: Array) -> int:
        """Cut a room along a line (k, 2) m; the larger side keeps the number.

        Returns:
            Number of the other side.

        Raises:
            EditError: the line does not part the room.
        """
        rows = np.flatnonzero(self.floor_room == room)
        columns, of = np.unique(self.navigable.cells[rows, :2], axis=0, return_inverse=True)
        side = part_columns(columns, self.navigable, line)
        if side is None:
            raise EditError(f"the line does not part room {room}: draw it from wall to wall")
        if 2 * side.sum() > len(side):
            side = ~side
        other, tree = len(self.rooms), cKDTree((columns + 0.5) * self.navigable.edge + self.navigable.origin[:2])
        on_side = side[of.ravel()]
        self.floor_room[rows[on_side]] = other
        occupied = np.flatnonzero(self.room == room)
        above, back = np.unique(self.grid.cells[occupied, :2], axis=0, return_inverse=True)
        nearest = tree.query((above + 0.5) * self.grid.edge + self.grid.origin[:2])[1]
        beyond = side[nearest][back.ravel()]
        self.room[occupied[beyond]] = other
        self.rooms = np.append(self.rooms, self.rooms[room])
        self._cut_areas(room, other, rows, on_side)

        def is_other(places: Array) -> Array:
            out: Array = side[tree.query(places[:, :2])[1]]
            return out

        for table in (self.edges, self.windows):
            at = np.flatnonzero((table["rooms"] == room).any(axis=1))
            moved = at[is_other(table["centre"][at])] if len(at) else at
            table["rooms"][moved] = np.where(table["rooms"][moved] == room, other, table["rooms"][moved])
        marks = self.landmarks.table.copy()
        placed = np.flatnonzero((marks["room"] == room) & np.isfinite(marks["position"][:, :2]).all(axis=1))
        if len(placed):
            marks["room"][placed[is_other(marks["position"][placed])]] = other
        self.landmarks = replace(self.landmarks, table=marks)
        self._measure(room, rows[~on_side], occupied[~beyond])
        self._measure(other, rows[on_side], occupied[beyond])
        self.edges = np.append(self.edges, self._find_meeting(room, other, rows))
        return other

    def join_rooms(self, members: list[int]) -> int:
        """Make several rooms one, which keeps the smallest of their numbers.

        Raises:
            EditError: fewer than two rooms, or of several storeys.
        """
        if len(members) < 2:
            raise EditError(f"the places lie in one room, {members[0]}: there is nothing to join")
        storeys = sorted({int(s) for s in self.rooms["storey"][members]})
        if len(storeys) > 1:
            raise EditError(f"the rooms lie on storeys {', '.join(map(str, storeys))}: rooms of one storey can be joined")
        room, others = members[0], members[1:]
        old = self.rooms[members]
        weight = np.maximum(old["area"], 1e-9)
        self._add_narrows(members)
        cells = []
        for labels in (self.floor_room, self.room):
            rows = [np.flatnonzero(labels == member) for member in members]
            for moved in rows[1:]:
                labels[moved] = room
            cells.append(np.sort(np.concatenate(rows)))
        self.areas["room"][np.isin(self.areas["room"], others)] = room
        for name in ("edges", "windows"):
            table = getattr(self, name)
            table["rooms"][np.isin(table["rooms"], others)] = room
            setattr(self, name, table[table["rooms"][:, 0] != table["rooms"][:, 1]])
        marks = self.landmarks.table.copy()
        marks["room"][np.isin(marks["room"], others)] = room
        self.landmarks = replace(self.landmarks, table=marks)
        self.gone |= set(others)
        self._measure(room, *cells)
        for name in WEIGHED:
            self.rooms[name][room] = np.clip((old[name] * weight).sum() / weight.sum(), 0, 1)
        self.rooms["entered"][room] = old["entered"].max()
        self.rooms["glimpsed"][room] = old["entered"].max() < 0.5
        return room

    def _measure(self, room: int, rows: Array, occupied: Array) -> None:
        """Measure a room again; that it is one is certain now.

        Args:
            rows: of its cells in the navigable volume.
            occupied: rows of its occupied cells.
        """
        rows = self.select_floor(rows)
        above = measure_floor_to_ceiling(self.grid, self.navigable.select_cells(rows), self.standing_height)
        self.rooms["confidence"][room] = 1.0
        for name, value in measure_room(self.grid, self.navigable, rows, occupied, above, self.body_width).items():
            self.rooms[name][room] = value

    def select_floor(self, rows: Array) -> Array:
        """Select, of rows of navigable cells, those that have none right below: the floor proper; all where that is none."""
        lowest = rows[~self.navigable.contains(self.navigable.cells[rows].astype(np.int64) - (0, 0, 1))]
        return lowest if len(lowest) else rows

    def _find_meeting(self, room: int, other: int, rows: Array) -> Array:
        """Return, as EDGE_DTYPE, the doors and openings where two parts of what was one room (`rows` of its floor) meet."""
        cells = self.navigable.select_cells(rows)
        label = (self.floor_room[rows] == other).astype(np.int32)
        none = np.zeros(len(rows), np.int32)
        floor = Floor(cells, self.map.storeys, none, label, none, none[:0], none[:0], self.body_width)
        above = measure_floor_to_ceiling(self.grid, cells, self.standing_height)
        edges = find_edges(floor, label, self.rooms["storey"][[room, other]], above)
        edges["rooms"] = room, other
        return edges

    # Areas, the parts of rooms.

    def _cut_areas(self, room: int, other: int, rows: Array, on_side: Array) -> None:
        """Give the other side of a room that is cut its areas; one that lies on both sides is cut, too."""
        new: list[tuple[int, tuple[Any, ...]]] = []
        for area in np.unique(self.floor_area[rows]).tolist():
            own = rows[self.floor_area[rows] == area]
            beyond = rows[on_side & (self.floor_area[rows] == area)]
            if area < 0 or not len(beyond):
                continue
            if len(beyond) == len(own):
                self.areas["room"][area] = other
                continue
            self.floor_area[beyond] = len(self.areas) + len(new)
            new.append((area, self._measure_area(other, beyond)))
            self.areas[area] = self._measure_area(room, np.setdiff1d(own, beyond, assume_unique=True))
        first = len(self.areas)
        self.areas = np.append(self.areas, np.array([row for _, row in new], AREA_DTYPE)) if new else self.areas
        for k, (area, _) in enumerate(new):
            for narrow in self.narrows[(self.narrows["rooms"] == area).any(axis=1)]:
                if self._find_area(narrow["centre"], [area, first + k]) != area:
                    narrow["rooms"][narrow["rooms"] == area] = first + k
        owners = self.areas["room"][self.narrows["rooms"]]
        self.narrows = self.narrows[owners[:, 0] == owners[:, 1]]

    def _measure_area(self, room: int, rows: Array) -> tuple[Any, ...]:
        """Return a row of AREA_DTYPE."""
        lowest = self.select_floor(rows)
        middle = self.navigable.compute_centroids(self.navigable.cells[lowest]).mean(axis=0)
        return room, middle, len(lowest) * self.navigable.edge**2

    def _find_area(self, place: Array, among: list[int]) -> int:
        """Return the one of some areas whose floor is nearest to a place; -1 where none has any."""
        rows = np.flatnonzero(np.isin(self.floor_area, among))
        if not len(rows):
            return -1
        apart = self.navigable.compute_centroids(self.navigable.cells[rows]) - place
        return int(self.floor_area[rows[(apart**2).sum(axis=1).argmin()]])

    def _add_narrows(self, members: list[int]) -> None:
        """Keep where rooms that are joined met as narrowings between their areas."""
        inside = np.isin(self.edges["rooms"], members).all(axis=1) & np.isin(self.edges["kind"], ("door", "opening"))
        added = self.edges[inside].copy()
        kept = np.ones(len(added), bool)
        for k, edge in enumerate(added):
            ends = [self._find_area(edge["centre"], np.flatnonzero(self.areas["room"] == r).tolist()) for r in edge["rooms"]]
            kept[k] = min(ends) >= 0 and ends[0] != ends[1]
            edge["rooms"] = sorted(ends)
        self.narrows = np.append(self.narrows, added[kept])

    def find_mark_room(self, place: Array, at_door: bool) -> tuple[int, int]:
        """Find the room and the storey of a landmark at a place (3,) m, at any height; -1 where there is none.

        Args:
            at_door: does it hang beside the door that leads to its room?
        """
        storeys = self.map.storeys["floor"]
        if not len(storeys):
            return -1, -1
        storey = max(int(np.searchsorted(storeys - BELOW_FLOOR, place[2], side="right")) - 1, 0)
        rows = self.find_floor(np.array([*place[:2], storeys[storey]]), MARK_REACH)
        here = np.array([self.floor_room[rows[0]] if len(rows) else -1])
        if at_door:
            here = find_rooms_of_doors(replace(self.map, rooms=self.rooms, edges=self.edges), storey, place[None, :2], here)
        return int(here[0]), storey

    def build_map(self) -> TopometricMap:
        """Build the map as it is now; rooms that are gone leave no gap in the numbers."""
        for table in (self.edges, self.narrows):
            table["rooms"].sort(axis=1)
        windows = self.windows
        both = (windows["rooms"] >= 0).all(axis=1, keepdims=True)
        windows["rooms"] = np.where(both, np.sort(windows["rooms"], axis=1), windows["rooms"])
        edges, narrows = (t[np.lexsort((*t["centre"].T[::-1], *t["rooms"].T[::-1]))] for t in (self.edges, self.narrows))
        stays = ~np.isin(np.arange(len(self.rooms)), sorted(self.gone))
        # Rows of rooms that are gone stay until `select_rooms`; nothing points at them.
        map = replace(
            self.map,
            room=self.room,
            navigable_room=self.floor_room,
            rooms=self.rooms,
            edges=edges,
            areas=self.areas,
            navigable_area=self.floor_area,
            narrows=narrows,
            windows=windows,
            landmarks=self.landmarks,
        )
        return map if stays.all() else select_rooms(map, stays)


def find_room_place(map: TopometricMap, room: int) -> Array:
    """Find a place (3,) m on the floor of a room, as far from its walls as there is."""
    rows = np.flatnonzero(map.navigable_room == room)
    cells = map.navigable.cells[rows]
    low = cells[:, :2].min(axis=0) - 1
    plan = np.zeros(cells[:, :2].max(axis=0) - low + 2, bool)
    plan[tuple((cells[:, :2] - low).T)] = True
    inward = ndimage.distance_transform_edt(plan)[tuple((cells[:, :2] - low).T)]
    middle = cells[:, :2].mean(axis=0)
    off = ((cells[:, :2] - middle) ** 2).sum(axis=1)
    at = np.lexsort((cells[:, 2], off, -np.round(inward, 6)))[0]
    out: Array = map.navigable.compute_centroids(cells[at : at + 1])[0]
    return out


def format_place(place: Array) -> str:
    """Return a place as text, m."""
    return f"({', '.join(f'{v:.2f}' for v in place)})"


def find_nearest_row(table: Array, place: Array, what: str) -> int:
    """Find the row of a table of doors or windows whose middle is nearest to a place (3,) m.

    Raises:
        EditError: none is within reach.
    """
    apart = table["centre"] - place
    far = np.hypot(apart[:, 0], apart[:, 1])
    reached = (far <= np.maximum(SAME_DOOR_DISTANCE, table["width"] / 2)) & (np.abs(apart[:, 2]) <= 2 * LEVEL_REACH)
    if not reached.any():
        raise EditError(f"there is no {what} at {format_place(place)}")
    return int(np.where(reached, far, np.inf).argmin())


def part_columns(columns: Array, grid: VoxelGrid, line: Array) -> Array | None:
    """Part the columns of a room by a line; what it does not touch goes with the nearer side.

    Args:
        columns: (n, 2) int, unique.
        grid: whose columns they are.
        line: (k, 2) m; it is prolonged as far as need be.

    Returns:
        (n,) bool, is a column right of the line? None where the line does not part them.
    """
    low = columns.min(axis=0)
    number = np.full(columns.max(axis=0) - low + 1, -1)
    number[tuple((columns - low).T)] = np.arange(len(columns))
    padded = np.pad(number, 1, constant_values=-1)
    here = columns - low + 1
    other = np.concatenate([padded[tuple((here + step).T)] for step in HALF_NEIGHBOURS])
    one = np.tile(np.arange(len(columns)), len(HALF_NEIGHBOURS))
    one, other = one[other >= 0], other[other >= 0]
    places, drawn = columns + 0.5, (np.asarray(line, float) - grid.origin[:2]) / grid.edge
    if not np.ptp(drawn, axis=0).any():
        return None
    for reach in LINE_REACH:
        crossed, is_right = find_crossings(places[one], places[other], prolong_line(drawn, reach / grid.edge))
        if not crossed.any():
            continue
        ends = one[~crossed], other[~crossed]
        graph = coo_array((np.ones(len(ends[0]), bool), ends), (len(columns), len(columns)))
        count, part = connected_components(graph, directed=False)
        right = np.bincount(part[np.where(is_right, one, other)[crossed]], minlength=count)
        left = np.bincount(part[np.where(is_right, other, one)[crossed]], minlength=count)
        if (np.minimum(right, left) > MIXED_SHARE * np.maximum(right, left)).any():
            continue
        side = _keep_connected(np.where(right > left, 1, np.where(left > right, 0, -1)), part, one[crossed], other[crossed])[part]
        if (side < 0).any():
            side = side[_find_nearest(columns - low, side >= 0, number.shape, number)]
        least = LEAST_PART / grid.edge**2
        if min(int((side == 0).sum()), int((side == 1).sum())) >= least:
            out: Array = side == 1
            return out
    return None


def _keep_connected(side: Array, part: Array, one: Array, other: Array) -> Array:
    """Return the side of each part of a room, -1 unknown, so that each side hangs together.

    A line that is too long cuts off corners. Of the parts on a side the largest stays; others go with the largest of the other
    side where they meet it across the line.

    Args:
        side: (P,).
        part: (n,) of each column.
        one, other: columns that meet across the line.
    """
    size = np.bincount(part, minlength=len(side))
    largest = [int(np.where(side == s, size, -1).argmax()) for s in (0, 1)]
    out = side.copy()
    for a, b in {*zip(part[one].tolist(), part[other].tolist(), strict=True)}:
        for small, main in ((a, b), (b, a)):
            if main in largest and small not in largest and side[small] >= 0:
                out[small] = side[main]
    return out


def _find_nearest(columns: Array, known: Array, shape: tuple[int, ...], number: Array) -> Array:
    """Return (n,) which column is the nearest known one of each."""
    unknown = np.ones(shape, bool)
    unknown[tuple(columns[known].T)] = False
    _, nearest = ndimage.distance_transform_edt(unknown, return_indices=True)
    out: Array = number[tuple(nearest[:, *columns.T])]
    return out


def prolong_line(line: Array, reach: float) -> Array:
    """Return a line (k, 2) that is longer by `reach` at both ends."""
    line = line[np.append(True, np.abs(np.diff(line, axis=0)).sum(axis=1) > 0)]
    first, last = line[0] - line[1], line[-1] - line[-2]
    ends = line[0] + reach * first / np.hypot(*first), line[-1] + reach * last / np.hypot(*last)
    return np.vstack([ends[0], line[1:-1], ends[1]])


def find_crossings(one: Array, other: Array, line: Array) -> tuple[Array, Array]:
    """Find which ways cross a line.

    Args:
        one, other: (n, 2) where each way begins and ends.
        line: (k, 2).

    Returns:
        (n,) bool, does the way cross it (an odd number of times)? (n,) bool, is where it begins to the right of the line?
    """
    crossed, is_right = np.zeros(len(one), bool), np.zeros(len(one), bool)
    for a, b in pairwise(line):
        begins, ends = (_cross(b - a, places - a) >= 0 for places in (one, other))
        way = other - one
        met = (begins != ends) & ((_cross(way, a - one) >= 0) != (_cross(way, b - one) >= 0))
        is_right = np.where(met, ~begins, is_right)
        crossed ^= met
    return crossed, is_right


def _cross(a: Array, b: Array) -> Array:
    a, b = np.broadcast_arrays(a, b)
    out: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out
