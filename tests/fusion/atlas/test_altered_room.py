"""Two maps contradict each other in the one room where they meet: what other pairs believe holds, and the room is named."""

from __future__ import annotations

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.altered import FRAMES, ROOM, office_parts
from topomerge.fusion.atlas.pairs import Conflict, find_conflicts, find_rooms_near, sum_places
from topomerge.fusion.atlas.store import serialise_contradiction
from topomerge.fusion.pipeline import merge
from topomerge.matching.poses import pose_difference
from topomerge.registration.prepared import prepare
from topomerge.types import Sim3

NAMES = ("west", "south", "east")


@pytest.fixture(scope="module")
def parts() -> dict[str, tm.TopometricMap]:
    return office_parts(6)


@pytest.mark.longer
def test_an_altered_room_does_not_keep_maps_apart(parts) -> None:
    result = merge([parts[name] for name in NAMES])
    assert result.status == "merged" and set(result.transforms) == {1, 2} and result.probability > 0.9
    for k, name in enumerate(NAMES[1:], 1):
        middle = parts[name].grid.compute_centroids().mean(axis=0)
        metres, radians, _ = pose_difference(result.transforms[k], FRAMES[name].inverse(), middle)
        assert metres < 0.15 and radians < np.radians(1)
    assert result.atlas is not None
    (found,) = result.atlas.contradictions
    assert found.maps == (0, 2) and 1.0 < found.area < 3.0 and not result.atlas.rejected
    low, high = np.array(ROOM)
    assert (np.array(found.middle[:2]) > low).all() and (np.array(found.middle[:2]) < high).all()
    west, east = (parts[name].rooms["centroid"] for name in ("west", "east"))
    moved = FRAMES["east"].inverse().apply(east)
    inside = [set(np.flatnonzero(((at[:, :2] > low) & (at[:, :2] < high)).all(axis=1)).tolist()) for at in (west, moved)]
    assert set(found.rooms[0]) == inside[0] and len(inside[0]) == 1 and len(set(found.rooms[1]) & inside[1]) >= 3
    assert f"west, east contradict each other in room {found.rooms[0][0]} of west" in result.reason
    assert "both versions are kept" in result.reason and serialise_contradiction(found)["maps"] == (0, 2)
    built = result.map.grid.compute_centroids()
    wall = (np.abs(built[:, 0] - 7.6) < 0.15) & (built[:, 1] > 8.6) & (built[:, 1] < 12) & (np.abs(built[:, 2] - 1.2) < 0.8)
    assert wall.sum() > 100 and np.bitwise_and.reduce(result.map.provenance[wall] | 0b011) == 0b111  # seen by the east, 2
    assert not (result.map.provenance[wall] & 0b001).any()  # and not by the west


@pytest.mark.longer
def test_places_of_conflict_are_found_and_pooled(parts) -> None:
    a, b = (prepare(parts[name]).storeys for name in ("west", "east"))
    (conflict,) = find_conflicts(a, b, FRAMES["west"] @ FRAMES["east"].inverse())
    assert isinstance(conflict, Conflict) and conflict.transform(Sim3(0.0, (1.0, 0.0, 0.0))).middle[0] == conflict.middle[0] + 1
    assert find_conflicts(a, a, Sim3()) == ()
    assert len(find_conflicts(a, b, FRAMES["west"] @ Sim3(0.3, (1.0, 2.0, 0.0)) @ FRAMES["east"].inverse())) >= 2
    spots = [np.array([x, 0.0, 0.0]) for x in (0.0, 2.0, 7.0)]
    assert sum_places(zip(spots, (0.5, 0.6, 0.3), strict=True)) == pytest.approx(0.9) and sum_places([]) == 0.0
    assert find_rooms_near(parts["west"], np.zeros((0, 3))) == () and find_rooms_near(parts["west"], np.full((3, 3), 99.0)) == ()
