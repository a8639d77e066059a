"""Matching: exact answers on maps made by hand, and what must change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.embedding.test_descriptors import permuted
from tests.matching.turned_maps import turned, uneven
from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.matching.match import match


def test_transform_and_rooms_are_found_exactly():
    b, true = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b)
    assert found.transform is not None
    corners = b.rooms["centroid"]
    assert any(np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05) for h in found.alternatives)
    right = next(h for h in found.alternatives if np.allclose(h.transform.apply(corners), true.apply(corners), atol=0.05))
    assert [tuple(p) for p in right.rooms.tolist()] == [(i, i) for i in range(4)]


def test_unknown_scale():
    a = building(2)
    b, true = turned(a, (7.0, -3.0, 1.5), 1.3)
    found = match(a, b, scale_free=True)
    assert any(h.transform.scale == pytest.approx(true.scale, rel=0.02) for h in found.alternatives[:3])


def test_rooms_that_look_alike_keep_alternatives():
    a = building(2)  # the same from both ends
    b, _ = turned(a, (7.0, -3.0, 1.5))
    found = match(a, b)
    yaws = sorted(round(np.degrees(h.transform.yaw)) % 180 for h in found.alternatives[:2])
    assert len(found.alternatives) > 1 and yaws == [90, 90]
    assert found.alternatives[0].probability < 0.7 and found.alternatives[1].probability > 0.2


def test_order_of_rooms():
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    order = np.array([2, 0, 3, 1])
    plain, mixed = match(uneven(), b), match(permuted(uneven(), order), b)
    back = {(int(order[i]), j) for i, j in mixed.rooms.tolist()}
    assert back == {tuple(p) for p in plain.rooms.tolist()}


@pytest.mark.parametrize("method", ["growing", "assignment", pytest.param("thesis", marks=pytest.mark.slow)])
def test_other_methods_run(method: str):
    b, _ = turned(uneven(), (7.0, -3.0, 1.5))
    found = match(uneven(), b, method=method)
    assert len(found.rooms) and ((found.probability >= 0) & (found.probability <= 1)).all()


def test_bad_input():
    a = building(1)
    nothing = replace(a, rooms=a.rooms[:0], edges=a.edges[:0], room=a.room * 0 - 1, navigable_room=a.navigable_room * 0 - 1)
    with pytest.raises(InputError, match="same map"):
        match(a, a)
    with pytest.raises(InputError, match="no rooms"):
        match(nothing, building(2))
    with pytest.raises(InputError, match="method"):
        match(a, building(2), method="best")
