"""Storeys of two maps from above as a training sees them: turned alike by what is true, and changed as other sensors and days
would have left them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from topomerge.embedding.schema import column
from topomerge.embedding.surroundings import CROP_SHAPES, SHEET_PLANES, crops
from topomerge.embedding.turns import edge_ways
from topomerge.training.packed import Graph, GraphPair

MIRRORED_COLUMNS = {"edge_attr": "turn_sin", "door_attr": "angle_sin", "near_attr": "angle_sin"}  # that change their sign
SEEN_AS = (  # planes that a map lacks, and how often: drawings and slices have no ceilings, and no low things
    ((), 0.65),
    (("ceiling",), 0.15),
    (("ceiling", "low"), 0.1),
    (("ceiling", "low", "high"), 0.1),
)
DOOR_SHIFT = 0.8  # pixels, standard deviation of where a door stands
PATCHES, PATCH = 3, (4, 24)  # patches that nothing was seen of, at most, and pixels of a side


def quarters_between(pair: GraphPair) -> int | None:
    """Quarter turns by which b is to be turned so that it stands as a does; None where no transform is true."""
    matrix = pair.transform
    if not bool(torch.isfinite(matrix).all()) or not len(pair.a["turn"]) or not len(pair.b["turn"]):
        return None
    yaw = math.atan2(float(matrix[1, 0]), float(matrix[0, 0])) + float(pair.b["turn"][0]) - float(pair.a["turn"][0])
    return round(yaw / (math.pi / 2)) % 4


def with_views(graph: Graph, names: Sequence[str]) -> Graph:
    """A graph with the crops and ways that a network reads, of its sheet as it is."""
    out = dict(graph)
    read: tuple[str, ...] = ("sheet", "sheet_room", "anchor", "door_anchor")
    arrays = {name: graph[name].numpy() for name in read if name in graph}
    for part in CROP_SHAPES.keys() & set(names):
        out[part] = torch.from_numpy(crops(arrays, part))
    if "edge_way" in names:
        out["edge_way"] = torch.from_numpy(edge_ways({n: graph[n].numpy() for n in ("pos", "edge_pos", "edge_index", "turn")}))
    return out


def changed_sheet(graph: Graph, shift: float, generator: torch.Generator) -> Graph:
    """A map whose storeys were seen by another sensor: some planes and patches are missing, middles of rooms lie elsewhere.

    Args:
        shift: pixels, standard deviation of the middles.
    """
    planes, anchor = graph["sheet"].clone(), graph["anchor"]
    chosen = int(torch.multinomial(torch.tensor([share for _, share in SEEN_AS]), 1, generator=generator))
    for name in SEEN_AS[chosen][0]:
        planes[..., SHEET_PLANES.index(name)] = 0
    room = graph["sheet_room"].clone()
    for _ in range(int(torch.randint(0, PATCHES + 1, (1,), generator=generator))):
        size = torch.randint(*PATCH, (2,), generator=generator).tolist()
        start = [int(torch.randint(0, max(n, 1), (1,), generator=generator)) for n in planes.shape[:2]]
        at = (slice(start[0], start[0] + size[0]), slice(start[1], start[1] + size[1]))
        planes[at], room[at] = 0, -1
    moved = anchor + shift * torch.randn(anchor.shape, generator=generator)
    doors = graph["door_anchor"] + DOOR_SHIFT * torch.randn(graph["door_anchor"].shape, generator=generator)
    return {**graph, "sheet": planes, "sheet_room": room, "anchor": moved, "door_anchor": doors}


def mirrored(graph: Graph) -> Graph:
    """A map seen in a mirror that stands along its walls: y changes its sign."""
    out = dict(graph)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = out[part].flip(out[part].dim() - 2)
    if "edge_way" in out:
        out["edge_way"] = out["edge_way"] * torch.tensor([1.0, -1.0, 1.0, -1.0])
    for name, feature in MIRRORED_COLUMNS.items():
        if name in out:
            sign = torch.ones(out[name].shape[1])
            sign[column(name, feature)] = -1
            out[name] = out[name] * sign
    return out
