"""Convolutional networks over plans, walls and places."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from topomerge.extraction.elevations.elevation import DEPTHS, DILATIONS, PLACES, STRIP_CHANNELS, TAPS, WALL_CLASSES
from topomerge.extraction.plans.plan_network import DOWN_LEVELS, EVIDENCE_CHANNELS, UP_LEVELS
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES
from topomerge.networks.drawing import DRAWING_CLASSES
from topomerge.registration.places import CONVOLUTIONS, PLANES


def _build_layer(channels: int, width: int, stride: int = 1) -> nn.Sequential:
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
            self.layers[f"{name}1"], self.layers[f"{name}2"] = _build_layer(wide, width, 2), _build_layer(width, width)
            wide = width
        for name, width in zip(UP_LEVELS, widths[len(DOWN_LEVELS) :], strict=True):
            self.layers[f"{name}1"] = _build_layer(wide + skips.pop(), width)
            wide = width
        self.out = nn.Conv2d(wide, len(COLUMN_CLASSES), 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores, not normalised."""
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
        """Return (n, 11, nx, ny) to (n, 5, nx, ny)."""
        probabilities: Tensor = self.network(evidence).softmax(dim=1)
        return probabilities


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
        """Return scores, not normalised."""
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
        """Return (n, w, 32, 17) to (n, w / 2, 7)."""
        probabilities: Tensor = self.network(strips.permute(0, 3, 1, 2)).transpose(1, 2).softmax(dim=2)
        return probabilities


class PlaceNetwork(nn.Module):
    """(n, PLANES, side, side) planes to (n,) log odds of one place.

    Args:
        widths: channels of the convolutions, and units of the layer after them.
    """

    def __init__(self, widths: Sequence[int], dropout: float = 0.0) -> None:
        super().__init__()
        self.layers, wide = nn.ModuleDict(), PLANES
        for (name, stride), width in zip(CONVOLUTIONS.items(), widths, strict=False):
            conv = nn.Conv2d(wide, width, 3, stride, 1, bias=False)
            self.layers[name] = nn.Sequential(conv, nn.BatchNorm2d(width), nn.ReLU())
            wide = width
        self.drop = nn.Dropout(dropout)
        self.hidden = nn.Linear(2 * wide, widths[-1])
        self.out = nn.Linear(widths[-1], 1)

    def forward(self, x: Tensor) -> Tensor:
        """Compute the log odds."""
        for layer in self.layers.values():
            x = layer(x)
        pooled = torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
        odds: Tensor = self.out(torch.relu(self.hidden(self.drop(pooled))))[:, 0]
        return odds


class PlaceLogOdds(nn.Module):
    """The network on planes as the package has them: what is exported, for `PLACE_SIGNATURE`."""

    def __init__(self, network: PlaceNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, planes: Tensor) -> Tensor:
        """Return (n, side, side, PLANES) to (n,)."""
        odds: Tensor = self.network(planes.permute(0, 3, 1, 2))
        return odds


class DrawingUNet(nn.Module):
    """(n, 3, h, w) pages to (n, 8, h, w) scores of `networks.drawing.DRAWING_CLASSES`; sides are multiples of 32.

    Args:
        widths: channels of the page's own pixels, and of the five levels below, each of half the side (Ronneberger et al. 2015).
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        first, *lower = widths
        self.first = nn.Sequential(_build_layer(3, first), _build_layer(first, first))
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for wide, width in zip(widths, lower, strict=False):
            self.down.append(nn.Sequential(_build_layer(wide, width, 2), _build_layer(width, width)))
        for wide, width in zip(reversed(lower), reversed(widths[:-1]), strict=True):
            self.up.append(_build_layer(wide + width, width))
        self.out = nn.Conv2d(first, len(DRAWING_CLASSES), 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return scores, not normalised."""
        skips = [self.first(x)]
        for layer in self.down:
            skips.append(layer(skips[-1]))
        x = skips.pop()
        for layer in self.up:
            x = layer(torch.cat([nn.functional.interpolate(x, scale_factor=2.0), skips.pop()], dim=1))
        scores: Tensor = self.out(x)
        return scores


class DrawingProbabilities(nn.Module):
    """The network with probabilities for scores: what is exported, for `networks.drawing.DRAWING_SIGNATURE`."""

    def __init__(self, network: DrawingUNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, picture: Tensor) -> Tensor:
        """Return (n, 3, h, w) to (n, 8, h, w)."""
        probabilities: Tensor = self.network(picture).softmax(dim=1)
        return probabilities
