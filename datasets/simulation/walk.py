"""Where a surveyor walks: over the free floor of a building, through doors and up stairs, into every room that is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.solids import build_rotation
from topomerge.datasets.simulation.floor_truth import FloorRasters, fill, rasterize_floors

from topomerge.errors import InputError
from topomerge.types import Array

WALK_CELL = 0.1  # m, of the floor that is walked on
HALF_PERSON = 0.2  # m, half a person's width
BLOCKED = 40.0  # what a step through furniture costs: only taken where there is no other way
FOREIGN = 8.0  # what a step in a room that was not asked for costs
SIGHT = (3.5, 5.0)  # m; every part of a room is that close to a stop: thorough surveyors and hasty ones
LONG = 8.0  # m; a room whose parts lie farther from a stop than that may be left half-way
WALKED = (0.2, 0.8)  # share of the stops of such a room that are made
STEP_UP = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])


@dataclass(frozen=True, eq=False)
class Walk:
    """A way through a building.

    Args:
        points: (n, 3) float64, on the floor, 0.1 m apart or less.
        room: (n,) room of each point, -1: in a doorway or on stairs.
        stops: indices of points where the surveyor stops and looks around.
        free: (n,) bool, not within furniture.
    """

    points: Array
    room: Array
    stops: Array
    free: Array

    @cached_property
    def along(self) -> Array:
        """(n,) m walked up to each point."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])


def plan_walk(building: Building, rooms: Sequence[int], rng: np.random.Generator, unfinished: float = 0.35) -> Walk:
    """Return a walk into all the given rooms, from one of them.

    The way follows one shortest-path tree, so the surveyor returns through the corridors as people do. Shut doors are opened in
    passing; rooms that were not asked for are crossed only where there is no other way.

    Args:
        unfinished: share of the long rooms (corridors, halls) in which the surveyor turns half-way, as real sessions do: every
            room is entered, but what lies beyond is passed only on the way to another room.

    Raises:
        InputError: no rooms, a room that does not exist, or one that cannot be reached.
    """
    requested = sorted({int(r) for r in rooms})
    if not requested or requested[0] < 0 or requested[-1] >= len(building.rooms):
        raise InputError(f"rooms to visit must be among 0..{len(building.rooms) - 1}, not {list(rooms)[:5]}")
    floors = rasterize_floors(building, WALK_CELL)
    cost, clear = _compute_costs(building, floors, requested)
    graph, places = _build_graph(building, floors, cost)
    sight = float(rng.uniform(*SIGHT))
    stops = []
    for r in requested:
        chosen = _choose_stops(floors, clear, building.rooms[r].storey, r, sight)
        stops += _sample_unfinished_stops(chosen, floors, rng) if rng.random() < unfinished else chosen
    if not stops:
        raise InputError(f"{building.name}: none of the rooms has a free floor to stand on")
    start = stops[int(rng.integers(len(stops)))]
    reach, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    lost = [s for s in stops if not np.isfinite(reach[s])]
    if lost:
        names = sorted({int(floors.room.ravel()[s]) for s in lost})
        raise InputError(f"{building.name}: rooms {names} cannot be reached from room {int(floors.room.ravel()[start])}")
    way, halts = _build_tour(start, stops, before, reach)
    room = np.append(floors.room.ravel(), np.full(len(places) - floors.room.size, -1))[way]
    price = np.append(cost.ravel(), np.ones(len(places) - cost.size))[way]
    step = np.linalg.norm(np.diff(places[way], axis=0), axis=1)
    first = np.concatenate([[0], np.cumsum(np.maximum(np.ceil(step / (1.5 * WALK_CELL)), 1))])  # stairs have few nodes
    at = np.arange(first[-1] + 1)
    points = np.stack([np.interp(at, first, places[way][:, k]) for k in range(3)], axis=1)
    nearest = np.clip(np.searchsorted(first, at), 0, len(way) - 1)
    stand = first[halts].astype(np.int64)
    return Walk(_smooth(points), room[nearest].astype(np.int32), stand, price[nearest] < BLOCKED)


