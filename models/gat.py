"""Graph attention (GATv2: Brody et al. 2022) over the graph of rooms, with or without the features of edges."""

from __future__ import annotations

import torch
from topomerge.models.layers import segment_softmax, segment_sum
from torch import Tensor, nn
from torch.nn.functional import leaky_relu


class GatLayer(nn.Module):
    """(R, width) -> (R, width): neighbours weighed by what they and the edge are like.

    Args:
        edges: width of the features of edges; 0: none.
        told: edges are part of what is summed, not of the weights only as in the paper: how far away and behind which turn a
            neighbour lies is itself worth knowing.
    """

    def __init__(self, width: int, edges: int, heads: int = 4, told: bool = True) -> None:
        super().__init__()
        self.heads, self.each = heads, width // heads
        self.here, self.there = nn.Linear(width, width), nn.Linear(width, width)
        self.edge = nn.Linear(edges, width, bias=False) if edges else None
        self.score = nn.Parameter(torch.empty(heads, self.each))
        nn.init.xavier_uniform_(self.score)
        self.value = nn.Linear(width, width)
        self.edge_value = nn.Linear(edges, width, bias=False) if edges and told else None
        self.out = nn.Linear(width, width)

    def forward(self, rooms: Tensor, edge_index: Tensor, edges: Tensor | None) -> Tensor:
        here, there = edge_index
        asked, value = self.here(rooms)[here] + self.there(rooms)[there], self.value(rooms)[there]
        if self.edge is not None and edges is not None:
            asked = asked + self.edge(edges)
        if self.edge_value is not None and edges is not None:
            value = value + self.edge_value(edges)
        score = (leaky_relu(asked.view(-1, self.heads, self.each), 0.2) * self.score).sum(dim=2)
        weight = segment_softmax(score, here, rooms.shape[0])
        weighed = (value.view(-1, self.heads, self.each) * weight[:, :, None]).flatten(1)
        out: Tensor = self.out(segment_sum(weighed, here, rooms.shape[0]))
        return out
