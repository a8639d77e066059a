"""Walls and furniture that stand in one map on ground that the other map saw empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from scipy import ndimage

from topomerge.changes.layers import CHANGE_CELL, MOST_SLACK, MapLayer, StoreyLayers, list_runs
from topomerge.structure.lines import Line, detect_lines
from topomerge.types import Array

PIXEL_WEIGHT = CHANGE_CELL / 3  # m of wall that a pixel stands for: a face is two to four pixels thick
GROUP_REACH = 0.2  # m: changed pixels that near are looked at together
PARALLEL = np.cos(np.radians(8.0))
ONE_WALL = 0.45  # m between the faces of one wall, at most
LEAST_WALL = 0.7  # m
SUPPORT_BIN = 0.1  # m along a wall
DOOR_GAP = 1.3  # m: a wider gap parts two walls
# Fitted on the candidates of 24 pairs of sessions of training seeds (`evaluation.changes`, data=dev).
WALL_ODDS = {"bias": -20.3, "length": 1.6, "clear": 8.4, "tall": 2.9, "margin": 0.6, "apart": 1.1, "entered": 7.5}
LEAST_THING = 0.12  # m2
THING_ODDS = {
    "bias": -2.6,
    "area": 1.9,
    "margin": -0.2,
    "solid": 6.4,
    "thick": -0.1,
    "entered": 3.0,
    "ring": -1.4,
    "height": -0.7,
}
BESIDE_WALL = 0.12  # m beside a wall, whose noise is no furniture
LEAF_THICKNESS = 0.3  # m: what stands thinner than that beside a door may be its leaf
WHOLE = 0.75  # share of a wall that was seen to stand, where no door is in it
LEAF_REACH = 0.35  # m beyond the width of its door
NUDGED, SAME_SIZE, CARRIED = 0.6, 0.55, 8.0  # m, ratio of areas, m: furniture that was moved a little, or across its room


@dataclass(frozen=True, eq=False)
class WallChange:
    """A wall that is new or gone.

    Args:
        kind: "wall new" or "wall gone".
        outline: (4, 2) m from above.
        length: m.
        probability: 0..1.
        evidence: see `WALL_ODDS`.
    """

    kind: str
    outline: Array
    length: float
    probability: float
    evidence: dict[str, float]

    @property
    def ends(self) -> Array:
        """(2, 2) m of its middle line."""
        o = self.outline
        return np.array([(o[0] + o[3]) / 2, (o[1] + o[2]) / 2])


@dataclass(frozen=True, eq=False)
class ThingChange:
    """Furniture that is new, gone or moved; `start` (2,) m is where moved furniture stood."""

    kind: str
    outline: Array
    length: float
    probability: float
    evidence: dict[str, float] = field(default_factory=dict)
    room: int = -1
    area: float = 0.0
    start: Array | None = None


def compute_probability(odds: dict[str, float], evidence: dict[str, float]) -> float:
    """Compute the probability of evidence under a logistic model: weights by name, and ``bias``."""
    total = odds["bias"] + sum(weight * evidence[name] for name, weight in odds.items() if name != "bias")
    return float(1 / (1 + np.exp(-total)))


Doors = Sequence[tuple[Array, float]]  # middle (2,) m and width


def find_wall_changes(layers: StoreyLayers, doors: Doors = ()) -> list[WallChange]:
    """Find the walls that are new or gone, whatever their probability; what fills a door and no more is its leaf."""
    found = []
    for kind, one, other in (("wall new", layers.new, layers.old), ("wall gone", layers.old, layers.new)):
        changed = one.wall & other.free & (other.to_wall > layers.slack) & (other.to_standing > layers.slack)
        groups, count = ndimage.label(_widen(changed, GROUP_REACH / 2))
        lines: list[Line] = []
        for k, box in enumerate(ndimage.find_objects(groups, count), 1):
            pixels = np.argwhere((groups[box] == k) & changed[box]) + [s.start for s in box]
            if len(pixels) * PIXEL_WEIGHT >= LEAST_WALL / 2:
                lines += detect_lines((pixels + 0.5) * CHANGE_CELL, np.full(len(pixels), PIXEL_WEIGHT), 0.0)
        for low, high, line in _merge_faces(lines):  # of all groups: a door parts a wall into two
            runs = _split_runs(changed, line, low, high)
            found += [_measure_wall(layers, kind, one, other, changed, (*run, line)) for run in runs]
    return [wall for wall in _drop_repeated(found) if not any(_fills_door(wall, *door) for door in doors)]


def _fills_door(wall: WallChange, centre: Array, width: float) -> bool:
    along = (wall.ends[1] - wall.ends[0]) / max(wall.length, 1e-9)
    apart = wall.ends.mean(axis=0) - centre
    off, shift = abs(float(apart[0] * along[1] - apart[1] * along[0])), abs(float(apart @ along))
    inside = off < LEAF_THICKNESS and shift + wall.length / 2 < width / 2 + 2 * LEAF_REACH
    return inside and wall.evidence["support"] > WHOLE  # a short wall with a door in it has a gap there


def _widen(mask: Array, metres: float) -> Array:
    steps = max(round(metres / CHANGE_CELL), 1)
    out: Array = ndimage.binary_dilation(mask, np.ones((3, 3), bool), iterations=steps)
    return out


def _merge_faces(lines: Sequence[Line]) -> list[tuple[float, float, Line]]:
    """Return (near, far, line): lines that are faces of one wall are one, `near` and `far` m across it."""
    left, out = sorted(lines, key=lambda line: -line.length), []
    while left:
        first, rest = left[0], []
        low = high = 0.0
        start, end = first.start, first.end
        for other in left[1:]:
            ends = other.ends - first.middle
            off, along = ends @ first.across, np.sort(ends @ first.along)
            overlap = min(along[1], end) - max(along[0], start)
            same = abs(other.along @ first.along) > PARALLEL and np.abs(off).max() < ONE_WALL and overlap > -DOOR_GAP
            fits = max(high, float(off.max())) - min(low, float(off.min())) < ONE_WALL
            if same and fits:
                low, high = min(low, float(off.min())), max(high, float(off.max()))
                start, end = min(start, float(along[0])), max(end, float(along[1]))
            else:
                rest.append(other)
        out.append((low, high, replace(first, start=start, end=end)))
        left = rest
    return out


def _count_bins(mask: Array, line: Line, low: float, high: float) -> Array:
    """Return (n,) bool: does a stretch of `SUPPORT_BIN` of a line, of which a mask knows, hold anything?"""
    steps = max(round(line.length / SUPPORT_BIN), 1)
    t = line.start + (np.arange(steps) + 0.5) * SUPPORT_BIN
    across = np.arange(low - 0.1, high + 0.11, CHANGE_CELL)
    places = line.middle + t[:, None, None] * line.along + across[None, :, None] * line.across
    at = np.floor(places / CHANGE_CELL).astype(np.int64)
    inside = ((at >= 0) & (at < mask.shape)).all(axis=-1)
    i, j = np.moveaxis(np.where(inside[..., None], at, 0), -1, 0)
    out: Array = (mask[i, j] & inside).any(axis=1)
    return out


def _split_runs(changed: Array, line: Line, low: float, high: float) -> list[tuple[float, float]]:
    """Return the stretches (start, end) of a line that are parted by gaps wider than a door."""
    seen = _count_bins(changed, line, low, high)
    if not seen.any():
        return []
    gap = int(DOOR_GAP / SUPPORT_BIN)
    closed = ~seen
    for a, b in list_runs(closed):
        if b - a <= gap and a > 0 and b < len(seen):
            seen[a:b] = True
    runs = [(line.start + a * SUPPORT_BIN, line.start + b * SUPPORT_BIN) for a, b in list_runs(seen)]
    return [(a, b) for a, b in runs if b - a >= LEAST_WALL]


def _measure_wall(
    layers: StoreyLayers, kind: str, one: MapLayer, other: MapLayer, changed: Array, stretch: tuple[float, float, Line]
) -> WallChange:
    """Return a wall with its probability: how long it is, how much of it was seen, how empty its ground was, how high it goes."""
    part = replace(stretch[2], start=stretch[0], end=stretch[1])
    own = _find_pixels(changed, part)
    off = ((own + 0.5) * CHANGE_CELL - part.middle) @ part.across
    low, high = (float(np.quantile(off, q)) for q in (0.03, 0.97)) if len(off) else (0.0, 0.0)
    at = tuple(own.T)
    covered = _count_bins(one.wall, part, low, high)
    support = _count_bins(changed, part, low, high)
    seen = _count_bins(other.free | other.standing, part, low, high) & covered
    margin = float(np.median(other.to_standing[at] / layers.slack[at])) if len(own) else 0.0
    evidence = {
        "length": float(np.log(max(part.length, 0.1))),
        "support": float(support.mean()),
        "clear": float(support[seen].mean()) if seen.any() else 0.0,
        "tall": float(one.tall[at].mean()) if len(own) else 0.0,
        "margin": min(margin - 1.0, 3.0),
        "apart": min(float(np.median(other.to_wall[at])), 1.5) if len(own) else 0.0,
        "entered": float(np.maximum(one.entered, other.entered)[_ring(own, one.entered.shape)].mean()) if len(own) else 0.0,
    }
    start, end = _lengthen(one, other, part, low, high)
    near, far = low - CHANGE_CELL / 2, high + CHANGE_CELL / 2
    corners = [(start, near), (end, near), (end, far), (start, far)]
    local = np.array([part.middle + t * part.along + v * part.across for t, v in corners])
    outline = (layers.low + local) @ layers.axes
    return WallChange(kind, outline, end - start, compute_probability(WALL_ODDS, evidence), evidence)


def _ring(pixels: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the pixels 0.5 m around some, within a raster: walls themselves are of no room."""
    steps = round(0.5 / CHANGE_CELL) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    around = (pixels[:, None] + steps).reshape(-1, 2).clip(0, np.array(shape) - 1)
    return around[:, 0], around[:, 1]


