"""Landmarks of joined maps: what two saw is one, what differs stays, what contradicts is told, and millions take seconds."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes_map import building
from topomerge.extraction.landmarks import assign_landmarks
from topomerge.landmarks.fuse import LandmarkSummary, fuse_landmarks
from topomerge.types import LANDMARK_KINDS, Landmarks, TopometricMap, build_landmarks, join_landmarks

HOME = building(1, 1)  # rooms 0 and 1 with one door each to the corridor 2
AT_0, AT_1, AT_2 = (tuple(middle) for middle in HOME.rooms["centroid"].tolist())


def seen(kind: str, *values: str, at: tuple[float, float, float] | None = None, **columns: float) -> Landmarks:
    position = None if at is None else np.tile(np.asarray(at, float), (len(values), 1))
    return assign_landmarks(HOME, build_landmarks(kind, list(values), "here", position, **columns))


def fuse(*parts: Landmarks, joined: TopometricMap = HOME) -> tuple[list[str], LandmarkSummary, Landmarks]:
    out, summary = fuse_landmarks(parts, joined)
    assert summary.joined == len(out) and sum(summary.maps) - summary.fused == summary.joined
    return sorted(out.get_values().tolist()), summary, out


def shifted(at: tuple[float, float, float], x: float) -> tuple[float, float, float]:
    return at[0] + x, at[1], at[2]


def test_one_sign_seen_twice_is_one_where_the_surer_sighting_says() -> None:
    a = seen("text", "2.113", at=AT_0, sigma=0.1, confidence=0.5, number=np.nan, time=5.0)
    b = seen("text", "2.113", at=shifted(AT_0, 1.0), sigma=0.3, confidence=0.8, number=1.0)
    names, summary, out = fuse(a, b)
    assert names == ["2.113"] and (summary.maps, summary.fused) == ((1, 1), 1) and not summary.contradictions
    row = out.table[0]
    assert row["position"][0] == pytest.approx(AT_0[0] + 0.1)
    assert row["sigma"] == pytest.approx((1 / 0.1**2 + 1 / 0.3**2) ** -0.5)
    assert row["confidence"] == pytest.approx(0.9) and (row["number"], row["time"]) == (1.0, 5.0)
    assert np.isnan(fuse(seen("text", "1", at=AT_0), seen("text", "1", at=AT_0))[2].table["sigma"][0])


@pytest.mark.parametrize(
    ("a", "b", "count"),
    [
        (seen("text", "Room A", at=AT_0), seen("text", "room  a", at=AT_0), 1),  # case and blanks do not count
        (seen("text", "1", at=AT_0), seen("text", "1", at=shifted(AT_0, 1.4)), 1),
        (seen("text", "1", at=AT_2), seen("text", "1", at=shifted(AT_2, 1.6)), 2),
        (seen("text", "1", at=AT_0), seen("tag", "1", at=AT_0), 2),
        (seen("text", "1", at=AT_0), seen("text", "2", at=AT_0), 2),
        (seen("name", "lab", at=AT_0), seen("name", "lab", at=shifted(AT_0, 1.9)), 1),  # a room has a name once
        (seen("name", "lab", room=0), seen("name", "lab", room=1), 2),
        (seen("text", "1", room=0), seen("text", "1", at=AT_0), 1),  # by hand, and read by a robot
        (seen("text", "1", at=AT_0), seen("text", "1", room=0), 1),
        (seen("text", "1", room=0), seen("text", "1", room=0), 1),
        (seen("text", "1"), seen("text", "1"), 2),  # nobody knows where
        (seen("radio", "aa", at=AT_0, number=-60.0), seen("radio", "aa", at=AT_0, number=-60.0), 2),
        (seen("pressure", "", at=AT_0, number=1013.0), seen("pressure", "", at=AT_0, number=1013.0), 2),
    ],
)
def test_what_is_one(a: Landmarks, b: Landmarks, count: int) -> None:
    for parts in ((a, b), (b, a), (Landmarks(), a, b), (a, Landmarks(), b)):
        names, summary, out = fuse(*parts)
        assert len(names) == count and summary.fused == 2 - count
        assert (out.table["room"] >= 0).all() or count == 2


def test_six_chairs_are_six_chairs() -> None:
    angle = np.arange(6) * np.pi / 3
    ring = AT_0 + 0.6 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    a = assign_landmarks(HOME, build_landmarks("object", ["chair"] * 6, "a", ring))
    b = assign_landmarks(HOME, build_landmarks("object", ["chair"] * 6, "b", ring + (0.1, 0.05, 0.0)))
    names, summary, out = fuse(a, b)
    assert names == ["chair"] * 6 and summary.fused == 6
    assert np.abs(np.sort(out.table["position"][:, 0]) - np.sort(ring[:, 0] + 0.05)).max() < 1e-9
    assert len(fuse(a, Landmarks())[0]) == 6


def test_three_maps_and_the_order_of_rows() -> None:
    parts = [join_landmarks([seen("text", "1", at=AT_0), seen("object", "sofa", at=AT_1)]), seen("object", "sofa", at=AT_1)]
    names, summary, _ = fuse(*parts, seen("text", "1", at=AT_0))
    assert names == ["1", "sofa"] and summary.maps == (2, 1, 1) and summary.fused == 2


def test_a_number_is_one_however_its_characters_were_read() -> None:
    """O for 0, S for 5, other dots: no contradiction, and what was read more surely stands; 1 for 7 is another number."""
    a = seen("text", "O.1Z5", at=AT_0, confidence=0.6)
    for b in (seen("text", "0.125", at=AT_0, confidence=0.8), seen("text", "0-12S", at=AT_0, confidence=0.8)):
        names, summary, _ = fuse(a, b)
        assert names == b.get_values().tolist() and summary.fused == 1 and summary.contradicting == 0
        assert fuse(b, a)[0] == names
    assert fuse(a, seen("text", "0.725", at=AT_0))[1].contradicting == 1
    assert (
        len(fuse(seen("tag", "t5", at=AT_0), seen("tag", "ts", at=AT_0))[0]) == 2
        and len(fuse(a, seen("object", "0125", at=AT_0))[0]) == 2
    )


def what(summary: LandmarkSummary) -> list[tuple[str, list[str], list[int], int | None]]:
    return [(c["what"], c["values"], c["maps"], c["room"]) for c in summary.contradictions]


def test_two_numbers_of_one_door_or_room_stay_and_are_told() -> None:
    door = HOME.edges["centre"][0] + (0.6, 0.2, 1.5)
    a, b = seen("text", "2.113", at=tuple(door)), seen("text", "2.115", at=shifted(tuple(door), 0.3))
    names, summary, _ = fuse(a, b)
    assert names == ["2.113", "2.115"] and what(summary) == [("number", ["2.113", "2.115"], [0, 1], 0)]
    assert summary.describe_contradictions(["a.ply", "b.ply"]) == (
        "landmarks contradict each other: room 0 is 2.113 in a.ply and 2.115 in b.ply"
    )
    assert what(fuse(seen("name", "2.113", room=2), seen("text", "2.115", room=2))[1]), "a room has one name"
    assert what(fuse(seen("text", "113", at=shifted(AT_0, -1.5)), seen("text", "115", at=shifted(AT_0, 1.5)))[1]), (
        "it has one door"
    )


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (seen("text", "EXIT", at=AT_0), seen("text", "WC", at=AT_0)),  # no numbers
        (seen("name", "Küche", room=0), seen("name", "kitchen", room=0)),
        (seen("text", "2.113", at=AT_0), seen("text", "2.115", at=AT_0, confidence=0.3)),  # perhaps misread
        (seen("text", "2.113", at=AT_0), seen("text", "2.115", at=AT_1)),
        (seen("text", "2.113", at=AT_0), seen("text", "2.11", at=AT_0)),  # an end was not read
        (seen("text", "2.113", at=AT_0), seen("text", "O.113", at=AT_0, confidence=0.4)),
        (seen("text", "118", at=AT_0), seen("text", "18", at=AT_0)),
        (seen("text", "2.113", at=shifted(AT_2, -1.4)), seen("text", "2.115", at=shifted(AT_2, 1.4))),  # a corridor has many
        (seen("text", "2.113", "2.115", at=AT_0), seen("text", "2.115", at=AT_0)),  # two doors
        (seen("name", "2.113", room=0), seen("text", "2.113", at=AT_0)),
        (seen("text", "2.113", "2.115", at=AT_0), Landmarks()),  # what one map says is its own matter
    ],
)
def test_what_is_no_contradiction(a: Landmarks, b: Landmarks) -> None:
    for parts in ((a, b), (b, a)):
        assert fuse(*parts)[1].contradicting == 0


def test_a_tag_in_two_places_is_told() -> None:
    a, b = seen("tag", "tag36h11:5", at=AT_0), seen("tag", "tag36h11:5", at=AT_1)
    names, summary, _ = fuse(a, b)
    apart = float(np.linalg.norm(np.subtract(AT_0, AT_1)))
    assert len(names) == 2 and what(summary) == [("tag", ["tag36h11:5"] * 2, [0, 1], 1)]
    assert summary.contradictions[0]["apart_m"] == round(apart, 2)
    assert f"tag tag36h11:5 is {apart:.1f} m apart in a and b" in summary.describe_contradictions(["a", "b"])
    assert fuse(a, seen("tag", "tag36h11:5", at=shifted(AT_0, 0.5)))[1].contradicting == 0


def test_all_rooms_101_are_no_quarrel_and_many_contradictions_are_counted() -> None:
    everywhere = join_landmarks([seen("text", "101", at=at) for at in (AT_0, AT_1, AT_2)])
    names, summary, _ = fuse(everywhere, everywhere)
    assert names == ["101"] * 3 and summary.contradicting == 0
    tags = [seen("tag", *(f"t{k}" for k in range(500)), at=at) for at in (AT_0, AT_1)]
    summary = fuse(*tags)[1]
    assert (summary.contradicting, len(summary.contradictions)) == (500, 100)
    assert summary.describe_contradictions(["a", "b"]).endswith("; and 497 more")


@pytest.mark.longer
@pytest.mark.parametrize("many", [50_000, pytest.param(250_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("hostile", ["spread", "one place", "one string"])
def test_many_landmarks_need_no_pairs(hostile: str, many: int) -> None:
    """Each pair of equal ones would be 10^9 of them."""
    random = np.random.default_rng(0)
    table = build_landmarks("text", ["x"], "a").table.repeat(many)
    position = random.uniform(0, 500, (many, 3)) if hostile == "spread" else np.zeros((many, 3))
    if hostile == "one string":
        position = random.uniform(0, 3, (many, 3))
    table["position"], table["kind"] = position, LANDMARK_KINDS.index("text")
    values = ("x",) if hostile == "one string" else tuple(f"2.{k}" for k in range(many))
    table["value"] = np.arange(many) % len(values)
    table["room"] = 0
    part = Landmarks(table, values, ("a",))
    _, summary, _ = fuse(part, part, part, part)
    assert summary.maps == (many,) * 4
    assert summary.joined == many if hostile != "one string" else summary.joined >= many
