"""Graph attention whose messages carry values of edges: between GATv2 (Brody et al. 2022) and graph transformers."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu
from torch_geometric.nn import MessagePassing
from torch_geometric.utils import softmax

SCORE_BOUND = 30.0  # of attention
LEAKY_SLOPE = 0.2  # of the leaky rectifier below 0 (Velickovic et al. 2018)


class EdgeValueConv(MessagePassing):
    r"""Attention over the neighbours j of each room i, in which edges change what is summed, not its weights only:

    .. math::
        x'_i = W_o \, \Big\Vert_h \sum_j \alpha^h_{ij} (W_v x_j + W_u e_{ij})^h + b_o, \qquad
        \alpha_{ij} = \mathrm{softmax}_j \big( B \tanh (s_{ij} / B) \big), \qquad
        s^h_{ij} = a_h^\top \, \mathrm{LeakyReLU} (W_r x_i + W_l x_j + W_e e_{ij})^h

    `GATv2Conv` sums W_l x_j. How far away and behind which turn a neighbour lies is itself worth knowing, hence W_u e. Values
    have a separate matrix, as in transformers. Scores are bounded by B = `SCORE_BOUND`: so were they when the weights that ship
    were trained.

    Args:
        channels: width of the rooms, in and out.
        edge_dim: width of the edges; None: they have no features.
        heads: divide the channels.

    Shapes:
        rooms (R, channels), edge_index (2, E) from j to i, edges (E, edge_dim) -> (R, channels).
    """

    def __init__(self, channels: int, edge_dim: int | None = None, heads: int = 4) -> None:
        super().__init__(aggr="add", node_dim=0)
        self.channels, self.heads = channels, heads
        self.lin_r, self.lin_l = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.lin_edge = nn.Linear(edge_dim, channels, bias=False) if edge_dim else None
        self.att = nn.Parameter(torch.empty(1, heads, channels // heads))
        nn.init.xavier_uniform_(self.att[0])
        self.lin_value = nn.Linear(channels, channels)
        self.lin_edge_value = nn.Linear(edge_dim, channels, bias=False) if edge_dim else None
        self.lin_out = nn.Linear(channels, channels)

    def forward(self, x: Tensor, edge_index: Tensor, edge_attr: Tensor | None = None) -> Tensor:
        alpha = self.edge_updater(edge_index, query=self.lin_r(x), key=self.lin_l(x), edge_attr=edge_attr)
        out: Tensor = self.propagate(edge_index, value=self.lin_value(x), alpha=alpha, edge_attr=edge_attr)
        return self.lin_out(out)

    def edge_update(
        self, query_i: Tensor, key_j: Tensor, edge_attr: Tensor | None, index: Tensor, dim_size: int | None
    ) -> Tensor:  # (E, heads)
        pair = query_i + key_j
        if self.lin_edge is not None and edge_attr is not None:
            pair = pair + self.lin_edge(edge_attr)
        heads = leaky_relu(pair.view(-1, self.heads, self.channels // self.heads), LEAKY_SLOPE)
        score = (heads * self.att).sum(dim=2)
        return softmax(SCORE_BOUND * torch.tanh(score / SCORE_BOUND), index, num_nodes=dim_size)

    def message(self, value_j: Tensor, alpha: Tensor, edge_attr: Tensor | None) -> Tensor:  # (E, channels)
        if self.lin_edge_value is not None and edge_attr is not None:
            value_j = value_j + self.lin_edge_value(edge_attr)
        return (value_j.view(-1, self.heads, self.channels // self.heads) * alpha[:, :, None]).flatten(1)
