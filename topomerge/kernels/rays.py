"""Compiled loops along rays: through voxel grids and over the floor of a plan."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, run_in_slices
from topomerge.kernels.voxels import find_row

Ints = NDArray[Any]
Floats = NDArray[np.float64]
LEAST_TARGETS = 64  # of a slice: each has many starts, or a long ray
FIELD_LIMIT = 255  # the distance field is a byte


@njit(cache=True, nogil=True)
def compute_distance_field(cells, low, size):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (size) uint8 Chebyshev distance, in cells, to the nearest of (n, 3) occupied cells of the window at `low`; at
    most 255."""
    sx, sy, sz = size
    field = np.full((sx + 2, sy + 2, sz + 2), FIELD_LIMIT, np.uint8)  # a border of one cell spares the tests for the edge
    for i in range(len(cells)):
        field[cells[i, 0] - low[0] + 1, cells[i, 1] - low[1] + 1, cells[i, 2] - low[2] + 1] = 0
    for x in range(1, sx + 1):
        for y in range(1, sy + 1):
            for z in range(1, sz + 1):
                best = field[x, y, z]
                if best > 0:
                    near = min(field[x, y, z - 1], field[x, y - 1, z - 1], field[x, y - 1, z], field[x, y - 1, z + 1])
                    for dy in range(-1, 2):
                        near = min(near, field[x - 1, y + dy, z - 1], field[x - 1, y + dy, z], field[x - 1, y + dy, z + 1])
                    if near < FIELD_LIMIT:
                        field[x, y, z] = min(best, np.uint8(near + 1))
    for x in range(sx, 0, -1):
        for y in range(sy, 0, -1):
            for z in range(sz, 0, -1):
                best = field[x, y, z]
                if best > 0:
                    near = min(field[x, y, z + 1], field[x, y + 1, z - 1], field[x, y + 1, z], field[x, y + 1, z + 1])
                    for dy in range(-1, 2):
                        near = min(near, field[x + 1, y + dy, z - 1], field[x + 1, y + dy, z], field[x + 1, y + dy, z + 1])
                    if near < FIELD_LIMIT:
                        field[x, y, z] = min(best, np.uint8(near + 1))
    return field[1 : sx + 1, 1 : sy + 1, 1 : sz + 1].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def is_visible(field, ox, oy, oz, tx, ty, tz):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return whether the ray from (ox, oy, oz) meets no occupied cell before cell (tx, ty, tz). Coordinates in cells of the
    window."""
    dx, dy, dz = tx + 0.5 - ox, ty + 0.5 - oy, tz + 0.5 - oz
    length = max(abs(dx), abs(dy), abs(dz))
    x, y, z = int(np.floor(ox)), int(np.floor(oy)), int(np.floor(oz))
    if (x == tx and y == ty and z == tz) or length == 0.0:
        return True
    dx, dy, dz = dx / length, dy / length, dz / length
    ix, iy, iz = 1.0 / abs(dx), 1.0 / abs(dy), 1.0 / abs(dz)
    sx, sy, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    px, py, pz = (1 if dx > 0 else 0), (1 if dy > 0 else 0), (1 if dz > 0 else 0)
    nx, ny, nz = abs(x + px - ox) * ix, abs(y + py - oy) * iy, abs(z + pz - oz) * iz
    s = 0.0
    near = field[x, y, z]
    if near == 0:
        near = 1  # the view itself may stand in an occupied cell
    while True:
        if near > 3:
            s += near - 1
            if s >= length:
                return True
            x, y, z = int(np.floor(ox + s * dx)), int(np.floor(oy + s * dy)), int(np.floor(oz + s * dz))
            nx, ny, nz = abs(x + px - ox) * ix, abs(y + py - oy) * iy, abs(z + pz - oz) * iz
        elif nx <= ny and nx <= nz:
            s = nx
            nx += ix
            x += sx
        elif ny <= nz:
            s = ny
            ny += iy
            y += sy
        else:
            s = nz
            nz += iz
            z += sz
        if s >= length or (x == tx and y == ty and z == tz):
            return True
        near = field[x, y, z]
        if near == 0:
            return False


@njit(cache=True, nogil=True, error_model="numpy")
def cast(field, low, views, radius, cells, near, rows, indptr, words, masks):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Write the seen rows of each view as words of 64 rows: word numbers and bit masks, from indptr[v] on; return their count a
    view.

    `views` are in cells of the whole grid, `field` covers a window at `low`; rows[near[v] : near[v + 1]] are ascending and hold
    all cells in range of view v; indptr must leave room for their words.
    """
    counts = np.zeros(len(views), np.int64)
    for v in range(len(views)):
        ox, oy, oz = views[v, 0] - low[0], views[v, 1] - low[1], views[v, 2] - low[2]
        at = indptr[v]
        word, mask = np.int64(-1), np.uint64(0)
        for i in rows[near[v] : near[v + 1]]:
            tx, ty, tz = cells[i, 0] - low[0], cells[i, 1] - low[1], cells[i, 2] - low[2]
            if (tx + 0.5 - ox) ** 2 + (ty + 0.5 - oy) ** 2 + (tz + 0.5 - oz) ** 2 > radius * radius:
                continue
            if is_visible(field, ox, oy, oz, tx, ty, tz):
                if i >> 6 != word:
                    if mask != 0:
                        words[at], masks[at] = word, mask
                        at += 1
                    word, mask = i >> 6, np.uint64(0)
                mask |= np.uint64(1) << np.uint64(i & 63)
        if mask != 0:
            words[at], masks[at] = word, mask
            at += 1
        counts[v] = at - indptr[v]
    return counts


