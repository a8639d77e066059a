"""For robots: a map_server grid of each storey (image and yaml), where not to go, and a route graph for Nav2.

In the image 254 is free, 0 occupied and 205 unknown. Sources: http://wiki.ros.org/map_server; the graphs that nav2_route's
GeoJsonGraphFileLoader reads; the masks of nav2_costmap_2d's KeepoutFilter.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.structure.floors import is_flight
from topomerge.types import Array, TopometricMap

OBSTACLE_BAND = (0.2, 1.8)  # m above the floor beside it: what is occupied there is in the way; lintels and thresholds are not
CUT = (1.0, 1.9)  # m above the floor: what fills most of this band is a wall
BAND_SHARE = 0.5  # share of the band that must be occupied
STEEP = (0.5, 0.2)  # m across, m up: a floor that rises so much is stairs, or the edge of a platform
NEVER = np.iinfo(np.int32).max
LARGEST_OCCUPANCY = 50_000_000  # pixels of a storey: 700 m by 700 m of 10 cm, 2 GB while it is made


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Pixels over a storey: pixel (i, j) covers x from low[0] + i * size, y from low[1] + j * size."""

    low: Array  # (2,) m, in the input's frame
    size: float  # m
    free: Array  # (nx, ny) bool
    occupied: Array  # (nx, ny) bool
    wall: Array  # (nx, ny) bool
    room: Array  # (nx, ny) int32 room whose floor it is, -1 none

    def compute_centre(self, pixel: Array) -> Array:
        """Compute (..., 2) middle of pixels, m."""
        middle: Array = self.low + (np.asarray(pixel) + 0.5) * self.size
        return middle

    def crop(self, box: tuple[slice, ...]) -> Occupancy:
        """Return a part of it."""
        low = self.low + self.size * np.array([side.start for side in box])
        return Occupancy(low, self.size, self.free[box], self.occupied[box], self.wall[box], self.room[box])


def rasterize_occupancy(map: TopometricMap, storey: int) -> Occupancy:
    """Return the pixels of one storey; each is as large as a cell of the map.

    Raises:
        InputError: the storey spans more than `LARGEST_OCCUPANCY` pixels.

    Free is the floor one walks on (also floor of no room) without anything above it at the height of a robot; stairs count as
    occupied.
    """
    edge = map.navigable.edge
    rows = _find_floor_cells(map, storey)
    cells = _find_near_cells(map, rows)
    both = np.concatenate([map.navigable.cells[rows], cells])[:, :2]
    first = both.min(axis=0, initial=NEVER) - 1 if len(both) else np.zeros(2, np.int64)
    nx, ny = (both.max(axis=0, initial=0) - first + 2).tolist()
    if nx * ny > LARGEST_OCCUPANCY:
        size = f"{nx * edge:,.0f} by {ny * edge:,.0f} m"
        raise InputError(f"storey {storey} spans {size} in cells of {edge:g} m: too much for a grid; extract with larger cells")
    level, room = _compute_levels(map, rows, first, (nx, ny))
    walked = level < NEVER
    if walked.any():  # beside the floor, heights are told from the nearest piece of it
        level = level[tuple(ndimage.distance_transform_edt(~walked, return_distances=False, return_indices=True))]
    i, j = (cells[:, :2] - first).T
    above = cells[:, 2] - level[i, j]
    filled = [_count((i, j), above, band, edge, (nx, ny)) for band in (OBSTACLE_BAND, CUT)]
    occupied = (filled[0] > 0) | (walked & _find_steep_floor(level, walked, edge))
    wall = filled[1] >= max(BAND_SHARE * (CUT[1] - CUT[0]) / edge, 1)
    return Occupancy(map.navigable.origin[:2] + first * edge, edge, walked & ~occupied, occupied, wall, room)


def _find_floor_cells(map: TopometricMap, storey: int) -> Array:
    """Return the rows of the navigable cells of a storey: of its rooms, and those of no room that are nearest to its floor."""
    label = map.navigable_room
    of = np.full(len(label), -1)
    inside = label >= 0
    of[inside] = map.rooms["storey"][label[inside]]
    if len(map.storeys) and not inside.all():
        z = map.navigable.compute_centroids()[~inside, 2]
        of[~inside] = np.abs(z[:, None] - map.storeys["floor"]).argmin(axis=1)
    return np.flatnonzero(of == storey)


