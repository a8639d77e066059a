"""PointNet on the points of a room (Qi et al. 2017), and a variant that looks at neighbourhoods first (PointNet++)."""

from __future__ import annotations

import torch
from topomerge.models.layers import mlp
from torch import Tensor, nn

COORDINATE_UNIT = 4.0  # m: coordinates come as multiples of it, so that they are of the order of 1; the scale stays known


class PointNet(nn.Module):
    """Points (R, P, 3), m, about the middle of the room's floor -> (R, width)."""

    def __init__(self, width: int, inside: tuple[int, int, int] = (32, 64, 128)) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in zip((4, *inside[:-1]), inside, strict=True):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.each = nn.Sequential(*layers)
        self.all = mlp(2 * inside[-1], inside[-1], width)

    def forward(self, points: Tensor) -> Tensor:
        features = self.each(with_radius(points))
        out: Tensor = self.all(torch.cat([features.amax(dim=1), features.mean(dim=1)], dim=1))
        return out


class LocalPointNet(nn.Module):
    """As PointNet, of the neighbourhoods of points that are spread over the room."""

    def __init__(self, width: int, centres: int = 48, near: int = 16) -> None:
        super().__init__()
        self.centres, self.near = centres, near
        self.local = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
        self.each = nn.Sequential(nn.Linear(64 + 4, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU())
        self.all = mlp(256, 128, width)

    def forward(self, points: Tensor) -> Tensor:
        rows = torch.arange(points.shape[0], device=points.device)[:, None]
        chosen = farthest(points, min(self.centres, points.shape[1]))
        middle = points[rows, chosen]
        around = points[rows[:, :, None], nearest(points, middle, min(self.near, points.shape[1]))]
        local = self.local(around - middle[:, :, None]).amax(dim=2)  # metres: a neighbourhood is of the order of 1
        features = self.each(torch.cat([local, with_radius(middle)], dim=2))
        out: Tensor = self.all(torch.cat([features.amax(dim=1), features.mean(dim=1)], dim=1))
        return out


def with_radius(points: Tensor) -> Tensor:
    """(R, P, 4) coordinates over `COORDINATE_UNIT`, and the distance from the middle seen from above, which no turn changes."""
    # The root of a sum that is never 0 has a gradient at the middle, too.
    radius = ((points[..., :2] ** 2).sum(dim=-1, keepdim=True) + 1e-6).sqrt()
    return torch.cat([points, radius], dim=-1) / COORDINATE_UNIT


def farthest(points: Tensor, number: int) -> Tensor:
    """(R, number) rows of points (R, P, 3), each as far as possible from those before; the first is farthest from the middle."""
    chosen = [(points**2).sum(dim=2).argmax(dim=1)]
    apart = torch.full(points.shape[:2], torch.inf, dtype=points.dtype, device=points.device)
    for _ in range(number - 1):
        last = points.gather(1, chosen[-1][:, None, None].expand(-1, 1, 3))
        apart = torch.minimum(apart, ((points - last) ** 2).sum(dim=2))
        chosen.append(apart.argmax(dim=1))
    return torch.stack(chosen, dim=1)


def nearest(points: Tensor, centres: Tensor, number: int) -> Tensor:
    """(R, C, number) rows of the points (R, P, 3) that are nearest to each centre (R, C, 3)."""
    return torch.cdist(centres, points).topk(number, dim=2, largest=False).indices
