"""What each room says, in the report: places in their rooms, colours by what they say, pictures that can be read again."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

from tests.fusion.atlas.atlas_scenes import office_map
from topomerge.registration.places import LOOKED, PARTS, SIDE, Crops, Places
from topomerge.viz.merge_plan import lay_out_pair
from topomerge.viz.merge_report import (
    AGAINST,
    FOR,
    SILENT,
    assign_places_to_rooms,
    compute_room_log_odds,
    compute_room_shades,
    describe_log_odds,
    draw_crop,
    encode_png_uri,
    render_places,
)


@pytest.fixture(scope="module")
def map():
    return office_map(0)


def places(at: list[tuple[float, float]], odds: list[float]) -> Places:
    k = len(at)
    parts = np.zeros((k, 2, SIDE, SIDE), np.uint8)
    parts[:, :, :, :8] = 1 << PARTS.index("wall")  # in the south
    middle = np.column_stack([np.array(at), np.zeros(k)])
    crops = Crops(parts, np.zeros_like(parts), np.zeros((k, 2, LOOKED), np.float32), middle, np.full(k, 10.0))
    return Places(crops, np.array(odds))


def test_a_place_is_of_the_room_whose_floor_it_is_on(map):
    rooms = assign_places_to_rooms(map, places([(2.0, 3.0), (9.0, 7.0), (2.5, 4.0), (300.0, 0.0)], [1.0] * 4))
    assert rooms[0] == rooms[2] >= 0 and rooms[1] not in (rooms[0], -1) and rooms[3] == -1


def test_a_room_says_the_mean_of_its_places_and_nothing_without_any():
    found = compute_room_log_odds(places([(0, 0)] * 3, [2.0, -9.0, 1.0]), np.array([1, 1, -1]), 3)
    assert np.isnan(found[[0, 2]]).all() and found[1] == pytest.approx((2 - 4) / 2)
    shades = compute_room_shades(np.array([4.0, -9.0, np.nan, 0.0]))
    assert [s.tolist() for s in shades] == [c.tolist() for c in (FOR, AGAINST, SILENT, SILENT)]


def test_log_odds_in_words():
    assert describe_log_odds(0.3) == "little evidence" and describe_log_odds(2.0) == "7 times as likely the same place"
    assert describe_log_odds(-20.0) == "55 times as likely another place"  # one place never says more


def test_pictures_are_north_up_and_the_same_every_time():
    image = draw_crop(places([(0, 0)], [0.0]).crops.parts[0, 0])
    uri = encode_png_uri(image)
    back = np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))))
    assert (back == image).all() and uri == encode_png_uri(image)
    assert (image[-8:] == image[-1, 0]).all() and (image[0] != image[-1]).any()  # the wall in the south is below


def test_the_section_holds_each_room_with_its_pictures(map):
    section = render_places(
        map, lay_out_pair(map, map, None)[0], places([(2.0, 3.0), (9.0, 7.0), (300.0, 0.0)], [3.0, -3.0, 1.0])
    )
    assert section.count("<img") == 6 and section.count("<details") == 3 and "another place" in section
    assert section.index("outside rooms") < len(section) and 'id="places"' in section
