"""Two sessions with known changes: what is listed differs between the meshes, and the clouds show it."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from topomerge.datasets.core.building import SURFACES
from topomerge.datasets.simulation.changed_sessions import SEEN_POINTS, ChangedPair, make_changed_pair

pytestmark = pytest.mark.longer


@pytest.fixture(scope="module")
def pair() -> ChangedPair:
    return make_changed_pair("apartment", 5_934, ("tls", "depth"))


def test_each_change_is_in_the_clouds(pair: ChangedPair) -> None:
    kinds = [c.kind for c in pair.changes]
    assert {k for k in kinds if k.startswith("wall")} in ({"wall new"}, {"wall gone"})
    flat = [frame.inverse().apply(cloud.points) for frame, cloud in zip(pair.frames, pair.clouds, strict=True)]
    floor = min(r.floor for r in pair.building.rooms)
    for change in pair.changes:
        if change.seen and change.kind in ("wall new", "wall gone", "furniture new", "furniture gone"):
            points = flat[1 if change.kind.endswith("new") else 0]
            height = points[:, 2] - floor
            inside = shapely.contains_xy(change.outline.buffer(0.125), points[:, 0], points[:, 1])
            assert int((inside & (height > 0.25) & (height < 2.0)).sum()) >= SEEN_POINTS


def test_nothing_changes_where_nothing_shall() -> None:
    pair = make_changed_pair("apartment", 5_934, ("tls", "tls"), changed=False)
    assert pair.changes == () and len(pair.clouds[0]) and len(pair.clouds[1])


def test_the_same_arguments_give_the_same_pair(pair: ChangedPair) -> None:
    again = make_changed_pair("apartment", 5_934, ("tls", "depth"))
    assert np.array_equal(again.clouds[0].points, pair.clouds[0].points) and again.changes == pair.changes
    assert SURFACES[0] == "wall" and pair.truth.scale == 1.0
