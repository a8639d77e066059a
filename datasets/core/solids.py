"""Triangles of simple solids, and of the boundary of a free space given as upright prisms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.core.building import SURFACES

from topomerge.types import Array

GRID = 1e-3  # m; polygons are snapped to it, so that shared walls cancel exactly
BOX = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
BOX_FACES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6]]
    + [[1, 3, 5], [3, 7, 5]]
)


@dataclass(eq=False)
class TriangleSoup:
    """Triangles that are being collected; each addition has one label and one thing."""

    vertices: list[Array] = field(default_factory=list)
    triangles: list[Array] = field(default_factory=list)
    labels: list[Array] = field(default_factory=list)
    things: list[Array] = field(default_factory=list)
    count: int = 0

    def add(self, vertices: Array, triangles: Array, label: str | int | Array, thing: int = -1) -> None:
        """Add (v, 3) vertices and (t, 3) triangles that count from 0."""
        if not len(triangles):
            return
        self.vertices.append(np.asarray(vertices, np.float64))
        self.triangles.append(np.asarray(triangles) + self.count)
        value = SURFACES.index(label) if isinstance(label, str) else label
        self.labels.append(np.broadcast_to(np.asarray(value, np.uint8), len(triangles)))
        self.things.append(np.full(len(triangles), thing, np.int32))
        self.count += len(vertices)

    def build_arrays(self) -> tuple[Array, Array, Array, Array]:
        """Build vertices, triangles, labels and things; triangles without area are left out."""
        if not self.count:
            return (
                np.zeros((0, 3), np.float32),
                np.zeros((0, 3), np.int32),
                np.zeros(0, np.uint8),
                np.zeros(0, np.int32),
            )
        vertices = np.concatenate(self.vertices).astype(np.float32)
        triangles = np.concatenate(self.triangles).astype(np.int32)
        a, b, c = np.moveaxis(vertices[triangles].astype(np.float64), 1, 0)
        solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-6
        return vertices, triangles[solid], np.concatenate(self.labels)[solid], np.concatenate(self.things)[solid]


def build_rotation(yaw: float | Array) -> Array:
    """Return (2, 2) matrix that turns row vectors: `points @ rotation(yaw)`; (2, 2, n) for n angles."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s], [-s, c]])


def triangulate_boxes(parts: Array, at: Array | None = None, yaw: float = 0.0) -> tuple[Array, Array]:
    """Return triangles of boxes.

    Args:
        parts: (n, 6) centre and size of each box.
        at: (3,) where to put the origin of the parts, after turning them.
        yaw: rad, turns all boxes about the parts' origin.
    """
    parts = np.asarray(parts, np.float64).reshape(-1, 6)
    corners = (parts[:, None, :3] + BOX * parts[:, None, 3:]).reshape(-1, 3)
    corners[:, :2] = corners[:, :2] @ build_rotation(yaw)
    triangles = (BOX_FACES + 8 * np.arange(len(parts))[:, None, None]).reshape(-1, 3)
    return corners if at is None else corners + np.asarray(at), triangles


def triangulate_column(centre: Array, radius: float, bottom: float, top: float, sides: int = 12) -> tuple[Array, Array]:
    """Return triangles of an upright prism with a regular base."""
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    ring = np.asarray(centre)[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low, high = (np.column_stack([ring, np.full(sides, z)]) for z in (bottom, top))
    i, j = np.arange(sides), np.roll(np.arange(sides), -1)
    walls = np.concatenate([np.stack([i, j, i + sides], 1), np.stack([j, j + sides, i + sides], 1)])
    fan = np.stack([np.zeros(sides - 2, int), np.arange(1, sides - 1), np.arange(2, sides)], axis=1)
    return np.concatenate([low, high]), np.concatenate([walls, fan[:, ::-1], fan + sides])


def build_rectangle(start: Sequence[float], end: Sequence[float], thickness: float) -> shapely.Polygon:
    """Build the rectangle around a segment."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
    side = np.array([-along[1], along[0]]) * thickness / 2
    return shapely.Polygon([a - side, b - side, b + side, a + side])


def triangulate_polygons(polygons: shapely.Geometry) -> tuple[Array, Array]:
    """Return (t, 3, 2) triangles of polygons, counter-clockwise, and their parts' index."""
    parts = np.asarray([p for p in shapely.get_parts(polygons) if p.geom_type == "Polygon" and p.area > 1e-5], object)
    if not len(parts):
        return np.zeros((0, 3, 2)), np.zeros(0, int)
    pieces = shapely.constrained_delaunay_triangles(parts)
    triangles, owner = shapely.get_parts(shapely.orient_polygons(pieces), return_index=True)
    return shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3], owner


