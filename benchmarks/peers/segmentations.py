"""The classic segmentations of grid maps into rooms: the peers of the field.

Written anew from their description in Bormann, Jordan, Li, Hampp and Hägele, "Room segmentation: survey, implementation, and
analysis", ICRA 2016; the numbers are those that the authors ship with their own implementation (`ipa_room_segmentation`), in
metres where they count pixels of 5 cm. Each takes the free cells of a map and gives every one that it can reach a room.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import Voronoi

from topomerge.types import Array

DISTANCE_AREAS = (0.35, 163.0)  # m2 of a room's seed
MORPHOLOGICAL_AREAS = (0.8, 47.0)  # m2 of a room's seed
VORONOI_AREAS = (0.1, 1e6)  # m2 between critical lines
DEAD_END_AREA, DEAD_END_WALL = 12.5, 0.75  # m2 and share of walls below which a piece with one neighbour joins it
SMALL_AREA, SMALL_BORDER = 2.0, 0.2  # m2, and the share of its outline from which it joins
PASSAGE_WALL, PASSAGE_BORDER, PASSAGE_ENDS = 0.5, 0.15, 0.95  # shares of the outline of a piece between two others
WIDE_BORDER, WIDE_OTHER, END_BORDER, END_SLACK = 0.2, 0.1, 0.1, 0.05  # shares of an outline that no door has
SQUARE = np.ones((3, 3), bool)
# m2: a critical point is the narrowest place of the graph for this, divided by its clearance (the authors: 280 cells of 5 cm).
NEIGHBOURHOOD = 0.7
APART = 0.5  # of its clearance that critical points are apart at least
TEETH = 3.0  # cells between the two walls of a point of the graph: below are the teeth of slanted walls


def segment_by_distance(free: Array, cell: float) -> Array:
    """Segment with seeds that are further from everything occupied than a threshold: the one that gives most seeds of a room's
    size.

    Args:
        free: (h, w) bool.
        cell: m, edge of a cell.

    Returns:
        (h, w) int32 room of each cell, -1 none.
    """
    clearance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    best, most = np.zeros(free.shape, np.int32), 0
    for threshold in range(1, int(clearance.max()) + 1):
        seeds, count = _label_pieces(clearance > threshold, cell, DISTANCE_AREAS, SQUARE)
        if count > most:
            best, most = seeds, count
    return flood_seeds(best, free)


def segment_by_erosion(free: Array, cell: float) -> Array:
    """Erode free space cell by cell; a piece that has come apart from others and has a room's size is a seed and taken out, and
    so is one that would vanish in the next step.

    Args:
        free: (h, w) bool.
        cell: m, edge of a cell.

    Returns:
        (h, w) int32 room of each cell, -1 none.
    """
    low, high = (area / cell**2 for area in MORPHOLOGICAL_AREAS)
    pieces, count = ndimage.label(free, SQUARE)
    apart, seeds, total = np.zeros(count + 1, bool), np.zeros(free.shape, np.int32), 0
    while count:
        smaller, number = ndimage.label(ndimage.binary_erosion(pieces > 0, SQUARE), SQUARE)
        whole = np.zeros(number + 1, int)  # the piece that each smaller one was of
        whole[smaller[smaller > 0]] = pieces[smaller > 0]
        area, before = np.bincount(smaller.ravel(), minlength=number + 1), np.bincount(pieces.ravel(), minlength=count + 1)
        real = area >= low
        real[0] = False
        parts = np.bincount(whole[real], minlength=count + 1)
        apart = real & (apart[whole] | (parts[whole] > 1))
        vanishing = (parts == 0) & (before >= low) & (before <= high)
        vanishing[0] = False
        for taken, of in ((vanishing, pieces), (apart & (area <= high), smaller)):
            seed = taken[of]
            names = np.cumsum(taken)[of[seed]]
            seeds[seed] = names + total
            total += int(taken.sum())
        left = real & ~(apart & (area <= high))
        pieces, count = np.where(left, np.cumsum(left), 0)[smaller], int(left.sum())
        apart = np.concatenate([[False], apart[left]])
    return flood_seeds(seeds, free)


def segment_by_voronoi(free: Array, cell: float) -> Array:
    """Cut free space at critical lines of the Voronoi graph, and join again pieces that no door parts.

    Args:
        free: (h, w) bool.
        cell: m, edge of a cell.

    Returns:
        (h, w) int32 room of each cell, -1 none.
    """
    cut = free.copy()
    for rows, columns in find_critical_lines(free, cell):
        cut[rows, columns] = False
    pieces, count = _label_pieces(cut, cell, VORONOI_AREAS, None)
    labels = flood_seeds(pieces, free)
    return join_pieces(labels, count, cell) if count else labels


METHODS: dict[str, Callable[[Array, float], Array]] = {
    "voronoi": segment_by_voronoi,
    "distance": segment_by_distance,
    "morphological": segment_by_erosion,
}


def _label_pieces(mask: Array, cell: float, areas: tuple[float, float], structure: Array | None) -> tuple[Array, int]:
    """Return (h, w) int32 connected pieces of a size between two areas (m2), numbered from 1, and how many there are."""
    pieces, count = ndimage.label(mask, structure)
    area = np.bincount(pieces.ravel(), minlength=count + 1) * cell**2
    fits = (area >= areas[0]) & (area <= areas[1])
    fits[0] = False
    number = np.where(fits, np.cumsum(fits), 0).astype(np.int32)
    return number[pieces], int(fits.sum())


def flood_seeds(seeds: Array, free: Array) -> Array:
    """Return (h, w) int32 free cells by the seed (from 1) whose wave front reaches them first, from 0; -1: none does."""
    labels = np.pad(np.where(free, seeds, 0).astype(np.int32), 1)
    open_cells = np.pad(free, 1).ravel() & (labels.ravel() == 0)
    flat, width = labels.ravel(), labels.shape[1]
    around = np.array([-1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1])
    front = np.flatnonzero(flat)
    while len(front):
        to, source = (front[:, None] + around).ravel(), np.repeat(front, len(around))
        inside = (to >= 0) & (to < len(flat))
        to, source = to[inside], source[inside]
        to, first = np.unique(np.where(open_cells[to], to, -1), return_index=True)
        to, source = to[to >= 0], source[first[to >= 0]]
        flat[to], open_cells[to] = flat[source], False
        front = to
    return labels[1:-1, 1:-1] - 1


def count_contacts(labels: Array, count: int) -> Array:
    """Return (count + 1, count + 1) sides that cells of two pieces share; the last is what is not free."""
    padded = np.pad(np.where(labels < 0, count, labels), 1, constant_values=count)
    out = np.zeros((count + 1, count + 1), np.int64)
    for a, b in ((padded[:, 1:], padded[:, :-1]), (padded[1:], padded[:-1])):
        apart = a != b
        np.add.at(out, (a[apart], b[apart]), 1)
    return out + out.T


def join_pieces(labels: Array, count: int, cell: float) -> Array:
    """Join pieces between critical lines by the survey's four rules, one after the other, the smallest piece first."""
    touch = count_contacts(labels, count).astype(float)
    area = np.bincount(labels[labels >= 0], minlength=count) * cell**2
    name = np.arange(count)
    for rule in (_dead_end, _small, _passage, _wide):
        while True:
            order = [i for i in np.argsort(area, kind="stable") if area[i] > 0]
            pair = next(((i, j) for i in order for j in rule(touch, area, int(i))), None)
            if pair is None:
                break
            _join(touch, area, name, *pair)
    _, number = np.unique(name, return_inverse=True)
    return np.where(labels >= 0, number[np.maximum(labels, 0)], -1).astype(np.int32)


