"""Look-alikes: who could tell them apart on cases made by hand, wrong poses by whole periods, mirror images, seeds of splits, and
the same bytes for the same item."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.drafting import Draft
from topomerge.datasets.buildings.furniture import make_item
from topomerge.datasets.buildings.modules import EQUAL, _convert_item, draw_module, make_row, replace_things
from topomerge.datasets.core.building import Building, Difficulty
from topomerge.datasets.pairs.grid_pairs import unpack_pair
from topomerge.datasets.pairs.lookalike_places import (
    FURNISHED,
    LOOKALIKES,
    add_pilasters,
    compute_row_poses,
    estimate_overlay_pose,
    mirror_by_point,
    sample_places,
)
from topomerge.datasets.pairs.lookalikes import (
    LookalikeItem,
    LookalikeRecipe,
    VisiblePlace,
    build_lookalike_arrays,
    draw_lookalike_items,
    evaluate_poses,
    is_distinguishable,
    measure_differences,
)
from topomerge.datasets.plans import splits

from topomerge.errors import InputError
from topomerge.types import Sim3

WIDE, DEEP = 8.0, 6.0  # m, of the room made by hand


def room(door: float | None = 0.3) -> Building:
    """One room with a door in its left wall at a share of it, or without one."""
    draft = Draft(0.1, np.random.default_rng(0))
    draft.add_box((0.0, 0.0), (WIDE, DEEP), "office")
    if door is not None:
        draft.cut(shapely.LineString([(0, 0), (0, DEEP)]), 0.9, "door", door)
    return build_building([draft.build_plan(3.2, 2.7)], EQUAL, 0, "room")


def with_things(building: Building, *things: tuple[str, float, float]) -> Building:
    """The building with things, each of a kind and at a place; those of a kind are all the same."""
    items = [replace(make_item(kind, np.random.default_rng(1)), at=np.array([x, y])) for kind, x, y in things]
    return replace_things(building, np.zeros(len(building.things), bool), [_convert_item(i, 0, building) for i in items])


def shown(building: Building, sensor: str = "tls", right: float = WIDE) -> VisiblePlace:
    """A place of which a map shows all up to an x."""
    x, y = np.meshgrid(np.arange(-0.3, right + 0.3, 0.1), np.arange(-0.3, DEEP + 0.3, 0.1))
    return VisiblePlace(building, np.column_stack([x.ravel(), y.ravel()]), sensor)


def test_the_same_room_cannot_be_told_from_itself() -> None:
    furnished = with_things(room(), ("wardrobe", 2, 5), ("bed", 5, 2), ("kitchen", 6, 5.3))
    amount = measure_differences(shown(furnished), shown(furnished), Sim3())
    assert amount["walls"] == amount["fitted"] == amount["furniture"] == 0 and not is_distinguishable(amount)
    assert amount["common"] == pytest.approx(7.9 * 5.9, rel=0.05) and amount["standing"] > 1.5


def test_furniture_elsewhere_tells_and_clutter_does_not() -> None:
    a = with_things(room(), ("wardrobe", 2, 5), ("bed", 5, 1.5), ("clutter", 3, 3), ("clutter", 6, 4))
    moved = with_things(room(), ("wardrobe", 6, 5), ("bed", 1.5, 2), ("clutter", 3, 3))
    strewn = with_things(room(), ("wardrobe", 2, 5), ("bed", 5, 1.5), ("clutter", 4, 2), ("clutter", 1, 4))
    nudged = with_things(room(), ("wardrobe", 2.1, 5), ("bed", 5.1, 1.5))
    assert measure_differences(shown(a), shown(moved), Sim3())["furniture"] == pytest.approx(1.0, abs=0.01)
    assert is_distinguishable(measure_differences(shown(a), shown(moved), Sim3()))
    for other in (strewn, nudged):
        assert not is_distinguishable(measure_differences(shown(a), shown(other), Sim3()))


def test_a_fixture_elsewhere_tells_where_both_maps_show_it() -> None:
    a, b = with_things(room(), ("kitchen", 6, 5.3)), with_things(room(), ("kitchen", 6, 0.7))
    assert (
        is_distinguishable(measure_differences(shown(a), shown(b), Sim3()))
        and measure_differences(shown(a), shown(b), Sim3())["fitted"] > 1.5
    )
    unseen = measure_differences(shown(a, right=3.0), shown(b), Sim3())
    assert unseen["fitted"] == 0 and not is_distinguishable(unseen)


def test_a_tablet_shows_nothing_low() -> None:
    a, b = with_things(room(), ("bed", 5, 1.5), ("bed", 2, 1.5)), with_things(room(), ("bed", 5, 4.5), ("bed", 2, 4.5))
    assert is_distinguishable(measure_differences(shown(a), shown(b), Sim3()))
    assert not is_distinguishable(measure_differences(shown(a), shown(b, "tablet"), Sim3()))


def test_a_wall_inside_the_floor_tells_by_its_length() -> None:
    a = room()
    moved = measure_differences(shown(a), shown(a), Sim3(0.0, (1.0, 0.0, 0.0)))
    assert moved["walls"] == pytest.approx(2 * (DEEP - 0.7), rel=0.15)  # the end wall of each, 0.3 m clear of the side walls
    assert is_distinguishable(moved)
    assert measure_differences(shown(a), shown(a), Sim3(0.0, (0.2, 0.0, 0.0)))["walls"] == 0  # drift does as much


def test_a_mirrored_outline_tells_unless_it_is_symmetrical() -> None:
    half_turn = Sim3(np.pi, (WIDE, DEEP, 0.0))
    plain = room(None)
    assert measure_differences(shown(plain), shown(plain), half_turn)["walls"] == 0.0
    draft = Draft(0.1, np.random.default_rng(0))
    draft.add_room(shapely.box(0, 0, WIDE, DEEP).difference(shapely.box(5, 3, WIDE, DEEP)), "office")
    corner = build_building([draft.build_plan(3.2, 2.7)], EQUAL, 0, "corner")
    assert measure_differences(shown(corner), shown(corner), half_turn)["walls"] > 3.0


def test_a_door_elsewhere_tells_and_one_that_stands_otherwise_does_not() -> None:
    def beside(state: str, at: float) -> VisiblePlace:
        draft = Draft(0.1, np.random.default_rng(0))
        rooms = [draft.add_box((0.0, 0.0), (WIDE, DEEP), "office"), draft.add_box((WIDE, 0.0), (2 * WIDE, DEEP), "office")]
        draft.cut(draft.outlines[rooms[0]].intersection(draft.outlines[rooms[1]]), 0.9, "door", at, state=state)
        return shown(build_building([draft.build_plan(3.2, 2.7)], EQUAL, 0, "two"), right=2 * WIDE)

    assert is_distinguishable(measure_differences(beside("open", 0.3), beside("open", 0.7), Sim3()))
    assert not is_distinguishable(
        measure_differences(beside("open", 0.3), beside("shut", 0.3), Sim3())
    )  # the same door on another day


def test_a_pair_is_tellable_only_if_each_of_its_poses_is() -> None:
    plain = shown(room(None))
    half_turn, apart = Sim3(np.pi, (WIDE, DEEP, 0.0)), Sim3(0.0, (1.0, 0.0, 0.0))
    assert evaluate_poses(plain, plain, [apart])[0]
    tellable, amount, pose = evaluate_poses(plain, plain, [apart, half_turn])
    assert not tellable and pose is half_turn and amount["walls"] < 1.0
    assert evaluate_poses(plain, plain, [Sim3(0.0, (100.0, 0.0, 0.0))]) == (True, {}, None)


@pytest.mark.longer
@pytest.mark.parametrize("layout", ["room", "ensuite", "suite"])
def test_a_row_moved_by_whole_periods_has_equal_walls_and_by_half_a_period_has_not(layout: str) -> None:
    row = make_row(replace(draw_module(layout, np.random.default_rng(2)), both=False), 6, Difficulty(), 2, "row")
    x, y = np.meshgrid(np.arange(row.period, 3 * row.period, 0.1), np.arange(-0.5, 9.0, 0.1))
    a = VisiblePlace(row.building, np.column_stack([x.ravel(), y.ravel()]), "tls")
    for k in (1, 2, 3):
        moved = replace(a, seen=a.seen + [k * row.period, 0.0])
        amount = measure_differences(a, moved, Sim3(0.0, (-k * row.period, 0.0, 0.0)))
        assert amount["walls"] == 0 and amount["common"] > 10
    assert measure_differences(a, a, Sim3(0.0, (row.period / 2, 0.0, 0.0)))["walls"] > 2.0


def test_wrong_poses_of_a_row_are_whole_periods_and_never_the_true_one() -> None:
    row = make_row(draw_module("room", np.random.default_rng(0)), 6, Difficulty(), 0, "row")
    shifts = [p.translation[0] / row.period for p in compute_row_poses(row, first=0, second=1, seen=3)]
    assert np.allclose(sorted(shifts), [-3, -2, -1, 1])  # modules 1 to 3 on 0 to 2, but not in their own places
    assert all(p.yaw == 0 and p.translation[1:] == (0.0, 0.0) for p in compute_row_poses(row, 0, 1, 3))


@pytest.mark.longer
def test_a_mirror_image_is_a_reflection_and_lies_on_the_building_where_it_can() -> None:
    places = sample_places("mirror", "same", 5)
    (a, b), (rooms, _) = places.buildings, places.visited
    for one, other in zip(a.rooms, b.rooms, strict=True):
        assert np.allclose(one.polygon * [-1, 1], other.polygon[::-1])
    assert np.allclose(a.things["centre"] * [-1, 1, 1], b.things["centre"])
    lying = estimate_overlay_pose(a, a, rooms, 0.0)
    assert np.allclose(lying.translation, 0.0, atol=1e-6) and lying.yaw == 0.0


@pytest.mark.longer
@pytest.mark.parametrize("kind", LOOKALIKES)
@pytest.mark.parametrize("furniture", FURNISHED)
def test_places_of_each_kind_hold_the_furniture_that_is_asked_for(kind: str, furniture: str) -> None:
    places = sample_places(kind, furniture, 21)
    a, b = places.buildings
    assert places.same == (kind in ("shifted-row", "modules", "point-symmetric")) and len(places.poses) >= 1
    assert all(len(v) and v.max() < len(x.rooms) for v, x in zip(places.visited, places.buildings, strict=True))
    loose = [x.things[~np.isin(x.things["kind"], ("leaf", "column"))] for x in (a, b)]
    if furniture == "empty":
        assert not len(loose[0]) and not len(loose[1])
    elif furniture == "same":
        assert len(loose[0]) == len(loose[1])


def test_sets_of_two_splits_share_no_seed_and_longer_sets_begin_with_shorter_ones() -> None:
    pairs = dict.fromkeys(LOOKALIKES, 40)
    train, test = (draw_lookalike_items(LookalikeRecipe(pairs=pairs, split=split)) for split in ("train", "test"))
    for items, split in ((train, "train"), (test, "test")):
        first, last = splits.get_seed_range(split)
        assert all(first <= item.seed <= last for item in items)
        assert len({item.name for item in items}) == len(items) == 40 * len(LOOKALIKES)
    assert not {i.seed for i in train} & {i.seed for i in test}
    shorter = draw_lookalike_items(LookalikeRecipe(pairs=dict.fromkeys(LOOKALIKES, 3)))
    assert shorter == train[: len(shorter)]


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        (LookalikeRecipe(pairs={"twins": 3}), "data.pairs.twins"),
        (LookalikeRecipe(), "data.pairs"),
        (LookalikeRecipe(pairs={"mirror": 1}, scaled=2.0), "data.scaled"),
        (LookalikeRecipe(pairs={"mirror": 1}, sensors={"eye": 1.0}), "eye"),
        (LookalikeRecipe(pairs={"mirror": 1}, split="exam"), "exam"),
    ],
)
def test_recipes_of_which_nothing_can_be_made_are_refused(recipe, message) -> None:
    with pytest.raises(InputError, match=message):
        draw_lookalike_items(recipe)


def test_the_same_item_gives_the_same_bytes_and_rooms_of_two_places_have_no_truth() -> None:
    item = LookalikeItem("same-room", 0, 900_001, "other", ("depth", "tls"), False)
    first, second = build_lookalike_arrays(item), build_lookalike_arrays(item)
    assert first.keys() == second.keys() and all(first[k].tobytes() == second[k].tobytes() for k in first)
    pair = unpack_pair("x", first)
    assert pair.truth is None and pair.common == 0 and pair.about["kind"] == "lookalike"
    assert pair.about["lookalike"] == "same-room" and pair.about["tellable"] in (True, False)


@pytest.mark.longer
def test_parts_of_a_row_have_their_true_pose_and_a_false_one_whole_rooms_away() -> None:
    item = LookalikeItem("shifted-row", 0, 3, "same", ("depth", "depth"), False)
    places = sample_places(item.kind, item.furniture, item.seed)
    pair = unpack_pair("x", build_lookalike_arrays(item))
    assert pair.about["kind"] == "overlap" and pair.common >= 1.0 and pair.truth is not None
    alike = np.array(pair.about["alike"])
    true = pair.truth.matrix
    assert np.allclose(alike[:3, :3], true[:3, :3], atol=1e-5)
    off = np.linalg.norm(alike[:3, 3] - true[:3, 3])
    assert min(abs(off - abs(p.translation[0])) for p in places.poses) < 1e-4


def test_a_place_visited_again_is_a_right_merge_and_changes_no_other_item() -> None:
    """Its walls lie on themselves under the true pose; who learns from look-alikes sees buildings of this style that are one."""
    recipe = LookalikeRecipe(pairs={"same-room": 2}, again={"same-room": 1})
    first, second, again = draw_lookalike_items(recipe)
    assert [first, second] == draw_lookalike_items(LookalikeRecipe(pairs={"same-room": 2}))
    assert (
        again.again and again.name not in (first.name, replace(again, again=False).name) and replace(again, again=False) == first
    )
    pair = unpack_pair("x", build_lookalike_arrays(replace(again, sensors=("tls", "tls"), scaled=False)))
    assert pair.about["kind"] == "overlap" and pair.about["tellable"] and pair.truth is not None and pair.common > 10
    a, b = (
        np.unique(np.floor(p[:, :2] / 0.3).astype(int), axis=0)
        for p in (pair.a.compute_centroids(), pair.truth.apply(pair.b.compute_centroids()))
    )
    both = {tuple(row) for row in a.tolist()} & {tuple(row) for row in b.tolist()}
    assert len(both) > 0.8 * min(len(a), len(b))


@pytest.mark.parametrize("seed", [1, 4])
def test_storeys_have_one_plan_and_furniture_of_their_own(seed: int) -> None:
    a, b = sample_places("storeys", "other", seed).buildings
    assert all(np.array_equal(r.polygon, s.polygon) for r, s in zip(a.rooms, b.rooms, strict=True))
    assert np.array_equal(a.doors["centre"], b.doors["centre"])
    first, second = (x.things[x.things["movable"] & (x.things["kind"] != "leaf")] for x in (a, b))
    assert len(first) and len(second)
    far = np.linalg.norm(first["centre"][:, None] - second["centre"][None], axis=2).min(axis=1)
    assert (far > 0.05).mean() > 0.8


def test_the_halves_of_a_point_symmetric_building_lie_on_each_other() -> None:
    places = sample_places("point-symmetric", "empty", 2)
    building, (pose,) = places.buildings[0], places.poses
    half = len(building.rooms) // 2
    for room, other in zip(building.rooms[:half], building.rooms[half:], strict=True):
        turned = pose.apply(np.pad(other.polygon, ((0, 0), (0, 1))))[:, :2]
        assert shapely.Polygon(turned).symmetric_difference(shapely.Polygon(room.polygon)).area < 1e-6
    assert (places.visited[0] < half).all() and (places.visited[1] >= half).all()
    assert len(set(building.find_components())) == 1 or {r.kind for r in building.rooms} >= {"lift"}


def test_a_plan_mirrored_by_a_point_is_one_building_through_the_joint() -> None:
    draft = Draft(0.1, np.random.default_rng(0))
    corridor = draft.add_box((0.0, 0.0), (10.0, 2.0), "corridor")
    office = draft.add_box((0.0, 2.0), (10.0, 6.0), "office")
    draft.cut(draft.outlines[corridor].intersection(draft.outlines[office]), 0.9, "door", 0.5)
    whole, middle = mirror_by_point(draft.build_plan(3.2, 2.7))
    assert middle == pytest.approx([10.0, 1.0], abs=0.11) and len(whole.rooms) == 4
    building = build_building([whole], EQUAL, 0, "whole")
    assert {frozenset(e) for e in building.list_edges().tolist()} == {frozenset(e) for e in ((0, 1), (2, 3), (0, 2))}


def test_pilasters_stand_along_walls_and_clear_of_doors() -> None:
    plain = room()
    with_some = add_pilasters(plain, 0.5, np.random.default_rng(3))
    added = with_some.things[with_some.things["kind"] == "column"]
    assert len(added) >= 4
    line = shapely.Polygon(plain.rooms[0].polygon).exterior
    for thing in added:
        point = shapely.Point(*thing["centre"][:2])
        assert line.distance(point) == pytest.approx(thing["size"][1] / 2, abs=0.02)
        assert min(np.hypot(*(d["centre"][:2] - thing["centre"][:2])) for d in plain.doors) > 0.5
    one, other = (add_pilasters(plain, 0.5, np.random.default_rng(k)) for k in (3, 4))
    amount = measure_differences(shown(one), shown(other), Sim3())
    assert amount["fitted"] > 0.5 and is_distinguishable(amount)
    assert not is_distinguishable(measure_differences(shown(one), shown(one), Sim3()))
