"""The network of plans in torch (`extraction.plans.plan_network` runs it in NumPy): a U-Net (Ronneberger et al. 2015) with batch
normalisation, which goes into the weights when they are exported."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from topomerge.extraction.plans.plan_network import DOWN_LEVELS, EVIDENCE_CHANNELS, UP_LEVELS
from topomerge.extraction.plans.storey_plan import COLUMN_CLASSES
from topomerge.types import Array


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


def exported_weights(network: PlanUNet) -> dict[str, Array]:
    """Weights for `plan_network.forward`: (9 c, k) with the normalisation in them."""
    weights = folded(network.layers)
    weights["out.w"] = network.out.weight.detach().cpu().numpy()[:, :, 0, 0].T
    assert network.out.bias is not None
    weights["out.b"] = network.out.bias.detach().cpu().numpy()
    return weights


def folded(layers: nn.ModuleDict) -> dict[str, Array]:
    """Weights (9 c, k) and biases (k,) of convolutions for NumPy (`numpy_nn.convolution`), by name, with the batch normalisation
    after each of them."""
    weights: dict[str, Array] = {}
    for name, layer in layers.items():
        conv, norm, _ = list(layer.children())
        assert isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
        assert norm.running_var is not None and norm.running_mean is not None
        scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).detach()
        kernel = (conv.weight * scale[:, None, None, None]).detach().cpu().numpy()
        weights[f"{name}.w"] = kernel.transpose(2, 3, 1, 0).reshape(-1, kernel.shape[0])
        weights[f"{name}.b"] = (norm.bias - norm.running_mean * scale).detach().cpu().numpy()
    return weights
