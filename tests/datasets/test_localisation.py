"""Single scans of a known place: they lie where they were taken, and a walk is short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.localisation import MORE_SCANS, SCANS, TURNS, WALK_LENGTH, WALKED, simulate_single_scan

from topomerge.errors import InputError
from topomerge.types import Sim3

BUILDING = make_building("house", 800_007)
ROOMS = [k for k, room in enumerate(BUILDING.rooms) if room.kind != "lift"]


@pytest.mark.parametrize("kind", [*SCANS, *MORE_SCANS])
def test_a_scan_lies_where_it_was_taken(kind: str) -> None:
    frame = Sim3(0.7, (3.0, 4.0, 5.0))
    scan = simulate_single_scan(BUILDING, kind, ROOMS, np.random.default_rng(3), frame)
    cloud = scan.cloud
    assert cloud.poses is not None and np.allclose(cloud.poses[0, :3, 3], 0, atol=1e-6) and scan.frame.yaw == frame.yaw
    assert np.allclose(scan.frame.apply(scan.place[None]), 0, atol=1e-6)
    back = scan.frame.inverse().apply(cloud.points)
    low, high = BUILDING.vertices.min(axis=0) - 0.5, BUILDING.vertices.max(axis=0) + 0.5
    assert ((back > low) & (back < high)).mean() > 0.95
    along = np.linalg.norm(np.diff(cloud.poses[:, :3, 3], axis=0), axis=1).sum()
    if kind in WALKED:
        assert len(cloud.poses) > 3 and along < WALK_LENGTH * 1.3
    else:
        assert along < 0.01 and len(cloud.poses) == (TURNS if kind == "turn" else 1)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(InputError, match="kind of scan 'sonar'"):
        simulate_single_scan(replace(BUILDING), "sonar", ROOMS, np.random.default_rng(0), Sim3())
