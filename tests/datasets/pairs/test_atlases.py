"""Atlases: transforms close around every cycle."""

from __future__ import annotations

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.pairs import Atlas

from topomerge.errors import InputError


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return make_atlas(make_building("house", 3), ("depth", "tls", "tablet"), 1, rooms=4, scale=True)


def test_transforms_take_every_map_to_the_first(atlas: Atlas) -> None:
    assert len(atlas.maps) == 3 and np.allclose(atlas.truth[0].matrix, np.eye(4), atol=1e-9)
    for cloud, transform in zip(atlas.maps, atlas.truth, strict=True):
        for room, first in zip(cloud.rooms, atlas.maps[0].rooms, strict=True):
            moved = transform.apply(np.column_stack([room.polygon, np.full(len(room.polygon), room.floor)]))
            assert np.allclose(moved[:, :2], first.polygon, atol=1e-6)


def test_every_map_overlaps_an_earlier_one(atlas: Atlas) -> None:
    assert set(atlas.shared) == {(0, 1), (0, 2), (1, 2)}
    assert all(any(atlas.shared[k, m] for k in range(m)) for m in (1, 2))


def test_bad_atlases() -> None:
    with pytest.raises(InputError, match="two or more"):
        make_atlas(make_building("house", 3), ("tls",))
    with pytest.raises(InputError, match="a transform and a sensor each"):
        Atlas("x", (), (), {}, (), "procedural", "x")
