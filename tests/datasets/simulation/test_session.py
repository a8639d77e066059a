from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import SURFACES, Building, Difficulty
from topomerge.datasets.simulation.session import simulate_session

STILL = Difficulty(moved=0, gone=0, doors_moved=0, people=0)


@pytest.fixture(scope="module")
def office() -> Building:
    return make_building("office", 0)


def test_nothing_happens_when_nothing_may(office: Building) -> None:
    other = simulate_session(office, STILL, 1)
    assert np.array_equal(other.vertices, office.vertices) and np.array_equal(other.triangles, office.triangles)


def test_a_share_of_the_furniture_goes(office: Building) -> None:
    movable = office.things["movable"] & (office.things["kind"] != "leaf")
    other = simulate_session(office, replace(STILL, gone=0.5), 1)
    left = np.isin(np.flatnonzero(movable), other.thing_of)
    assert 0.3 < left.mean() < 0.7
    fixed = office.thing_of < 0
    assert (other.thing_of < 0).sum() == fixed.sum()


def test_moved_things_stay_in_their_room_and_move_as_one(office: Building) -> None:
    other = simulate_session(office, replace(STILL, moved=0.5), 2)
    shift = np.hypot(*(other.things["centre"] - office.things["centre"])[:, :2].T)
    assert 0.2 < (shift > 0).mean() < 0.9 and (shift > 1.0).any()
    for i in np.flatnonzero(shift > 0):
        assert shapely.Polygon(office.rooms[other.things["room"][i]].polygon).covers(shapely.Point(other.things["centre"][i, :2]))
        rows = np.unique(office.triangles[office.thing_of == i])
        before, after = office.vertices[rows].astype(float), other.vertices[rows].astype(float)
        assert np.allclose(np.linalg.norm(before - before[0], axis=1), np.linalg.norm(after - after[0], axis=1), atol=1e-3)
        middle = (after.min(axis=0) + after.max(axis=0))[:2] / 2
        assert np.hypot(*(middle - other.things["centre"][i, :2])) < 0.3


def test_doors_open_and_shut_about_their_hinges(office: Building) -> None:
    other = simulate_session(office, replace(STILL, doors_moved=1, open=0, half=0), 3)
    assert set(other.doors["state"].tolist()) <= {"shut", "none"}
    leaves = other.things[other.things["kind"] == "leaf"]
    for leaf in leaves:
        door = other.doors[leaf["door"]]
        offset = leaf["centre"][:2] - door["centre"][:2]
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
        assert abs(offset @ normal) <= door["thickness"] / 2
    assert np.allclose(leaves["pivot"], office.things["pivot"][office.things["kind"] == "leaf"])


def test_people_stand_about(office: Building) -> None:
    other = simulate_session(office, replace(STILL, people=2), 4)
    people = other.things[other.things["kind"] == "person"]
    assert len(people) > 10
    assert (other.labels == SURFACES.index("person")).sum() == 36 * len(people)
    assert people["size"][:, 2].min() > 1.6 and people["size"][:, 2].max() < 2.0


def test_the_same_seed_gives_the_same_session(office: Building) -> None:
    one, same, other = (simulate_session(office, Difficulty(), s).vertices.tobytes() for s in (1, 1, 2))
    assert one == same != other
