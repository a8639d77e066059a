"""The network of places in torch (`fusion.evidence.network` runs it in NumPy): convolutions over two maps laid on one another,
with batch normalisation, which goes into the weights when they are exported."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from topomerge.models.plan_unet import folded
from torch import Tensor, nn

from topomerge.registration.evidence.network import CONVOLUTIONS, PLANES
from topomerge.types import Array


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
        """Log odds."""
        for layer in self.layers.values():
            x = layer(x)
        pooled = torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
        odds: Tensor = self.out(torch.relu(self.hidden(self.drop(pooled))))[:, 0]
        return odds


def exported_weights(network: PlaceNetwork) -> dict[str, Array]:
    """Weights for `place_log_odds`: (9 c, k) with the normalisation in them."""
    weights = folded(network.layers)
    for name, layer in (("f", network.hidden), ("out", network.out)):
        weights[f"{name}.w"], weights[f"{name}.b"] = layer.weight.detach().cpu().numpy().T, layer.bias.detach().cpu().numpy()
    return weights
