"""A map's storeys seen from above on one sheet of pixels, turned into the direction of the walls (`embedding.surroundings`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.embedding.surroundings import CEILING_UNIT, GAP, SHEET_PIXEL, SHEET_PLANES, TIE
from topomerge.extraction.plans.storey_plan import (
    BODY_HEIGHTS,
    HEIGHT_BANDS,
    UPRIGHT,
    USUAL_HEIGHT,
    WALL_HEIGHTS,
    WALL_RULE,
    build_band_stack,
    detect_wall_columns,
    is_observed_band,
)
from topomerge.kernels.rasters import compute_column_bits
from topomerge.structure.lines import estimate_wall_directions
from topomerge.types import Array, TopometricMap

FURNITURE_STEP = 1.0  # m above the floor, between low and high things
FULL_SHARE = 0.5  # of a pixel's area, from which on it is full: walls are thinner than pixels
HIGHEST = 5.0  # m over the floor
BELOW_FLOOR = 0.3  # m
DOOR_RADIUS = 0.5  # m about a door's middle that is marked
MOST_DOORS = 8  # of a room
BIN = 0.1  # m, into which walls are projected; columns are laid no farther apart


@dataclass(frozen=True, eq=False)
class Sheet:
    """A map's storeys from above.

    Args:
        planes: (H, W, len(SHEET_PLANES)) uint8, how much of a pixel is of each kind; "ceiling": its height (`CEILING_UNIT`),
            0 where none was seen.
        room: (H, W) int16 room whose floor it is, -1 none.
        anchor: (R, 2) float32 pixels, middle of each room.
        doors: (R, MOST_DOORS, 2) float32 pixels, doors of each room, those nearest to its middle first; nan where it has fewer.
        turn: (S,) float64 rad, direction of each storey's walls in the map's frame: that of the lowest in [0, pi/2), those of the
            others no more than pi/4 away from it.
        tilts: rad, by how much other directions in which walls of the lowest storey line up differ from its first one.
    """

    planes: Array
    room: Array
    anchor: Array
    doors: Array
    turn: Array
    tilts: tuple[float, ...] = ()


def rasterise_sheet(map: TopometricMap, scale: float = 1.0, tilt: float = 0.0) -> Sheet:
    """Return the sheet of a map; the same map gives the same one.

    Args:
        scale: m that the unit of a map of unknown scale is taken for; heights stay as they are.
        tilt: rad, by which it is turned away from the first direction of walls.
    """
    storeys: list[Sheet] = []
    for s in range(len(map.storeys)):
        storeys.append(_rasterise_storey(map, s, storeys[0].turn[0] - tilt if storeys else np.pi / 4, scale, tilt))
    height = sum(len(s.room) + GAP for s in storeys)
    width = max((s.room.shape[1] for s in storeys), default=0)
    planes, room = np.zeros((height, width, len(SHEET_PLANES)), np.uint8), np.full((height, width), -1, np.int16)
    anchor, row = np.zeros((len(map.rooms), 2), np.float32), 0
    doors = np.full((len(map.rooms), MOST_DOORS, 2), np.nan, np.float32)
    for s, storey in enumerate(storeys):
        nx, ny = storey.room.shape
        planes[row : row + nx, :ny], room[row : row + nx, :ny] = storey.planes, storey.room
        of = map.rooms["storey"] == s
        anchor[of], doors[of] = storey.anchor[of] + (row, 0), storey.doors[of] + (row, 0)
        row += nx + GAP
    return Sheet(planes, room, anchor, doors, np.array([s.turn[0] for s in storeys]), storeys[0].tilts if storeys else ())


def build_sheet_arrays(map: TopometricMap, scale: float = 1.0) -> dict[str, Array]:
    """Return the sheet of a map by the names that it has among the tensors of a graph."""
    return _name_arrays(rasterise_sheet(map, scale))


def build_tilted_sheet_arrays(map: TopometricMap, scale: float = 1.0) -> list[dict[str, Array]]:
    """Return `build_sheet_arrays` in each direction in which walls line up, the first one first."""
    first = rasterise_sheet(map, scale)
    return [_name_arrays(sheet) for sheet in (first, *(rasterise_sheet(map, scale, tilt) for tilt in first.tilts))]


def _name_arrays(drawn: Sheet) -> dict[str, Array]:
    places = {"anchor": drawn.anchor, "door_anchor": drawn.doors, "turn": drawn.turn}
    return {"sheet": drawn.planes, "sheet_room": drawn.room, **places}


def _rasterise_storey(map: TopometricMap, storey: int, near: float, scale: float, tilt: float) -> Sheet:
    """Rasterise one storey by itself, turned by the direction of its walls that is no more than pi/4 from another, rad, and the
    tilt; anchors of other storeys' rooms mean nothing."""
    grid, nav = map.grid, map.navigable
    masks, ceiling = _classify_columns(map, storey)
    # Within 1 degree of the truth in 51 of 52 validation pairs: so crops have the same direction in both maps (docs/adr/0016).
    first, *others = estimate_wall_directions(_compute_middles(grid.origin, np.argwhere(masks[0]), grid.edge))
    turn = near + (first - near + np.pi / 4) % (np.pi / 2) - np.pi / 4 + tilt
    origin, edge = scale * grid.origin, scale * grid.edge
    wall, low, high, explored = (_sample_column_points(origin, np.argwhere(mask), edge, turn) for mask in masks)
    inside = np.flatnonzero((map.navigable_room >= 0) & (map.rooms["storey"][np.maximum(map.navigable_room, 0)] == storey))
    ground = _sample_column_points(scale * nav.origin, nav.cells[inside, :2], scale * nav.edge, turn)
    label = np.repeat(map.navigable_room[inside], len(ground) // max(len(inside), 1))
    raster = _build_raster(np.concatenate([explored, ground]))
    shares = [raster.compute_share(points, _compute_spacing(edge)) for points in (wall, low, high, explored)]
    columns = np.argwhere(np.isfinite(ceiling))
    roofs = _sample_column_points(origin, columns, edge, turn)
    heights = np.repeat(ceiling[tuple(columns.T)], len(roofs) // max(len(columns), 1))
    ceilings = np.minimum(raster.compute_mean(roofs, heights) / CEILING_UNIT, 255).round()
    doors = 255 * raster.find_near(_rotate_points(scale * _locate_doors(map, storey), turn), DOOR_RADIUS)
    planes = np.stack(
        [shares[0], raster.compute_share(ground, _compute_spacing(scale * nav.edge)), *shares[1:], ceilings, doors], axis=-1
    )
    middles, of_rooms = scale * map.rooms["centroid"], scale * _locate_room_doors(map).reshape(-1, 2)
    anchor = (_rotate_points(middles[:, :2], turn) - raster.corner) / SHEET_PIXEL
    doors_of = (_rotate_points(of_rooms, turn).reshape(-1, MOST_DOORS, 2) - raster.corner) / SHEET_PIXEL
    rooms = raster.label(ground, label, np.column_stack([map.rooms["centroid"], map.rooms["area"]]))
    tilts = tuple(other - first for other in others)
    return Sheet(planes.astype(np.uint8), rooms, anchor.astype(np.float32), doors_of.astype(np.float32), np.array([turn]), tilts)


def _classify_columns(map: TopometricMap, storey: int) -> tuple[tuple[Array, ...], Array]:
    """Return which columns (nx, ny) of a storey's cells are walls, low things, high things, and seen at all; and how high above
    the floor, m, the highest cell of each stands that may be a ceiling, -inf where none does."""
    grid, (floor, limit) = map.grid, _measure_levels(map, storey)
    ix, iy = np.ascontiguousarray(grid.cells[:, :2].T.astype(np.int64))
    z = grid.origin[2] + (grid.cells[:, 2] + 0.5) * grid.edge - floor
    z = np.where((z > -BELOW_FLOOR) & (z < limit), z, np.nan)
    shape = grid.shape[:2]
    profile = compute_column_bits(ix, iy, z, np.zeros(shape), -HEIGHT_BANDS.below * HEIGHT_BANDS.step, HEIGHT_BANDS.step)
    filled = build_band_stack(profile, HEIGHT_BANDS, WALL_HEIGHTS)
    wall = detect_wall_columns(filled[is_observed_band(filled)], WALL_RULE)
    low, high = (_is_between(profile, *h) & ~wall for h in ((BODY_HEIGHTS[0], FURNITURE_STEP), (FURNITURE_STEP, BODY_HEIGHTS[1])))
    ceiling, above = np.full(shape, -np.inf), z >= UPRIGHT
    np.maximum.at(ceiling, (ix[above], iy[above]), z[above])
    return (wall, low, high, profile > 0), np.where(wall, -np.inf, ceiling)


def _measure_levels(map: TopometricMap, storey: int) -> tuple[float, float]:
    """Measure the height of a storey's floor, m, and how far above it the storey ends."""
    row = map.storeys[storey]
    floor = float(row["floor"]) if np.isfinite(row["floor"]) else float(row["ceiling"]) - USUAL_HEIGHT
    above = map.storeys["floor"][map.storeys["floor"] > floor + UPRIGHT]
    return floor, min(float(above.min()) - floor - map.grid.edge, HIGHEST) if len(above) else HIGHEST


def _is_between(profile: Array, low: float, high: float) -> Array:
    out: Array = (profile & profile.dtype.type(HEIGHT_BANDS.build_mask(low, high))) != 0
    return out


def _locate_doors(map: TopometricMap, storey: int) -> Array:
    """Return (n, 2) m, middles of the doors of a storey's rooms."""
    edges = map.open_edges
    centres: Array = edges["centre"][(map.rooms["storey"][edges["rooms"]] == storey).any(axis=1), :2]
    return centres


def _locate_room_doors(map: TopometricMap) -> Array:
    """Return (R, MOST_DOORS, 2) m, doors of each room, those nearest to its middle first; nan where it has fewer."""
    edges = map.open_edges
    room, centre = edges["rooms"].T.reshape(-1), np.tile(edges["centre"][:, :2], (2, 1))
    away = np.hypot(*(centre - map.rooms["centroid"][room, :2]).T).round(3)
    order = np.lexsort((*centre.T, away, room))
    room, centre = room[order], centre[order]
    place = np.arange(len(room)) - np.searchsorted(room, room)
    out = np.full((len(map.rooms), MOST_DOORS, 2), np.nan)
    near = place < MOST_DOORS
    out[room[near], place[near]] = centre[near]
    return out


def _rotate_points(points: Array, turn: float) -> Array:
    """Rotate points (n, 2) of the map's frame into that of its walls."""
    c, s = np.cos(turn), np.sin(turn)
    out: Array = points @ np.array([[c, -s], [s, c]])
    return out


def _compute_middles(origin: Array, columns: Array, edge: float) -> Array:
    out: Array = origin[:2] + (columns + 0.5) * edge
    return out


def _compute_spacing(edge: float) -> float:
    return edge / max(int(np.ceil(edge / BIN - 1e-6)), 1)


def _sample_column_points(origin: Array, columns: Array, edge: float, turn: float) -> Array:
    """Return points of columns (n, 2), no farther apart than `BIN`, in the frame of the walls: those of a column behind each
    other."""
    spacing = _compute_spacing(edge)
    steps = (np.arange(round(edge / spacing)) + 0.5) * spacing - edge / 2
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    return _rotate_points((_compute_middles(origin, columns, edge)[:, None] + grid[None]).reshape(-1, 2), turn)


@dataclass(frozen=True, eq=False)
class _Raster:
    """Pixels from a corner (2,), m, on."""

    corner: Array
    size: tuple[int, int]

    def find_pixels(self, points: Array) -> Array:
        """Return (n,) number of the pixel of each point."""
        x, y = np.floor((points - self.corner) / SHEET_PIXEL + TIE).astype(np.int64).T
        return np.asarray(np.clip(x, 0, self.size[0] - 1) * self.size[1] + np.clip(y, 0, self.size[1] - 1))

    def count(self, points: Array, weight: Array | None = None) -> Array:
        """Return points in each pixel, or the sum of their weights."""
        return np.bincount(self.find_pixels(points), weight, self.size[0] * self.size[1]).reshape(self.size)

    def compute_share(self, points: Array, spacing: float) -> Array:
        """Compute how much of a pixel, 0 to 255, points cover that stand so far apart."""
        return np.minimum(self.count(points) * (spacing / SHEET_PIXEL) ** 2 / FULL_SHARE, 1.0) * 255

    def compute_mean(self, points: Array, values: Array) -> Array:
        """Return mean of the values of its points; 0 where there is none."""
        return np.asarray(self.count(points, values) / np.maximum(self.count(points), 1))

    def find_near(self, points: Array, radius: float) -> Array:
        """Return (size) bool: which pixels' middles are no farther from any of a few points."""
        out = np.zeros(self.size, bool)
        middles = [self.corner[k] + (np.arange(n) + 0.5) * SHEET_PIXEL for k, n in enumerate(self.size)]
        for x, y in points:
            out |= (middles[0][:, None] - x) ** 2 + (middles[1][None] - y) ** 2 <= radius**2
        return out

    def label(self, points: Array, labels: Array, order_by: Array) -> Array:
        """Return (size) int16 label that most points of a pixel have; -1 where there is none. Which of two with as many depends
        on the last columns of what they are ordered by, not on their numbers."""
        out = np.full(self.size[0] * self.size[1], -1, np.int16)
        if len(points):
            count = int(labels.max()) + 1
            pair, votes = np.unique(self.find_pixels(points) * count + labels, return_counts=True)
            order = np.lexsort((*order_by[pair % count].T, votes))  # the last one written has most votes
            pixel, label = np.divmod(pair[order], count)
            out[pixel] = label
        return out.reshape(self.size)


def _build_raster(points: Array) -> _Raster:
    """Return the pixels that hold points (n, 2), m, with their middle in their own, so that a turned map has the same pixels,
    turned."""
    points = points if len(points) else np.zeros((1, 2))
    size = np.floor(np.ptp(points, axis=0) / SHEET_PIXEL).astype(int) + 1
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return _Raster(middle - size * SHEET_PIXEL / 2, (int(size[0]), int(size[1])))
