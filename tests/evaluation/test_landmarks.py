"""The table of look-alikes with signs: what counts as wrong and as right."""

import numpy as np
import pytest
from topomerge.datasets.pairs.lookalikes import LookalikeItem

from topomerge.errors import InputError
from topomerge.evaluation import landmarks
from topomerge.evaluation.landmarks import (
    READ_ALONE,
    READINGS,
    RELATIONS,
    Settings,
    draw_sign,
    list_inputs,
    measure,
    measure_building,
    measure_reader,
    measure_wifi,
    read_landmarks,
    spread_belief,
    tabulate,
    tabulate_readers,
)
from topomerge.io import pictures


def row(kind, again, reading, believed, right, landmarks):
    return {"kind": kind, "again": again, "reading": reading, "believed": believed, "right": right, "landmarks": landmarks}


def test_wrong_merges_and_believed_true_pairs_are_counted():
    none, signs = list(READINGS)[:2]
    rows = [
        row("storeys", False, none, True, False, [0, 0]),
        row("storeys", False, signs, False, False, [5, 4]),
        row("modules", False, none, True, False, [0, 0]),
        row("modules", False, signs, True, False, [3, 0]),
        row("storeys", True, none, False, True, [0, 0]),
        row("storeys", True, signs, True, True, [5, 4]),
    ]
    table = tabulate(rows, Settings())["landmarks"]
    assert f"| {none} | 2 | 2 | 15.8 to 100.0 % | 0 | 0 | 1 | 0 | 0 |" in table
    assert f"| {signs} | 2 | 1 | 1.3 to 98.7 % | 1 | 0 | 1 | 1 | 100 |" in table
    assert f"| storeys | {signs} | 1 | 0 |" in table and "tags" not in table


def test_inputs_are_the_items_of_the_split():
    few, more = (list_inputs(Settings(pairs=n, again=0)) for n in (1, 2))
    assert set(few) < set(more) and len(more) == 2 * len(few) == 14


@pytest.mark.longer
def test_signs_alone_are_scored_and_tabulated(tmp_path):
    """One building: places of five relations by three readers; the same bytes again; a wrong ten to one is counted."""
    settings = Settings(cache=str(tmp_path))
    settings.data.set, settings.data.limit = "signs", 1
    assert list_inputs(settings) == ["signs 0"]
    rows = measure(settings, lambda text: None)
    scored = rows[0]["scored"]
    assert len(scored) == 3 * 8 and {relation for _, relation, _ in scored} == {"", *RELATIONS}
    assert measure_building(0, "test") == {"scored": scored} != measure_building(0, "train")
    assert np.mean([odds for _, relation, odds in scored if relation]) > np.mean([odds for _, r, odds in scored if not r])
    assert "nan" not in tabulate(rows, settings)["landmark-odds"]
    wrong = [[name, relation, -5.0 if relation else 5.0] for name in READ_ALONE for relation in ("",) * 4 + (*RELATIONS,)]
    table = tabulate([{"scored": wrong}], settings)["landmark-odds"]
    assert table.count("| 1 | " + " | ".join(["5.007", "1.000"] * 5)) == len(READ_ALONE)


ROOM = LookalikeItem("same-room", 0, 7, "same", ("tls", "tls"), False)


def test_wifi_leaves_less_of_a_look_alike_than_of_one_place():
    """Another room of a row is believed less than the same one."""
    heard = read_landmarks(ROOM, READINGS["WiFi"])
    assert all(len(of) and of.is_kind("radio").all() for of in heard)
    assert [len(of) for of in read_landmarks(ROOM, None)] == [0, 0]
    other, again = measure_wifi(ROOM), measure_wifi(LookalikeItem(*list(vars(ROOM).values())[:-1], again=True))
    assert {w["relation"] for w in other["worlds"]} == {"row"} and {w["relation"] for w in again["worlds"]} == {""}
    assert all(0 <= p <= 1 for row in (other, again) for w in row["worlds"] for p in w["left"])
    assert np.mean([w["left"] for w in other["worlds"]]) < np.mean([w["left"] for w in again["worlds"]])
    assert abs(sum(spread_belief(0.95).values()) - 1) < 1e-9 and spread_belief(0.95)["here"] == 0.95


def test_wifi_is_tabulated_by_how_the_second_place_lies():
    settings = Settings()
    settings.data.set = "wifi"
    world = {"scans": [9, 12]}
    rows = [
        {"kind": "storeys", "again": False, "building": k, "worlds": [{**world, "relation": "storey", "left": [p, 0.1]}] * 2}
        for k, p in enumerate((0.99, 0.2))
    ]
    rows.append({"kind": "storeys", "again": True, "building": 0, "worlds": [{**world, "relation": "", "left": [0.99, 0.9]}]})
    table = tabulate(rows, settings)["landmarks-wifi"]
    assert "| two storeys | 2 | 4 | 9 | 50.0 % | 0.0 to 100.0 % | 0.0 % |" in table
    assert "| one place visited twice | 1 | 1 | 9 | 100.0 %" in table and "two wings" not in table


@pytest.mark.parametrize("height", [10, 40])
def test_a_sign_has_letters_of_the_height_that_is_asked_for(height):
    picture = draw_sign("HHHH", height, 0.0, np.random.default_rng(1))
    assert picture.shape == (480, 640, 3)
    assert np.array_equal(picture, draw_sign("HHHH", height, 0.0, np.random.default_rng(1)))
    grey = picture[..., 0].astype(float)
    plate = np.abs(grey - np.median(grey[:5])) > 25  # what is not wall
    rows, columns = (np.flatnonzero(plate.any(axis=axis)) for axis in (1, 0))
    edge = height // 2  # the letters stand their own height from the edge of the plate
    inside = grey[rows[0] + edge : rows[-1] + 1 - edge, columns[0] + edge : columns[-1] + 1 - edge]
    ink = np.flatnonzero(np.abs(inside - np.median(inside)).max(axis=1) > 60)
    assert 0.8 * height - 2 <= np.ptp(ink) + 1 <= 1.2 * height + 3


@pytest.mark.longer
def test_large_signs_are_read_and_tiny_ones_are_not(monkeypatch):
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    monkeypatch.setattr(landmarks, "HEIGHTS", (3, 26))
    monkeypatch.setattr(landmarks, "ANGLES", (0.0,))
    tiny, large = measure_reader(3)["scored"]
    assert large[2:] == [4, 4, 0, 0, 0] and sum(tiny[4:]) > 0  # E-420, dashes aside


def test_without_a_reader_a_line_says_what_helps(monkeypatch):
    monkeypatch.setattr(landmarks, "load_text_reader", lambda: None)
    monkeypatch.setattr(pictures, "load_text_reader", lambda: None)
    with pytest.raises(InputError, match="data=reader: no reader of texts"):
        measure_reader(0)


def test_errors_of_readers_are_shares_of_the_characters():
    scored = [[26, 0.0, 4, 4, 0, 0, 0], [26, 0.0, 4, 4, 1, 0, 0], [26, 0.0, 4, 0, 0, 0, 4], [26, 0.0, 4, 5, 0, 0, 1]]
    table = tabulate_readers([{"text": "E-420", "scored": scored}])
    assert "| 26 | 0° | 4 | 1 | 1 | 0.01–0.81 | 0.167 | 50 % | 50 % |" in table  # 2 of the 12 characters of three signs
    assert "| 6 | 0° | 0 | 0 | 0 |" not in table
