"""Drawing a plan: rooms that share walls, doors where two rooms meet, windows where one meets the outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from topomerge.datasets.core.building import Flight, Opening, Plan, PlanRoom, Point, Wall

from topomerge.types import Array

DOOR_WIDTH_SPREAD = 0.01  # m, standard deviation of the clear width of doors of one make, as built
CORNER_MARGIN = 0.12  # m between an opening and the corner of its room


@dataclass(eq=False)
class Draft:
    """A plan that is being drawn, with outlines along the walls' centre lines.

    Args:
        wall: m, thickness of the inner walls.
        rng: decides where along a wall a door stands.
        wide: factor on the widths of doors: every building has its own make.
    """

    wall: float
    rng: np.random.Generator
    wide: float = 1.0
    outlines: list[shapely.Polygon] = field(default_factory=list)
    rooms: list[PlanRoom] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    openings: list[Opening] = field(default_factory=list)
    flights: list[Flight] = field(default_factory=list)

    def add_room(self, outline: shapely.Polygon, kind: str, ceiling: float = 0.0) -> int:
        """Add a room; return its index."""
        outline = snap(outline)
        inner = np.asarray(shapely.orient_polygons(outline.buffer(-self.wall / 2, join_style="mitre")).exterior.coords)[:-1]
        self.outlines.append(outline)
        self.rooms.append(PlanRoom(f"{kind} {len(self.rooms)}", np.round(inner, 3), kind, ceiling))
        return len(self.rooms) - 1

    def add_box(self, low: Sequence[float], high: Sequence[float], kind: str, ceiling: float = 0.0) -> int:
        """Add a rectangular room between two corners, in any order."""
        (x0, x1), (y0, y1) = sorted((low[0], high[0])), sorted((low[1], high[1]))
        return self.add_room(shapely.box(x0, y0, x1, y1), kind, ceiling)

    def add_door(self, a: int, b: int, width: float, kind: str = "door", at: float | None = None, **more: float | str) -> bool:
        """Add a door between two rooms, anywhere along their longest common wall, or at a share of it.

        Returns False where no common wall is long enough.
        """
        line = self.outlines[a].intersection(self.outlines[b])
        if kind == "door":
            width = round(max(width * self.wide + float(self.rng.normal(0, DOOR_WIDTH_SPREAD)), 0.72), 2)
        return self.cut(line, width, kind, at, **more) or (width < 1.3 and self.cut(line, 0.72, kind, at, **more))

    def add_entrance(self, a: int, width: float) -> bool:
        """Add a door to the outside."""
        return self.cut(self.compute_outer_walls(a), width, "door", 0.5)

    def compute_outer_walls(self, a: int) -> shapely.Geometry:
        """Compute the outer walls of a room."""
        others = [o for i, o in enumerate(self.outlines) if i != a]
        near = [o for o in others if o.distance(self.outlines[a]) < 0.6]
        return self.outlines[a].exterior.difference(shapely.union_all(near).buffer(0.45, join_style="mitre"))

    def cut(self, line: shapely.Geometry, width: float, kind: str, at: float | None, **more: float | str) -> bool:
        """Cut an opening into the longest straight piece of a line; False where it is too short, or where an opening is
        already."""
        edges = split_straight(line)
        spare = self.wall / 2 + CORNER_MARGIN
        if not len(edges):
            return False
        start, end = max(edges, key=lambda e: float(np.hypot(*(e[1] - e[0]))))
        length = float(np.hypot(*(end - start)))
        if length < width + 2 * spare:
            return False
        along = (end - start) / length
        middle = self.rng.uniform(spare + width / 2, length - spare - width / 2) if at is None else at * length
        middle = min(max(middle, spare + width / 2), length - spare - width / 2)
        a, b = start + along * (middle - width / 2), start + along * (middle + width / 2)
        box = shapely.LineString([a, b]).buffer(0.1)
        if any(box.intersects(shapely.LineString([o.start, o.end])) for o in self.openings):
            return False
        self.openings.append(Opening(kind, round_point(a), round_point(b), self.wall, **more))  # type: ignore[arg-type]
        return True

    def add_windows(self, a: int, width: float, sill: float, every: float) -> None:
        """Add windows along the outer walls of a room, `every` so many metres."""
        for start, end in split_straight(self.compute_outer_walls(a)):
            length = float(np.hypot(*(end - start)))
            number = int((length - 0.5) // every) or int(length > width + 0.5)
            along = (end - start) / max(length, 1e-9)
            for middle in (np.arange(number) + 0.5) * length / max(number, 1):
                wide = min(width, length / number - 0.3)
                p, q = start + along * (middle - wide / 2), start + along * (middle + wide / 2)
                here = shapely.LineString([p, q]).buffer(0.2)
                if not any(here.intersects(shapely.LineString([o.start, o.end])) for o in self.openings):
                    self.openings.append(Opening("window", round_point(p), round_point(q), 0.3, sill))

    def glaze(self, a: int, b: int) -> None:
        """Make the wall between two rooms a glass one."""
        for start, end in split_straight(self.outlines[a].intersection(self.outlines[b])):
            along = (end - start) / np.hypot(*(end - start))
            inset = along * (self.wall / 2 + 0.1)
            if np.hypot(*(end - start)) > 1.0:
                self.walls.append(Wall(round_point(start + inset), round_point(end - inset), self.wall, glass=True))

    def build_plan(self, height: float, ceiling: float) -> Plan:
        """Build the finished plan."""
        return Plan(tuple(self.rooms), tuple(self.walls), tuple(self.openings), tuple(self.flights), None, height, ceiling)


def snap(outline: shapely.Geometry) -> shapely.Geometry:
    """Round to a millimetre, so that walls in common are the same numbers."""
    return shapely.set_precision(outline, 1e-3)


def round_point(p: Array) -> Point:
    """Round a point to a millimetre."""
    return round(float(p[0]), 3), round(float(p[1]), 3)


def split_straight(line: shapely.Geometry) -> list[Array]:
    """Return straight pieces (2, 2) of lines, collinear ones joined."""
    parts = [p for p in shapely.get_parts(line) if p.geom_type == "LineString"]
    if not parts:
        return []
    merged = shapely.line_merge(shapely.union_all(parts)).simplify(1e-4)
    out = []
    for piece in shapely.get_parts(merged):
        corners = shapely.get_coordinates(piece)
        out += [corners[i : i + 2] for i in range(len(corners) - 1)]
    return [e for e in out if np.hypot(*(e[1] - e[0])) > 0.2]
