"""The graph: shapes, values reckoned by hand, and nothing that depends on the frame among the features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.embedding.graph import (
    DOOR_FEATURES,
    EDGE_FEATURES,
    EDGE_KINDS,
    LANDMARK_FEATURES,
    MOST_SIGNS,
    ROOM_FEATURES,
    build_graph,
    build_graph_arrays,
    compute_landmark_features,
    hash_text,
)
from topomerge.errors import InputError
from topomerge.types import TopometricMap, VoxelGrid, build_landmarks, join_landmarks


@pytest.fixture(scope="module")
def map() -> TopometricMap:
    return building(2, 2)


def turned(map: TopometricMap) -> TopometricMap:
    """The map turned by 90 degrees to the left about the vertical, and moved."""
    width = map.grid.shape[1]
    shift = np.array([7.0, -3.0, 1.5])

    def turn(grid: VoxelGrid) -> tuple[VoxelGrid, np.ndarray]:
        cells = np.stack([width - 1 - grid.cells[:, 1], grid.cells[:, 0], grid.cells[:, 2]], axis=1)
        shape = (width, grid.shape[0], grid.shape[2])
        new = VoxelGrid.from_cells(cells, shift, grid.edge, shape, {"row": np.arange(len(cells))})
        return new, new.properties["row"]

    def place(points: np.ndarray) -> np.ndarray:
        local = points - map.grid.origin
        return np.stack([width * map.grid.edge - local[:, 1], local[:, 0], local[:, 2]], axis=1) + shift

    (grid, rows), (navigable, walked) = turn(map.grid), turn(map.navigable)
    rooms, edges = map.rooms.copy(), map.edges.copy()
    rooms["centroid"], edges["centre"] = place(rooms["centroid"]), place(edges["centre"])
    return replace(
        map,
        grid=grid,
        room=map.room[rows],
        navigable=navigable,
        navigable_room=map.navigable_room[walked],
        rooms=rooms,
        edges=edges,
        free=None,
        provenance=None,
    )


def test_shapes(map: TopometricMap) -> None:
    arrays = build_graph_arrays(map, 64)
    rooms, edges = len(map.rooms), len(map.edges)
    assert arrays["x"].shape == (rooms, len(ROOM_FEATURES)) and arrays["x"].dtype == np.float32
    assert arrays["room_points"].shape == (rooms, 64, 3) and arrays["room_points"].dtype == np.float32
    assert arrays["edge_index"].shape == (2, 2 * edges) and arrays["edge_index"].dtype == np.int64
    assert arrays["edge_attr"].shape == (2 * edges, len(EDGE_FEATURES))
    assert arrays["door_attr"].shape == (arrays["door_index"].shape[1], len(DOOR_FEATURES))
    assert all(np.isfinite(a).all() for a in arrays.values())
    degree = np.bincount(arrays["edge_index"][0], minlength=rooms)
    assert arrays["door_index"].shape[1] == (degree * (degree - 1)).sum()


def test_both_directions_agree(map: TopometricMap) -> None:
    arrays, edges = build_graph_arrays(map, 8), len(map.edges)
    there, back = arrays["edge_attr"][:edges], arrays["edge_attr"][edges:]
    name = {n: i for i, n in enumerate(EDGE_FEATURES)}
    assert np.array_equal(arrays["edge_index"][:, :edges], arrays["edge_index"][::-1, edges:])
    for same in ("width", "height", "door", "opening", "stairs", "distance", "turn_cos"):
        assert np.allclose(there[:, name[same]], back[:, name[same]], atol=1e-5), same
    for opposite in ("climb", "turn_sin"):
        assert np.allclose(there[:, name[opposite]], -back[:, name[opposite]], atol=1e-5), opposite
    assert np.allclose(there[:, name["from_middle"]], back[:, name["to_middle"]])
    assert np.allclose(there[:, [name[k] for k in EDGE_KINDS]].sum(axis=1), 1)


def test_features_do_not_depend_on_the_frame(map: TopometricMap) -> None:
    here, there = build_graph_arrays(map, 16), build_graph_arrays(turned(map), 16)
    for name in ("x", "edge_attr", "door_attr", "edge_index", "door_index"):
        assert np.allclose(here[name], there[name], atol=1e-4), name
    assert not np.allclose(here["pos"], there["pos"])


def test_points_stand_on_their_floor_about_the_middle(map: TopometricMap) -> None:
    arrays = build_graph_arrays(map, 512)
    for r in range(len(map.rooms)):
        points = arrays["room_points"][r]
        assert points[:, 2].min() > -0.5 and points[:, 2].max() < 5
        cells = map.grid.compute_centroids()[map.room == r]
        if len(cells):
            middle = [*map.rooms["centroid"][r][:2], 0]
            moved = cells - middle
            assert points[:, :2].min() >= moved[:, :2].min() - 1e-3 and points[:, :2].max() <= moved[:, :2].max() + 1e-3


def test_the_same_map_gives_the_same_tensors(map: TopometricMap) -> None:
    one, two = build_graph_arrays(map), build_graph_arrays(map)
    assert all(one[k].tobytes() == two[k].tobytes() for k in one)


def test_a_map_without_edges_or_rooms(map: TopometricMap) -> None:
    lonely = build_graph_arrays(replace(map, edges=map.edges[:0]), 4)
    assert lonely["edge_index"].shape == (2, 0) and lonely["edge_attr"].shape == (0, len(EDGE_FEATURES))
    assert lonely["door_index"].shape == (2, 0) and (lonely["x"][:, ROOM_FEATURES.index("degree")] == 0).all()
    none = np.full(len(map.room), -1, np.int32), np.full(len(map.navigable), -1, np.int32)
    empty = replace(map, edges=map.edges[:0], rooms=map.rooms[:0], room=none[0], navigable_room=none[1])
    assert build_graph_arrays(empty, 4)["x"].shape == (0, len(ROOM_FEATURES))


def test_a_wrong_number_of_points(map: TopometricMap) -> None:
    with pytest.raises(InputError, match="1 or more, not 0"):
        build_graph_arrays(map, 0)


def test_tensors(map: TopometricMap) -> None:
    pytest.importorskip("torch_geometric")
    data = build_graph(map, 32)
    assert data.validate() and data.num_nodes == len(map.rooms) and data.num_edges == 2 * len(map.edges)
    assert data.x.shape[1] == len(ROOM_FEATURES) and data.room_points.shape == (len(map.rooms), 32, 3)


def test_landmarks_of_rooms(map: TopometricMap) -> None:
    """Signs, tags and names are texts, chairs are objects; readings of radio and what has no room say nothing."""
    parts = [
        build_landmarks("text", ["2.113", "2.113", "2.114"], "r", room=np.array([0, 1, 2])),
        build_landmarks("object", ["chair", "Chair "], "r", room=np.array([2, 3])),
        build_landmarks("radio", ["aa:bb"], "r", room=4),
        build_landmarks("text", ["2.115"], "r"),
    ]
    rows = compute_landmark_features(replace(map, landmarks=join_landmarks(parts)))
    assert rows.shape == (len(map.rooms), len(LANDMARK_FEATURES)) and rows.dtype == np.float32
    assert rows[:5, :2].tolist() == [[1, 0], [1, 0], [1, 1], [0, 1], [0, 0]] and not rows[4:].any()
    assert np.allclose(np.linalg.norm(rows[:2], axis=1), 2**0.5) and np.array_equal(rows[0], rows[1])
    assert not np.array_equal(rows[0], rows[2]) and np.array_equal(rows[2, -32:], rows[3, -32:])
    assert "landmarks" not in build_graph_arrays(map, 4)


def test_misread_texts_are_alike_and_marks_do_not_count() -> None:
    def likeness(one: str, other: str) -> float:
        vectors = np.zeros((2, 128))
        for vector, text in zip(vectors, (one, other), strict=True):
            for column, value in hash_text(text):
                vector[column] += value
        return float(vectors[0] @ vectors[1] / np.linalg.norm(vectors[0]) / np.linalg.norm(vectors[1]))

    assert likeness("2.113", "2-1I3") == pytest.approx(1) and hash_text(" .- ") == ()
    assert likeness("2.113", "2.117") > 0.4 > likeness("2.113", "4.057") + 0.2


def test_a_room_full_of_signs_is_bounded(map: TopometricMap) -> None:
    """Hostile: of a hundred thousand signs in one room the surest are looked at; the others change nothing."""
    texts = [f"{k}" for k in range(100_000)]
    sure = np.where(np.arange(len(texts)) < MOST_SIGNS, 1.0, 0.5)
    many = build_landmarks("text", texts, "r", room=0, confidence=sure)
    few = build_landmarks("text", texts[:MOST_SIGNS], "r", room=0)
    rows = [compute_landmark_features(replace(map, landmarks=of)) for of in (many, few)]
    assert np.array_equal(*rows) and np.isfinite(rows[0]).all()