def _compute_costs(building: Building, floors: FloorRasters, requested: list[int]) -> tuple[Array, Array]:
    """Return the price of each cell (inf: wall) and its distance to what stands around, m."""
    passable = floors.room >= 0
    _open_doorways(building, floors, passable)
    things = building.things[building.things["kind"] != "leaf"]
    bottom = things["centre"][:, 2] - things["size"][:, 2] / 2
    cost = np.ones(floors.room.shape)
    clear = np.zeros(floors.room.shape)
    foreign = passable & (floors.room >= 0) & ~np.isin(floors.room, requested)
    for k, floor in enumerate(building.storeys["floor"]):
        stand = things[(bottom >= floor - 0.1) & (bottom < floor + 1.7)]
        filled = _rasterize_things(stand, floors)
        upper = [r.polygon for r in building.rooms if r.storey != k and r.floor < floor < r.ceiling - 1.5]
        blocked = [s["footprint"] for s in building.stairs if k in s["storeys"] and s["kind"] != "lift"]
        passable[k] &= ~_rasterize_polygons([*blocked, *upper], floors)
        walls = ndimage.distance_transform_edt(passable[k]) * WALK_CELL
        clear[k] = np.minimum(walls, ndimage.distance_transform_edt(~filled) * WALK_CELL)
        cost[k] = 1 + 2 * np.exp(-np.minimum(clear[k], 5) / 0.3)
        cost[k][clear[k] < HALF_PERSON] += BLOCKED
        cost[k][walls < 1.5 * WALK_CELL] = np.inf
    cost[foreign] *= FOREIGN
    return cost, clear


def _open_doorways(building: Building, floors: FloorRasters, passable: Array) -> None:
    for door in building.doors[(building.doors["rooms"] >= 0).all(axis=1)]:
        half = np.array([door["thickness"] / 2 + 0.15, door["width"] / 2 - 0.02])
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        k = building.rooms[door["rooms"][0]].storey
        passable[k] |= _rasterize_polygons([corners @ build_rotation(door["direction"]) + door["centre"][:2]], floors)


def _rasterize_things(things: Array, floors: FloorRasters) -> Array:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return _rasterize_polygons([corners * t["size"][:2] @ build_rotation(t["yaw"]) + t["centre"][:2] for t in things], floors)


def _rasterize_polygons(polygons: Sequence[Array], floors: FloorRasters) -> Array:
    out = np.zeros(floors.room.shape[1:], bool)
    for polygon in polygons:
        fill(out, (polygon - floors.origin) / floors.cell, 1)
    return out


def _build_graph(building: Building, floors: FloorRasters, cost: Array) -> tuple[coo_array, Array]:
    """Return the steps between cells, and along stairs, and where each node lies."""
    nodes = np.arange(cost.size).reshape(cost.shape)
    rows, columns, prices = [], [], []
    height, width = cost.shape[1:]
    for dy, dx in STEP_UP:
        a = (slice(None), slice(0, height - dy), slice(max(-dx, 0), width - max(dx, 0)))
        b = (slice(None), slice(dy, height), slice(max(dx, 0), width + min(dx, 0)))
        price = (cost[a] + cost[b]) * np.hypot(dy, dx) / 2
        fine = np.isfinite(price)
        rows.append(nodes[a][fine])
        columns.append(nodes[b][fine])
        prices.append(price[fine])
    k, i, j = np.unravel_index(np.arange(cost.size), cost.shape)
    xy = floors.origin + (np.stack([j, i], axis=1) + 0.5) * floors.cell
    places = [np.column_stack([xy, building.storeys["floor"][k]])]
    count = cost.size
    for stair in building.stairs[building.stairs["kind"] != "lift"]:
        path = stair["path"]
        ends = [_find_nearest_node(path[e], int(stair["storeys"][s]), floors, cost) for e, s in ((0, 0), (-1, 1))]
        chain = np.array([ends[0], *range(count, count + len(path)), ends[1]])
        rows.append(chain[:-1])
        columns.append(chain[1:])
        prices.append(np.full(len(chain) - 1, 5.0))
        places.append(path)
        count += len(path)
    graph = coo_array((np.concatenate(prices), (np.concatenate(rows), np.concatenate(columns))), shape=(count, count))
    return graph.tocsr(), np.concatenate(places)


def _find_nearest_node(point: Array, storey: int, floors: FloorRasters, cost: Array) -> int:
    """Return the node of the passable cell nearest to a point."""
    i, j = np.nonzero(np.isfinite(cost[storey]))
    at = floors.compute_cells(point[None])[0]
    best = int(np.argmin((i - at[0]) ** 2 + (j - at[1]) ** 2))
    return int(storey * cost[0].size + i[best] * cost.shape[2] + j[best])


