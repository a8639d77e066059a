"""Transfer knowledge of the maps that were joined to the joined map: doors, windows, landmarks, and who was in the rooms (method
4)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from topomerge.extraction.attributes import LEVEL_KINDS, find_rooms_at, select_distinct_doors
from topomerge.extraction.elevations.windows import iter_same_windows, select_windows
from topomerge.extraction.landmarks import assign_landmarks
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.landmarks.fuse import fuse_landmarks
from topomerge.types import EDGE_DTYPE, ROOM_ODDS, WINDOW_DTYPE, Array, Landmarks, Placement, TopometricMap, transform_landmarks
from topomerge.types.grid import wrap_to_turn

DOOR_SIDE = 1.0  # m around a door in which floor says which rooms it joins
LEAST_FLOOR = 5  # cells of it, from which a map saw that side of a door
ONE_DOOR = 1.2  # m: doors of two maps that are this close are one
SEEN_BY_A_PART = ("centre", "lower", "upper", "direction", "width", "height", "kind", "open", "half")  # of a door
LANDMARK_PARAMETER = "landmarks"  # of a joined map: what became of those of its maps (`LandmarkSummary`)
NEARLY_WHOLE = 0.8  # of a joined room's floor: a part that saw as much knows what it is
LEAST_COVER = 0.3  # of a joined room's floor, from which on a part knows who was in it


class PlacedPart(NamedTuple):
    """A part as it is kept once it is joined: its rooms, ROOM_DTYPE of them, and its doors and openings as they lie in the
    joined map, EDGE_DTYPE with the part's rooms; likewise its narrowings, with the part's areas."""

    rooms: PartRooms
    table: Array
    doors: Array
    narrows: Array


def transform_part(part: TopometricMap, placement: Placement) -> PlacedPart:
    """Return a part as it lies in the joined map."""
    doors = part.edges[np.isin(part.edges["kind"], LEVEL_KINDS)]
    area = (placement.pose.scale * part.navigable.edge) ** 2
    rooms = PartRooms(*transform_floor(part, placement), part.rooms["entered"], area)
    return PlacedPart(rooms, part.rooms, _transform_edges(doors, placement), _transform_edges(part.narrows, placement))


def _transform_edges(edges: Array, placement: Placement) -> Array:
    """Return edges, EDGE_DTYPE, as they lie in the joined map."""
    moved = edges.copy()
    for name in ("centre", "lower", "upper") if len(edges) else ():
        moved[name] = placement.transform_points(moved[name])
    moved["direction"] = (moved["direction"] + placement.pose.yaw) % np.pi
    for name in ("width", "height"):
        moved[name] *= placement.pose.scale
    return moved


def add_part_narrows(joined: TopometricMap, narrows: Array) -> TopometricMap:
    """Return the joined map with those narrowings of its parts that it lacks.

    Args:
        narrows: EDGE_DTYPE as they lie in it, with its areas, -1 where there is none.
    """
    owner, table = np.append(joined.areas["room"], -1), joined.narrows
    narrows = narrows.copy()
    narrows["rooms"] = np.sort(narrows["rooms"], axis=1)
    low, high = narrows["rooms"].T
    within = (low >= 0) & (low != high) & (owner[low] == owner[high])
    for narrow in narrows[within]:
        if not _is_among_edges(table, narrow):
            table = np.append(table, narrow)
    return replace(joined, narrows=table[np.lexsort((*table["centre"].T[::-1], *table["rooms"].T[::-1]))])


def add_carried_odds(joined: TopometricMap, tables: Sequence[Array], member: Array, share: Array) -> tuple[TopometricMap, Array]:
    """Return the joined map with the odds of those rooms that a part saw nearly whole, and (R,) bool, which these are.

    Args:
        tables: ROOM_DTYPE of the parts.
        member: (n,) room of the joined map of each of their rooms, -1 none.
        share: (n,) of its floor that they cover.
    """
    known = np.flatnonzero((member >= 0) & (share >= NEARLY_WHOLE))
    known = known[np.argsort(share[known], kind="stable")]  # the one that covers most is written last
    rooms, is_known = joined.rooms.copy(), np.zeros(len(joined.rooms), bool)
    for name in (*ROOM_ODDS, "glimpsed"):
        rooms[name][member[known]] = np.concatenate(tables)[name][known]
    is_known[member[known]] = True
    return replace(joined, rooms=rooms), is_known


def add_part_doors(joined: TopometricMap, parts: Iterable[PlacedPart]) -> TopometricMap:
    """Return the joined map with those doors and openings of its parts that it lacks, without those that its parts deny, and each
    as the part saw it that is surest of it.

    Args:
        parts: as they lie in it.
    """
    placed = [_PlacedFloor.from_part(part, joined) for part in parts]
    level = np.isin(joined.edges["kind"], LEVEL_KINDS)
    edges = joined.edges[[not level[k] or _is_confirmed(edge, placed) for k, edge in enumerate(joined.edges)]]
    edges = _adopt_doors(edges, np.concatenate([np.zeros(0, EDGE_DTYPE), *(part.doors for part in placed)]))
    for part in placed:
        new = [door for door in part.doors if not _is_among_edges(edges, door)]
        edges = np.concatenate([edges, np.array(new, EDGE_DTYPE)])
    return select_distinct_doors(replace(joined, edges=edges[np.lexsort((*edges["centre"].T[::-1], *edges["rooms"].T[::-1]))]))


def transform_floor(part: TopometricMap, placement: Placement) -> tuple[Array, Array]:
    """Return (k, 3) m in the joined map, and (k,) their rooms in the part: the floor of its rooms."""
    inside = part.navigable_room >= 0
    return placement.transform_points(part.navigable.compute_centroids(part.navigable.cells[inside])), part.navigable_room[inside]


@dataclass(frozen=True, eq=False)
class _PlacedFloor:
    """The floor and doors of a part, in the joined map.

    Args:
        floor: tree of the floor of its rooms, (k, 3) m.
        room: (k,) room of the joined map there, -1 none.
        centres: (E, 3) m of its doors and openings.
        doors: EDGE_DTYPE, those of them that lie between two rooms of the joined map.
    """

    floor: cKDTree
    room: Array
    centres: Array
    doors: Array

    @classmethod
    def from_part(cls, part: PlacedPart, joined: TopometricMap) -> _PlacedFloor:
        part_room, doors = part.rooms.room, part.doors.copy()
        room, tree = find_rooms_at(joined, part.rooms.places), cKDTree(part.rooms.places)
        pairs = np.full((len(doors), 2), -1, np.int64)
        for k, near in enumerate(tree.query_ball_point(doors["centre"], DOOR_SIDE)):
            joined_room, own = room[near], part_room[near]
            for side, number in enumerate(doors["rooms"][k]):
                votes = joined_room[(own == number) & (joined_room >= 0)]
                pairs[k, side] = np.bincount(votes).argmax() if len(votes) else -1
        between = (pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])
        doors["rooms"] = np.sort(pairs, axis=1)
        return cls(tree, room, doors["centre"], doors[between])

    def has_both_sides(self, edge: Array) -> bool:
        """Return whether it has floor on both sides of an edge of the joined map."""
        near = self.room[self.floor.query_ball_point(edge["centre"], DOOR_SIDE)]
        return all(int((near == room).sum()) >= LEAST_FLOOR for room in edge["rooms"])


def _is_confirmed(edge: Array, parts: Sequence[_PlacedFloor]) -> bool:
    """Return whether a part has a door there, or none saw both sides."""
    at = np.concatenate([part.centres for part in parts])
    if (np.linalg.norm(at - edge["centre"], axis=1) < ONE_DOOR).any():
        return True
    return not any(part.has_both_sides(edge) for part in parts)


def _adopt_doors(edges: Array, doors: Array) -> Array:
    """Return the doors of the joined map as the surest of the parts' doors that are the same has them; its sureness is the higher
    one."""
    edges = edges.copy()
    for edge in edges:
        if edge["kind"] not in LEVEL_KINDS:
            continue
        near = (doors["rooms"] == np.sort(edge["rooms"])).all(axis=1)
        near &= np.linalg.norm(doors["centre"] - edge["centre"], axis=1) <= ONE_DOOR
        if near.any():
            surest = doors[near][doors["confidence"][near].argmax()]
            for name in SEEN_BY_A_PART:
                edge[name] = surest[name]
            edge["confidence"] = max(edge["confidence"], surest["confidence"])
    return edges


def _is_among_edges(edges: Array, door: Array) -> bool:
    """Return whether a door is among edges, between the same rooms and near enough."""
    same = (np.sort(edges["rooms"], axis=1) == door["rooms"]).all(axis=1)
    apart = np.linalg.norm(edges["centre"][same] - door["centre"], axis=1)
    return bool((apart <= max(ONE_DOOR, float(door["width"]) / 2)).any())


def add_part_odds(joined: TopometricMap, parts: Sequence[PartRooms]) -> TopometricMap:
    """Return the joined map with the probability that each room was entered, and with what was only glimpsed, as its parts say:
    that of the part in which somebody was most likely there; as the joined map has it where no part has enough of its floor."""
    if not len(joined.rooms):
        return joined
    count = len(joined.rooms)
    inside = joined.navigable_room >= 0
    area = np.bincount(joined.navigable_room[inside], minlength=count) * joined.navigable.edge**2
    entered = np.full(count, -1.0)
    for part in parts:
        room = find_rooms_at(joined, part.places)
        present = room >= 0
        places = np.bincount(room[present], minlength=count)
        mean = np.bincount(room[present], part.entered[part.room[present]], count) / np.maximum(places, 1)
        # By the surest part 94 % of 884 joined rooms are told right, by the joined outline 87 % (docs/adr/0020).
        entered = np.where(places * part.area >= LEAST_COVER * area, np.maximum(entered, mean), entered)
    rooms = joined.rooms.copy()
    rooms["entered"] = np.where(entered >= 0, entered, rooms["entered"])
    rooms["glimpsed"] = rooms["entered"] < 0.5
    return replace(joined, rooms=rooms)


def transform_windows(part: TopometricMap, placement: Placement) -> Array:
    """Return (W,) WINDOW_DTYPE of a part in the joined map, without rooms."""
    windows = part.windows.copy()
    if len(windows):
        windows["centre"] = placement.transform_points(windows["centre"])
        windows["direction"] = wrap_to_turn(windows["direction"] + placement.pose.yaw, np.pi)
        for name in ("width", "sill", "head"):
            windows[name] *= placement.pose.scale
    windows["rooms"] = -1
    return windows


def add_joined_windows(joined: TopometricMap, parts: Sequence[Array]) -> TopometricMap:
    """Return the joined map with the windows of its parts, each once: as the part saw it that is the surest of it.

    Args:
        parts: WINDOW_DTYPE of `transform_windows`.
    """
    windows = np.concatenate([np.zeros(0, WINDOW_DTYPE), *parts])
    first = [int(group[0]) for group in iter_same_windows(windows)]
    return replace(joined, windows=select_windows(joined, windows[first]))


def vote_rooms(part_room: Array, joined_room: Array, count: int) -> Array:
    """Return (count,) room of the joined map in which most floor of each room of a part lies, -1 none.

    Args:
        part_room: (k,) room of each place of a part's floor.
        joined_room: (k,) room of the joined map there, -1 none.
    """
    inside, most = joined_room >= 0, int(joined_room.max(initial=0)) + 1
    pairs, votes = np.unique(part_room[inside].astype(np.int64) * most + joined_room[inside], return_counts=True)
    best = pairs[np.lexsort((-pairs, votes))]  # the most votes, then the first room, comes last
    out = np.full(count, -1, np.int64)
    out[best // most] = best % most
    return out


class PlacedLandmarks(NamedTuple):
    """Landmarks of a part as they lie in the joined map, with the part's rooms; what of the part says where those are."""

    landmarks: Landmarks
    rooms: PartRooms
    floors: Array  # (S,) m in the joined map, of the part's storeys
    total: int  # of its rooms