@njit(cache=True, nogil=True)
def count_words(near, rows):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (v,) in how many words of 64 rows the ascending rows[near[v] : near[v + 1]] lie."""
    count = np.zeros(len(near) - 1, np.int64)
    for v in range(len(count)):
        for k in range(near[v], near[v + 1]):
            if k == near[v] or rows[k] >> 6 != rows[k - 1] >> 6:
                count[v] += 1
    return count


@compile_ahead("i8, i8, b1[:,::1], i8[:,::1], i8[:,::1], f8, b1[::1]")
def _is_seen_from(first, last, free, targets, starts, reach, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for i in range(first, last):
        x, y = targets[i, 0], targets[i, 1]
        for k in range(len(starts)):
            dx, dy = starts[k, 0] - x, starts[k, 1] - y
            if dx * dx + dy * dy > reach * reach:
                continue
            steps = max(abs(dx), abs(dy))
            clear = True
            for s in range(1, steps):
                if not free[int(np.rint(x + dx * s / steps)), int(np.rint(y + dy * s / steps))]:
                    clear = False
                    break
            if clear:
                out[i] = True
                break


def is_seen_from(free: NDArray[np.bool_], targets: Ints, starts: Ints, reach: float) -> NDArray[np.bool_]:
    """Return (t,) bool: whether a straight line over columns that are `free` (nx, ny) leads from any start to each target, at
    most `reach` columns long.

    `targets` (t, 2) and `starts` (s, 2) int64 columns.
    """
    out = np.zeros(len(targets), np.bool_)
    run_in_slices(_is_seen_from, len(targets), LEAST_TARGETS, free, targets, starts, float(reach), out)
    return out


@njit(cache=True, nogil=True)
def find_lit_pixels(opaque, starts, reach):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return (nx, ny) bool: pixels that a straight line from any start (n, 2) int64 reaches, at most `reach` pixels long, with
    the `opaque` (nx, ny) pixel that ends it. A start may stand on an opaque pixel."""
    nx, ny = opaque.shape
    out = np.zeros((nx, ny), np.bool_)
    rays = int(2 * np.pi * reach) + 8
    for k in range(len(starts)):
        for ray in range(rays):
            angle = 2 * np.pi * ray / rays
            dx, dy = np.cos(angle) / 2, np.sin(angle) / 2
            x, y = starts[k, 0] + 0.5, starts[k, 1] + 0.5
            for step in range(int(2 * reach)):
                i, j = int(np.floor(x)), int(np.floor(y))
                if i < 0 or j < 0 or i >= nx or j >= ny:
                    break
                out[i, j] = True
                if opaque[i, j] and step > 3:
                    break
                x += dx
                y += dy
    return out


def carve(starts: Floats, ends: Floats, margin: float, crossed: NDArray[np.bool_]) -> None:
    """Set `crossed` (nx, ny, nz) bool in every cell that a ray enters between `starts` and `margin` cells before `ends` ((k, 3)
    float64, in cells), by the digital differential analyser of Amanatides and Woo (1987)."""
    run_in_slices(_carve, len(starts), LEAST_TARGETS, starts, ends, margin, crossed)


@njit(cache=True, nogil=True)
def _carve(first, last, starts, ends, margin, crossed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    nx, ny, nz = crossed.shape
    for i in range(first, last):
        length = 0.0
        for k in range(3):
            length += (ends[i, k] - starts[i, k]) ** 2
        length = np.sqrt(length)
        if not length > margin:
            continue
        stop = (length - margin) / length
        x, y, z = int(np.floor(starts[i, 0])), int(np.floor(starts[i, 1])), int(np.floor(starts[i, 2]))
        dx, dy, dz = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1], ends[i, 2] - starts[i, 2]
        far = np.inf
        sx, sy, sz = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
        tx = (x + (sx > 0) - starts[i, 0]) / dx if dx != 0 else far
        ty = (y + (sy > 0) - starts[i, 1]) / dy if dy != 0 else far
        tz = (z + (sz > 0) - starts[i, 2]) / dz if dz != 0 else far
        ux, uy, uz = (abs(1 / dx) if dx != 0 else far), (abs(1 / dy) if dy != 0 else far), (abs(1 / dz) if dz != 0 else far)
        t = 0.0
        while t < stop:
            if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                crossed[x, y, z] = True
            if tx <= ty and tx <= tz:
                t, tx, x = tx, tx + ux, x + sx
            elif ty <= tz:
                t, ty, y = ty, ty + uy, y + sy
            else:
                t, tz, z = tz, tz + uz, z + sz


