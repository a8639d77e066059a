"""Furniture: what it is made of, which rooms hold it, where it stands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from topomerge.datasets.core.solids import build_rotation

from topomerge.types import Array


@dataclass(frozen=True, eq=False)
class Item:
    """A thing at its place: boxes (n, 6) about `at` on the floor, turned by `yaw`; `size` of the box around them."""

    kind: str
    parts: Array
    at: Array  # (2,) middle of its footprint
    yaw: float
    size: tuple[float, float, float]
    movable: bool = True
    label: str = "furniture"

    @property
    def outline(self) -> shapely.Polygon:
        """Its footprint."""
        return shapely.Polygon(compute_footprints(self.at[None], np.array([self.yaw]), self.size)[0])


def _make_table(w: float, d: float, h: float = 0.74) -> list[list[float]]:
    legs = [[x * (w / 2 - 0.05), y * (d / 2 - 0.05), h / 2, 0.05, 0.05, h] for x in (-1, 1) for y in (-1, 1)]
    return [[0, 0, h - 0.015, w, d, 0.03], *legs]


def _make_pile(w: float, d: float, h: float, g: np.random.Generator, most: int = 4) -> list[list[float]]:
    """Draw the things that lie on a top: papers, boxes, bags."""
    number = int(g.integers(most + 1))
    sizes = g.uniform([0.1, 0.1, 0.03], [0.35, 0.3, 0.35], (number, 3))
    sizes[:, 2] *= g.uniform(0.2, 1.0, number)
    at = g.uniform(-0.5, 0.5, (number, 2)) * np.maximum([w - 0.35, d - 0.3], 0.0)
    return [[x, y, h + s[2] / 2, *s] for (x, y), s in zip(at.tolist(), sizes.tolist(), strict=True)]


def _make_chair(x: float = 0.0, y: float = 0.0, back: float = -1.0) -> list[list[float]]:
    return [
        [x, y, 0.44, 0.45, 0.45, 0.06],
        [x, y + back * 0.21, 0.7, 0.42, 0.04, 0.45],
        *_make_legs(x, y, 0.18, 0.18, 0.21, 0.04, 0.42),
    ]


def _make_legs(x: float, y: float, dx: float, dy: float, z: float, side: float, h: float) -> list[list[float]]:
    return [[x + i * dx, y + j * dy, z, side, side, h] for i in (-1, 1) for j in (-1, 1)]


def _make_shelf(w: float, d: float, h: float, g: np.random.Generator) -> list[list[float]]:
    boards = [[0, 0, z, w, d, 0.03] for z in np.linspace(0.05, h - 0.02, max(2, round(h / 0.4)))]
    levels = np.linspace(0.05, h - 0.02, max(2, round(h / 0.4)))[:-1]
    full = g.uniform(0, 0.95, len(levels)) * w  # rows of books begin at the left
    books = [[f / 2 - w / 2, 0.03, z + 0.14, f, d * 0.6, 0.25] for z, f in zip(levels, full, strict=True) if f > 0.1]
    return [
        [0, d / 2 - 0.01, h / 2, w, 0.02, h],
        [-w / 2, 0, h / 2, 0.03, d, h],
        [w / 2, 0, h / 2, 0.03, d, h],
        *boards,
        *books,
    ]


def _make_bed(w: float, d: float = 2.05) -> list[list[float]]:
    return [[0, 0, 0.3, w, d, 0.3], [0, d / 2 - 0.03, 0.5, w, 0.06, 1.0], [0, d / 2 - 0.35, 0.5, w * 0.8, 0.4, 0.12]]


def _make_sofa(w: float, d: float = 0.9) -> list[list[float]]:
    arms = [[s * (w / 2 - 0.09), 0, 0.3, 0.18, d, 0.6] for s in (-1, 1)]
    return [[0, 0, 0.21, w, d, 0.42], [0, d / 2 - 0.1, 0.55, w, 0.2, 0.6], *arms]


def _make_desk(w: float, d: float, g: np.random.Generator) -> list[list[float]]:
    """Make a desk with a screen, a chair and what lies on it; the chair's side is y < 0, anywhere between pushed in and pulled
    out."""
    y = 0.35
    shift = [[b[0], b[1] + y, *b[2:]] for b in [*_make_table(w, d), *_make_pile(w, d, 0.74, g)]]
    x, out = float(g.normal(0, 0.12)), float(g.uniform(-0.1, 0.35))
    return [
        *shift,
        [0, y + 0.2, 1.0, 0.55, 0.04, 0.33],
        [0, y + 0.2, 0.8, 0.2, 0.15, 0.12],
        *_make_chair(x, y - d / 2 - out),
    ]


def _make_dining_table(w: float, d: float, g: np.random.Generator) -> list[list[float]]:
    """Make a table with chairs on both sides; one in eight is missing."""
    xs = np.arange(int(w / 0.65)) * 0.65
    xs = xs - xs.mean()
    seats = [(float(x + g.normal(0, 0.05)), s, float(g.uniform(0.0, 0.3))) for x in xs for s in (-1.0, 1.0) if g.random() < 0.88]
    return [
        *_make_table(w, d),
        *_make_pile(w, d, 0.74, g),
        *(b for x, s, out in seats for b in _make_chair(x, s * (d / 2 + out), s)),
    ]


def _make_counter(w: float, g: np.random.Generator, d: float = 0.6) -> list[list[float]]:
    """Make a kitchen run with cupboards above and a tall fridge."""
    cupboard = [w * 0.1, d / 2 - 0.17, 1.75, w * 0.75, 0.34, 0.65]
    return [[0, 0, 0.45, w, d, 0.9], *_make_pile(w, d, 0.9, g), cupboard, [-w / 2 + 0.3, 0, 0.95, 0.6, d, 1.9]]


def _make_toilet() -> list[list[float]]:
    return [[0, -0.05, 0.2, 0.37, 0.5, 0.4], [0, 0.22, 0.6, 0.4, 0.18, 0.4]]


def _make_bench(w: float, d: float, g: np.random.Generator) -> list[list[float]]:
    """Make a laboratory island: drawers, a worktop and a rack of shelves along its middle."""
    return [
        [0, 0, 0.42, w * 0.95, d * 0.8, 0.84],
        [0, 0, 0.89, w, d, 0.06],
        [0, 0, 1.35, w * 0.9, 0.3, 0.03],
        [0, 0, 1.2, 0.05, 0.3, 0.6],
        *_make_pile(w, d, 0.92, g, 8),
    ]


def _make_school_desk(w: float, g: np.random.Generator) -> list[list[float]]:
    """Make a school desk for two with two chairs."""
    back = [b for x in (-w / 4, w / 4) for b in _make_chair(x, -float(g.uniform(0.3, 0.6)))]
    return [*_make_table(w, 0.5, 0.72), *back]


Make = Callable[[np.random.Generator], list[list[float]]]
ITEMS: dict[str, Make] = {
    "desk": lambda g: _make_desk(g.choice([1.2, 1.4, 1.6]), 0.8, g),
    "shelf": lambda g: _make_shelf(g.choice([0.8, 1.0, 1.6]), 0.35, g.choice([1.2, 1.9, 2.1]), g),
    "cabinet": lambda g: [[0, 0, (h := g.uniform(0.8, 1.5)) / 2, g.choice([0.8, 1.2]), 0.45, h]],
    "wardrobe": lambda g: [[0, 0, 1.05, g.choice([1.0, 1.5, 2.0]), 0.6, 2.1]],
    "bed": lambda g: _make_bed(g.choice([0.9, 1.4, 1.6])),
    "hospitalbed": lambda g: _make_bed(0.95, 2.15),
    "nightstand": lambda g: [[0, 0, 0.27, 0.45, 0.4, 0.54]],
    "sofa": lambda g: _make_sofa(g.choice([1.5, 1.9, 2.3])),
    "lowtable": lambda g: _make_table(1.0, 0.6, 0.4),
    "armchair": lambda g: _make_sofa(0.9, 0.85),
    "dining": lambda g: _make_dining_table(g.choice([1.4, 1.8]), 0.85, g),
    "meeting": lambda g: _make_dining_table(g.choice([2.4, 3.2]), 1.1, g),
    "kitchen": lambda g: _make_counter(g.choice([1.8, 2.4, 3.0]), g),
    "tv": lambda g: [[0, 0, 0.25, 1.5, 0.4, 0.5], [0, 0.05, 0.85, 1.1, 0.06, 0.65]],
    "toilet": lambda g: _make_toilet(),
    "sink": lambda g: [[0, 0, 0.8, 0.55, 0.45, 0.16], [0, 0.1, 0.36, 0.18, 0.2, 0.72], [0, 0.21, 1.5, 0.5, 0.03, 0.7]],
    "shower": lambda g: [[0, 0, 0.04, 0.9, 0.9, 0.08], [0, 0.42, 1.1, 0.05, 0.05, 2.0]],
    "bath": lambda g: [[0, 0, 0.28, 1.7, 0.75, 0.56]],
    "bench": lambda g: _make_bench(g.choice([1.8, 2.4, 3.0]), g.choice([0.8, 1.4]), g),
    "hood": lambda g: [[0, 0, 0.45, 1.5, 0.8, 0.9], [0, 0.3, 1.6, 1.5, 0.2, 1.4], [0, 0, 2.25, 1.5, 0.8, 0.3]],
    "seat": lambda g: _make_school_desk(1.3, g),
    "board": lambda g: [[0, 0, 1.5, g.choice([1.8, 2.4, 3.6]), 0.05, 1.2]],
    "locker": lambda g: [[0, 0, 0.9, g.choice([0.9, 1.8, 2.7]), 0.4, 1.8]],
    "printer": lambda g: [[0, 0, 0.55, 0.65, 0.6, 1.1]],
    "sidebench": lambda g: [
        [0, 0, 0.43, 1.5, 0.4, 0.05],
        [-0.6, 0, 0.2, 0.05, 0.35, 0.4],
        [0.6, 0, 0.2, 0.05, 0.35, 0.4],
    ],
    "plant": lambda g: [
        [0, 0, 0.2, 0.35, 0.35, 0.4],
        [0, 0, 0.9, 0.5, 0.5, (h := g.uniform(0.6, 1.2))],
        [0, 0, 0.7, 0.06, 0.06, h],
    ],
    "rack": lambda g: _make_shelf(1.2, 0.6, 2.1, g),
    "trolley": lambda g: [[0, 0, 0.5, 0.8, 0.5, 0.9]],
    "radiator": lambda g: [[0, 0, 0.45, g.choice([0.8, 1.2]), 0.1, 0.6]],
    "partition": lambda g: [[0, 0, 0.75, 1.6, 0.05, 1.5]],
    "counterdesk": lambda g: [[0, 0, 0.55, 2.2, 0.7, 1.1], [0, 0.6, 0.72, 2.0, 0.5, 0.04]],
    "clutter": lambda g: [[0, 0, (h := g.uniform(0.12, 0.6)) / 2, g.uniform(0.15, 0.5), g.uniform(0.15, 0.5), h]],
    "person": lambda g: [[0, 0, 0.42, 0.32, 0.24, 0.84], [0, 0, 1.15, 0.44, 0.26, 0.66], [0, 0, 1.6, 0.2, 0.22, 0.26]],
}
FIXED = {"kitchen", "toilet", "sink", "shower", "bath", "bench", "hood", "board", "radiator", "counterdesk"}
# kind of room -> (item, where, number, m2 for each further one: 0 none). "rows" fill the room's middle.
BY_WALL, IN_MIDDLE, IN_ROWS = "wall", "middle", "rows"
FURNITURE_OF: dict[str, list[tuple[str, str, int, float]]] = {
    "office": [
        ("desk", BY_WALL, 1, 9), ("shelf", BY_WALL, 1, 14), ("cabinet", BY_WALL, 1, 16),
        ("radiator", BY_WALL, 1, 0), ("plant", BY_WALL, 0, 25),
    ],
    "openplan": [
        ("desk", IN_ROWS, 4, 7), ("cabinet", BY_WALL, 2, 25),
        ("partition", IN_MIDDLE, 1, 40), ("plant", BY_WALL, 1, 40),
    ],
    "meeting": [("meeting", IN_MIDDLE, 1, 60), ("board", BY_WALL, 1, 0), ("cabinet", BY_WALL, 0, 30)],
    "corridor": [
        ("cabinet", BY_WALL, 0, 40), ("plant", BY_WALL, 0, 60),
        ("sidebench", BY_WALL, 0, 60), ("printer", BY_WALL, 0, 70),
    ],
    "lobby": [
        ("counterdesk", IN_MIDDLE, 1, 0), ("sofa", BY_WALL, 1, 40),
        ("lowtable", IN_MIDDLE, 1, 60), ("plant", BY_WALL, 1, 30),
    ],
    "atrium": [
        ("sofa", IN_MIDDLE, 1, 60), ("lowtable", IN_MIDDLE, 1, 60),
        ("plant", BY_WALL, 2, 40), ("dining", IN_MIDDLE, 0, 60),
    ],
    "lounge": [("sofa", IN_MIDDLE, 1, 30), ("lowtable", IN_MIDDLE, 1, 40), ("plant", BY_WALL, 1, 30), ("shelf", BY_WALL, 0, 30)],
    "kitchen": [("kitchen", BY_WALL, 1, 0), ("dining", IN_MIDDLE, 1, 0), ("cabinet", BY_WALL, 0, 15)],
    "living": [
        ("sofa", BY_WALL, 1, 25), ("lowtable", IN_MIDDLE, 1, 0), ("tv", BY_WALL, 1, 0), ("shelf", BY_WALL, 1, 12),
        ("dining", IN_MIDDLE, 0, 22), ("armchair", IN_MIDDLE, 0, 15), ("plant", BY_WALL, 1, 0),
    ],
    "bedroom": [("bed", BY_WALL, 1, 0), ("wardrobe", BY_WALL, 1, 18), ("nightstand", BY_WALL, 1, 0), ("desk", BY_WALL, 0, 14)],
    "hotel": [
        ("bed", BY_WALL, 1, 0), ("wardrobe", BY_WALL, 1, 0), ("nightstand", BY_WALL, 1, 0),
        ("tv", BY_WALL, 1, 0), ("armchair", BY_WALL, 0, 20),
    ],
    "ward": [
        ("hospitalbed", BY_WALL, 1, 11), ("nightstand", BY_WALL, 1, 11),
        ("wardrobe", BY_WALL, 1, 30), ("trolley", BY_WALL, 0, 20),
    ],
    "bath": [("toilet", BY_WALL, 1, 0), ("sink", BY_WALL, 1, 0), ("shower", BY_WALL, 1, 0), ("bath", BY_WALL, 0, 6)],
    "toilets": [("toilet", BY_WALL, 1, 5), ("sink", BY_WALL, 1, 7)],
    "classroom": [
        ("board", BY_WALL, 1, 0), ("seat", IN_ROWS, 6, 4.5), ("desk", IN_MIDDLE, 1, 0),
        ("shelf", BY_WALL, 1, 40), ("cabinet", BY_WALL, 1, 40),
    ],
    "hall": [("sidebench", BY_WALL, 2, 50), ("seat", IN_ROWS, 0, 60), ("cabinet", BY_WALL, 1, 80)],
    "canteen": [("dining", IN_ROWS, 3, 12), ("counterdesk", BY_WALL, 1, 0)],
    "lab": [
        ("bench", IN_ROWS, 1, 16), ("hood", BY_WALL, 1, 30), ("shelf", BY_WALL, 1, 20),
        ("desk", BY_WALL, 0, 25), ("cabinet", BY_WALL, 1, 25),
    ],
    "storage": [("rack", BY_WALL, 2, 5), ("clutter", IN_MIDDLE, 1, 5)],
    "nurses": [
        ("counterdesk", IN_MIDDLE, 1, 0), ("desk", BY_WALL, 1, 12),
        ("shelf", BY_WALL, 1, 10), ("trolley", BY_WALL, 1, 12),
    ],
    "library": [("shelf", IN_ROWS, 4, 6), ("desk", BY_WALL, 1, 25), ("dining", IN_MIDDLE, 0, 40)],
    "cloakroom": [("locker", BY_WALL, 2, 6), ("sidebench", IN_MIDDLE, 1, 12)],
}  # fmt: skip


def compute_footprints(at: Array, yaw: Array, size: Sequence[float]) -> Array:
    """Compute (n, 4, 2) corners of rectangles of one size at (n, 2) places, turned by (n,) radians."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size[:2]) / 2
    turn = np.moveaxis(build_rotation(np.asarray(yaw)), 2, 0)
    return corners @ turn + np.asarray(at)[:, None]


