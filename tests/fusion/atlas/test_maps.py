"""Keys tell maps apart; files are read when they are needed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.fusion.atlas.atlas_scenes import office_map, stranger
from topomerge.fusion.atlas.memory import map_key


@pytest.mark.longer
def test_keys_tell_maps_by_what_they_hold():
    maps = [*(office_map(k) for k in range(4)), stranger()]
    assert map_key(maps[0]) == map_key(replace(maps[0], source="other", seconds={"x": 1.0}))
    moved = replace(maps[0], grid=replace(maps[0].grid, origin=maps[0].grid.origin + 1.0))
    assert len({map_key(m) for m in (*maps, moved)}) == 6