def _find_near_cells(map: TopometricMap, rows: Array) -> Array:
    """Return (n, 3) int64 occupied cells from the lowest floor to a person's height over the highest, in the floor's lattice."""
    if not len(rows):
        return np.empty((0, 3), np.int64)
    points, z = map.grid.compute_centroids(), map.navigable.compute_centroids()[rows, 2]
    near = (points[:, 2] > z.min() - map.navigable.edge) & (points[:, 2] < z.max() + CUT[1] + map.navigable.edge)
    return map.navigable.locate(points[near])


def _compute_levels(map: TopometricMap, rows: Array, first: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return (nx, ny) int32 lowest navigable cell of each column, NEVER where there is none; and its room."""
    level, room = np.full(shape, NEVER, np.int32), np.full(shape, -1, np.int32)
    order = rows[np.argsort(-map.navigable.cells[rows, 2], kind="stable")]  # the lowest one is written last
    i, j = (map.navigable.cells[order, :2] - first).T
    level[i, j] = map.navigable.cells[order, 2]
    room[i, j] = map.navigable_room[order]
    return level, room


def _count(at: tuple[Array, Array], above: Array, band: tuple[float, float], edge: float, shape: tuple[int, int]) -> Array:
    """Return (nx, ny) number of cells in a band of heights above the floor."""
    low, high = max(round(band[0] / edge), 1), max(round(band[1] / edge), 2)
    present = (above >= low) & (above < high)
    count = np.zeros(shape, np.int32)
    np.add.at(count, (at[0][present], at[1][present]), 1)
    return count


def _find_steep_floor(level: Array, walked: Array, edge: float) -> Array:
    """Return (nx, ny) bool: floor that rises like stairs. `level` is known everywhere."""
    if not walked.any():
        return walked
    wide = 2 * max(round(STEEP[0] / edge) // 2, 1) + 1
    level = ndimage.median_filter(level, 3)  # a cell too high is noise
    rise = ndimage.maximum_filter(level, wide) - ndimage.minimum_filter(level, wide)
    steep = np.pad(rise * edge >= STEEP[1] - 1e-6, wide)
    return np.asarray(ndimage.binary_closing(steep, np.ones((wide, wide)))[wide:-wide, wide:-wide])  # treads, too


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
    links: list[Pixel] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)

    def add(self, point: Any, **metadata: Any) -> int:
        """Add a node and return its number."""
        x, y = (float(v) for v in point)
        self.nodes.append(Node(self.first + len(self.nodes), (x, y), metadata))
        return self.nodes[-1].id


def plan_storey_route(map: TopometricMap, grid: Occupancy, storey: int, first: int = 0) -> tuple[Route, int]:
    """Return the routes of one storey, its numbers counted from `first`; and the first number that is left."""
    route = Route(first)
    clear = ndimage.distance_transform_edt(np.pad(grid.free, 1))[1:-1, 1:-1] * grid.size
    doors: dict[int, int] = {}
    reach = int(np.ceil(FLIGHT_REACH / grid.size))
    for r, box in enumerate(ndimage.find_objects(grid.room + 1)):
        if box is not None and map.rooms["storey"][r] == storey:
            wide = tuple(slice(max(side.start - reach, 0), side.stop + reach) for side in box)
            _add_room(route, map, grid.crop(wide), clear[wide], r, doors)
    number = first + len(route.nodes)
    place = {node.id: node.point for node in route.nodes}
    for a, b in route.links:
        length = float(np.hypot(*np.subtract(place[a], place[b])))
        route.edges += [Edge(number, a, b, length), Edge(number + 1, b, a, length)]
        number += 2
    return route, number


def _add_room(route: Route, map: TopometricMap, grid: Occupancy, clear: Array, r: int, doors: dict[int, int]) -> None:
    """Add the middle of a room, its doors and the ways between them."""
    edges = [(int(i), map.edges[i]) for i in np.flatnonzero((map.edges["rooms"] == r).any(axis=1))]
    inside = grid.free & (grid.room == r)
    if not inside.any():
        return
    mask = inside.copy()
    for _, edge in edges:
        if not is_flight(edge):
            box, disc = _rasterize_disc(grid, edge["centre"][:2], DOOR_REACH)
            mask[box] |= grid.free[box] & disc
    root = _find_middle(inside, clear)
    parent = _compute_predecessors(mask, clear, grid.size, root)
    reached = np.zeros_like(mask)
    reached[tuple(np.array([root, *parent]).T)] = True
    middle = route.add(grid.compute_centre(np.array(root)), kind="room", room=r, storey=int(map.rooms["storey"][r]))
    leaves: dict[Pixel, int] = {}
    for i, edge in edges:
        point, out = _find_exit(map, edge, r)
        leaf = _find_exit_pixel(reached, grid, point, out)
        if leaf is None:
            continue
        if i not in doors or is_flight(edge):
            other = int(edge["rooms"][edge["rooms"] != r][0])
            values = {"kind": str(edge["kind"]), "edge": i, "width": round(float(edge["width"]), 3), "open": bool(edge["open"])}
            if is_flight(edge):
                values |= {"to_room": other, "to_storey": int(map.rooms["storey"][other])}
            doors[i] = route.add(grid.compute_centre(np.array(leaf)) if is_flight(edge) else point, **values)
        leaves[leaf] = doors[i] if leaf not in leaves else leaves[leaf]
        if leaves[leaf] != doors[i]:
            route.links.append((leaves[leaf], doors[i]))
    _add_tree(route, grid, mask, clear, parent, leaves, root, middle)


def _find_exit(map: TopometricMap, edge: Any, r: int) -> tuple[Array, Array]:
    """Return (2,) where one leaves room r: the middle of a door, the nearer end of a flight; and (2,) the way on out of a
    flight."""
    if not is_flight(edge):
        return np.asarray(edge["centre"][:2]), np.zeros(2)
    z = map.rooms["centroid"][r, 2]
    near, other = edge["lower"], edge["upper"]
    if abs(near[2] - z) > abs(other[2] - z):
        near, other = other, near
    out = (near - other)[:2]
    return np.asarray(near[:2]), out / max(float(np.hypot(*out)), 1e-9)


def _find_exit_pixel(reached: Array, grid: Occupancy, point: Array, out: Array) -> Pixel | None:
    """Return the pixel from which one goes through a door, or onto a flight: straight on from its end, else beside it."""
    if not out.any():
        return _find_nearest(reached, grid, point, DOOR_REACH)
    ahead = point + np.arange(0.0, FLIGHT_REACH, grid.size / 2)[:, None] * out
    at = np.floor((ahead - grid.low) / grid.size).astype(int)
    at = at[((at >= 0) & (at < reached.shape)).all(axis=1)]
    hits = at[reached[tuple(at.T)]]
    return (int(hits[0, 0]), int(hits[0, 1])) if len(hits) else _find_nearest(reached, grid, point, FLIGHT_REACH)


def _find_middle(inside: Array, clear: Array) -> Pixel:
    """Return, of the pixels with most space around them, the nearest to the middle of the room."""
    space = np.where(inside, clear, -1.0)
    options = np.argwhere(space >= 0.85 * space.max())
    middle = np.argwhere(inside).mean(axis=0)
    i, j = options[((options - middle) ** 2).sum(axis=1).argmin()].tolist()
    return i, j


def _rasterize_disc(grid: Occupancy, point: Array, radius: float) -> tuple[tuple[slice, slice], Array]:
    """Return the part of the pixels around a point, and which of them are near to it."""
    first = np.maximum(np.floor((point - radius - grid.low) / grid.size).astype(int), 0)
    last = np.maximum(np.ceil((point + radius - grid.low) / grid.size).astype(int), first)
    box = (slice(first[0], last[0]), slice(first[1], last[1]))
    wide, high = grid.free[box].shape
    x = grid.low[0] + (first[0] + np.arange(wide) + 0.5) * grid.size - point[0]
    y = grid.low[1] + (first[1] + np.arange(high) + 0.5) * grid.size - point[1]
    near: Array = x[:, None] ** 2 + y**2 <= radius**2
    return box, near


def _find_nearest(mask: Array, grid: Occupancy, point: Array, radius: float) -> Pixel | None:
    """Return the pixel of the mask nearest to a point."""
    box, disc = _rasterize_disc(grid, point, radius)
    options = np.argwhere(mask[box] & disc) + (box[0].start, box[1].start)
    if not len(options):
        return None
    i, j = options[((grid.compute_centre(options) - point) ** 2).sum(axis=1).argmin()].tolist()
    return i, j


def _add_tree(
    route: Route,
    grid: Occupancy,
    mask: Array,
    clear: Array,
    parent: dict[Pixel, Pixel],
    leaves: dict[Pixel, int],
    root: Pixel,
    middle: int,
) -> None:
    """Add the ways from the root to all leaves (pixel -> node), with a node at every fork and bend."""
    if root in leaves:
        route.links.append((middle, leaves[root]))
    nodes = {**leaves, root: middle}
    used: dict[Pixel, int] = {}  # pixel -> how many ways come into it from further out
    far = [leaf for leaf in leaves if leaf != root]
    for at in far:
        while at != root:
            at = parent[at]
            used[at] = used.get(at, 0) + 1
            if used[at] > 1:
                break
    for start in [*(pixel for pixel, count in used.items() if count > 1), *far]:
        chain = [start]
        while chain[-1] != root and (len(chain) == 1 or (used.get(chain[-1], 0) < 2 and chain[-1] not in nodes)):
            chain.append(parent[chain[-1]])
        if len(chain) > 1:
            _add_chain(route, grid, mask, clear, chain, nodes)


def _add_chain(route: Route, grid: Occupancy, mask: Array, clear: Array, chain: list[Pixel], nodes: dict[Pixel, int]) -> None:
    turns = _simplify_chain(np.array(chain), mask, clear, 1.5 * grid.size)
    for i in turns:
        if chain[i] not in nodes:
            nodes[chain[i]] = route.add(grid.compute_centre(np.array(chain[i])), kind="way")
    names = [nodes[chain[i]] for i in turns]
    route.links += [(a, b) for a, b in pairwise(names) if a != b]


def _compute_predecessors(mask: Array, clear: Array, size: float, root: Pixel) -> dict[Pixel, Pixel]:
    """Map each pixel to the next one on the way to the root, for all pixels of the mask that are joined to it."""
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


def _simplify_chain(chain: Array, mask: Array, clear: Array, give: float) -> list[int]:
    """Return the rows of a chain of pixels between which straight ways keep as much space (give or take, m) as the chain does, or
    AWAY."""
    turns = [0]
    ahead = [len(chain) - 1]
    while ahead:
        i, j = turns[-1], ahead[-1]
        if j - i < 2 or _has_clear_line(chain[i : j + 1], mask, clear, give):
            turns.append(ahead.pop())
            continue
        along = chain[j] - chain[i]
        off = np.abs((chain[i + 1 : j] - chain[i]) @ (-along[1], along[0]))
        ahead.append(i + 1 + int(off.argmax()) if off.max() > 0 else (i + j) // 2)
    return turns


def _has_clear_line(chain: Array, mask: Array, clear: Array, give: float) -> bool:
    start, end = chain[0], chain[-1]
    steps = 4 * int(np.abs(end - start).max()) + 1
    line = np.rint(start + np.linspace(0, 1, steps)[:, None] * (end - start)).astype(int)
    least = min(float(clear[tuple(chain.T)].min()) - give, AWAY)
    return bool(mask[tuple(line.T)].all() and (clear[tuple(line.T)] >= least - 1e-9).all())


LIKELY_OUTSIDE = 0.5  # probability from which a room is kept out of
FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205


def count_storeys(map: TopometricMap, storey: int | None, lacking: str) -> int:
    """Count the storeys of a map.

    Args:
        storey: that is wanted; None: all.
        lacking: what a map without storeys does not give, in words.

    Raises:
        InputError: there is no such storey, or none at all.
    """
    count = len(map.storeys)
    if storey is not None and not 0 <= storey < count:
        raise InputError(f"--storey {storey}: the map has no such storey (it has {count})")
    if not count:
        raise InputError(f"the map has no storeys, so that {lacking}; extract it from a denser cloud")
    return count


def prepare_files(map: TopometricMap, folder: Path, stem: str, storey: int | None = None) -> list[tuple[Path, partial[None]]]:
    """Prepare the files of the folder: of each storey its grid, and `storey_0_keepout.pgm` and `.yaml` where floor is
    probably outside, and `storey_0_route.geojson` where there are routes.

    Numbers of nodes and edges are unique over all storeys. Where stairs begin or end, a node says in its metadata to which room
    of which storey they lead.

    Raises:
        InputError: there is no such storey, or none at all.
    """
    count = count_storeys(map, storey, "there is nothing to draw for a robot")
    outputs: list[tuple[Path, partial[None]]] = []
    first = 0
    for s in range(count):
        grid = rasterize_occupancy(map, s)
        route, first = plan_storey_route(map, grid, s, first)
        if storey not in (None, s):
            continue
        name = f"{stem}storey_{s}"
        outputs += _prepare_images(folder, name, grid)
        keepout = _build_keepout(map, grid)
        if keepout.occupied.any():
            outputs += _prepare_images(folder, f"{name}_keepout", keepout)
        if route.edges:
            outputs.append((folder / f"{name}_route.geojson", partial(_save_route, route, name)))
    return outputs


def _prepare_images(folder: Path, name: str, grid: Occupancy) -> list[tuple[Path, partial[None]]]:
    """Return a grid's image and what says where it lies."""
    image = f"{name}.pgm"
    return [(folder / image, partial(_save_image, grid)), (folder / f"{name}.yaml", partial(_save_yaml, grid, image))]


def _build_keepout(map: TopometricMap, grid: Occupancy) -> Occupancy:
    """Build a map in which the floor of rooms that are probably outside is occupied; everything else is free."""
    outside = np.append(map.rooms["outside"] >= LIKELY_OUTSIDE, False)[grid.room]  # room -1: the last one
    return replace(grid, free=~outside, occupied=outside)


def _save_image(grid: Occupancy, path: Path) -> None:
    image = np.full(grid.free.shape, UNKNOWN_PIXEL, np.uint8)
    image[grid.free] = FREE_PIXEL
    image[grid.occupied] = OCCUPIED_PIXEL
    image = np.ascontiguousarray(image.T[::-1])  # rows from the top, y up
    height, width = len(image), len(image[0])
    with replace_on_success(path) as temporary, temporary.open("wb") as file:
        file.write(f"P5\n# topomerge: {grid.size:g} m a pixel\n{width} {height}\n255\n".encode("ascii"))
        file.write(image.tobytes())


def _save_yaml(grid: Occupancy, image: str, path: Path) -> None:
    x, y = float(grid.low[0]), float(grid.low[1])
    lines = [f"image: {json.dumps(image)}", "mode: trinary", f"resolution: {grid.size!r}", f"origin: [{x!r}, {y!r}, 0.0]"]
    lines += ["negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196"]
    with replace_on_success(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _save_route(route: Route, name: str, path: Path) -> None:
    place = {node.id: [round(v, 4) for v in node.point] for node in route.nodes}
    features = []
    for node in route.nodes:
        properties = {"id": node.id, "frame": "map", "metadata": node.metadata}
        point = {"type": "Point", "coordinates": place[node.id]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    for edge in route.edges:
        line = {"type": "MultiLineString", "coordinates": [[place[edge.start], place[edge.end]]]}
        properties = {"id": edge.id, "startid": edge.start, "endid": edge.end, "cost": round(edge.length, 4), "overridable": True}
        features.append({"type": "Feature", "properties": properties, "geometry": line})
    head = json.dumps({"type": "FeatureCollection", "name": name, "crs": None})[:-1]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    with replace_on_success(path) as temporary:
        temporary.write_text(f'{head}, "features": [\n{lines}\n]}}\n', encoding="utf-8")
