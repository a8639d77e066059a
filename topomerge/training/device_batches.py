"""Batches of pairs of maps that are made where the network is: storeys stay on the device, crops are sampled there.

The host decides what is in a batch (rooms and doors that are lost, turns). The device draws its values for all maps at once:
sizes, ways and crops. A crop is sampled straight from the storey through the turn, the zoom and the drift of its map, so that no
storey is warped. Random numbers are hashes of a pair's seed: they depend neither on the batch nor on the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from topomerge.embedding.graph import find_column, find_columns_of_power
from topomerge.embedding.network import Network
from topomerge.embedding.surroundings import (
    CROP_PART,
    CROP_SHAPES,
    DOOR_CROP,
    DOOR_CROPS,
    DOOR_PART,
    SHEET_PLANES,
    WIDE_PART,
    WIDE_STEP,
)
from topomerge.training.batches import (
    ALIKE_AREAS,
    BEND_STEP,
    DOOR_SHIFT,
    MIRRORED_COLUMNS,
    PATCH,
    PATCHES,
    SEEN_AS,
    WILD,
    WILD_SHARE,
    MapPair,
    compute_quarter_turns,
    compute_relative_positions,
)
from topomerge.training.captured_step import BatchShape
from topomerge.training.crop_sampling import Crops, Storeys, Views, build_turns, place_crops, sample_by_torch
from topomerge.training.hashed_random import draw_normal, draw_uniform, draw_uniforms, hash_numbers
from topomerge.training.packed_pairs import GraphPair
from topomerge.training.settings import Augment
from topomerge.types import Array

SUPPORTED = {"x", "edge_index", "edge_attr", "edge_way", *CROP_SHAPES}  # tensors that are made on the device
ALIGNED = 64  # numbers of 8 bytes: kernels are compiled anew for tensors that start elsewhere
# Streams of random numbers of a map: one of each kind of change.
ROOM_LOSS, EDGE_LOSS, RATES, SIZES, LENGTHS, MIDDLES, DOORS, KNOTS, SHAPE, TURNS, GAPS = range(1, 12)


def supports_device_batches(network: Network, names: Sequence[str], augment: Augment | None) -> bool:
    """Tell whether batches of these tensors, changed in this way, can be made on a device."""
    changes = () if augment is None else (augment.walks, augment.slices, augment.rough)
    return network.turns > 1 and set(names) <= SUPPORTED and not any(changes)


def pad_structure(s: Structure, shape: BatchShape) -> Structure:
    """Fill a batch up: rooms come again, which are of no pair, and edges lead from the last of these to itself.

    Rooms that come again leave the statistics of a batch much as they were; zeros would not.
    """
    rooms, edges = shape.rooms - len(s.room), shape.edges - len(s.edge)
    repeated, first = np.arange(rooms) % len(s.room), np.zeros(edges, np.int64)
    edge_index = np.concatenate([s.edge_index, np.full((2, edges), shape.rooms - 1)], axis=1)
    edge_part = np.full(edges, s.room_part[repeated[-1]])
    return replace(
        s, room=np.concatenate([s.room, s.room[repeated]]), room_part=np.concatenate([s.room_part, s.room_part[repeated]]),
        true=np.concatenate([s.true, np.full(rooms, -1)]), clear=np.concatenate([s.clear, np.zeros(rooms, bool)]),
        edge=np.concatenate([s.edge, first]), edge_part=np.concatenate([s.edge_part, edge_part]), edge_index=edge_index,
    )  # fmt: skip


def choose_sampler(device: torch.device) -> Callable[[Storeys, Views, Crops], Tensor]:
    """Return what samples crops on a device: one kernel where there is Triton, else torch."""
    if device.type == "cuda" and find_spec("triton") is not None:
        from topomerge.training.crop_kernel import sample_by_kernel

        return sample_by_kernel
    return sample_by_torch


def concatenate_ranges(first: Array, count: Array) -> Array:
    """Return the numbers first[0], first[0] + 1, ... (count[0] of them), then those of the next, int64."""
    ends = np.cumsum(count)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(first - (ends - count), count)


@dataclass(frozen=True)
class Structure:
    """The structure of a batch: its parts are a, b, and b once more where it is turned wrongly, of each pair.

    Args:
        room, edge: (R,), (E,) rows of the tables.
        room_part, edge_part: (R,), (E,) part of the batch that each is of.
        part_map: (P,) map of each part; side: (P,); pair: (P,) of the batch.
        rotation: (P, 2, 2) which place of a map lies where, of each part: quarter turns and mirrors.
        seed: (P,) of the map's changes.
        edge_index: (2, E); match_index: (2, M) rooms of the batch.
        true: (R,); clear: (R,) bool; counts: (pairs, 2) rooms of a and b.
        real: so many rooms are of the batch; those after them fill it up.
    """

    room: Array
    edge: Array
    room_part: Array
    edge_part: Array
    part_map: Array
    side: Array
    pair: Array
    rotation: Array
    seed: Array
    edge_index: Array
    match_index: Array
    true: Array
    clear: Array
    counts: Array
    real: int


class DevicePairs:
    """Pairs of maps on a device, and batches of them.

    Args:
        pairs: with their sheets (`load_pairs(extras=["sheet"])`).
        names: tensors that the network reads, of `SUPPORTED`.
        augment: how maps are changed; None: not at all.
        device: that the network is on.

    `mean_shape` is set where batches are filled up to a few shapes.
    """

    def __init__(self, pairs: Sequence[GraphPair], names: Sequence[str], augment: Augment | None, device: torch.device) -> None:
        self.names, self.augment, self.device = tuple(names), augment, device
        graphs = [graph for pair in pairs for graph in (pair.a, pair.b)]
        self.rooms = np.array([len(graph["x"]) for graph in graphs])
        self.edges = np.array([graph["edge_index"].shape[1] for graph in graphs])
        self.first_room = np.concatenate([[0], np.cumsum(self.rooms)])
        self.first_edge = np.concatenate([[0], np.cumsum(self.edges)])
        self.edge_index = torch.cat([graph["edge_index"] for graph in graphs], dim=1).numpy()
        self.true = np.concatenate([rooms.numpy() for pair in pairs for rooms in pair.true])
        self.matches = np.concatenate([pair.matches.numpy().reshape(-1, 2) for pair in pairs])
        self.first_match = np.concatenate([[0], np.cumsum([len(pair.matches) for pair in pairs])])
        self.building = torch.tensor([pair.building_numbers for pair in pairs]).flatten().to(device)  # of each map
        self.quarters = np.array([-1 if (k := compute_quarter_turns(pair)) is None else k for pair in pairs])
        x = torch.cat([graph["x"] for graph in graphs])
        self.glimpsed = x[:, find_column("x", "glimpsed")].numpy() != 0
        self.log_area = np.log(np.maximum(x[:, find_column("x", "area")].numpy(), 0.1))
        self.tables = {"x": x, "edge_attr": torch.cat([graph["edge_attr"] for graph in graphs])}
        if "edge_way" in names:
            self.tables["edge_way"] = torch.cat([compute_relative_positions(graph, names)["edge_way"] for graph in graphs])
        self.tables["anchor"] = torch.cat([graph["anchor"] for graph in graphs])
        self.tables["doors"] = torch.cat([_pad_doors(graph["door_anchor"]) for graph in graphs])
        self.tables = {name: table.to(device) for name, table in self.tables.items()}
        self.has_door = np.isfinite(self.tables["doors"][..., 0].cpu().numpy())
        self.powers = _mark_columns(x.shape[1], {power: find_columns_of_power("x", power) for power in (1, 2, 3)}).to(device)
        edge_columns = self.tables["edge_attr"].shape[1]
        self.lengths = _mark_columns(edge_columns, {1: find_columns_of_power("edge_attr", 1)}).to(device)
        mirrored = [find_column("edge_attr", MIRRORED_COLUMNS["edge_attr"])]
        self.sign = (1 - _mark_columns(edge_columns, {2: mirrored})).to(device)
        bytes_of = [~sum(255 << (8 * SHEET_PLANES.index(name)) for name in names) for names, _ in SEEN_AS]
        self.gap_masks = torch.tensor(bytes_of, device=device)
        self.gap_shares = torch.tensor(np.cumsum([share for _, share in SEEN_AS])[:-1], device=device, dtype=torch.float32)
        self.mean_shape: BatchShape | None = None
        self.sample = choose_sampler(device)
        self._load_sheets([(graph["sheet"], graph["sheet_room"]) for graph in graphs])

    def _load_sheets(self, sheets: Sequence[tuple[Tensor, Tensor]]) -> None:
        """Put each storey on the device once: eight bytes a pixel, its planes, and its room."""
        number: dict[tuple[int, int], int] = {}
        once: list[tuple[Tensor, Tensor]] = []
        keys = [(planes.data_ptr(), room.data_ptr()) for planes, room in sheets]  # pairs share the storeys of their maps
        for key, sheet in zip(keys, sheets, strict=True):
            if key not in number:
                number[key] = len(once)
                once.append(sheet)
        sizes = np.array([room.shape for _, room in once]).reshape(-1, 2)
        first = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])
        pixels = torch.zeros((int(first[-1]), 8), dtype=torch.uint8)
        rooms = torch.empty(int(first[-1]), dtype=torch.int16)
        for (planes, room), start in zip(once, first[:-1].tolist(), strict=True):
            pixels[start : start + room.numel(), : len(SHEET_PLANES)] = planes.reshape(-1, len(SHEET_PLANES))
            rooms[start : start + room.numel()] = room.reshape(-1)
        self.storeys = Storeys(pixels.view(torch.int64)[:, 0].to(self.device), rooms.to(self.device))
        of_map = np.array([number[key] for key in keys], np.int64)
        self.sheet_size, self.sheet_first = sizes[of_map], first[:-1][of_map]

    def make_batch(self, numbers: Sequence[int], seed_of: Callable[[int], int]) -> MapPair:
        """Return pairs of these numbers as a batch on the device, changed by the seeds of their numbers."""
        structure = self.decide(np.asarray(numbers, np.int64), np.array([seed_of(number) for number in numbers], np.uint64))
        door = np.flatnonzero(self.has_door[structure.room])
        if self.mean_shape is None:
            return self.fill(structure, door)
        shape = BatchShape(len(structure.room), len(structure.edge), len(door)).pad_to_few(self.mean_shape)
        return self.fill(pad_structure(structure, shape), np.resize(door, shape.doors), len(door))

    def measure_mean(self, batch: int) -> BatchShape:
        """Return what a batch of so many pairs holds on average if nothing is lost."""
        doors = np.diff(np.concatenate([[0], np.cumsum(self.has_door.sum(axis=1))])[self.first_room])
        share = batch / (len(self.rooms) // 2)
        copies = [1, 1 if self.augment is None else 2]  # of a and of b
        totals = [float(of.reshape(-1, 2).sum(axis=0) @ copies) for of in (self.rooms, self.edges, doors)]
        return BatchShape(*(round(share * total) for total in totals))

    def decide(self, numbers: Array, seeds: Array) -> Structure:
        """Return what a batch holds: the rooms and edges that are left, and how each part is turned."""
        maps = (2 * numbers[:, None] + [0, 1]).ravel()
        map_seed = hash_numbers(np.repeat(seeds, 2), RATES, np.tile([0, 1], len(numbers))) >> np.uint64(1)
        keep, edge_keep, rows, edge_rows = self._drop_rooms(maps, map_seed)
        of_map = np.repeat(np.arange(len(maps)), self.rooms[maps])
        kept = np.bincount(of_map[keep], minlength=len(maps))
        edge_of_map = np.repeat(np.arange(len(maps)), self.edges[maps])
        edges_kept = np.bincount(edge_of_map[edge_keep], minlength=len(maps))
        number = np.cumsum(keep) - 1  # among all that are kept
        start, edge_start = np.cumsum(kept) - kept, np.cumsum(edges_kept) - edges_kept

        copies = 2 if self.augment is None else 3
        part = (2 * np.arange(len(numbers))[:, None] + [0, 1, 1][:copies]).ravel()
        side, pair = np.tile([0, 1, 1][:copies], len(numbers)), np.repeat(np.arange(len(numbers)), copies)
        wrong = np.tile([False, False, True][:copies], len(numbers))
        part_start = np.cumsum(kept[part]) - kept[part]
        pick = concatenate_ranges(start[part], kept[part])
        edge_pick = concatenate_ranges(edge_start[part], edges_kept[part])
        room, edge = rows[keep][pick], edge_rows[edge_keep][edge_pick]
        room_part, edge_part = np.repeat(np.arange(len(part)), kept[part]), np.repeat(np.arange(len(part)), edges_kept[part])

        first = (np.cumsum(self.rooms[maps]) - self.rooms[maps])[part]  # of each part's map among all of the batch
        ends = self.edge_index[:, edge] + first[edge_part]
        edge_index = number[ends] - start[part][edge_part] + part_start[edge_part]

        match_rows = concatenate_ranges(self.first_match[numbers], np.diff(self.first_match)[numbers])
        match_pair = np.repeat(np.arange(len(numbers)), np.diff(self.first_match)[numbers])
        map_first = np.cumsum(self.rooms[maps]) - self.rooms[maps]
        ends = self.matches[match_rows].T + np.stack([map_first[2 * match_pair], map_first[2 * match_pair + 1]])
        present = keep[ends].all(axis=0)
        ends, match_pair = ends[:, present], match_pair[present]
        parts = np.stack([copies * match_pair, copies * match_pair + 1])
        match_index = number[ends] - start[np.stack([2 * match_pair, 2 * match_pair + 1])] + part_start[parts]

        true = np.where(wrong[room_part], -1, self.true[room])
        clear = self._find_well_seen_rooms(room, match_index) & ~wrong[room_part]
        rotation = self._draw_rotations(numbers, seeds, side, wrong)
        return Structure(
            room, edge, room_part, edge_part, maps[part], side, pair, rotation, map_seed[part], edge_index, match_index, true,
            clear, kept.reshape(-1, 2), len(room),
        )  # fmt: skip

    def _drop_rooms(self, maps: Array, seed: Array) -> tuple[Array, Array, Array, Array]:
        """Return which rooms and edges of maps are kept (bool), and their rows: at least two rooms of each, doors both ways."""
        count, edges = self.rooms[maps], self.edges[maps]
        rows, edge_rows = concatenate_ranges(self.first_room[maps], count), concatenate_ranges(self.first_edge[maps], edges)
        if self.augment is None:
            return np.ones(len(rows), bool), np.ones(len(edge_rows), bool), rows, edge_rows
        of_map, edge_of_map = np.repeat(np.arange(len(maps)), count), np.repeat(np.arange(len(maps)), edges)
        local, edge_local = rows - self.first_room[maps][of_map], edge_rows - self.first_edge[maps][edge_of_map]
        rate = self.augment.rooms * draw_uniform(seed, RATES, np.zeros(len(maps)))
        keep = draw_uniform(seed[of_map], ROOM_LOSS, local) >= rate[of_map]
        keep |= (np.bincount(of_map[keep], minlength=len(maps)) < 2)[of_map]
        rate = self.augment.edges * draw_uniform(seed, RATES, np.ones(len(maps)))
        half = np.maximum(edges // 2, 1)[edge_of_map]
        edge_keep = draw_uniform(seed[edge_of_map], EDGE_LOSS, edge_local % half) >= rate[edge_of_map]
        first = (np.cumsum(count) - count)[edge_of_map]
        return keep, edge_keep & keep[self.edge_index[:, edge_rows] + first].all(axis=0), rows, edge_rows

    def _find_well_seen_rooms(self, room: Array, match_index: Array) -> Array:
        """Return (R,) bool as `batches.find_well_seen_rooms`: entered in both maps, areas alike, or entered and without a
        partner."""
        a, b = room[match_index]
        alike = np.abs(self.log_area[a] - self.log_area[b]) <= math.log(ALIKE_AREAS)
        well, linked = np.zeros(len(room), bool), np.zeros(len(room), bool)
        linked[match_index.ravel()] = True
        good = alike & ~self.glimpsed[a] & ~self.glimpsed[b]
        well[match_index[:, good].ravel()] = True
        return well | (~linked & ~self.glimpsed[room])

    def _draw_rotations(self, numbers: Array, seeds: Array, side: Array, wrong: Array) -> Array:
        """Return (P, 2, 2) int64: a place of a part, seen from its middle -> that of its map."""
        copies = len(side) // len(numbers)
        draws = np.stack([draw_uniform(seeds, TURNS, np.full(len(seeds), k)) for k in range(4)])
        more, free, false = (4 * draws[0]).astype(int), (4 * draws[1]).astype(int), 1 + (3 * draws[3]).astype(int)
        mirror = draws[2] < 0.5
        true = np.where(self.quarters[numbers] < 0, free, self.quarters[numbers])
        if self.augment is None:
            more, true, false, mirror = (np.zeros(len(numbers), int) for _ in range(4))
        quarter = np.array([[0, 1], [-1, 0]])  # where a pixel of a crop that is turned once was before
        powers = np.stack([np.linalg.matrix_power(quarter, k) for k in range(4)])
        flips = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]]])
        pair = np.repeat(np.arange(len(numbers)), copies)
        turns = (more[pair] + np.where(side == 1, true[pair], 0)) % 4
        last = np.where(wrong, false[pair], 0)
        return np.asarray(powers[turns] @ flips[mirror[pair].astype(int)] @ powers[last], np.int64)

    def send(self, arrays: Mapping[str, Array]) -> dict[str, Tensor]:
        """Send arrays of whole numbers to the device in one piece, int64, without waiting for it."""
        sizes = [-(-array.size // ALIGNED) * ALIGNED for array in arrays.values()]
        flat = torch.empty(sum(sizes), dtype=torch.int64, pin_memory=self.device.type == "cuda")
        for piece, array in zip(flat.split(sizes), arrays.values(), strict=True):
            piece[: array.size] = torch.from_numpy(np.ascontiguousarray(array).astype(np.int64)).flatten()
        pieces = flat.to(self.device, non_blocking=True).split(sizes)
        return {name: piece[: of.size].view(of.shape) for piece, (name, of) in zip(pieces, arrays.items(), strict=True)}

    def fill(self, structure: Structure, door: Array, doors: int | None = None) -> MapPair:
        """Return the batch of a structure, with values drawn on the device.

        Args:
            door: (D,) which of the rooms' R * DOOR_CROPS doors there are; doors: so many of them, those after them fill it up.
        """
        s, names = structure, self.names
        slots = np.full(len(s.room) * DOOR_CROPS, len(door))
        slots[door[:doors]] = np.arange(len(door[:doors]))
        arrays = {"room": s.room, "part": s.room_part, "edge": s.edge, "edge_part": s.edge_part, "door": door}
        arrays |= {"pair": np.where(np.arange(len(s.room)) < s.real, s.pair[s.room_part], -1), "side": s.side[s.room_part]}
        arrays |= {"true": s.true, "clear": s.clear, "ends": s.edge_index, "match": s.match_index, "slots": slots}
        arrays |= {"map": s.part_map[s.room_part], "first": self.first_room[s.part_map], "seed": s.seed, "rotation": s.rotation}
        arrays |= {"size": self.sheet_size[s.part_map], "pixel": self.sheet_first[s.part_map]}
        sent = self.send(arrays)
        room, part, seed = sent["room"], sent["part"], sent["seed"]
        views = self._draw_views(seed, sent["rotation"], sent["size"], sent["pixel"], self.sheet_size[s.part_map])
        local = room - sent["first"][part]
        tensors = self._draw_tables(room, part, local, sent["edge"], sent["edge_part"], seed, views)
        tensors |= self._sample_crops(room, part, local, sent["door"], views)
        batch = MapPair(
            **{name: tensors[name] for name in names if name in tensors}, edge_index=sent["ends"], side=sent["side"],
            true=sent["true"], map=part, clear=sent["clear"].bool(), building=self.building[sent["map"]],
            match_index=sent["match"], room_counts=torch.from_numpy(s.counts.ravel()), num_nodes=len(s.room),
        )  # fmt: skip
        batch["batch"] = sent["pair"]
        if DOOR_PART in names:
            batch["door_rows"], batch["door_slots"] = sent["door"], sent["slots"].view(-1, DOOR_CROPS)
        return batch

    def _draw_views(self, seed: Tensor, rotation: Tensor, size: Tensor, first: Tensor, sizes: Array) -> Views:
        """Draw how the storey of each part is turned, stretched, bent, and what of it is missing; `sizes` as on the host."""
        augment, device = self.augment, self.device
        if augment is None:
            shape = torch.tensor([[0.0, 1.0, 1.0]], device=device).expand(len(seed), 3)
            return Views(seed, size, first, rotation.float(), shape, None, None, None)
        draws = draw_uniforms(seed[:, None], GAPS, torch.arange(3 + 4 * PATCHES, device=device))
        normal = draw_normal(seed[:, None], SHAPE, torch.arange(3, device=device))
        wild = torch.where(draws[:, 0] < WILD_SHARE, WILD, 1.0)
        angle, zoom = wild * math.radians(augment.tilt) * normal[:, 0], (wild * augment.zoom * normal[:, 1]).exp()
        shape = torch.stack([angle, zoom, (augment.scale * normal[:, 2]).exp()], dim=1)
        rows, columns = ((sizes // BEND_STEP).max(axis=0) + 2).tolist()
        index = torch.arange(2 * rows * columns, device=device)
        knots = augment.bend * draw_normal(seed[:, None], KNOTS, index).reshape(len(seed), rows, columns, 2)
        return Views(seed, size, first, rotation.float(), shape, knots, *self._draw_gaps(draws[:, 1:], size))

    def _draw_gaps(self, draws: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """Draw which planes a map lacks, as a mask of bytes, and patches that it did not see (P, 4, n): low and high x, y."""
        mask = self.gap_masks[torch.bucketize(draws[:, 0].contiguous(), self.gap_shares, right=True)]
        count = (draws[:, 1] * (PATCHES + 1)).floor()
        starts, sides = draws[:, 2:].reshape(len(draws), 2, 2, PATCHES).unbind(dim=1)
        low = (starts * size[..., None]).floor()
        some = torch.arange(PATCHES, device=self.device) < count[:, None]
        high = low + (PATCH[0] + (sides * (PATCH[1] - PATCH[0])).floor()) * some[:, None]
        return mask, torch.cat([low, high], dim=1)

    def _draw_tables(
        self, room: Tensor, part: Tensor, local: Tensor, edge: Tensor, edge_part: Tensor, seed: Tensor, views: Views
    ) -> dict[str, Tensor]:
        """Return features of rooms and edges, of other sizes, turned as their part is."""
        augment, out = self.augment, {"x": self.tables["x"][room], "edge_attr": self.tables["edge_attr"][edge]}
        if "edge_way" in self.names:
            out["edge_way"] = self.tables["edge_way"][edge]
        if augment is None:
            return out
        scale, powers, lengths, sign = views.shape[:, 2], self.powers, self.lengths, self.sign
        index = local[:, None] * len(powers) + torch.arange(len(powers), device=self.device)
        jitter = (augment.jitter * draw_normal(seed[part][:, None], SIZES, index)).exp()
        out["x"] = out["x"] * torch.where(powers > 0, scale[part][:, None] ** powers * jitter, 1.0)
        index = edge[:, None] * len(lengths) + torch.arange(len(lengths), device=self.device)
        jitter = (augment.jitter * draw_normal(seed[edge_part][:, None], LENGTHS, index)).exp()
        out["edge_attr"] = out["edge_attr"] * torch.where(lengths > 0, scale[edge_part][:, None] * jitter, 1.0)
        (a, b), (c, d) = views.rotation.permute(1, 2, 0)
        flipped = a * d < b * c
        out["edge_attr"] = torch.where(flipped[edge_part][:, None], out["edge_attr"] * sign, out["edge_attr"])
        if "edge_way" in out:
            turn = views.rotation.mT @ build_turns(
                views.shape[:, 0], torch.ones_like(scale)
            )  # the rotation leads back to the map
            out["edge_way"] = (out["edge_way"].reshape(-1, 2, 2) @ turn.mT[edge_part]).flatten(1)
        return out

    def _sample_crops(self, room: Tensor, part: Tensor, local: Tensor, door: Tensor, views: Views) -> dict[str, Tensor]:
        """Return the crops that the network reads, about middles and doors (D,) that lie elsewhere."""
        out = {}
        anchor, doors, augment = self.tables["anchor"][room].double(), self.tables["doors"][room].double(), self.augment
        axes = torch.arange(2, device=self.device)
        anchor, doors = views.move(anchor, part), views.move(doors.flatten(0, 1), part.repeat_interleave(DOOR_CROPS))
        if augment is not None:
            seed = views.seed[part][:, None]
            anchor = anchor + augment.shift * draw_normal(seed, MIDDLES, 2 * local[:, None] + axes)
            index = 2 * DOOR_CROPS * local[:, None] + torch.arange(2 * DOOR_CROPS, device=self.device)
            doors = doors + DOOR_SHIFT * draw_normal(seed, DOORS, index).reshape(-1, 2)
        for name, step in ((CROP_PART, 1), (WIDE_PART, WIDE_STEP)):
            if name in self.names:
                out[name] = self._sample(views, place_crops(views, anchor, part, local, CROP_SHAPES[name][0], step))
        if DOOR_PART in self.names:
            of = door // DOOR_CROPS
            crops = torch.zeros((len(doors), *CROP_SHAPES[DOOR_PART][1:]), dtype=torch.uint8, device=self.device)
            crops[door] = self._sample(views, place_crops(views, doors[door], part[of], local[of], DOOR_CROP, 1))
            out[DOOR_PART] = crops.unflatten(0, (len(room), DOOR_CROPS))
        return out

    def _sample(self, views: Views, crops: Crops) -> Tensor:
        """Return (n, side, side, 8) uint8 crops."""
        if not len(crops.part):
            return torch.zeros((0, crops.side, crops.side, 8), dtype=torch.uint8, device=self.device)
        pixels = self.sample(self.storeys, views, crops)
        return pixels[..., None].view(torch.uint8).unflatten(1, (crops.side, crops.side))


def _mark_columns(count: int, marks: dict[int, Sequence[int]]) -> Tensor:
    """Return (count,) float32: the mark of each column, 0 of the others."""
    out = torch.zeros(count)
    for mark, columns in marks.items():
        out[list(columns)] = mark
    return out


def _pad_doors(doors: Tensor) -> Tensor:
    """Return (R, DOOR_CROPS, 2) places of doors, nan where a room has fewer."""
    out = torch.full((len(doors), DOOR_CROPS, 2), float("nan"))
    some = doors[:, :DOOR_CROPS]
    out[:, : some.shape[1]] = some
    return out
