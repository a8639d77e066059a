"""Compiled loops over images: convolution, crops, warps, strips along walls."""

from __future__ import annotations

from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topomerge.kernels import compile_ahead, count_threads, run_side_by_side


@compile_ahead("u1[:,:,::1], i2[:,::1], i8[:,::1], i8[::1], i8, i8")
def cut(planes, room, corner, number, side, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Cut (n, side, side, P + 1) uint8: the planes from each corner on, then how much of each pixel is the room of that number.

    Pixels off the sheet are 0.

    Args:
        planes: (H, W, P) uint8; room: (H, W) int16.
        corner: (n, 2) int64 first pixel of each square; may lie off the sheet.
        number: (n,) int64 room that each square is of.
        step: pixels of the sheet on a side of each pixel cut, which is their mean, rounded down.
    """
    height, width, count = planes.shape
    out = np.zeros((len(corner), side, side, count + 1), np.uint8)
    area, sums = step * step, np.zeros(count + 1, np.int64)
    for k in range(len(corner)):
        left, low = corner[k]
        for i in range(max(0, -left // step), min(side, (height - 1 - left) // step + 1)):
            for j in range(max(0, -low // step), min(side, (width - 1 - low) // step + 1)):
                x, y = left + i * step, low + j * step
                if step == 1:
                    for c in range(count):
                        out[k, i, j, c] = planes[x, y, c]
                    out[k, i, j, count] = 255 * (room[x, y] == number[k])
                    continue
                sums[:] = 0
                for p in range(max(x, 0), min(x + step, height)):
                    for q in range(max(y, 0), min(y + step, width)):
                        sums[count] += 255 * (room[p, q] == number[k])
                        for c in range(count):
                            sums[c] += planes[p, q, c]
                for c in range(count + 1):
                    out[k, i, j, c] = sums[c] // area
    return out


@njit(cache=True, nogil=True)
def interpolate_drift(knots, x, y):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Interpolate the move of the place x, y in a grid of `knots` (2, m, n) float64; those at the border reach
    on for ever."""
    m, n = knots.shape[1] - 1, knots.shape[2] - 1
    x, y = min(max(x, 0.0), m - 1e-9), min(max(y, 0.0), n - 1e-9)
    i, j = int(x), int(y)
    u, v = x - i, y - j
    w = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    dx = w[0] * knots[0, i, j] + w[1] * knots[0, i + 1, j] + w[2] * knots[0, i, j + 1] + w[3] * knots[0, i + 1, j + 1]
    dy = w[0] * knots[1, i, j] + w[1] * knots[1, i + 1, j] + w[2] * knots[1, i, j + 1] + w[3] * knots[1, i + 1, j + 1]
    return dx, dy


@njit(cache=True, nogil=True)
def interpolate_drifts(knots, places):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the (n, 2) drift (`interpolate_drift`) of places (n, 2) float64."""
    out = np.zeros((len(places), 2))
    for k in range(len(places)):
        out[k, 0], out[k, 1] = interpolate_drift(knots, places[k, 0], places[k, 1])
    return out


@njit(cache=True, nogil=True)
def warp_sheet(planes, room, back, low, shape, knots, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return planes (*shape, P) uint8 and rooms (*shape) int16: each pixel is that of the sheet that came there; off it 0 and -1.

    Args:
        planes: (H, W, P) uint8; room: (H, W) int16.
        back: (2, 2) float64, turns and shrinks a place back to where it was before; low: (2,) float64 place of the first pixel.
        knots: (2, m, n) float64 pixels that places `step` pixels apart had moved before.
    """
    height, width, count = planes.shape
    out, of = np.zeros((shape[0], shape[1], count), np.uint8), np.full((shape[0], shape[1]), -1, np.int16)
    for i in range(shape[0]):
        for j in range(shape[1]):
            x, y = i + 0.5 + low[0], j + 0.5 + low[1]
            x, y = back[0, 0] * x + back[0, 1] * y, back[1, 0] * x + back[1, 1] * y
            dx, dy = interpolate_drift(knots, x / step, y / step)
            p, q = int(np.floor(x - dx)), int(np.floor(y - dy))
            if p >= 0 and q >= 0 and p < height and q < width:
                out[i, j], of[i, j] = planes[p, q], room[p, q]
    return out, of


LEAST_FILLED = 1_000_000  # points times strips, below which a thread costs more than it saves
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@compile_ahead("f8[:,::1], f8[:,::1], i8[::1], i8[::1], f8[::1], f8, i8[::1], i8[::1], i8[::1], f8[::1], f4[:,:,::1]")
def _fill(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    points, frames, sizes, starts, low, tile, columns, first, lines, step, out
):
    for p in range(len(points)):
        i, j = int((points[p, 0] - low[0]) // tile), int((points[p, 1] - low[1]) // tile)
        if i < 0 or j < 0 or i >= columns[0] or j >= columns[1]:
            continue
        at = i * columns[1] + j
        for k in range(first[at], first[at + 1]):
            line = lines[k]
            x, y = points[p, 0] - frames[line, 0], points[p, 1] - frames[line, 1]
            ax, ay = frames[line, 2], frames[line, 3]
            ox, oy = frames[line, 4], frames[line, 5]
            v = (x * ox + y * oy) / step[1] - 0.5
            if not -1.0 <= v < out.shape[1]:  # most of them; the exact divisions below are slow
                continue
            u = int((x * ax + y * ay) // step[0])
            w = int((points[p, 2] - frames[line, 6]) // step[2])
            if u < 0 or u >= sizes[line] or w < 0 or w >= out.shape[2]:
                continue
            near = int(np.floor(v))
            far = v - near
            row = starts[line] + u
            if 0 <= near < out.shape[1]:
                out[row, near, w] += 1.0 - far
            if 0 <= near + 1 < out.shape[1]:
                out[row, near + 1, w] += far


def fill_strips(
    points: Floats, frames: Floats, sizes: Ints, shape: tuple[int, int], step: Floats, tile: float
) -> NDArray[np.float32]:
    """Count the points in each element of strips along lines; between two elements across they count for both, in proportion.

    Args:
        points: (n, 3) m.
        frames: (L, 7) lower corner of each strip from above (2), unit vectors along (2) and across (2), and its lower height.
        sizes: (L,) elements along each strip.
        shape: elements across, and above each other.
        step: (3,) m along, across and up of an element.
        tile: m, of the squares in which lines are looked up.

    Returns:
        (sizes.sum(), *shape) float32, one strip after the other.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)])
    out = np.zeros((int(starts[-1]), *shape), np.float32)
    if not len(frames) or not len(points):
        return out
    along, across = sizes * step[0], shape[0] * step[1]
    corners = frames[:, None, :2] + np.array([0.0, 1.0])[:, None] * (along[:, None] * frames[:, 2:4])[:, None]
    corners = np.concatenate([corners, corners + across * frames[:, None, 4:6]], axis=1)
    low = corners.min(axis=(0, 1))
    columns = ((corners.max(axis=(0, 1)) - low) // tile).astype(np.int64) + 1
    table = _find_touched_tiles(frames, along, across, low, tile, columns)

    def fill(own: Ints) -> None:  # strips share no element, so that each gets its points in their order
        first = np.searchsorted(own[:, 0], np.arange(int(columns.prod()) + 1))
        _fill(points, frames, sizes, starts, low, tile, columns, first, np.ascontiguousarray(own[:, 1]), step, out)

    threads = count_threads() if len(points) * len(frames) >= LEAST_FILLED else 1
    run_side_by_side(fill, [table[table[:, 1] % threads == k] for k in range(threads)])
    return out


def _find_touched_tiles(frames: Floats, along: Floats, across: float, low: Floats, tile: float, columns: Ints) -> Ints:
    """Return the (n, 2) square and strip of all that touch each other, ascending: squares of places in a strip that are closer to
    each other than a square is wide."""
    d = np.linspace(0, across, int(np.ceil(4 * across / tile)) + 2)
    aside = tile / 4 * np.array([-1, 0, 1])
    steps = np.ceil(4 * along / tile).astype(np.int64) + 2
    t = np.concatenate([np.linspace(0, long, step) for long, step in zip(along, steps, strict=True)])
    line = np.repeat(np.arange(len(frames)), steps)
    frame = frames[line]
    places = (frame[:, None, :2] + t[:, None, None] * frame[:, None, 2:4]) + d[:, None] * frame[:, None, 4:6]
    x, y = ([np.floor(((places[..., k] + offset) - low[k]) / tile).astype(np.int64) for offset in aside] for k in (0, 1))
    found = []
    for u, v in product(x, y):
        inside = (u >= 0) & (u < columns[0]) & (v >= 0) & (v < columns[1])
        found.append(np.unique(((u * columns[1] + v) * len(frames) + line[:, None])[inside]))
    return np.column_stack(np.divmod(np.unique(np.concatenate(found)), len(frames)))
