"""Rooms cut finer: the tree of merges is kept, and cut lower it gives the zones of open plans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from topomerge.extraction.extract import extract
from topomerge.extraction.zones import compute_merge_levels, cut_zones, find_zones
from topomerge.io.maps import load_map, save_map
from topomerge.io.points import read_points
from topomerge.types import AREA_DTYPE, EDGE_DTYPE, TopometricMap

NEVER = 1.0  # of areas that no merge joined


def test_areas_part_at_the_largest_of_the_merges_that_joined_them() -> None:
    merges = ((0, 1, 0.1), (2, 3, 0.3), (0, 2, 0.25), (5, 6, 0.05))  # 2 and 3 were joined before
    pairs = np.array([(0, 1), (1, 0), (2, 3), (1, 3), (0, 2), (5, 6), (0, 4), (4, 7), (3, 5)])
    assert compute_merge_levels(merges, pairs).tolist() == [0.1, 0.1, 0.3, 0.3, 0.3, 0.05, NEVER, NEVER, NEVER]
    assert compute_merge_levels((), pairs).tolist() == [NEVER] * len(pairs) and not len(compute_merge_levels(merges, pairs[:0]))


@pytest.fixture(scope="module")
def open_plan(tmp_path_factory: pytest.TempPathFactory) -> TopometricMap:
    """Two rooms of 6 x 5 m with an opening of 1.3 m between them and a smaller one behind a door, taken for one."""
    image = np.full((100, 320), 254, np.uint8)
    image[[0, 99]] = image[:, [0, 120, 240, 319]] = 0
    image[37:63, 120] = image[40:57, 240] = 254
    path: Path = tmp_path_factory.mktemp("plan") / "plan.png"
    Image.fromarray(image).save(path)
    map = extract(read_points(path, resolution=0.05), door=1.0)
    assert len(map.rooms) == 1 and len(map.narrows) == 2
    return map


def test_a_lower_cut_of_the_same_tree_gives_zones(open_plan: TopometricMap) -> None:
    between = np.sort(open_plan.narrows["confidence"])
    assert (between > 0.2).all() and (between <= 1).all()
    zones = cut_zones(open_plan)
    assert len(zones.rooms) == 3 and zones.rooms["area"].sum() == pytest.approx(open_plan.rooms["area"].sum())
    assert zones.edges["rooms"].tolist() in ([[0, 1], [1, 2]], [[0, 1], [0, 2]], [[0, 2], [1, 2]]) and not len(zones.narrows)
    assert sorted(zones.edges["confidence"]) == pytest.approx(between)
    width = zones.rooms["hi"][:, 0] - zones.rooms["lo"][:, 0]
    assert np.sort(width) == pytest.approx([4, 6, 6], abs=0.4)
    for labels, before in ((zones.room, open_plan.room), (zones.navigable_room, open_plan.navigable_room)):
        assert ((labels >= 0) == (before >= 0)).all()
        assert [int((labels == z).sum()) > 0 for z in range(3)] == [True] * 3
    assert zones.rooms["cells"].tolist() == np.bincount(zones.room[zones.room >= 0]).tolist()
    middle = cut_zones(open_plan, float(between[0]))  # only what the surer narrowing parts
    assert len(middle.rooms) == 2 and len(middle.narrows) == 1


def test_above_all_merges_the_zones_are_the_rooms(open_plan: TopometricMap) -> None:
    same = cut_zones(open_plan, 1.0)
    assert (same.room == open_plan.room).all() and (same.navigable_room == open_plan.navigable_room).all()
    for name in ("rooms", "edges", "narrows", "areas"):
        assert (getattr(same, name) == getattr(open_plan, name)).all()


def test_the_probabilities_are_in_the_file(open_plan: TopometricMap, tmp_path: Path) -> None:
    save_map(open_plan, tmp_path / "a.tmap")
    assert (load_map(tmp_path / "a.tmap").narrows == open_plan.narrows).all()


def test_zones_are_numbered_room_by_room(open_plan: TopometricMap) -> None:
    areas, narrows = np.zeros(5, AREA_DTYPE), np.zeros(3, EDGE_DTYPE)
    narrows["rooms"], narrows["confidence"] = [(0, 2), (1, 2), (1, 3)], [0.6, 0.3, 0.1]
    drawn = replace(open_plan, areas=areas, narrows=narrows, navigable_area=None)
    assert find_zones(drawn).tolist() == [0, 1, 2, 1, 3]
    assert find_zones(drawn, 0.3).tolist() == [0, 1, 1, 1, 2] and find_zones(drawn, 0.6).tolist() == [0, 0, 0, 0, 1]
    two = replace(drawn, rooms=np.repeat(drawn.rooms, 2))
    two.areas["room"][[0, 4]] = 1
    assert find_zones(two, 0.3).tolist() == [1, 0, 0, 0, 2]