def transform_part_landmarks(part: TopometricMap, placement: Placement, rooms: PartRooms) -> PlacedLandmarks:
    """Return the landmarks of a part as they lie in the joined map.

    Args:
        rooms: of the part, as they lie there.
    """
    pose = placement.pose
    moved = transform_landmarks(part.landmarks, placement.transform_points, pose.yaw, pose.scale)
    return PlacedLandmarks(moved, rooms, pose.scale * part.storeys["floor"] + pose.translation[2], len(part.rooms))


def add_joined_landmarks(joined: TopometricMap, parts: Mapping[int, PlacedLandmarks], names: Sequence[str]) -> TopometricMap:
    """Return the joined map with the landmarks of its parts, fused; what contradicts is told in a warning.

    Args:
        parts: by the number of the map.
        names: of all maps.
    """
    placed = [_assign_joined_rooms(joined, parts[n]) if n in parts else Landmarks() for n in range(len(names))]
    landmarks, summary = fuse_landmarks(placed, joined)
    text = summary.describe_contradictions(names)
    parameters = {**joined.parameters, LANDMARK_PARAMETER: asdict(summary)}
    return replace(joined, landmarks=landmarks, parameters=parameters, warnings=(*joined.warnings, *([text] if text else [])))


def _assign_joined_rooms(joined: TopometricMap, part: PlacedLandmarks) -> Landmarks:
    """Return the landmarks of a part with rooms and storeys of the joined map: by their position; without one by the room that
    they had."""
    table = part.landmarks.table.copy()
    known = np.isfinite(table["position"]).all(axis=1)
    room = np.append(vote_rooms(part.rooms.room, find_rooms_at(joined, part.rooms.places), part.total), -1)[table["room"]]
    floors = joined.storeys["floor"]
    level = (
        np.abs(floors[None] - part.floors[:, None]).argmin(axis=1) if len(floors) and len(part.floors) else np.zeros(0, np.int64)
    )
    table["storey"] = np.where(known | (table["storey"] < 0) | (len(level) == 0), -1, np.append(level, -1)[table["storey"]])
    table["room"] = np.where(known, -1, room)
    assigned = assign_landmarks(joined, replace(part.landmarks, table=table))
    lost = known & (assigned.table["room"] < 0) & (room >= 0)
    if not lost.any():
        return assigned
    restored = assigned.table.copy()
    restored["room"][lost] = room[lost]
    return assign_landmarks(joined, replace(assigned, table=restored))
