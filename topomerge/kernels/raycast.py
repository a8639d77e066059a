"""Rays from views to cell centroids through a voxel grid, with jumps over empty space.

The digital differential analyser of Amanatides and Woo (1987) visits every cell that a ray enters. Where the nearest occupied
cell is k cells away (Chebyshev distance), the next k - 1 cells along the ray's main axis are empty whatever the direction: they
are jumped.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FIELD_LIMIT = 255  # the distance field is a byte


@njit(cache=True, nogil=True)
def distance_field(cells, low, size):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(size) uint8 Chebyshev distance, in cells, to the nearest of (n, 3) occupied cells of the window at `low`; at most 255."""
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


@njit(cache=True, inline="always", error_model="numpy")
def reaches(field, ox, oy, oz, tx, ty, tz):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Does the ray from (ox, oy, oz) meet no occupied cell before cell (tx, ty, tz)? Coordinates in cells of the window."""
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
    """Seen rows of each view as words of 64 rows: word numbers and bit masks, from indptr[v] on; returns their count a view.

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
            if reaches(field, ox, oy, oz, tx, ty, tz):
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
def words_of(near, rows):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(v,) in how many words of 64 rows the ascending rows[near[v] : near[v + 1]] lie."""
    count = np.zeros(len(near) - 1, np.int64)
    for v in range(len(count)):
        for k in range(near[v], near[v + 1]):
            if k == near[v] or rows[k] >> 6 != rows[k - 1] >> 6:
                count[v] += 1
    return count