@dataclass(frozen=True, eq=False)
class Prism:
    """Free space over a polygon between two heights."""

    polygon: shapely.Geometry
    bottom: float
    top: float


@dataclass(frozen=True, eq=False)
class Faces:
    """Boundary of a free space: corners (n, 4 or 3, 3), looked at from inside counter-clockwise."""

    sides: Array
    ups: Array  # floors
    downs: Array  # ceilings


def build_boundary(prisms: Sequence[Prism]) -> Faces:
    """Build the surfaces around the union of prisms.

    Rooms, doorways, windows, stair wells and the world outside are all prisms of free space; everything else is solid. Between
    two neighbouring heights at which a prism starts or ends, the union has one plan; walls stand on its outline, and floors
    and ceilings lie where it differs from the plan below or above.
    """
    levels = np.unique(np.round([z for p in prisms for z in (p.bottom, p.top)], 3))
    shapes = shapely.set_precision(np.array([p.polygon for p in prisms], object), GRID)
    spans = np.round([[p.bottom, p.top] for p in prisms], 3)
    layers = [shapely.Polygon()]
    for low, high in pairwise(levels):
        layers.append(shapely.union_all(shapes[(spans[:, 0] <= low) & (spans[:, 1] >= high)], grid_size=GRID))
    layers.append(shapely.Polygon())
    ups: list[Any] = []
    downs: list[Any] = []
    for z, (below, above) in zip(levels, pairwise(layers), strict=True):
        for out, free, solid, turn in ((ups, above, below, 1), (downs, below, above, -1)):
            corners = triangulate_polygons(shapely.difference(free, solid, grid_size=GRID))[0][:, ::turn]
            out.append(np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=2))
    return Faces(_build_sides(layers[1:-1], levels), np.concatenate(ups), np.concatenate(downs))


def _build_sides(layers: list[shapely.Geometry], levels: Array) -> Array:
    """Return (n, 4, 3) upright rectangles; those that go on in the next layer are made one."""
    keys = []
    for k, layer in enumerate(layers):
        rings = shapely.get_rings(shapely.get_parts(shapely.orient_polygons(layer)))
        corners, owner = shapely.get_coordinates(rings, return_index=True)
        corners = np.round(corners / GRID).astype(np.int64)
        same = owner[1:] == owner[:-1]
        keys.append(np.column_stack([corners[:-1], corners[1:], np.full(len(corners) - 1, k)])[same])
    rows = np.concatenate(keys)
    rows = rows[np.lexsort(rows[:, ::-1].T)]
    first = np.ones(len(rows), bool)
    first[1:] = (rows[1:, :4] != rows[:-1, :4]).any(axis=1) | (rows[1:, 4] != rows[:-1, 4] + 1)
    last = np.append(first[1:], True)
    a, b = rows[first, :2] * GRID, rows[first, 2:4] * GRID
    low, high = levels[rows[first, 4]][:, None], levels[rows[last, 4] + 1][:, None]
    return np.stack([np.hstack(p) for p in ((b, low), (a, low), (a, high), (b, high))], axis=1)