def _join(touch: Array, area: Array, name: Array, i: int, j: int) -> None:
    """Make piece i part of piece j."""
    touch[j] += touch[i]
    touch[:, j] += touch[:, i]
    touch[i] = touch[:, i] = touch[j, j] = 0
    area[j] += area[i]
    area[i] = 0
    name[name == i] = j


def _measure_shares(touch: Array, i: int) -> tuple[Array, float, Array]:
    """Return the shares of a piece's outline by neighbour, of walls, and its neighbours, the longest border first."""
    outline = max(float(touch[i].sum()), 1.0)
    shares = touch[i, :-1] / outline
    order = np.argsort(-shares, kind="stable")
    return shares, float(touch[i, -1]) / outline, order[shares[order] > 0]


def _dead_end(touch: Array, area: Array, i: int) -> list[int]:
    _, wall, near = _measure_shares(touch, i)
    return near.tolist() if len(near) == 1 and area[i] < DEAD_END_AREA and wall <= DEAD_END_WALL else []


def _small(touch: Array, area: Array, i: int) -> list[int]:
    shares, _, near = _measure_shares(touch, i)
    return near[:1].tolist() if len(near) and area[i] < SMALL_AREA and shares[near[0]] > SMALL_BORDER else []


def _passage(touch: Array, area: Array, i: int) -> list[int]:
    shares, wall, near = _measure_shares(touch, i)
    if not len(near) or len(near) > 2 or wall <= PASSAGE_WALL or shares[near[0]] <= PASSAGE_BORDER:
        return []
    others, other_wall, beyond = _measure_shares(touch, int(near[0]))
    ends = other_wall + float(others[beyond[:2]].sum())
    return near[:1].tolist() if len(beyond) <= 2 or ends >= PASSAGE_ENDS else []


def _wide(touch: Array, area: Array, i: int) -> list[int]:
    shares, wall, near = _measure_shares(touch, i)
    out = []
    for j in near.tolist():
        end = shares[j] > END_BORDER and abs(wall - (1 - 2 * shares[j])) < END_SLACK
        if (shares[j] > WIDE_BORDER or end) and _measure_shares(touch, j)[0][i] > WIDE_OTHER:
            out.append(j)
    return out


