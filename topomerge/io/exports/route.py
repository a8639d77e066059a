"""Routes of a robot through a storey: from the middle of each room to its doors and stairs, away from walls.

In each room, shortest ways (Dijkstra 1959) from its middle to all its doors make a tree. Pixels are dearer the nearer a wall is,
so that the ways keep to the middle and join. Between forks they are made straight where nothing is in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from topomerge.io.exports.occupancy import Occupancy
from topomerge.structure.floors import is_flight
from topomerge.types import Array, TopometricMap

DOOR_REACH = 0.6  # m around the middle of a door through which its ways may lead
FLIGHT_REACH = 2.0  # m: the end of a flight of stairs is looked for this far
AWAY = 0.5  # m from walls at which ways are not dearer for being near
Point = tuple[float, float]
Pixel = tuple[int, int]


@dataclass(frozen=True)
class Node:
    """A place to drive to."""

    id: int
    point: Point  # m
    metadata: dict[str, Any]


@dataclass(frozen=True)
class Edge:
    """A straight way from node to node."""

    id: int
    start: int
    end: int
    length: float  # m


@dataclass
class Route:
    """The graph of a storey; every way is there in both directions."""

    first: int = 0
    nodes: list[Node] = field(default_factory=list)
    ways: list[Pixel] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)

    def add(self, point: Any, **metadata: Any) -> int:
        """A new node; its number."""
        x, y = (float(v) for v in point)
        self.nodes.append(Node(self.first + len(self.nodes), (x, y), metadata))
        return self.nodes[-1].id


def storey_route(map: TopometricMap, grid: Occupancy, storey: int, first: int = 0) -> tuple[Route, int]:
    """The routes of one storey, its numbers counted from `first`; and the first number that is left."""
    route = Route(first)
    clear = ndimage.distance_transform_edt(np.pad(grid.free, 1))[1:-1, 1:-1] * grid.size
    doors: dict[int, int] = {}
    reach = int(np.ceil(FLIGHT_REACH / grid.size))
    for r, box in enumerate(ndimage.find_objects(grid.room + 1)):
        if box is not None and map.rooms["storey"][r] == storey:
            wide = tuple(slice(max(side.start - reach, 0), side.stop + reach) for side in box)
            _add_room(route, map, grid.window(wide), clear[wide], r, doors)
    number = first + len(route.nodes)
    place = {node.id: node.point for node in route.nodes}
    for a, b in route.ways:
        length = float(np.hypot(*np.subtract(place[a], place[b])))
        route.edges += [Edge(number, a, b, length), Edge(number + 1, b, a, length)]
        number += 2
    return route, number


def _add_room(route: Route, map: TopometricMap, grid: Occupancy, clear: Array, r: int, doors: dict[int, int]) -> None:
    """The middle of a room, its doors and the ways between them."""
    edges = [(int(i), map.edges[i]) for i in np.flatnonzero((map.edges["rooms"] == r).any(axis=1))]
    inside = grid.free & (grid.room == r)
    if not inside.any():
        return
    mask = inside.copy()
    for _, edge in edges:
        if not is_flight(edge):
            box, disc = _disc(grid, edge["centre"][:2], DOOR_REACH)
            mask[box] |= grid.free[box] & disc
    root = _middle(inside, clear)
    parent = _ways(mask, clear, grid.size, root)
    reached = np.zeros_like(mask)
    reached[tuple(np.array([root, *parent]).T)] = True
    middle = route.add(grid.centre(np.array(root)), kind="room", room=r, storey=int(map.rooms["storey"][r]))
    leaves: dict[Pixel, int] = {}
    for i, edge in edges:
        point, out = _end(map, edge, r)
        leaf = _leaf(reached, grid, point, out)
        if leaf is None:
            continue
        if i not in doors or is_flight(edge):
            other = int(edge["rooms"][edge["rooms"] != r][0])
            values = {"kind": str(edge["kind"]), "edge": i, "width": round(float(edge["width"]), 3), "open": bool(edge["open"])}
            if is_flight(edge):
                values |= {"to_room": other, "to_storey": int(map.rooms["storey"][other])}
            doors[i] = route.add(grid.centre(np.array(leaf)) if is_flight(edge) else point, **values)
        leaves[leaf] = doors[i] if leaf not in leaves else leaves[leaf]
        if leaves[leaf] != doors[i]:
            route.ways.append((leaves[leaf], doors[i]))
    _tree(route, grid, mask, clear, parent, leaves, root, middle)


def _end(map: TopometricMap, edge: Any, r: int) -> tuple[Array, Array]:
    """(2,) where one leaves room r: the middle of a door, the nearer end of a flight; and (2,) the way on out of a flight."""
    if not is_flight(edge):
        return np.asarray(edge["centre"][:2]), np.zeros(2)
    z = map.rooms["centroid"][r, 2]
    near, other = edge["lower"], edge["upper"]
    if abs(near[2] - z) > abs(other[2] - z):
        near, other = other, near
    out = (near - other)[:2]
    return np.asarray(near[:2]), out / max(float(np.hypot(*out)), 1e-9)


def _leaf(reached: Array, grid: Occupancy, point: Array, out: Array) -> Pixel | None:
    """The pixel from which one goes through a door, or onto a flight: straight on from its end, else beside it."""
    if not out.any():
        return _nearest(reached, grid, point, DOOR_REACH)
    ahead = point + np.arange(0.0, FLIGHT_REACH, grid.size / 2)[:, None] * out
    at = np.floor((ahead - grid.low) / grid.size).astype(int)
    at = at[((at >= 0) & (at < reached.shape)).all(axis=1)]
    hits = at[reached[tuple(at.T)]]
    return (int(hits[0, 0]), int(hits[0, 1])) if len(hits) else _nearest(reached, grid, point, FLIGHT_REACH)


def _middle(inside: Array, clear: Array) -> Pixel:
    """Of the pixels with most space around them the nearest to the middle of the room."""
    space = np.where(inside, clear, -1.0)
    options = np.argwhere(space >= 0.85 * space.max())
    middle = np.argwhere(inside).mean(axis=0)
    i, j = options[((options - middle) ** 2).sum(axis=1).argmin()].tolist()
    return i, j


def _disc(grid: Occupancy, point: Array, radius: float) -> tuple[tuple[slice, slice], Array]:
    """The part of the pixels around a point, and which of them are near to it."""
    first = np.maximum(np.floor((point - radius - grid.low) / grid.size).astype(int), 0)
    last = np.maximum(np.ceil((point + radius - grid.low) / grid.size).astype(int), first)
    box = (slice(first[0], last[0]), slice(first[1], last[1]))
    wide, high = grid.free[box].shape
    x = grid.low[0] + (first[0] + np.arange(wide) + 0.5) * grid.size - point[0]
    y = grid.low[1] + (first[1] + np.arange(high) + 0.5) * grid.size - point[1]
    near: Array = x[:, None] ** 2 + y**2 <= radius**2
    return box, near


def _nearest(mask: Array, grid: Occupancy, point: Array, radius: float) -> Pixel | None:
    """The pixel of the mask nearest to a point."""
    box, disc = _disc(grid, point, radius)
    options = np.argwhere(mask[box] & disc) + (box[0].start, box[1].start)
    if not len(options):
        return None
    i, j = options[((grid.centre(options) - point) ** 2).sum(axis=1).argmin()].tolist()
    return i, j


def _tree(
    route: Route,
    grid: Occupancy,
    mask: Array,
    clear: Array,
    parent: dict[Pixel, Pixel],
    leaves: dict[Pixel, int],
    root: Pixel,
    middle: int,
) -> None:
    """Ways from the root to all leaves (pixel -> node), with a node at every fork and bend."""
    if root in leaves:
        route.ways.append((middle, leaves[root]))
    nodes = {**leaves, root: middle}
    used: dict[Pixel, int] = {}  # pixel -> how many ways come into it from further out
    far = [leaf for leaf in leaves if leaf != root]
    for at in far:
        while at != root:
            at = parent[at]
            used[at] = used.get(at, 0) + 1
            if used[at] > 1:
                break
    for start in [*(pixel for pixel, ways in used.items() if ways > 1), *far]:
        chain = [start]
        while chain[-1] != root and (len(chain) == 1 or (used.get(chain[-1], 0) < 2 and chain[-1] not in nodes)):
            chain.append(parent[chain[-1]])
        if len(chain) > 1:
            _add_chain(route, grid, mask, clear, chain, nodes)


def _add_chain(route: Route, grid: Occupancy, mask: Array, clear: Array, chain: list[Pixel], nodes: dict[Pixel, int]) -> None:
    turns = _pulled(np.array(chain), mask, clear, 1.5 * grid.size)
    for i in turns:
        if chain[i] not in nodes:
            nodes[chain[i]] = route.add(grid.centre(np.array(chain[i])), kind="way")
    names = [nodes[chain[i]] for i in turns]
    route.ways += [(a, b) for a, b in pairwise(names) if a != b]


def _ways(mask: Array, clear: Array, size: float, root: Pixel) -> dict[Pixel, Pixel]:
    """Pixel -> the next one on the way to the root, for all pixels of the mask that are joined to it."""
    number = np.full(np.add(mask.shape, 2), -1)
    pixels = np.argwhere(mask)
    number[tuple((pixels + 1).T)] = np.arange(len(pixels))
    dear = 1 + (AWAY / np.maximum(clear[mask], size / 2)).clip(1) ** 2
    starts, ends, costs = [], [], []
    for di, dj in ((1, 0), (0, 1), (1, 1), (1, -1)):
        end = number[pixels[:, 0] + 1 + di, pixels[:, 1] + 1 + dj]
        start = np.flatnonzero(end >= 0)
        starts.append(start)
        ends.append(end[start])
        costs.append(np.hypot(di, dj) * (dear[start] + dear[end[start]]) / 2)
    shape = (len(pixels), len(pixels))
    graph = sparse.csr_matrix((np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))), shape)
    source = int(number[root[0] + 1, root[1] + 1])
    _, before = csgraph.dijkstra(graph, directed=False, indices=source, return_predecessors=True)
    rows: list[Pixel] = [(i, j) for i, j in pixels.tolist()]
    return {rows[k]: rows[b] for k, b in enumerate(before.tolist()) if b >= 0}


def _pulled(chain: Array, mask: Array, clear: Array, give: float) -> list[int]:
    """Rows of a chain of pixels between which straight ways keep as much space (give or take, m) as the chain does, or AWAY."""
    turns = [0]
    ahead = [len(chain) - 1]
    while ahead:
        i, j = turns[-1], ahead[-1]
        if j - i < 2 or _sees(chain[i : j + 1], mask, clear, give):
            turns.append(ahead.pop())
            continue
        along = chain[j] - chain[i]
        off = np.abs((chain[i + 1 : j] - chain[i]) @ (-along[1], along[0]))
        ahead.append(i + 1 + int(off.argmax()) if off.max() > 0 else (i + j) // 2)
    return turns


def _sees(chain: Array, mask: Array, clear: Array, give: float) -> bool:
    start, end = chain[0], chain[-1]
    steps = 4 * int(np.abs(end - start).max()) + 1
    line = np.rint(start + np.linspace(0, 1, steps)[:, None] * (end - start)).astype(int)
    least = min(float(clear[tuple(chain.T)].min()) - give, AWAY)
    return bool(mask[tuple(line.T)].all() and (clear[tuple(line.T)] >= least - 1e-9).all())
