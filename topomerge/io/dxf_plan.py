"""From lines of a plan to its walls and its floor: what is between two lines of a wall is wall, what is enclosed is floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from topomerge.types import Array

THICKEST_NARROW = 0.54  # m between two lines of a wall, at most, also where its ends are open
THICKEST_CLOSED = 0.8  # m, where it is closed and has no door
LEAST_NARROW = 0.05  # m2: smaller narrow places are corners of rooms
SMALLEST_ROOM = 0.7  # m2
MARGIN = 1.2  # m around all lines: more than half of the widest opening
NEAR = 1.0  # m from a room: what lies farther off is no wall of the building
SWING = (0.45, 1.6)  # m, radius of a door's arc
BESIDE = (0.05, 0.12, 0.2)  # m beyond the end of a gap, where a wall goes on
ERASED = 0.4  # m to either side of a gap: lines of the wall drawn through it, the threshold
LEAF_THICKNESS = 0.12  # m
SEAL = 0.15  # m by which a gap is closed beyond its ends while the page is flooded
GAPS = (0.0, 0.6, 1.2, 2.0)  # m: openings to the page without a door that are closed while it is flooded
ENCLOSED_SHARE = 0.5  # of what is enclosed with the widest of those closed
THINNEST_WINDOW = 0.6  # m: a block of a window that is thinner is filled
TOTAL_FILL = 60  # times the raster: area of all filled polygons together


@dataclass(frozen=True, eq=False)
class Line:
    """Points (n, 2) of a line, what it is ("wall", "window", "door" or ""), and its width.

    `filled`: the number of the polygon that it is an edge of, of which inner ones are holes; `block`: that of the block that it
    is part of; 0: of none.
    """

    points: Array
    kind: str
    width: float = 0.0
    filled: int = 0
    block: int = 0


@dataclass(frozen=True, eq=False)
class Swing:
    """The arc of a door: its hinge (2,), both ends (2, 2), and whether a layer or a block says that it is a door."""

    hinge: Array
    ends: Array
    named: bool

    @classmethod
    def find(cls, arc: Array, named: bool) -> Swing:
        """Find the hinge of an arc (n, 2): the middle of the circle through three of its points."""
        a, b, c = arc[0], arc[len(arc) // 2], arc[-1]
        matrix = 2 * np.stack([b - a, c - a])
        offset = np.array([((b - a) ** 2).sum(), ((c - a) ** 2).sum()])
        hinge = a + np.linalg.lstsq(matrix, offset, rcond=None)[0]
        return cls(hinge, np.stack([a, c]), named)


@dataclass(frozen=True, eq=False)
class PlanMasks:
    """(h, w) bool walls, floor and gaps of doors; x and y (m) of the lower left corner; what is doubtful."""

    occupied: Array
    free: Array
    door: Array
    corner: tuple[float, float]
    warnings: tuple[str, ...] = ()


class _LineRaster:
    """Pixels over all lines, first row at the top."""

    def __init__(self, lines: list[Line], pixel: float) -> None:
        points = np.concatenate([line.points for line in lines])
        low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
        columns, rows = (int(v) for v in np.ceil((high - low) / pixel))
        self.pixel, self.shape, self.corner = pixel, (rows, columns), (float(low[0]), float(low[1]))

    def place(self, points: Array) -> Array:
        """Return (n, 2) columns and rows of points (n, 2)."""
        places = (points - self.corner) / self.pixel
        return np.stack([places[:, 0], self.shape[0] - places[:, 1]], axis=1)

    def draw(self, lines: list[tuple[Array, float]]) -> Array:
        """Return (h, w) bool: lines (n, 2) of a width (m)."""
        from PIL import Image, ImageDraw

        image = Image.new("1", self.shape[::-1])
        pen = ImageDraw.Draw(image)
        for points, width in lines:
            pen.line([tuple(p) for p in self.place(points).tolist()], 1, max(round(width / self.pixel), 1))
        return np.array(image)

    def fill(self, mask: Array, polygons: list[Array], value: bool = True) -> int:
        """Fill polygons, one in another a hole; return the pixels of their box."""
        from PIL import Image, ImageDraw

        places = [self.place(p) for p in polygons]
        places = [p for p in places if len(p) >= 3]
        if not places:
            return 0
        low = np.maximum(np.floor(np.concatenate(places).min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(np.concatenate(places).max(axis=0)).astype(int) + 1, self.shape[::-1])
        part = np.zeros((high[1] - low[1], high[0] - low[0]), bool)
        for polygon in places:
            image = Image.new("L", part.shape[::-1])
            ImageDraw.Draw(image).polygon([tuple(p) for p in (polygon - low).tolist()], 1, 1)
            part ^= np.asarray(image) > 0
        mask[low[1] : high[1], low[0] : high[0]][part] = value
        return part.size

    def sample(self, mask: Array, points: Array) -> Array:
        """Return (n,) values of a mask at points (n, 2), those outside False."""
        places = np.floor(self.place(points)).astype(int)
        inside = ((places >= 0) & (places < self.shape[::-1])).all(axis=1)
        out = np.zeros(len(points), bool)
        out[inside] = mask[places[inside, 1], places[inside, 0]] > 0
        return out


def build_plan_masks(lines: list[Line], swings: list[Swing], pixel: float) -> PlanMasks:
    """Build the walls and the floor of a plan.

    Args:
        lines: in m; those of doors are no walls.
        swings: arcs of doors, in m.
        pixel: m.
    """
    raster = _LineRaster(lines, pixel)
    swings = [s for s in swings if SWING[0] <= np.linalg.norm(s.ends[0] - s.hinge) <= SWING[1]]
    is_leaf = [line.kind == "door" or is_door_leaf(line, swings) for line in lines]
    leaves, walls = ([line for line, leaf in zip(lines, is_leaf, strict=True) if leaf is side] for side in (True, False))
    drawn = raster.draw([(line.points, line.width) for line in walls])
    polygons: dict[int, list[Array]] = {}
    for line in walls:
        if line.filled:
            polygons.setdefault(line.filled, []).append(line.points)
    left = TOTAL_FILL * drawn.size
    for polygon in (*polygons.values(), *([hull] for hull in _find_window_hulls(walls))):
        left -= raster.fill(drawn, polygon) if left > 0 else 0
    occupied = _fill_narrow(drawn, pixel)
    gaps = find_gaps(raster, occupied, swings, leaves)
    for gap in gaps:
        _erase_gap(raster, occupied, gap)
    return _fill_floor(raster, occupied, raster.draw([(_lengthen(gap, SEAL), 2 * pixel) for gap in gaps]))


def is_door_leaf(line: Line, swings: list[Swing]) -> bool:
    """Return whether a line, or a thin rectangle, is the leaf of a door that no name tells: from a hinge to an end of an arc."""
    if line.kind == "window" or line.filled or len(line.points) > 5 or not swings:
        return False
    hinges, ends = np.stack([s.hinge for s in swings]), np.stack([s.ends for s in swings])
    radius = np.linalg.norm(ends[:, 0] - hinges, axis=1)
    length = np.linalg.norm(line.points[:, None] - line.points, axis=2).max()
    at_hinge = np.linalg.norm(line.points[:, None] - hinges, axis=2).min(axis=0) < LEAF_THICKNESS
    at_end = np.linalg.norm(line.points[:, None, None] - ends, axis=3).min(axis=(0, 2)) < LEAF_THICKNESS
    return bool((at_hinge & at_end & (length >= 0.9 * radius) & (length <= 1.2 * radius)).any())


def _find_window_hulls(lines: list[Line]) -> list[Array]:
    """Return the hulls of blocks of windows that are as thin as a wall."""
    from shapely import MultiPoint

    parts: dict[int, list[Array]] = {}
    for line in lines:
        if line.kind == "window" and line.block:
            parts.setdefault(line.block, []).append(line.points)
    hulls = []
    for points in parts.values():
        box = MultiPoint(np.concatenate(points)).minimum_rotated_rectangle
        if box.geom_type == "Polygon":
            corners = np.array(box.exterior.coords)
            if np.linalg.norm(np.diff(corners[:3], axis=0), axis=1).min() <= THINNEST_WINDOW:
                hulls.append(corners)
    return hulls


def _fill_narrow(drawn: Array, pixel: float) -> Array:
    """Return the walls with what is between their lines: where no disc of the thickest wall fits."""
    radius = THICKEST_NARROW / 2 / pixel
    core = ndimage.distance_transform_edt(~drawn) > radius
    reached = ndimage.distance_transform_edt(~core) <= radius + 1.5
    label, count = ndimage.label(~(drawn | reached))
    size = np.bincount(label.ravel(), minlength=count + 1) * pixel**2
    size[0] = 0.0
    return drawn | (size >= LEAST_NARROW)[label]


def find_gaps(raster: _LineRaster, occupied: Array, swings: list[Swing], leaves: list[Line]) -> list[Array]:
    """Find the (2, 2) ends of the gap of each door: of its arc, else of its block."""
    gaps = []
    boxes = np.array([[*line.points.min(axis=0), *line.points.max(axis=0)] for line in leaves]).reshape(-1, 4)
    for swing in swings:
        near = ((boxes[:, :2] <= swing.hinge + LEAF_THICKNESS) & (boxes[:, 2:] >= swing.hinge - LEAF_THICKNESS)).all(axis=1)
        scores = []
        for end in swing.ends:
            leaf = any(_runs_along(leaves[k].points, swing.hinge, end) for k in np.flatnonzero(near))
            scores.append(_score_gap(raster, occupied, np.stack([swing.hinge, end])) - leaf)
        best = int(np.argmax(scores))
        if swing.named or scores[best] >= 1:
            gaps.append(np.stack([swing.hinge, swing.ends[best]]))
    blocks: dict[int, list[Array]] = {}
    for line in leaves:
        if line.block:
            blocks.setdefault(line.block, []).append(line.points)
    hinges = np.array([s.hinge for s in swings]).reshape(-1, 2)
    for parts in blocks.values():
        points = np.concatenate(parts)
        low, high = points.min(axis=0) - 0.2, points.max(axis=0) + 0.2
        if not ((low <= hinges) & (hinges <= high)).all(axis=1).any():
            gaps += _find_block_gap(raster, occupied, points)
    return gaps


def _runs_along(points: Array, start: Array, end: Array) -> bool:
    """Return whether a line has a point near each end of another."""
    away = [float(np.linalg.norm(points - place, axis=1).min()) for place in (start, end)]
    return max(away) < LEAF_THICKNESS


def _score_gap(raster: _LineRaster, occupied: Array, ends: Array) -> float:
    """Count the ends (2, 2) beyond which a wall goes on."""
    along = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    score = 0.0
    for end, sign in zip(ends, (-1, 1), strict=True):
        score += raster.sample(occupied, end + sign * along * np.array(BESIDE)[:, None]).mean()
    return score


def _find_block_gap(raster: _LineRaster, occupied: Array, points: Array) -> list[Array]:
    """Return the gap of a door without an arc: the line across its box whose ends meet walls; none where no line's do."""
    from shapely import MultiPoint

    box = MultiPoint(points).minimum_rotated_rectangle
    if box.geom_type != "Polygon":
        chords = [np.array(box.coords)[[0, -1]]]
    else:
        a, b, c, d = np.array(box.exterior.coords)[:4]
        chords = [
            np.stack(pair) for pair in ((a, b), (b, c), (c, d), (d, a), ((a + d) / 2, (b + c) / 2), ((a + b) / 2, (c + d) / 2))
        ]
    chords = [chord for chord in chords if SWING[0] <= np.linalg.norm(chord[1] - chord[0]) <= 4 * SWING[1]]
    scores = [_score_gap(raster, occupied, chord) + 0.01 * float(np.linalg.norm(chord[1] - chord[0])) for chord in chords]
    return [chords[int(np.argmax(scores))]] if scores and max(scores) >= 0.9 else []