def _lengthen(one: MapLayer, other: MapLayer, line: Line, low: float, high: float) -> tuple[float, float]:
    """Return the start and end of a wall that changed, m along its line, each up to the wall of both maps that it meets: what is
    near that one does not count as changed, but belongs to it."""
    ends = []
    for tip, sign in ((line.start, -1), (line.end, 1)):
        step = 0
        while step * CHANGE_CELL < MOST_SLACK:
            at = line.middle + (tip + sign * (step + 0.5) * CHANGE_CELL) * line.along + (low + high) / 2 * line.across
            i, j = np.floor(at / CHANGE_CELL).astype(int).tolist()
            inside = 0 <= i < one.wall.shape[0] and 0 <= j < one.wall.shape[1]
            if not inside or one.to_wall[i, j] > (high - low) / 2 + CHANGE_CELL or other.to_wall[i, j] <= CHANGE_CELL / 2:
                break
            step += 1
        ends.append(tip + sign * step * CHANGE_CELL)
    return ends[0], ends[1]


def _find_pixels(mask: Array, line: Line) -> Array:
    """Return (n, 2) pixels of a mask that are at most `ONE_WALL` / 2 beside a line."""
    reach = ONE_WALL / 2
    low = np.floor((line.ends.min(axis=0) - reach) / CHANGE_CELL).astype(int).clip(0)
    high = np.ceil((line.ends.max(axis=0) + reach) / CHANGE_CELL).astype(int).clip(0)
    pixels = np.argwhere(mask[low[0] : high[0], low[1] : high[1]]) + low
    apart = (pixels + 0.5) * CHANGE_CELL - line.middle
    along, across = apart @ line.along, apart @ line.across
    out: Array = pixels[(np.abs(across) <= reach) & (along >= line.start) & (along <= line.end)]
    return out


