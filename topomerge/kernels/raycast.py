"""Rays from views to cell centroids through a voxel grid, with jumps over empty space.

The digital differential analyser of Amanatides and Woo (1987) visits every cell that a ray enters. Where the nearest occupied
cell is k cells away (Chebyshev distance), the next k - 1 cells along the ray's main axis are empty whatever the direction: they
are jumped.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FAR = 255  # the distance field is a byte


@njit(cache=True, nogil=True)
def distance_field(bricks, starts, cells, low, size):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(size) uint8 Chebyshev distance, in cells, to the nearest occupied cell of the window at `low`; at most 255.

    `bricks` are those that may reach into the window; the rows of brick b are starts[b] .. starts[b + 1] - 1.
    """
    sx, sy, sz = size
    field = np.full((sx + 2, sy + 2, sz + 2), FAR, np.uint8)  # a border of one cell spares the tests for the edge
    for b in bricks:
        for i in range(starts[b], starts[b + 1]):
            x, y, z = cells[i, 0] - low[0], cells[i, 1] - low[1], cells[i, 2] - low[2]
            if 0 <= x < sx and 0 <= y < sy and 0 <= z < sz:
                field[x + 1, y + 1, z + 1] = 0
    for x in range(1, sx + 1):
        for y in range(1, sy + 1):
            for z in range(1, sz + 1):
                best = field[x, y, z]
                if best > 0:
                    near = min(field[x, y, z - 1], field[x, y - 1, z - 1], field[x, y - 1, z], field[x, y - 1, z + 1])
                    for dy in range(-1, 2):
                        near = min(near, field[x - 1, y + dy, z - 1], field[x - 1, y + dy, z], field[x - 1, y + dy, z + 1])
                    if near < FAR:
                        field[x, y, z] = min(best, np.uint8(near + 1))
    for x in range(sx, 0, -1):
        for y in range(sy, 0, -1):
            for z in range(sz, 0, -1):
                best = field[x, y, z]
                if best > 0:
                    near = min(field[x, y, z + 1], field[x, y + 1, z - 1], field[x, y + 1, z], field[x, y + 1, z + 1])
                    for dy in range(-1, 2):
                        near = min(near, field[x + 1, y + dy, z - 1], field[x + 1, y + dy, z], field[x + 1, y + dy, z + 1])
                    if near < FAR:
                        field[x, y, z] = min(best, np.uint8(near + 1))
    return field[1 : sx + 1, 1 : sy + 1, 1 : sz + 1].copy()


@njit(cache=True, inline="always", error_model="numpy")
def reaches(field, ox, oy, oz, tx, ty, tz, tolerance):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Does the ray from (ox, oy, oz) meet no occupied cell before cell (tx, ty, tz)? Coordinates in cells of the window.

    Occupied cells that the ray enters at most `tolerance` cells (along its main axis) before the target's centre don't count.
    """
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
    stop = length - tolerance
    near = field[x, y, z]
    if near == 0:
        near = 1  # the view itself may stand in an occupied cell
    while True:
        if near > 3:
            s += near - 1
            if s >= stop:
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
        if s >= stop or (x == tx and y == ty and z == tz):
            return True
        near = field[x, y, z]
        if near == 0:
            return False


@njit(cache=True, nogil=True, error_model="numpy")
def cast(field, low, views, radius, tolerance, cells, starts, table, indptr, words, masks):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Seen rows of each view as words of 64 rows: word numbers and bit masks, from indptr[v] on; returns their count a view.

    `views` are in cells of the whole grid, `field` covers a window at `low`; indptr must leave room for every word in range.
    """
    counts = np.zeros(len(views), np.int64)
    for v in range(len(views)):
        found = bricks_in_range(table, views[v], radius)
        ox, oy, oz = views[v, 0] - low[0], views[v, 1] - low[1], views[v, 2] - low[2]
        at = indptr[v]
        word, mask = np.int64(-1), np.uint64(0)
        for b in found:
            for i in range(starts[b], starts[b + 1]):
                tx, ty, tz = cells[i, 0] - low[0], cells[i, 1] - low[1], cells[i, 2] - low[2]
                if (tx + 0.5 - ox) ** 2 + (ty + 0.5 - oy) ** 2 + (tz + 0.5 - oz) ** 2 > radius * radius:
                    continue
                if reaches(field, ox, oy, oz, tx, ty, tz, tolerance):
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
def bricks_in_range(table, view, radius):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Ascending numbers of the bricks that reach within `radius` cells of a view."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        low[a] = max(np.int64(np.floor((view[a] - radius) / 8)), 0)
        high[a] = min(np.int64(np.floor((view[a] + radius) / 8)) + 1, table.shape[a])
    found = np.empty(max(high[0] - low[0], 0) * max(high[1] - low[1], 0) * max(high[2] - low[2], 0), np.int64)
    n = 0
    for x in range(low[0], high[0]):
        gx = max(8 * x - view[0], view[0] - 8 * (x + 1), 0.0)
        for y in range(low[1], high[1]):
            gy = max(8 * y - view[1], view[1] - 8 * (y + 1), 0.0)
            for z in range(low[2], high[2]):
                gz = max(8 * z - view[2], view[2] - 8 * (z + 1), 0.0)
                if table[x, y, z] >= 0 and gx * gx + gy * gy + gz * gz <= radius * radius:
                    found[n] = table[x, y, z]
                    n += 1
    return np.sort(found[:n])


@njit(cache=True, nogil=True)
def room_for_words(views, radius, starts, table):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(v,) how many words of 64 rows each view may touch."""
    room = np.zeros(len(views), np.int64)
    for v in range(len(views)):
        total = np.int64(0)
        for b in bricks_in_range(table, views[v], radius):
            total += ((starts[b + 1] - 1) >> 6) - (starts[b] >> 6) + 1
        room[v] = total
    return room