def make_item(kind: str, rng: np.random.Generator) -> Item:
    """Make an item at the origin, its back towards +y, centred on its footprint."""
    parts = np.array(ITEMS[kind](rng), float)
    low, high = (parts[:, :3] - parts[:, 3:] / 2).min(axis=0), (parts[:, :3] + parts[:, 3:] / 2).max(axis=0)
    parts[:, :2] -= (low + high)[:2] / 2
    size = (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2]))
    label = kind if kind in ("clutter", "person") else "furniture"
    return Item(kind, parts, np.zeros(2), 0.0, size, kind not in FIXED, label)


PLACES_TRIED = 10
ROW_SHIFT, ASKEW, ROW_GAPS = (
    0.06,
    0.03,
    0.08,
)  # m and rad (standard deviations) and share by which rows of furniture are irregular
HALF_BODY = 0.28  # m, half of what a person needs to pass
ANYHOW = ("clutter", "person", "armchair", "plant")  # stand at any angle
UNFURNISHED = ("stairs", "lift", "void")


@dataclass(eq=False)
class FurnishedFloor:
    """A room while it is being furnished: its outline (counter-clockwise), what is taken, and its clear height in metres."""

    shape: shapely.Polygon
    taken: list[shapely.Polygon]
    rng: np.random.Generator
    height: float = 2.5

    def __post_init__(self) -> None:
        shapely.prepare(self.shape)
        ring = np.asarray(self.shape.exterior.coords)
        self.corners, steps = ring[:-1], np.diff(ring, axis=0)
        self.lengths = np.hypot(steps[:, 0], steps[:, 1])
        self.along = steps / self.lengths[:, None]

    def put(self, item: Item, where: str) -> Item | None:
        """Put the item at a place that is free and return it, or None when none was found."""
        at, yaw = self._sample_by_wall(item) if where == BY_WALL else self._sample_in_middle(item)
        yaw = yaw + self._sample_misalignment(item)
        free = np.flatnonzero(self.is_fitting(at, yaw, item))
        return self._add_item(item, at[free[0]], float(yaw[free[0]])) if len(free) else None

    def _sample_misalignment(self, item: Item) -> float:
        """Sample the angle, rad, by which a thing is not parallel to the walls; what is fitted stands straight."""
        return float(self.rng.normal(0, ASKEW)) if item.movable else 0.0

    def is_fitting(self, at: Array, yaw: Array, item: Item) -> Array:
        """Return (n,) bool, whether the item lies within the room and clear of everything, at each place."""
        outlines = shapely.polygons(compute_footprints(at, yaw, item.size))
        inside = shapely.contains(self.shape, outlines)
        if self.taken:
            inside[inside] = ~shapely.intersects(outlines[inside][:, None], self.taken).any(axis=1)
        return inside

    def _add_item(self, item: Item, at: Array, yaw: float) -> Item:
        item = replace(item, at=at, yaw=yaw)
        self.taken.append(item.outline.buffer(0.02, join_style="mitre"))
        return item

    def _sample_by_wall(self, item: Item) -> tuple[Array, Array]:
        """Sample places with the back to a wall; half of them in corners, as people put things."""
        width, depth = item.size[:2]
        weight = np.maximum(self.lengths - width, 0) + 1e-9
        wall = self.rng.choice(len(weight), PLACES_TRIED, p=weight / weight.sum())
        along, spare = self.along[wall], np.maximum(self.lengths[wall] - width, 0.0)
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
        free = self.rng.uniform(0, 1, PLACES_TRIED) * spare
        corner = np.where(self.rng.random(PLACES_TRIED) < 0.5, 0.04, spare - 0.04)
        offset = np.where(self.rng.random(PLACES_TRIED) < 0.5, corner, free) + width / 2
        gap = 0.05 + self.rng.exponential(0.03, PLACES_TRIED) if item.movable else np.full(PLACES_TRIED, 0.03)
        at = self.corners[wall] + along * offset[:, None] + inward * (depth / 2 + gap)[:, None]
        return at, np.arctan2(-inward[:, 1], -inward[:, 0]) - np.pi / 2

    def _sample_in_middle(self, item: Item) -> tuple[Array, Array]:
        low, high = np.array(self.shape.bounds).reshape(2, 2)
        turn = self.rng.uniform(0, 4, PLACES_TRIED) if item.kind in ANYHOW else self.rng.integers(4, size=PLACES_TRIED)
        return self.rng.uniform(low, high, (PLACES_TRIED, 2)), self.compute_bearing() + turn * np.pi / 2

    def compute_bearing(self) -> float:
        """Compute the direction, rad, of the longest wall."""
        x, y = self.along[np.argmax(self.lengths)]
        return float(np.arctan2(y, x))

    def add_rows(self, kind: str, count: int) -> list[Item]:
        """Add up to `count` items of one make on a grid in the room's middle, with aisles."""
        item, yaw = make_item(kind, self.rng), self.compute_bearing()
        turned = self.corners @ build_rotation(-yaw)
        low, high = turned.min(axis=0) + 0.7, turned.max(axis=0) - 0.7
        size, aisle = np.array(item.size[:2]), self.rng.uniform(0.5, 0.9, 2)
        xs, ys = (np.arange(low[k] + size[k] / 2, high[k] - size[k] / 2 + 1e-6, size[k] + aisle[k]) for k in (0, 1))
        spots = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2) @ build_rotation(yaw)
        spots = spots + self.rng.normal(0, ROW_SHIFT, spots.shape)
        yaws = yaw + self.rng.normal(0, ASKEW, len(spots))
        free = self.is_fitting(spots, yaws, item) & (self.rng.random(len(spots)) > ROW_GAPS) if len(spots) else np.zeros(0, bool)
        return [self._add_item(item, spot, float(y)) for spot, y in zip(spots[free][:count], yaws[free][:count], strict=True)]


