"""The network: rooms of a map with their points, doors and neighbours -> a vector each, and whether it has a partner."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from topomerge.models.geometry import DoorsEncoder, SurroundingsEncoder, YawAverage
from topomerge.models.nodes import NodeEncoder, Standardizer, build_mlp
from torch import Tensor, nn

from topomerge.embedding.graph import LANDMARK_MASKS, count_columns
from topomerge.embedding.network import (
    GRAPH,
    LANDMARK_PART,
    TABLE_PARTS,
    Network,
    check,
    find_crop_encoder,
    find_tensor,
    list_pair_tensors,
    list_tensors,
)
from topomerge.embedding.surroundings import CROP_SHAPES, DOOR_PART
from topomerge.registry import GEOMETRIES

DOOR_ROWS = ("door_rows", "door_slots")  # tensors of a batch: see `DoorsEncoder`
QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # cosine and sine of 0 to 3 quarter turns


class Table(nn.Module):
    """Rows (R, n) of numbers -> (R, width)."""

    def __init__(self, columns: int, width: int, dropout: float) -> None:
        super().__init__()
        self.scale = Standardizer(columns)
        self.each = build_mlp(columns, 2 * width, width, dropout=dropout)

    def forward(self, values: Tensor) -> Tensor:
        out: Tensor = self.each(self.scale(values))
        return out


class LandmarkEncoder(nn.Module):
    """Landmark features of rooms (R, n), the first columns of which are masks -> (R, width); 0 of a room without any."""

    def __init__(self, columns: int, width: int, dropout: float) -> None:
        super().__init__()
        self.each = build_mlp(columns, 2 * width, width, dropout=dropout)

    def forward(self, values: Tensor) -> Tensor:
        masks = values[:, : len(LANDMARK_MASKS)].sum(dim=1, keepdim=True)
        rows: Tensor = self.each(values)
        return torch.where(masks > 0, rows, torch.zeros_like(rows))


class GeometryEncoder(nn.Module):
    """Geometry of each room by itself -> (R, width). Landmarks are added to it."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        geometry, self.width = network.geometry, network.geometry.width
        self.landmarks: LandmarkEncoder | None = None
        self.parts = nn.ModuleDict()
        for part in geometry.parts:
            if part == LANDMARK_PART:
                self.landmarks = LandmarkEncoder(count_columns(part), self.width, network.dropout)
            elif encoder := find_crop_encoder(part):
                self.parts[part] = GEOMETRIES[encoder](self.width)
            elif part in GEOMETRIES:
                self.parts[part] = YawAverage(GEOMETRIES[part](self.width), geometry.yaws, geometry.canonical)
            elif part == DOOR_PART:
                self.parts[part] = DoorsEncoder(self.width, network.dropout)
            elif part in CROP_SHAPES:
                self.parts[part] = SurroundingsEncoder(part, self.width, network.dropout)
            else:
                self.parts[part] = Table(count_columns(TABLE_PARTS[part]), self.width, network.dropout)
        joined = len(self.parts) * self.width
        self.join = nn.Sequential(nn.LayerNorm(joined), nn.ReLU(), nn.Dropout(network.dropout)) if joined else None
        self.out = nn.Linear(joined, self.width) if joined else None

    def forward(self, tensors: Mapping[str, Tensor]) -> Tensor:
        rooms = [module(tensors[find_tensor(part)], *self._list_doors(part, tensors)) for part, module in self.parts.items()]
        terms = [self.out(self.join(torch.cat(rooms, dim=1)))] if self.join is not None and self.out is not None else []
        terms += [] if self.landmarks is None else [self.landmarks(tensors[LANDMARK_PART])]
        return terms[0] + terms[1] if len(terms) > 1 else terms[0]

    @staticmethod
    def _list_doors(part: str, tensors: Mapping[str, Tensor]) -> list[Tensor]:
        """Return which crops of doors there are, where a batch tells."""
        return [tensors[name] for name in DOOR_ROWS] if part == DOOR_PART and DOOR_ROWS[0] in tensors else []


