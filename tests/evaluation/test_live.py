"""The measure of robots live: what of a join is right, when a person could tell, and how long a wrong join lives."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge.evaluation.live import Settings, draw_robots, judge_event, list_floor, list_inputs, tabulate
from topomerge.types import Sim3

FRAMES = Sim3(), Sim3(2.1, (7.0, -3.0, 0.0))


def robots(second: int = 1) -> list[tuple[str, int, Sim3, list[tuple[float, np.ndarray, np.ndarray]]]]:
    pose = np.eye(4)
    pose[:3, 3] = (4.0, 2.0, 1.0)
    return [(name, k, frame, [(0.0, pose, np.zeros((0, 3)))]) for name, k, frame in zip("ab", (1, second), FRAMES, strict=True)]


def joined(pose: Sim3) -> dict[str, object]:
    return {"event": "joined", "robots": ["a", "b"], "probability": 0.97, "matrix": pose.matrix.round(5).tolist()}


def test_a_join_is_right_only_in_one_building_and_at_the_true_pose() -> None:
    true = FRAMES[0] @ FRAMES[1].inverse()
    assert judge_event(joined(true), robots())["right"] and judge_event(joined(true), robots())["away"] < 1e-3
    assert not judge_event(joined(true), robots(second=2))["right"]
    assert not judge_event(joined(Sim3(true.yaw, (0.0, 0.0, 0.0))), robots())["right"]
    assert "right" not in judge_event({"event": "parted", "robots": ["a", "b"], "probability": 0.1}, robots())


def test_delays_count_from_the_least_floor_by_which_a_pair_was_joined() -> None:
    def case(name: str, areas: list[float], events: list[dict[str, object]], together: bool = True) -> dict[str, object]:
        shared = [[10.0 * k, {"ab": area}] for k, area in enumerate(areas)]
        return {"name": name, "robots": 2, "together": {"ab": together}, "areas": shared, "events": events, "end": 50.0,
                "add": 0.004, "update": 0.2}  # fmt: skip

    def event(time: float, right: bool | None) -> dict[str, object]:
        return {"time": time, "pair": "ab", "event": "joined" if right is not None else "parted", "right": right}

    rows = [
        case("one", [0, 20, 40, 60], [event(22.0, True)]),
        case("two", [0, 50, 60, 90], [event(15.0, False), event(27.0, None), event(33.0, True)]),
        case("three", [0, 0, 0, 0], [event(20.0, False)], together=False),
    ]
    (table,) = tabulate(rows, Settings()).values()
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()[2:]]
    assert [line[4:8] for line in lines] == [["20", "22", "2", "none"], ["10", "33", "23", "12 s"], ["–", "–", "–", "to the end"]]
    assert lines[0][-1] == "28" and len(list_inputs(Settings())) == 8


@pytest.mark.longer
def test_robots_of_a_case_see_the_same_floor_in_frames_of_their_own() -> None:
    (_, one, frame_a, scans_a), (_, two, frame_b, scans_b) = draw_robots(0, np.random.default_rng([0, 55]))
    assert one == two and len(scans_a) > 10 and not np.allclose(frame_a.matrix, frame_b.matrix)
    seen = [
        set().union(*(list_floor(f.inverse(), pose, points) for _, pose, points in scans[:20]))
        for f, scans in ((frame_a, scans_a), (frame_b, scans_b))
    ]
    assert len(seen[0] & seen[1]) > 0.1 * min(map(len, seen))