def _choose_stops(floors: FloorRasters, clear: Array, storey: int, room: int, sight: float) -> list[int]:
    """Choose the nodes from which a room is seen: its freest spot, then whatever lies far from the stops so far."""
    inside = floors.room[storey] == room
    i, j = np.nonzero(inside & (clear[storey] >= min(0.35, clear[storey][inside].max(initial=0.0))))
    if not len(i) or clear[storey][i, j].max() <= 0:
        return []
    out = [int(np.argmax(clear[storey][i, j]))]
    far = np.hypot(i - i[out[0]], j - j[out[0]]) * floors.cell
    while far.max() > sight:
        out.append(int(np.argmax(far)))
        far = np.minimum(far, np.hypot(i - i[out[-1]], j - j[out[-1]]) * floors.cell)
    return [int(storey * clear[0].size + i[k] * clear.shape[2] + j[k]) for k in out]


def _sample_unfinished_stops(stops: list[int], floors: FloorRasters, rng: np.random.Generator) -> list[int]:
    """Return, of the stops in a long room, those next to one of them."""
    i, j = np.unravel_index(stops, floors.room.shape)[1:] if stops else (np.empty(0), np.empty(0))
    if not len(i) or np.hypot(i - i[0], j - j[0]).max() * floors.cell < LONG:
        return stops
    one = int(rng.integers(len(stops)))
    order = np.argsort(np.hypot(i - i[one], j - j[one]), kind="stable")
    number = max(round(float(rng.uniform(*WALKED)) * len(stops)), 1)
    return [stops[k] for k in sorted(order[:number].tolist())]


def _build_tour(start: int, stops: list[int], before: Array, reach: Array) -> tuple[Array, list[int]]:
    """Return the nodes of a walk over all stops along the tree of shortest ways, and where on it the stops are."""
    trunks = {}
    for stop in stops:
        trunk = [stop]
        while trunk[-1] != start:
            trunk.append(int(before[trunk[-1]]))
        trunks[stop] = trunk[::-1]
    order = _order_stops(stops, trunks, reach)
    way, halts, at = [start], [], [start]
    for stop in order:
        trunk = trunks[stop]
        same = next((n for n, (a, b) in enumerate(zip(at, trunk, strict=False)) if a != b), min(len(at), len(trunk)))
        way += at[same - 1 : len(at) - 1][::-1] + trunk[same:]
        at = trunk
        halts.append(len(way) - 1)
    return np.array(way), halts


def _order_stops(stops: list[int], trunks: dict[int, list[int]], reach: Array) -> list[int]:
    """Return the stops in the order of a depth-first walk over the tree, near branches first."""
    edges = np.array([(a, b) for t in trunks.values() for a, b in pairwise(t)]).reshape(-1, 2)
    nodes, inverse = np.unique(np.append(edges.ravel(), stops), return_inverse=True)
    del inverse
    children: dict[int, list[int]] = {int(n): [] for n in nodes}
    for a, b in np.unique(edges, axis=0):
        children[int(a)].append(int(b))
    deepest: dict[int, float] = {}
    for node in sorted(children, key=lambda n: -reach[n]):
        deepest[node] = max([float(reach[node]), *(deepest.get(c, 0.0) for c in children[node])])
    requested, out = set(stops), []
    stack = [next(iter(trunks.values()))[0]]
    while stack:
        node = stack.pop()
        if node in requested:
            out.append(node)
        stack += sorted(children[node], key=lambda c: -deepest[c])
    return out


def _smooth(points: Array) -> Array:
    """Take the corners off a walk on a grid; its ends stay."""
    if len(points) < 8:
        return points
    return ndimage.uniform_filter1d(points, 7, axis=0, mode="nearest")


def sample_part(
    building: Building, count: int, rng: np.random.Generator, storey: int | None = None, start: int | None = None
) -> Array:
    """Sample (n,) int64 rooms that hang together, up to `count` of them, grown from a room through doors and stairs.

    Args:
        storey: stay on this storey.
        start: room to grow from; none: drawn.
    """
    fits = np.array([r.kind != "lift" and (storey is None or r.storey == storey) for r in building.rooms])
    edges = building.list_edges()
    edges = edges[fits[edges].all(axis=1)]
    neighbours: dict[int, set[int]] = {int(i): set() for i in np.flatnonzero(fits)}
    for a, b in edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    if not neighbours:
        raise InputError(f"{building.name}: no rooms on storey {storey}")
    first = int(rng.choice(sorted(neighbours))) if start is None else int(start)
    out, edge = [first], sorted(neighbours[first])
    while edge and len(out) < count:
        out.append(edge.pop(int(rng.integers(len(edge)))))
        edge = sorted({n for r in out for n in neighbours[r]} - set(out))
    return np.array(sorted(out))
