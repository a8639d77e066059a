"""Pairs of maps as graphs of torch-geometric: a batch says of each map what the map says alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from topomerge.models.embedder import Embedder
from torch_geometric.data import Batch
from torch_geometric.loader import DataLoader

from tests.graphs import pair
from topomerge.embedding.graph import find_column
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.training import batches
from topomerge.training.batches import AugmentedPairs, MapPair, add_views, augment_sheet, build_map_pair, make_batch, mirror_graph
from topomerge.training.packed_pairs import Graph, GraphPair
from topomerge.training.settings import Augment


@pytest.mark.parametrize(
    "node", [Node("gat", 2, doors=1, width=4), Node("gat", 1, doors=1, near=True, width=4), Node("sage", 1, width=4)]
)
def test_maps_of_a_batch_do_not_see_each_other(node):
    torch.manual_seed(0)
    network = Embedder(Network(Geometry(["scalars"], width=8), node, size=8)).eval()
    pairs = [pair(0, 5), pair(1, 9)]
    batch = make_batch(pairs, network.tensors)
    assert isinstance(batch, Batch) and isinstance(batch, MapPair) and batch.rooms == [5, 5, 9, 9]
    with torch.no_grad():
        embeddings = network(batch.tensors)[0].split(batch.rooms)
        for embedding, graph in zip(embeddings, (g for p in pairs for g in (p.a, p.b)), strict=True):
            assert torch.allclose(embedding, network(graph)[0], atol=1e-6)


def test_matches_lead_to_rooms_of_the_batch():
    pairs = [pair(k, 5) for k in range(3)]
    batch = make_batch(pairs, ("x", "edge_index", "edge_attr"))
    first, second = batch.match_index
    assert batch.match_index.shape[1] == sum(len(p.matches) for p in pairs)
    assert torch.equal(batch.batch[first], batch.batch[second])
    assert (batch.side[first] == 0).all() and (batch.side[second] == 1).all()
    assert torch.equal(batch.true[first], batch.true[second])
    assert batch.truth.same.sum() == 2 * len(first) and not batch.truth.piece.any()


def test_the_loader_of_torch_geometric_makes_the_same_batches():
    pairs, names = [pair(k, 6) for k in range(4)], ("x", "edge_index", "edge_attr", "near_index", "near_attr")
    loader = DataLoader([build_map_pair(p, names) for p in pairs], batch_size=2)
    for batch, start in zip(loader, (0, 2), strict=True):
        again = make_batch(pairs[start : start + 2], names)
        assert all(torch.equal(batch[name], again[name]) for name in (*names, "match_index", "clear", "batch"))


def test_rooms_that_are_left_out_take_their_matches_along():
    one, generator = pair(0, 12), torch.Generator().manual_seed(0)
    batch = make_batch([one], ("x", "edge_index", "edge_attr"), Augment(rooms=0.9), generator)
    assert sum(batch.rooms) < 24 and len(batch.x) == len(batch.side) == len(batch.true) == sum(batch.rooms)
    first, second = batch.match_index
    assert torch.equal(batch.true[first], batch.true[second]) and batch.edge_index.max() < len(batch.x)


def test_changes_of_a_pair_depend_on_its_seed_only():
    pairs, names = [pair(k, 8) for k in range(4)], ("x", "edge_index", "edge_attr")
    first, again, later = (
        AugmentedPairs(pairs, names, Augment(), seed_of) for seed_of in (int, int, lambda number: number + 100)
    )
    together = next(iter(DataLoader(first, batch_sampler=[[3, 1]])))
    alone = Batch.from_data_list([again[3], again[1]])
    assert len(first) == 4 and torch.equal(together.x, alone.x) and torch.equal(together.edge_index, alone.edge_index)
    assert not torch.equal(first[0].x[:2], later[0].x[:2])


ORIENTED_NAMES = ("x", "edge_index", "edge_attr", "surroundings", "edge_way")


def turned_pair(seed: int, quarters: int) -> GraphPair:
    """A map, and the same rooms in a frame that is turned back by so many quarter turns."""
    one = pair(seed)
    a = {**one.a, "anchor": one.a["anchor"].round()}
    b, side = {**a, "sheet": a["sheet"].rot90(-quarters), "sheet_room": a["sheet_room"].rot90(-quarters)}, len(a["sheet"])
    for _ in range(-quarters % 4):
        b["anchor"] = torch.stack([side - b["anchor"][:, 1], b["anchor"][:, 0]], dim=1)
    turn, angle = torch.eye(4, dtype=torch.float64), quarters * math.pi / 2
    turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    rooms = torch.arange(len(a["x"]))
    return replace(one, a=a, b=b, matches=torch.stack([rooms, rooms], dim=1), true=(rooms, rooms), transform=turn)


@pytest.mark.parametrize("quarters", range(4))
def test_maps_are_trained_on_as_they_truly_stand(quarters, monkeypatch):
    """Both maps have the same crops, turned alike; b comes once more, turned otherwise, with no partner."""
    monkeypatch.setattr(batches, "SEEN_AS", (((), 1.0),))
    monkeypatch.setattr(batches, "PATCHES", 0)
    nothing = Augment(0.0, 0.0, 0.0, noise=0.0, shift=0.0, walks=0.0, slices=0.0, rough=0.0, tilt=0.0, zoom=0.0, bend=0.0)
    one = turned_pair(3, quarters)
    assert batches.compute_quarter_turns(one) == quarters
    batch = build_map_pair(one, ORIENTED_NAMES, nothing, torch.Generator().manual_seed(1))
    count = len(one.a["x"])
    first, second, wrong = batch.surroundings.split(count)
    assert torch.equal(first, second) and not torch.equal(first, wrong)
    assert batch.room_counts.tolist() == [count, count] and batch.side.tolist() == [0] * count + [1] * 2 * count
    assert (batch.true[2 * count :] == -1).all() and not batch["clear"][2 * count :].any()
    assert (batch.match_index < 2 * count).all() and batch.edge_index.max() >= 2 * count


def test_a_mirrored_map_has_mirrored_crops_ways_and_turns():
    seen = add_views(pair(1).a, ORIENTED_NAMES)
    other = mirror_graph(seen)
    assert torch.equal(other["surroundings"], seen["surroundings"].flip(2))
    assert torch.equal(other["edge_way"], seen["edge_way"] * torch.tensor([1.0, -1.0, 1.0, -1.0]))
    sine, cosine = find_column("edge_attr", "turn_sin"), find_column("edge_attr", "turn_cos")
    assert torch.equal(other["edge_attr"][:, sine], -seen["edge_attr"][:, sine])
    assert torch.equal(other["edge_attr"][:, cosine], seen["edge_attr"][:, cosine])
    assert all(torch.equal(mirror_graph(other)[name], seen[name]) for name in ORIENTED_NAMES)


def mirrored_sheet(graph: Graph) -> Graph:
    """The map itself in a mirror: its sheet is drawn from the other side, and middles and doors lie there."""
    out = {**graph, "sheet": graph["sheet"].flip(1), "sheet_room": graph["sheet_room"].flip(1)}
    for name in ("anchor", "door_anchor"):
        x, y = graph[name].unbind(dim=-1)
        out[name] = torch.stack([x, graph["sheet"].shape[1] - y], dim=-1)
    for name in ("pos", "edge_pos"):
        out[name] = graph[name] * torch.tensor([1.0, -1.0, 1.0])
    return out


@pytest.mark.parametrize("part", [*CROP_SHAPES, "edge_way"])
def test_crops_and_ways_of_a_mirrored_sheet_are_the_mirrored_ones(part):
    one = pair(1).a
    seen = add_views(mirrored_sheet(one), [part])[part]
    assert torch.equal(seen, mirror_graph(add_views(one, [part]))[part])
    assert not torch.equal(seen, add_views(one, [part])[part])


@pytest.mark.longer
def test_what_another_sensor_saw_has_the_same_walls_but_in_patches():
    one, alone = pair(2).a, Augment(walks=0.0, slices=0.0, rough=0.0, tilt=0.0, zoom=0.0, bend=0.0)
    seen = augment_sheet(one, alone, torch.Generator().manual_seed(0))
    assert seen["sheet"].shape == one["sheet"].shape and not torch.equal(seen["anchor"], one["anchor"])
    lost = (seen["sheet"][..., 0] != one["sheet"][..., 0]).float().mean()
    assert lost < 0.35 and (seen["sheet"][..., 0][seen["sheet_room"] == -1] == 0).all()
    same, other = (augment_sheet(one, Augment(), torch.Generator().manual_seed(seed)) for seed in (0, 1))
    again = augment_sheet(one, Augment(), torch.Generator().manual_seed(0))
    assert torch.equal(same["sheet"], again["sheet"]) and torch.equal(same["anchor"], again["anchor"])
    assert same["sheet"].shape != other["sheet"].shape or not torch.equal(same["sheet"], other["sheet"])


def test_invented_signs_are_one_of_a_room_and_leave_a_pair_with_landmarks_alone():
    """They depend on the seed only; rooms that are one bear like strings, others do not; the pair itself stays as it is."""
    from topomerge.training.batches import add_invented_signs

    one = pair(0, 40)
    bare = replace(one, a={**one.a, "landmarks": 0 * one.a["landmarks"]}, b={**one.b, "landmarks": 0 * one.b["landmarks"]})
    alike, unlike, read = [], [], []
    for seed in range(20):
        signs, same = (add_invented_signs(bare, 1.0, torch.Generator().manual_seed(seed)) for _ in range(2))
        assert torch.equal(signs.a["landmarks"], same.a["landmarks"]) and not bare.a["landmarks"].any()
        a, b = (graph["landmarks"][:, 2:] for graph in (signs.a, signs.b))
        likeness = a @ b.T
        both = (a.any(dim=1)[:, None] & b.any(dim=1)[None]).float()
        links = torch.zeros_like(likeness)
        links[one.matches[:, 0], one.matches[:, 1]] = 1
        alike.append(float((likeness * links * both).sum() / (links * both).sum()))
        unlike.append(float((likeness * (1 - links) * both).sum() / ((1 - links) * both).sum()))
        read.append(float(a.any(dim=1).float().mean()))
    assert np.mean(alike) > np.mean(unlike) + 0.25 and 0.4 < np.mean(read) < 0.95 and np.ptp(read) > 0.2
    generator = torch.Generator().manual_seed(0)
    assert add_invented_signs(one, 1.0, generator) is one and add_invented_signs(bare, 0.0, generator) is bare
    assert add_invented_signs(replace(bare, matches=bare.matches[:0]), 1.0, generator).a is bare.a
