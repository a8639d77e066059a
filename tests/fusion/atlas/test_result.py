"""What an atlas says of itself: components, the weakest link, and words.

Keys tell maps apart; files are read when they are needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, stranger
from topomerge.errors import InputError
from topomerge.fusion.atlas import maps as atlas_maps
from topomerge.fusion.atlas.link_evidence import Link
from topomerge.fusion.atlas.maps import hash_map
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

NAMES = ("west.ply", "east.ply", "north.ply", "south.ply", "attic.ply")


def link(i: int, j: int, p: float, against: tuple[int, int] | None = None) -> Link:
    return Link((i, j), PoseHypothesis(Sim3(), probability=p), float(np.log(p / (1 - p))), against)


def atlas(*components: tuple[int, ...], **more: Any) -> AtlasResult:
    count = sum(map(len, components))
    return AtlasResult([None] * count, NAMES[:count], components, {k: Sim3() for k in range(count)}, **more)  # type: ignore[arg-type]


def test_a_component_is_as_probable_as_its_weakest_link():
    result = atlas((0, 2), (1, 3, 4), links=(link(0, 2, 0.9), link(1, 3, 0.99), link(3, 4, 0.95)))
    assert result.get_probability(0) == pytest.approx(0.9) and result.get_probability(1) == pytest.approx(0.95)
    assert [result.find_component(k) for k in range(5)] == [0, 1, 0, 1, 1] and atlas((0,), (1,)).get_probability(1) == 0.0


@pytest.mark.parametrize(
    ("components", "status", "alone"),
    [
        (((0, 1, 2),), "merged", ()),
        (((0, 2), (1,)), "parted", (1,)),
        (((0,), (1,)), "abstained", (0, 1)),
        (((0, 1), (2, 3)), "parted", ()),
    ],
)
def test_the_status_and_who_stands_alone(components, status, alone):
    assert atlas(*components).status == status and atlas(*components).alone == alone


def test_a_component_that_is_not_there_is_named():
    with pytest.raises(InputError, match="^there is no component 9: the atlas has 2 components, counted from 0"):
        atlas((0, 1), (2,)).join_component(9)


def test_words_name_who_belongs_together_who_stands_apart_and_what_was_thrown_out():
    result = atlas((0, 1), (2,), links=(link(0, 1, 0.93),), rejected=(link(0, 2, 0.88, (1, 2)), link(1, 2, 0.85)))
    assert result.format_summary().split("; ") == [
        "2 maps belong together (west.ply, east.ply), weakest link 0.93",
        "north.ply stands apart: nothing connects it",
        "west.ply, north.ply: a match of probability 0.88 by itself was thrown out, east.ply, north.ply contradict it",
        "east.ply, north.ply: a match of probability 0.85 by itself was thrown out, other maps contradict it",
    ]
    assert (
        atlas((0, 1), (2,), (3,), links=(link(0, 1, 0.93),))
        .format_summary()
        .endswith("north.ply, south.ply stand apart: nothing connects them")
    )


def test_words_of_an_atlas_without_links():
    assert atlas((0,), (1,)).format_summary() == "nothing could be connected: all 2 maps stand apart"
    assert atlas((0,)).format_summary() == "one map, nothing to connect it with yet" and atlas().format_summary() == "no map"


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