def _drop_repeated(walls: Sequence[WallChange]) -> list[WallChange]:
    """Return the walls without those that mostly lie in a longer one of their kind."""
    chosen: list[tuple[WallChange, shapely.Polygon]] = []
    for wall in sorted(walls, key=lambda w: -w.length):
        shape = shapely.Polygon(wall.outline).buffer(0.15)
        if all(w.kind != wall.kind or shape.intersection(s).area < 0.5 * shape.area for w, s in chosen):
            chosen.append((wall, shape))
    return [wall for wall, _ in chosen]


def find_furniture_changes(
    layers: StoreyLayers, walls: Sequence[WallChange], doors: Doors, least: float = 0.5
) -> list[ThingChange]:
    """Find furniture that is new, gone or moved, where both maps show furniture at all.

    Args:
        layers: of the storey.
        walls: those that changed; what stands in a probable one is no furniture.
        doors: middle (2,) m and width of each door: what is thin and near may be a leaf.
        least: probability of walls that count.
    """
    if not (layers.old.furnished and layers.new.furnished):
        return []
    taken = _draw_outlines(layers, [w.outline for w in walls if w.probability >= least])
    sides = []
    for kind, one, other in (("furniture new", layers.new, layers.old), ("furniture gone", layers.old, layers.new)):
        own_wall = one.to_wall <= BESIDE_WALL
        wall_of_both = own_wall & (other.to_wall <= layers.slack + BESIDE_WALL)
        changed = one.thing & other.clear & (other.to_standing > layers.slack) & ~wall_of_both & ~taken
        changed &= other.to_wall > layers.slack
        solid = ndimage.binary_opening(changed, np.ones((2, 2), bool))
        groups, count = ndimage.label(_widen(solid, CHANGE_CELL))
        things = []
        for k, box in enumerate(ndimage.find_objects(groups, count), 1):
            pixels = np.argwhere((groups[box] == k) & solid[box]) + [s.start for s in box]
            if len(pixels) * CHANGE_CELL**2 >= LEAST_THING:
                things.append(_measure_thing(layers, kind, one, other, pixels))
        sides.append([t for t in things if not _is_leaf(t, doors)])
    return _match_moved(*sides)