def furnish(floor: FurnishedFloor, kind: str, density: float, clutter: float, doors: Array) -> list[Item]:
    """Place things in a room of a kind.

    Args:
        floor: the room, with what is taken already (door swings, stairs, columns).
        kind: of the room; an unknown one gets the furniture of an office.
        density: 1 is usual.
        clutter: things on the floor of 10 m2.
        doors: (d, 2) where the doors are; all must stay reachable from each other.
    """
    if kind in UNFURNISHED:
        return []
    area, rng = floor.shape.area, floor.rng
    out: list[Item | None] = []
    for name, where, least, every in FURNITURE_OF.get(kind, FURNITURE_OF["office"]):
        count = (least + (area / every if every else 0.0)) * density
        number = int(count) + int(rng.random() < count % 1)
        if where == IN_ROWS:
            out += floor.add_rows(name, number)
        else:
            out += [floor.put(make_item(name, rng), where) for _ in range(number)]
    strewn = int(rng.poisson(clutter * area / 10))
    out += [floor.put(make_item("clutter", rng), IN_MIDDLE) for _ in range(strewn)]
    items = [item for item in out if item is not None and item.size[2] < floor.height]
    while items and not is_passable(floor.shape, items, doors):
        items = items[: len(items) * 2 // 3]
    return items


def is_passable(shape: shapely.Polygon, items: list[Item], doors: Array) -> bool:
    """Return whether a person gets from every door to every other one, and some way into the room."""
    if not len(doors):
        return True
    standing = [compute_footprints(i.at[None], np.array([i.yaw]), i.size) for i in items if i.kind != "board"]
    blocked = shapely.union_all(shapely.polygons(np.concatenate(standing)) if standing else []).buffer(HALF_BODY, 2)
    parts = shapely.get_parts(shape.buffer(0.1, 2).buffer(-0.1 - HALF_BODY * 0.9, 2).difference(blocked))
    near = shapely.distance(parts[:, None], shapely.points(doors)[None]) < 0.45
    return bool((near.all(axis=1) & (shapely.area(parts) > 0.15 * shape.area * (shape.area > 8))).any())
