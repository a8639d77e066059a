"""Maps made from the truth must score 1, in any frame and under drift; what is wrong with a map must cost what it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.simulation.floor_truth import (
    NOT_JUDGED,
    OUTSIDE_ROOMS,
    TRUTH_CELL,
    FloorTruth,
    build_truth,
    compute_room_truth,
    draw_rooms,
    evaluate_map,
    predict_columns,
    transform_truth,
)

from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, Array, Sim3, TopometricMap, VoxelGrid

FRAME = Sim3(0.7, (12.0, -30.0, 1.0))


@pytest.fixture(scope="module")
def building():
    return make_building("house", 3, 2)


@pytest.fixture(scope="module")
def floor(building) -> tuple[Array, Array]:
    """Places a body's width from the walls of all rooms, 5 cm apart, and their rooms."""
    raster, origin = draw_rooms(building.rooms, building.storeys["floor"])
    inner = np.stack([np.where(ndimage.distance_transform_edt(level >= 0) > 2, level, -1) for level in raster])
    k, i, j = np.nonzero(inner >= 0)
    x, y = (origin[:, None] + (np.stack([j, i]) + 0.5) * TRUTH_CELL).tolist()
    places = np.column_stack([x, y, building.storeys["floor"][k]])
    shifts = np.array([[dx, dy, 0.0] for dx in (-0.025, 0.025) for dy in (-0.025, 0.025)])
    return (places[:, None] + shifts).reshape(-1, 3), np.repeat(inner[k, i, j], 4)


@pytest.fixture(scope="module")
def truth(building) -> FloorTruth:
    """As if everything had been seen."""
    raster, origin = draw_rooms(building.rooms, building.storeys["floor"])
    k, i, j = np.nonzero(raster >= 0)
    points = np.column_stack(
        [origin[0] + (j + 0.5) * TRUTH_CELL, origin[1] + (i + 0.5) * TRUTH_CELL, building.storeys["floor"][k]]
    )
    return build_truth(building, np.ones(len(building.rooms), bool), points)


def drawn(building, floor: tuple[Array, Array], frame: Sim3 = FRAME, shift: float = 0.0) -> TopometricMap:
    """The map that knows everything."""
    places = frame.apply(floor[0]) + [shift, 0, 0]
    low = places.min(axis=0) - 0.1
    cells = np.floor((places - low) / 0.1).astype(np.int32)
    grid = VoxelGrid.from_cells(cells, low, 0.1, properties={"room": floor[1].astype(np.int32)})
    rooms = np.zeros(len(building.rooms), ROOM_DTYPE)
    rooms["storey"] = [r.storey for r in building.rooms]
    inner = building.doors[(building.doors["rooms"] >= 0).all(axis=1)]
    flights = building.stairs[building.stairs["kind"] != "lift"]
    edges = np.zeros(len(inner) + len(flights), EDGE_DTYPE)
    edges["rooms"] = np.concatenate([inner["rooms"], flights["rooms"]])
    edges["centre"] = frame.apply(np.concatenate([inner["centre"], flights["lower"]])) + [shift, 0, 0]
    edges["kind"][: len(inner)], edges["kind"][len(inner) :] = "door", "stairs"
    storeys = np.zeros(len(building.storeys), STOREY_DTYPE)
    storeys["floor"] = building.storeys["floor"] + frame.translation[2]
    label = grid.properties["room"]
    return TopometricMap(grid, label, grid, label, rooms, edges, storeys)


def test_the_truth_scores_one(building, floor, truth) -> None:
    verdict = evaluate_map(drawn(building, floor), transform_truth(truth, FRAME))
    assert verdict.rooms.iou > 0.995 and verdict.rooms.mcc > 0.995
    assert (verdict.rooms.precision, verdict.rooms.recall) == (1, 1)
    assert (verdict.doors.precision, verdict.doors.recall) == (1, 1)
    assert (verdict.edges.precision, verdict.edges.recall) == (1, 1)
    assert verdict.storeys and verdict.true_storeys == verdict.found_storeys == 2


