"""A trained network run with NumPy, in float64: what `models.embedder.Embedder` computes where it reads no points.

The layers are those of `models/`, by the same names; `Weights` are those of its `state_dict`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge import numpy_nn as nn
from topomerge.embedding.network import (
    CROP_CHANNELS,
    DOOR_KNOT_STEP,
    DOOR_KNOTS,
    ROOM_KNOTS,
    SCORE_BOUND,
    WAY_LIMIT,
    WAY_UNIT,
    Network,
    needed,
    pair_tensors,
    tensors,
)
from topomerge.embedding.schema import TABLES, column, width
from topomerge.embedding.surroundings import CROP_SHAPES, DOOR_PART
from topomerge.types import Array

SCALED_LIMIT = 5.0  # standard deviations beyond which inputs are cut off (`models.layers.Standardise`)
COLDEST = 0.02  # least temperature; the largest is 1
NORM_EPSILON = 1e-5  # added to the variance, as torch does
FULL_VALUE = 255  # of a pixel


class Forward:
    """Callable: arrays of a graph -> embeddings, dustbins.

    Args:
        weights: by the names of the network's `state_dict`.
    """

    def __init__(self, network: Network, weights: Mapping[str, Array]) -> None:
        self.network = network
        self.weights = {name: array.astype(np.float64) for name, array in weights.items()}
        self.used: set[str] = set()
        self.temperature = float(np.exp(np.clip(self._get("log_temperature", ()), np.log(COLDEST), 0.0)))

    def check_weights(self) -> None:
        """Run it on two rooms that share a door.

        Raises:
            KeyError, ValueError: weights are missing, of other shapes, or too many.
        """
        graph = {name: np.zeros((2, width(name))) for name in tensors(self.network) if name in TABLES}
        graph |= {name: np.array([[0, 1], [1, 0]]) for name in tensors(self.network) if name not in TABLES}
        graph |= {part: np.zeros((2, *shape), np.uint8) for part, shape in CROP_SHAPES.items() if part in graph}
        with np.errstate(all="ignore"):
            embedding, _ = self(graph)
        if embedding.shape[1] != self.network.size:
            raise ValueError(f"embeddings are {embedding.shape[1]} numbers, not {self.network.size}")
        if unused := sorted(set(self.weights) - self.used):
            raise ValueError(f"{unused[0]} is of no layer")

    def __call__(self, graph: Mapping[str, Array]) -> tuple[Array, Array]:
        """Arrays by the names of `network.tensors` -> embeddings (R, size) of length 1, dustbins (R,)."""
        rooms = self._nodes(self._geometry(graph), graph["edge_index"], self._edges(graph))
        out = self._mlp("project", rooms)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return out / np.maximum(length, 1e-12), self._mlp("dustbin", rooms)[:, 0]

    def _geometry(self, graph: Mapping[str, Array]) -> Array:
        parts = []
        for part in self.network.geometry.parts:
            name = f"geometry.parts.{part}"
            if part in CROP_SHAPES:
                parts.append(self._crops(name, part, graph[part]))
                continue
            parts.append(self._mlp(f"{name}.each", self._scaled(f"{name}.scale", graph[needed(part)])))
        rooms = self._linear("geometry.out", nn.relu(self._norm("geometry.join.0", np.concatenate(parts, axis=1))))
        if rooms.shape[1] != self.network.geometry.width:
            raise ValueError(f"rooms are {rooms.shape[1]} wide, not {self.network.geometry.width}")
        return rooms

    def _crops(self, name: str, part: str, crops: Array) -> Array:
        """`models.surroundings.SurroundingsEncoder` and `DoorsEncoder`."""
        if part != DOOR_PART:
            return self._encoded(name, part, crops)
        there = crops.any(axis=(2, 3, 4))
        rows, of = nn.relu(self._encoded(f"{name}.each", part, crops[there])), np.nonzero(there)[0]
        both = [nn.segment_mean(rows, of, len(crops)), nn.segment_max(rows, of, len(crops))]
        return self._linear(f"{name}.out", np.concatenate(both, axis=1))

    def _encoded(self, name: str, part: str, crops: Array) -> Array:
        """Crops (n, side, side, planes) -> (n, width), in float32: the norms are part of the convolutions."""
        x = np.moveaxis(crops, -1, 1).astype(np.float32) / FULL_VALUE
        for k, wide in enumerate(CROP_CHANNELS[part]):
            norm = f"{name}.norms.{k}"
            weight, bias, mean, variance = (
                self._get(f"{norm}.{which}", (wide,)) for which in ("weight", "bias", "running_mean", "running_var")
            )
            factor = weight / np.sqrt(np.maximum(variance, 0) + NORM_EPSILON)
            kernel = self._get(f"{name}.convolutions.{k}.weight", (wide, x.shape[1], 3, 3)) * factor[:, None, None, None]
            rows = kernel.transpose(2, 3, 1, 0).reshape(-1, wide).astype(np.float32)
            x = nn.convolution(x, rows, (bias - factor * mean).astype(np.float32), stride=2)
        flat = x.reshape(len(x), int(np.prod(x.shape[1:]))).astype(np.float64)
        return self._linear(f"{name}.out", flat)

    def _edges(self, graph: Mapping[str, Array]) -> Array | None:
        """(E, width) of the edges, from their features and the doors beside them."""
        node = self.network.node
        if not node.edges or node.kind == "none":
            return None
        scaled = self._scaled("node.edges", graph["edge_attr"])
        if node.around:
            distance = np.asarray(graph["edge_attr"], np.float64)[:, column("edge_attr", "distance"), None]
            scaled = np.concatenate([scaled, np.exp(-((distance - np.arange(ROOM_KNOTS)) ** 2))], axis=1)
        if node.ways:
            scaled = np.concatenate([scaled, np.clip(graph["edge_way"] / WAY_UNIT, -WAY_LIMIT, WAY_LIMIT)], axis=1)
        edges = nn.relu(self._norm("node.edge.1", self._linear("node.edge.0", scaled)))
        if node.around:
            edges = nn.relu(self._norm("node.edge.4", self._linear("node.edge.3", edges)))
        for k in range(node.doors):
            index, attr = pair_tensors(node)
            edges = self._door_conv(f"node.doors.{k}", edges, graph[index], np.asarray(graph[attr], np.float64))
        return edges

    def _door_conv(self, name: str, edges: Array, pair_index: Array, pairs: Array) -> Array:
        """`models.door_conv.DoorConv`."""
        (first, second), count = pair_index, len(edges)
        bumps = np.exp(-(((pairs[:, :1] - DOOR_KNOT_STEP * np.arange(DOOR_KNOTS)) / DOOR_KNOT_STEP) ** 2))
        messages = np.concatenate([edges[first], edges[second], self._scaled("node.pairs", pairs), bumps], axis=1)
        messages = nn.relu(self._linear(f"{name}.pair.2", nn.relu(self._linear(f"{name}.pair.0", messages))))
        both = np.concatenate([nn.segment_mean(messages, first, count), nn.segment_max(messages, first, count)], axis=1)
        return edges + self._norm(f"{name}.out.1", self._linear(f"{name}.out.0", both))

    def _nodes(self, rooms: Array, edge_index: Array, edges: Array | None) -> Array:
        node, states = self.network.node, [rooms]
        layer = self._sage_conv if node.kind == "sage" else self._edge_value_conv if node.edge_values else self._gatv2_conv
        for k in range(0 if node.kind == "none" else node.layers):
            update = nn.relu(self._norm(f"node.norms.{k}", layer(f"node.layers.{k}", states[-1], edge_index, edges)))
            states.append(states[-1] + update if node.skip else update)
        if node.jump == "cat":
            return np.concatenate(states, axis=1)
        out: Array = np.max(states, axis=0) if node.jump == "max" else states[-1]
        return out

    def _edge_value_conv(self, name: str, rooms: Array, edge_index: Array, edges: Array | None) -> Array:
        """`models.edge_value_conv.EdgeValueConv`; the second row of the index are the neighbours."""
        targets, sources = edge_index
        value, score = self._linear(f"{name}.lin_value", rooms)[sources], self._scores(name, rooms, edge_index, edges)[1]
        if edges is not None:
            value = value + self._linear(f"{name}.lin_edge_value", edges, bias=False)
        weight = np.exp(SCORE_BOUND * np.tanh(score / SCORE_BOUND))  # bounded: no need to subtract the largest first
        alpha = weight / nn.segment_sum(weight, targets, len(rooms))[targets]
        return self._linear(f"{name}.lin_out", nn.segment_sum(_weighed(value, alpha), targets, len(rooms)))

    def _gatv2_conv(self, name: str, rooms: Array, edge_index: Array, edges: Array | None) -> Array:
        """`torch_geometric.nn.GATv2Conv` without loops."""
        targets, sources = edge_index
        keys, score = self._scores(name, rooms, edge_index, edges)
        alpha = nn.segment_softmax(score, targets, len(rooms))
        return nn.segment_sum(_weighed(keys[sources], alpha), targets, len(rooms)) + self._get(f"{name}.bias", (rooms.shape[1],))

    def _scores(self, name: str, rooms: Array, edge_index: Array, edges: Array | None) -> tuple[Array, Array]:
        """(R, width) keys of the rooms; (E, heads) scores of attention (Brody et al. 2022)."""
        targets, sources = edge_index
        keys = self._linear(f"{name}.lin_l", rooms)
        pair = self._linear(f"{name}.lin_r", rooms)[targets] + keys[sources]
        if edges is not None:
            pair = pair + self._linear(f"{name}.lin_edge", edges, bias=False)
        shape = (self.network.node.heads, rooms.shape[1] // self.network.node.heads)
        heads = nn.leaky_relu(pair.reshape(-1, *shape))
        return keys, (heads * self._get(f"{name}.att", (1, *shape))).sum(axis=2)

    def _sage_conv(self, name: str, rooms: Array, edge_index: Array, edges: Array | None) -> Array:
        """`torch_geometric.nn.SAGEConv`, or `models.edge_sage_conv.EdgeSAGEConv` where edges have features."""
        targets, sources = edge_index
        message = rooms[sources]
        if edges is not None:
            message = nn.relu(self._linear(f"{name}.lin_message", np.concatenate([message, edges], axis=1)))
        around = nn.segment_mean(message, targets, len(rooms))
        return self._linear(f"{name}.lin_l", around) + self._linear(f"{name}.lin_r", rooms, bias=False)

    def _mlp(self, name: str, x: Array) -> Array:
        """`models.layers.mlp` of three widths; its fourth layer is the dropout."""
        return self._linear(f"{name}.4", nn.relu(self._norm(f"{name}.1", self._linear(f"{name}.0", x))))

    def _scaled(self, name: str, x: Array) -> Array:
        """`models.layers.Standardise`."""
        x = np.asarray(x, np.float64)
        mean, spread = (self._get(f"{name}.{which}", x.shape[1:]) for which in ("mean", "spread"))
        if not (spread > 0).all():
            raise ValueError(f"{name}.spread: is not above 0")
        out: Array = np.clip((np.sign(x) * np.log1p(np.abs(x)) - mean) / spread, -SCALED_LIMIT, SCALED_LIMIT)
        return out

    def _norm(self, name: str, x: Array) -> Array:
        return nn.layer_norm(x, *(self._get(f"{name}.{which}", x.shape[1:]) for which in ("weight", "bias")))

    def _linear(self, name: str, x: Array, bias: bool = True) -> Array:
        weight = self._get(f"{name}.weight")
        if weight.ndim != 2:
            raise ValueError(f"{name}.weight: is no matrix")
        return nn.linear(x, weight.T, self._get(f"{name}.bias", (len(weight),)) if bias else None)

    def _get(self, name: str, shape: tuple[int, ...] | None = None) -> Array:
        array = self.weights[name]
        self.used.add(name)
        if shape is not None and array.shape != shape:
            raise ValueError(f"{name}: is {array.shape}, not {shape}")
        return array


def _weighed(value: Array, alpha: Array) -> Array:
    """(E, width) values, of which each head's share is weighed by it (E, heads)."""
    return value * alpha.repeat(value.shape[1] // alpha.shape[1], axis=1)
