"""Sampling of crops as one kernel of a card, in Triton, which comes with torch's builds for CUDA.

The same as `crop_sampling.sample_by_torch`, which passes over memory some forty times for what is one read of a pixel here.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from topomerge.training.batches import BEND_STEP
from topomerge.training.crop_sampling import EVEN_BYTES, ROOM_BYTE, Crops, Storeys, Views

BLOCK = 256  # pixels that a program samples


@triton.jit
def _interpolate(knots, start, columns, u, v, axis):  # type: ignore[no-untyped-def]  # pragma: no cover
    a = tl.load(knots + 2 * start + axis)
    b = tl.load(knots + 2 * (start + columns) + axis)
    c = tl.load(knots + 2 * (start + 1) + axis)
    d = tl.load(knots + 2 * (start + columns + 1) + axis)
    low = a + u * (b - a)
    return low + v * (c + u * (d - c) - low)


@triton.jit
def _sample(  # type: ignore[no-untyped-def]  # pragma: no cover
    out, pixels, rooms, centre, turned, parts, numbers, sizes, firsts, masks, patches, knots, rows, columns,
    SIDE: tl.constexpr, STEP: tl.constexpr, BITS: tl.constexpr, PATCHES: tl.constexpr, BEND: tl.constexpr, DRIFTS: tl.constexpr,
    MASKED: tl.constexpr, EVEN: tl.constexpr, ROOM: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    crop = tl.program_id(0).to(tl.int64)
    pixel = tl.program_id(1) * WIDTH + tl.arange(0, WIDTH)
    part, number = tl.load(parts + crop), tl.load(numbers + crop)
    c0, c1 = tl.load(centre + 2 * crop), tl.load(centre + 2 * crop + 1)
    t00, t01 = tl.load(turned + 4 * crop), tl.load(turned + 4 * crop + 1)
    t10, t11 = tl.load(turned + 4 * crop + 2), tl.load(turned + 4 * crop + 3)
    size_x, size_y = tl.load(sizes + 2 * part), tl.load(sizes + 2 * part + 1)
    first = tl.load(firsts + part)
    gx = ((pixel // SIDE).to(tl.float32) + (0.5 - SIDE / 2)) * STEP
    gy = ((pixel % SIDE).to(tl.float32) + (0.5 - SIDE / 2)) * STEP
    px = c0 + (t00 * gx + t01 * gy)
    py = c1 + (t10 * gx + t11 * gy)
    if DRIFTS:
        ax = tl.minimum(tl.maximum(px / BEND, 0.0), (size_x // BEND + 1).to(tl.float32) - 1e-3)
        ay = tl.minimum(tl.maximum(py / BEND, 0.0), (size_y // BEND + 1).to(tl.float32) - 1e-3)
        low_x, low_y = tl.floor(ax), tl.floor(ay)
        start = part * (rows * columns) + low_x.to(tl.int64) * columns + low_y.to(tl.int64)
        u, v = ax - low_x, ay - low_y
        px = px - _interpolate(knots, start, columns, u, v, 0)
        py = py - _interpolate(knots, start, columns, u, v, 1)
    mask = tl.load(masks + part) if MASKED else tl.full((), -1, tl.int64)
    even = tl.zeros((WIDTH,), tl.int64)
    odd = tl.zeros((WIDTH,), tl.int64)
    for k in range(STEP * STEP):
        fx = (k // STEP) * 1.0 + (0.5 - STEP / 2)
        fy = (k % STEP) * 1.0 + (0.5 - STEP / 2)
        x = tl.floor(px + (t00 * fx + t01 * fy))
        y = tl.floor(py + (t10 * fx + t11 * fy))
        present = (x >= 0) & (y >= 0) & (x < size_x.to(tl.float32)) & (y < size_y.to(tl.float32)) & (pixel < SIDE * SIDE)
        for p in range(PATCHES):
            corner = patches + part * 4 * PATCHES + p
            inside = (x >= tl.load(corner)) & (y >= tl.load(corner + PATCHES))
            inside = inside & (x < tl.load(corner + 2 * PATCHES)) & (y < tl.load(corner + 3 * PATCHES))
            present = present & (inside == 0)
        at = first + x.to(tl.int64) * size_y + y.to(tl.int64)
        value = tl.load(pixels + at, mask=present, other=0) & mask
        value = tl.where(tl.load(rooms + at, mask=present, other=-1).to(tl.int64) == number, value | ROOM, value)
        value = tl.where(present, value, 0)
        even += value & EVEN
        odd += (value >> 8) & EVEN
    result = ((even >> BITS) & EVEN) | (((odd >> BITS) & EVEN) << 8)
    tl.store(out + crop * (SIDE * SIDE) + pixel, result, mask=pixel < SIDE * SIDE)


def sample_by_kernel(storeys: Storeys, views: Views, crops: Crops) -> Tensor:
    """Return (n, side * side) int64, eight bytes a pixel, as `crop_sampling.sample_by_torch`; at least one crop."""
    count, side, step = len(crops.part), crops.side, crops.step
    out = torch.empty((count, side * side), dtype=torch.int64, device=crops.part.device)
    knots, patches, mask = views.knots, views.patches, views.mask
    empty = out.new_zeros(1)
    rows, columns = (0, 0) if knots is None else knots.shape[1:3]
    _sample[(count, triton.cdiv(side * side, BLOCK))](
        out, storeys.pixels, storeys.rooms, crops.centre.contiguous(), crops.turned.contiguous(), crops.part, crops.number,
        views.size.contiguous(), views.first.contiguous(), empty if mask is None else mask, empty if patches is None else patches,
        empty if knots is None else knots.contiguous(), rows, columns, SIDE=side, STEP=step, BITS=(step * step).bit_length() - 1,
        PATCHES=0 if patches is None else patches.shape[2], BEND=BEND_STEP, DRIFTS=knots is not None, MASKED=mask is not None,
        EVEN=EVEN_BYTES, ROOM=ROOM_BYTE, WIDTH=BLOCK,
    )  # fmt: skip
    return out
