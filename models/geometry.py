"""Geometry encoders: points, voxels and surroundings of a room."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from topomerge.models.nodes import build_mlp
from torch import Tensor, nn

from topomerge.embedding.surroundings import CROP_PART, CROP_PLANES, CROP_SHAPES, DOOR_PART, WIDE_PART

COORDINATE_UNIT = 4.0  # m: coordinates come as multiples of it, so that they are of the order of 1; the scale stays known


class PointNet(nn.Module):
    """Points (R, P, 3), m, about the middle of the room's floor -> (R, width)."""

    def __init__(self, width: int, inside: tuple[int, int, int] = (32, 64, 128)) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in zip((4, *inside[:-1]), inside, strict=True):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.each = nn.Sequential(*layers)
        self.all = build_mlp(2 * inside[-1], inside[-1], width)

    def forward(self, points: Tensor) -> Tensor:
        features = self.each(append_radius(points))
        out: Tensor = self.all(torch.cat([features.amax(dim=1), features.mean(dim=1)], dim=1))
        return out


class LocalPointNet(nn.Module):
    """As PointNet, of the neighbourhoods of points that are spread over the room."""

    def __init__(self, width: int, centres: int = 48, near: int = 16) -> None:
        super().__init__()
        self.centres, self.near = centres, near
        self.local = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
        self.each = nn.Sequential(nn.Linear(64 + 4, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU())
        self.all = build_mlp(256, 128, width)

    def forward(self, points: Tensor) -> Tensor:
        rows = torch.arange(points.shape[0], device=points.device)[:, None]
        chosen = sample_farthest(points, min(self.centres, points.shape[1]))
        middle = points[rows, chosen]
        around = points[rows[:, :, None], find_nearest(points, middle, min(self.near, points.shape[1]))]
        local = self.local(around - middle[:, :, None]).amax(dim=2)  # metres: a neighbourhood is of the order of 1
        features = self.each(torch.cat([local, append_radius(middle)], dim=2))
        out: Tensor = self.all(torch.cat([features.amax(dim=1), features.mean(dim=1)], dim=1))
        return out


def append_radius(points: Tensor) -> Tensor:
    """Return (R, P, 4) coordinates over `COORDINATE_UNIT`, and the distance from the middle seen from above, which no turn
    changes."""
    # The root of a sum that is never 0 has a gradient at the middle, too.
    radius = ((points[..., :2] ** 2).sum(dim=-1, keepdim=True) + 1e-6).sqrt()
    return torch.cat([points, radius], dim=-1) / COORDINATE_UNIT


def sample_farthest(points: Tensor, number: int) -> Tensor:
    """Return (R, number) rows of points (R, P, 3), each as far as possible from those before; the first is farthest from the
    middle."""
    chosen = [(points**2).sum(dim=2).argmax(dim=1)]
    apart = torch.full(points.shape[:2], torch.inf, dtype=points.dtype, device=points.device)
    for _ in range(number - 1):
        last = points.gather(1, chosen[-1][:, None, None].expand(-1, 1, 3))
        apart = torch.minimum(apart, ((points - last) ** 2).sum(dim=2))
        chosen.append(apart.argmax(dim=1))
    return torch.stack(chosen, dim=1)


def find_nearest(points: Tensor, centres: Tensor, number: int) -> Tensor:
    """Find (R, C, number) rows of the points (R, P, 3) that are nearest to each centre (R, C, 3)."""
    return torch.cdist(centres, points).topk(number, dim=2, largest=False).indices


CROP_CELLS = 32
CROP_CELL_SIZE = (0.4, 0.4, 0.125)  # m: 12.8 by 12.8 m from above, 4 m of height; what lies outside is cut off
CROP_CELLS_BELOW = 4  # cells under the floor: a step down, noise


class VoxelCNN(nn.Module):
    """Points (R, P, 3), m, about the middle of the room's floor -> (R, width)."""

    def __init__(self, width: int, channels: tuple[int, int, int] = (8, 16, 32)) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in zip((1, *channels[:-1]), channels, strict=True):
            layers += [nn.Conv3d(a, b, 3, stride=2, padding=1), nn.GroupNorm(4, b), nn.ReLU()]
        self.each = nn.Sequential(*layers)
        self.all = build_mlp(2 * channels[-1], 2 * channels[-1], width)

    def forward(self, points: Tensor) -> Tensor:
        features = self.each(voxelize_crop(points)).flatten(2)
        out: Tensor = self.all(torch.cat([features.amax(dim=2), features.mean(dim=2)], dim=1))
        return out


def voxelize_crop(points: Tensor) -> Tensor:
    """Return (R, 1, 32, 32, 32), where cells with a point are 1, the others 0."""
    middle = points.new_tensor([CROP_CELLS / 2, CROP_CELLS / 2, CROP_CELLS_BELOW])
    cell = torch.floor(points / points.new_tensor(CROP_CELL_SIZE) + middle).long()
    inside = ((cell >= 0) & (cell < CROP_CELLS)).all(dim=2)
    cell = cell.clamp(0, CROP_CELLS - 1)
    place = (cell[..., 0] * CROP_CELLS + cell[..., 1]) * CROP_CELLS + cell[..., 2]
    # What lies outside is counted in one place more, which is cut off.
    place = torch.where(inside, place, torch.full_like(place, CROP_CELLS**3))
    grid = torch.zeros((points.shape[0], CROP_CELLS**3 + 1), dtype=points.dtype, device=points.device)
    grid = grid.scatter(1, place, torch.ones_like(points[..., 0]))[:, :-1]
    return grid.reshape(-1, 1, CROP_CELLS, CROP_CELLS, CROP_CELLS)


class YawAverage(nn.Module):
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
        start = -estimate_principal_axis(points) if self.canonical else points.new_zeros(points.shape[0])
        number = self.yaws if self.canonical or not self.training else 1
        out = self.encoder(rotate_yaw(points, start))
        for k in range(1, number):
            out = out + self.encoder(rotate_yaw(points, start + 2 * math.pi * k / number))
        mean: Tensor = out / number
        return mean


def rotate_yaw(points: Tensor, angle: Tensor) -> Tensor:
    """Return points (R, P, 3) turned about the vertical by an angle (R,) each, counter-clockwise."""
    c, s = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = points.unbind(dim=2)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


def estimate_principal_axis(points: Tensor) -> Tensor:
    """Estimate (R,) angle of the first principal axis of points (R, P, 3) seen from above, but for half turns."""
    flat = points[..., :2] - points[..., :2].mean(dim=1, keepdim=True)
    x, y = flat.unbind(dim=2)
    return 0.5 * torch.atan2(2 * (x * y).mean(dim=1), (x * x - y * y).mean(dim=1))


CROP_CHANNELS = {  # of the convolutions of crops, each of which halves the sides
    CROP_PART: (16, 32, 64, 128), WIDE_PART: (16, 32, 64), DOOR_PART: (16, 32, 64),
}  # fmt: skip
FULL_VALUE = 255.0  # of a pixel
CROPS_A_PLAN = 512  # convolutions on CUDA see multiples of so many crops while training


class BatchNorm(nn.Module):
    """As `torch.nn.BatchNorm2d`, without its count of batches: files of weights hold float32 only, and nothing reads it."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Parameter(torch.ones(channels)), nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        return nn.functional.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, self.training)


class SurroundingsEncoder(nn.Module):
    """Crops (n, side, side, len(CROP_PLANES)) uint8 -> (n, width).

    Args:
        part: which crops they are, of `CROP_SHAPES`.
    """

    def __init__(self, part: str, width: int, dropout: float) -> None:
        super().__init__()
        channels = list(pairwise((len(CROP_PLANES), *CROP_CHANNELS[part])))
        self.convolutions = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1, bias=False) for a, b in channels)
        self.norms = nn.ModuleList(BatchNorm(b) for _, b in channels)
        self.drop = nn.Dropout(dropout)
        left = CROP_SHAPES[part][-2] >> len(channels)
        self.out = nn.Linear(left * left * CROP_CHANNELS[part][-1], width)

    def forward(self, crops: Tensor) -> Tensor:
        x = crops.permute(0, 3, 1, 2).float() / FULL_VALUE
        count = len(x)
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            if self.training and x.is_cuda:  # cuDNN looks for a plan, 3 ms, for each number of crops that it has not seen
                x = convolution(nn.functional.pad(x, (0, 0, 0, 0, 0, 0, 0, -count % CROPS_A_PLAN)))[:count]
            else:
                x = convolution(x)
            x = norm(x).relu()
        out: Tensor = self.out(self.drop(x.flatten(1)))
        return out


class DoorsEncoder(nn.Module):
    """Crops of doors (R, DOOR_CROPS, side, side, len(CROP_PLANES)) uint8 -> (R, width): mean and maximum over the doors that a
    room has, of which those without a crop are none.

    Batches that are made on a device say which crops there are: `rows` (D,) of all R * DOOR_CROPS, and `slots` (R, DOOR_CROPS),
    which of the D each is, or D. Nothing has to wait for the device then to count them.
    """

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.each = SurroundingsEncoder(DOOR_PART, width, dropout)
        self.out = nn.Linear(2 * width, width)

    def forward(self, crops: Tensor, rows: Tensor | None = None, slots: Tensor | None = None) -> Tensor:
        count, doors = crops.shape[:2]
        present = crops.flatten(2).amax(dim=2) > 0
        if rows is not None and slots is not None:
            those = self.each(crops.flatten(0, 1).index_select(0, rows)).relu()
            those = torch.cat([those, those.new_zeros((1, those.shape[1]))])
            values = those.index_select(0, slots.flatten()) * present.flatten()[:, None]
        elif self.training:  # only those that are there: two of three are not
            those = self.each(crops[present]).relu()
            values = those.new_zeros((count * doors, self.out.in_features // 2)).masked_scatter(present.flatten()[:, None], those)
        else:  # one shape for all maps, as other runtimes need it
            values = self.each(crops.flatten(0, 1)).relu() * present.flatten()[:, None]
        values = values.unflatten(0, (count, doors))
        mean = values.sum(dim=1) / present.sum(dim=1, keepdim=True).clamp(min=1)
        out: Tensor = self.out(torch.cat([mean, values.amax(dim=1)], dim=1))
        return out
