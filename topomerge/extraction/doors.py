"""Where two rooms meet: doors, openings and stairs (seeds 2.7)."""

from __future__ import annotations

import numpy as np

from topomerge.extraction.components import connected_components
from topomerge.extraction.convolution import sphere
from topomerge.types import EDGE_DTYPE, Array, VoxelGrid

DOOR_WIDTH = 1.6  # m: what is wider is an opening
NEIGHBOURS = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1)])


def find_edges(
    navigable: VoxelGrid, room: Array, storey_of_room: Array, floor_to_ceiling: Array, body: float
) -> Array:
    """Edges between rooms that have adjacent navigable cells (seeds 2.7), one for each place where they meet.

    Args:
        navigable: the navigable volume.
        room: (m,) room of each of its cells, -1 none.
        storey_of_room: (R,) storey of each room.
        floor_to_ceiling: (m,) m of empty space above each cell, 0 where nothing was seen.
        body: width of the body that the navigable volume was made for, m: a door is that much wider than what is navigable.

    Returns:
        (E,) EDGE_DTYPE, sorted by rooms and place.
    """
    cells = navigable.cells.astype(np.int64)
    first, second = [], []
    for step in NEIGHBOURS:
        other = navigable.rows(cells + step)
        here = np.flatnonzero((other >= 0) & (room >= 0))
        there = other[here]
        meet = (room[there] >= 0) & (room[there] != room[here])
        first.append(here[meet])
        second.append(there[meet])
    a, b = np.concatenate(first), np.concatenate(second)
    swap = room[a] > room[b]
    a[swap], b[swap] = b[swap], a[swap]
    edges: list[tuple[object, ...]] = []
    for pair in np.unique(np.column_stack([room[a], room[b]]), axis=0):
        here = (room[a] == pair[0]) & (room[b] == pair[1])
        rows = np.unique(np.concatenate([a[here], b[here]]))
        meeting = navigable.subset(rows)
        contact = connected_components(meeting, sphere(2.5 * navigable.edge, navigable.edge))
        for c in range(int(contact.max()) + 1):
            edges.append(_edge(navigable, pair, rows[contact == c], storey_of_room, floor_to_ceiling, body))
    return np.array(edges, EDGE_DTYPE) if edges else np.zeros(0, EDGE_DTYPE)


def _edge(
    navigable: VoxelGrid, pair: Array, rows: Array, storey_of_room: Array, floor_to_ceiling: Array, body: float
) -> tuple[object, ...]:
    """One row of EDGE_DTYPE from the cells of both rooms that touch."""
    points = navigable.centroids(navigable.cells[rows])
    plan = np.unique(navigable.cells[rows, :2], axis=0) * navigable.edge
    along = np.array([1.0, 0.0])
    if len(plan) > 2:
        along = np.linalg.svd(plan - plan.mean(axis=0), full_matrices=False)[2][0]
    across = float(np.arctan2(along[0], -along[1]) % np.pi)  # the wall's normal
    above = floor_to_ceiling[rows]
    height = float(above[above > 0].min()) if (above > 0).any() else 0.0
    floor = float(np.sort(points[:, 2])[: max(len(points) // 4, 1)].mean())
    centre = (float(points[:, 0].mean()), float(points[:, 1].mean()), floor)
    width = float(np.ptp(plan @ along)) + body
    if storey_of_room[pair[0]] != storey_of_room[pair[1]]:
        kind = "stairs"
    else:
        kind = "door" if width <= DOOR_WIDTH else "opening"
    return (tuple(int(p) for p in pair), centre, width, height, across, kind)
