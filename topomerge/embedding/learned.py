"""A trained embedder as what `match`, `merge` and the command line take: a callable map -> (R, D).

Networks that read numbers (of rooms, doors and pairs of doors) are run here, with NumPy: no torch, which takes seconds to import.
The layers are those of `models/`, by the same names. Networks that read points need torch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module, resources
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.embedding.door_layout import door_layout
from topomerge.embedding.graph import POINTS, graph_arrays
from topomerge.embedding.network import GEOMETRY, Network, needed, pair_tensors, tensors
from topomerge.embedding.point_features import point_features, point_spectra
from topomerge.embedding.rooms_around import DISTANCE, with_rooms_around
from topomerge.embedding.weights import Weights, does_not_fit, read_weights
from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap

EXTRAS = {"engineered": point_features, "shapedna": point_spectra}  # reckoned from the points where a network reads them
KNOTS, STEP = 24, 0.5  # of the distances between doors: `models/doors.py`
AROUND = 11  # of those between rooms, 1 m apart: `models/nodes.py`
BOUND = 30  # of scores: `models/layers.py:segment_softmax`
Run = Callable[[Mapping[str, Array]], tuple[Array, Array]]


def load_embedder(path: str | Path | None = None) -> Learned:
    """A trained embedder. Neither Hydra nor the training code is needed, and torch only for one that reads points.

    Args:
        path: a run, its `best` or `last`, or what `topomerge export-embedder` wrote; None: the one that ships with the package.

    Raises:
        InputError: no embedder there, or damaged, of another format or class; or it reads points and torch is missing.
    """
    if path is None:
        with resources.as_file(resources.files("topomerge.embedding").joinpath("pretrained")) as folder:
            return load_embedder(folder)
    network, weights, about = read_weights(path)
    if not all(GEOMETRY[part] for part in network.geometry.parts):
        try:  # the networks of torch stand above this package
            found: Learned = import_module("topomerge.models.learned").load_with_torch(path)
        except ModuleNotFoundError as error:
            raise InputError(f"{path}: reads points, for which it needs {error.name}: pip install topomerge[learn]") from error
        return found
    try:
        run = Forward(network, weights)
        run.tried()
    except (KeyError, ValueError) as error:
        raise does_not_fit(path, error) from error
    return Learned(run, network, run.temperature, about)


class Learned:
    """Callable map -> (R, D) float64 of length 1; the same map gives the same rows.

    Args:
        run: arrays of a graph -> embeddings (R, D), dustbins (R,).
        network: what it is made of.
        temperature: that divides similarities.
        about: what is told about it.
    """

    def __init__(self, run: Run, network: Network, temperature: float, about: Mapping[str, Any] | None = None) -> None:
        self.run, self.network, self.temperature, self.about = run, network, temperature, dict(about or {})

    def __call__(self, map: TopometricMap) -> Array:
        return self.graph(self.arrays(map))[0]

    def matchability(self, map: TopometricMap) -> Array:
        """(R,) float64: how alike a room of another map must at least be, as a cosine, before it is rather this one than none."""
        return self.temperature * self.graph(self.arrays(map))[1]

    def probabilities(self, a: TopometricMap, b: TopometricMap) -> tuple[Array, Array]:
        """That each room of a (R_a, R_b + 1) is each of b, in the last place none of them; and of b likewise (R_b, R_a + 1)."""
        (ea, da), (eb, db) = (self.graph(self.arrays(m)) for m in (a, b))
        logits = ea @ eb.T / self.temperature
        return _softmax(np.column_stack([logits, da])), _softmax(np.column_stack([logits.T, db]))

    def graph(self, arrays: Mapping[str, Array]) -> tuple[Array, Array]:
        """Embeddings (R, D) and dustbins (R,), as logits, of what `embedding.graph.graph_arrays` gives."""
        if not len(arrays["x"]):
            return np.zeros((0, self.network.size)), np.zeros(0)
        told, names = dict(arrays), tensors(self.network)
        if self.network.node.around:
            told |= with_rooms_around(told, self.network.node.around)
        told |= {n: make(arrays["room_points"]) for n, make in EXTRAS.items() if n in names and n not in arrays}
        if "near_index" in names and "near_index" not in arrays:
            layout = door_layout(*(arrays[n] for n in ("edge_index", "pos", "edge_pos")))
            told |= dict(zip(("near_index", "near_attr"), layout, strict=True))
        return self.run({name: told[name] for name in names})

    def arrays(self, map: TopometricMap) -> dict[str, Array]:
        """What `graph` takes, of a map."""
        return graph_arrays(map, POINTS if set(self.network.geometry.parts) != {"scalars"} else 1)


class Forward:
    """What `models.embedder.Embedder` reckons, of a network that reads no points; in float64.

    Args:
        weights: by the names of the network's `state_dict`.
    """

    def __init__(self, network: Network, weights: Weights) -> None:
        self.network = network
        self.weights = {name: array.astype(np.float64) for name, array in weights.items()}
        self.used: set[str] = set()
        self.temperature = float(np.exp(np.clip(self._get("log_temperature", ()), np.log(0.02), 0.0)))

    def tried(self) -> None:
        """Run it on two rooms that share a door.

        Raises:
            KeyError, ValueError: weights are missing, of other shapes, or too many.
        """
        pair = {"edge_index": 11, "door_index": 3, "near_index": 5}
        graph = {needed(part): np.zeros((2, GEOMETRY[part])) for part in self.network.geometry.parts}
        for index in (n for n in tensors(self.network) if n in pair):
            graph |= {index: np.array([[0, 1], [1, 0]]), index.replace("index", "attr"): np.zeros((2, pair[index]))}
        with np.errstate(all="ignore"):
            embedding, _ = self(graph)
        if embedding.shape[1] != self.network.size:
            raise ValueError(f"embeddings are {embedding.shape[1]} numbers, not {self.network.size}")
        if unknown := sorted(set(self.weights) - self.used):
            raise ValueError(f"{unknown[0]} is of no layer")

    def __call__(self, graph: Mapping[str, Array]) -> tuple[Array, Array]:
        """Arrays by the names of `network.tensors` -> embeddings (R, size) of length 1, dustbins (R,)."""
        rooms = self._nodes(self._geometry(graph), graph["edge_index"], self._edges(graph))
        out = self._mlp("project", rooms)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return out / np.maximum(length, 1e-12), self._mlp("dustbin", rooms)[:, 0]

    def _geometry(self, graph: Mapping[str, Array]) -> Array:
        found = []
        for part in self.network.geometry.parts:
            name = f"geometry.parts.{part}"
            found.append(self._mlp(f"{name}.each", self._scaled(f"{name}.scale", graph[needed(part)])))
        rooms = self._linear("geometry.out", _relu(self._norm("geometry.join.0", np.concatenate(found, axis=1))))
        if rooms.shape[1] != self.network.geometry.width:
            raise ValueError(f"rooms are {rooms.shape[1]} wide, not {self.network.geometry.width}")
        return rooms

    def _edges(self, graph: Mapping[str, Array]) -> Array | None:
        """(E, width) of the edges, from their features and the doors beside them (`models/doors.py`)."""
        node = self.network.node
        if not node.edges or node.kind == "none":
            return None
        scaled = self._scaled("node.edges", graph["edge_attr"])
        if node.around:
            far = np.asarray(graph["edge_attr"], np.float64)[:, DISTANCE, None]
            scaled = np.concatenate([scaled, np.exp(-((far - np.arange(AROUND)) ** 2))], axis=1)
        edges = _relu(self._norm("node.edge.1", self._linear("node.edge.0", scaled)))
        if node.around:
            edges = _relu(self._norm("node.edge.4", self._linear("node.edge.3", edges)))
        for k in range(node.doors):
            index, attr = pair_tensors(node)
            (first, second), told, count = graph[index], np.asarray(graph[attr], np.float64), len(edges)
            bumps = np.exp(-(((told[:, :1] - STEP * np.arange(KNOTS)) / STEP) ** 2))
            pairs = np.concatenate([edges[first], edges[second], self._scaled("node.pairs", told), bumps], axis=1)
            name = f"node.doors.{k}"
            pairs = _relu(self._linear(f"{name}.pair.2", _relu(self._linear(f"{name}.pair.0", pairs))))
            most = np.zeros((count, pairs.shape[1]))
            np.maximum.at(most, first, pairs)
            both = np.concatenate([_mean(pairs, first, count), most], axis=1)
            edges = edges + self._norm(f"{name}.out.1", self._linear(f"{name}.out.0", both))
        return edges

    def _nodes(self, rooms: Array, index: Array, edges: Array | None) -> Array:
        node, found = self.network.node, [rooms]
        layer = {"gat": self._gat, "sage": self._sage}.get(node.kind)
        for k in range(node.layers if layer else 0):
            assert layer is not None
            told = _relu(self._norm(f"node.norms.{k}", layer(f"node.layers.{k}", found[-1], index, edges)))
            found.append(found[-1] + told if node.skip else told)
        if node.jump == "cat":
            return np.concatenate(found, axis=1)
        out: Array = np.max(found, axis=0) if node.jump == "max" else found[-1]
        return out

    def _gat(self, name: str, rooms: Array, index: Array, edges: Array | None) -> Array:
        (here, there), node = index, self.network.node
        asked = self._linear(f"{name}.here", rooms)[here] + self._linear(f"{name}.there", rooms)[there]
        value = self._linear(f"{name}.value", rooms)[there]
        if edges is not None:
            asked = asked + self._linear(f"{name}.edge", edges, bias=False)
            if node.told:
                value = value + self._linear(f"{name}.edge_value", edges, bias=False)
        shape = (len(here), node.heads, rooms.shape[1] // node.heads)
        asked = asked.reshape(shape)
        score = (np.where(asked > 0, asked, 0.2 * asked) * self._get(f"{name}.score", shape[1:])).sum(axis=2)
        weight = np.exp(BOUND * np.tanh(score / BOUND))
        weight = weight / np.maximum(_sum(weight, here, len(rooms))[here], 1e-12)
        weighed = (value.reshape(shape) * weight[:, :, None]).reshape(value.shape)
        return self._linear(f"{name}.out", _sum(weighed, here, len(rooms)))

    def _sage(self, name: str, rooms: Array, index: Array, edges: Array | None) -> Array:
        here, there = index
        told = rooms[there]
        if edges is not None:
            told = _relu(self._linear(f"{name}.beside.0", np.concatenate([told, edges], axis=1)))
        around = _mean(told, here, len(rooms))
        return self._linear(f"{name}.own", rooms) + self._linear(f"{name}.around", around, bias=False)

    def _mlp(self, name: str, x: Array) -> Array:
        """`models.layers.mlp` of three widths; its fourth layer is the dropout."""
        return self._linear(f"{name}.4", _relu(self._norm(f"{name}.1", self._linear(f"{name}.0", x))))

    def _scaled(self, name: str, x: Array) -> Array:
        """`models.layers.Standardise`."""
        x = np.asarray(x, np.float64)
        mean, spread = (self._get(f"{name}.{which}", x.shape[1:]) for which in ("mean", "spread"))
        if not (spread > 0).all():
            raise ValueError(f"{name}.spread: is not above 0")
        out: Array = np.clip((np.sign(x) * np.log1p(np.abs(x)) - mean) / spread, -5, 5)
        return out

    def _norm(self, name: str, x: Array) -> Array:
        weight, bias = (self._get(f"{name}.{which}", x.shape[1:]) for which in ("weight", "bias"))
        away = x - x.mean(axis=1, keepdims=True)
        out: Array = away / np.sqrt((away**2).mean(axis=1, keepdims=True) + 1e-5) * weight + bias
        return out

    def _linear(self, name: str, x: Array, bias: bool = True) -> Array:
        weight = self._get(f"{name}.weight")
        if weight.ndim != 2:
            raise ValueError(f"{name}.weight: is no matrix")
        out: Array = x @ weight.T
        return out + self._get(f"{name}.bias", (len(weight),)) if bias else out

    def _get(self, name: str, shape: tuple[int, ...] | None = None) -> Array:
        found = self.weights[name]
        self.used.add(name)
        if shape is not None and found.shape != shape:
            raise ValueError(f"{name}: is {found.shape}, not {shape}")
        return found


def _relu(x: Array) -> Array:
    return np.maximum(x, 0)


def _sum(values: Array, index: Array, count: int) -> Array:
    """(count, W) sums of the rows (n, W) that have each index (n,)."""
    out = np.zeros((count, values.shape[1]))
    np.add.at(out, index, values)
    return out


def _mean(values: Array, index: Array, count: int) -> Array:
    out: Array = _sum(values, index, count) / np.maximum(np.bincount(index, minlength=count), 1)[:, None]
    return out


def _softmax(logits: Array) -> Array:
    weight = np.exp(logits - logits.max(axis=1, keepdims=True))
    out: Array = weight / weight.sum(axis=1, keepdims=True)
    return out