def test_drift_is_not_held_against_a_map(building, floor, truth) -> None:
    moved = drawn(building, floor, shift=0.5)
    turned = transform_truth(truth, FRAME)
    assert evaluate_map(moved, turned).rooms.iou < 0.9
    anchors = FRAME.apply(floor[0][::20]) + [0.5, 0, 0]
    undrifted = replace(turned, anchors=anchors, drift=np.tile([-0.5, 0.0, 0.0], (len(anchors), 1)))
    assert evaluate_map(moved, undrifted).rooms.iou > 0.995
    again = transform_truth(transform_truth(undrifted, Sim3(1.0, (3.0, 0.0, 0.0))), Sim3(1.0, (3.0, 0.0, 0.0)).inverse())
    assert np.allclose(again.transform_to_building(anchors), undrifted.transform_to_building(anchors))


def test_merged_and_missing_rooms_cost(building, floor, truth) -> None:
    whole, turned = drawn(building, floor), transform_truth(truth, FRAME)
    one = np.where(whole.navigable_room >= 0, 0, -1).astype(np.int32)
    verdict = evaluate_map(replace(whole, room=one, navigable_room=one), turned)
    assert (verdict.rooms.each > 0).sum() == 1 and verdict.rooms.recall <= 1 / len(building.rooms)
    gone = np.where(whole.navigable_room == 2, -1, whole.navigable_room).astype(np.int32)
    verdict = evaluate_map(replace(whole, room=gone, navigable_room=gone), turned)
    assert verdict.rooms.each[2] == 0 and verdict.rooms.iou == pytest.approx(1 - 1 / len(building.rooms), abs=0.01)


def test_only_visited_rooms_are_expected(building, floor, truth) -> None:
    whole, turned = drawn(building, floor), transform_truth(truth, FRAME)
    visited = truth.visited.copy()
    visited[2] = False
    verdict = evaluate_map(whole, replace(turned, visited=visited))
    count = len(building.rooms)
    assert verdict.true_rooms == count - 1 and verdict.rooms.precision == pytest.approx((count - 1) / count)
    rooms = whole.rooms.copy()
    rooms["glimpsed"][2] = True
    assert evaluate_map(replace(whole, rooms=rooms), replace(turned, visited=visited)).rooms.precision == 1
    rooms["glimpsed"] = True  # those that the surveyor stood in count all the same
    assert evaluate_map(replace(whole, rooms=rooms), turned).found_rooms == count


def test_what_is_true_about_each_room(building, floor, truth) -> None:
    whole, turned = drawn(building, floor), transform_truth(truth, FRAME)
    about, count = compute_room_truth(whole, turned, building.rooms), len(building.rooms)
    assert all(v.shape == (count,) and v.dtype == bool for v in vars(about).values())
    assert about.one.all() and about.whole.all() and about.entered.all() and about.judged.all() and not about.outside.any()
    visited = truth.visited.copy()
    visited[2] = False
    assert (~compute_room_truth(whole, replace(turned, visited=visited), building.rooms).entered).nonzero()[0].tolist() == [2]
    astray = compute_room_truth(
        drawn(building, floor, shift=500.0), turned, building.rooms
    )  # beyond the raster nothing is judged
    assert not astray.judged.any() and not astray.one.any() and not astray.whole.any()
    middle = FRAME.inverse().apply(whole.navigable.compute_centroids())[:, 0]
    left = np.where(
        (whole.navigable_room == 0) & (middle > np.median(middle[whole.navigable_room == 0])), -1, whole.navigable_room
    )
    half = compute_room_truth(
        replace(whole, room=left.astype(np.int32), navigable_room=left.astype(np.int32)), turned, building.rooms
    )
    assert not half.whole[0] and half.entered[0] and half.whole[1:].all()


def test_what_was_not_seen_is_not_judged(building, floor, truth) -> None:
    room = building.rooms[0]
    few = np.column_stack([room.polygon, np.full(len(room.polygon), room.floor)])
    seen = build_truth(building, truth.visited, few)
    judged = seen.raster >= 0
    assert 0 < judged.sum() < 0.2 * (truth.raster >= 0).sum()
    assert (seen.raster == NOT_JUDGED).any() and (seen.raster == OUTSIDE_ROOMS).any()
    open_ended = build_truth(building, truth.visited, few, complete=False)
    assert not (open_ended.raster == OUTSIDE_ROOMS).any()


def test_the_strip_along_walls_goes_to_the_nearest_floor(building, floor, truth) -> None:
    columns = predict_columns(drawn(building, floor), transform_truth(truth, FRAME))
    inside = truth.raster >= 0
    assert (columns[inside] == truth.raster[inside]).mean() > 0.99
