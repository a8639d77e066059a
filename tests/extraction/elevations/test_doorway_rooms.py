"""The rooms on both sides of doorways, by the floor that lies before and behind them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases import list_longer
from tests.extraction.elevations.doors import extracted
from tests.extraction.elevations.test_doorways import chances, face, walls
from tests.scenes import Scene
from topomerge.extraction.elevations.doorways import detect_doorways
from topomerge.types import Sim3

PLACES_OF_DOOR = slice(20, 29)  # along 6 m in steps of 0.1 m


@pytest.mark.parametrize(
    ("before", "room"),
    [([2, 2, 2], 2), ([2, 2, -1], 2), ([-1, -1, -1], 5), ([5, 2, -1], 5), ([2, 5, 2], 2)],
    ids=["another room", "some floor", "no floor", "as much of its own", "more of another"],
)
def test_the_floor_before_a_doorway_tells_its_room(before, room):
    spots = np.full((60, 3), 7)  # elsewhere along the wall
    spots[PLACES_OF_DOOR] = before
    (door,) = detect_doorways(walls(face(room=5)), chances(6, (2.0, 2.9, 0.9, 0.05)), spots)
    assert door["rooms"].tolist() == [room, -1]


def vestibule() -> Scene:
    """Two rooms of 4 m by 4 m, 1.3 m of vestibule between them, with a door to each and one to a corridor past all three: the
    walls of the rooms go on in line with that of the vestibule, which is hardly wider than its door."""
    scene = Scene().shell(0, 0, 9, 6).wall((0, 4), (9, 4), doors=(4.65,))
    return scene.wall((4, 0), (4, 4), doors=(1.0,)).wall((5.3, 0), (5.3, 4), doors=(3.0,))


@pytest.mark.parametrize("turn", [0.4, *list_longer(0.0, 2.0)])
def test_a_door_in_line_with_a_neighbours_wall_is_the_rooms_that_it_opens_to(turn):
    map = extracted(vestibule().points(0.003), turn)
    back = Sim3(turn).inverse()
    at = back.apply(map.rooms["centroid"])
    corridor = int(at[:, 1].argmax())
    left, middle, right = sorted(set(range(4)) - {corridor}, key=lambda room: at[room, 0])
    doors = {tuple(sorted(edge["rooms"].tolist())): back.apply(edge["centre"][None])[0, :2] for edge in map.edges}
    expected = {(middle, corridor): (4.65, 4.0), (left, middle): (4.0, 1.0), (middle, right): (5.3, 3.0)}
    assert len(map.rooms) == 4 and len(map.edges) == 3
    for rooms, place in expected.items():
        assert doors[tuple(sorted(rooms))] == pytest.approx(place, abs=0.1)
