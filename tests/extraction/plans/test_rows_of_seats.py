"""Rows that repeat themselves are seats or shelves; walls, however many, are none."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from topomerge.extraction.plans import rows_of_seats as module
from topomerge.extraction.plans.rows_of_seats import without_rows
from topomerge.extraction.plans.storey_plan import HEIGHT_BANDS, StoreyPlan

EDGE = 0.1


def hall() -> np.ndarray:
    """The walls of a hall of 20 x 16 m."""
    wall = np.zeros((200, 160), bool)
    wall[[0, -1]] = wall[:, [0, -1]] = True
    return wall


def rows_of_seats(wall: np.ndarray, edge: float) -> np.ndarray:
    """Those of a hall of which all floor is known."""
    return module.rows_of_seats(wall, ~wall, edge)


def rows(first: int, count: int, step: int = 10, low: int = 40, high: int = 160, depth: int = 2) -> np.ndarray:
    """Columns of rows along x, `step` columns from each other."""
    out = np.zeros((200, 160), bool)
    for k in range(count):
        out[low:high, first + k * step : first + k * step + depth] = True
    return out


def turned(mask: np.ndarray, turn: float) -> np.ndarray:
    """The same raster about its middle turned by an angle, rad."""
    i, j = np.indices(mask.shape) - np.array(mask.shape)[:, None, None] / 2
    x, y = np.cos(turn) * i + np.sin(turn) * j, np.cos(turn) * j - np.sin(turn) * i
    at = np.rint([x + mask.shape[0] / 2, y + mask.shape[1] / 2]).astype(int)
    there = ((at >= 0) & (at < np.array(mask.shape)[:, None, None])).all(axis=0)
    return there & mask[tuple(np.where(there, at, 0))]


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 2])
@pytest.mark.parametrize("seats", [rows(30, 9), rows(30, 7, 15, depth=5), rows(30, 9, high=90) | rows(30, 9, low=105)])
def test_rows_of_a_hall_are_rows_and_its_walls_are_none(turn, seats) -> None:
    seats = turned(seats, turn)
    if turn == np.pi / 2:
        seats[:45] = seats[155:] = False  # rows of the other direction, as many as there is room for
    seats &= ~hall()
    told = rows_of_seats(hall() | seats, EDGE)
    assert told[seats].mean() > 0.95 and (told & ~seats).sum() < 0.02 * seats.sum()
    assert not (told & hall()).any()


def test_a_row_that_was_seen_in_part_or_in_parts_belongs_to_the_others() -> None:
    seats = rows(30, 8)
    seats[60:150, 50:52] = False  # the start of one row, and
    seats[80:86, 70:72] = False  # a gap in another one
    assert (rows_of_seats(hall() | seats, EDGE) == seats).all()


@pytest.mark.parametrize(
    "wall",
    [
        rows(30, 3),  # a wall with two faces and a rail
        rows(30, 4, 20),  # rooms of 1.8 m side by side
        rows(30, 5, 10, low=1),  # stalls: their walls go out from that of the room
        rows(30, 1) | rows(40, 1) | rows(45, 1) | rows(61, 1),  # at no step
        rows(30, 6, high=44),  # pillars
    ],
)
def test_what_does_not_repeat_itself_side_by_side_is_wall(wall) -> None:
    assert not rows_of_seats(hall() | wall, EDGE).any()


def test_a_wall_behind_the_last_row_stays() -> None:
    """It stands at the step of the rows, but is much longer than these; and one further away is no matter how long."""
    seats, wall = rows(30, 6, low=70, high=130), rows(90, 1, low=20, high=180) | rows(110, 1, low=70, high=130)
    assert (rows_of_seats(hall() | seats | wall, EDGE) == seats).all()


@pytest.mark.parametrize("doors", [((36, 45), (155, 164)), ((25, 34), (165, 174)), ((36, 45), (95, 104), (155, 164))])
@pytest.mark.parametrize("behind", [90, 92])
def test_a_wall_with_doors_behind_the_last_row_stays(doors, behind) -> None:
    """Its middle stands alone, in the place of a row; but it goes on behind its doors."""
    seats, wall = rows(30, 6), rows(behind, 1, low=0, high=200)
    for a, b in doors:
        wall[a:b] = False
    assert (rows_of_seats(hall() | seats | wall, EDGE) == seats).all()


def test_what_stands_alone_far_from_the_rows_stays() -> None:
    """Legs that follow each other at the step of the rows lead on to a wall."""
    seats, legs = rows(30, 5, low=40, high=100), rows(80, 6, low=60, high=63)
    wall = rows(145, 1, low=50, high=90)
    assert (rows_of_seats(hall() | seats | legs | wall, EDGE) == seats).all()


def test_thousands_of_pieces_make_no_table_of_all_pairs() -> None:
    wall = np.zeros((800, 800), bool)
    for x in range(0, 792, 9):
        wall[x : x + 6, ::10] = True  # 7,040 of them, each 0.6 m long, in lines
    tracemalloc.start()
    rows_of_seats(wall, EDGE)
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def plan_of(wall: np.ndarray) -> StoreyPlan:
    inside = ~wall
    profile = np.where(wall, np.uint32(HEIGHT_BANDS.mask(0, 2.4)), np.uint32(HEIGHT_BANDS.mask(-0.25, 0)))
    nowhere = np.full(wall.shape, np.nan)
    return StoreyPlan(np.zeros(2), EDGE, wall, inside, profile, HEIGHT_BANDS, np.zeros(wall.shape), nowhere)


def test_a_plan_without_rows_has_floor_in_their_place() -> None:
    plan = without_rows(plan_of(hall() | rows(30, 9)))
    assert (plan.wall == hall()).all() and (plan.inside == ~hall()).all()
    assert not plan.occupied(0.25, 2.0)[~hall()].any() and plan.occupied(0.25, 2.0)[hall()].all()
    bare = plan_of(hall())
    assert without_rows(bare) is bare and not without_rows(plan_of(np.zeros((20, 20), bool))).wall.any()
