"""The network of plans in torch: a U-Net (Ronneberger et al. 2015) with batch normalisation. `extraction.plans.plan_network` runs
what is exported of it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from topomerge.extraction.plans.plan_network import DOWN_LEVELS, EVIDENCE_CHANNELS, UP_LEVELS
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES


def _layer(channels: int, width: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width), nn.ReLU())


class PlanUNet(nn.Module):
    """(n, 11, nx, ny) evidence of columns to (n, 5, nx, ny) scores of `COLUMN_CLASSES`; sides are multiples of 16.

    Args:
        widths: channels of the four levels down, each of which halves the sides, and of the four up again.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ModuleDict()
        wide, skips = EVIDENCE_CHANNELS, []
        for name, width in zip(DOWN_LEVELS, widths, strict=False):
            skips.append(wide)
            self.layers[f"{name}1"], self.layers[f"{name}2"] = _layer(wide, width, 2), _layer(width, width)
            wide = width
        for name, width in zip(UP_LEVELS, widths[len(DOWN_LEVELS) :], strict=True):
            self.layers[f"{name}1"] = _layer(wide + skips.pop(), width)
            wide = width
        self.out = nn.Conv2d(wide, len(COLUMN_CLASSES), 1)

    def forward(self, x: Tensor) -> Tensor:
        """Scores, not normalised."""
        skips = [x]
        for name in DOWN_LEVELS:
            x = self.layers[f"{name}2"](self.layers[f"{name}1"](x))
            skips.append(x)
        x = skips.pop()
        for name in UP_LEVELS:
            x = torch.cat([nn.functional.interpolate(x, scale_factor=2.0), skips.pop()], dim=1)
            x = self.layers[f"{name}1"](x)
        scores: Tensor = self.out(x)
        return scores


class PlanProbabilities(nn.Module):
    """The network with probabilities for scores: what is exported, for `plan_network.PLAN_SIGNATURE`."""

    def __init__(self, network: PlanUNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, evidence: Tensor) -> Tensor:
        """(n, 11, nx, ny) to (n, 5, nx, ny)."""
        probabilities: Tensor = self.network(evidence).softmax(dim=1)
        return probabilities
