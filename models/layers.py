"""Parts that the encoders share: small perceptrons, standardised inputs, sums over the neighbours of a room."""

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
            found = logarithm(values.double())
            spread = found.std(dim=0, unbiased=False)
            self.mean.copy_(found.mean(dim=0))
            self.spread.copy_(torch.where(spread > 1e-4, spread, torch.ones_like(spread)))


def logarithm(values: Tensor) -> Tensor:
    """Sign times the logarithm of 1 + size."""
    return values.sign() * values.abs().log1p()


def segment_sum(values: Tensor, index: Tensor, count: int) -> Tensor:
    """(count, W) sums of the rows (n, W) that have each index (n,); 0 where there is none."""
    out: Tensor = torch.zeros((count, values.shape[1]), dtype=values.dtype, device=values.device).index_add(0, index, values)
    return out


def segment_mean(values: Tensor, index: Tensor, count: int) -> Tensor:
    """(count, W) means likewise."""
    ones = torch.ones((values.shape[0], 1), dtype=values.dtype, device=values.device)
    return segment_sum(values, index, count) / segment_sum(ones, index, count).clamp(min=1)


def segment_max(values: Tensor, index: Tensor, count: int) -> Tensor:
    """(count, W) largest of values (n, W) of 0 and more likewise."""
    zeros = torch.zeros((count, values.shape[1]), dtype=values.dtype, device=values.device)
    out: Tensor = zeros.scatter_reduce(0, index[:, None].expand(-1, values.shape[1]), values, "amax")
    return out


def segment_softmax(scores: Tensor, index: Tensor, count: int) -> Tensor:
    """(n, H) softmax of scores (n, H) among the rows with the same index.

    Scores are bounded, not shifted by the largest one of each index: exp of 30 is far from overflow, and the graph is simpler.
    """
    weight = (30 * torch.tanh(scores / 30)).exp()
    return weight / segment_sum(weight, index, count)[index].clamp(min=1e-12)
