"""Maps in other units, one map twice, storeys that are too high: what is refused, and what a user is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes_map import building, same
from topomerge.errors import InputError
from topomerge.fusion.atlas.solve import build_atlas
from topomerge.fusion.inputs import check_different, check_pair, check_units, iter_pair_warnings, load_input, resolve_threshold
from topomerge.fusion.pipeline import merge
from topomerge.io.maps import save_map
from topomerge.registration.verify import load_model
from topomerge.types import PointCloud, TopometricMap


def scaled(map: TopometricMap, times: float, name: str = "large.ply") -> TopometricMap:
    """The same map in a smaller unit."""
    return replace(map, grid=replace(map.grid, edge=map.grid.edge * times), source=name)


def with_storeys(map: TopometricMap, *heights: float) -> TopometricMap:
    storeys = np.zeros(len(heights), map.storeys.dtype)
    storeys["ceiling"] = storeys["floor"] + heights
    return replace(map, storeys=storeys)


@pytest.mark.parametrize(("times", "unit"), [(100.0, "cm"), (1000.0, "mm")])
def test_the_unit_of_the_larger_map_is_named_whichever_comes_first(times, unit):
    small, large = building(1), scaled(building(2), times)
    for pair in ((small, large), (large, small)):
        with pytest.raises(InputError, match=rf"large.ply: spans .* building.ply .*--unit {unit}$"):
            check_units(*pair)


def test_the_span_that_is_told_is_the_diagonal_from_above():
    map = building(1)
    with pytest.raises(InputError) as error:
        check_units(map, scaled(map, 1000.0))
    spans = np.hypot(*(np.ptp(map.grid.cells[:, :2], axis=0))) * map.grid.edge
    assert f"spans {1000 * spans:,.0f} m, building.ply {spans:,.0f} m" in str(error.value)


def is_refused(check, *inputs):
    try:
        check(*inputs)
    except InputError:
        return True
    return False


def test_large_buildings_are_no_other_unit():
    house = building(1)
    assert is_refused(check_units, house, scaled(house, 100.0))
    assert not is_refused(check_units, house, scaled(house, 25.0))  # 350 m beside 14 m
    assert not is_refused(check_units, scaled(house, 0.1), scaled(house, 10.0))  # 140 m beside 1.4 m
    pair = house, scaled(building(2), 100.0)
    assert is_refused(check_pair, *pair, "fixed") and not is_refused(check_pair, *pair, "free")  # the scale is looked for


def test_one_map_is_not_merged_with_itself():
    map = building(1)
    for other in (map, replace(map, source="copy")):
        with pytest.raises(InputError, match="is the same map as building.ply"):
            check_different(map, other)
    moved = replace(map, grid=replace(map.grid, origin=map.grid.origin + (1.0, 0.0, 0.0)))
    for other in (moved, scaled(map, 2.0), building(2)):
        check_different(map, other)


def test_what_is_no_map_is_named():
    with pytest.raises(InputError, match=r"^a\.ply: merge takes maps and \.tmap files; make a map of points with extract"):
        merge(["a.ply", "b.ply"])
    with pytest.raises(InputError, match=r"^a\.tmap: no such file"):
        merge(["a.tmap", "b.tmap"])
    with pytest.raises(InputError, match="^PointCloud: merge takes maps"):
        merge([building(1), PointCloud(np.zeros((1, 3)))])


@pytest.mark.parametrize("function", [merge, build_atlas])
def test_what_is_no_list_of_maps_is_named(function):
    name = function.__name__
    for maps in (building(1), (building(k) for k in (1, 2)), "a.tmap"):
        with pytest.raises(InputError, match=rf"^{name} takes a list of maps, not a {type(maps).__name__}; give it as {name}\("):
            function(maps)


def test_maps_are_read_where_they_are_files(tmp_path):
    save_map(building(1), tmp_path / "a.tmap")
    for path in (tmp_path / "a.tmap", str(tmp_path / "a.tmap")):
        assert same(load_input(path), building(1))


def test_storeys_twice_as_high_are_told_of_with_the_unit_in_mind():
    low, high = with_storeys(building(1), 2.5, 2.7, 9.0), with_storeys(building(2), 6.2)
    high = replace(high, source="hall.ply")
    said = "hall.ply: storeys are 6.2 m high, in building.ply 2.7 m: the units may differ"
    assert list(iter_pair_warnings(low, high, "fixed")) == list(iter_pair_warnings(high, low, "fixed")) == [said]
    assert not list(iter_pair_warnings(low, high, "free"))
    assert not list(iter_pair_warnings(low, with_storeys(building(2), 5.8), "fixed"))
    assert not list(iter_pair_warnings(low, with_storeys(building(2), np.nan), "fixed"))


def test_few_rooms_are_told_of():
    map = building(1)
    labels = {"room": map.room * 0, "navigable_room": map.navigable_room * 0}
    one = replace(map, rooms=map.rooms[:1], edges=map.edges[:0], **labels)
    none = replace(map, rooms=map.rooms[:0], edges=map.edges[:0], source="", **{k: v - 1 for k, v in labels.items()})
    said = [
        "building.ply: has one room: little can be compared",
        "the second map: has no rooms: only walls and empty space can be compared",
    ]
    assert list(iter_pair_warnings(one, none, "fixed")) == said


def test_a_threshold_is_a_probability():
    assert resolve_threshold(None) == load_model()["threshold"] and resolve_threshold(0) == 0.0 and resolve_threshold(1) == 1.0
    for wrong in (-0.1, 1.01, float("nan")):
        with pytest.raises(InputError, match="between 0 and 1"):
            resolve_threshold(wrong)
