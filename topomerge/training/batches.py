"""Pairs of maps as graphs of torch-geometric, and their augmentation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.utils.data import Dataset
from torch_geometric.data import Batch, Data

from topomerge.datasets.simulation.signs import READERS, draw_numbering, misread
from topomerge.embedding.graph import find_column, find_columns_of_power, hash_landmarks
from topomerge.embedding.network import LANDMARK_PART
from topomerge.embedding.quarter_turns import compute_edge_positions
from topomerge.embedding.surroundings import CROP_SHAPES, SHEET_PLANES, cut_crops
from topomerge.kernels.images import interpolate_drifts, warp_sheet
from topomerge.kernels.rays import find_lit_pixels
from topomerge.models.embedder import rotate_quarter_turns
from topomerge.models.geometry import rotate_yaw
from topomerge.models.losses import Truth
from topomerge.training.packed_pairs import INDICES, Graph, GraphPair
from topomerge.training.settings import Augment
from topomerge.types import Array

SEEN_AS = (  # planes that a map lacks, and how often: drawings and slices have no ceilings, and no low things
    ((), 0.65),
    (("ceiling",), 0.15),
    (("ceiling", "low"), 0.1),
    (("ceiling", "low", "high"), 0.1),
)
PATCHES, PATCH = 3, (4, 24)  # patches that nothing was seen of, at most, and pixels of a side
SENSOR_REACH = (16.0, 56.0)  # pixels, how far a sensor sees
OPAQUE = 128  # from which share of a pixel on a wall stops a ray
ENTERED = (0.3, 1.0)  # share of rooms that a walk enters; into the others it looks through a door
BEND_STEP = 32  # pixels, between two places that drift apart from each other
MOST_LOST = 0.4  # of the pixels of rough walls
WALL, LOW, HIGH, CEILING = (SHEET_PLANES.index(name) for name in ("wall", "low", "high", "ceiling"))


def simulate_partial_walk(
    planes: Array, room: Array, anchor: Array, doors: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return the planes and rooms of what a walk sees that enters some rooms and looks into the others from a door: the rest is
    empty.

    Args:
        planes: (H, W, len(SHEET_PLANES)) uint8; room: (H, W); anchor: (R, 2) pixels; doors: (R, n, 2) pixels, nan where none is.
    """
    entered = rng.random(len(anchor)) < rng.uniform(*ENTERED)
    through = doors[np.arange(len(anchor)), rng.integers(0, np.maximum(np.isfinite(doors[..., 0]).sum(axis=1), 1))]
    stand = np.where((entered | ~np.isfinite(through[:, 0]))[:, None], anchor, through)
    columns = np.clip(np.floor(stand).astype(np.int64), 0, np.array(room.shape) - 1)
    seen = find_lit_pixels(planes[..., WALL] >= OPAQUE, columns, rng.uniform(*SENSOR_REACH))
    return np.where(seen[..., None], planes, 0).astype(np.uint8), np.where(seen, room, -1).astype(room.dtype)


def simulate_slice(planes: Array, rng: np.random.Generator) -> Array:
    """Return the planes as a laser that turns in one plane sees them: what stands at its height looks like walls, the rest is not
    seen."""
    out = planes.copy()
    things = np.maximum(planes[..., HIGH], planes[..., LOW]) if rng.random() < 0.5 else planes[..., HIGH]
    out[..., WALL] = np.maximum(planes[..., WALL], things)
    out[..., [LOW, HIGH, CEILING]] = 0
    return out


def roughen_walls(planes: Array, rng: np.random.Generator) -> Array:
    """Return planes whose walls have gaps, or are a pixel thicker."""
    out, wall = planes.copy(), planes[..., WALL]
    if rng.random() < 0.5:
        out[..., WALL] = np.where(rng.random(wall.shape) < rng.uniform(0, MOST_LOST), 0, wall)
    else:
        out[..., WALL] = ndimage.maximum_filter(wall, (2, 2))
    return out


