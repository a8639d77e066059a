"""A trained embedder run by torch: one that reads points, or one that was just trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from topomerge.models.embedder import Embedder
from topomerge.models.weights import read_embedder

from topomerge.embedding.learned import Learned
from topomerge.types import Array


def load_with_torch(path: str | Path) -> Learned:
    """As `topomerge.load_embedder`, which is to be preferred: it needs torch only where it must."""
    return learned(*read_embedder(path))


def learned(network: Embedder, about: Mapping[str, Any] | None = None) -> Learned:
    """A network as a callable map -> (R, D)."""
    network.eval()

    @torch.no_grad()
    def run(arrays: Mapping[str, Array]) -> tuple[Array, Array]:
        # Copies: of a map with one room, views of its table count as contiguous with steps that torch refuses.
        embedding, dustbin = network({name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()})
        return embedding.double().numpy(), dustbin.double().numpy()

    return Learned(run, network.network, float(network.temperature.detach()), about)
