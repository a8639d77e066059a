"""How the doors of a room lie to each other: an edge learns from the other edges that leave its room."""

from __future__ import annotations

import torch
from topomerge.models.layers import segment_mean, segment_sum
from torch import Tensor, nn


class DoorLayer(nn.Module):
    """Features (E, width) of edges and of every two doors of a room -> (E, width); a layer over the line graph.

    Distances between doors, and the angle between them at the room's middle, depend on no frame and hardly on how much of
    the room was seen.
    """

    def __init__(self, width: int, pair: int) -> None:
        super().__init__()
        self.pair = nn.Sequential(nn.Linear(2 * width + pair, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.out = nn.Sequential(nn.Linear(2 * width, width), nn.LayerNorm(width))

    def forward(self, edges: Tensor, door_index: Tensor, door_attr: Tensor) -> Tensor:
        first, second = door_index
        told = self.pair(torch.cat([edges[first], edges[second], door_attr], dim=1))
        mean, total = (f(told, first, edges.shape[0]) for f in (segment_mean, segment_sum))
        out: Tensor = edges + self.out(torch.cat([mean, total / 4], dim=1))
        return out
