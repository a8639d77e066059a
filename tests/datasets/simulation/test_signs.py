"""Signs of simulated buildings, and what readers make of them."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.lookalikes import LOOKALIKES, LookalikeRecipe, draw_lookalike_items, read_lookalike_signs
from topomerge.datasets.simulation.signs import (
    STYLES,
    UNNUMBERED,
    Numbering,
    Reader,
    change_signs,
    draw_numbering,
    draw_other_numbering,
    misread,
    number_rooms,
    place_signs,
    read_signs,
)

from topomerge.types import Sim3

PLAIN = Numbering(STYLES[0], storey=2, first=10)
EXACT = Reader(("text", "tag", "name"), 1.0, 0.0, 0.0, 0.0)


@cache
def build_office() -> Building:
    """The building of these tests."""
    return make_building("office", 11, 2)


def test_rooms_are_numbered_once_storey_by_storey():
    texts = number_rooms(build_office(), PLAIN)
    numbered = {k: t for k, t in texts.items() if t != "WC"}
    assert len(set(numbered.values())) == len(numbered) > 5
    for k, text in numbered.items():
        room = build_office().rooms[k]
        assert room.kind not in UNNUMBERED and re.fullmatch(rf"{2 + room.storey}\.0\d\d", text), (room.kind, text)


def test_sides_are_odd_and_even():
    texts = number_rooms(build_office(), replace(PLAIN, sides=True))
    middles = np.array([r.polygon.mean(axis=0) for r in build_office().rooms])
    axis = int(np.argmax(np.ptp(middles, axis=0)))
    first = [k for k, r in enumerate(build_office().rooms) if r.storey == 0]
    across = np.median(middles[first, 1 - axis])
    parities = {(middles[k, 1 - axis] > across): int(t[-1]) % 2 for k, t in texts.items() if k in first and t != "WC"}
    assert parities == {False: 0, True: 1}


def test_signs_hang_beside_doors_on_the_side_that_one_comes_from():
    signs = place_signs(build_office(), PLAIN, np.random.default_rng(0))
    texts = number_rooms(build_office(), PLAIN)
    of_rooms = [s for s in signs if s["kind"] == "text" and texts.get(int(s["of"])) == s["text"]]
    assert len(of_rooms) > 5
    for s in of_rooms:
        door = min(build_office().doors, key=lambda d: np.linalg.norm(d["centre"] - s["at"]))
        assert {int(s["of"]), int(s["room"])} <= set(door["rooms"].tolist())
        assert np.hypot(*(s["at"] - door["centre"])[:2]) < door["width"] / 2 + 0.6
        away = s["at"][:2] - door["centre"][:2]
        assert away @ (np.cos(s["heading"]), np.sin(s["heading"])) > 0  # it faces away from its wall


def test_the_same_seed_gives_the_same_signs():
    one, other = (place_signs(build_office(), PLAIN, np.random.default_rng(3)) for _ in range(2))
    assert one.tobytes() == other.tobytes() and set(one["kind"]) == {"text", "tag", "name"}


def test_an_exact_reader_gives_every_sign_of_the_visited_rooms_in_the_frame_of_the_map():
    signs = place_signs(build_office(), PLAIN, np.random.default_rng(0))
    frame = Sim3(1.2, (5.0, 6.0, 0.5))
    read = read_signs(signs, [0, 1, 2], frame, EXACT, np.random.default_rng(0))
    there = signs[np.isin(signs["room"], [0, 1, 2])]
    assert sorted(read.get_values().tolist()) == sorted(there["text"].tolist())
    assert np.allclose(np.sort(read.table["position"], axis=0), np.sort(frame.apply(there["at"]), axis=0))
    assert (read.table["confidence"] == 1).all()


def test_readers_err_as_often_as_they_are_asked_to():
    rng = np.random.default_rng(0)
    read = [misread("2.113", 0.2, rng) for _ in range(2000)]
    right = np.mean([t == "2.113" for t in read])
    assert 0.25 < right < 0.4 and len(set(read)) > 100  # .8 ** 5 is .33
    assert misread("2.113", 0.0, rng) == "2.113" and all(read)
    signs = place_signs(build_office(), PLAIN, rng)
    every = range(len(build_office().rooms))
    some = [len(read_signs(signs, every, Sim3(), Reader(reads=0.5), rng)) for _ in range(40)]
    assert np.mean(some) == pytest.approx(0.5 * (signs["kind"] == "text").sum(), rel=0.15)


def test_other_places_have_other_numbers():
    rng = np.random.default_rng(1)
    for style in STYLES:
        one = replace(PLAIN, style=style)
        for relation in ("storey", "wing", "row"):
            other = draw_other_numbering(one, relation, rng)
            mine, theirs = (number_rooms(build_office(), n) for n in (one, other))
            assert any(mine[k] != theirs[k] for k in mine if mine[k] != "WC"), (style, relation)
    assert draw_other_numbering(PLAIN, "storey", rng).storey > PLAIN.storey
    assert len({draw_numbering(rng) for _ in range(20)}) > 10


def test_few_signs_change():
    signs = np.repeat(place_signs(build_office(), PLAIN, np.random.default_rng(0)), 50)
    changed = change_signs(signs, np.random.default_rng(0))
    text = signs["kind"] == "text"
    assert 0.01 < (changed["text"] != signs["text"])[text].mean() < 0.03 and (changed["text"] == signs["text"])[~text].all()


@pytest.mark.longer
def test_signs_of_lookalikes_are_those_of_their_places():
    items = draw_lookalike_items(
        LookalikeRecipe(pairs=dict.fromkeys(LOOKALIKES, 1), again=dict.fromkeys(LOOKALIKES, 1), scaled=0.0)
    )
    exact = Reader(("text",), 1.0, 0.0, 0.05, 0.0)
    for item in items:
        if item.kind not in ("storeys", "hotel-corridors"):
            continue
        one, other = read_lookalike_signs(item, exact)
        shared = set(one.get_values()) & set(other.get_values()) - {"WC", "EXIT", "Notausgang", "Sortie", "Salida"}
        assert (len(shared) > 0.8 * len(set(one.get_values())) - 3) == item.again, item
        again = read_lookalike_signs(item, exact)
        assert again[0].table.tobytes() == one.table.tobytes() and again[1].values == other.values
