"""Steps of a training as CUDA graphs: hundreds of small kernels are launched as one.

A graph runs on tensors of one shape and at one place. Batches are therefore padded to a few shapes (`BatchShape`), and copied to
where their shape's graph reads them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from topomerge.embedding.network import find_crop_encoder
from topomerge.models.losses import Truth
from topomerge.training.settings import Training

STEP_UP = 1.08  # from one shape to the next larger one
GRANULE = 64  # rooms, edges and doors come in multiples of this many
CAPTURED_LOSSES, CAPTURED_NODES = ("infonce", "ntxent"), ("none", "sage", "gat")  # no shape in them depends on values

Step = Callable[[Mapping[str, Tensor], Truth], dict[str, Tensor]]


class BatchShape(NamedTuple):
    """How many rooms, edges and doors a batch holds, or is padded to."""

    rooms: int
    edges: int
    doors: int

    def pad_to_few(self, mean: BatchShape) -> BatchShape:
        """Return the smallest of a few shapes that holds this one, and one room more, where padding goes.

        Args:
            mean: what a batch holds on average, before anything is lost: shapes are so many times that, each larger than the one
                before by `STEP_UP` in all.
        """
        counts = (self.rooms + 1, self.edges, self.doors)
        most = max(count / max(usual, 1) for count, usual in zip(counts, mean, strict=True))
        factor = STEP_UP ** math.ceil(math.log(most) / math.log(STEP_UP))
        return BatchShape(*(_round_up(factor * usual) for usual in mean))


def _round_up(count: float) -> int:
    return math.ceil(max(count, 1) / GRANULE) * GRANULE


def can_capture(settings: Training, fabric: Any, optimizer: torch.optim.Optimizer) -> bool:
    """Tell whether steps of a training can run as graphs: on one card, and with nothing whose shape depends on values."""
    network = settings.network
    known = settings.loss.kind in CAPTURED_LOSSES and network.node.kind in CAPTURED_NODES
    known = known and not any(find_crop_encoder(part) for part in network.geometry.parts)
    alone = fabric.device.type == "cuda" and fabric.world_size == 1
    scaled = getattr(fabric.strategy.precision, "scaler", None) is not None
    capturable = optimizer.defaults.get("capturable", False)
    return bool(settings.graphs and alone and known and capturable and not scaled and not settings.anomaly)


@dataclass
class _Graph:
    """A captured step.

    Args:
        inputs: that it reads; losses: that it leaves.
    """

    graph: Any
    inputs: list[Tensor]
    losses: dict[str, Tensor]


class CapturedStep:
    """Runs a step on batches: the first of each shape as it is, later ones as a graph.

    Args:
        step: forwards, backwards, and the optimizer's, of tensors and truth; it returns the losses.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self.graphs: dict[tuple[Any, ...], _Graph | None] = {}
        self.stream = torch.cuda.Stream()
        self.pool = torch.cuda.graph_pool_handle()

    def __call__(self, tensors: Mapping[str, Tensor], truth: Truth) -> dict[str, Tensor]:
        """Take a step; return the losses, which later steps leave alone."""
        given = [*tensors.values(), *(getattr(truth, field.name) for field in fields(truth))]
        key = tuple((tuple(tensor.shape), tensor.dtype) for tensor in given)
        if key not in self.graphs:
            self.graphs[key] = None
            return self._warm_up(tensors, truth)
        graph = self.graphs[key]
        if graph is None:
            graph = self.graphs[key] = self._capture(list(tensors), given)
        for kept, new in zip(graph.inputs, given, strict=True):
            kept.copy_(new)
        graph.graph.replay()
        return {name: value.clone() for name, value in graph.losses.items()}

    def _warm_up(self, tensors: Mapping[str, Tensor], truth: Truth) -> dict[str, Tensor]:
        """Take the first step of a shape: libraries make what they need, which they may not while a graph is captured."""
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            losses = self.step(tensors, truth)
        torch.cuda.current_stream().wait_stream(self.stream)
        return losses

    def _capture(self, names: list[str], given: list[Tensor]) -> _Graph:
        """Capture a step on copies of a batch, which does not run it."""
        inputs = [tensor.clone() for tensor in given]
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, self.pool, self.stream):
            losses = self.step(dict(zip(names, inputs, strict=False)), Truth(*inputs[len(names) :]))
        return _Graph(graph, inputs, losses)
