"""Pairs of maps as graphs of torch-geometric, and their truth: what its `Batch` and `DataLoader` put together without padding."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset
from torch_geometric.data import Batch, Data

from topomerge.embedding.schema import column, columns_of_power
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.models.embedder import quarter_turned
from topomerge.models.losses import Truth
from topomerge.models.yaw import turn
from topomerge.training.packed import INDICES, Graph, GraphPair
from topomerge.training.settings import Augment
from topomerge.training.turned_views import changed_sheet, mirrored, quarters_between, room_crops, ways_of

METRES_PER_MILLIMETRE = 0.001
ORIENTED = {*CROP_SHAPES, "edge_way"}  # tensors that depend on how a map is turned
DOOR_NOISE = 0.05  # m, of the distance between two doors
ALIKE_AREAS = 1.5  # areas of two views of a room that both saw most of it differ by less than this factor


class MapPair(Data):
    """Two maps of one building as one graph of which no edge leads from one to the other: the rooms of a, then those of b.

    Beside the tensors of `embedding.graph` that a network reads:

    | tensor | shape | content |
    |---|---|---|
    | `side` | (R,) | 0: of a, 1: of b |
    | `true` | (R,) | true room, -1 none |
    | `clear` | (R,) bool | see `seen_well` |
    | `building` | (R,) int64 | number of the physical building |
    | `match_index` | (2, M) | rooms of a and of b that are one true room |
    | `room_counts` | (2,) | rooms of a and of b |

    Batches of pairs are of this class, too.
    """

    def __inc__(self, key: str, value: Any, *args: Any, **kwargs: Any) -> Any:
        if key in ("door_index", "near_index"):  # of edges, not of rooms
            return self["edge_index"].size(1)
        return super().__inc__(key, value, *args, **kwargs)

    @property
    def tensors(self) -> Graph:
        """By name, as a network takes them."""
        tensors: Graph = self.to_dict()
        return tensors

    @property
    def rooms(self) -> list[int]:
        """Of each map: a0, b0, a1, b1, ..."""
        counts: list[int] = self["room_counts"].tolist()
        return counts

    @property
    def truth(self) -> Truth:
        """What belongs together in a batch."""
        pair, side, true = self["batch"], self["side"], self["true"]
        same = torch.zeros((len(pair), len(pair)), dtype=torch.bool, device=pair.device)
        first, second = self["match_index"]
        same[first, second] = same[second, first] = True
        map = 2 * pair + side
        piece = (map[:, None] == map[None]) & (true[:, None] == true[None]) & (true >= 0)[:, None]
        return Truth(pair, side, same, piece.fill_diagonal_(False), self["clear"], self["building"])


class ChangedPairs(Dataset[MapPair]):
    """Pairs as graphs, changed anew each epoch, for torch-geometric's `DataLoader`.

    Args:
        names: tensors that the network reads.
        augment: how maps are changed; None: not at all.
        seed_of: number of a pair -> seed of its changes: they depend on nothing else, so neither on the batch nor on the process.
    """

    def __init__(
        self, pairs: Sequence[GraphPair], names: Sequence[str], augment: Augment | None, seed_of: Callable[[int], int]
    ) -> None:
        self.pairs, self.names, self.augment, self.seed_of = pairs, names, augment, seed_of

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, number: int) -> MapPair:
        generator = torch.Generator().manual_seed(self.seed_of(number))
        return map_pair(self.pairs[number], self.names, self.augment, generator)

    def batch(self, numbers: Sequence[int]) -> MapPair:
        """Pairs of these numbers as a batch."""
        batch: MapPair = Batch.from_data_list([self[number] for number in numbers])
        return batch


def make_batch(
    pairs: Sequence[GraphPair], names: Sequence[str], augment: Augment | None = None, generator: torch.Generator | None = None
) -> MapPair:
    """Pairs as a batch.

    Args:
        names: tensors that the network reads.
        augment: how maps are changed; needs the generator. None: not at all.
    """
    batch: MapPair = Batch.from_data_list([map_pair(pair, names, augment, generator) for pair in pairs])
    return batch


def map_pair(
    pair: GraphPair, names: Sequence[str], augment: Augment | None = None, generator: torch.Generator | None = None
) -> MapPair:
    """A pair as one graph; see `make_batch`. While training, maps whose turn matters stand alike, and b comes once more, turned
    wrongly: none of its rooms there is one of a."""
    graphs, rows = [], []
    views, oriented = _views(pair, names, augment, generator), bool(ORIENTED & set(names))
    for view, true in zip(views, pair.true, strict=True):
        tensors = {name: view.graph[name] for name in {*names, "edge_index"} - CROP_SHAPES.keys()}
        present = torch.arange(len(true))
        if augment is not None:
            assert generator is not None
            tensors, present = changed(tensors, len(true), augment, generator)
        elif "room_points" in tensors:
            tensors["room_points"] = tensors["room_points"].float() * METRES_PER_MILLIMETRE
        graphs.append(view.placed(tensors | room_crops(view.graph, names, present)) if oriented else tensors)
        rows.append(present)
    if augment is not None and generator is not None and oriented:
        graphs.append(quarter_turned(graphs[1], int(torch.randint(1, 4, (1,), generator=generator))))
    links = torch.zeros((len(pair.true[0]), len(pair.true[1])), dtype=torch.bool)
    links[pair.matches[:, 0], pair.matches[:, 1]] = True
    links = links[rows[0]][:, rows[1]]
    counts = torch.tensor([len(present) for present in rows])
    again = int(counts[1]) * (len(graphs) - len(rows))
    sides = [torch.repeat_interleave(torch.arange(2), counts), torch.ones(again, dtype=torch.long)]
    true_rooms = [numbers[present] for numbers, present in zip(pair.true, rows, strict=True)]
    clear = seen_well(links, pair.a["x"][rows[0]], pair.b["x"][rows[1]])
    side = torch.cat(sides)
    return MapPair(
        **_joined(graphs, [*counts.tolist(), again], names),
        side=side,
        building=torch.tensor(pair.building_numbers)[side],
        true=torch.cat([*true_rooms, torch.full((again,), -1)]),
        clear=torch.cat([*clear, torch.zeros(again, dtype=torch.bool)]),
        match_index=torch.nonzero(links).T + torch.tensor([[0], [int(counts[0])]]),
        room_counts=counts,
        num_nodes=int(counts.sum()) + again,
    )


def _joined(graphs: Sequence[Graph], rooms: Sequence[int], names: Sequence[str]) -> Graph:
    """Graphs of so many rooms as one of which no edge leads from one to another."""
    edges = [graph["edge_index"].shape[1] for graph in graphs]
    first = {"edge_index": rooms, "door_index": edges, "near_index": edges}
    out = {name: torch.cat([graph[name] for graph in graphs]) for name in names if name not in INDICES}
    for name in set(names) & set(INDICES):
        starts = [sum(first[name][:k]) for k in range(len(graphs))]
        out[name] = torch.cat([graph[name] + start for graph, start in zip(graphs, starts, strict=True)], dim=1)
    return out


@dataclass(frozen=True)
class _View:
    """A map with ways, whose sheet no crops were cut out of yet, and how it is turned and mirrored."""

    graph: Graph
    quarters: int = 0
    mirror: bool = False

    def placed(self, tensors: Graph) -> Graph:
        """Tensors of this map as it is turned."""
        turned = quarter_turned(tensors, self.quarters)
        return mirrored(turned) if self.mirror else turned


def _views(
    pair: GraphPair, names: Sequence[str], augment: Augment | None, generator: torch.Generator | None
) -> tuple[_View, _View]:
    """Both maps as they are; while training, those whose turn matters are changed, turned alike, and both turned and mirrored at
    random."""
    if not ORIENTED & set(names):
        return _View(pair.a), _View(pair.b)
    if augment is None or generator is None:
        return _View({**pair.a, **ways_of(pair.a, names)}), _View({**pair.b, **ways_of(pair.b, names)})
    a, b = (changed_sheet({**graph, **ways_of(graph, names)}, augment, generator) for graph in (pair.a, pair.b))
    more, quarters = torch.randint(0, 4, (2,), generator=generator).tolist()
    true = quarters_between(pair)
    mirror = bool(torch.rand((), generator=generator) < 0.5)
    return _View(a, more, mirror), _View(b, more + (quarters if true is None else true), mirror)


def seen_well(links: Tensor, a: Tensor, b: Tensor) -> list[Tensor]:
    """Which rooms were entered by both walks and have nearly the same area in both maps: (R_a,) and (R_b,) bool.

    Of the others that have a partner, one map holds a part only, so that little can be said about their shape. A room that has
    no partner counts if it was entered.

    Args:
        links: (R_a, R_b) bool, the two are one true room.
        a, b: the rooms' `x`.
    """
    visited = [x[:, column("x", "glimpsed")] == 0 for x in (a, b)]
    areas = [x[:, column("x", "area")].clamp(min=0.1).log() for x in (a, b)]
    alike = (areas[0][:, None] - areas[1][None]).abs() <= math.log(ALIKE_AREAS)
    good = links & alike & visited[0][:, None] & visited[1][None]
    return [good.any(dim=k) | (~links.any(dim=k) & visited[1 - k]) for k in (1, 0)]


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
    doors = (uniform(half) >= augment.edges * uniform(1)).repeat(2)
    edges = keep[index[0]] & keep[index[1]] & doors
    number, edge_number = keep.cumsum(0) - 1, edges.cumsum(0) - 1
    rows = {"edge_attr": edges, "edge_way": edges}
    out = {"edge_index": number[index[:, edges]]}
    for name in ("door", "near"):
        if f"{name}_index" in graph:
            rows[f"{name}_attr"] = edges[graph[f"{name}_index"]].all(dim=0)
            out[f"{name}_index"] = edge_number[graph[f"{name}_index"][:, rows[f"{name}_attr"]]]
    out |= {name: tensor[rows.get(name, keep)] for name, tensor in graph.items() if name not in INDICES}
    scale = float((augment.scale * normal(1)).exp())
    if "x" in out:
        out["x"] = _resized(out["x"], scale, augment.jitter * normal(*out["x"].shape))
    if "edge_attr" in out:
        factor = torch.ones_like(out["edge_attr"])
        lengths = columns_of_power("edge_attr", 1)
        factor[:, lengths] = scale * (augment.jitter * normal(len(factor), len(lengths))).exp()
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
    for power in (1, 2, 3):
        columns = columns_of_power("x", power)
        factor[:, columns] = scale**power * jitter[:, columns].exp()
    return x * factor


def _points(points: Tensor, scale: float, augment: Augment, generator: torch.Generator) -> Tensor:
    """Points drawn at random, in metres, turned about the vertical at random and jittered."""
    rooms, number = points.shape[:2]
    if 0 < augment.points < number:
        chosen = torch.randperm(number, generator=generator)[: augment.points]
        points = points[:, chosen]
    angle = 2 * torch.pi * torch.rand(rooms, generator=generator)
    noise = augment.noise * torch.randn(points.shape, generator=generator)
    return turn(points.float() * (METRES_PER_MILLIMETRE * scale) + noise, angle)
