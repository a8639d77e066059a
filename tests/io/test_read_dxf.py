"""DXF plans: walls of two lines, doors and windows as blocks, units, layers in other languages, hostile files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("ezdxf")

import ezdxf

import topomerge as tm
from tests.io.cad_plans import OUTER, ROOMS, write_flat
from topomerge.errors import InputError
from topomerge.io import dxf
from topomerge.io.dxf import classify_name
from topomerge.io.piece import ReadOptions

AREAS = {name: w * h for name, (_, _, w, h) in ROOMS.items()}


def read_floor(path: Path, **options: Any) -> tuple[np.ndarray, Any, tuple[str, ...]]:
    """(n, 2) points of the floor in metres, landmarks and warnings of a plan, read in this process."""
    pieces = list(dxf.read_in_process(path, ReadOptions(**options)))
    factor = ReadOptions(**options).factor
    return pieces[1].points[:, :2] * factor, pieces[0].landmarks, pieces[0].warnings


def find_areas(path: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> list[float]:
    """Areas of the rooms of a plan, m2, smallest first: its floor without the gaps of doors, which are narrower than 1.1 m."""
    seen = []
    build = dxf.build_plan_masks
    monkeypatch.setattr(dxf, "build_plan_masks", lambda *values: seen.append((build(*values), values[2])) or seen[-1][0])
    next(dxf.read_in_process(path, ReadOptions(**options)))
    monkeypatch.undo()
    ((masks, pixel),) = seen
    core = ndimage.distance_transform_edt(masks.free) * pixel > 0.55
    nearest = ndimage.distance_transform_edt(~core, return_indices=True)[1]
    label = ndimage.label(core)[0][tuple(nearest)]
    return sorted((np.bincount(label[masks.free])[1:] * pixel**2).tolist())


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"turn": 30.0, "unit": 0.001, "code": 4},
        {"names": ("Wände tragend", "TUER_90", "Fenster"), "unit": 0.01, "code": 5},
        {"names": ("MURS_PORTEURS", "Porte simple", "Fenêtre"), "unit": 0.3048, "code": 2},
        {"names": ("0", "X1", "X2"), "unit": 1.0, "code": 6, "sheet": True},
        {"unit": 0.001, "code": 0, "shift": (3.5e5, 5.6e6), "sheet": True},
    ],
    ids=["inches", "turned", "german", "french", "no names, on a sheet", "no unit, far off"],
)
def test_rooms_of_a_flat(tmp_path: Path, how: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_flat(tmp_path / "flat.dxf", **how)
    assert find_areas(path, monkeypatch) == pytest.approx(sorted(AREAS.values()), rel=0.02)
    floor, names, warnings = read_floor(path)
    assert sorted(names.get_values()) == sorted(ROOMS)
    corner, turn = np.array(how.get("shift", (0.0, 0.0))), math.radians(how.get("turn", 0.0))
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    inside = (floor - corner) @ rotation
    assert (inside > -0.05).all() and (inside < np.array(OUTER) + 0.05).all()
    middle = (names.table["position"][:, :2] - corner) @ rotation
    true = [(x + w / 2, y + h / 2) for x, y, w, h in (ROOMS[name] for name in names.get_values())]
    np.testing.assert_allclose(middle, true, atol=0.1)
    assert bool(warnings) == (how.get("code") == 0)


def test_extract_finds_the_rooms_and_their_names(tmp_path: Path) -> None:
    found = tm.extract(tm.read_points(write_flat(tmp_path / "flat.dxf")))
    assert len(found.rooms) == len(ROOMS)
    names = dict(zip(found.landmarks.table["room"].tolist(), found.landmarks.get_values(), strict=True))
    for number, room in enumerate(found.rooms):
        _, _, width, height = ROOMS[names[number]]
        cell, gaps = 0.1, 4 * 0.2  # a floor begins and ends within cells; the gaps of doors belong to rooms
        assert width * height * 0.98 <= room["area"] <= (width + cell) * (height + cell) + gaps
    pairs = {frozenset(names[int(r)] for r in edge["rooms"]) for edge in found.edges}
    assert pairs >= {frozenset(("LIVING", other)) for other in ("KITCHEN", "BATH", "BED")}


def test_a_text_stands_where_its_box_is_fastened(tmp_path: Path) -> None:
    path = write_flat(tmp_path / "flat.dxf")
    document = ezdxf.readfile(path)
    for text in document.modelspace().query("MTEXT"):
        name, height = text.plain_text().split("\n")[0], text.dxf.char_height
        x, y, _ = text.dxf.insert
        text.dxf.insert, text.dxf.attachment_point = (x + 0.35 * height * max(len(name), 7), y - 1.6 * height), 9
    document.saveas(path)
    _, names, _ = read_floor(path)
    true = [(x + w / 2, y + h / 2) for x, y, w, h in (ROOMS[name] for name in names.get_values())]
    np.testing.assert_allclose(names.table["position"][:, :2], true, atol=0.1)


@pytest.mark.parametrize("titles", [("GROUND FLOOR", "FIRST FLOOR"), ("FIRST FLOOR", "GROUND FLOOR"), ("HOUSE A", "HOUSE B")])
def test_plans_with_titles_of_storeys_are_storeys(tmp_path: Path, titles: tuple[str, str]) -> None:
    path = write_flat(tmp_path / "flat.dxf", unit=1.0, code=6)
    document = ezdxf.readfile(path)
    model = document.modelspace()
    for entity in list(model):
        copy = entity.copy()
        copy.translate(20.0, 0.0, 0.0)
        model.add_entity(copy)
    for k, title in enumerate(titles):
        model.add_text(title, dxfattribs={"insert": (3.0 + 20 * k, -2.0), "height": 0.3})
    document.saveas(path)
    found = tm.extract(tm.read_points(path))
    storeys = 1 if titles[0] == "HOUSE A" else 2
    assert len(found.storeys) == storeys and len(found.rooms) == 2 * len(ROOMS)
    assert np.ptp(found.rooms["centroid"][:, 0]) == pytest.approx(5.0 if storeys == 2 else 25.0, abs=3.0)
    assert len(tm.extract(tm.read_points(path, page=2)).rooms) == len(ROOMS)
    with pytest.raises(InputError, match="has 2 plans; --page 3 is none of them"):
        tm.read_points(path, page=3)


def test_unit_is_what_the_user_says(tmp_path: Path) -> None:
    path = write_flat(tmp_path / "flat.dxf", unit=0.01, code=4)
    extent = np.ptp(read_floor(path, unit="cm")[0], axis=0)
    np.testing.assert_allclose(extent, np.array(OUTER) - 0.4, atol=0.1)
    half = np.ptp(read_floor(path, unit="cm", scale=0.5)[0], axis=0)
    np.testing.assert_allclose(half, extent / 2, atol=0.1)


def test_openings_without_windows_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_flat(tmp_path / "flat.dxf", windows=False)
    assert any("outer walls are open" in warning for warning in read_floor(path)[2])
    assert find_areas(path, monkeypatch) == pytest.approx(sorted(AREAS.values()), rel=0.05)


def test_filled_and_thick_walls(tmp_path: Path) -> None:
    """Hatches with holes, wide polylines, solids, and a block scaled, turned and mirrored within another."""
    document = ezdxf.new()
    model = document.modelspace()
    hatch = model.add_hatch(dxfattribs={"layer": "WALL"})
    hatch.paths.add_polyline_path([(0, 0), (8, 0), (8, 6), (0, 6)], is_closed=True)
    hatch.paths.add_polyline_path([(1, 1), (7, 1), (7, 5), (1, 5)], is_closed=True)
    inner = document.blocks.new("PART")
    inner.add_lwpolyline([(0, 0), (2, 0)], dxfattribs={"const_width": 0.1, "layer": "0"})
    outer = document.blocks.new("PARTS")
    outer.add_blockref("PART", (0, 0), dxfattribs={"xscale": -2, "yscale": 2, "rotation": 90})
    model.add_blockref("PARTS", (4, 5), dxfattribs={"layer": "WALL", "yscale": 1})
    model.add_circle((2.5, 3), 0.3, dxfattribs={"layer": "FURNITURE"})
    model.add_solid([(6, 1), (7, 1), (6, 2), (7, 2)], dxfattribs={"layer": "WALL"})
    document.saveas(tmp_path / "a.dxf")
    floor = read_floor(tmp_path / "a.dxf")[0]
    assert len(floor) * dxf.PIXEL**2 == pytest.approx(24 - 4 * 0.2 - 1, rel=0.02)
    assert not ((np.abs(floor[:, 0] - 4) < 0.08) & (floor[:, 1] > 1.05)).any()


def draw_rectangle(model: Any, x: float, y: float, width: float, height: float, layer: str) -> None:
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    model.add_lwpolyline(corners, close=True, dxfattribs={"layer": layer})


def draw_lines(model: Any, lines: list[Any], layer: str) -> None:
    for start, end in lines:
        model.add_line(start, end, dxfattribs={"layer": layer})


def draw_wall_through_a_door(model: Any) -> None:
    """Closed rooms in thick walls; the swing is a bulge of a polyline."""
    for box in ((0, 0, 10, 8), (0.6, 0.6, 4.3, 6.8), (5.1, 0.6, 4.3, 6.8)):
        draw_rectangle(model, *box, "WALLS")
    swing = [(4.9, 3, 0), (4.0, 3, -0.4142), (4.9, 3.9, 0)]
    model.add_lwpolyline(swing, format="xyb", dxfattribs={"layer": "DOORS"})


def draw_double_door(model: Any) -> None:
    """Walls whose ends are open; two leaves, of layers instead of blocks."""
    draw_rectangle(model, 0, 0, 10, 6, "A-WALL")
    draw_lines(model, [((x, y), (x + 4.7, y)) for x in (0.2, 5.1) for y in (0.2, 5.8)], "A-WALL")
    draw_lines(model, [((x, 0.2), (x, 5.8)) for x in (0.2, 9.8)], "A-WALL")
    draw_lines(model, [((x, y), (x, y + 2.0)) for x in (4.9, 5.1) for y in (0.2, 3.8)], "A-WALL")
    draw_lines(model, [((4.9, y), (4.1, y)) for y in (2.2, 3.8)], "A-DOOR")
    for y, angle in ((2.2, 90), (3.8, 180)):
        model.add_arc((4.9, y), 0.8, angle, angle + 90, dxfattribs={"layer": "A-DOOR"})


def draw_sliding_door(model: Any) -> None:
    """A block without an arc in the outer wall."""
    draw_rectangle(model, 0, 0, 8, 6, "MUR")
    draw_rectangle(model, 0.2, 0.2, 7.6, 5.6, "MUR")
    draw_lines(model, [((x, 0), (x, 0.2)) for x in (3, 5)], "MUR")
    block = model.doc.blocks.new("SLIDING_DOOR")
    draw_rectangle(block, 0, 0, 1, 0.05, "0")
    draw_rectangle(block, 1, 0.1, 1, 0.05, "0")
    model.add_blockref("SLIDING_DOOR", (3, 0.02))


def draw_single_lines(model: Any) -> None:
    """Nothing has a name but a piece of furniture; a door is known by its arc; a dimension."""
    draw_rectangle(model, 0, 0, 8, 6, "0")
    draw_lines(model, [((4, 0), (4, 2)), ((4, 2.9), (4, 6)), ((4, 2), (3.1, 2))], "0")
    model.add_arc((4, 2), 0.9, 90, 180)
    draw_rectangle(model.doc.blocks.new("BED_DOUBLE"), 0, 0, 2, 1.8, "0")
    model.add_blockref("BED_DOUBLE", (5.5, 3))
    model.add_linear_dim(base=(0, -1), p1=(0, 0), p2=(8, 0)).render()


@pytest.mark.parametrize(
    ("draw", "area", "door"),
    [
        (draw_wall_through_a_door, 2 * 4.3 * 6.8, (5.0, 3.45)),
        (draw_double_door, 2 * 4.7 * 5.6 + 1.6 * 0.2, (5.0, 3.0)),
        (draw_sliding_door, 7.6 * 5.6, (4.0, 0.18)),
        (draw_single_lines, 48.0, (4.0, 2.45)),
    ],
)
def test_ways_to_draw_doors(tmp_path: Path, draw: Any, area: float, door: tuple[float, float]) -> None:
    document = ezdxf.new(setup=True)
    draw(document.modelspace())
    document.saveas(tmp_path / "a.dxf")
    floor, _, warnings = read_floor(tmp_path / "a.dxf")
    assert len(floor) * dxf.PIXEL**2 == pytest.approx(area, rel=0.02) and not warnings
    assert np.linalg.norm(floor - door, axis=1).min() < 0.05  # its gap is open


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("A-WALL-FULL", "wall"), ("Außenwand", "wall"), ("MUR", "wall"), ("VÆGG", "wall"), ("PAREDES", "wall"),
        ("MURS_PORTEURS", "wall"),
        ("Innentür", "door"), ("A-DOOR", "door"), ("PORTE_80", "door"), ("Window 120", "window"), ("FENÊTRE", "window"),
        ("A-GLAZ", "window"),
        ("A-WALL-PATT", "other"), ("FURNITURE", "other"), ("Möbel", "other"), ("DIMENSIONS", "other"),
        ("STRUCTURE", ""), ("0", ""),
    ],
)  # fmt: skip
def test_names_of_layers(name: str, kind: str) -> None:
    assert classify_name(name) == kind


def write_lines(path: Path, lines: list[Any], layer: str = "WALL") -> Path:
    document = ezdxf.new()
    for start, end in lines:
        document.modelspace().add_line(start, end, dxfattribs={"layer": layer})
    document.saveas(path)
    return path


ROOM = [((0, 0), (5, 0)), ((5, 0), (5, 4)), ((5, 4), (0, 4)), ((0, 4), (0, 0))]


def test_what_is_far_off_or_no_number_is_left_out(tmp_path: Path) -> None:
    far = [((9e5, 9e5), (9e5, 9.1e5)), ((1e300, 0), (0, 1e300)), ((0, 0), (-1e200, 5))]
    path = write_lines(tmp_path / "a.dxf", ROOM + far)
    path.write_text(path.read_text().replace("900000.0", "nan", 1).replace("900000.0", "910000.0"))
    floor, _, warnings = read_floor(path)
    assert len(floor) * dxf.PIXEL**2 == pytest.approx(20, rel=0.02)
    path = write_lines(tmp_path / "b.dxf", [*ROOM, far[0]])
    assert any("1 lines farther than 250 m" in warning for warning in read_floor(path)[2]) and not warnings


def test_large_plans_have_coarser_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dxf, "MOST_PIXELS", 10_000)
    path = write_lines(tmp_path / "a.dxf", ROOM)
    _, _, warnings = read_floor(path)
    assert any("in pixels of 0.07 m" in warning for warning in warnings)


def write_bomb(path: Path, levels: int, inserts: int, own: bool = False) -> Path:
    document = ezdxf.new()
    blocks = [document.blocks.new(f"B{i}") for i in range(levels)]
    for block, inner in zip(blocks, [*blocks[1:], blocks[0]] if own else blocks[1:], strict=False):
        for _ in range(inserts):
            block.add_blockref(inner.name, (0, 0))
    blocks[-1].add_line((0, 0), (1, 0))
    document.modelspace().add_blockref("B0", (0, 0))
    document.saveas(path)
    return path


@pytest.mark.parametrize(
    ("levels", "inserts", "own", "says"), [(30, 2, False, "has more than 2,000 entities"), (2, 1, True, "deep in blocks")]
)
def test_bombs_of_blocks(
    tmp_path: Path, levels: int, inserts: int, own: bool, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dxf, "MOST_ENTITIES", 2000)
    path = write_bomb(tmp_path / "bomb.dxf", levels, inserts, own)
    with pytest.raises(InputError, match=says) as refusal:
        list(dxf.read_in_process(path, ReadOptions()))
    assert "\n" not in str(refusal.value)


def test_a_grid_of_blocks_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dxf, "MOST_ENTITIES", 2000)
    document = ezdxf.new()
    document.blocks.new("B").add_line((0, 0), (1, 0))
    many = {"row_count": 30_000, "column_count": 30_000, "row_spacing": 1, "column_spacing": 1}
    document.modelspace().add_blockref("B", (0, 0), dxfattribs=many)
    document.saveas(tmp_path / "grid.dxf")
    with pytest.raises(InputError, match="has more than 2,000 entities"):
        list(dxf.read_in_process(tmp_path / "grid.dxf", ReadOptions()))


def test_what_is_no_plan(tmp_path: Path) -> None:
    cases = {
        "open": (ROOM[:2], "no walls around a room"),
        "none": ([], "holds no lines"),
        "dots": ([((0, 0), (0, 0))], "holds no lines"),
    }
    for name, (lines, says) in cases.items():
        with pytest.raises(InputError, match=says) as refusal:
            list(dxf.read_in_process(write_lines(tmp_path / f"{name}.dxf", lines), ReadOptions()))
        assert f"{name}.dxf" in str(refusal.value) and "\n" not in str(refusal.value)
    (tmp_path / "text.dxf").write_text("this is no drawing\n" * 9)
    with pytest.raises(InputError, match="damaged, or not a DXF drawing"):
        tm.read_points(tmp_path / "text.dxf")
    with pytest.raises(InputError, match="--resolution is of no use to a DXF drawing"):
        tm.read_points(tmp_path / "text.dxf", resolution=0.1)
