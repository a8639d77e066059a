"""Hypotheses that grow from a pair of rooms to its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.scenes_map import building
from topomerge.matching.assignment import align, grow
from topomerge.types import Sim3


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


def test_a_part_grows_into_its_rooms_of_the_whole():
    """Of five rooms the other map has three, in another order; costs tell them, the corridor leads from one to the next."""
    whole, part = building(2), building(1)
    order = (4, 1, 0)  # rooms 0, 1 and the corridor of the whole are rooms 2, 1 and 0 of the part
    rooms, edges = whole.rooms[list(order)], part.edges.copy()
    edges["rooms"] = np.array([2, 1, 0])[part.edges["rooms"]]
    part = replace(part, rooms=rooms, edges=edges, room=_renamed(part.room), navigable_room=_renamed(part.navigable_room))
    cost = np.full((5, 3), 1.0)
    for j, i in enumerate(order):
        cost[i, j] = 0.1
    assert grow(whole, part, cost, c_max=0.5) == [((0, 2), (1, 1), (4, 0))]
    assert grow(part, whole, cost.T, c_max=0.5) == [((0, 4), (1, 1), (2, 0))]


def _renamed(room: np.ndarray) -> np.ndarray:
    return np.where(room >= 0, 2 - room, -1).astype(np.int32)


def test_the_largest_hypothesis_comes_first_and_of_equal_ones_the_cheapest():
    a = building(2)
    cost = np.full((5, 5), 1.0)
    np.fill_diagonal(cost, (0.3, 0.2, 0.9, 0.8, 0.1))  # rooms 2 and 3 are too dear but as seeds
    rest = ((0, 0), (1, 1), (4, 4))
    assert grow(a, replace(a), cost, c_max=0.5) == [(*rest[:2], (3, 3), rest[2]), (*rest[:2], (2, 2), rest[2]), rest]
    alone = grow(a, replace(a), np.diag([0.4, 0.2, 0.3, 0.1, 0.05]) + 1 - np.eye(5), c_max=0.01)
    assert alone == [((4, 4),), ((3, 3),), ((1, 1),), ((2, 2),), ((0, 0),)]


def test_each_match_may_make_the_alignment_a_little_worse():
    """Rooms of a stretched map are off by more and more, but none by 2.5 m more than the ones before."""
    a = building(3)
    wider = replace(a, rooms=a.rooms.copy())
    wider.rooms["centroid"][:, 0] = 2.3 * a.rooms["centroid"][:, 0]
    cost = 1 - 0.9 * np.eye(7)
    error = align(a.rooms["centroid"], wider.rooms["centroid"])[1]
    assert error > 2.5 and len(grow(a, wider, cost, c_max=0.5, de_max=2.5)[0]) == 7
    assert len(grow(a, wider, cost, c_max=0.5, de_max=0.3)[0]) < 7


def test_weights_of_an_alignment():
    """A point of no weight changes nothing; the error is the weighted root mean square of what is left."""
    points = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [7, 7, 7]])
    true = Sim3(-1.0, (2.0, 5.0, 1.0))
    to = true.apply(points)
    to[3] += 9.0
    pose, error = align(to, points, weight=np.array([1.0, 1.0, 1.0, 0.0]))
    assert np.allclose(pose.matrix, true.matrix) and error < 1e-9
    level, off = align(np.array([[0.0, 0, 1], [0, 0, 5]]), np.zeros((2, 3)), weight=np.array([3.0, 1.0]))
    assert level.yaw == 0 and level.translation == (0.0, 0.0, 2.0) and np.isclose(off, np.sqrt(0.75 * 1 + 0.25 * 9))
