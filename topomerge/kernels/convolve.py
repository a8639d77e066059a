"""3 x 3 convolutions of images: the compiled loop behind `numpy_nn.convolution`.

A padded image is one long row of pixels, in which the nine neighbours of every pixel lie at the same nine offsets. So the loop
runs over a long stretch whatever the image's shape, eight pixels an instruction; the pixels between two rows are nobody's and
are cut off. Each stretch read serves four channels at once, and its sums stay in the processor's nearest cache. It takes one
thread: images are small, and threads that wait for each other after each take longer where other work shares the cores.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

STRETCH = 512  # pixels at a time
TOGETHER = 4  # channels at a time


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _rectified(x, place, offset, weight, bias, length, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """x (n, phases, c, pixels); place, offset (9,) phase and offset of each neighbour; weight (k, c, 9)."""
    count, channels = out.shape[:2]
    stretches = (length + STRETCH - 1) // STRETCH
    sums = np.empty((TOGETHER, STRETCH), np.float32)
    for task in range(count * stretches):
        image, low = task // stretches, task % stretches * STRETCH
        size = min(STRETCH, length - low)
        first, second, third, fourth = sums[0], sums[1], sums[2], sums[3]
        for k in range(0, channels, TOGETHER):
            for at in range(TOGETHER):
                sums[at] = bias[k + at]
            for c in range(x.shape[2]):
                for tap in range(0, 9, 3):
                    u = x[image, place[tap], c, low + offset[tap] :]
                    v = x[image, place[tap + 1], c, low + offset[tap + 1] :]
                    w = x[image, place[tap + 2], c, low + offset[tap + 2] :]
                    a0, a1, a2 = weight[k, c, tap], weight[k, c, tap + 1], weight[k, c, tap + 2]
                    b0, b1, b2 = weight[k + 1, c, tap], weight[k + 1, c, tap + 1], weight[k + 1, c, tap + 2]
                    c0, c1, c2 = weight[k + 2, c, tap], weight[k + 2, c, tap + 1], weight[k + 2, c, tap + 2]
                    d0, d1, d2 = weight[k + 3, c, tap], weight[k + 3, c, tap + 1], weight[k + 3, c, tap + 2]
                    for j in range(size):
                        first[j] += a0 * u[j] + a1 * v[j] + a2 * w[j]
                        second[j] += b0 * u[j] + b1 * v[j] + b2 * w[j]
                        third[j] += c0 * u[j] + c1 * v[j] + c2 * w[j]
                        fourth[j] += d0 * u[j] + d1 * v[j] + d2 * w[j]
            for at in range(TOGETHER):
                for j in range(size):
                    out[image, k + at, low + j] = max(sums[at, j], np.float32(0))


def rectified(images: NDArray[Any], kernel: NDArray[Any], bias: NDArray[Any], stride: int) -> NDArray[np.float32]:
    """(n, c, nx, ny) -> (n, k, nx / stride, ny / stride) float32, what is below 0 becomes 0; zeros around the images.

    Args:
        kernel: (k, c, 3, 3).
        bias: (k,).
        stride: divides both sides.
    """
    n, channels = images.shape[:2]
    nx, ny = (side // stride for side in images.shape[2:])
    tall, wide = nx + 2 // stride, ny + 2 // stride
    padded = np.zeros((n, channels, stride * tall, stride * wide), np.float32)
    padded[:, :, 1:-1, 1:-1] = images
    phases = padded.reshape(n, channels, tall, stride, wide, stride).transpose(0, 3, 5, 1, 2, 4)  # every stride-th pixel is one
    pixels = np.ascontiguousarray(phases).reshape(n, stride * stride, channels, tall * wide)
    u, v = np.divmod(np.arange(9), 3)
    place, offset = u % stride * stride + v % stride, u // stride * wide + v // stride
    more = -len(kernel) % TOGETHER
    weight = np.pad(kernel.reshape(-1, channels, 9).astype(np.float32), ((0, more), (0, 0), (0, 0)))
    out = np.zeros((n, len(weight), nx * wide), np.float32)
    length = max((nx - 1) * wide + ny, 0)
    _rectified(pixels, place, offset, weight, np.pad(bias.astype(np.float32), (0, more)), length, out)
    return out.reshape(n, len(weight), nx, wide)[:, : len(kernel), :, :ny]
