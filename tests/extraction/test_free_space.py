"""Free space: where views stand when the sensor's places are unknown.

Scans that end below the ceiling: worktops, islands and beds are furniture, and the walls are those that stand higher.
"""

from __future__ import annotations

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.scenes import Scene
from topomerge.extraction.morphology import compute_horizontal_distance_field
from topomerge.extraction.navigable import VIEW_CLEARANCE, VIEW_HEIGHT, find_free_space, select_tile_views
from topomerge.extraction.scan import Scan
from topomerge.types import VoxelGrid


def slab(nx: int, ny: int, z: int = 0) -> VoxelGrid:
    return VoxelGrid.from_cells((np.argwhere(np.ones((nx, ny, 1), bool)) + (0, 0, z)).astype(np.int32), shape=(nx, ny, 30))


def test_one_view_a_tile_where_it_is_farthest_from_the_boundary() -> None:
    grid = slab(30, 20)
    views = select_tile_views(grid, grid, 1.0)
    distance = compute_horizontal_distance_field(grid)
    assert len(views) == 6
    for cell in grid.locate(views - (0, 0, VIEW_HEIGHT)):
        tile = (grid.cells // 10 == cell // 10).all(axis=1)
        assert distance[grid.find_rows(cell[None])[0]] == distance[tile].max()


def test_views_stay_below_the_ceiling() -> None:
    floor = slab(20, 20)
    room = floor.replace_cells(np.concatenate([floor.cells, slab(10, 20, 15).cells]))
    views = select_tile_views(room, floor, 1.0)
    covered = views[:, 0] < 1.0
    np.testing.assert_allclose(views[covered, 2], 0.05 + 1.5 - VIEW_CLEARANCE)
    np.testing.assert_allclose(views[~covered, 2], 0.05 + VIEW_HEIGHT)


def test_what_the_file_says_is_empty_is_taken_as_it_is() -> None:
    floor, known_empty = slab(20, 20), slab(5, 5, 3)
    assert find_free_space(Scan(floor, free=known_empty), floor, 5.0) is known_empty


KITCHEN = (  # boxes: two worktops along walls, an island, a bar
    (0.0, 0.0, 0.0, 0.6, 5.0, 0.9),
    (0.0, 0.0, 0.0, 4.0, 0.6, 0.9),
    (1.8, 1.8, 0.0, 2.7, 4.2, 1.1),
    (3.2, 1.5, 0.0, 3.9, 3.6, 1.1),
)
LIVING = ((5.0, 3.2, 0.0, 7.6, 4.4, 0.8), (5.2, 0.6, 0.0, 7.6, 2.6, 0.9))


def flat(top: float) -> np.ndarray:
    """A kitchen with living room, 8 x 5 m, a door at (8, 2.5) and a bedroom of 4 x 5 m, without all above `top` m; the
    sensor did not look down between the kitchen's worktops."""
    scene = Scene().shell(0, 0, 12, 5).wall((8, 0), (8, 5), doors=(2.5,))
    points = np.concatenate(scene.parts)
    hidden = (points[:, 2] < 0.05) & (points[:, 0] < 3.0)
    for box in (*KITCHEN, *LIVING):
        inside = ((points > box[:3]) & (points < box[3:])).all(axis=1) | (
            (points[:, 2] < 0.05) & ((points[:, :2] > box[:2]) & (points[:, :2] < box[3:5])).all(axis=1)
        )
        points, hidden = points[~inside], hidden[~inside]
    things = Scene()
    for box in (*KITCHEN, *LIVING):
        things.box(*box)
    points = np.concatenate([points[~hidden], np.concatenate(things.parts)])
    points = points[points[:, 2] < top] + (0.013, 0.017, 0.021)
    return (points + np.random.default_rng(0).normal(0, 0.01, points.shape)).astype(np.float32)


@pytest.mark.parametrize("top", [1.95, *list_longer(2.1)])
def test_what_ends_below_head_height_is_furniture(top: float) -> None:
    map = tm.extract(flat(top))
    assert len(map.rooms) == 2 and len(map.storeys) == 1 and len(map.edges) == 1
    assert np.abs(map.navigable.compute_centroids()[:, 2] - 0.05).max() < 0.4  # nobody stands on a worktop
    assert (map.rooms["lo"][:, 0].min() < 0.3) and map.rooms["hi"][:, 0].max() > 11.7
    places = map.navigable.compute_centroids()[:, :2]
    for x0, y0, _, x1, y1, _ in KITCHEN[2:]:  # the island and the bar stand in the room
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
        room = map.navigable_room[np.abs(places - middle).max(axis=1) < 0.3]
        assert len(room) >= 25 and (room == map.navigable_room[np.abs(places - (4.6, 2.5)).sum(axis=1).argmin()]).all()


def test_with_its_ceiling_the_flat_has_the_same_rooms() -> None:
    assert len(tm.extract(flat(3.0)).rooms) == 2
