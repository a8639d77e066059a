"""Maps of vacuum robots: layers, frames, maps without walls, damage."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import topomerge as tm
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.valetudo import parse_roborock_map, parse_robot_map

LEFT, RIGHT = (110, 120), (131, 141)  # columns of two rooms of 1 m in pixels of 10 cm; a wall between, open at rows 103 to 106
ROWS = (100, 110)


def run(first: tuple[int, int], row: int) -> list[int]:
    return [first[0], row, first[1] - first[0]]


def two_rooms(walls: bool = True, **values: Any) -> dict[str, Any]:
    """Two rooms of 1 m by 1 m, 1.1 m apart, as Valetudo writes them: compressed and plain pixels."""
    left = [n for row in range(*ROWS) for n in run(LEFT, row)]
    right = [n for row in range(*ROWS) for column in range(*RIGHT) for n in (column, row)]
    door = [n for row in range(103, 107) for n in run((LEFT[1], RIGHT[0]), row)]
    wall = [n for c in range(LEFT[0] - 1, RIGHT[1] + 1) for r in (ROWS[0] - 1, ROWS[1]) for n in (c, r)]
    wall += [n for r in range(*ROWS) for c in (LEFT[0] - 1, RIGHT[1]) for n in (c, r)]
    wall += [n for r in (*range(ROWS[0], 103), *range(107, ROWS[1])) for c in (LEFT[1], RIGHT[0] - 1) for n in (c, r)]
    layers = [
        {"type": "segment", "metaData": {"segmentId": "1", "name": "Bath"}, "compressedPixels": left},
        {"type": "segment", "metaData": {"segmentId": "2"}, "pixels": right},
        {"type": "floor", "metaData": {}, "compressedPixels": door},
    ]
    layers += [{"type": "wall", "metaData": {}, "pixels": wall}] if walls else []
    return {"__class": "ValetudoMap", "metaData": {"version": 2}, "pixelSize": 10, "layers": layers, "entities": []} | values


def saved(folder: Path, about: object) -> Path:
    path = folder / "home.json"
    path.write_text(about if isinstance(about, str) else json.dumps(about))
    return path


def test_walls_and_floor_stand_where_the_robot_drew_them(tmp_path: Path) -> None:
    cloud = read_points(saved(tmp_path, two_rooms()))
    cloud.points[:, :2] += (-0.1 * (LEFT[0] - 1), 0.1 * (ROWS[1] + 1))
    tall = cloud.points[cloud.points[:, 2] > 0]
    floor = cloud.points[cloud.points[:, 2] == 0]
    assert np.allclose(tall.min(axis=0)[:2], 0.05) and np.allclose(tall.max(axis=0)[:2], (3.25, 1.15))  # cells' middles
    inside = (floor[:, 0] > 0.1) & (floor[:, 0] < 1.1) & (floor[:, 1] > 0.1) & (floor[:, 1] < 1.1)
    assert inside.sum() == 100
    assert np.isclose(tall[:, 2].max(), 2.5) and not cloud.warnings


def test_y_points_up_as_in_the_app(tmp_path: Path) -> None:
    about = two_rooms()
    about["layers"][2]["compressedPixels"] = run((LEFT[1], RIGHT[0]), ROWS[0])  # a way along the upper rim of the picture
    drawn = parse_robot_map(tmp_path, about)
    middle = drawn.free[:, (LEFT[1] + 3) - (LEFT[0] - 1)]
    assert np.flatnonzero(middle).tolist() == [len(middle) - 2]


def test_the_robots_own_rooms(tmp_path: Path) -> None:
    drawn = parse_robot_map(tmp_path, two_rooms())
    assert drawn.names == ("Bath", "") and drawn.resolution == 0.1
    assert np.bincount(drawn.rooms.ravel()).tolist()[1:] == [100, 100] and drawn.free.sum() >= 200
    assert not (drawn.walls & drawn.free).any()


def test_where_a_robot_draws_no_walls_the_outline_stands_for_them(tmp_path: Path) -> None:
    walled, bare = (read_points(saved(tmp_path, two_rooms(walls))) for walls in (True, False))
    assert not walled.warnings and len(bare.warnings) == 1 and "along 0% of its floor's outline" in bare.warnings[0]
    columns = [{tuple(p) for p in np.round(c.points[c.points[:, 2] > 1][:, :2], 3).tolist()} for c in (walled, bare)]
    between = {p for p in columns[0] if 12.1 < p[0] < 13.0}  # walls that no floor touches
    assert len(between) == 18 and columns[0] - between <= columns[1]


def test_a_home_becomes_rooms(tmp_path: Path) -> None:
    rows, left, right = (100, 140), (100, 140), (142, 182)  # two rooms of 4 m in pixels of 10 cm, a door of 0.9 m
    floor = [n for row in range(*rows) for first in (left, right) for n in run(first, row)]
    door = [n for row in range(115, 124) for n in (140, row, 2)]
    ring = [n for c in range(99, 183) for r in (99, 140) for n in (c, r)] + [
        n for r in range(99, 141) for c in (99, 182) for n in (c, r)
    ]
    ring += [n for r in range(*rows) if not 115 <= r < 124 for c in (140, 141) for n in (c, r)]
    layers = [{"type": "floor", "compressedPixels": floor + door}, {"type": "wall", "pixels": ring}]
    extracted = tm.extract(read_points(saved(tmp_path, two_rooms(layers=layers))))
    assert len(extracted.rooms) == 2 and len(extracted.edges) == 1
    assert np.allclose(extracted.rooms["area"], 16, atol=1.5)


@pytest.mark.parametrize(
    ("about", "reason"),
    [
        ("{", "damaged"),
        ("[" * 100_000, "damaged"),
        ([1, 2], "neither a map of Valetudo"),
        ({"rooms": []}, "neither a map of Valetudo"),
        (two_rooms(pixelSize=0), "pixel size"),
        (two_rooms(pixelSize="5"), "pixel size"),
        (two_rooms(pixelSize=float("nan")), "pixel size"),
        (two_rooms(layers=[]), "neither floor nor walls"),
        (two_rooms(layers=7), "no layers"),
        (two_rooms(layers=[{"type": "floor", "pixels": [1, 2, 3]}]), "2 each"),
        (two_rooms(layers=[{"type": "floor", "compressedPixels": [1, 2, 3, 4]}]), "3 each"),
        (two_rooms(layers=[{"type": "floor", "pixels": [1, -2]}]), "outside of any map"),
        (two_rooms(layers=[{"type": "floor", "pixels": [1, "a"]}]), "whole numbers"),
        (two_rooms(layers=[{"type": "floor", "pixels": [[1, 2], [3]]}]), "no numbers"),
        (two_rooms(layers=[{"type": "floor", "pixels": {"a": 1}}]), "whole numbers"),
        (two_rooms(layers=[{"type": "floor", "pixels": 7}]), "whole numbers"),
        (two_rooms(layers=[{"type": "floor", "compressedPixels": [0, 0, 10**9]}]), "outside of any map"),
        (two_rooms(layers=[{"type": "floor", "compressedPixels": [0, 0, 10**30]}]), "whole numbers"),
        (two_rooms(layers=[{"type": "floor", "pixels": [0, 0, 90_000, 90_000]}]), "spans"),
    ],
)
def test_what_is_no_map_is_refused(tmp_path: Path, about: object, reason: str) -> None:
    path = saved(tmp_path, about)
    with pytest.raises(InputError, match=reason) as caught:
        read_points(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_its_resolution_is_its_own(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="states its own resolution"):
        read_points(saved(tmp_path, two_rooms()), resolution=0.05)


def rr_file(
    path: Path, pixels: np.ndarray, corner: tuple[int, int] = (500, 480), *, segments: bool = True, packed: bool = True
) -> Path:
    """A map as Roborock writes it: where its charger is, a picture whose lowest row is first, a digest."""
    top_left = struct.pack("<2i", corner[1], corner[0]) + struct.pack("<2i", *pixels.shape)
    count = struct.pack("<i", 2) if segments else b""
    blocks = struct.pack("<2HI", 1, 8, 8) + bytes(8)
    blocks += struct.pack("<2HI", 2, 24 + len(count), pixels.size) + count + top_left + pixels.astype(np.uint8).tobytes()
    blocks += struct.pack("<2HI", 1024, 8, 20) + bytes(20)
    data = b"rr" + struct.pack("<HI2H2I", 20, len(blocks), 1, 1, 3, 7) + blocks
    path.write_bytes(gzip.compress(data) if packed else data)
    return path


def rr_pixels() -> np.ndarray:
    """Two rooms of 1 m by 1 m side by side, 16 and 17, walls around and between them; the lowest row first."""
    pixels = np.zeros((26, 47), np.uint8)
    pixels[2:24, 2:45] = 1
    pixels[3:23, 3:23] = 16 << 3 | 7
    pixels[3:23, 24:44] = 17 << 3 | 7
    pixels[8:12, 23] = 255  # the door between them is floor of no room
    return pixels


@pytest.mark.parametrize("layout", [{}, {"packed": False}, {"segments": False}])
def test_roborock_s_own_file(tmp_path: Path, layout: dict[str, bool]) -> None:
    path = rr_file(tmp_path / "home.rr", rr_pixels(), **layout)
    cloud = read_points(path)
    tall, floor = cloud.points[cloud.points[:, 2] > 0], cloud.points[cloud.points[:, 2] == 0]
    low = np.array([(500 + 2) * 0.05, (480 + 2) * 0.05])
    np.testing.assert_allclose(tall[:, :2].min(axis=0), low + 0.025, atol=1e-4)
    np.testing.assert_allclose(tall[:, :2].max(axis=0), low + (42.5 * 0.05, 21.5 * 0.05), atol=1e-4)
    assert len(floor) == 2 * 400 + 4 + (rr_pixels() == 1).sum() and not cloud.warnings  # walls begin on the floor
    data = path.read_bytes()
    drawn = parse_roborock_map(path, gzip.decompress(data) if layout.get("packed", True) else data)
    assert drawn.rooms.max() == 2 and (drawn.rooms == 1).sum() == 400


def test_valetudo_re_lies_where_roborock_s_own_file_does(tmp_path: Path) -> None:
    """Rows are counted from the top of a world of 1024 pixels; pairs, numbers of pixels, and rooms packed above them."""
    pixels = np.flipud(rr_pixels())
    height, width = pixels.shape
    rooms = {number: np.argwhere(pixels == (number << 3 | 7))[:, ::-1] for number in (16, 17)}
    walls, door = np.argwhere(pixels == 1)[:, ::-1].tolist(), np.argwhere(pixels == 255)[:, ::-1]
    image = {"position": {"left": 500, "top": 1024 - 480 - height}, "dimensions": {"height": height, "width": width}}
    by_room = {"floor": door.tolist(), "obstacle_strong": walls, "segments": {str(k): v.tolist() for k, v in rooms.items()}}
    packed = [(k << 21) | int(x + y * width) for k, v in rooms.items() for x, y in v]
    flat = {
        "floor": [int(x + y * width) for x, y in door],
        "obstacle_weak": [x + y * width for x, y in walls],
        "segments": packed,
    }
    expected = read_points(rr_file(tmp_path / "home.rr", rr_pixels())).points
    for listed in (by_room, flat):
        found = read_points(saved(tmp_path, {"image": {**image, "pixels": listed}, "path": {"points": []}, "charger": [1, 2]}))
        assert {tuple(p) for p in np.round(found.points, 4).tolist()} == {tuple(p) for p in np.round(expected, 4).tolist()}


def test_damaged_files_of_roborock(tmp_path: Path) -> None:
    path = rr_file(tmp_path / "home.rr", rr_pixels(), packed=False)
    good = path.read_bytes()

    def told(data: bytes) -> str:
        path.write_bytes(data)
        with pytest.raises(InputError) as caught:
            read_points(path)
        return str(caught.value)

    assert "does not start with rr" in told(b"xx" + good[2:])
    assert "a block of" in told(good[:200])
    assert "cut short" in told(gzip.compress(good)[:-9])
    assert "cut short, or unpacks to more" in told(gzip.compress(bytes(1 << 27)))
    assert "shows neither floor nor walls" in told(good[:36])
    assert "shows neither floor nor walls" in told(rr_file(path, np.zeros((5, 5)), packed=False).read_bytes())
    at = good.index(struct.pack("<2i", 26, 47))
    assert "a picture of 47 by 27 pixels" in told(good[:at] + struct.pack("<i", 27) + good[at + 4 :])
    picture = {"position": {"left": 0, "top": 0}, "dimensions": {"height": 3, "width": 3}, "pixels": {"floor": [[5, 1]]}}
    for change in (
        {},
        {"pixels": {"floor": [1.5]}},
        {"pixels": {"floor": [[1, 2, 3]]}},
        {"dimensions": {"height": -3, "width": 3}},
    ):
        with pytest.raises(InputError, match="damaged"):
            read_points(saved(tmp_path, {"image": picture | change}))