class Embedder(nn.Module):
    """Tensors of one or more maps (`embedding.graph`) -> embeddings (R, size) of length 1, dustbins (R,).

    A room's dustbin is how alike another one must at least be to be its partner, as a logit: high for rooms that are likely
    seen by this map only, such as those that were glimpsed.
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        check(network)
        self.network = network
        self.geometry = GeometryEncoder(network)
        self.node = NodeEncoder(network.node, network.geometry.width, network.dropout)
        self.project = build_mlp(self.node.out, 2 * network.size, network.size, dropout=network.dropout)
        self.dustbin = build_mlp(self.node.out, 32, 1)
        self.log_temperature = nn.Parameter(torch.tensor(-2.3))  # 0.1; similarities are divided by it

    @property
    def tensors(self) -> tuple[str, ...]:
        """Names of the tensors that the network reads."""
        return list_tensors(self.network)

    @property
    def pairs(self) -> tuple[str, ...]:
        """Names of the tensors that tell of pairs of doors, if the network reads any."""
        return list_pair_tensors(self.network.node)

    @property
    def temperature(self) -> Tensor:
        """Learned, between 0.02 and 1."""
        return self.log_temperature.exp().clamp(0.02, 1.0)

    def forward(self, tensors: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        pairs: list[Tensor | None] = [tensors[name] for name in self.pairs] or [None, None]
        rooms = self.node(
            self.geometry(tensors), *(tensors[name] for name in GRAPH), *pairs, tensors.get("edge_way"), tensors.get("map")
        )
        return nn.functional.normalize(self.project(rooms), dim=1), self.dustbin(rooms)[:, 0]

    def embed_rotations(self, tensors: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return embeddings (R, D), or, of a network that tells turns apart, (R, 4, D): of the map turned by 0 to 3 quarter
        turns; and the mean of the dustbins (R,)."""
        if self.network.turns == 1:
            return self(tensors)
        rows, bins = zip(*(self(rotate_quarter_turns(tensors, k)) for k in range(self.network.turns)), strict=True)
        return torch.stack(rows, dim=1), torch.stack(bins).mean(dim=0)

    def fit_scales(self, graphs: Iterable[Mapping[str, Any]]) -> None:
        """Take the statistics of all inputs from the graphs of the training set."""
        graphs = list(graphs)
        tables = [(find_tensor(name), part.scale) for name, part in self.geometry.parts.items() if isinstance(part, Table)]
        tables += [
            (name, s)
            for name, s in zip(("edge_attr", *self.pairs[1:]), (self.node.edges, self.node.pairs), strict=False)
            if s is not None
        ]
        for name, scale in tables:
            scale.fit(torch.cat([graph[name] for graph in graphs]))


def rotate_quarter_turns(tensors: Mapping[str, Tensor], turns: int) -> dict[str, Tensor]:
    """Return a map turned by so many quarter turns, counter-clockwise seen from above."""
    out = dict(tensors)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = out[part].rot90(turns, (out[part].dim() - 3, out[part].dim() - 2))
    if "edge_way" in out:
        c, s = QUARTERS[turns % 4]
        x, y = out["edge_way"].reshape(-1, 2, 2).unbind(dim=2)
        out["edge_way"] = torch.stack([c * x - s * y, s * x + c * y], dim=2).flatten(1)
    return out


def match_scores(a: Tensor, b: Tensor, bin_a: Tensor, bin_b: Tensor, temperature: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return the logarithms of the probabilities that row i's partner is column j, or, in the last place, that it has none; and
    vice versa.

    Args:
        a, b: (n, D), (m, D) embeddings of two maps.
        bin_a, bin_b: (n,), (m,) their dustbins.

    Returns:
        (n, m + 1) of the rooms of a, (m, n + 1) of those of b.
    """
    logits = a @ b.T / temperature
    rows = torch.cat([logits, bin_a[:, None]], dim=1).log_softmax(dim=1)
    columns = torch.cat([logits.T, bin_b[:, None]], dim=1).log_softmax(dim=1)
    return rows, columns
