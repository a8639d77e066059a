"""Node encoders: message passing over doors."""

from __future__ import annotations

import itertools
import warnings
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu
from torch_geometric.nn import GATv2Conv, MessagePassing, SAGEConv
from torch_geometric.utils import softmax

from topomerge.embedding.graph import count_columns, find_column
from topomerge.embedding.network import Node, list_pair_tensors
from topomerge.registry import NODES


def build_mlp(*widths: int, dropout: float = 0.0) -> nn.Sequential:
    """Build linear layers with a layer norm and a ReLU after all but the last."""
    layers: list[nn.Module] = []
    for k, (a, b) in enumerate(itertools.pairwise(widths)):
        layers.append(nn.Linear(a, b))
        if k < len(widths) - 2:
            layers += [nn.LayerNorm(b), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers)


class Standardizer(nn.Module):
    """Columns as signed logarithms, then scaled by the statistics of the training set; they are buffers, saved with the weights.

    Sizes span orders of magnitude, and how much a partial view changes them goes with the size: hence the logarithm.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("spread", torch.ones(width))

    def forward(self, values: Tensor) -> Tensor:
        out: Tensor = ((compute_signed_log(values) - self.mean) / self.spread).clamp(-5, 5)
        return out

    def fit(self, values: Tensor) -> None:
        """Take mean and standard deviation from rows (n, width); columns that never change are left as they are."""
        if len(values):
            logarithms = compute_signed_log(values.double())
            spread = logarithms.std(dim=0, unbiased=False)
            self.mean.copy_(logarithms.mean(dim=0))
            self.spread.copy_(torch.where(spread > 1e-4, spread, torch.ones_like(spread)))


def compute_signed_log(values: Tensor) -> Tensor:
    """Compute sign times the logarithm of 1 + size."""
    return values.sign() * values.abs().log1p()


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
        rbf = (-(((distance[:, None] - self.knots) / DOOR_KNOT_STEP) ** 2)).exp()
        out: Tensor = self.pair(torch.cat([edges_i, edges_j, pairs, rbf], dim=1))
        return out


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


ROOM_KNOTS = 11  # bumps of the distance between two rooms, 1 m apart
WAY_UNIT, WAY_LIMIT = 5.0, 3.0  # m that ways to neighbours are divided by, and how far they tell then


def build_dense(*widths: int) -> nn.Sequential:
    """Build linear layers, each with a layer norm and a ReLU."""
    return nn.Sequential(*(part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU())))


def compute_rbf(distance: Tensor) -> Tensor:
    """Compute (n,) m -> (n, `ROOM_KNOTS`) radial basis functions, 1 m apart, so that 3 m and 4 m are two things."""
    knots = torch.arange(ROOM_KNOTS, dtype=distance.dtype, device=distance.device)
    return (-((distance[:, None] - knots) ** 2)).exp()


def build_sage(settings: Node, channels: int) -> nn.Module:
    """Return a layer of means over the neighbours."""
    return EdgeSAGEConv(channels, settings.width) if settings.edges else SAGEConv(channels, channels)


def build_gat(settings: Node, channels: int) -> nn.Module:
    """Return a layer of attention over the neighbours."""
    edge_dim = settings.width if settings.edges else None
    if settings.edge_values:
        return EdgeValueConv(channels, edge_dim, settings.heads)
    return GATv2Conv(channels, channels // settings.heads, settings.heads, edge_dim=edge_dim, add_self_loops=False)


class NodeEncoder(nn.Module):
    """(R, width) -> (R, out): each room with what it learns from its neighbours.

    Layers are of `topomerge.registry.NODES`, whose entries take the settings and a number of channels. A layer takes rooms
    (R, channels), edge_index (2, E) and, where edges have features, these (E, settings.width); it gives (R, channels).
    A layer with a true attribute `reads_map`, such as attention between all rooms of a map, gets `map=` as well: the number of
    each room's map (R,) int64, or None where all rooms are of one map.

    Args:
        settings: kind of layer and how they are stacked; kind `none` gives the rooms back.
        channels: width of the rooms.
    """

    def __init__(self, settings: Node, channels: int, dropout: float) -> None:
        super().__init__()
        self.settings = settings
        self.distance = find_column("edge_attr", "distance")
        self.edges, self.edge, self.pairs, self.doors = None, None, None, nn.ModuleList()
        if settings.edges and settings.kind != "none":
            columns = count_columns("edge_attr")
            self.edges = Standardizer(columns)
            columns += count_columns("edge_way") if settings.ways else 0
            hidden = (columns + ROOM_KNOTS, 2 * settings.width) if settings.around else (columns,)
            self.edge = build_dense(*hidden, settings.width)
        if pair_tables := list_pair_tensors(settings)[1:]:
            pair_dim = count_columns(pair_tables[0])
            self.pairs = Standardizer(pair_dim)
            self.doors = nn.ModuleList(DoorConv(settings.width, pair_dim) for _ in range(settings.doors))
        count = 0 if settings.kind == "none" else settings.layers
        self.layers = nn.ModuleList(NODES[settings.kind](settings, channels) for _ in range(count))
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
        map: Tensor | None = None,
    ) -> Tensor:
        edges = self._encode_edges(edge_attr, pair_index, pair_attr, way)
        directions = edge_index.flip(0)  # edges lead from a room to its neighbours; messages come back
        states = [rooms]
        for layer, norm in zip(self.layers, self.norms, strict=True):
            inputs = (states[-1], directions) if edges is None else (states[-1], directions, edges)
            update = layer(*inputs, map=map) if getattr(layer, "reads_map", False) else layer(*inputs)
            update = self.drop(torch.relu(norm(update)))
            states.append(states[-1] + update if self.settings.skip else update)
        if self.settings.jump == "cat":
            return torch.cat(states, dim=1)
        return torch.stack(states).amax(dim=0) if self.settings.jump == "max" else states[-1]

    def _encode_edges(
        self, edge_attr: Tensor, pair_index: Tensor | None, pair_attr: Tensor | None, way: Tensor | None
    ) -> Tensor | None:
        """Return (E, settings.width) of the edges, from their features and the doors beside them."""
        if self.edges is None or self.edge is None:
            return None
        scaled = self.edges(edge_attr)
        if self.settings.around:
            scaled = torch.cat([scaled, compute_rbf(edge_attr[:, self.distance])], dim=1)
        if self.settings.ways:
            assert way is not None
            scaled = torch.cat([scaled, (way / WAY_UNIT).clamp(-WAY_LIMIT, WAY_LIMIT)], dim=1)
        edges: Tensor = self.edge(scaled)
        for layer in self.doors:
            assert self.pairs is not None and pair_index is not None and pair_attr is not None
            edges = layer(edges, pair_index.flip(0), self.pairs(pair_attr), pair_attr[:, 0])
        return edges
