"""Pairs of maps put together to a batch: one graph without padding, and what belongs together in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from topomerge.models.losses import Truth
from topomerge.models.yaw import turn
from topomerge.training.packed import INDICES, Graph, GraphPair
from topomerge.training.settings import Augment

LENGTHS, AREAS, VOLUMES = (1, 3, 4, 7, 12, 13), (0,), (2,)  # columns of x that are m, m2, m3 (`embedding.graph.ROOM_FEATURES`)
EDGE_LENGTHS = (0, 1, 5, 6, 7, 8)  # columns of edge_attr that are m
MM = 0.001
DOOR_NOISE = 0.05  # m, of the distance between two doors
GLIMPSED, AREA = 15, 0  # columns of x
ALIKE = 1.5  # areas of two views of a room that both saw most of it differ by less than this factor


@dataclass(frozen=True)
class Batch:
    """All rooms of some pairs of maps: a0, b0, a1, b1, ... behind each other."""

    tensors: Graph
    truth: Truth
    rooms: list[int]  # of each map

    def to(self, device: torch.device | str) -> Batch:
        """The same on another device."""
        truth = Truth(*(getattr(self.truth, name).to(device) for name in ("pair", "side", "same", "piece", "clear")))
        return Batch({name: tensor.to(device) for name, tensor in self.tensors.items()}, truth, self.rooms)


def make_batch(
    pairs: Sequence[GraphPair], names: Sequence[str], augment: Augment | None = None, generator: torch.Generator | None = None
) -> Batch:
    """Some pairs as a batch.

    Args:
        names: tensors that the network reads.
        augment: how maps are changed; needs the generator. None: not at all.
    """
    graphs, pair, side, true, clear, matches, start = [], [], [], [], [], [], 0
    for number, one in enumerate(pairs):
        links = torch.zeros((len(one.true[0]), len(one.true[1])), dtype=torch.bool)
        links[one.matches[:, 0], one.matches[:, 1]] = True
        kept = [torch.arange(len(t)) for t in one.true]
        for k, graph in enumerate((one.a, one.b)):
            some = {name: graph[name] for name in {*names, "edge_index"}}
            if augment is not None:
                assert generator is not None
                some, kept[k] = changed(some, len(one.true[k]), augment, generator)
            elif "room_points" in some:
                some["room_points"] = some["room_points"].float() * MM
            graphs.append(some)
            pair.append(torch.full((len(kept[k]),), number))
            side.append(torch.full((len(kept[k]),), k))
            true.append(one.true[k][kept[k]])
        links = links[kept[0]][:, kept[1]]
        clear += seen_well(links, one.a["x"][kept[0]], one.b["x"][kept[1]])
        i, j = torch.nonzero(links, as_tuple=True)
        matches.append(torch.stack([start + i, start + len(kept[0]) + j]))
        start += len(kept[0]) + len(kept[1])
    rooms = [len(t) for t in true]
    truth = _truth(torch.cat(pair), torch.cat(side), torch.cat(true), torch.cat(clear), torch.cat(matches, dim=1))
    return Batch(join(graphs, rooms, names), truth, rooms)


def join(graphs: Sequence[Graph], rooms: Sequence[int], names: Sequence[str]) -> Graph:
    """Graphs as one, in which no edge leads from one to another."""
    out = {name: torch.cat([g[name] for g in graphs]) for name in names if name not in INDICES}
    edges = [g["edge_index"].shape[1] for g in graphs]
    for name, counts in (("edge_index", rooms), ("door_index", edges), ("near_index", edges)):
        if name not in names:
            continue
        starts = torch.tensor([0, *counts]).cumsum(0).tolist()
        out[name] = torch.cat([g[name] + start for g, start in zip(graphs, starts[:-1], strict=True)], dim=1)
    return out


def seen_well(links: Tensor, a: Tensor, b: Tensor) -> list[Tensor]:
    """Which rooms were entered by both walks and have nearly the same area in both maps: (R_a,) and (R_b,) bool.

    Of the others that have a partner, one map holds a part only, so that little can be said about their shape. A room that has
    no partner counts if it was entered.

    Args:
        links: (R_a, R_b) bool, the two are one true room.
        a, b: the rooms' `x`.
    """
    visited = [x[:, GLIMPSED] == 0 for x in (a, b)]
    areas = [x[:, AREA].clamp(min=0.1).log() for x in (a, b)]
    alike = (areas[0][:, None] - areas[1][None]).abs() <= math.log(ALIKE)
    good = links & alike & visited[0][:, None] & visited[1][None]
    return [good.any(dim=k) | (~links.any(dim=k) & visited[1 - k]) for k in (1, 0)]


def _truth(pair: Tensor, side: Tensor, true: Tensor, clear: Tensor, matches: Tensor) -> Truth:
    count = len(pair)
    same = torch.zeros((count, count), dtype=torch.bool)
    same[matches[0], matches[1]] = same[matches[1], matches[0]] = True
    map = 2 * pair + side
    piece = (map[:, None] == map[None]) & (true[:, None] == true[None]) & (true >= 0)[:, None]
    return Truth(pair, side, same, piece & ~torch.eye(count, dtype=torch.bool), clear)


def changed(graph: Graph, rooms: int, augment: Augment, generator: torch.Generator) -> tuple[Graph, Tensor]:
    """A map as another walk, sensor or day might have left it; and which rooms are still in it, at least two."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    keep = uniform(rooms) >= augment.rooms * uniform(1)
    if keep.sum() < 2:
        keep[:] = True
    index = graph["edge_index"]
    half = index.shape[1] // 2  # an edge and its way back stand half of all apart
    open_ = (uniform(half) >= augment.edges * uniform(1)).repeat(2)
    edges = keep[index[0]] & keep[index[1]] & open_
    number, edge_number = keep.cumsum(0) - 1, edges.cumsum(0) - 1
    of = {"edge_attr": edges}
    out = {"edge_index": number[index[:, edges]]}
    for name in ("door", "near"):
        if f"{name}_index" in graph:
            of[f"{name}_attr"] = edges[graph[f"{name}_index"]].all(dim=0)
            out[f"{name}_index"] = edge_number[graph[f"{name}_index"][:, of[f"{name}_attr"]]]
    out |= {name: tensor[of.get(name, keep)] for name, tensor in graph.items() if name not in INDICES}
    scale = float((augment.scale * normal(1)).exp())
    if "x" in out:
        out["x"] = _resized(out["x"], scale, augment.jitter * normal(*out["x"].shape))
    if "edge_attr" in out:
        factor = torch.ones_like(out["edge_attr"])
        factor[:, EDGE_LENGTHS] = scale * (augment.jitter * normal(len(factor), len(EDGE_LENGTHS))).exp()
        out["edge_attr"] = out["edge_attr"] * factor
    for name in ("door_attr", "near_attr"):
        if name in out:  # the first column is the distance between two doors
            noise = DOOR_NOISE * normal(len(out[name]))
            out[name] = torch.cat([(out[name][:, :1] * scale + noise[:, None]).clamp(min=0), out[name][:, 1:]], dim=1)
    if "room_points" in out:
        out["room_points"] = _points(out["room_points"], scale, augment, generator)
    return out, torch.nonzero(keep)[:, 0]


def _resized(x: Tensor, scale: float, jitter: Tensor) -> Tensor:
    factor = torch.ones_like(x)
    for columns, power in ((LENGTHS, 1), (AREAS, 2), (VOLUMES, 3)):
        factor[:, columns] = scale**power * jitter[:, columns].exp()
    return x * factor


def _points(points: Tensor, scale: float, augment: Augment, generator: torch.Generator) -> Tensor:
    """Some of the points, in metres, turned about the vertical at random and jittered."""
    rooms, number = points.shape[:2]
    if 0 < augment.points < number:
        chosen = torch.randperm(number, generator=generator)[: augment.points]
        points = points[:, chosen]
    angle = 2 * torch.pi * torch.rand(rooms, generator=generator)
    noise = augment.noise * torch.randn(points.shape, generator=generator)
    return turn(points.float() * (MM * scale) + noise, angle)
