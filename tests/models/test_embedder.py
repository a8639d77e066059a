"""Networks: what must not matter does not, gradients reach every weight, files are trusted only as far as they can be."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
import torch
from topomerge.models.embedder import Embedder, match_scores, rotate_quarter_turns
from topomerge.models.geometry import find_nearest, rotate_yaw, sample_farthest, voxelize_crop
from topomerge.models.nodes import Standardizer, compute_rbf
from topomerge.models.weights import read_embedder, save_state, wrap_network

from tests.graphs import graph, shuffled, turned
from tests.scenes_map import building
from topomerge.embedding.engineered import LAYOUT_REACH, compute_door_layout
from topomerge.embedding.graph import add_proximity_edges, build_graph_arrays, is_door_edge
from topomerge.embedding.network import TABLE_PARTS, Geometry, Network, Node, build_network, check, list_geometry_parts
from topomerge.embedding.quarter_turns import rotate_graph as numpy_quarter_turned
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError

NODES = [
    Node("none"),
    Node("sage", 1),
    Node("sage", 2, edges=False, skip=False, jump="last"),
    Node("gat", 3, doors=1, jump="max"),
]
NODES += [Node("gat", 2, around=10.0), Node("sage", 1, around=5.0, edges=False)]
NODES += [
    Node("gat", 2, edge_values=False),
    Node("gat", 1, edges=False),
    Node("gat", 2, edges=False, edge_values=False),
]
NODES += [Node("gat", 2, doors=2, near=True), Node("gat", 4, skip=False)]
NODES += [Node("gat", 2, around=10.0, ways=True), Node("sage", 1, ways=True)]


def node_name(node: Node) -> str:
    """Of a test: the options by which the nodes above differ."""
    return f"{node.kind}{node.layers}{node.jump}{node.edges}{node.edge_values}{node.doors}{node.near}{node.around}{node.ways}"


def network(*parts: str, node: Node | None = None, **geometry) -> Embedder:
    torch.manual_seed(0)
    return Embedder(Network(Geometry(list(parts or ["scalars"]), **geometry), node or Node("gat", doors=1))).eval()


@pytest.mark.parametrize("node", NODES, ids=node_name)
def test_the_order_of_rooms_does_not_matter(node):
    net, one = network("scalars", "pointnet", node=node), graph()
    other, rooms = shuffled(one)
    with torch.no_grad():
        (a, bin_a), (b, bin_b) = net(one), net(other)
    assert torch.allclose(a[rooms], b, atol=1e-5) and torch.allclose(bin_a[rooms], bin_b, atol=1e-5)
    assert torch.allclose(a.norm(dim=1), torch.ones(len(a)))


def test_a_turned_map_has_the_same_rows_one_place_further():
    net = network("scalars", *CROP_SHAPES, node=Node("gat", 2, around=10.0, ways=True))
    one = graph()
    with torch.no_grad():
        (rows, bins), (other, other_bins) = net.embed_rotations(one), net.embed_rotations(rotate_quarter_turns(one, 1))
        assert torch.allclose(rows.roll(-1, dims=1), other, atol=1e-5) and torch.allclose(bins, other_bins, atol=1e-5)
        assert (rows[:, 0] - rows[:, 1]).abs().max() > 1e-3
        assert network().embed_rotations(one)[0].ndim == 2


def test_four_quarter_turns_are_none_and_numpy_turns_alike():
    one = {name: tensor for name, tensor in graph().items() if name in (*CROP_SHAPES, "edge_way")}
    arrays = {name: tensor.numpy() for name, tensor in one.items()}
    for turns in range(5):
        ours, theirs = rotate_quarter_turns(one, turns), numpy_quarter_turned(arrays, turns)
        assert all(np.allclose(ours[name].numpy(), theirs[name], atol=1e-5) for name in one)
    assert all(torch.equal(rotate_quarter_turns(one, 4)[name], one[name]) for name in one)


@pytest.mark.parametrize("part", [part for part in list_geometry_parts() if part not in CROP_SHAPES])
def test_yaw(part):
    """Numbers: exactly; points about their longest axis: to 1e-3; points as they are: at the turns that are averaged."""
    one = graph(points=200)
    exact = network(part, canonical=True, yaws=2)
    loose = network(part, yaws=4)
    with torch.no_grad():
        for angle in (0.4, 2.0, math.pi):
            apart = (exact(one)[0] - exact(turned(one, angle))[0]).abs().max()
            limit = 1e-6 if part in TABLE_PARTS else 1e-3 if part != "voxelcnn" else 0.1  # cells: points cross borders
            assert apart < limit, angle
        assert (loose(one)[0] - loose(turned(one, math.pi / 2))[0]).abs().max() < (1e-3 if part != "voxelcnn" else 0.1)


def test_the_scale_matters():
    one = graph()
    big = {**one, "room_points": 1.5 * one["room_points"]}
    for part in ("pointnet", "pointnet_local", "voxelcnn"):
        net = network(part, node=Node("none"))
        with torch.no_grad():
            assert (net.geometry(one) - net.geometry(big)).abs().max() > 1e-3, part


SCALAR_PARTS = ("scalars", "engineered", "shapedna", "landmarks")


# Each node behind the same parts, and each part before the same node: what lies between them is one array.
@pytest.mark.parametrize(
    ("parts", "node"),
    [pytest.param(SCALAR_PARTS, node, id=node_name(node)) for node in NODES]
    + [(parts, NODES[1]) for parts in (("pointnet", "voxelcnn"), ("pointnet_local",), tuple(CROP_SHAPES))],
)
def test_gradients_reach_every_weight(parts, node):
    net = network(*parts, node=node).train()
    embedding, dustbin = net(graph())
    rows, columns = match_scores(embedding[:3], embedding[3:], dustbin[:3], dustbin[3:], net.temperature)
    (rows[:, 0].sum() + columns[:, 1].sum()).backward()
    silent = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    # A shift of all scores of a softmax changes nothing: biases of what is only compared stay where they are.
    assert not [name for name in silent if not name.endswith(("lin_r.bias", "lin_l.bias"))]


def test_rooms_without_doors_and_maps_without_rooms():
    one = graph(3)
    bare = {**one, "edge_index": one["edge_index"][:, :0], "edge_attr": one["edge_attr"][:0], "edge_way": one["edge_way"][:0]}
    for name in ("door", "near"):
        bare |= {f"{name}_index": one[f"{name}_index"][:, :0], f"{name}_attr": one[f"{name}_attr"][:0]}
    for node in NODES:
        embedding, _ = network(node=node)(bare)
        assert torch.isfinite(embedding).all()


def test_standardise_by_hand():
    scale = Standardizer(2)
    scale.fit(torch.tensor([[0.0, 5.0], [math.e - 1, 5.0], [1 - math.e, 5.0]]))
    assert torch.allclose(scale(torch.tensor([[math.e - 1, 5.0]])), torch.tensor([[1 / math.sqrt(2 / 3), 0.0]]), atol=1e-6)


def test_grouping_and_crop_by_hand():
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0]]])
    assert sample_farthest(line, 3).tolist() == [[3, 0, 2]]
    assert sorted(find_nearest(line, line[:, 3:], 2)[0, 0].tolist()) == [2, 3]
    grid = voxelize_crop(torch.tensor([[[0.01, 0.01, 0.01], [0.02, 0.01, 0.01], [100.0, 0, 0]]]))
    assert grid.sum() == 1 and grid[0, 0, 16, 16, 4] == 1
    assert torch.allclose(rotate_yaw(line, torch.tensor([math.pi / 2]))[0, 3], torch.tensor([0.0, 5, 0]), atol=1e-6)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"geometry": {"parts": ["lidar"]}}, "geometry.parts"),
        ({"geometry": {"parts": ["pointnet"], "canonical": True, "yaws": 3}}, "geometry.yaws"),
        ({"node": {"kind": "gcn"}}, "node.kind"),
        ({"node": {"layers": 5}}, "node.layers"),
        ({"node": {"doors": 1, "edges": False}}, "node.edges"),
        ({"node": {"doors": 1, "around": 10.0}}, "node.around=0"),
        ({"node": {"ways": True, "edges": False}}, "node.edges"),
        ({"node": {"around": 1000.0}}, "node.around must be"),
        ({"node": {"heads": 7}}, "geometry.width"),
        ({"node": {"layer": 2}}, "node.layer"),
        ({"node": {"layers": True}}, "node.layers"),
        ({"size": "64"}, "size"),
        ({"dropout": 1.0}, "dropout"),
    ],
)
def test_bad_networks_name_their_key(table, message):
    with pytest.raises(InputError, match=message):
        build_network(table)


@pytest.mark.parametrize("part", ["pointnet", "pointnet_local", "voxelcnn"])
def test_a_file_gives_the_same_network(tmp_path, part):
    net = network("scalars", part)
    save_state(net, tmp_path / "best", {"data": "x"})
    read, about = read_embedder(tmp_path)  # a run: its best
    assert about == {"data": "x"} and asdict(read.network) == asdict(net.network)
    with torch.no_grad():
        assert torch.equal(read(graph())[0], net(graph())[0])


def spoil(path, change) -> None:
    settings = json.loads(path.read_text())
    change(settings)
    path.write_text(json.dumps(settings))


def test_bad_files_are_refused(tmp_path):
    def fresh():
        save_state(network(), tmp_path)
        return tmp_path / "embedder.json", tmp_path / "embedder.safetensors"

    settings, weights = fresh()
    with pytest.raises(InputError, match="no_such"):
        read_embedder(tmp_path / "no_such")
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(InputError, match="cut off"):
        read_embedder(tmp_path)
    weights.unlink()
    with pytest.raises(InputError, match="safetensors"):
        read_embedder(tmp_path)
    for change, said in (
        (lambda t: t.update(format=99), "format 99"),
        (lambda t: t.update(format=1), "has format 1, this version reads 2; export it with the version that wrote it"),
        (lambda t: t.update({"class": "os.system"}), "no embedder .'os.system', not"),
        (lambda t: t.pop("sha256"), "lacks"),
        (lambda t: t["network"].update(size=32), "does not fit"),
        (lambda t: t["network"].update(kind="x"), "kind"),
    ):
        settings, _ = fresh()
        spoil(settings, change)
        with pytest.raises(InputError, match=said):
            read_embedder(tmp_path)
    settings, _ = fresh()
    settings.write_text(settings.read_text()[:50])
    with pytest.raises(InputError, match="damaged"):
        read_embedder(tmp_path)


def test_a_pickle_under_another_name_is_not_run(tmp_path):
    """What torch.save wrote could run anything when unpickled: it is refused by its digest, or as no safetensors."""
    import hashlib

    save_state(network(), tmp_path)
    torch.save({"x": torch.ones(1)}, tmp_path / "embedder.safetensors")
    with pytest.raises(InputError, match="cut off, damaged"):
        read_embedder(tmp_path)
    digest = hashlib.sha256((tmp_path / "embedder.safetensors").read_bytes()).hexdigest()
    spoil(tmp_path / "embedder.json", lambda t: t.update(sha256=digest))
    with pytest.raises(InputError, match="is no safetensors file"):
        read_embedder(tmp_path)


@pytest.mark.longer
def test_an_embedder_of_maps():
    map = building(2, 2)
    describe = wrap_network(network("scalars", "engineered", "shapedna", "pointnet", node=Node("gat", doors=1, near=True)))
    rows = describe(map)
    assert rows.shape == (len(map.rooms), 64) and rows.dtype == np.float64 and np.array_equal(rows, describe(map))
    assert np.array_equal(rows, describe.embed_graph(build_graph_arrays(map))[0]) and describe.compute_matchability(
        map
    ).shape == (len(map.rooms),)
    assert describe(building(1, 1)).shape == (len(building(1, 1).rooms), 64)
    ours, theirs = describe.compute_probabilities(map, map)
    assert np.allclose(ours.sum(axis=1), 1) and ours.shape == (len(map.rooms), len(map.rooms) + 1) and np.allclose(ours, theirs)


def test_rooms_around_by_hand():
    """Three rooms 4 m and 7 m apart, one of them a step higher, and one 5 m above the first; a door leads from 0 to 1."""
    map = {
        "pos": np.array([[0, 0, 1], [4, 0, 1.5], [0, 7, 1], [0, 0, 6]], float),
        "edge_index": np.array([[0, 1], [1, 0]]),
        "edge_attr": np.tile(np.array([0.9, 2, 1, 0, 0, 4, 0.5, 2, 2, 0, 1], np.float32), (2, 1)),
        "edge_pos": np.array([[2, 0, 1], [2, 0, 1]], float),
    }
    near = add_proximity_edges(map, 7.5)
    assert near["edge_index"].T.tolist() == [[0, 1], [0, 1], [0, 2], [1, 0], [1, 0], [2, 0]]  # 1 and 2 are 8.1 m apart
    assert is_door_edge(near).tolist() == [True, False, False] * 2
    assert np.allclose(near["edge_attr"][[1, 4]], [[0, 0, 0, 0, 0, 4, s, 0, 0, 0, 1] for s in (0.5, -0.5)])
    assert np.allclose(near["edge_pos"][[1, 4]], [2, 0, 1.25]) and np.allclose(near["edge_pos"][[0, 3]], [2, 0, 1])
    assert add_proximity_edges(map, 1.0)["edge_index"].tolist() == map["edge_index"].tolist()
    assert compute_rbf(torch.tensor([0.0, 3.5]))[:, 3].tolist() == pytest.approx([math.exp(-9), math.exp(-0.25)])
    built = building(2, 2)
    describe = wrap_network(network("scalars", node=Node("gat", around=10.0)))
    assert describe(built).shape == (len(built.rooms), 64)


def test_layout_of_doors_by_hand():
    """Room 0 at the origin with a door to the east, to room 1, and one to the north, to room 2; a far one leads from 2 to 3."""
    index = np.array([[0, 0, 2, 1, 2, 3], [1, 2, 3, 0, 0, 2]])
    middle = np.array([[0, 0, 1], [4, 0, 1], [0, 4, 1], [0, 40, 1]], float)
    door = np.array([[2, 0, 1], [0, 2, 1], [0, 30, 1]] * 2, float)
    pairs, features = compute_door_layout(index, middle, door)
    by_pair = {(int(e), int(f)): row for (e, f), row in zip(pairs.T, features, strict=True)}
    assert sorted(by_pair) == [
        (0, 1),
        (0, 4),
        (1, 0),
        (1, 3),
        (3, 1),
        (3, 4),
        (4, 0),
        (4, 3),
    ]  # no way back, none far
    half = np.sqrt(0.5)
    assert np.allclose(by_pair[0, 1], [np.sqrt(8), 0, half, -half, 1])  # out to the east, then back and to the left
    assert np.allclose(by_pair[1, 0], [np.sqrt(8), 0, -half, -half, 1])
    assert np.allclose(by_pair[0, 4][:4], by_pair[0, 1][:4]) and by_pair[0, 4][4] == 0  # the same door, left from room 2
    c, s = np.cos(1.1), np.sin(1.1)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    again = compute_door_layout(index, middle @ turn.T + 7, door @ turn.T + 7)
    assert np.array_equal(again[0], pairs) and np.allclose(again[1], features, atol=1e-6) and features[:, 0].max() <= LAYOUT_REACH
    assert compute_door_layout(np.zeros((2, 0), int), middle, np.zeros((0, 3)))[1].shape == (0, 5)


def test_check_takes_the_defaults():
    assert check(Network()) is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"size": 10**9}, "size must be 1 to 4096"),
        ({"node": {"kind": "gat", "doors": 10**12}}, "node.doors must be 0 to 4"),
        ({"geometry": {"parts": [["scalars"]]}}, "must be names"),
    ],
)
def test_settings_that_would_take_all_memory_or_fail_oddly_are_refused(tmp_path, table, message):
    save_state(network(), tmp_path)
    settings = json.loads((tmp_path / "embedder.json").read_text())
    (tmp_path / "embedder.json").write_text(json.dumps({**settings, "network": table}))
    with pytest.raises(InputError, match=rf"embedder\.json: .*{message}"):
        read_embedder(tmp_path)


def test_rooms_without_landmarks_are_as_before_to_the_bit():
    """A network with a part for landmarks says of a map that has none what it says without that part; signs change rooms."""
    node = Node("gat", 2, around=10.0)
    net, plain, one = network("scalars", "landmarks", node=node), network("scalars", node=node), graph()
    plain.load_state_dict({name: value for name, value in net.state_dict().items() if "landmarks" not in name})
    none = {**one, "landmarks": torch.zeros_like(one["landmarks"])}
    with torch.no_grad():
        assert all(torch.equal(ours, before) for ours, before in zip(net(none), plain(one), strict=True))
        without = one["landmarks"][:, :2].sum(dim=1) == 0
        assert 0 < int(without.sum()) < len(without)
        assert torch.equal(net.geometry(one)[without], plain.geometry(one)[without])
        assert ((net.geometry(one) - plain.geometry(one)).abs().amax(dim=1) > 1e-3)[~without].all()
