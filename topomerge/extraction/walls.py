"""Walls of storeys, unrolled before rooms exist, and the doorways in them (beyond the thesis: docs/adr/0018, 0024).

The faces of segments are read once by the network of elevations. Faces and doorways have the numbers of the segments beside them,
and those of rooms once segments are merged (`relabel_walls`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
from scipy import ndimage

from topomerge.extraction.elevations.doorways import (
    StoreyWalls,
    classify_places,
    compute_door_probabilities,
    detect_doorways,
)
from topomerge.extraction.elevations.elevation import ALONG, FACE_DTYPE, PLACES, Elevations, build_face_rows, unroll
from topomerge.extraction.plans.storey_floor import WALL_REACH, find_cells_of_storey
from topomerge.extraction.scan import Scan
from topomerge.extraction.segment import RasterisedStoreys, SegmentedStorey, find_segments
from topomerge.kernels import run_side_by_side
from topomerge.kernels.occupied_cells import OFFSET_STEPS
from topomerge.structure.floors import FACE_HEIGHTS, FULL_COLUMN, LEAST_CELLS
from topomerge.structure.lines import detect_lines, estimate_main_direction
from topomerge.types import Array, VoxelGrid

Locate = Callable[[Array], Array]  # (n, 3) m places on floors -> (n,) int64 segment or room there, -1 none
SPOTS_BEFORE = (0.2, 0.35, 0.5)  # m before a face: there the floor lies that sees it
BEYOND = (0.1, 1.0)  # m from a wall: there the other side begins


def unroll_walls(
    scan: Scan, navigable: VoxelGrid, rasters: RasterisedStoreys, storeys: Sequence[SegmentedStorey]
) -> StoreyWalls | None:
    """Unroll the walls of all segments and read them once; None of a scan that shows no walls at heights.

    Args:
        navigable: the navigable volume.
    """
    if scan.fine is None or not any(storey.count for storey in storeys):
        return None
    # Of segments, before rooms exist: so doors on walls have a say in the only cut (docs/adr/0024).
    first = np.cumsum([0, *(storey.count for storey in storeys)]).tolist()
    rows = run_side_by_side(lambda i: _faces_of(scan.grid, rasters, storeys[i], first[i]), range(len(storeys)))
    elevations = unroll(np.array(list(chain(*rows)), FACE_DTYPE), navigable, scan.fine, scan.crossed)
    classes = classify_places(elevations)
    doors = compute_door_probabilities(elevations, classes)
    return StoreyWalls(
        elevations, classes, doors, find_doorways(elevations, doors, lambda places: find_segments(storeys, places))
    )


def find_doorways(elevations: Elevations, doors: Array, locate: Locate) -> Array:
    """Find the doorways (D,) DOORWAY_DTYPE on walls, with what lies on their two sides; the second -1 where that is nothing else.

    Args:
        doors: (n / 2, 3) of `compute_door_probabilities`.
    """
    # A strip goes on past its face: a doorway there is of the room before it, not of that whose wall is in line (docs/adr/0018).
    found = detect_doorways(elevations, doors, _sides_before(elevations, locate))
    found = found[found["rooms"][:, 0] >= 0].copy()
    for k in np.flatnonzero(found["rooms"][:, 1] < 0).tolist():
        behind = locate(_sample_places_behind(found[k]))
        other = behind[(behind >= 0) & (behind != found["rooms"][k, 0])]
        if len(other):
            found["rooms"][k, 1] = np.bincount(other).argmax()
    return found


def relabel_walls(walls: StoreyWalls, number: Array) -> StoreyWalls:
    """Return the walls with other numbers of what lies beside them: of rooms, once segments were merged.

    Args:
        number: (n,) of each segment, -1 none.
    """
    number = np.append(number, -1)
    faces, doorways = walls.elevations.faces.copy(), walls.doorways.copy()
    # Read once: what walls lie beside is only named anew (docs/adr/0024).
    faces["room"] = number[faces["room"]]
    sides = number[doorways["rooms"]]
    sides[sides[:, 0] == sides[:, 1], 1] = -1
    doorways["rooms"] = np.where((sides[:, 0] < 0)[:, None], sides[:, ::-1], sides)
    return replace(walls, elevations=replace(walls.elevations, faces=faces), doorways=doorways[doorways["rooms"][:, 0] >= 0])


def _faces_of(grid: VoxelGrid, rasters: RasterisedStoreys, storey: SegmentedStorey, first: int) -> list[tuple[object, ...]]:
    """Return the rows of FACE_DTYPE of a storey's segments, which are numbered from `first` on."""
    plan = storey.plan
    far, nearest = ndimage.distance_transform_edt(storey.segment < 0, return_indices=True)
    segment = np.where(far * plan.edge <= WALL_REACH, storey.segment[tuple(nearest)], -1)
    rows, column = find_cells_of_storey(grid, plan, segment, rasters.factor)
    of = segment[tuple(column.T)]
    count = storey.count
    inside = storey.segment >= 0
    order = np.argsort(storey.segment[inside], kind="stable")
    ends = np.searchsorted(storey.segment[inside][order], np.arange(count + 1))
    floors = plan.origin + (np.argwhere(inside)[order] + 0.5) * plan.edge
    heights = plan.floor[inside][order]
    level = np.array([np.median(heights[a:b]) for a, b in pairwise(ends)])
    offset = grid.properties.get("offset")
    within = 0.5 if offset is None else (offset[rows].astype(np.float64) + 0.5) / OFFSET_STEPS
    at = grid.origin + (grid.cells[rows] + within) * grid.edge
    above = at[:, 2] - level[of]
    upright = (above > FACE_HEIGHTS[0]) & (above < FACE_HEIGHTS[1])
    rows, of, at = rows[upright], of[upright], at[upright]
    key = (of * grid.shape[0] + grid.cells[rows, 0]) * grid.shape[1] + grid.cells[rows, 1]
    _, start, column_of, cells = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    middle = np.column_stack([np.bincount(column_of, at[:, k], len(cells)) / np.maximum(cells, 1) for k in (0, 1)])
    scale = 0.1 / grid.edge  # how many cells stand above each other
    full = cells >= LEAST_CELLS * scale
    owner, middle = of[start][full], middle[full]
    weight = np.minimum(cells[full] / (FULL_COLUMN * scale), 1.0) * grid.edge
    columns = [(middle[owner == s], weight[owner == s]) for s in range(count)]
    main = estimate_main_direction([line for points in columns for line in detect_lines(*points)])
    faces: list[tuple[object, ...]] = []
    for s, points in enumerate(columns):
        faces += build_face_rows(first + s, detect_lines(*points, main), floors[ends[s] : ends[s + 1]], float(level[s]))
    return faces


def _sides_before(elevations: Elevations, locate: Locate) -> Array:
    """Return (n / 2, 3) int64 what lies under spots before each place along all strips, -1 none."""
    sizes = np.diff(elevations.first) // PLACES
    face = elevations.faces[np.repeat(np.arange(len(sizes)), sizes)]
    along = (np.arange(len(face)) - np.repeat(elevations.first[:-1] // PLACES, sizes) + 0.5) * (PLACES * ALONG)
    at = face["start"] + along[:, None] * face["along"]
    return np.stack([locate(np.column_stack([at - off * face["out"], face["floor"]])) for off in SPOTS_BEFORE], axis=1)


def _sample_places_behind(way: Array) -> Array:
    """Return (k, 3) m, behind a doorway as its first side sees it."""
    steps = np.arange(BEYOND[0], BEYOND[1] + 0.05, 0.1)
    aside = np.array([-way["out"][1], way["out"][0]]) * float(way["width"]) / 4
    places = way["centre"][:2] + aside * np.array([[-1.0], [0.0], [1.0]]) + steps[:, None, None] * way["out"]
    places = places.reshape(-1, 2)
    return np.column_stack([places, np.full(len(places), way["centre"][2])])
