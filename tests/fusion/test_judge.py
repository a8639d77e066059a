"""What the columns of two maps say to a pose."""

from __future__ import annotations

from tests.fusion.plans_of import grid_of
from tests.scenes import Scene
from topomerge.fusion.judge import Judge
from topomerge.fusion.storey_plan import plans
from topomerge.matching.plan_fields import PlanFields
from topomerge.types import Sim3


def test_free_space_speaks_against_a_wall():
    hall, cut = Scene().shell(0, 0, 10, 8), Scene().shell(0, 0, 10, 8).wall((5, 0), (5, 8), doors=(3.0,))
    a, b = ([PlanFields(p) for p in plans(grid_of(s.points()))] for s in (hall, cut))
    judged = Judge(a, b)(Sim3())
    assert judged["conflict"] > 0.3 and judged["conflict_share"] > 0.1
    assert Judge(a, a)(Sim3())["conflict"] == 0 and Judge(a, a)(Sim3())["ratio"] > 0.95