def _draw_outlines(layers: StoreyLayers, outlines: Sequence[Array]) -> Array:
    """Return (nx, ny) bool: pixels in polygons (n, 2) m, or beside them."""
    taken = np.zeros(layers.slack.shape, bool)
    for outline in outlines:
        taken |= layers.rasterise(shapely.Polygon(outline).buffer(0.2, join_style="mitre"))
    return taken


def _measure_thing(layers: StoreyLayers, kind: str, one: MapLayer, other: MapLayer, pixels: Array) -> ThingChange:
    at = tuple(pixels.T)
    points = layers.compute_points(pixels)[:, :2]
    hull = shapely.MultiPoint(points).buffer(CHANGE_CELL / 2, cap_style="square")
    outline = np.asarray(shapely.minimum_rotated_rectangle(hull).exterior.coords)[:4]
    sides = np.sort(np.linalg.norm(np.diff(outline[:3], axis=0), axis=1))
    area = len(pixels) * CHANGE_CELL**2
    evidence = {
        "area": float(np.log(area / 0.2)),
        "margin": min(float(np.max(other.to_standing[at] / layers.slack[at])) - 1.0, 3.0),
        "solid": area / max(float(sides[0] * sides[1]), 1e-6),
        "thick": min(float(sides[0]) / 0.3, 2.0) - 1.0,
        "entered": float(min(one.entered[_ring(pixels, one.entered.shape)].mean(), other.entered[at].mean())),
        "ring": _measure_ring(one, pixels),
        "height": float(np.quantile(one.top[at], 0.9)),
        "m2": area,
    }
    rooms, times = np.unique(other.room[at], return_counts=True)
    room = int(rooms[times.argmax()])
    return ThingChange(kind, outline, float(sides[1]), compute_probability(THING_ODDS, evidence), evidence, room, area)


def _measure_ring(one: MapLayer, pixels: Array) -> float:
    """Measure the share of the ground 0.2 m around a thing that is floor: a floor that has drifted upwards has no other one
    around it."""
    low = (pixels.min(axis=0) - 6).clip(0)
    high = pixels.max(axis=0) + 7
    box = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    own = np.zeros(one.clear[box].shape, bool)
    own[tuple((pixels - low).T)] = True
    around = _widen(own, 4 * CHANGE_CELL) & ~_widen(own, 2 * CHANGE_CELL)
    return float(one.clear[box][around].mean()) if around.any() else 0.0


def _is_leaf(thing: ThingChange, doors: Doors) -> bool:
    """Return whether it may be the leaf of a door that stands otherwise."""
    sides = np.linalg.norm(np.diff(thing.outline[:3], axis=0), axis=1)
    if sides.min() > LEAF_THICKNESS:
        return False
    return any(np.linalg.norm(thing.outline - at, axis=1).max() < width + LEAF_REACH for at, width in doors)


def _match_moved(new: Sequence[ThingChange], gone: Sequence[ThingChange]) -> list[ThingChange]:
    """Join furniture that is gone here and new there, of one size and in one room: it has been moved."""
    options = []
    for i, a in enumerate(gone):
        for j, b in enumerate(new):
            apart = float(np.linalg.norm(a.outline.mean(axis=0) - b.outline.mean(axis=0)))
            ratio = min(a.area, b.area) / max(a.area, b.area)
            tall = abs(a.evidence["height"] - b.evidence["height"])
            if apart < NUDGED or (ratio > SAME_SIZE and apart < CARRIED and tall < 0.3):
                options.append((apart / CARRIED - ratio, i, j))
    left_gone, left_new = set(range(len(gone))), set(range(len(new)))
    out = []
    for _, i, j in sorted(options):
        if i in left_gone and j in left_new:
            left_gone.discard(i)
            left_new.discard(j)
            a, b = gone[i], new[j]
            probability = float(np.sqrt(a.probability * b.probability))
            out.append(replace(b, kind="furniture moved", probability=probability, start=a.outline.mean(axis=0)))
    return [*out, *(new[j] for j in sorted(left_new)), *(gone[i] for i in sorted(left_gone))]
