"""Keys tell maps apart; files are read when they are needed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.fusion.atlas.atlas_scenes import office_map, stranger
from topomerge.fusion.atlas import maps as atlas_maps
from topomerge.fusion.atlas.maps import hash_map


@pytest.mark.longer
def test_keys_tell_maps_by_what_they_hold():
    maps = [*(office_map(k) for k in range(4)), stranger()]
    assert hash_map(maps[0]) == hash_map(replace(maps[0], source="other", seconds={"x": 1.0}))
    moved = replace(maps[0], grid=replace(maps[0].grid, origin=maps[0].grid.origin + 1.0))
    assert len({hash_map(m) for m in (*maps, moved)}) == 6


@pytest.mark.longer
def test_areas_are_remembered_of_maps_whose_plans_are_not(monkeypatch):
    prepared, prepare = [], atlas_maps.prepare
    monkeypatch.setattr(atlas_maps, "PREPARED_AT_ONCE", 1)
    monkeypatch.setattr(atlas_maps, "prepare", lambda map: prepared.append(map.source) or prepare(map))
    maps = atlas_maps.Maps([office_map(0), stranger()])
    areas = [maps.get_area(k) for k in (0, 1, 0, 1)]
    assert areas[:2] == areas[2:] and min(areas) > 20 and len(prepared) == 2
