"""Doors of joined maps: what one map saw open is a door, and a gap that every map saw as wall is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.scenes import Scene
from topomerge.fusion.fuse import fuse
from topomerge.fusion.transfer import add_part_doors, transform_part
from topomerge.types import Placement, Sim3, TopometricMap

MOVE = Sim3(0.6, (3.0, -2.0, 0.5))


def flat(doors: tuple[float, ...], frame: Sim3 | None = None) -> TopometricMap:
    """Three rooms side by side; the wall between the first two has doors at these heights of the plan, the other one always."""
    scene = Scene().shell(0, 0, 15, 5).wall((5, 0), (5, 5), doors=doors).wall((10, 0), (10, 5), doors=(2.0,))
    return tm.extract((frame or Sim3()).apply(scene.points()).astype(np.float32))


def joined_pairs(map: TopometricMap) -> set[tuple[int, int]]:
    """Which rooms are joined, from the west to the east."""
    place = np.argsort(np.argsort(map.rooms["centroid"][:, 0]))
    return {tuple(sorted(place[edge["rooms"]].tolist())) for edge in map.edges}


@pytest.fixture(scope="module")
def open_map() -> TopometricMap:
    return flat((2.0,))


@pytest.fixture(scope="module")
def shut_map() -> TopometricMap:
    return flat((), MOVE)


@pytest.mark.parametrize("first", ["open", "shut"])
def test_a_door_that_is_shut_in_one_map_stays_a_door(open_map, shut_map, first):
    a, b = (open_map, shut_map) if first == "open" else (shut_map, open_map)
    pose = MOVE.inverse() if first == "open" else MOVE
    joined = fuse((a, b), [(0, Sim3()), (1, pose)])
    there = replace(joined, rooms=joined.rooms.copy())
    if first == "shut":
        there.rooms["centroid"] = MOVE.inverse().apply(joined.rooms["centroid"])
    assert len(joined.rooms) == 3 and joined_pairs(there) == {(0, 1), (1, 2)}
    (door,) = open_map.edges[np.abs(open_map.edges["centre"][:, 0] - 5) < 1]
    at = door["centre"] if first == "open" else MOVE.apply(door["centre"][None])[0]
    apart = np.linalg.norm(joined.edges["centre"] - at, axis=1)
    carried = joined.edges[apart.argmin()]
    assert apart.min() < 0.15 and carried["kind"] == "door" and carried["width"] == pytest.approx(door["width"], abs=0.11)
    turned = (carried["direction"] - door["direction"] - (0.0 if first == "open" else MOVE.yaw)) % np.pi
    assert min(turned, np.pi - turned) < 0.05


def test_a_door_that_no_map_has_where_both_sides_were_seen_is_none(open_map):
    false = open_map.edges[:1].copy()
    false["centre"] = (5.0, 4.5, 0.0)
    false["rooms"] = np.sort(open_map.edges["rooms"][np.abs(open_map.edges["centre"][:, 0] - 5) < 1][0])
    doubtful = replace(open_map, edges=np.concatenate([open_map.edges, false]))
    checked = add_part_doors(doubtful, [transform_part(open_map, Placement(Sim3()))])
    assert (checked.edges["centre"] == open_map.edges["centre"]).all() and len(checked.edges) == len(open_map.edges)


def test_what_only_the_joined_map_shows_on_both_sides_may_be_a_door(open_map):
    west = replace(
        open_map, navigable_room=np.where(open_map.navigable.compute_centroids()[:, 0] < 5, open_map.navigable_room, -1)
    )
    west = replace(west, edges=west.edges[:0], navigable_area=None)
    assert len(add_part_doors(open_map, [transform_part(west, Placement(Sim3()))]).edges) >= 1


def test_a_part_without_doors_and_one_without_rooms_change_nothing(open_map):
    bare = replace(open_map, edges=open_map.edges[:0])
    empty = replace(bare, navigable_room=np.full(len(bare.navigable), -1, np.int32), navigable_area=None)
    assert (
        len(add_part_doors(bare, [transform_part(bare, Placement(Sim3())), transform_part(empty, Placement(Sim3()))]).edges) == 0
    )


def test_a_door_lies_where_the_surest_part_saw_it(open_map):
    """The joined cells show it 0.4 m off; of two parts the surer one decides, whichever comes first."""
    edges, (first, second) = open_map.edges, (open_map.edges.copy(), open_map.edges.copy())
    first["confidence"], second["confidence"] = 0.7, 0.95
    first["centre"][:, 1] += 0.2
    second["width"] = 0.83
    moved = edges.copy()
    moved["centre"][:, 1] -= 0.4
    moved["confidence"] = 0.8
    parts = [transform_part(replace(open_map, edges=e), Placement(Sim3())) for e in (first, second)]
    for order in (parts, parts[::-1]):
        out = add_part_doors(replace(open_map, edges=moved), order).edges
        assert len(out) == len(edges) and np.allclose(out["centre"], edges["centre"])
        assert np.allclose(out["width"], 0.83) and np.allclose(out["confidence"], 0.95)
    alone = add_part_doors(replace(open_map, edges=moved), parts[:1]).edges
    assert np.allclose(alone["centre"], first["centre"]) and np.allclose(alone["confidence"], 0.8)