def _lengthen(ends: Array, length: float) -> Array:
    """Return (2, 2) ends that lie so much farther out, m."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return ends + np.stack([-along, along]) * length


def _erase_gap(raster: _LineRaster, occupied: Array, ends: Array) -> None:
    """Erase what is drawn across a gap."""
    inner = _lengthen(ends, -2 * raster.pixel)
    along = (inner[1] - inner[0]) / np.linalg.norm(inner[1] - inner[0])
    aside = np.array([-along[1], along[0]]) * ERASED
    raster.fill(occupied, [np.stack([inner[0] - aside, inner[1] - aside, inner[1] + aside, inner[0] + aside])], False)


def _fill_floor(raster: _LineRaster, occupied: Array, seals: Array) -> PlanMasks:
    """Fill the floor: all that the page's border can't reach, but for parts as thin as a wall that have no door."""
    pixel = raster.pixel
    closed = occupied | seals
    distance = ndimage.distance_transform_edt(~closed)
    inside = [_find_inside(closed, distance, gap / 2 / pixel) for gap in GAPS]
    least = ENCLOSED_SHARE * inside[-1].sum()
    chosen = next(k for k, mask in enumerate(inside) if mask.sum() >= least)
    label, count = ndimage.label(inside[chosen] & ~closed)
    numbers = np.arange(count + 1)
    depth = ndimage.maximum(distance, label, numbers) if count else np.zeros(1)
    at_door = np.unique(label[ndimage.binary_dilation(seals, np.ones((3, 3)), 2)])
    thin = (np.asarray(depth) * pixel * 2 <= THICKEST_CLOSED) & ~np.isin(numbers, at_door)
    thin[0] = False
    occupied = occupied | thin[label]
    free = (inside[chosen] | seals) & ~occupied
    label, count = ndimage.label(free)
    size = np.bincount(label.ravel(), minlength=count + 1) * pixel**2
    size[0] = 0.0
    free = (size >= SMALLEST_ROOM)[label]
    occupied &= ndimage.distance_transform_edt(~free) * pixel <= NEAR if free.any() else True
    warnings = (f"its outer walls are open; openings up to {GAPS[chosen]:g} m were taken for closed",) if chosen else ()
    return PlanMasks(occupied, free, free & seals, raster.corner, warnings)


def _find_inside(closed: Array, distance: Array, radius: float) -> Array:
    """Find the pixels that a disc of a radius (px) does not reach from the border; `distance` is to the nearest closed one."""
    label, _ = ndimage.label(distance > radius)
    outside = label == label[0, 0]
    if radius > 0:
        outside = (ndimage.distance_transform_edt(~outside) <= radius + 1) & ~closed
    return ~(outside | closed)
