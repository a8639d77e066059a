from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.core.building import Opening, Plan, PlanRoom, check_plan

from tests.datasets.boxes import one_room, room, two_rooms
from topomerge.errors import InputError


def test_a_good_plan_passes() -> None:
    for plan in (one_room(), two_rooms()):
        assert check_plan(plan) is None


@pytest.mark.parametrize(
    ("plan", "reason"),
    [
        (Plan(()), "no rooms"),
        (Plan((room("a", 0, 0, 4, 5), room("b", 1, 1, 3, 3))), "'a' and 'b' overlap"),
        (Plan((PlanRoom("bow", np.array([[0, 0], [4, 4], [4, 0], [0, 4.0]])),)), "'bow' crosses itself"),
        (Plan((PlanRoom("line", np.array([[0, 0], [4, 4.0]])),)), "no outline"),
        (Plan((PlanRoom("nan", np.array([[0, 0], [np.nan, 4], [4, 0.0]])),)), "no outline"),
        (Plan((room("tiny", 0, 0, 0.4, 0.5),)), "0.20 m2: is the scale right"),
        (Plan((room("huge", 0, 0, 4000, 5000),)), "is the scale right"),
        (Plan((room("a", 0, 0, 4, 5),), ceiling=3.5), "ceiling at 3.5 m"),
        (Plan((room("a", 0, 0, 4, 5),), openings=(Opening("door", (1, 1), (1, 1)),)), "0.00 m wide"),
    ],
)
def test_impossible_plans_are_refused_with_the_reason(plan: Plan, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as error:
        check_plan(plan, "school 3")
    assert str(error.value).startswith("school 3: ") and "\n" not in str(error.value)


def test_rooms_that_share_a_wall_do_not_overlap() -> None:
    plan = replace(one_room(), rooms=(room("a", 0, 0, 4, 5), room("b", 4, 0, 8, 5)), openings=())
    assert check_plan(plan) is None
    with pytest.raises(InputError, match="overlap"):  # a hand's breadth more, and they do
        check_plan(replace(plan, rooms=(room("a", 0, 0, 4.2, 5), plan.rooms[1])))
