"""The node encoder: layers over the graph of rooms, stacked."""

from __future__ import annotations

import torch
from topomerge.models.doors import DoorLayer
from topomerge.models.gat import GatLayer
from topomerge.models.layers import Standardise
from topomerge.models.sage import SageLayer
from torch import Tensor, nn

from topomerge.embedding.network import Node

EDGE, PAIR, NEAR = 11, 3, 5  # widths of edge_attr and door_attr (`embedding.graph`), and of near_attr (`embedding.door_layout`)


class NodeEncoder(nn.Module):
    """(R, width) -> (R, out): each room with what it knows of its neighbours.

    Args:
        settings: kind of layer and how they are stacked; kind `none` gives the rooms back.
        width: of the rooms.
    """

    def __init__(self, settings: Node, width: int, dropout: float) -> None:
        super().__init__()
        self.settings = settings
        told = settings.width if settings.edges else 0
        self.edges, self.edge, self.pairs, self.doors = None, None, None, nn.ModuleList()
        if told and settings.kind != "none":
            self.edges = Standardise(EDGE)
            self.edge = nn.Sequential(nn.Linear(EDGE, told), nn.LayerNorm(told), nn.ReLU())
        if settings.doors and settings.kind != "none":
            pair = NEAR if settings.near else PAIR
            self.pairs = Standardise(pair)
            self.doors = nn.ModuleList(DoorLayer(told, pair) for _ in range(settings.doors))
        count = 0 if settings.kind == "none" else settings.layers
        if settings.kind == "gat":
            layers: list[nn.Module] = [GatLayer(width, told, settings.heads, settings.told) for _ in range(count)]
        else:
            layers = [SageLayer(width, told) for _ in range(count)]
        self.layers = nn.ModuleList(layers)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(count))
        self.drop = nn.Dropout(dropout)
        self.out = width * (count + 1) if settings.jump == "cat" else width

    def forward(
        self, rooms: Tensor, edge_index: Tensor, edge_attr: Tensor, pair_index: Tensor | None, pair_attr: Tensor | None
    ) -> Tensor:
        edges = None
        if self.edges is not None and self.edge is not None:
            edges = self.edge(self.edges(edge_attr))
            for layer in self.doors:
                assert self.pairs is not None and pair_index is not None and pair_attr is not None
                edges = layer(edges, pair_index, self.pairs(pair_attr), pair_attr[:, 0])
        found = [rooms]
        for layer, norm in zip(self.layers, self.norms, strict=True):
            told = self.drop(torch.relu(norm(layer(found[-1], edge_index, edges))))
            found.append(found[-1] + told if self.settings.skip else told)
        if self.settings.jump == "cat":
            return torch.cat(found, dim=1)
        return torch.stack(found).amax(dim=0) if self.settings.jump == "max" else found[-1]
