"""How doors lie to each other: an edge learns from the doors beside its own."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor, nn
from torch_geometric.nn import MessagePassing

DOOR_KNOTS, DOOR_KNOT_STEP = 24, 0.5  # bumps of the distance between two doors, and m between them

# Maxima of a few thousand rows: torch's own are quick enough, and the package that the warning asks for has to be compiled.
warnings.filterwarnings("ignore", message="The usage of `scatter", module="torch_geometric")


class DoorConv(MessagePassing):
    r"""A layer over the line graph, whose nodes are the edges e of the graph of rooms, each a way through a door:

    .. math::
        e'_i = e_i + \mathrm{LayerNorm} \big( W [\mathrm{mean}_j \, m_{ij} \Vert \max_j m_{ij}] + b \big), \qquad
        m_{ij} = \mathrm{MLP} (e_i \Vert e_j \Vert p_{ij} \Vert \exp (-((d_{ij} - k) / s)^2)_k)

    p are the scaled features of a pair of doors and d the distance between them, m, which comes as `DOOR_KNOTS` bumps,
    s = `DOOR_KNOT_STEP` apart: 3.0 m and 3.5 m are two things, not nearly one. Distances between doors, and the angles at which
    they lie, depend on no frame and hardly on how much of the room was seen. The maximum asks whether there is a door like this:
    doors that this map lacks change it less than they change a mean.

    Args:
        channels: width of the edges.
        pair_dim: width of the features of a pair.

    Shapes:
        edges (E, channels), pair_index (2, M) from j to i, pairs (M, pair_dim), distance (M,) -> (E, channels).
    """

    knots: Tensor

    def __init__(self, channels: int, pair_dim: int) -> None:
        super().__init__(aggr=["mean", "max"], node_dim=0)
        self.pair = nn.Sequential(
            nn.Linear(2 * channels + pair_dim + DOOR_KNOTS, 2 * channels), nn.ReLU(), nn.Linear(2 * channels, channels), nn.ReLU()
        )
        self.out = nn.Sequential(nn.Linear(2 * channels, channels), nn.LayerNorm(channels))
        self.register_buffer("knots", torch.arange(DOOR_KNOTS) * DOOR_KNOT_STEP, persistent=False)

    def forward(self, edges: Tensor, pair_index: Tensor, pairs: Tensor, distance: Tensor) -> Tensor:
        out: Tensor = edges + self.out(self.propagate(pair_index, edges=edges, pairs=pairs, distance=distance))
        return out

    def message(self, edges_i: Tensor, edges_j: Tensor, pairs: Tensor, distance: Tensor) -> Tensor:  # (M, channels)
        bumps = (-(((distance[:, None] - self.knots) / DOOR_KNOT_STEP) ** 2)).exp()
        out: Tensor = self.pair(torch.cat([edges_i, edges_j, pairs, bumps], dim=1))
        return out
