"""How doors lie to each other: an edge learns from the doors beside its own."""

from __future__ import annotations

import torch
from topomerge.models.layers import segment_max, segment_mean
from torch import Tensor, nn

KNOTS, STEP = 24, 0.5  # distances are told as 24 bumps, 0.5 m apart: 3.0 m and 3.5 m are two things, not nearly one


class DoorLayer(nn.Module):
    """Features (E, width) of edges and of pairs of them -> (E, width); a layer over the line graph.

    Distances between doors, and the angles at which they lie, depend on no frame and hardly on how much of the room was seen.

    Args:
        pair: width of the features of a pair, of which the first is the distance.
    """

    knots: Tensor

    def __init__(self, width: int, pair: int) -> None:
        super().__init__()
        self.pair = nn.Sequential(
            nn.Linear(2 * width + pair + KNOTS, 2 * width), nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU()
        )
        self.out = nn.Sequential(nn.Linear(2 * width, width), nn.LayerNorm(width))
        self.register_buffer("knots", torch.arange(KNOTS) * STEP, persistent=False)

    def forward(self, edges: Tensor, index: Tensor, scaled: Tensor, distance: Tensor) -> Tensor:
        """Pairs: (2, M) edges, (M, pair) features scaled, (M,) distances, m."""
        first, second = index
        bumps = (-(((distance[:, None] - self.knots) / STEP) ** 2)).exp()
        told = self.pair(torch.cat([edges[first], edges[second], scaled, bumps], dim=1))
        # The largest: is there a door like this at all? Doors that this map lacks change it less than they change a mean.
        mean, most = (f(told, first, edges.shape[0]) for f in (segment_mean, segment_max))
        out: Tensor = edges + self.out(torch.cat([mean, most], dim=1))
        return out
