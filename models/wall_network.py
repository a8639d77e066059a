"""The network of elevations in torch. `extraction.elevations.elevation` runs what is exported of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from topomerge.extraction.elevations.elevation import DEPTHS, DILATIONS, PLACES, STRIP_CHANNELS, TAPS, WALL_CLASSES


class WallNetwork(nn.Module):
    """(n, 17, w, 32) strips along walls to (n, 7, w / 2) scores of `WALL_CLASSES`.

    Args:
        widths: channels of the two convolutions, of the layer of all depths, and of those along the wall.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        first, second, depths, along = widths
        self.layers = nn.ModuleDict(
            {
                "a": nn.Sequential(nn.Conv2d(STRIP_CHANNELS, first, 3, 2, 1, bias=False), nn.BatchNorm2d(first), nn.ReLU()),
                "b": nn.Sequential(nn.Conv2d(first, second, 3, 1, 1, bias=False), nn.BatchNorm2d(second), nn.ReLU()),
            }
        )
        self.depths = nn.Linear(DEPTHS // PLACES * second, depths)
        self.along = nn.ModuleList(
            nn.Conv1d(depths if k == 0 else along, along, TAPS, padding=TAPS // 2 * dilation, dilation=dilation)
            for k, dilation in enumerate(DILATIONS)
        )
        self.out = nn.Linear(along, len(WALL_CLASSES))

    def forward(self, x: Tensor) -> Tensor:
        """Scores, not normalised."""
        x = self.layers["b"](self.layers["a"](x))
        x = torch.relu(self.depths(x.permute(0, 2, 3, 1).flatten(2))).transpose(1, 2)
        for layer in self.along:
            x = torch.relu(layer(x))
        scores: Tensor = self.out(x.transpose(1, 2)).transpose(1, 2)
        return scores


class WallProbabilities(nn.Module):
    """The network on strips as the package has them, with probabilities for scores: what is exported, for `WALL_SIGNATURE`."""

    def __init__(self, network: WallNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, strips: Tensor) -> Tensor:
        """(n, w, 32, 17) to (n, w / 2, 7)."""
        probabilities: Tensor = self.network(strips.permute(0, 3, 1, 2)).transpose(1, 2).softmax(dim=2)
        return probabilities