def build_graph(free: Array) -> tuple[Array, Array, Array]:
    """Return the Voronoi graph of the occupied cells beside free ones, without its dead ends.

    Args:
        free: (h, w) bool.

    Returns:
        (n, 2) points (row, column), (e, 2) pairs of them, and (e, 2, 2) the two cells that are the nearest to each edge.
    """
    padded = np.pad(free, 1)
    wall = np.argwhere(~padded & ndimage.binary_dilation(padded, np.ones((3, 3)))) - 1.0
    none = np.zeros((0, 2))
    if len(wall) < 4:
        return none, none.astype(int), np.zeros((0, 2, 2))
    cells = Voronoi(wall)
    at = np.rint(cells.vertices).astype(int)
    inside = np.all((at >= 0) & (at < free.shape), axis=1)
    inside[inside] = free[tuple(at[inside].T)]
    ends, walls = np.array(cells.ridge_vertices), wall[cells.ridge_points]
    good = (ends >= 0).all(axis=1)
    good[good] = inside[ends[good]].all(axis=1)
    ends, walls = ends[good], walls[good]
    wide = np.linalg.norm(walls[:, 0] - walls[:, 1], axis=1) > TEETH
    ends, walls = ends[wide], walls[wide]
    stay = _prune_dead_ends(ends, len(cells.vertices))
    return cells.vertices, ends[stay], walls[stay]


def _prune_dead_ends(ends: Array, count: int) -> Array:
    """Return (e,) bool edges that remain when every dead end is taken back to the first crossing."""
    stay = np.ones(len(ends), bool)
    crossing = np.bincount(ends.ravel(), minlength=count) >= 3
    while True:
        degree = np.bincount(ends[stay].ravel(), minlength=count)
        loose = (degree == 1) & ~crossing
        dead = stay & loose[ends].any(axis=1)
        if not dead.any():
            return stay
        stay &= ~dead


def find_critical_lines(free: Array, cell: float) -> list[tuple[Array, Array]]:
    """Return the rows and columns of the cells of each critical line: from a narrowest point of the graph to its two nearest
    walls.

    Args:
        free: (h, w) bool.
        cell: m, edge of a cell.
    """
    points, ends, walls = build_graph(free)
    if not len(ends):
        return []
    middle = points[ends].mean(axis=1)
    clearance = np.linalg.norm(middle - walls[:, 0], axis=1) * cell
    narrow = _find_narrowest(points * cell, ends, clearance)
    one, two = walls[:, 0] - middle, walls[:, 1] - middle
    cosine = (one * two).sum(axis=1) / np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1), 1e-9)
    lines: list[tuple[Array, Array]] = []
    taken = np.zeros((0, 2))
    for edge in narrow[np.lexsort([narrow, clearance[narrow], np.round(cosine[narrow], 1)])]:  # the straightest first
        near = np.linalg.norm(taken - middle[edge], axis=1) * cell
        if (near < APART * clearance[edge]).any():
            continue
        taken = np.concatenate([taken, middle[edge][None]])
        lines.append(_line(walls[edge, 0], middle[edge], walls[edge, 1], free.shape))
    return lines


def _find_narrowest(points: Array, ends: Array, clearance: Array) -> Array:
    """Return the edges that no other edge of the graph within their neighbourhood undercuts; every one of a stretch of even
    width."""
    length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    count, edges = len(points), np.arange(len(ends))
    table = sparse.csr_matrix((np.tile(edges, 2), (ends.T.ravel(), ends[:, ::-1].T.ravel())), (count, count))
    out = []
    for edge in edges:
        reach = NEIGHBOURHOOD / 2 / max(clearance[edge], 1e-6)  # to each side
        far = dict.fromkeys(ends[edge].tolist(), 0.0)
        stack, least = list(far), clearance[edge]
        while stack and least >= clearance[edge]:
            at = stack.pop()
            row = slice(table.indptr[at], table.indptr[at + 1])
            for to, via in zip(table.indices[row].tolist(), table.data[row].tolist(), strict=True):
                least = min(least, clearance[via])
                way = far[at] + length[via]
                if way < reach and way < far.get(to, np.inf):
                    far[to] = way
                    stack.append(to)
        if least >= clearance[edge]:
            out.append(edge)
    return np.array(out, int)


def _line(start: Array, middle: Array, end: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the rows and columns of the cells from one wall over the middle to the other."""
    steps = 2 + 3 * int(np.linalg.norm(start - middle) + np.linalg.norm(end - middle))
    way = np.linspace(0, 1, steps)[:, None]
    places = np.concatenate([start + way * (middle - start), middle + way * (end - middle)])
    rows, columns = np.clip(np.rint(places).astype(int), 0, np.array(shape) - 1).T
    return rows, columns
