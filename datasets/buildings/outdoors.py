"""Surroundings of a building: uneven ground, fences, hedges, houses across the street, trees, bushes and cars.

Buildings are erected without it, so that scans of rooms end at the windows. Whoever wants to know what a sensor sees beyond them
adds it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.solids import BOX, BOX_FACES, TriangleSoup

from topomerge.types import Array

WALL = 0.4  # m from the rooms to the outer face of their walls
GROUND_CELL = 1.0  # m between the vertices of the ground
DEPTH = (6.0, 18.0)  # m of ground on each side
DROP = (0.0, 0.5)  # m from the lowest floor down to the ground
GROUND_ROUGHNESS = 0.08  # m, standard deviation of the ground's height
BOUNDS = ("street", "fence", "hedge", "open")  # what may end a side
PLANT_AREA = 25.0  # m2 of ground a tree or bush, at the greenest
LEAVES = (25, 70)  # triangles of a crown
LEAF = 0.35  # m, of a side
CAR = (4.3, 1.8, 1.45)  # m


def add_outdoors(building: Building, rng: np.random.Generator) -> Building:
    """Return the building with ground around its lowest storey and with what stands there, all labelled `facade`."""
    low = float(building.storeys["floor"][0]) - float(rng.uniform(*DROP))
    taken = compute_footprint(building)
    x0, y0, x1, y1 = taken.bounds
    sides = rng.uniform(*DEPTH, 4)
    box = np.array([[x0 - sides[0], y0 - sides[1]], [x1 + sides[2], y1 + sides[3]]])
    soup = TriangleSoup()
    _add_ground(soup, box, taken, low, rng)
    for side in range(4):
        _add_bound(soup, box, side, low, rng)
    _add_plants(soup, box, taken, low, rng)
    vertices, triangles, labels, _ = soup.build_arrays()
    return replace(
        building,
        vertices=np.concatenate([building.vertices, vertices]),
        triangles=np.concatenate([building.triangles, triangles + len(building.vertices)]),
        labels=np.concatenate([building.labels, labels]),
        thing_of=np.concatenate([building.thing_of, np.full(len(triangles), -1, building.thing_of.dtype)]),
    )


def compute_footprint(building: Building) -> shapely.Geometry:
    """Compute the outline of a building's rooms with their walls."""
    return shapely.union_all([shapely.Polygon(room.polygon).buffer(WALL, join_style="mitre") for room in building.rooms])


def _add_ground(soup: TriangleSoup, box: Array, taken: shapely.Geometry, low: float, rng: np.random.Generator) -> None:
    counts = np.ceil((box[1] - box[0]) / GROUND_CELL).astype(int) + 1
    x, y = (np.linspace(box[0, k], box[1, k], counts[k]) for k in (0, 1))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([places, low + rng.normal(0, GROUND_ROUGHNESS, len(places))])
    corner = (np.arange(counts[0] - 1)[:, None] * counts[1] + np.arange(counts[1] - 1)).ravel()
    right, up = corner + counts[1], corner + 1
    triangles = np.concatenate([np.column_stack([corner, right, up]), np.column_stack([right, right + 1, up])])
    middle = vertices[triangles][:, :, :2].mean(axis=1)
    soup.add(vertices, triangles[~shapely.contains_xy(taken, middle)], "facade")


def _add_bound(soup: TriangleSoup, box: Array, side: int, low: float, rng: np.random.Generator) -> None:
    """Add a hedge, a wall or houses along a side of the ground (0 west, 1 south, 2 east, 3 north), or leave it open."""
    kind, axis = str(rng.choice(BOUNDS)), side % 2
    if kind == "open":
        return
    at, along = box[side // 2, axis], box[:, 1 - axis]
    length = float(along[1] - along[0])
    if kind == "hedge":
        for start in np.arange(0.0, length, 0.7):
            size = rng.uniform([0.6, 0.7, 0.9], [1.2, 1.1, 2.4])
            _add_box(soup, at, along[0] + start, size, axis, low, float(rng.uniform(-0.3, 0.3)))
        return
    height = float(rng.uniform(6, 10)) if kind == "street" else float(rng.uniform(0.9, 2.0))
    _add_box(soup, at, along[0] + length / 2, np.array([0.2, length, height]), axis, low, 0.0)
    if kind == "street":
        inward = 1 if side < 2 else -1
        for start in np.arange(rng.uniform(0, 8), length, rng.uniform(5.5, 12)):
            size = np.array([CAR[1], CAR[0], CAR[2]])
            _add_box(soup, at + inward * rng.uniform(1.8, 2.6), along[0] + start, size, axis, low, float(rng.normal(0, 0.03)))


def _add_box(soup: TriangleSoup, across: float, along: float, size: Array, axis: int, low: float, yaw: float) -> None:
    """Add a box on the ground: `size` across the side, along it, and up."""
    corners = BOX * size
    turned = np.column_stack([np.cos(yaw) * corners[:, 0] - np.sin(yaw) * corners[:, 1],
                              np.sin(yaw) * corners[:, 0] + np.cos(yaw) * corners[:, 1]])  # fmt: skip
    place = turned + [across, along]
    soup.add(np.column_stack([place if axis == 0 else place[:, ::-1], corners[:, 2] + low + size[2] / 2]), BOX_FACES, "facade")


def _add_plants(soup: TriangleSoup, box: Array, taken: shapely.Geometry, low: float, rng: np.random.Generator) -> None:
    """Add trees, and bushes that begin at the ground; their leaves are triangles that hang about."""
    area = float(np.prod(box[1] - box[0])) - taken.area
    for place in rng.uniform(box[0], box[1], (rng.poisson(rng.uniform(0, 1) * area / PLANT_AREA), 2)):
        if taken.distance(shapely.Point(place)) < 0.8:
            continue
        tree = rng.random() < 0.4
        radius = rng.uniform([0.4, 0.4, 0.4], [1.0, 1.0, 0.9]) * (1.8 if tree else 1.0)
        middle = np.array([*place, low + (rng.uniform(2.5, 4.0) if tree else 0.7 * radius[2])])
        if tree:
            _add_box(soup, place[0], place[1], np.array([0.25, 0.25, middle[2] - low]), 0, low, 0.0)
        count = int(rng.integers(*LEAVES))
        away = rng.normal(size=(count, 3))
        centre = middle + radius * away / np.linalg.norm(away, axis=1, keepdims=True) * rng.random((count, 1)) ** (1 / 3)
        leaves = centre[:, None] + rng.uniform(-LEAF, LEAF, (count, 3, 3))
        soup.add(leaves.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), "facade")
