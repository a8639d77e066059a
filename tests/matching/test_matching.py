"""Matching: exact answers on maps made by hand, and what must change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.embedding.test_descriptors import permuted
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.kernels.poses import pose_evidence
from topomerge.matching.assignment import assign, by_overlap
from topomerge.matching.costs import descriptor_costs
from topomerge.matching.growing import align, grow
from topomerge.matching.match import match
from topomerge.types import Sim3, TopometricMap, VoxelGrid


def turned(map: TopometricMap, shift: tuple[float, float, float], scale: float = 1.0) -> tuple[TopometricMap, Sim3]:
    """The map turned by 90 degrees, moved and made larger; and T_ab, which brings it back."""
    width, edge = map.grid.shape[1] * map.grid.edge, map.grid.edge
    low = map.grid.origin
    turn = Sim3(np.pi / 2, (0.0, 0.0, 0.0), scale)
    corner = turn.apply(low[None])[0]
    x, y, z = np.array(shift) - corner + np.array([width * scale, 0.0, 0.0])
    there = Sim3(np.pi / 2, (float(x), float(y), float(z)), scale)

    def of(grid: VoxelGrid) -> tuple[VoxelGrid, np.ndarray]:
        c = grid.cells
        cells = np.stack([grid.shape[1] - 1 - c[:, 1], c[:, 0], c[:, 2]], axis=1)
        shape = (grid.shape[1], grid.shape[0], grid.shape[2])
        new = VoxelGrid.from_cells(cells, np.array(shift), edge * scale, shape, {"row": np.arange(len(cells))})
        return VoxelGrid(new.cells, new.origin, new.edge, new.shape), new.properties["row"]

    (grid, rows), (navigable, walked) = of(map.grid), of(map.navigable)
    rooms, edges, storeys = map.rooms.copy(), map.edges.copy(), map.storeys.copy()
    rooms["centroid"], edges["centre"] = there.apply(rooms["centroid"]), there.apply(edges["centre"])
    edges["direction"] = (edges["direction"] + np.pi / 2) % np.pi
    edges["width"] *= scale
    rooms["height"], rooms["area"] = rooms["height"] * scale, rooms["area"] * scale**2
    for name in ("floor", "ceiling"):
        storeys[name] = storeys[name] * scale + there.translation[2]
    other = replace(
        map, grid=grid, room=map.room[rows], navigable=navigable, navigable_room=map.navigable_room[walked],
        navigable_area=None, rooms=rooms, edges=edges, storeys=storeys, source="other.ply",
    )  # fmt: skip
    return other, there.inverse()


def uneven() -> TopometricMap:
    """Four rooms: of the fifth only the walls are there, so that the rooms have no symmetry."""
    return without(building(2), 3)


def without(map: TopometricMap, room: int) -> TopometricMap:
    """The map without one of its rooms."""
    new = np.arange(len(map.rooms)) - (np.arange(len(map.rooms)) > room)
    new[room] = -1
    labels = [np.where(r >= 0, new[r], -1).astype(np.int32) for r in (map.room, map.navigable_room)]
    edges = map.edges[(map.edges["rooms"] != room).all(axis=1)].copy()
    edges["rooms"] = new[edges["rooms"]]
    return replace(map, room=labels[0], navigable_room=labels[1], rooms=np.delete(map.rooms, room), edges=edges)


def test_transform_and_rooms_are_found_exactly():
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b)
    assert found.transform is not None
    corners = b.rooms["centroid"]
    assert any(np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05) for h in found.alternatives)
    right = next(h for h in found.alternatives if np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05))
    assert [tuple(p) for p in right.rooms.tolist()] == [(i, i) for i in range(4)]


def test_unknown_scale():
    a = building(2)
    b, true = turned(a, (7.0, -3.0, 1.5), 1.3)
    found = match(a, b, scale_free=True)
    assert any(h.transform.scale == pytest.approx(true.scale, rel=0.02) for h in found.alternatives[:3])


def test_rooms_that_look_alike_keep_alternatives():
    a = building(2)  # the same from both ends
    b, _ = turned(a, (7.0, -3.0, 1.5))
    found = match(a, b)
    yaws = sorted(round(np.degrees(h.transform.yaw)) % 180 for h in found.alternatives[:2])
    assert len(found.alternatives) > 1 and yaws == [90, 90]
    assert found.alternatives[0].probability < 0.7 and found.alternatives[1].probability > 0.2


def test_order_of_rooms():
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    order = np.array([2, 0, 3, 1])
    plain, mixed = match(uneven(), b), match(permuted(uneven(), order), b)
    back = {(int(order[i]), j) for i, j in mixed.rooms.tolist()}
    assert back == {tuple(p) for p in plain.rooms.tolist()}


def test_costs_and_dustbin():
    cost = descriptor_costs(np.array([[0.0], [5.0], [9.0]]), np.array([[0.1], [5.2]]))
    assert assign(cost, 1.0).tolist() == [[0, 0], [1, 1]]
    assert assign(cost, 0.15).tolist() == [[0, 0]]
    assert len(assign(np.zeros((0, 3)))) == 0


def test_rooms_without_a_partner_change_nothing():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((6, 4)), rng.standard_normal((5, 4))
    plain = assign(descriptor_costs(a, b), 1.2)
    more = assign(descriptor_costs(np.concatenate([a, a[:2] + 50]), np.concatenate([b, b[:3] - 50])), 1.2)
    assert np.array_equal(plain, more)


def test_a_room_cut_in_two_has_two_partners():
    common = np.array([[6.0, 4.0], [0.0, 0.0]])
    pairs, fit = by_overlap(common, np.array([10.0, 5.0]), np.array([6.0, 4.0]))
    assert pairs.tolist() == [[0, 0], [0, 1]] and np.allclose(fit, [0.6, 1.0])


def test_growing_on_a_graph_by_hand():
    a = building(2)
    cost = np.full((5, 5), 1.0)
    np.fill_diagonal(cost, 0.1)
    cost[0, 0] = 0.01
    b = replace(a)
    grown = grow(a, b, cost, c_max=0.5)
    assert grown[0] == ((0, 0), (1, 1), (2, 2), (3, 3), (4, 4))
    assert all(len(pairs) == 1 for pairs in grow(a, b, cost, c_max=0.005))
    far = replace(a, rooms=a.rooms.copy())
    far.rooms["centroid"][3] += 40  # its match makes the alignment worse by more than 2.5 m
    assert (3, 3) not in grow(a, far, cost, c_max=0.5)[0]


def test_align_is_exact():
    rng = np.random.default_rng(1)
    points = rng.standard_normal((7, 3))
    true = Sim3(2.5, (3.0, -1.0, 0.5), 1.4)
    found, error = align(true.apply(points), points, scale=True)
    assert np.allclose(found.matrix, true.matrix) and error < 1e-9


@pytest.mark.parametrize("method", ["growing", "assignment", pytest.param("thesis", marks=pytest.mark.slow)])
def test_other_methods_run(method: str):
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b, method=method)
    assert len(found.rooms) and ((found.probability >= 0) & (found.probability <= 1)).all()


def test_bad_input():
    a = building(1)
    nothing = replace(a, rooms=a.rooms[:0], edges=a.edges[:0], room=a.room * 0 - 1, navigable_room=a.navigable_room * 0 - 1)
    with pytest.raises(InputError, match="same map"):
        match(a, a)
    with pytest.raises(InputError, match="no rooms"):
        match(nothing, building(2))
    with pytest.raises(InputError, match="method"):
        match(a, building(2), method="best")


def test_kernel_is_its_slow_twin():
    rng = np.random.default_rng(2)
    distance, floor = rng.uniform(0, 1, (1, 9, 8)).astype(np.float32), rng.random((1, 9, 8)) < 0.5
    points, is_wall = rng.uniform(-0.2, 1.2, (50, 2)), rng.random(50) < 0.5
    poses = np.array([[1.0, 0.0, 0.0, 0.0], [0.6, 0.8, 0.3, -0.1]])
    found = pose_evidence(
        poses, np.zeros((2, 1), np.int64), points, np.zeros(50, np.int64), is_wall, distance, floor, np.zeros(2), 0.1, 0.2
    )
    for h, (a, b, x, y) in enumerate(poses):
        at = np.floor((points @ np.array([(a, b), (-b, a)]) + (x, y)) / 0.1).astype(int)
        some = [(i, distance[0, u, v], floor[0, u, v]) for i, (u, v) in enumerate(at) if 0 <= u < 9 and 0 <= v < 8]
        agree = sum(np.exp(-0.5 * (d / 0.2) ** 2) for i, d, _ in some if is_wall[i] and d < 0.6)
        against = sum(f and d > 0.3 if is_wall[i] else (not f and d < 0.1) for i, d, f in some)
        common = sum(not is_wall[i] and f for i, _, f in some)
        assert np.allclose(found[h], (agree, against, common), rtol=1e-5)
