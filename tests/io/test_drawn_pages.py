"""Pages of drawings as pictures show them: on tables and screens, tilted, in shade, light on dark, several plans on a sheet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy import ndimage

from tests.cases import list_longer
from tests.io.test_drawings import draw, draw_case
from topomerge.errors import InputError
from topomerge.evaluation.drawings import straighten_truth
from topomerge.extraction.extract import extract
from topomerge.io.drawing import (
    ParsedDrawing,
    TracedDrawing,
    build_stairs_landmarks,
    find_structure,
    find_treads,
    is_plan,
    parse_drawing,
    trace_drawing,
)
from topomerge.io.drawn_page import DrawnPage, compute_levels, find_homography, find_page, move_places
from topomerge.io.drawn_storeys import correlate_masks, find_storeys, parse_storey
from topomerge.io.grid import build_drawn_pieces, count_pages, read_paper, read_picture
from topomerge.io.piece import ReadOptions
from topomerge.io.points import read_points
from topomerge.io.written_lengths import PictureText
from topomerge.networks.drawing import DRAWING_CLASSES

SHEET = 842, 595  # px, of A4


def draw_sheet():
    """An A4 page with three rooms as outlines of walls, 3 px wide."""
    sheet = Image.new("RGB", SHEET, "white")
    pen = ImageDraw.Draw(sheet)
    for box in ((120, 90, 720, 500), (120, 90, 420, 300), (420, 90, 720, 300)):
        pen.rectangle(box, outline="black", width=3)
    return sheet


def photograph(sheet, tilt=25.0, pan=-15.0, roll=5.0, table=(60, 40, 30), shade=0.4, zoom=1.0):
    """Photograph a sheet with a camera of usual lens: the picture, and the (4, 2) corners of the sheet on it."""
    size = np.array([1000, 760])
    half, focal = np.hypot(*size) / 2, 1.3 * np.hypot(*size) / 2
    t, p, r = np.radians([tilt, pan, roll])
    about_x = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    w, h = sheet.size
    flat = np.array([[0, 0], [w, 0], [w, h], [0, h]], float)
    space = np.column_stack([flat - [w / 2, h / 2], np.zeros(4)]) @ (about_z @ about_y @ about_x).T + [0, 0, 1.5 * half / zoom]
    corners = space[:, :2] / space[:, 2:] * focal + size / 2
    step = find_homography(corners, flat)
    how = tuple(size.tolist()), Image.Transform.PERSPECTIVE, (step / step[2, 2]).ravel()[:8], Image.Resampling.BICUBIC
    on = np.asarray(Image.new("L", sheet.size, 255).transform(*how)) > 0
    rng = np.random.default_rng(1)
    out = np.where(on[..., None], np.asarray(sheet.transform(*how), float), np.array(table, float))
    light = 1 - shade * np.linspace(0, 1, size[0])[None, :, None]
    out = ndimage.gaussian_filter(out * light, (0.6, 0.6, 0)) + rng.normal(0, 3, out.shape)
    return out.clip(0, 255).astype(np.uint8), corners


@pytest.mark.parametrize(("tilt", "pan", "roll"), [(25, -15, 5), *list_longer((0, 0, 0), (30, 0, 0), (-20, 20, -10))])
@pytest.mark.parametrize("table", [(60, 40, 30), *list_longer(((20, 20, 20),), ((150, 150, 155),))])
def test_a_photographed_page_is_cut_out_and_straight(tilt, pan, roll, table):
    picture, corners = photograph(draw_sheet(), tilt, pan, roll, table)
    page = find_page(picture)
    assert page is not None and page.mended[0].startswith("cut out")
    h, w = page.picture.shape[:2]
    assert w / h == pytest.approx(SHEET[0] / SHEET[1], rel=0.01)
    found = move_places(page.matrix, np.array([[0, 0], [w, 0], [w, h], [0, h]], float))
    assert np.abs(found - corners).max() < 12
    assert np.median(page.picture[:10]) > 225 and np.median(page.picture[:, -10:]) > 225  # lit evenly
    check_straight(page, corners, 0.02)


def check_straight(page, corners, near):
    """The outer walls on a page stand square to each other, as long as they are drawn but for one factor."""
    w, h = SHEET
    sheet = find_homography(np.array([[0, 0], [w, 0], [w, h], [0, h]], float), corners)
    walls = move_places(np.linalg.inv(page.matrix), move_places(sheet, WALLS))
    sides = np.roll(walls, -1, axis=0) - walls
    off = np.degrees(np.arctan2(sides[:, 1], sides[:, 0])) - [0, 90, 180, -90]
    assert np.abs((off + 180) % 360 - 180).max() < 0.8
    length = np.hypot(*sides.T)
    assert length[0] == pytest.approx(length[2], rel=0.02) and length[1] == pytest.approx(length[3], rel=0.02)
    assert length[0] / length[1] == pytest.approx(600 / 410, rel=near)
    seen = move_places(sheet, WALLS)
    assert length[0] * length[1] == pytest.approx(measure_area(seen), rel=0.15)  # pixels are as large as they were


def measure_area(ring):
    x, y = ring.T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


WALLS = np.array([[120, 90], [720, 90], [720, 500], [120, 500]], float)


@pytest.mark.parametrize(("tilt", "pan", "roll"), [(20, -15, 4), *list_longer((25, 0, 0))])
def test_a_page_that_fills_the_picture_is_straightened_by_its_lines(tilt, pan, roll):
    picture, corners = photograph(draw_sheet(), tilt, pan, roll, table=(255, 255, 255), shade=0.3)
    page = find_page(picture)
    assert page is not None and "straightened by its lines" in page.mended
    check_straight(page, corners, 0.06)


def test_a_straight_photograph_and_a_drawing_with_an_oblique_wing_stay():
    picture, _ = photograph(draw_sheet(), 0, 0, 0, table=(255, 255, 255), shade=0.3)
    assert "straightened by its lines" not in find_page(picture).mended
    sheet = draw_sheet()
    pen = ImageDraw.Draw(sheet)
    for k in range(12):
        pen.line((150, 320 + 8 * k, 650, 380 + 8 * k), fill="black", width=2)
    assert not find_page(np.asarray(sheet)).mended


@pytest.mark.parametrize("paper", [(20, 60, 140), *list_longer(((0, 0, 0),), ((70, 75, 80),))])
def test_light_lines_on_dark_paper_are_turned(paper):
    share = 1 - draw().picture.mean(axis=2, keepdims=True) / 255
    picture = (np.array(paper) * (1 - share) + 240 * share).astype(np.uint8)
    page = find_page(picture)
    assert page.mended == ("turned into dark lines on light paper",)
    true = draw().picture.mean(axis=2)
    assert np.abs(page.picture.mean(axis=2) - true)[(true < 5) | (true > 250)].mean() < 12


@pytest.mark.longer
def test_light_floor_among_dark_walls_is_no_blueprint_and_no_page():
    rng = np.random.default_rng(0)
    grid = np.full((300, 300), 0.1)
    grid[40:140, 40:260] = grid[150:260, 40:140] = grid[150:260, 150:260] = 0.95
    noisy = paint_noisy(grid, rng)
    assert find_page(noisy) is None
    room = np.full((300, 300), 0.1)
    room[40:260, 40:260] = 0.95
    assert find_page(paint_noisy(room, rng)) is None  # a page without a line on it


def paint_noisy(grey, rng):
    return (np.repeat(grey[..., None], 3, axis=2) * 255 + rng.normal(0, 2, (*grey.shape, 3))).clip(0, 255).astype(np.uint8)


def test_paper_as_grey_as_unknown_is_paper_where_nothing_is_lighter():
    page = draw().picture.astype(float)
    grey = (60 + page / 255 * 145).astype(np.uint8)  # a faint print on paper of 205
    assert find_page(grey) is not None
    grey[100:200, 100:200] = 254  # the floor of a grid
    assert find_page(grey) is None


@pytest.mark.longer
def test_a_plan_on_a_dark_screen_has_its_rooms(tmp_path):
    screen = Image.new("RGB", (960, 720), (50, 50, 50))
    screen.paste(Image.open(draw_case(tmp_path / "plan.png")), (100, 60))
    path = tmp_path / "screen.png"
    screen.resize((959, 719), Image.Resampling.BILINEAR).save(path)  # as screens show it: lines have soft edges
    map = extract(read_points(path, resolution=0.02, text=False))
    assert len(map.rooms) == 5 and len(map.edges) == 4 and any("cut out" in warning for warning in map.warnings)


@pytest.mark.longer
def test_a_photograph_of_a_plan_has_its_rooms(tmp_path):
    picture, _ = photograph(Image.open(draw_case(tmp_path / "plan.png")), 20, -10, 3)
    path = tmp_path / "photo.png"
    Image.fromarray(picture).save(path)
    map = extract(read_points(path, resolution=0.026, text=False))
    assert len(map.rooms) == 5 and (map.rooms["outside"] < 0.5).all()


def test_a_photograph_without_a_page_is_told_from_a_grid(tmp_path):
    rng = np.random.default_rng(3)
    light = np.linspace(40, 220, 160)[:, None] + rng.normal(0, 25, (160, 120))
    greys = np.clip(light, 0, 255).astype(np.uint8)
    greys[60:100, 40:80] = 255  # floor of a grid
    Image.fromarray(greys).save(tmp_path / "photo.png")
    Image.fromarray(np.where(greys > 200, 254, np.where(greys < 60, 0, 205)).astype(np.uint8)).save(tmp_path / "grid.png")
    told = {name: " ".join(read_points(tmp_path / f"{name}.png", resolution=0.05).warnings) for name in ("photo", "grid")}
    assert "looks like a photograph" in told["photo"] and "photograph" not in told["grid"]


@pytest.mark.longer
def test_a_blueprint_has_its_rooms(tmp_path):
    sheet = np.asarray(Image.open(draw_case(tmp_path / "plan.png")).resize((759, 599), Image.Resampling.BILINEAR))
    path = tmp_path / "blue.png"
    share = 1 - sheet.mean(axis=2, keepdims=True) / 255
    Image.fromarray((np.array([20, 60, 140]) * (1 - share) + 240 * share).astype(np.uint8)).save(path)
    map = extract(read_points(path, resolution=0.02, text=False))
    assert len(map.rooms) == 5 and any("dark lines on light paper" in warning for warning in map.warnings)


@pytest.mark.longer
def test_a_plan_of_two_levels_is_turned_and_a_grid_is_not(tmp_path):
    page = find_page((255 - np.asarray(Image.open(draw_case(tmp_path / "plan.png")))) // 2)  # crisp, and pale
    assert page.mended and page.doubtful and is_plan(page)
    floor = np.zeros((300, 600), bool)  # corridors and rooms among solid black, with edges as a laser gives them
    floor[40:54, 20:580] = floor[230:244, 20:580] = True
    for column in range(40, 560, 110):
        floor[40:240, column : column + 14] = floor[80:105, column - 16 : column + 26] = True
    far = ndimage.distance_transform_edt(floor) - ndimage.distance_transform_edt(~floor)
    rough = far + 8 * ndimage.gaussian_filter(np.random.default_rng(0).normal(0, 1, floor.shape), 1.5) > 1
    grid = np.repeat(rough[..., None] * np.uint8(255), 3, axis=2)
    assert find_page(grid).doubtful
    Image.fromarray(grid).save(tmp_path / "grid.png")
    with pytest.raises(InputError, match="give --resolution .*; if it shows light lines on dark paper, invert its colours$"):
        read_points(tmp_path / "grid.png", text=False)


@pytest.mark.parametrize("how", ["transparent", "16 bits", "JPEG", *list_longer("turned", "mirrored", "half as large")])
def test_the_same_plan_in_other_files(tmp_path, how):
    sheet = Image.open(draw_case(tmp_path / "plan.png"))
    path, factor = tmp_path / ("a.jpg" if how == "JPEG" else "a.png"), 1.0
    if how == "turned":
        sheet = sheet.transpose(Image.Transpose.ROTATE_90)
    elif how == "mirrored":
        sheet = sheet.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    elif how == "transparent":
        sheet.putalpha(Image.fromarray(((np.asarray(sheet).mean(axis=2) < 250) * 255).astype(np.uint8)))
    elif how == "16 bits":
        sheet = Image.fromarray(np.asarray(sheet.convert("L")).astype(np.uint16) * 257)
    elif how == "half as large":
        sheet, factor = sheet.resize((380, 300), Image.Resampling.BOX), 2.0
    sheet.save(path)
    page = find_page(read_picture(path))
    assert page is not None and not page.mended
    parsed = parse_drawing(page.picture, 0.02 * factor)
    assert int(ndimage.label(parsed.free & ~parsed.door)[1]) == 5


def test_a_picture_of_a_cat_has_no_walls(tmp_path):
    cat = Image.new("RGB", (400, 400), "white")
    pen = ImageDraw.Draw(cat)
    pen.polygon(((120, 150), (130, 60), (190, 120)), fill=(90, 70, 50))
    pen.polygon(((280, 150), (270, 60), (210, 120)), fill=(90, 70, 50))
    pen.ellipse((110, 100, 290, 300), fill=(120, 95, 70))
    for x in (160, 240):
        pen.ellipse((x - 12, 170, x + 12, 200), fill=(60, 160, 60))
    cat.save(tmp_path / "cat.png")
    with pytest.raises(InputError, match="no walls around a room") as refusal:
        read_points(tmp_path / "cat.png", resolution=0.02, text=False)
    assert "cat.png" in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["page.png", "page.pdf"])
def test_a_page_with_nothing_on_it(tmp_path, name):
    Image.new("RGB", (400, 300), (250, 250, 246)).save(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: nothing is drawn on it$"):
        read_points(tmp_path / name, resolution=0.02, text=False)


@pytest.mark.parametrize(
    ("name", "dots", "paper"),
    [
        ("a.png", (300, 300), 0.0254 / 300),
        ("a.jpg", (150, 150), 0.0254 / 150),
        ("a.tif", (200, 200), 0.0254 / 200),
        ("a.png", (72, 72), None),
        ("a.png", (96, 96), None),
        ("a.png", (300, 150), None),
        ("a.bmp", (0, 0), None),
    ],
)
def test_dots_an_inch_say_how_long_a_pixel_is_on_paper(tmp_path, name, dots, paper):
    Image.new("RGB", (200, 150), "white").save(tmp_path / name, dpi=dots)
    assert read_paper(tmp_path / name) == (None if paper is None else pytest.approx(paper, rel=1e-3))


def test_a_photograph_says_nothing_of_paper(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x829A] = 0.01  # exposed for so many seconds
    Image.new("RGB", (200, 150), "white").save(tmp_path / "a.jpg", dpi=(300, 300), exif=exif)
    assert read_paper(tmp_path / "a.jpg") is None


@pytest.mark.parametrize("stated", [100, 250])
def test_a_stated_scale_counts_unless_doors_would_be_of_odd_widths(stated, monkeypatch):
    drawing = draw()  # 30 px a metre
    parsed = find_structure(np.eye(len(DRAWING_CLASSES), dtype=np.float32)[drawing.classes], 1.0, None)
    monkeypatch.setattr("topomerge.io.drawing.parse_drawing", lambda picture, known=None: parsed)
    texts = [PictureText(f"1:{stated}", (20.0, 20.0), 10.0, 1.0)]
    traced = trace_drawing(Path("a.png"), DrawnPage(drawing.picture), None, texts, 1 / 3000)
    is_right = stated == 100
    assert traced.resolution == pytest.approx(1 / 30, rel=1e-6 if is_right else 0.2)
    assert any("not taken" in warning for warning in traced.warnings) != is_right


def test_a_tiff_of_several_pages_says_which_was_read(tmp_path):
    first, second = (np.full((140, 180), 254, np.uint8) for _ in range(2))
    first[40:100, 40:42] = first[40:42, 40:100] = first[98:100, 40:100] = first[40:100, 98:100] = 0
    page, other, small = (Image.fromarray(a) for a in (first, second, first[::2, ::2]))
    small.encoderinfo = {"tiffinfo": {254: 1}}
    page.save(tmp_path / "one.tif", save_all=True, append_images=[small])  # a smaller copy, as viewers use
    page.save(tmp_path / "two.tif", save_all=True, append_images=[other])
    told = [read_points(tmp_path / f, resolution=0.05, drawing=False).warnings for f in ("one.tif", "two.tif")]
    assert not any("pages" in t for t in told[0]) and count_pages(tmp_path / "one.tif") == 1
    assert [t for t in told[1] if "pages" in t] == [
        "two.tif: has 2 pages, and the first was read; save the others as files of their own"
    ]


@pytest.mark.parametrize(
    ("text", "rank"),
    [
        ("GROUND FLOOR", 0),
        ("Erdgeschoss 1:100", 0),
        ("EG", 0),
        ("Rez-de-chaussée", 0),
        ("First floor", 1),
        ("1. OG", 1),
        ("2nd Floor Plan", 2),
        ("Second floor", 2),
        ("Étage 3", 3),
        ("Basement", -1),
        ("Kellergeschoss", -1),
        ("Lower ground floor", -1),
        ("Dachgeschoss", 100),
        ("Källare", -1),
        ("KITCHEN", None),
        ("BEDROOM 2", None),
        ("13.4 m²", None),
        ("1:100", None),
    ],
)
def test_titles_name_storeys(text, rank):
    assert parse_storey(text) == rank


def trace_two(shift=(6, 3), titles=("FIRST FLOOR", "GROUND FLOOR"), other=False):
    """Two storeys of a flat beside each other on a sheet of 0.05 m a pixel, the right one lower by some pixels."""
    occupied, free, door = (np.zeros((240, 460), bool) for _ in range(3))
    boxes = ((10, 20), (230 + shift[1], 20 + shift[0]))
    for number, (column, row) in enumerate(boxes):
        w, h = (60, 190) if other and number else (180, 140)
        occupied[row : row + h, column : column + w] = True
        middle = column + (w // 2 if not number else w // 3)
        for left, right in ((column + 4, middle - 2), (middle + 2, column + w - 4)):
            free[row + 4 : row + h - 4, left:right] = True
        door[row + 60 : row + 78, middle - 2 : middle + 2] = True
    free |= door
    occupied &= ~free
    texts = tuple(PictureText(t, (c + 60.0, r + 165.0), 10.0, 1.0) for t, (c, r) in zip(titles, boxes, strict=False))
    return TracedDrawing(ParsedDrawing(occupied, free, door, np.zeros_like(free), door.astype(np.float32), 1.0), 0.05, texts, ())


def test_two_plans_on_a_sheet_are_storeys_over_each_other(tmp_path):
    storeys, warnings = find_storeys(tmp_path / "a.png", trace_two(), None)
    assert len(storeys) == 2 and "2 plans" in warnings[0] and "titles" in warnings[0]
    lower, upper = storeys
    assert np.nonzero(lower.free)[1].min() > 230 and np.nonzero(upper.free)[1].max() < 230  # as their titles say
    corner = [np.array([np.nonzero(s.free)[1].min() * 0.05, -np.nonzero(s.free)[0].max() * 0.05]) + s.corner for s in storeys]
    assert np.abs(corner[0] - corner[1]).max() <= 0.2
    in_order, said = find_storeys(tmp_path / "a.png", trace_two(titles=()), None)
    assert np.nonzero(in_order[0].free)[1].max() < 230 and "order" in said[0]


def test_plans_that_do_not_fit_stay_beside_each_other_and_one_can_be_chosen(tmp_path):
    traced = trace_two(titles=(), other=True)
    storeys, warnings = find_storeys(tmp_path / "a.png", traced, None)
    assert len(storeys) == 1 and (storeys[0].free == traced.drawing.free).all() and "side by side" in warnings[0]
    one, _ = find_storeys(tmp_path / "a.png", traced, 2)
    assert len(one) == 1 and np.nonzero(one[0].free)[1].min() > 230
    with pytest.raises(InputError, match="has 2 plans; --page 3 is none of them"):
        find_storeys(tmp_path / "a.png", traced, 3)


def test_storeys_of_a_sheet_are_extracted(tmp_path):
    pieces = list(build_drawn_pieces(tmp_path / "a.png", trace_two(), ReadOptions()))
    assert [p.done for p in pieces] == sorted(p.done for p in pieces)
    points = np.concatenate([p.points for p in pieces])
    path = tmp_path / "two.xyz"
    np.savetxt(path, points, fmt="%.3f")
    map = extract(read_points(path))
    assert len(map.storeys) == 2 and len(map.rooms) == 4
    assert sorted(np.bincount(map.rooms["storey"]).tolist()) == [2, 2]


def test_a_small_drawing_beside_a_plan_is_no_storey(tmp_path):
    traced = trace_two(titles=())
    drawing = traced.drawing
    keep = np.ones(drawing.free.shape, bool)
    keep[:, 230:] = False
    keep[20:60, 240:300] = True
    small = replace(drawing, occupied=drawing.occupied & keep, free=drawing.free & keep, door=drawing.door & keep)
    storeys, warnings = find_storeys(tmp_path / "a.png", replace(traced, drawing=small), None)
    assert len(storeys) == 1 and not warnings and (storeys[0].free == small.free).all()


def draw_stairs(walking, turned, pale=0):
    """A room of 6 x 5 m with a flight of eight treads of 1 m, at 0.025 m a pixel."""
    page = Image.new("RGB", (320, 280), "white")
    pen = ImageDraw.Draw(page)
    pen.rectangle((40, 40, 280, 240), outline="black", width=6)
    for k in range(9):
        pen.line((80, 60 + 11 * k, 120, 60 + 11 * k), fill=(pale, pale, pale), width=1)
    if walking:
        pen.line((100, 60, 100, 148), fill=(pale, pale, pale))
    return np.asarray(page.rotate(90, expand=True) if turned else page)


@pytest.mark.parametrize("walking", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_treads_are_stairs_and_a_landmark(walking, turned):
    stairs = find_treads(draw_stairs(walking, turned), 0.025)
    assert int(ndimage.label(stairs)[1]) == 1
    assert stairs.sum() * 0.025**2 == pytest.approx(1.0 * 2.2, rel=0.1)
    landmarks = build_stairs_landmarks(stairs, 0.025, (0.0, 0.0), 1.2, "a.png")
    assert landmarks.get_values() == ["stairs"] and landmarks.is_kind("object").all()
    place = (104 * 0.025, (320 - 220) * 0.025) if turned else (100 * 0.025, (280 - 104) * 0.025)
    np.testing.assert_allclose(landmarks.table["position"][0], [*place, 1.2], atol=0.1)
    assert len(build_stairs_landmarks(None, 0.025, (0.0, 0.0), 1.2, "a.png").table) == 0


def test_pale_tiles_and_lines_of_other_distances_are_no_stairs():
    assert not find_treads(draw_stairs(False, False, pale=225), 0.025).any()
    for resolution in (0.01, 0.05):  # 0.11 and 0.55 m apart
        assert not find_treads(draw_stairs(False, False), resolution).any()


def test_pages_are_what_they_were_without_what_is_mended():
    page = find_page(draw().picture)
    assert isinstance(page, DrawnPage) and (page.picture == draw().picture).all()


def test_a_grid_has_no_plan_to_choose(tmp_path):
    grid = np.full((200, 200), 205, np.uint8)
    grid[50:150, 50:150] = 254
    grid[50:150, 50] = 0
    Image.fromarray(grid).save(tmp_path / "grid.png")
    with pytest.raises(InputError, match="no page with drawn plans"):
        read_points(tmp_path / "grid.png", resolution=0.05, page=1)


def test_titles_are_drawn_and_read_nowhere_else(tmp_path):
    """The name of a room that is also that of a storey is no title: it lies in the room."""
    traced = trace_two(titles=())
    inside = (PictureText("Attic", (60.0, 80.0), 8.0, 1.0), PictureText("Hall", (300.0, 80.0), 8.0, 1.0))
    _, warnings = find_storeys(tmp_path / "a.png", replace(traced, texts=inside), None)
    assert "order" in warnings[0]


def test_the_truth_of_a_page_is_measured_where_it_is_read():
    drawing = draw()
    assert straighten_truth(drawing) is drawing
    screen = np.full((420, 460, 3), 40, np.uint8)
    at = np.s_[50:370, 54:406]
    screen[at] = drawing.picture
    classes, rooms = np.zeros((420, 460), np.uint8), np.full((420, 460), -1, np.int16)
    classes[at], rooms[at] = drawing.classes, drawing.rooms
    cut = straighten_truth(replace(drawing, picture=screen, classes=classes, rooms=rooms))
    assert cut.picture.shape[:2] == cut.rooms.shape == cut.classes.shape and cut.rooms.shape[0] < 330
    dark = cut.picture.mean(axis=2) < 60
    walls = ndimage.binary_dilation(np.isin(cut.classes, (2, 3)), iterations=2)
    assert walls[dark].mean() > 0.5 and cut.rooms.max() == drawing.rooms.max()


def test_levels_are_means_to_the_bit() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    assert (compute_levels(picture) == picture.mean(axis=2).round()).all()
    assert (compute_levels(np.full((1, 1, 3), 255, np.uint8)) == 255).all()


@pytest.mark.parametrize("shapes", [((9, 14), (5, 6)), ((4, 3), (8, 11))])
def test_masks_are_correlated_at_every_move(shapes):
    below, above = (np.random.default_rng(k).random(shape) < 0.4 for k, shape in enumerate(shapes))
    score = correlate_masks(below, above)
    assert score.shape == tuple(a + b - 1 for a, b in zip(*shapes, strict=True))
    for i, j in np.ndindex(score.shape):
        moved = np.argwhere(above) + [i, j] - np.array(above.shape) + 1
        inside = ((moved >= 0) & (moved < below.shape)).all(axis=1)
        assert score[i, j] == pytest.approx(below[tuple(moved[inside].T)].sum(), abs=1e-3)
