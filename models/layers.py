"""Parts that the encoders share: small perceptrons and standardised inputs."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn


def mlp(*widths: int, dropout: float = 0.0) -> nn.Sequential:
    """Linear layers with a layer norm and a ReLU after all but the last."""
    layers: list[nn.Module] = []
    for k, (a, b) in enumerate(itertools.pairwise(widths)):
        layers.append(nn.Linear(a, b))
        if k < len(widths) - 2:
            layers += [nn.LayerNorm(b), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers)


class Standardise(nn.Module):
    """Columns as signed logarithms, then scaled by the statistics of the training set; they are buffers, saved with the weights.

    Sizes span orders of magnitude, and how much a partial view changes them goes with the size: hence the logarithm.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("spread", torch.ones(width))

    def forward(self, values: Tensor) -> Tensor:
        out: Tensor = ((logarithm(values) - self.mean) / self.spread).clamp(-5, 5)
        return out

    def fit(self, values: Tensor) -> None:
        """Take mean and standard deviation from rows (n, width); columns that never change are left as they are."""
        if len(values):
            logarithms = logarithm(values.double())
            spread = logarithms.std(dim=0, unbiased=False)
            self.mean.copy_(logarithms.mean(dim=0))
            self.spread.copy_(torch.where(spread > 1e-4, spread, torch.ones_like(spread)))


def logarithm(values: Tensor) -> Tensor:
    """Sign times the logarithm of 1 + size."""
    return values.sign() * values.abs().log1p()
