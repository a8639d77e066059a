"""Maps of vacuum robots written moved and joined, as maps of Valetudo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.io.test_native import BENT, TILTED, move
from tests.io.test_read_valetudo import rr_file, rr_pixels, saved, two_rooms
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.native import NATIVE, Motion, Source, find_format, plan_outputs, save_joined
from topomerge.io.valetudo import RobotMap, parse_robot_map
from topomerge.types import Sim3, transform_points

MIDDLE = np.array([12.5, -10.5])  # m, of the two rooms
ENTITIES = [
    {"__class": "PointMapEntity", "type": "robot_position", "points": [1150, 1050], "metaData": {"angle": 90}},
    {"__class": "PointMapEntity", "type": "charger_location", "points": [1110, 1010], "metaData": {}},
    {"__class": "PolygonMapEntity", "type": "no_go_area", "points": [1110, 1010, 1150, 1010, 1150, 1050, 1110, 1050]},
]


def turn(degrees: float, right: float = 0.0, up: float = 0.0) -> Motion:
    """A turn about the middle of the rooms, and a way on from there."""
    there = Sim3(np.radians(degrees), (0, 0, 0)).apply(np.array([[*MIDDLE, 0.0]]))[0]
    return Motion(Sim3(np.radians(degrees), (MIDDLE[0] - there[0] + right, MIDDLE[1] - there[1] + up, 0)).matrix)


def home(path: Path, names: tuple[str, str] = ("Bath", ""), **values: Any) -> Path:
    about = two_rooms(entities=ENTITIES, size={"x": 5120, "y": 5120}, **values)
    for layer, name in zip(about["layers"], names, strict=False):
        layer["metaData"]["name"] = name
    path.write_text(json.dumps(about))
    return path


def load(path: Path) -> tuple[dict[str, Any], RobotMap]:
    about = json.loads(path.read_text())
    return about, parse_robot_map(path, about)


def test_a_map_that_stays_is_copied_and_one_that_moves_by_pixels_is_equal(tmp_path: Path) -> None:
    source, target = home(tmp_path / "a.json"), tmp_path / "b.json"
    move(source, target, Motion())
    assert target.read_bytes() == source.read_bytes()
    tally = move(source, target, Motion(Sim3(0.0, (0.5, -0.3, 0)).matrix))
    assert tally.counts["rooms"] == (2, 2) and tally.counts["entities"] == (3, 3) and not tally.warnings
    (about, moved), (_, before) = load(target), load(source)
    for name in ("walls", "free", "rooms"):
        low = getattr(moved, name)
        filled = np.argwhere(moved.walls | moved.free)
        (top, left), (end, right) = filled.min(axis=0), filled.max(axis=0) + 1
        np.testing.assert_array_equal(low[top:end, left:right], getattr(before, name))
    assert moved.names == before.names and about["entities"][1]["points"] == [1160, 1040]


def test_what_valetudo_states_of_layers(tmp_path: Path) -> None:
    """Runs, middles and areas; the sizes that its interface asks for."""
    move(home(tmp_path / "a.json"), tmp_path / "b.json", turn(30))
    about, drawn = load(tmp_path / "b.json")
    assert about["metaData"]["version"] == 2 and about["pixelSize"] == 10 and about["size"] == {"x": 5120, "y": 5120}
    kinds = [layer["type"] for layer in about["layers"]]
    assert kinds == ["floor", "wall", "segment", "segment"]
    assert about["metaData"]["totalLayerArea"] == sum(layer["metaData"]["area"] for layer in about["layers"])
    bath = about["layers"][2]
    assert bath["metaData"]["name"] == "Bath" and bath["metaData"]["segmentId"] == "1"
    row = np.nonzero(np.flipud(drawn.rooms == 1))[0]
    low = -round(drawn.origin[1] / drawn.resolution) - drawn.rooms.shape[0]
    assert bath["dimensions"]["pixelCount"] == len(row) == sum(bath["compressedPixels"][2::3])
    assert bath["dimensions"]["y"]["min"] == low + row.min() and bath["dimensions"]["y"]["avg"] == round(low + row.mean())
    assert abs(len(row) - 100) <= 5  # 1 m2, turned


def test_places_are_moved_to_half_a_pixel_and_entities_to_half_a_centimetre(tmp_path: Path) -> None:
    from scipy.spatial import cKDTree

    motion = turn(30, 1.23, 0.4)
    source, target = home(tmp_path / "a.json"), tmp_path / "b.json"
    move(source, target, motion)
    before, after = (read_points(path).points[:, :2].astype(float) for path in (source, target))
    expected = transform_points(motion.matrix, np.column_stack([before, np.zeros(len(before))]))[:, :2]
    assert cKDTree(after).query(expected)[0].max() < 0.15 and cKDTree(expected).query(after)[0].max() <= 0.0708
    about, _ = load(target)
    robot = about["entities"][0]
    place = motion.matrix[:2, :2] @ (11.5, -10.5) + motion.matrix[:2, 3]
    np.testing.assert_allclose(np.array(robot["points"]) * (0.01, -0.01), place, atol=0.00501)
    assert robot["metaData"]["angle"] == 60  # clockwise


def test_two_maps_of_one_home_become_one(tmp_path: Path) -> None:
    """Rooms that both show are one, with the name that either has; what only the second shows is filled in."""
    a = home(tmp_path / "a.json")
    a_about = json.loads(a.read_text())
    a_about["layers"][1]["pixels"] = a_about["layers"][1]["pixels"][:160]  # 80 of the 100 pixels of the right room
    a.write_text(json.dumps(a_about))
    b = home(tmp_path / "b.json", ("Bathroom", "Kitchen"))
    tally = save_joined(NATIVE["robot_map"], [Source(a), Source(b, turn(0, 0.02, 0.01))], tmp_path / "c.json")
    assert tally.counts == {"rooms": (4, 2), "rooms that are one": (2, 2), "names": (3, 2), "entities": (6, 3)}
    _, drawn = load(tmp_path / "c.json")
    assert drawn.names == ("Bath", "Kitchen") and np.bincount(drawn.rooms.ravel())[1:].tolist() == [100, 100]
    np.testing.assert_array_equal(drawn.walls.sum(), load(a)[1].walls.sum())


def test_rooms_apart_get_numbers_of_their_own(tmp_path: Path) -> None:
    a, b = home(tmp_path / "a.json"), home(tmp_path / "b.json", ("Bath", "Kitchen"))
    save_joined(NATIVE["robot_map"], [Source(a), Source(b, turn(90, 0, -3.0))], tmp_path / "c.json")
    about, drawn = load(tmp_path / "c.json")
    assert drawn.names == ("Bath", "", "Bath", "Kitchen") and np.bincount(drawn.rooms.ravel()).tolist()[1:] == [100] * 4
    numbers = [layer["metaData"]["segmentId"] for layer in about["layers"] if layer["type"] == "segment"]
    assert sorted(numbers) == ["1", "2", "3", "4"] and len(about["entities"]) == 6


def test_a_map_beyond_its_corner_is_shifted_and_says_so(tmp_path: Path) -> None:
    tally = move(home(tmp_path / "a.json"), tmp_path / "b.json", turn(0, -20.0, 20.0))
    assert "begins beyond its corner, so that all is 910 cm further right and 1010 cm further down" in tally.warnings[0]
    about, _ = load(tmp_path / "b.json")
    assert min(n for layer in about["layers"] for n in layer["compressedPixels"]) >= 0
    assert about["entities"][0]["points"] == [1150 - 2000 + 910, 1050 - 2000 + 1010]


def test_a_bent_map_bends_its_pixels(tmp_path: Path) -> None:
    from scipy.spatial import cKDTree

    source, target = home(tmp_path / "a.json"), tmp_path / "b.json"
    tally = move(source, target, BENT)
    right, down = (int(w) / 100 for w in tally.warnings[0].split() if w.lstrip("-").isdigit()) if tally.warnings else (0, 0)
    before, after = (read_points(path).points[:, :2].astype(float) for path in (source, target))
    expected = BENT.move_points(np.column_stack([before, np.zeros(len(before))]))[:, :2] + (right, -down)
    assert cKDTree(after).query(expected)[0].max() < 0.2


def test_roborock_and_valetudo_re_become_maps_of_valetudo(tmp_path: Path) -> None:
    source = rr_file(tmp_path / "home.rr", rr_pixels())
    ((target, form, _),) = plan_outputs([Source(source)], tmp_path)
    assert target.name == "home_moved.json"
    tally = save_joined(form, [Source(source)], target)
    assert tally.counts["rooms"] == (2, 2) and "becomes a map of Valetudo" in tally.warnings[0]
    before, after = (read_points(path).points.astype(float) for path in (source, target))
    np.testing.assert_allclose(np.unique(after, axis=0), np.unique(before - (0, 51.2, 0), axis=0), atol=1e-5)
    both = save_joined(form, [Source(home(tmp_path / "a.json")), Source(source, Motion(Sim3(0.1, (-14, -36, 0)).matrix))], target)
    assert both.counts["rooms"] == (4, 4)


def test_refusals(tmp_path: Path) -> None:
    good = home(tmp_path / "a.json")
    with pytest.raises(InputError, match="its map is tilted"):
        move(good, tmp_path / "out.json", TILTED)
    for values, told in (
        ({"entities": [{"type": "path"}]}, "an entity without points"),
        ({"entities": [{"points": [1e30, 5]}]}, "outside of any map"),
        ({"metaData": 3}, "damaged"),
        ({"layers": 7}, "no layers"),
    ):
        with pytest.raises(InputError, match=told) as caught:
            move(saved(tmp_path, two_rooms(**values)), tmp_path / "out.json", turn(3))
        assert "\n" not in str(caught.value) and not (tmp_path / "out.json").exists()
    with pytest.raises(InputError, match="lies so far off"):
        save_joined(NATIVE["robot_map"], [Source(good), Source(good, turn(0, 1e5, 1e5))], tmp_path / "out.json")
    assert find_format(saved(tmp_path, {"rooms": []})) is None
