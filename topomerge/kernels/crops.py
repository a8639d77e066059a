"""Squares cut out of a sheet of pixels: the compiled loop behind `embedding.surroundings.crops`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def cut(planes, room, corner, number, side, step):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(n, side, side, P + 1) uint8: the planes from each corner on, then how much of each pixel is the room of that number.

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
