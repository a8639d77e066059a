"""GraphSAGE (Hamilton et al. 2017) whose messages are made of the neighbour and of the edge that leads there."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch_geometric.nn import SAGEConv


class EdgeSAGEConv(SAGEConv):
    r"""The mean over the neighbours j of each room i, each told apart by its edge:

    .. math::
        x'_i = W_r x_i + W_l \, \mathrm{mean}_j \, \mathrm{ReLU} (W_m [x_j \Vert e_{ij}] + b_m) + b

    `SAGEConv` takes the mean of x_j, by which the neighbours blur (measured: no gain over no graph at all).

    Args:
        channels: width of the rooms, in and out.
        edge_dim: width of the edges.

    Shapes:
        rooms (R, channels), edge_index (2, E) from j to i, edges (E, edge_dim) -> (R, channels).
    """

    def __init__(self, channels: int, edge_dim: int) -> None:
        super().__init__(channels, channels)
        self.lin_message = nn.Linear(channels + edge_dim, channels)

    def forward(self, x: Tensor, edge_index: Tensor, edge_attr: Tensor) -> Tensor:  # type: ignore[override]
        # propagate_type: (x: Tensor, edge_attr: Tensor)
        out: Tensor = self.lin_l(self.propagate(edge_index, x=x, edge_attr=edge_attr)) + self.lin_r(x)
        return out

    def message(self, x_j: Tensor, edge_attr: Tensor) -> Tensor:  # type: ignore[override]
        return self.lin_message(torch.cat([x_j, edge_attr], dim=1)).relu()
