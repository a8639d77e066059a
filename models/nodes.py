"""The node encoder: layers over the graph of rooms, stacked."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from topomerge.models.door_conv import DoorConv
from topomerge.models.edge_sage_conv import EdgeSAGEConv
from topomerge.models.edge_value_conv import EdgeValueConv
from topomerge.models.layers import Standardise
from torch import Tensor, nn
from torch_geometric.nn import GATv2Conv, SAGEConv

from topomerge.embedding.network import Node, pair_tensors
from topomerge.embedding.schema import column, width

ROOM_KNOTS = 11  # bumps of the distance between two rooms, 1 m apart
WAY_UNIT, WAY_LIMIT = 5.0, 3.0  # m that ways to neighbours are divided by, and how far they tell then


def dense(*widths: int) -> nn.Sequential:
    """Linear layers, each with a layer norm and a ReLU."""
    return nn.Sequential(*(part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU())))


def bumps(distance: Tensor) -> Tensor:
    """(n,) m -> (n, `ROOM_KNOTS`): distances come as bumps 1 m apart, so that 3 m and 4 m are two things."""
    knots = torch.arange(ROOM_KNOTS, dtype=distance.dtype, device=distance.device)
    return (-((distance[:, None] - knots) ** 2)).exp()


def build_sage(settings: Node, channels: int) -> nn.Module:
    """A layer of means over the neighbours."""
    return EdgeSAGEConv(channels, settings.width) if settings.edges else SAGEConv(channels, channels)


def build_gat(settings: Node, channels: int) -> nn.Module:
    """A layer of attention over the neighbours."""
    edge_dim = settings.width if settings.edges else None
    if settings.edge_values:
        return EdgeValueConv(channels, edge_dim, settings.heads)
    return GATv2Conv(channels, channels // settings.heads, settings.heads, edge_dim=edge_dim, add_self_loops=False)


# Kind of node encoder (`Node.kind`, `embedding.network.NODES`) -> what builds one of its layers over the rooms:
# (R, channels), edge_index, edges (E, settings.width) if there are features -> (R, channels).
ROOM_LAYERS: dict[str, Callable[[Node, int], nn.Module]] = {"sage": build_sage, "gat": build_gat}


class NodeEncoder(nn.Module):
    """(R, width) -> (R, out): each room with what it learns from its neighbours.

    Args:
        settings: kind of layer and how they are stacked; kind `none` gives the rooms back.
        channels: width of the rooms.
    """

    def __init__(self, settings: Node, channels: int, dropout: float) -> None:
        super().__init__()
        self.settings = settings
        self.distance = column("edge_attr", "distance")
        self.edges, self.edge, self.pairs, self.doors = None, None, None, nn.ModuleList()
        if settings.edges and settings.kind != "none":
            columns = width("edge_attr")
            self.edges = Standardise(columns)
            columns += width("edge_way") if settings.ways else 0
            hidden = (columns + ROOM_KNOTS, 2 * settings.width) if settings.around else (columns,)
            self.edge = dense(*hidden, settings.width)
        if pair_tables := pair_tensors(settings)[1:]:
            pair_dim = width(pair_tables[0])
            self.pairs = Standardise(pair_dim)
            self.doors = nn.ModuleList(DoorConv(settings.width, pair_dim) for _ in range(settings.doors))
        count = 0 if settings.kind == "none" else settings.layers
        self.layers = nn.ModuleList(ROOM_LAYERS[settings.kind](settings, channels) for _ in range(count))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(count))
        self.drop = nn.Dropout(dropout)
        self.out = channels * (count + 1) if settings.jump == "cat" else channels

    def forward(
        self,
        rooms: Tensor,
        edge_index: Tensor,
        edge_attr: Tensor,
        pair_index: Tensor | None,
        pair_attr: Tensor | None,
        way: Tensor | None = None,
    ) -> Tensor:
        edges = self._edges(edge_attr, pair_index, pair_attr, way)
        ways = edge_index.flip(0)  # edges lead from a room to its neighbours; messages come back
        states = [rooms]
        for layer, norm in zip(self.layers, self.norms, strict=True):
            update = layer(states[-1], ways) if edges is None else layer(states[-1], ways, edges)
            update = self.drop(torch.relu(norm(update)))
            states.append(states[-1] + update if self.settings.skip else update)
        if self.settings.jump == "cat":
            return torch.cat(states, dim=1)
        return torch.stack(states).amax(dim=0) if self.settings.jump == "max" else states[-1]

    def _edges(self, edge_attr: Tensor, pair_index: Tensor | None, pair_attr: Tensor | None, way: Tensor | None) -> Tensor | None:
        """(E, settings.width) of the edges, from their features and the doors beside them."""
        if self.edges is None or self.edge is None:
            return None
        scaled = self.edges(edge_attr)
        if self.settings.around:
            scaled = torch.cat([scaled, bumps(edge_attr[:, self.distance])], dim=1)
        if self.settings.ways:
            assert way is not None
            scaled = torch.cat([scaled, (way / WAY_UNIT).clamp(-WAY_LIMIT, WAY_LIMIT)], dim=1)
        edges: Tensor = self.edge(scaled)
        for layer in self.doors:
            assert self.pairs is not None and pair_index is not None and pair_attr is not None
            edges = layer(edges, pair_index.flip(0), self.pairs(pair_attr), pair_attr[:, 0])
        return edges
