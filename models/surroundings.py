"""Crops about rooms -> a vector each: convolutions that halve the sides until four by four pixels are left.

The vector depends on how a crop is turned. That of a room is reckoned for all four quarter turns (`Embedder.turned`), so that it
is equivariant to them by construction: a map that was turned by one has the same rows, one place further.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from topomerge.embedding.surroundings import CROP_PART, CROP_PLANES, CROP_SHAPES, DOOR_PART, WIDE_PART

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
    room has, of which those without a crop are none."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.each = SurroundingsEncoder(DOOR_PART, width, dropout)
        self.out = nn.Linear(2 * width, width)

    def forward(self, crops: Tensor) -> Tensor:
        count, doors = crops.shape[:2]
        there = crops.flatten(2).amax(dim=2) > 0
        if self.training:  # only those that are there: two of three are not
            those = self.each(crops[there]).relu()
            rows = those.new_zeros((count * doors, self.out.in_features // 2)).masked_scatter(there.flatten()[:, None], those)
        else:  # one shape for all maps, as other runtimes need it
            rows = self.each(crops.flatten(0, 1)).relu() * there.flatten()[:, None]
        rows = rows.unflatten(0, (count, doors))
        mean = rows.sum(dim=1) / there.sum(dim=1, keepdim=True).clamp(min=1)
        out: Tensor = self.out(torch.cat([mean, rows.amax(dim=1)], dim=1))
        return out