def sweep(
    table: Ints, bricks: Ints, starts: Floats, directions: Floats, reach: float, coarser: int, crossed: NDArray[np.bool_]
) -> None:
    """Set `crossed` in every cell, `coarser` times as long as those of the grid, that lies between a start and the first occupied
    cell in each direction; nothing for a ray that meets none within `reach` cells.

    `starts` (v, 3) in cells, `directions` (d, 3) unit vectors.
    """
    run_in_slices(_sweep, len(starts), 1, table, bricks, starts, directions, float(reach), coarser, crossed)


@compile_ahead("i8, i8, i4[:,:,::1], i4[:,::1], f8[:,::1], f8[:,::1], f8, i8, b1[:,:,::1]")
def _sweep(first, last, table, bricks, starts, directions, reach, coarser, crossed):  # type: ignore[no-untyped-def]  # pragma: no cover
    nx, ny, nz = crossed.shape
    for i in range(first, last):
        for d in range(len(directions)):
            dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
            met = -1.0
            t = 1.0
            while t < reach:
                u, v, w = starts[i, 0] + t * dx, starts[i, 1] + t * dy, starts[i, 2] + t * dz
                if find_row(table, bricks, int(np.floor(u)), int(np.floor(v)), int(np.floor(w))) >= 0:
                    met = t
                    break
                t += 0.7
            t = 0.0
            while t < met - coarser / 2:
                x = int(np.floor((starts[i, 0] + t * dx) / coarser))
                y = int(np.floor((starts[i, 1] + t * dy) / coarser))
                z = int(np.floor((starts[i, 2] + t * dz) / coarser))
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    crossed[x, y, z] = True
                t += coarser / 2


@njit(cache=True)
def count_rays(starts, ends, margin, passed, met):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add to `passed` and `met` (nx, ny) int32 how many rays go through each column, from `starts` until `margin` columns before
    `ends` ((k, 2) float64, in columns), and how many end in it: as `carve`, in the plane."""
    nx, ny = passed.shape
    for i in range(len(starts)):
        dx, dy = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1]
        x, y = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= x < nx and 0 <= y < ny:
            met[x, y] += 1
        length = np.sqrt(dx**2 + dy**2)
        if not length > margin:
            continue
        stop = (length - margin) / length
        x, y = int(np.floor(starts[i, 0])), int(np.floor(starts[i, 1]))
        sx, sy = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        tx = (x + (sx > 0) - starts[i, 0]) / dx if dx != 0 else np.inf
        ty = (y + (sy > 0) - starts[i, 1]) / dy if dy != 0 else np.inf
        ux, uy = (abs(1 / dx) if dx != 0 else np.inf), (abs(1 / dy) if dy != 0 else np.inf)
        t = 0.0
        while t < stop:
            if 0 <= x < nx and 0 <= y < ny:
                passed[x, y] += 1
            if tx <= ty:
                t, tx, x = tx, tx + ux, x + sx
            else:
                t, ty, y = ty, ty + uy, y + sy


@compile_ahead("b1[:,::1], f8, f8, f8, f8, f8")
def measure_run(mask, x, y, dx, dy, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Count the cells from (x, y) along the unit vector (dx, dy) while `mask` holds, in halves, at most `limit`."""
    length = 0.0
    while length < limit:
        u, v = int(np.rint(x + (length + 0.5) * dx)), int(np.rint(y + (length + 0.5) * dy))
        if not (0 <= u < mask.shape[0] and 0 <= v < mask.shape[1]) or not mask[u, v]:
            break
        length += 0.5
    return length


@compile_ahead("b1[:,::1], f8, f8, f8, f8, i8, f8")
def measure_widths(mask, x, y, dx, dy, steps, limit):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (2 steps + 1,) free width (cells) across the direction (dx, dy)'s normal, at -steps..steps cells along that
    normal from (x, y); -1 from where the normal itself is blocked."""
    out = np.full(2 * steps + 1, -1.0)
    for sign in (-1, 1):
        for t in range(steps + 1):
            u, v = x - sign * t * dy, y + sign * t * dx
            i, j = int(np.rint(u)), int(np.rint(v))
            if not (0 <= i < mask.shape[0] and 0 <= j < mask.shape[1]) or not mask[i, j]:
                break
            out[steps + sign * t] = measure_run(mask, u, v, dx, dy, limit) + measure_run(mask, u, v, -dx, -dy, limit) + 1
    return out


@compile_ahead("f4[:,::1], f8, f8, f8, f8, f8, f8, i8")
def measure_cover(mask, x, y, dx, dy, before, after, steps):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the greatest share of the cells of a line, from `before` cells behind (x, y) to `after` ahead along (dx, dy), for
    which `mask` holds; the line may be shifted by up to `steps` cells along its normal."""
    best = 0.0
    for t in range(-steps, steps + 1):
        hit, total = 0, 0
        for k in range(-int(before), int(after) + 1):
            u, v = int(np.rint(x + k * dx - t * dy)), int(np.rint(y + k * dy + t * dx))
            if 0 <= u < mask.shape[0] and 0 <= v < mask.shape[1]:
                total += 1
                hit += mask[u, v]
        if total:
            best = max(best, hit / total)
    return best
