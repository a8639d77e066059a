"""Text of signs: what readers confuse, and how rare a string is."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from topomerge.landmarks.text import (
    ALIKE_CHARACTERS,
    ALIKE_SHARE,
    ALPHABET,
    RAREST,
    SUBSTITUTED,
    apply_shift,
    count_edits,
    estimate_share,
    find_shifts,
    fold_text,
    is_number,
    quote_text,
    score_neighbour,
    score_reading,
    score_shifted,
)

WORDS = st.text("0123456789abcOIlSBZ.- ", max_size=8)


@pytest.mark.parametrize(
    ("one", "other"), [("2.113", "Z.ll3"), ("O-105", "0 1o5"), ("Büro", "BURO"), ("58", "SB"), ("2.113", "2113")]
)
def test_shapes_that_readers_take_for_one_are_one(one, other):
    assert fold_text(one) == fold_text(other)


def test_other_characters_are_not():
    assert len({fold_text(t) for t in ("2.113", "2.114", "3.113", "A113", "H113")}) == 5


@pytest.mark.parametrize(
    ("one", "other", "edits"),
    [
        ("2113", "2113", (0, 0, 0)),
        ("2113", "2173", (1, 0, 0)),
        ("2113", "2153", (0, 1, 0)),
        ("2113", "213", (0, 0, 1)),
        ("", "abc", (0, 0, 3)),
    ],
)
def test_edits_by_hand(one, other, edits):
    assert count_edits(one, other) == edits


def test_reading_by_hand():
    assert score_reading("2113", "2113", 0.05) == pytest.approx(0.9**4)
    assert score_reading("2113", "2153", 0.05) == pytest.approx(0.9**3 * 0.1 * SUBSTITUTED * (1 - ALIKE_SHARE) / ALPHABET)
    assert score_reading("2113", "2173", 0.05) == pytest.approx(0.9**3 * 0.1 * SUBSTITUTED * ALIKE_SHARE / ALIKE_CHARACTERS)
    assert score_reading("2113", "113", 0.0) == pytest.approx(0.02)  # cut off


@given(WORDS, WORDS, st.floats(0.0, 0.4))
def test_reading_is_a_probability_in_any_order(one, other, error):
    one, other = fold_text(one), fold_text(other)
    read = score_reading(one, other, error)
    assert 0 <= read <= 1 and read == pytest.approx(score_reading(other, one, error))
    assert read <= score_reading(one, one, error) + 1e-12 or len(one) > len(other)


def test_what_stands_everywhere_is_common_and_numbers_are_rare():
    for text in ("EXIT", "Notausgang", "WC", "2. OG", "Level 3", "sortie de secours", "Staff only", "Herren", "Küche"):
        assert estimate_share(text) >= 0.02, text
    for text in ("2.113", "A-1204", "Dr. Meierhofer", "Frege Archive"):
        assert RAREST <= estimate_share(text) <= 1 / 500, text
    assert estimate_share("2.113") < estimate_share("113") < estimate_share("13") < estimate_share("3")


def test_numbers_are_told_from_words():
    assert all(is_number(t) for t in ("2.113", "A-113", "101", "IOI", "Z.1l3", "12b"))
    assert not any(is_number(t) for t in ("EXIT", "Kitchen", "", "--", "Dr. Meier", "Sali0a", "BKI7"))


@pytest.mark.parametrize(
    ("one", "other", "shift"),
    [
        ("2113", "3113", ("change", 0, "2>3")),
        ("a113", "h113", ("change", 0, "a>h")),
        ("2113", "2117", ("count", 4, "")),
        ("2109", "2110", ("count", 1, "")),
    ],
)
def test_shifts_turn_the_one_into_the_other(one, other, shift):
    assert shift in find_shifts(one, other)
    assert all(
        apply_shift(one, s) == other for s in find_shifts(one, other) if s[0] == "count" or len(find_shifts(one, other)) < 3
    )


def test_shifts_that_do_not_apply():
    assert apply_shift("4113", ("change", 0, "2>3")) is None and apply_shift("k", ("count", 2, "")) is None
    assert apply_shift("1", ("count", -5, "")) is None and apply_shift("007", ("count", 2, "")) == "009"


def test_a_shift_is_scored_from_both_ends():
    shift = ("change", 0, "2>3")
    assert score_shifted("2113", "3113", shift, 0.05) == score_reading("2113", "2113", 0.05)
    assert score_shifted("4113", "5113", shift, 0.05) == 0
    assert score_shifted("2113", "2113", shift, 0.05) == score_reading("3113", "2113", 0.05)
    assert score_shifted("113", "3113", shift, 0.05) == score_reading("113", "2113", 0.05)  # the storey is cut off
    assert score_shifted("2109", "2111", ("count", 2, ""), 0.05) == score_shifted("2111", "2109", ("count", -2, ""), 0.05)


def test_neighbours_are_numbers_with_a_digit_changed():
    assert score_neighbour("2113", "2114") == pytest.approx(0.4 / 36)
    assert score_neighbour("2113", "2124") == pytest.approx(0.3 / (81 * 6))
    assert score_neighbour("2113", "2113") == score_neighbour("2113", "113") == score_neighbour("2113", "9874") == 0


def test_quoted_text_is_one_line_without_control_characters():
    assert quote_text("2.1\x1b[31m13\n\tb") == "2.1 [31m13 b"
    assert len(quote_text("x" * 500)) == 24
