"""A trained embedder as what `match`, `merge` and the command line take: a callable map -> (R, D), or `TurnedRows` where what a
room looks like depends on how the map is turned. ONNX Runtime runs it (`topomerge.networks`), whatever it was trained as.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.embedding.door_layout import door_layout
from topomerge.embedding.graph import graph_arrays, resized
from topomerge.embedding.network import Network, build_embedder_signature, tensors
from topomerge.embedding.point_features import point_features, point_spectra
from topomerge.embedding.rooms_around import with_rooms_around
from topomerge.embedding.schema import POINTS_PER_ROOM
from topomerge.embedding.sheets import sheet_arrays
from topomerge.embedding.surroundings import CROP_SHAPES, crops
from topomerge.embedding.turns import Rows, TurnedRows, aligned, along_walls, edge_ways, quarter_turned, room_facts
from topomerge.embedding.weights import read_embedder_card
from topomerge.networks.network import Run, open_network
from topomerge.numpy_nn import softmax
from topomerge.types import Array, TopometricMap

POINT_TABLES = {"engineered": point_features, "shapedna": point_spectra}  # computed from the points where a network reads them


def load_embedder(path: str | Path | None = None) -> Learned:
    """A trained embedder. Neither torch, Hydra nor the training code is needed.

    Args:
        path: a run, or what `topomerge export-embedder` wrote; None: the one that ships with the package.

    Raises:
        InputError: no embedder there, or damaged, of another format or class, or trained on other features.
    """
    card = read_embedder_card(path)
    run = open_network(card.path, card.digest, build_embedder_signature(card.network), card.values)
    return Learned(run, card.network, card.temperature, card.about, card.digest)


class Learned:
    """Callable map -> (R, D) float64 of length 1, or `TurnedRows`; the same map gives the same rows.

    Args:
        run: as of `build_embedder_signature`.
        network: what it is made of.
        temperature: that divides similarities.
        about: on what it was trained, how good it is.
        embedder: hash of its weights, which its rows are marked with.
    """

    def __init__(
        self, run: Run, network: Network, temperature: float, about: Mapping[str, Any] | None = None, embedder: str = ""
    ) -> None:
        self.run, self.network, self.temperature, self.about = run, network, temperature, dict(about or {})
        self.embedder = embedder

    def __call__(self, map: TopometricMap) -> Rows:
        return self.graph(self.arrays(map))[0]

    def at_scales(self, map: TopometricMap) -> Callable[[float], Rows]:
        """What the embedder gives for a map of unknown scale, whose unit is taken for so many m."""
        of_map = self._graph_arrays(map)

        def rows(scale: float) -> Rows:
            arrays = resized(of_map, scale)
            return self.graph(arrays if self.network.turns == 1 else arrays | sheet_arrays(map, scale))[0]

        return rows

    def matchability(self, map: TopometricMap) -> Array:
        """(R,) float64: how alike a room of another map must at least be, as a cosine, before it is rather this one than none."""
        return self.temperature * self.graph(self.arrays(map))[1]

    def probabilities(self, a: TopometricMap, b: TopometricMap) -> tuple[Array, Array]:
        """That each room of a (R_a, R_b + 1) is each of b, in the last place none of them; and of b likewise (R_b, R_a + 1)."""
        (ea, da), (eb, db) = (self.graph(self.arrays(m)) for m in (a, b))
        ea, eb = aligned(ea, eb)
        logits = ea @ eb.T / self.temperature
        return softmax(np.column_stack([logits, da])), softmax(np.column_stack([logits.T, db]))

    def graph(self, arrays: Mapping[str, Array]) -> tuple[Rows, Array]:
        """Embeddings and dustbins (R,), as logits, of what `arrays` gives."""
        turns = self.network.turns
        if not len(arrays["x"]):
            none = np.zeros((0, turns, self.network.size))
            return (none[:, 0] if turns == 1 else TurnedRows(none, np.zeros((0, 2)), self.embedder)), np.zeros(0)
        inputs, names = dict(arrays), tensors(self.network)
        if self.network.node.around:
            inputs |= with_rooms_around(inputs, self.network.node.around)
        inputs |= {n: compute(arrays["room_points"]) for n, compute in POINT_TABLES.items() if n in names and n not in arrays}
        if "near_index" in names and "near_index" not in arrays:
            layout = door_layout(*(arrays[n] for n in ("edge_index", "pos", "edge_pos")))
            inputs |= dict(zip(("near_index", "near_attr"), layout, strict=True))
        inputs |= {part: crops(inputs, part) for part in CROP_SHAPES if part in names and part not in inputs}
        if "edge_way" in names:
            inputs["edge_way"] = edge_ways(inputs)
        read = {name: inputs[name] for name in names}
        computed = [self.run(**(quarter_turned(read, k) if k else read)) for k in range(turns)]
        rows, bins = ([array.astype(np.float64) for array in arrays] for arrays in zip(*computed, strict=True))
        if turns == 1:
            return rows[0], bins[0]
        dustbin = np.mean(bins, axis=0)
        facts = room_facts(arrays["x"], dustbin, arrays["pos"][:, 2])
        return TurnedRows(np.stack(rows, axis=1), along_walls(arrays), self.embedder, facts), dustbin

    @property
    def needs_points(self) -> bool:
        """Does the network read the points of rooms, or what is reckoned from them?"""
        return bool(set(self.network.geometry.parts) - {"scalars", *CROP_SHAPES})

    def arrays(self, map: TopometricMap) -> dict[str, Array]:
        """What `graph` takes, of a map."""
        arrays = self._graph_arrays(map)
        return arrays if self.network.turns == 1 else arrays | sheet_arrays(map)

    def _graph_arrays(self, map: TopometricMap) -> dict[str, Array]:
        return graph_arrays(map, POINTS_PER_ROOM if self.needs_points else 1)
