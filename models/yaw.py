"""What makes an encoder of points independent of how the map is turned about the vertical."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class Turned(nn.Module):
    """The mean of what an encoder says about points turned several ways.

    Args:
        encoder: (R, P, 3) -> (R, width).
        yaws: turns spread over a full one. While training without `canonical` it is one: there the turn is drawn at random.
        canonical: first turn the longest axis seen from above into x. With an even number of yaws the result doesn't depend on
            the map's yaw, but for rooms that have no longest axis.
    """

    def __init__(self, encoder: nn.Module, yaws: int = 4, canonical: bool = False) -> None:
        super().__init__()
        self.encoder, self.yaws, self.canonical = encoder, yaws, canonical

    def forward(self, points: Tensor) -> Tensor:
        start = -longest_axis(points) if self.canonical else points.new_zeros(points.shape[0])
        number = self.yaws if self.canonical or not self.training else 1
        out = self.encoder(turn(points, start))
        for k in range(1, number):
            out = out + self.encoder(turn(points, start + 2 * math.pi * k / number))
        mean: Tensor = out / number
        return mean


def turn(points: Tensor, angle: Tensor) -> Tensor:
    """Points (R, P, 3) turned about the vertical by an angle (R,) each, counter-clockwise."""
    c, s = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = points.unbind(dim=2)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


def longest_axis(points: Tensor) -> Tensor:
    """(R,) angle of the first principal axis of points (R, P, 3) seen from above, but for half turns."""
    flat = points[..., :2] - points[..., :2].mean(dim=1, keepdim=True)
    x, y = flat.unbind(dim=2)
    return 0.5 * torch.atan2(2 * (x * y).mean(dim=1), (x * x - y * y).mean(dim=1))
