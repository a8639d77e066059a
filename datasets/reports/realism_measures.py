"""How well a map shows the surfaces of a room, how far its points lie off planes, and sizes of rooms and doors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from topomerge.datasets.simulation.floors import fill

from topomerge.types import Array, TrueRoom

SURFACE_CELL = 0.1  # m, of all rasters
OUTLINE_NEAR = 2  # cells; a wall is seen, and a cell belongs to it, within so many of the outline
FLOOR_OFF = 0.15  # m that a point of a floor may lie off it
CEILING_OFF = 0.3  # m, likewise of a ceiling: they hang lower here and there
LEAST_SEEN = 0.2  # share of a room's columns with a point, from which on the map is one of this room
MEASURED_HEIGHTS = ((0.0, 1.0), (1.0, 2.0), (2.0, 3.0))  # m above the floor
PATCH_RADIUS, PATCHES = 0.3, 400  # m, number of the patches that planes are fitted to
CELLS_AROUND = 3  # cells around a room that are looked at, too


@dataclass(frozen=True, eq=False)
class Space:
    """A room as cells: `mask` (rows, columns) bool from `origin` (2,) m, between two heights (m)."""

    mask: Array
    origin: Array
    floor: float
    ceiling: float


def space_of(room: TrueRoom) -> Space:
    """A true room as cells."""
    origin = room.polygon.min(axis=0) - CELLS_AROUND * SURFACE_CELL
    columns, rows = np.ceil((room.polygon.max(axis=0) - origin) / SURFACE_CELL).astype(int) + CELLS_AROUND
    mask = np.zeros((int(rows), int(columns)), bool)
    fill(mask, (room.polygon - origin) / SURFACE_CELL, 1)
    return Space(mask, origin, room.floor, room.ceiling)


def outline_of(points: Array, floor: float, ceiling: float, gap: float = 0.5) -> Space:
    """The outline of a cloud of one room: its largest piece, gaps closed and holes filled; for clouds without true rooms.

    Args:
        points: (n, 3) m.
        gap: m; wider ones between columns with points are not closed.
    """
    wide = CELLS_AROUND + int(gap / SURFACE_CELL)
    origin = points[:, :2].min(axis=0) - wide * SURFACE_CELL
    ij = np.floor((points[:, 1::-1] - origin[::-1]) / SURFACE_CELL).astype(int)
    count = np.zeros(ij.max(axis=0) + 1 + wide, int)
    np.add.at(count, tuple(ij.T), 1)
    mask = ndimage.binary_fill_holes(ndimage.binary_closing(count > 1, iterations=int(gap / SURFACE_CELL)))
    parts, number = ndimage.label(mask)
    if number:
        mask = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    return Space(mask, origin, floor, ceiling)


def surfaces(points: Array, space: Space) -> dict[str, float] | None:
    """What of a room a map shows; None where the map is not one of this room (fewer than `LEAST_SEEN` of its columns).

    Args:
        points: (n, 3) m, of this room or of more than it.

    Returns:
        `area` (m2), `points` a m2 of floor, `density` (points a m2 of seen surface, reckoned as 0.01 m2 an occupied cell), and as
        shares: `floor` and `ceiling` (cells within the outline without a point of it), `wall 0`, `wall 1`, `wall 2` (steps of the
        outline, 0.1 m high, without a point within 0.2 m, in three bands of height), `clutter` (occupied cells that are neither
        floor nor ceiling nor at the outline).
    """
    mask = space.mask
    height = max(space.ceiling - space.floor, 0.3)
    ij = np.floor((points[:, 1::-1] - space.origin[::-1]) / SURFACE_CELL).astype(int)
    z = points[:, 2] - space.floor
    inside = (ij >= 0).all(axis=1) & (ij < mask.shape).all(axis=1) & (z > -CEILING_OFF) & (z < height + CEILING_OFF)
    ij, z = ij[inside], z[inside]
    around = ndimage.binary_dilation(mask, iterations=OUTLINE_NEAR)
    inside = around[ij[:, 0], ij[:, 1]]
    ij, z = ij[inside], z[inside]
    columns = _hit(ij, mask.shape)
    if not mask.any() or columns[mask].mean() < LEAST_SEEN:
        return None
    out = {"area": float(mask.sum()) * SURFACE_CELL**2, "points": len(z) / (float(mask.sum()) * SURFACE_CELL**2)}
    out["floor"] = 1 - float(_hit(ij[np.abs(z) < FLOOR_OFF], mask.shape)[mask].mean())
    out["ceiling"] = 1 - float(_hit(ij[np.abs(z - height) < CEILING_OFF], mask.shape)[mask].mean())
    level = np.floor(z / SURFACE_CELL).astype(int) + 3  # of the cells, from 0.3 m below the floor
    full = np.zeros((*mask.shape, int(level.max(initial=0)) + 1), bool)
    full[ij[:, 0], ij[:, 1], level] = True
    out["density"] = len(z) / max(float(full.sum()) * SURFACE_CELL**2, SURFACE_CELL**2)
    inner = ndimage.binary_erosion(mask, iterations=OUTLINE_NEAR)
    between = full[:, :, 3 + round(FLOOR_OFF / SURFACE_CELL) : max(int((height - CEILING_OFF) / SURFACE_CELL) + 3, 4)]
    out["clutter"] = float(between[inner].sum() / max(full.sum(), 1))
    return out | _walls(full, mask, height)


def _hit(ij: Array, shape: tuple[int, ...]) -> Array:
    out = np.zeros(shape, bool)
    out[ij[:, 0], ij[:, 1]] = True
    return out


def _walls(full: Array, mask: Array, height: float) -> dict[str, float]:
    """Share of the outline that is not seen, by band of height."""
    edge = mask & ~ndimage.binary_erosion(mask)
    near = ndimage.binary_dilation(full, np.ones((2 * OUTLINE_NEAR + 1, 2 * OUTLINE_NEAR + 1, 1)))
    out = {}
    for k, (low, high) in enumerate(MEASURED_HEIGHTS):
        first, last = round(low / SURFACE_CELL) + 3, round(min(high, height - SURFACE_CELL) / SURFACE_CELL) + 3
        seen = near[edge][:, first:last].sum()
        whole = edge.sum() * max(last - first, 0)
        out[f"wall {k}"] = 1 - float(seen / whole) if whole else np.nan
    return out


def thickness(points: Array, seed: int = 0) -> dict[str, float]:
    """How far points lie off the planes that they are part of.

    Planes are fitted to patches of `PATCH_RADIUS` about points that are drawn; a patch counts as plane where it is three times
    as wide as thick. No truth is needed: edges, furniture and clutter make the patches that are none.

    Returns:
        `flat` and `upright`: median standard deviation across the planes that lie and stand, mm; `rough`: of the upright ones,
        that at 90 %; `loose`: share of the patches that are no plane.
    """
    rng = np.random.default_rng(seed)
    centres = points[rng.choice(len(points), min(PATCHES, len(points)), replace=False)]
    tree = cKDTree(points)
    off, up = [], []
    for patch in tree.query_ball_point(centres, PATCH_RADIUS):
        if len(patch) < 20:
            continue
        some = points[rng.choice(patch, min(len(patch), 400), replace=False)].astype(float)
        size, axes = np.linalg.eigh(np.cov(some.T))
        size = np.sqrt(np.maximum(size, 0))
        plane = size[0] * 3 < size[1] and size[1] > 0.3 * size[2]
        off.append(size[0] if plane else np.nan)
        up.append(abs(axes[2, 0]))
    off_, up_ = np.array(off) * 1000, np.array(up)
    flat, upright = (off_[(up_ > 0.95) & np.isfinite(off_)], off_[(up_ < 0.2) & np.isfinite(off_)])
    middle = [float(np.median(x)) if len(x) else np.nan for x in (flat, upright)]
    rough = float(np.quantile(upright, 0.9)) if len(upright) else np.nan
    return {"flat": middle[0], "upright": middle[1], "rough": rough, "loose": float(np.isnan(off_).mean()) if off else np.nan}


def rooms_and_doors(storeys: Sequence[Sequence[float]], widths: Sequence[float]) -> dict[str, float]:
    """Numbers of a source's rooms and doors.

    Args:
        storeys: the rooms' areas, m2, storey by storey.
        widths: of the doors and openings, m.
    """
    areas = np.concatenate([np.asarray(s, float) for s in storeys])
    quarter, half, three = np.quantile(areas, [0.25, 0.5, 0.75])
    doors = np.quantile(widths, [0.1, 0.25, 0.5, 0.75, 0.9]) if len(widths) else np.full(5, np.nan)
    return {
        "storeys": len(storeys), "rooms": len(areas) / len(storeys), "25 %": quarter, "area": half, "75 %": three,
        "small": float((areas < 5).mean()), "large": float((areas > 100).mean()),
        "door 10 %": doors[0], "door 25 %": doors[1], "door": doors[2], "door 75 %": doors[3], "door 90 %": doors[4],
        "equal": _equal(widths),
    }  # fmt: skip


def _equal(widths: Sequence[float]) -> float:
    """Share of the doors with the commonest width, to a centimetre."""
    if not len(widths):
        return np.nan
    return float(np.unique(np.round(widths, 2), return_counts=True)[1].max() / len(widths))


def together(rows: Iterable[Mapping[str, float] | None]) -> dict[str, float]:
    """Means of the rooms of a map, weighed by their area."""
    seen = [r for r in rows if r is not None]
    out = {"seen": float(len(seen))}
    for key in seen[0] if seen else ():
        values, weight = np.array([r[key] for r in seen]), np.array([r["area"] for r in seen])
        measured = np.isfinite(values)
        out[key] = float(np.average(values[measured], weights=weight[measured])) if measured.any() else np.nan
    return out
