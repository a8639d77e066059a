"""GraphSAGE over the graph of rooms (Hamilton et al. 2017), with or without the features of edges."""

from __future__ import annotations

from topomerge.models.layers import segment_mean
from torch import Tensor, cat, nn


class SageLayer(nn.Module):
    """(R, width) -> (R, width): a room's own row, and the mean over its neighbours.

    With features of edges, what is averaged is made of the neighbour's row and of the edge that leads there: without them the
    neighbours blur (measured: no gain over no graph at all).
    """

    def __init__(self, width: int, edges: int) -> None:
        super().__init__()
        self.own = nn.Linear(width, width)
        self.beside = nn.Sequential(nn.Linear(width + edges, width), nn.ReLU()) if edges else None
        self.around = nn.Linear(width, width, bias=False)

    def forward(self, rooms: Tensor, edge_index: Tensor, edges: Tensor | None) -> Tensor:
        here, there = edge_index
        told = rooms[there]
        if self.beside is not None and edges is not None:
            told = self.beside(cat([told, edges], dim=1))
        out: Tensor = self.own(rooms) + self.around(segment_mean(told, here, rooms.shape[0]))
        return out
