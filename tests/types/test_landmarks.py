"""Landmarks of a map: tables that hold together, joined and moved."""

import numpy as np
import pytest

from topomerge.types import (
    LANDMARK_DTYPE,
    LANDMARK_KINDS,
    Landmarks,
    Sim3,
    build_landmarks,
    clean_landmarks,
    find_room_names,
    join_landmarks,
    move_landmarks,
    transform_landmarks,
)


def signs(*texts, source="a.csv", **columns):
    return build_landmarks("text", texts, source, np.arange(3.0 * len(texts)).reshape(-1, 3), **columns)


def test_what_is_left_out_is_not_known():
    both = build_landmarks("radio", ["aa", "bb", "aa"], "bag", number=[-60.0, -70, -80])
    assert both.values == ("aa", "bb") and both.table["value"].tolist() == [0, 1, 0]
    assert both.table["room"].tolist() == both.table["storey"].tolist() == both.table["group"].tolist() == [-1] * 3
    assert np.isnan(both.table["position"]).all() and np.isnan(both.table["time"]).all() and (both.table["confidence"] == 1).all()
    assert (
        both.get_values().tolist() == ["aa", "bb", "aa"] and both.is_kind("radio").all() and not both.is_kind("text", "tag").any()
    )


def test_joined_landmarks_count_strings_once():
    joined = join_landmarks([signs("2.113", "WC"), Landmarks(), signs("WC", "2.114", source="b.csv")])
    assert joined.get_values().tolist() == ["2.113", "WC", "WC", "2.114"] and joined.values == ("2.113", "WC", "2.114")
    assert joined.sources == ("a.csv", "b.csv") and joined.table["source"].tolist() == [0, 0, 1, 1]
    assert joined.select(np.array([3])).get_values().tolist() == ["2.114"]
    assert len(join_landmarks([])) == 0


def test_moved_landmarks_come_back():
    pose = Sim3(yaw=2.5, translation=(3.0, -1.0, 0.5))
    moved = move_landmarks(signs("1", "2", sigma=0.2, number=[3.0, -3.0]), pose)
    assert np.allclose(moved.table["position"], pose.apply(np.arange(6.0).reshape(2, 3)))
    assert moved.table["number"] == pytest.approx([5.5 - 2 * np.pi, -0.5]) and moved.table["sigma"] == pytest.approx(0.2)
    back = move_landmarks(moved, pose.inverse()).table
    assert np.allclose(back["position"], np.arange(6.0).reshape(2, 3)) and back["number"] == pytest.approx([3.0, -3.0])
    radio = build_landmarks("radio", ["aa"], "x", number=-60.0)
    assert move_landmarks(radio, pose).table["number"] == -60


@pytest.mark.parametrize(("column", "value"), [("kind", len(LANDMARK_KINDS)), ("value", 1), ("source", -1)])
def test_tables_that_do_not_hold_together_are_refused(column, value):
    table = signs("1").table.copy()
    table[column] = value
    with pytest.raises(ValueError, match=column):
        Landmarks(table, ("1",), ("a.csv",))
    with pytest.raises(ValueError, match="LANDMARK_DTYPE"):
        Landmarks(np.zeros(1, [(n, LANDMARK_DTYPE[n]) for n in ("kind", "value")]))
    with pytest.raises(ValueError, match="smell"):
        build_landmarks("smell", ["x"], "nose")


def test_rooms_are_called_by_their_surest_name_or_number():
    names = build_landmarks("name", ["Lab", "Hall", "?"], "x", room=[0, 0, 5], confidence=[0.4, 0.9, 1.0])
    texts = build_landmarks("text", ["2.1", "EXIT", "2.2", "2.3"], "x", room=[0, 1, 2, 2], confidence=[1.0, 1.0, 0.5, 0.6])
    assert find_room_names(join_landmarks([texts, names]), 4) == ["Hall", "", "2.3", ""]
    assert find_room_names(Landmarks(), 2) == ["", ""] and find_room_names(names, 0) == []


def test_positions_that_are_not_known_are_not_carried():
    at = np.array([[1.0, 2, 3], [np.nan] * 3])
    moved = transform_landmarks(
        build_landmarks("text", ["a", "b"], "x", at, number=[3.0, np.nan], sigma=0.5), lambda p: p + 1, 1.0, 2.0
    )
    assert moved.table["position"][0].tolist() == [2, 3, 4] and np.isnan(moved.table["position"][1]).all()
    assert moved.table["number"][0] == pytest.approx(4.0 - 2 * np.pi) and moved.table["sigma"].tolist() == [1, 1]


def test_cleaned_landmarks_are_left_alone_where_they_are_clean():
    clean = build_landmarks("text", ["2.1", "Küche"], "x", np.ones((2, 3)), sigma=0.5, room=[0, 1])
    again = clean_landmarks(clean)
    assert again.table.tobytes() == clean.table.tobytes() and (again.values, again.sources) == (clean.values, clean.sources)
    assert len(clean_landmarks(build_landmarks("text", [" ", ""], "x"))) == 0
    assert len(clean_landmarks(build_landmarks("pressure", [""], "x", number=1000.0))) == 1


def test_a_landmark_without_a_height_keeps_its_place():
    pose = Sim3(yaw=np.pi / 2, translation=(1.0, 2.0, 3.0))
    flat = build_landmarks("text", ["1", "2"], "x", np.array([[1.0, 0.0, np.nan], [np.nan, 0.0, 1.0]]))
    moved = move_landmarks(flat, pose).table["position"]
    assert moved[0, :2] == pytest.approx([1.0, 3.0]) and np.isnan(moved[0, 2]) and np.isnan(moved[1, 0])
