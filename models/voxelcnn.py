"""A 3D convolutional network on a dense crop of a room: 32 cells each way, of a size in metres, which keeps the scale."""

from __future__ import annotations

import torch
from topomerge.models.layers import mlp
from torch import Tensor, nn

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
        self.all = mlp(2 * channels[-1], 2 * channels[-1], width)

    def forward(self, points: Tensor) -> Tensor:
        features = self.each(crop(points)).flatten(2)
        out: Tensor = self.all(torch.cat([features.amax(dim=2), features.mean(dim=2)], dim=1))
        return out


def crop(points: Tensor) -> Tensor:
    """(R, 1, 32, 32, 32) cells with a point are 1, the others 0."""
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
