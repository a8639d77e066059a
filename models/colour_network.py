"""The network of the colours of walls in torch (`extraction.elevations.colour_network` runs it in NumPy)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from topomerge.extraction.elevations.colour_network import ALONG_LAYERS, COLOUR_CLASSES, INPUTS
from topomerge.extraction.elevations.wall_network import DILATIONS, TAPS
from topomerge.types import Array


class ColourNetwork(nn.Module):
    """(n, w, 108) places along walls and their scores by shape (n, w, 4) to their scores (n, 4, w) by shape and colours. Before
    it is trained it changes nothing.

    Args:
        width: channels of all layers.
        dropout: of the channels of what it reads of a place.
    """

    def __init__(self, width: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.into = nn.Linear(INPUTS, width)
        self.along = nn.ModuleList(
            nn.Conv1d(width, width, TAPS, padding=TAPS // 2 * dilation, dilation=dilation) for dilation in DILATIONS
        )
        self.out = nn.Linear(width, len(COLOUR_CLASSES))
        self.dropout = nn.Dropout(dropout)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, scores: Tensor) -> Tensor:
        """Scores, not normalised."""
        x = self.dropout(torch.relu(self.into(x))).transpose(1, 2)
        for layer in self.along:
            x = torch.relu(layer(x))
        return (scores + self.out(x.transpose(1, 2))).transpose(1, 2)


def exported_colours(network: ColourNetwork) -> dict[str, Array]:
    """Weights for `colour_network.with_colours`: (in, out)."""
    weights = {}
    for name, layer in _layers(network):
        assert layer.bias is not None
        taps = layer.weight.detach().cpu().numpy()
        turned = taps.T if taps.ndim == 2 else taps.transpose(2, 1, 0).reshape(-1, taps.shape[0])
        weights[f"{name}.w"], weights[f"{name}.b"] = turned, layer.bias.detach().cpu().numpy()
    return weights


def _layers(network: ColourNetwork) -> Iterator[tuple[str, nn.Linear | nn.Conv1d]]:
    yield "in", network.into
    for name, layer in zip(ALONG_LAYERS, network.along, strict=True):
        assert isinstance(layer, nn.Conv1d)
        yield name, layer
    yield "out", network.out
