"""What has changed between two flats that are known: each change once, with its size, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.changes.flats import CABIN, MOVED, TABLE, flat_map
from tests.scenes_map import building
from topomerge.changes.compare import KINDS, Changes, compare_maps
from topomerge.changes.layers import build_storey_layers, estimate_slack
from topomerge.edits.journal import build_edit
from topomerge.errors import InputError
from topomerge.types import Placement, Sim3, TopometricMap

TURNED = Sim3(0.7, (30.0, -12.0, 1.5))


def kinds(old: TopometricMap, new: TopometricMap, **choices: object) -> dict[str, int]:
    return compare_maps(old, new, **choices).count_kinds()  # type: ignore[arg-type]


def only(changes: Changes, kind: str) -> tm.Changes:
    (change,) = [c for c in changes.changes if c.kind == kind]
    return change


def test_identical_maps_give_nothing() -> None:
    assert kinds(flat_map(), flat_map(), least=0.0) == {}


def test_noise_of_two_centimetres_is_no_change() -> None:
    assert kinds(flat_map(), flat_map(noise=0.02)) == {}


@pytest.mark.parametrize("shift", [0.08, *list_longer(0.04)])
def test_a_map_that_lies_a_little_off_has_not_changed(shift: float) -> None:
    found = compare_maps(flat_map(), flat_map(noise=0.01), Placement(Sim3(0.0, (shift, -shift, 0.0))))
    assert found.count_kinds() == {}
    assert found.slack >= 0.12


def test_a_wall_that_was_put_up() -> None:
    found = compare_maps(flat_map(), flat_map(wall=True))
    assert found.count_kinds() == {"wall new": 1, "door new": 1, "room split": 1}
    wall, door = only(found, "wall new"), only(found, "door new")
    assert wall.extent == pytest.approx(4.85, abs=0.15)  # between the faces of the walls that it meets
    assert wall.place[:2] == pytest.approx([4.0, 2.5], abs=0.06) and wall.probability > 0.9
    assert np.ptp(wall.shape, axis=0) == pytest.approx([0.2, 4.85], abs=0.15)
    assert door.extent == pytest.approx(0.9, abs=0.1) and door.place[:2] == pytest.approx([4.0, 2.5], abs=0.1)
    split = only(found, "room split")
    assert len(split.old) == 1 and len(split.new) == 2


def test_a_cabin_in_a_hall_is_a_new_room_and_one_that_was_taken_out_is_gone() -> None:
    found = compare_maps(flat_map(), flat_map(cabin=True))
    assert found.count_kinds() == {"wall new": 2, "door new": 1, "room new": 1}
    room = only(found, "room new")
    assert room.old == () and len(room.new) == 1 and room.extent**2 == pytest.approx((CABIN - 0.15) ** 2, abs=0.8)
    assert room.place[:2] == pytest.approx([CABIN / 2, CABIN / 2], abs=0.2) and room.evidence["seen"] > 0.8
    assert kinds(flat_map(cabin=True), flat_map()) == {"wall gone": 2, "door gone": 1, "room gone": 1}
    assert kinds(flat_map(half=True), flat_map(cabin=True)) == {}, "its ground was not seen before"


def test_of_one_scan_what_was_corrected_is_compared() -> None:
    map = flat_map()
    cut = tm.apply_edits(map, [build_edit("split_room", at=[2.0, 2.5, 0.1], line=[[4.0, -0.2], [4.0, 5.2]])]).map
    cut = tm.apply_edits(cut, [build_edit("delete_door", at=map.edges["centre"][0].tolist())]).map
    placement, reason, _ = tm.align_maps(map, cut)
    assert placement is not None and "one scan" in reason
    found = compare_maps(map, cut, placement)
    assert found.count_kinds() == {"door new": 1, "door gone": 1, "room split": 1}, "a cut leaves an opening"
    assert all(c.probability == 1 and c.evidence == {"corrected": 1.0} for c in found.changes)
    split = only(found, "room split")
    assert len(split.old) == 1 and len(split.new) == 2
    assert kinds(cut, map) == {"door new": 1, "door gone": 1, "room joined": 1}
    with pytest.raises(InputError, match="is the same map"):
        tm.align_maps(map, replace(map, source="copy.tmap"))


@pytest.mark.parametrize("choices", [{"wall": True}, *list_longer({"box": TABLE})])
def test_the_other_way_round_new_is_gone(choices: dict[str, object]) -> None:
    there = {"new": "gone", "gone": "new", "split": "joined", "joined": "split"}
    first = compare_maps(flat_map(), flat_map(**choices))  # type: ignore[arg-type]
    second = compare_maps(flat_map(**choices), flat_map())  # type: ignore[arg-type]
    assert first.changes
    turned = sorted(f"{c.element} {there[c.kind.split(' ')[1]]}" for c in first.changes)
    assert turned == sorted(c.kind for c in second.changes)
    sizes = [sorted((round(c.extent, 1), round(c.probability, 1)) for c in found.changes) for found in (first, second)]
    assert sizes[0] == sizes[1]


def test_what_one_map_did_not_see_is_not_gone() -> None:
    whole = flat_map(wall=True, box=TABLE)
    assert kinds(whole, flat_map(half=True)) == {}
    assert kinds(flat_map(half=True), whole) == {}
    assert kinds(whole, flat_map()) == {"wall gone": 1, "door gone": 1, "room joined": 1, "furniture gone": 1}


@pytest.mark.longer
def test_a_frame_of_its_own_changes_nothing() -> None:
    here = compare_maps(flat_map(), flat_map(wall=True, box=MOVED))
    there = compare_maps(flat_map(), flat_map(frame=TURNED, wall=True, box=MOVED), Placement(TURNED.inverse()))
    both = compare_maps(flat_map(frame=TURNED), flat_map(frame=TURNED, wall=True, box=MOVED))
    assert here.count_kinds() == there.count_kinds() == both.count_kinds()
    for one, other, moved in zip(here.changes, there.changes, both.changes, strict=True):
        assert other.place == pytest.approx(one.place, abs=0.15)
        assert TURNED.inverse().apply(moved.place[None])[0] == pytest.approx(one.place, abs=0.15)
        assert other.extent == pytest.approx(one.extent, abs=0.3) and moved.extent == pytest.approx(one.extent, abs=0.3)


def test_furniture_that_came_and_that_was_moved() -> None:
    found = compare_maps(flat_map(), flat_map(box=TABLE))
    assert found.count_kinds() == {"furniture new": 1}
    thing = only(found, "furniture new")
    assert thing.place[:2] == pytest.approx([2.6, 1.4], abs=0.1) and thing.extent == pytest.approx(1.25, abs=0.15)
    moved = only(compare_maps(flat_map(box=TABLE), flat_map(box=MOVED)), "furniture moved")
    assert moved.from_place[:2] == pytest.approx([2.6, 1.4], abs=0.1)
    assert moved.place[:2] == pytest.approx([5.6, 3.4], abs=0.1)


def test_a_door_that_was_walled_up_and_one_that_was_broken_through() -> None:
    found = only(compare_maps(flat_map(), flat_map(walled_up=True)), "door bricked up")
    assert found.place[:2] == pytest.approx([8.075, 2.0], abs=0.1) and found.old == (0,) and found.new == ()
    assert kinds(flat_map(walled_up=True), flat_map()) == {"door new": 1}


def test_a_leaf_that_was_shut() -> None:
    """The same place filled by a board of 4 cm, flush with one face of the wall."""
    from tests.changes.flats import flat
    from tests.scenes import Scene
    from topomerge.extraction.extract import extract

    leaf = np.concatenate(Scene().box(8.0, 1.55, 0.0, 8.04, 2.45, 2.05).parts)
    shut = extract(np.concatenate([flat(), leaf]))
    assert kinds(flat_map(), shut) == {"door shut": 1}
    assert kinds(shut, flat_map()) == {"door opened": 1}


def test_the_slack_grows_where_walls_do_not_meet() -> None:
    near, far = (build_storey_layers(flat_map(), flat_map(), Placement(Sim3(0.0, (shift, 0.0, 0.0))))[0] for shift in (0.0, 0.2))
    assert float(np.median(far.slack)) > float(np.median(near.slack)) + 0.05
    assert estimate_slack(near.old, near.new).shape == near.old.wall.shape


def test_maps_that_share_no_storey_are_refused() -> None:
    above = Placement(Sim3(0.0, (0.0, 0.0, 40.0)))
    with pytest.raises(InputError, match="shares no storey"):
        compare_maps(flat_map(), flat_map(), above)


def test_storeys_are_told_apart() -> None:
    two = building(1, 2)
    found = compare_maps(two, two)
    assert not found.changes and sorted(found.compared) == [0, 1]


@pytest.mark.longer
def test_aligned_as_in_a_merge() -> None:
    placement, reason, _ = tm.align_maps(flat_map(), flat_map(frame=TURNED, wall=True), threshold=0.0)
    assert placement is not None and reason.startswith("aligned: ")
    at = placement.transform_points(TURNED.apply(np.array([[4.0, 2.5, 0.0]])))[0]
    assert at == pytest.approx([4.0, 2.5, 0.0], abs=0.1)
    refused, why, _ = tm.align_maps(flat_map(), flat_map(frame=TURNED, wall=True), threshold=1.0)
    assert refused is None and why.startswith("not aligned: ")


def test_every_kind_has_an_element() -> None:
    change = compare_maps(flat_map(), flat_map(box=TABLE)).changes[0]
    assert {replace(change, kind=kind).element for kind in KINDS} == {"wall", "door", "room", "furniture", "element"}
