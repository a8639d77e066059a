"""Small random graphs and sets of pairs for the tests of networks and of training."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from topomerge import archive
from topomerge.embedding.engineered import compute_door_layout
from topomerge.embedding.graph import count_columns, hash_landmarks
from topomerge.embedding.surroundings import CROP, CROP_SHAPES, SHEET_PLANES
from topomerge.training.batches import add_views
from topomerge.training.packed_pairs import GraphPair

LATER = ("engineered", "shapedna", "near_index", "near_attr", *CROP_SHAPES, "edge_way")  # reckoned when a set is read
VIEWS = (*CROP_SHAPES, "edge_way")


def graph(rooms: int = 7, seed: int = 0, points: int = 64) -> dict[str, torch.Tensor]:
    """Tensors as of `embedding.graph`, of a ring of rooms with one more door across; points are metres."""
    g = torch.Generator().manual_seed(seed)
    ends = torch.tensor([*((i, (i + 1) % rooms) for i in range(rooms)), (0, rooms // 2)]).T
    index = torch.cat([ends, ends.flip(0)], dim=1)
    here = index[0]
    doors = torch.nonzero((here[:, None] == here[None]) & ~torch.eye(len(here), dtype=torch.bool)).T
    middle, door = 8 * torch.rand((rooms, 3), generator=g), 8 * torch.rand((ends.shape[1], 3), generator=g)
    middle[:, 2] = door[:, 2] = 1.0
    near = [torch.from_numpy(array) for array in compute_door_layout(index.numpy(), middle.numpy(), door.repeat(2, 1).numpy())]
    size = 1 + 3 * torch.rand((rooms, 1, 3), generator=g)
    anchor = 10 + CROP * torch.rand((rooms, 2), generator=g)
    columns = torch.stack(torch.meshgrid(*[torch.arange(CROP + 20.0)] * 2, indexing="ij"), dim=-1)
    views = {
        "sheet": torch.randint(0, 256, (*columns.shape[:2], len(SHEET_PLANES)), generator=g, dtype=torch.uint8),
        "sheet_room": (columns[:, :, None] - anchor).norm(dim=3).argmin(dim=2).to(torch.int16),
        "anchor": anchor,
        "door_anchor": _doors(anchor),
        "turn": torch.zeros(1, dtype=torch.float64),
    }
    tensors = {
        "x": 10 * torch.rand((rooms, count_columns("x")), generator=g),
        "engineered": torch.rand((rooms, count_columns("engineered")), generator=g),
        "shapedna": torch.rand((rooms, count_columns("shapedna")), generator=g),
        "landmarks": _landmarks(rooms, seed),
        "room_points": size * (torch.rand((rooms, points, 3), generator=g) - torch.tensor([0.5, 0.5, 0.0])),
        "edge_index": index,
        "edge_attr": torch.randn((index.shape[1], count_columns("edge_attr")), generator=g),
        "door_index": doors,
        "door_attr": torch.randn((doors.shape[1], count_columns("door_attr")), generator=g),
        "near_index": near[0],
        "near_attr": near[1],
        "pos": middle,
        "edge_pos": door.repeat(2, 1),
    }
    return add_views({**tensors, **views}, VIEWS)


def _landmarks(rooms: int, seed: int) -> torch.Tensor:
    """Signs in two of three rooms, a chair in every fourth."""
    texts = [(r, f"{seed}.{100 + r}", 0.9) for r in range(rooms) if r % 3]
    return torch.from_numpy(hash_landmarks(rooms, texts, [(r, "chair", 1.0) for r in range(0, rooms, 4)]))


def _doors(anchor: torch.Tensor) -> torch.Tensor:
    """(R, 4, 2) places of no door, one, two or three, and so on."""
    number = torch.arange(4)
    doors = anchor[:, None] + 3.0 * number[None, :, None]
    doors[number[None] >= torch.arange(len(anchor))[:, None] % 4] = torch.nan
    return doors


def turned(tensors: dict[str, torch.Tensor], angle: float) -> dict[str, torch.Tensor]:
    """The same map in a frame turned about the vertical: all but the points stays."""
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    return {**tensors, "room_points": tensors["room_points"] @ turn.T}


def shuffled(tensors: dict[str, torch.Tensor], seed: int = 0) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """The same map with rooms and edges in another order; and where each new room was."""
    g = torch.Generator().manual_seed(seed)
    rooms, edges = torch.randperm(len(tensors["x"]), generator=g), torch.randperm(len(tensors["edge_attr"]) // 2, generator=g)
    edges = torch.cat([edges, edges + len(edges)])  # an edge and its way back stand half of all apart
    new_room, new_edge = rooms.argsort(), edges.argsort()
    of_rooms = ("x", "engineered", "shapedna", "landmarks", "room_points", "pos", "anchor", "door_anchor")
    out = {name: tensors[name][rooms] for name in of_rooms}
    out |= {"sheet": tensors["sheet"], "sheet_room": new_room[tensors["sheet_room"].long()].to(torch.int16)}
    out["turn"] = tensors["turn"]
    out |= {"edge_index": new_room[tensors["edge_index"][:, edges]], "edge_attr": tensors["edge_attr"][edges]}
    out |= {
        "edge_pos": tensors["edge_pos"][edges],
        "near_index": new_edge[tensors["near_index"]],
        "near_attr": tensors["near_attr"],
    }
    out |= {"door_index": new_edge[tensors["door_index"]], "door_attr": tensors["door_attr"]}
    return add_views(out, VIEWS), rooms


def pair(seed: int, rooms: int = 7) -> GraphPair:
    """A map and the same one in another order with a little noise; room 0 of a has no partner."""
    a = graph(rooms, seed)
    b, rooms_of = shuffled(a, seed)
    b["x"] = b["x"] * (1 + 0.01 * torch.randn(b["x"].shape, generator=torch.Generator().manual_seed(seed)))
    for one in (a, b):
        one["room_points"] = (one["room_points"] * 1000).to(torch.int16)
    where = rooms_of.argsort()
    matches = torch.tensor([(i, int(where[i])) for i in range(1, rooms)])
    true = (torch.arange(rooms), torch.where(rooms_of > 0, rooms_of, torch.tensor(-1)))
    return GraphPair(a, b, matches, true, (torch.ones(rooms), torch.ones(rooms)), {"building": f"b{seed}"}, torch.eye(4))


def write_set(folder: Path, name: str, pairs: int) -> Path:
    """A cached set as `datasets.pairs.build` leaves it: a manifest and a file a pair."""
    (folder / "pairs").mkdir(parents=True, exist_ok=True)
    rows = []
    for k in range(pairs):
        one = pair(k)
        arrays = {}
        for side, g, true, iou in zip("ab", (one.a, one.b), one.true, one.iou, strict=True):
            tensors = {n: t for n, t in g.items() if n not in LATER}
            arrays |= {f"{side}.{n}": t.numpy() for n, t in tensors.items()}
            arrays[f"{side}.room_points"] = g["room_points"].numpy().astype(np.float32) / 1000
            arrays |= {f"{side}.true_room": true.numpy().astype(np.int32), f"{side}.true_iou": iou.numpy()}
        arrays |= {"matches": one.matches.numpy(), "transform": one.transform.double().numpy()}
        archive.write(arrays, folder / "pairs" / f"{name}{k}.npz")
        rows.append({"file": f"{name}{k}.npz", "building": f"b{k}", "source": "procedural", "sensors": ["tls", "depth"]})
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder / f"{name}.jsonl"
