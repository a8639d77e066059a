"""Storeys of two maps from above as a training sees them: turned alike by what is true, and changed as other sensors and days
would have left them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from topomerge.embedding.schema import column
from topomerge.embedding.surroundings import CROP_SHAPES, crops
from topomerge.embedding.turns import edge_ways
from topomerge.training.other_sensors import as_slice, bent, looked_at, rough_walls, with_gaps
from topomerge.training.packed import Graph, GraphPair
from topomerge.training.settings import Augment

MIRRORED_COLUMNS = {"edge_attr": "turn_sin", "door_attr": "angle_sin", "near_attr": "angle_sin"}  # that change their sign
DOOR_SHIFT = 0.8  # pixels, standard deviation of where a door stands
WILD, WILD_SHARE = 4.0, 0.1  # how many times as much some maps are turned and stretched, and how often


def quarters_between(pair: GraphPair) -> int | None:
    """Quarter turns by which b is to be turned so that it stands as a does; None where no transform is true."""
    matrix = pair.transform
    if not bool(torch.isfinite(matrix).all()) or not len(pair.a["turn"]) or not len(pair.b["turn"]):
        return None
    yaw = math.atan2(float(matrix[1, 0]), float(matrix[0, 0])) + float(pair.b["turn"][0]) - float(pair.a["turn"][0])
    return round(yaw / (math.pi / 2)) % 4


def with_views(graph: Graph, names: Sequence[str]) -> Graph:
    """A graph with the crops and ways that a network reads, of its sheet as it is."""
    return {**graph, **room_crops(graph, names), **ways_of(graph, names)}


def room_crops(graph: Graph, names: Sequence[str], rooms: Tensor | None = None) -> Graph:
    """The crops that a network reads, of the rooms (n,) of a sheet; of all if left out."""
    read: tuple[str, ...] = ("sheet", "sheet_room", "anchor", "door_anchor")
    arrays = {name: graph[name].numpy() for name in read if name in graph}
    chosen = None if rooms is None else rooms.numpy()
    return {part: torch.from_numpy(crops(arrays, part, chosen)) for part in CROP_SHAPES if part in names}


def ways_of(graph: Graph, names: Sequence[str]) -> Graph:
    """In which direction the neighbours of rooms are, if a network reads it."""
    if "edge_way" not in names:
        return {}
    return {"edge_way": torch.from_numpy(edge_ways({n: graph[n].numpy() for n in ("pos", "edge_pos", "edge_index", "turn")}))}


def changed_sheet(graph: Graph, augment: Augment, generator: torch.Generator) -> Graph:
    """A map whose storeys were seen by another sensor on another walk (`training.other_sensors`); middles of rooms, and doors,
    lie elsewhere."""
    rng = np.random.default_rng(int(torch.randint(1 << 40, (), generator=generator)))
    planes, room, anchor, doors = (graph[name].numpy() for name in ("sheet", "sheet_room", "anchor", "door_anchor"))
    if rng.random() < augment.walks:
        planes, room = looked_at(planes, room, anchor, doors, rng)
    if rng.random() < augment.slices:
        planes = as_slice(planes, rng)
    if rng.random() < augment.rough:
        planes = rough_walls(planes, rng)
    planes, room = with_gaps(planes, room, rng)
    out, tilt = dict(graph), 0.0
    if augment.tilt or augment.zoom or augment.bend:
        more = WILD if rng.random() < WILD_SHARE else 1.0
        tilt, zoom = (
            math.radians(more * augment.tilt) * rng.standard_normal(),
            math.exp(more * augment.zoom * rng.standard_normal()),
        )
        planes, room, (anchor, doors) = bent(planes, room, (anchor, doors), tilt, zoom, augment.bend, rng)
    if "edge_way" in out:
        out["edge_way"] = _rotated_ways(out["edge_way"], tilt)
    anchor = anchor + augment.shift * rng.standard_normal(anchor.shape)
    doors = doors + DOOR_SHIFT * rng.standard_normal(doors.shape)
    places = {"anchor": torch.from_numpy(anchor.astype(np.float32)), "door_anchor": torch.from_numpy(doors.astype(np.float32))}
    return {**out, "sheet": torch.from_numpy(planes), "sheet_room": torch.from_numpy(room), **places}


def _rotated_ways(ways: Tensor, angle: float) -> Tensor:
    """Ways (E, 4), two of x and y each, turned by an angle, rad."""
    c, s = math.cos(angle), math.sin(angle)
    return (ways.reshape(-1, 2, 2) @ torch.tensor([[c, s], [-s, c]])).flatten(1)


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
