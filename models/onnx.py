"""The network for other runtimes: one ONNX file in which numbers of rooms, edges and pairs of doors may be any."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import torch
from topomerge.models.embedder import Embedder
from torch import Tensor, nn

from topomerge.embedding.graph import POINTS_PER_ROOM
from topomerge.embedding.schema import TABLES
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError
from topomerge.io.atomic import replacing

SHAPES: dict[str, tuple[int, ...]] = {name: (len(columns),) for name, columns in TABLES.items()}  # of each row
SHAPES |= {"room_points": (POINTS_PER_ROOM, 3), **CROP_SHAPES}
ONNX_OPSET = 18


class Positional(nn.Module):
    """A network that takes its tensors in the order of `Embedder.tensors`."""

    def __init__(self, network: Embedder) -> None:
        super().__init__()
        self.network = network

    def forward(self, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        embedding, dustbin = self.network.turned(dict(zip(self.network.tensors, tensors, strict=True)))
        return embedding, dustbin


def sample(network: Embedder, rooms: int = 6, edges: int = 10, doors: int = 12, seed: int = 0) -> dict[str, Tensor]:
    """Random tensors of the shapes that a network reads."""
    generator = torch.Generator().manual_seed(seed)
    count = {"edge_attr": edges, "edge_way": edges, "door_attr": doors, "near_attr": doors}
    out = {}
    for name in network.tensors:
        if name in SHAPES:
            out[name] = torch.rand((count.get(name, rooms), *SHAPES[name]), generator=generator) * 3
            out[name] = (80 * out[name]).to(torch.uint8) if name in CROP_SHAPES else out[name]
        else:
            most, number = (rooms, edges) if name == "edge_index" else (edges, doors)
            out[name] = torch.randint(0, max(most, 1), (2, number), generator=generator)
    return out


def save_onnx(network: Embedder, path: str | Path) -> None:
    """Write a network; inputs are named as the tensors of a graph, outputs `embedding` (R, D), or (R, 4, D) where
    turns matter, and `dustbin` (R,).

    Raises:
        InputError: onnx is not installed, or the path can't be written.
    """
    try:
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError("ONNX needs onnx and onnxscript: pip install topomerge[onnx]") from error
    dims = {name: torch.export.Dim(name, min=2) for name in ("rooms", "edges", "doors")}
    first = {"edge_attr": "edges", "edge_way": "edges", "door_attr": "doors", "near_attr": "doors"}
    shapes = tuple(
        {1: dims["edges" if name == "edge_index" else "doors"]} if name not in SHAPES else {0: dims[first.get(name, "rooms")]}
        for name in network.tensors
    )
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), replacing(path) as beside:
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            Positional(network.eval()), tuple(sample(network).values()), dynamo=True, opset_version=ONNX_OPSET, verbose=False,
            input_names=list(network.tensors), output_names=["embedding", "dustbin"], dynamic_shapes=(shapes,),
        )  # fmt: skip
        assert program is not None
        program.save(str(beside), external_data=False)
