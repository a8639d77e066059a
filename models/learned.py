"""A trained embedder as what `match`, `merge` and the command line take: a callable map -> (R, D)."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from topomerge.models.embedder import Embedder, match_scores
from topomerge.models.weights import read_embedder
from torch import Tensor

from topomerge.embedding.door_layout import door_layout
from topomerge.embedding.graph import to_graph
from topomerge.embedding.point_features import point_features, point_spectra
from topomerge.types import Array, TopometricMap

EXTRAS = {"engineered": point_features, "shapedna": point_spectra}  # reckoned from the points where a network reads them


def load_embedder(path: str | Path | None = None) -> Learned:
    """A trained embedder; neither Hydra nor the training code is needed.

    Args:
        path: a run, its `best` or `last`, or what `topomerge export-embedder` wrote; None: the one that ships with the package.

    Raises:
        InputError: no embedder there, or damaged, of another format or class.
    """
    if path is not None:
        return Learned(*read_embedder(path))
    with resources.as_file(resources.files("topomerge.embedding").joinpath("pretrained")) as folder:
        return Learned(*read_embedder(folder))


class Learned:
    """Callable map -> (R, D) float64 of length 1; the same map gives the same rows.

    Args:
        network: ready to use.
        about: what is told about it.
    """

    def __init__(self, network: Embedder, about: Mapping[str, Any] | None = None) -> None:
        self.network, self.about = network.eval(), dict(about or {})

    def __call__(self, map: TopometricMap) -> Array:
        return self.graph(to_graph(map))[0]

    def matchability(self, map: TopometricMap) -> Array:
        """(R,) float64: how alike a room of another map must at least be, as a cosine, before it is rather this one than none."""
        return self.graph(to_graph(map))[1]

    def graph(self, data: Any) -> tuple[Array, Array]:
        """Embeddings (R, D) and least cosines (R,) of a graph of `embedding.graph.to_graph`, or a cached one."""
        embedding, dustbin = self._run(data)
        return embedding.double().numpy(), (dustbin * self.network.temperature.detach()).double().numpy()

    def probabilities(self, a: TopometricMap | Any, b: TopometricMap | Any) -> tuple[Array, Array]:
        """That each room of a (R_a, R_b + 1) is each of b, in the last place none of them; and of b likewise (R_b, R_a + 1).

        Args:
            a, b: maps, or their graphs.
        """
        (ea, da), (eb, db) = (self._run(to_graph(m) if isinstance(m, TopometricMap) else m) for m in (a, b))
        with torch.no_grad():
            rows, columns = match_scores(ea, eb, da, db, self.network.temperature)
        return rows.exp().double().numpy(), columns.exp().double().numpy()

    @torch.no_grad()
    def _run(self, data: Any) -> tuple[Tensor, Tensor]:
        tensors = {}
        for name in self.network.tensors:
            have = getattr(data, name, None) if hasattr(data, name) else None
            if have is not None:
                tensors[name] = have
            elif name in EXTRAS:
                tensors[name] = torch.from_numpy(EXTRAS[name](data.room_points.numpy()))
            elif "near_index" not in tensors:  # both at once
                layout = door_layout(*(getattr(data, n).numpy() for n in ("edge_index", "pos", "edge_pos")))
                tensors |= {n: torch.from_numpy(a) for n, a in zip(("near_index", "near_attr"), layout, strict=True)}
        if not len(data.x):
            return torch.zeros((0, self.network.network.size)), torch.zeros(0)
        embedding, dustbin = self.network(tensors)
        return embedding, dustbin
