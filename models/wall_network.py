"""The network of elevations in torch (`extraction.elevations.elevation` runs it in NumPy).

Its batch normalisation goes into the weights when they are exported.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from topomerge.models.plan_unet import folded
from torch import Tensor, nn

from topomerge.extraction.elevations.elevation import ALONG_LAYERS, DEPTHS, DILATIONS, PLACES, STRIP_CHANNELS, TAPS, WALL_CLASSES
from topomerge.types import Array


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


def exported_network(network: WallNetwork) -> dict[str, Array]:
    """Weights for `wall_network.place_probabilities`: (in, out), with the normalisation in them."""
    weights = folded(network.layers)
    for name, layer in (("depths", network.depths), ("out", network.out)):
        weights[f"{name}.w"], weights[f"{name}.b"] = layer.weight.detach().cpu().numpy().T, layer.bias.detach().cpu().numpy()
    for name, convolved in zip(ALONG_LAYERS, network.along, strict=True):
        assert isinstance(convolved, nn.Conv1d) and convolved.bias is not None
        taps = convolved.weight.detach().cpu().numpy()  # (out, in, taps)
        weights[f"{name}.w"] = taps.transpose(2, 1, 0).reshape(-1, taps.shape[0])
        weights[f"{name}.b"] = convolved.bias.detach().cpu().numpy()
    return weights
