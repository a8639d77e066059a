"""Pairs: what is said to be shared is shared, the transform is right, and an extracted room is judged by the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import Pair, PairSettings, draw_frames, make_pair
from topomerge.datasets.pairs.parts import (
    TRUTH_DTYPE,
    build_room_graph,
    compute_dice,
    find_true_matches,
    find_twin_rooms,
    label_cells,
    match_true_rooms,
    sample_two_parts,
)

from tests.cases import list_longer
from topomerge.errors import InputError
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, PointCloud, Sim3, TopometricMap, TrueRoom, VoxelGrid


@pytest.fixture(scope="module")
def tower() -> Building:
    return make_building("hotel", 2, 2)


@pytest.fixture(scope="module")
def pair() -> Pair:
    return make_pair(make_building("house", 3), PairSettings(0.5, ("depth", "tls"), 4, scale=True), 5)


def connected(building: Building, part: set[int]) -> bool:
    graph = build_room_graph(building)
    seen, edge = set(), {min(part)}
    while edge:
        seen |= edge
        edge = {n for r in edge for n in graph[r] & part} - seen
    return seen == part


@pytest.mark.parametrize("overlap", [0.0, 0.5, 1.0, *list_longer(0.1, 0.25, 0.75)])
def test_parts_hang_together_and_share_what_was_asked(tower: Building, overlap: float) -> None:
    for seed in range(5):
        a, b = (set(part.tolist()) for part in sample_two_parts(tower, 12, overlap, np.random.default_rng(seed)))
        assert connected(tower, a) and connected(tower, b)
        assert abs(compute_dice(a, b) - overlap) <= 0.1
        assert max(len(a), len(b)) <= 12 and not {i for i in a | b if tower.rooms[i].kind == "lift"}


def test_a_building_without_such_parts_is_refused() -> None:
    with pytest.raises(InputError, match="no two connected parts"):
        sample_two_parts(make_building("house", 3), 20, 0.0, np.random.default_rng(0))
    with pytest.raises(InputError, match="overlap must be"):
        sample_two_parts(make_building("house", 3), 20, -0.1, np.random.default_rng(0))


@pytest.mark.longer
def test_twin_rooms_lie_above_each_other() -> None:
    building = make_building("hotel", 5, 3)
    for i, j in find_twin_rooms(building).items():
        assert building.rooms[i].storey != building.rooms[j].storey
        assert np.allclose(building.rooms[i].polygon.mean(axis=0), building.rooms[j].polygon.mean(axis=0), atol=0.05)
    with pytest.raises(InputError, match="same plan"):
        find_twin_rooms(make_building("hotel", 5, 1))


def test_the_truth_takes_b_to_a(pair: Pair) -> None:
    assert pair.truth is not None and pair.frames is not None
    assert pair.truth.scale != 1 and abs(pair.truth.yaw) > np.radians(3)
    for i, j in pair.shared:
        room, twin = pair.a.rooms[i], pair.b.rooms[j]
        moved = pair.truth.apply(np.column_stack([twin.polygon, np.full(len(twin.polygon), twin.floor)]))
        assert np.allclose(moved[:, :2], room.polygon, atol=1e-6) and np.allclose(moved[:, 2], room.floor)
    both = set(pair.visited[0]) & set(pair.visited[1])
    assert both <= {i for i, _ in pair.shared} and pair.overlap == compute_dice(*pair.visited)


def test_points_of_a_shared_room_coincide(pair: Pair) -> None:
    assert pair.truth is not None
    i = next(iter(set(pair.visited[0]) & set(pair.visited[1])))
    boxes = []
    for cloud, frame in ((pair.a, Sim3()), (pair.b, pair.truth)):
        points = frame.apply(cloud.points[cloud.labels == i])
        boxes.append(np.quantile(points, [0.02, 0.98], axis=0))
    assert np.abs(boxes[0] - boxes[1])[:, :2].max() < 0.4


def test_the_same_seed_gives_the_same_pair() -> None:
    building = make_building("house", 3)
    one, same, other = (make_pair(building, PairSettings(0.5, ("depth", "depth"), 3), seed) for seed in (1, 1, 2))
    assert one.truth == same.truth != other.truth
    assert one.b.points.tobytes() == same.b.points.tobytes() != other.b.points.tobytes()


def test_frames_are_never_alike() -> None:
    for seed in range(50):
        a, b = draw_frames(2, False, np.random.default_rng(seed))
        assert abs((a.inverse() @ b).yaw) > np.radians(3) and a.scale == b.scale == 1


def test_a_pair_that_tests_nothing_or_contradicts_itself_is_refused(pair: Pair) -> None:
    for wrong, reason in (
        ({"truth": Sim3()}, "identity"),
        ({"kind": "twin-wing"}, "share no room"),
        ({"kind": "odd"}, "kind of pair"),
        ({"overlap": 1.2}, "overlap"),
        ({"shared": ((0, 999),)}, "do not exist"),
    ):
        with pytest.raises(InputError, match=reason):
            replace(pair, **wrong)
    with pytest.raises(InputError, match="hard negative 'odd'"):
        make_pair(make_building("house", 3), PairSettings(hard="odd"))


def strip() -> tuple[TopometricMap, PointCloud]:
    """Rooms of 20 by 20 cells of floor in a row; the middle one is extracted in two pieces, the last two true rooms as one."""
    x, y = np.meshgrid(np.arange(80), np.arange(20), indexing="ij")
    cells = np.stack([x.ravel(), y.ravel(), np.zeros(x.size, int)], axis=1)
    grid = VoxelGrid.from_cells(cells, shape=(80, 20, 30))
    column = grid.cells[:, 0]
    extracted = np.select([column < 20, column < 32, column < 40], [0, 1, 2], 3).astype(np.int32)
    tables = np.zeros(4, ROOM_DTYPE), np.zeros(0, EDGE_DTYPE), np.zeros(1, STOREY_DTYPE)
    map = TopometricMap(grid, extracted, grid, extracted, *tables)
    labels = np.where(column < 70, np.minimum(column // 20, 2), 3).astype(np.int32)
    labels[column < 2] = -1
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]])
    rooms_true = tuple(TrueRoom(str(i), square + [2 * i, 0], 0.0, 2.5) for i in range(4))
    return map, PointCloud(grid.compute_centroids().astype(np.float32), labels=labels, rooms=rooms_true)


def test_room_truth_by_hand() -> None:
    map, cloud = strip()
    truth = match_true_rooms(map, cloud)
    assert truth.dtype == TRUTH_DTYPE and truth["room"].tolist() == [0, 1, 1, 2]
    assert truth["one"].tolist() == [True, True, False, True]
    assert np.allclose(truth["iou"], [18 / 20, 12 / 20, 8 / 20, 30 / 40])
    assert find_true_matches(truth, truth, [(0, 0), (1, 1)]).tolist() == [[0, 0], [1, 1], [1, 2], [2, 1], [2, 2]]
    assert find_true_matches(truth, truth, []).shape == (0, 2)


def test_labels_from_outlines() -> None:
    map, cloud = strip()
    by_outline = label_cells(map, replace(cloud, labels=None))
    assert (by_outline == map.grid.cells[:, 0] // 20).mean() > 0.95
    assert match_true_rooms(map, replace(cloud, labels=None))["room"].tolist()[:3] == [0, 1, 1]


def test_no_labels_no_truth() -> None:
    map, cloud = strip()
    truth = match_true_rooms(map, replace(cloud, labels=np.full(len(cloud), -1, np.int32)))
    assert (truth["room"] == -1).all() and not truth["one"].any()
    assert (match_true_rooms(map, PointCloud(cloud.points))["room"] == -1).all()