def warp_planes(
    planes: Array, room: Array, places: tuple[Array, ...], tilt: float, zoom: float, bend: float, rng: np.random.Generator
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Return planes, rooms and places of a map that is turned, stretched, and bent by drift.

    Args:
        places: (..., 2) pixels each.
        tilt: rad, counter-clockwise; zoom: factor.
        bend: pixels, standard deviation of how far places `BEND_STEP` apart move.
    """
    c, s = zoom * np.cos(tilt), zoom * np.sin(tilt)
    turn, size = np.array([[c, -s], [s, c]]), np.array(room.shape)
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size) @ turn.T
    low = np.floor(corners.min(axis=0)) - BEND_STEP // 4
    shape = (np.ceil(corners.max(axis=0)) - low).astype(np.int64) + BEND_STEP // 4
    knots = bend * rng.standard_normal((2, *(size // BEND_STEP + 2)))

    planes, room = warp_sheet(planes, room, np.linalg.inv(turn), low, shape, knots, BEND_STEP)
    moved = []
    for place in places:
        flat = place.reshape(-1, 2).astype(np.float64)
        finite = np.isfinite(flat).all(axis=1)
        flat[finite] = (flat[finite] + interpolate_drifts(knots, flat[finite] / BEND_STEP)) @ turn.T - low
        moved.append(flat.reshape(place.shape).astype(place.dtype))
    return planes, room, tuple(moved)


def drop_patches(planes: Array, room: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return planes and rooms of which some planes and patches are missing."""
    planes, room = planes.copy(), room.copy()
    for name in SEEN_AS[rng.choice(len(SEEN_AS), p=[share for _, share in SEEN_AS])][0]:
        planes[..., SHEET_PLANES.index(name)] = 0
    for _ in range(rng.integers(0, PATCHES + 1)):
        size = rng.integers(*PATCH, 2)
        start = rng.integers(0, np.maximum(room.shape, 1))
        at = (slice(start[0], start[0] + size[0]), slice(start[1], start[1] + size[1]))
        planes[at], room[at] = 0, -1
    return planes, room


MIRRORED_COLUMNS = {"edge_attr": "turn_sin", "door_attr": "angle_sin", "near_attr": "angle_sin"}  # that change their sign
DOOR_SHIFT = 0.8  # pixels, standard deviation of where a door stands
WILD, WILD_SHARE = 4.0, 0.1  # how many times as much some maps are turned and stretched, and how often


def compute_quarter_turns(pair: GraphPair) -> int | None:
    """Compute quarter turns by which b is to be turned so that it stands as a does; None where no transform is true."""
    matrix = pair.transform
    if not bool(torch.isfinite(matrix).all()) or not len(pair.a["turn"]) or not len(pair.b["turn"]):
        return None
    yaw = math.atan2(float(matrix[1, 0]), float(matrix[0, 0])) + float(pair.b["turn"][0]) - float(pair.a["turn"][0])
    return round(yaw / (math.pi / 2)) % 4


def add_views(graph: Graph, names: Sequence[str]) -> Graph:
    """Return a graph with the crops and ways that a network reads, of its sheet as it is."""
    return {**graph, **crop_rooms(graph, names), **compute_relative_positions(graph, names)}


def crop_rooms(graph: Graph, names: Sequence[str], rooms: Tensor | None = None) -> Graph:
    """Return the crops that a network reads, of the rooms (n,) of a sheet; of all if left out."""
    read: tuple[str, ...] = ("sheet", "sheet_room", "anchor", "door_anchor")
    arrays = {name: graph[name].numpy() for name in read if name in graph}
    chosen = None if rooms is None else rooms.numpy()
    return {part: torch.from_numpy(cut_crops(arrays, part, chosen)) for part in CROP_SHAPES if part in names}


def compute_relative_positions(graph: Graph, names: Sequence[str]) -> Graph:
    """Compute the directions of the rooms' neighbours, if a network reads them."""
    if "edge_way" not in names:
        return {}
    return {
        "edge_way": torch.from_numpy(
            compute_edge_positions({n: graph[n].numpy() for n in ("pos", "edge_pos", "edge_index", "turn")})
        )
    }


def augment_sheet(graph: Graph, augment: Augment, generator: torch.Generator) -> Graph:
    """Return a map as another sensor saw its storeys on another walk (`simulate_partial_walk`, `simulate_slice`); middles of
    rooms, and doors, lie elsewhere."""
    rng = np.random.default_rng(int(torch.randint(1 << 40, (), generator=generator)))
    planes, room, anchor, doors = (graph[name].numpy() for name in ("sheet", "sheet_room", "anchor", "door_anchor"))
    if rng.random() < augment.walks:
        planes, room = simulate_partial_walk(planes, room, anchor, doors, rng)
    if rng.random() < augment.slices:
        planes = simulate_slice(planes, rng)
    if rng.random() < augment.rough:
        planes = roughen_walls(planes, rng)
    planes, room = drop_patches(planes, room, rng)
    out, tilt = dict(graph), 0.0
    if augment.tilt or augment.zoom or augment.bend:
        more = WILD if rng.random() < WILD_SHARE else 1.0
        tilt, zoom = (
            math.radians(more * augment.tilt) * rng.standard_normal(),
            math.exp(more * augment.zoom * rng.standard_normal()),
        )
        planes, room, (anchor, doors) = warp_planes(planes, room, (anchor, doors), tilt, zoom, augment.bend, rng)
    if "edge_way" in out:
        out["edge_way"] = _rotate_relative_positions(out["edge_way"], tilt)
    anchor = anchor + augment.shift * rng.standard_normal(anchor.shape)
    doors = doors + DOOR_SHIFT * rng.standard_normal(doors.shape)
    places = {"anchor": torch.from_numpy(anchor.astype(np.float32)), "door_anchor": torch.from_numpy(doors.astype(np.float32))}
    return {**out, "sheet": torch.from_numpy(planes), "sheet_room": torch.from_numpy(room), **places}


def _rotate_relative_positions(positions: Tensor, angle: float) -> Tensor:
    """Turn ways (E, 4), two of x and y each, by an angle, rad."""
    c, s = math.cos(angle), math.sin(angle)
    return (positions.reshape(-1, 2, 2) @ torch.tensor([[c, s], [-s, c]])).flatten(1)


def mirror_graph(graph: Graph) -> Graph:
    """Return a map seen in a mirror that stands along its walls: y changes its sign."""
    out = dict(graph)
    for part in CROP_SHAPES.keys() & out.keys():
        out[part] = out[part].flip(out[part].dim() - 2)
    if "edge_way" in out:
        out["edge_way"] = out["edge_way"] * torch.tensor([1.0, -1.0, 1.0, -1.0])
    for name, feature in MIRRORED_COLUMNS.items():
        if name in out:
            sign = torch.ones(out[name].shape[1])
            sign[find_column(name, feature)] = -1
            out[name] = out[name] * sign
    return out


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
    | `map` | (R,) int64 | number of the map; one that comes again, turned, has a number of its own |
    | `true` | (R,) | true room, -1 none |
    | `clear` | (R,) bool | see `find_well_seen_rooms` |
    | `building` | (R,) int64 | number of the physical building |
    | `match_index` | (2, M) | rooms of a and of b that are one true room |
    | `room_counts` | (2,) | rooms of a and of b |

    Batches of pairs are of this class, too.
    """

    def __inc__(self, key: str, value: Any, *args: Any, **kwargs: Any) -> Any:
        if key in ("door_index", "near_index"):  # of edges, not of rooms
            return self["edge_index"].size(1)
        if key == "map":
            return int(value.max()) + 1 if len(value) else 0
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
        """Return which rooms of the batch belong together."""
        pair, side, true = self["batch"], self["side"], self["true"]
        same = torch.zeros((len(pair), len(pair)), dtype=torch.bool, device=pair.device)
        first, second = self["match_index"]
        same[first, second] = same[second, first] = True
        map = 2 * pair + side
        piece = (map[:, None] == map[None]) & (true[:, None] == true[None]) & (true >= 0)[:, None]
        return Truth(pair, side, same, piece.fill_diagonal_(False), self["clear"], self["building"])


class AugmentedPairs(Dataset[MapPair]):
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
        return build_map_pair(self.pairs[number], self.names, self.augment, generator)

    def build_batch(self, numbers: Sequence[int]) -> MapPair:
        """Build pairs of these numbers as a batch."""
        batch: MapPair = Batch.from_data_list([self[number] for number in numbers])
        return batch


def make_batch(
    pairs: Sequence[GraphPair], names: Sequence[str], augment: Augment | None = None, generator: torch.Generator | None = None
) -> MapPair:
    """Make pairs as a batch.

    Args:
        names: tensors that the network reads.
        augment: how maps are changed; needs the generator. None: not at all.
    """
    batch: MapPair = Batch.from_data_list([build_map_pair(pair, names, augment, generator) for pair in pairs])
    return batch


def build_map_pair(
    pair: GraphPair, names: Sequence[str], augment: Augment | None = None, generator: torch.Generator | None = None
) -> MapPair:
    """Return a pair as one graph; see `make_batch`. While training, maps whose turn matters stand alike, and b comes once more,
    turned wrongly: none of its rooms there is one of a."""
    if augment is not None and augment.signs and LANDMARK_PART in names:
        assert generator is not None
        pair = add_invented_signs(pair, augment.signs, generator)
    graphs, rows = [], []
    views, oriented = _build_views(pair, names, augment, generator), bool(ORIENTED & set(names))
    for view, true in zip(views, pair.true, strict=True):
        tensors = {name: view.graph[name] for name in {*names, "edge_index"} - CROP_SHAPES.keys()}
        present = torch.arange(len(true))
        if augment is not None:
            assert generator is not None
            tensors, present = augment_graph(tensors, len(true), augment, generator)
        elif "room_points" in tensors:
            tensors["room_points"] = tensors["room_points"].float() * METRES_PER_MILLIMETRE
        graphs.append(view.rotate_tensors(tensors | crop_rooms(view.graph, names, present)) if oriented else tensors)
        rows.append(present)
    if augment is not None and generator is not None and oriented:
        graphs.append(rotate_quarter_turns(graphs[1], int(torch.randint(1, 4, (1,), generator=generator))))
    links = torch.zeros((len(pair.true[0]), len(pair.true[1])), dtype=torch.bool)
    links[pair.matches[:, 0], pair.matches[:, 1]] = True
    links = links[rows[0]][:, rows[1]]
    counts = torch.tensor([len(present) for present in rows])
    negatives = int(counts[1]) * (len(graphs) - len(rows))
    sides = [torch.repeat_interleave(torch.arange(2), counts), torch.ones(negatives, dtype=torch.long)]
    true_rooms = [numbers[present] for numbers, present in zip(pair.true, rows, strict=True)]
    clear = find_well_seen_rooms(links, pair.a["x"][rows[0]], pair.b["x"][rows[1]])
    side = torch.cat(sides)
    return MapPair(
        **_join_graphs(graphs, [*counts.tolist(), negatives], names),
        side=side,
        map=torch.repeat_interleave(torch.arange(3), torch.tensor([*counts.tolist(), negatives])),
        building=torch.tensor(pair.building_numbers)[side],
        true=torch.cat([*true_rooms, torch.full((negatives,), -1)]),
        clear=torch.cat([*clear, torch.zeros(negatives, dtype=torch.bool)]),
        match_index=torch.nonzero(links).T + torch.tensor([[0], [int(counts[0])]]),
        room_counts=counts,
        num_nodes=int(counts.sum()) + negatives,
    )


def _join_graphs(graphs: Sequence[Graph], rooms: Sequence[int], names: Sequence[str]) -> Graph:
    """Join graphs of so many rooms to one of which no edge leads from one to another."""
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

    def rotate_tensors(self, tensors: Graph) -> Graph:
        """Return the tensors of this map as it is turned."""
        turned = rotate_quarter_turns(tensors, self.quarters)
        return mirror_graph(turned) if self.mirror else turned


def _build_views(
    pair: GraphPair, names: Sequence[str], augment: Augment | None, generator: torch.Generator | None
) -> tuple[_View, _View]:
    """Return both maps as they are; while training, those whose turn matters are changed, turned alike, and both turned and
    mirrored at random."""
    if not ORIENTED & set(names):
        return _View(pair.a), _View(pair.b)
    if augment is None or generator is None:
        return _View({**pair.a, **compute_relative_positions(pair.a, names)}), _View(
            {**pair.b, **compute_relative_positions(pair.b, names)}
        )
    a, b = (
        augment_sheet({**graph, **compute_relative_positions(graph, names)}, augment, generator) for graph in (pair.a, pair.b)
    )
    more, quarters = torch.randint(0, 4, (2,), generator=generator).tolist()
    true = compute_quarter_turns(pair)
    mirror = bool(torch.rand((), generator=generator) < 0.5)
    return _View(a, more, mirror), _View(b, more + (quarters if true is None else true), mirror)


def find_well_seen_rooms(links: Tensor, a: Tensor, b: Tensor) -> list[Tensor]:
    """Find rooms that both walks entered and that have nearly the same area in both maps: (R_a,) and (R_b,) bool.

    Of the others that have a partner, one map holds a part only, so that little can be said about their shape. A room that has
    no partner counts if it was entered.

    Args:
        links: (R_a, R_b) bool, the two are one true room.
        a, b: the rooms' `x`.
    """
    visited = [x[:, find_column("x", "glimpsed")] == 0 for x in (a, b)]
    areas = [x[:, find_column("x", "area")].clamp(min=0.1).log() for x in (a, b)]
    alike = (areas[0][:, None] - areas[1][None]).abs() <= math.log(ALIKE_AREAS)
    good = links & alike & visited[0][:, None] & visited[1][None]
    return [good.any(dim=k) | (~links.any(dim=k) & visited[1 - k]) for k in (1, 0)]


MISPLACED = 0.1  # share of the signs that are taken for another room's


def add_invented_signs(pair: GraphPair, share: float, generator: torch.Generator) -> GraphPair:
    """Return a pair with invented door signs of its true rooms, read by a visitor of each map; by chance, and where it has
    landmarks already or nothing in common, as it is.

    Args:
        share: of the pairs that get signs.
    """
    drawn = bool(torch.rand((), generator=generator) < share) and len(pair.matches) > 0
    if not drawn or any(bool(graph[LANDMARK_PART].any()) for graph in (pair.a, pair.b)):
        return pair
    rng = np.random.default_rng(int(torch.randint(1 << 40, (), generator=generator)))
    numbering, reader = draw_numbering(rng), READERS[str(rng.choice(sorted(READERS)))]
    order = rng.permutation(1 + max(int(true.max()) for true in pair.true))
    graphs = []
    for graph, true in zip((pair.a, pair.b), pair.true, strict=True):
        texts = []
        for room in np.flatnonzero((true.numpy() >= 0) & (rng.random(len(true)) < reader.reads)).tolist():
            number = numbering.first + int(order[true[room]])
            text = numbering.style.format(storey=numbering.storey, wing=numbering.wing, number=number)
            at = int(rng.integers(len(true))) if rng.random() < MISPLACED else room
            texts.append((at, misread(text, reader.wrong, rng), 1.0))
        graphs.append({**graph, LANDMARK_PART: torch.from_numpy(hash_landmarks(len(true), texts, ()))})
    return replace(pair, a=graphs[0], b=graphs[1])


def augment_graph(graph: Graph, rooms: int, augment: Augment, generator: torch.Generator) -> tuple[Graph, Tensor]:
    """Return a map as another walk, sensor or day might have left it; and which rooms are still in it, at least two."""

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
        out["x"] = _scale_features(out["x"], scale, augment.jitter * normal(*out["x"].shape))
    if "edge_attr" in out:
        factor = torch.ones_like(out["edge_attr"])
        lengths = find_columns_of_power("edge_attr", 1)
        factor[:, lengths] = scale * (augment.jitter * normal(len(factor), len(lengths))).exp()
        out["edge_attr"] = out["edge_attr"] * factor
    for name in ("door_attr", "near_attr"):
        if name in out:  # the first column is the distance between two doors
            noise = DOOR_NOISE * normal(len(out[name]))
            out[name] = torch.cat([(out[name][:, :1] * scale + noise[:, None]).clamp(min=0), out[name][:, 1:]], dim=1)
    if "room_points" in out:
        out["room_points"] = _augment_points(out["room_points"], scale, augment, generator)
    return out, torch.nonzero(keep)[:, 0]


def _scale_features(x: Tensor, scale: float, jitter: Tensor) -> Tensor:
    factor = torch.ones_like(x)
    for power in (1, 2, 3):
        columns = find_columns_of_power("x", power)
        factor[:, columns] = scale**power * jitter[:, columns].exp()
    return x * factor


def _augment_points(points: Tensor, scale: float, augment: Augment, generator: torch.Generator) -> Tensor:
    """Draw points at random, in metres, turn them about the vertical at random, and jitter them."""
    rooms, number = points.shape[:2]
    if 0 < augment.points < number:
        chosen = torch.randperm(number, generator=generator)[: augment.points]
        points = points[:, chosen]
    angle = 2 * torch.pi * torch.rand(rooms, generator=generator)
    noise = augment.noise * torch.randn(points.shape, generator=generator)
    return rotate_yaw(points.float() * (METRES_PER_MILLIMETRE * scale) + noise, angle)
