"""The node encoder: layers over the graph of rooms, stacked."""

from __future__ import annotations

from itertools import pairwise

import torch
from topomerge.models.doors import DoorLayer
from topomerge.models.gat import GatLayer
from topomerge.models.layers import Standardise
from topomerge.models.sage import SageLayer
from torch import Tensor, nn

from topomerge.embedding.network import Node

KNOTS, DISTANCE = 11, 5  # bumps of the distance between two rooms, which is this column of edge_attr
EDGE, PAIR, NEAR = 11, 3, 5  # widths of edge_attr and door_attr (`embedding.graph`), and of near_attr (`embedding.door_layout`)


def dense(*widths: int) -> nn.Sequential:
    """Linear layers, each with a layer norm and a ReLU."""
    return nn.Sequential(*(part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU())))


def bumps(distance: Tensor) -> Tensor:
    """(n,) m -> (n, KNOTS): distances are told as bumps 1 m apart, so that 3 m and 4 m are two things."""
    knots = torch.arange(KNOTS, dtype=distance.dtype, device=distance.device)
    return (-((distance[:, None] - knots) ** 2)).exp()


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
            wide = (EDGE + KNOTS, 2 * told) if settings.around else (EDGE,)
            self.edge = dense(*wide, told)
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
            scaled = self.edges(edge_attr)
            edges = self.edge(torch.cat([scaled, bumps(edge_attr[:, DISTANCE])], dim=1) if self.settings.around else scaled)
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
