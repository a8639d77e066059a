"""Drawn floor plans: what is page, wall and floor, and what the texts on them say."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage
from topomerge.datasets.drawings.hands import draw_plan
from topomerge.datasets.drawings.pages import spoil_page
from topomerge.datasets.drawings.shapes import DrawingShapes, OpeningShape, RoomShape
from topomerge.datasets.drawings.sheet import Hand, load_font

from tests.cases import list_longer
from topomerge.extraction.extract import extract
from topomerge.io.drawing import choose_zoom, estimate_scale, find_structure, read_texts, select_lost_areas
from topomerge.io.drawn_page import find_page
from topomerge.io.points import read_points
from topomerge.io.written_lengths import PictureText, find_name, parse_lengths, parse_lost_area
from topomerge.networks.drawing import DRAWING_CLASSES, compute_drawing_probabilities

PLAIN = Hand("filled", (0, 0, 0), 0.25, 0.1, 2, False, "arc", "lines", 0.0, 0.0, 1.0, "m2", False, 3, 0.3)


def rectangle(x0, y0, x1, y1):
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def flat():
    """A hall with two rooms, a courtyard between walls, a window and an entrance."""
    rooms = (
        RoomShape(rectangle(0, 0, 8, 2), "corridor"),
        RoomShape(rectangle(0, 2.1, 4, 6), "bedroom"),
        RoomShape(rectangle(4.1, 2.1, 8, 6), "office"),
    )
    doors = [((1, 2.05), (1.9, 2.05)), ((6, 2.05), (6.9, 2.05)), ((-0.05, 0.5), (-0.05, 1.4))]
    openings = [OpeningShape("door", np.array(line), 0.1) for line in doors]
    return DrawingShapes("flat", rooms, (*openings, OpeningShape("window", np.array([[1.0, 6.1], [2.5, 6.1]]), 0.2)))


def draw(hand=PLAIN, seed=0, scale=30.0):
    return draw_plan(flat(), hand, np.random.default_rng(seed), (320, 352), scale, np.array([-1.8, -2.2]))


def one_hot(classes):
    return np.eye(len(DRAWING_CLASSES), dtype=np.float32)[classes]


def count_rooms(parsed):
    return int(ndimage.label(parsed.free & ~parsed.door)[1])


@pytest.mark.parametrize("seed", range(4))
def test_true_classes_give_the_true_rooms(seed):
    drawing = draw(seed=seed)
    parsed = find_structure(one_hot(drawing.classes), 1.0, 30.0)
    assert count_rooms(parsed) == 3
    assert int(ndimage.label(parsed.door)[1]) == 3
    label, _ = ndimage.label(parsed.free & ~parsed.door)
    for room in range(3):
        inside = drawing.rooms == room
        best = np.bincount(label[inside & (label > 0)]).argmax()
        both, either = (inside & (label == best)).sum(), (inside | (label == best)).sum()
        assert both / either > 0.9
    assert not (
        parsed.free & (drawing.rooms < 0) & ~parsed.door & ~ndimage.binary_dilation(drawing.rooms >= 0, iterations=3)
    ).any()


def test_the_page_stays_outside_where_a_wall_was_missed():
    drawing = draw()
    classes = drawing.classes.copy()
    classes[40:60, :][classes[40:60, :] == DRAWING_CLASSES.index("wall")] = DRAWING_CLASSES.index("floor")
    parsed = find_structure(one_hot(classes), 1.0, 30.0)
    assert parsed.free[drawing.rooms >= 0].mean() > 0.9
    far = ~ndimage.binary_dilation(drawing.rooms >= 0, iterations=12)
    assert not parsed.free[far].any() and not parsed.occupied[far].any()


def test_a_courtyard_is_page():
    classes = np.full((100, 100), DRAWING_CLASSES.index("page"))
    classes[10:90, 10:90] = DRAWING_CLASSES.index("wall")
    classes[14:86, 14:86] = DRAWING_CLASSES.index("floor")
    classes[40:60, 40:60] = DRAWING_CLASSES.index("wall")
    classes[43:57, 43:57] = DRAWING_CLASSES.index("page")
    parsed = find_structure(one_hot(classes), 1.0, 10.0)
    assert parsed.free[20, 20] and not parsed.free[50, 50] and not parsed.free[5, 5]


@pytest.mark.parametrize(
    ("text", "area", "sides"),
    [
        ("BEDROOM 13.4 m²", 13.4, None),
        ("12,5 qm", 12.5, None),
        ("145 sq ft", 145 * 0.3048**2, None),
        ("4.2 x 5.8 m", None, (4.2, 5.8)),
        ("420 x 580", None, (4.2, 5.8)),
        ("3500 mm x 2700 mm", None, (3.5, 2.7)),
        ("10'1\" x 11'11\"", None, (10 * 0.3048 + 0.0254, 11 * 0.3048 + 11 * 0.0254)),
        ("9' x 8'", None, (9 * 0.3048, 8 * 0.3048)),
        ("12'-4\" x 9'-7\"", None, (12 * 0.3048 + 4 * 0.0254, 9 * 0.3048 + 7 * 0.0254)),
        ("12ft 6in x 10ft", None, (12 * 0.3048 + 6 * 0.0254, 3.048)),
        ("3.75m x 2.92m (12'4 x 9'7)", None, (12 * 0.3048 + 4 * 0.0254, 9 * 0.3048 + 7 * 0.0254)),
        ("4.2m by 3.1m", None, (4.2, 3.1)),
        ("3200 x 4100", None, (3.2, 4.1)),
        ("10-1 x 11-1", None, None),
        ("112 SF", 112 * 0.3048**2, None),
        ("12.3 m 2", 12.3, None),
        ("14.5 ma", 14.5, None),
        ("14.5 ml", 14.5, None),
        ("14.5 max", None, None),
        ("1,200 sq ft", 1200 * 0.3048**2, None),
        ("12,5 m²", 12.5, None),
        ("12'6½\" x 9'", None, (12 * 0.3048 + 6 * 0.0254, 9 * 0.3048)),
        ("KITCHEN", None, None),
        ("2.113", None, None),
        ("0.001 m²", None, None),
        ("1:100", None, None),
    ],
)
def test_lengths_are_read_from_texts(text, area, sides):
    found_area, found_sides = parse_lengths(text)
    assert found_area == (None if area is None else pytest.approx(area))
    assert found_sides == (None if sides is None else pytest.approx(sides))


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("BEDROOM 13.4 m²", "BEDROOM"),
        ("2.113", "2.113"),
        ("A-113", "A-113"),
        ("4.2 x 5.8 m", ""),
        ("13,2", ""),
        ("-", ""),
        ("Küche", "Küche"),
    ],
)
def test_names_are_what_is_left_of_texts(text, name):
    if text == "13,2":
        assert find_name(text) == ""
    else:
        assert find_name(text) == name


def texts_of(drawing):
    return [PictureText(t.text, t.place, 8.0, 1.0) for t in drawing.texts]


@pytest.mark.parametrize("style", ["m2", "size", "feet"])
@pytest.mark.parametrize("zoom", [1.0, 0.5])
def test_areas_give_the_scale(style, zoom):
    drawing = draw(Hand(**{**vars(PLAIN), "areas": style, "names": 0.0}))
    step = round(1 / zoom)
    parsed = find_structure(one_hot(drawing.classes[::step, ::step]), zoom, None)
    scale = estimate_scale(parsed, texts_of(drawing))
    assert scale is not None and scale.written and scale.resolution == pytest.approx(1 / 30, rel=0.04)


def test_a_text_of_another_room_is_outvoted_and_doors_are_the_last_resort():
    drawing = draw(Hand(**{**vars(PLAIN), "names": 0.0}))
    parsed = find_structure(one_hot(drawing.classes), 1.0, None)
    texts = texts_of(drawing)
    wrong = PictureText("120 m²", texts[0].place, 8.0, 1.0)
    assert estimate_scale(parsed, [*texts, wrong]).resolution == pytest.approx(1 / 30, rel=0.04)
    by_doors = estimate_scale(parsed, [])
    assert not by_doors.written and by_doors.resolution == pytest.approx(1 / 30, rel=0.2) and by_doors.spread > 0.1


def test_areas_that_lost_their_squares_give_the_scale_and_lengths_do_not():
    drawing = draw(Hand(**{**vars(PLAIN), "names": 0.0}))
    parsed = find_structure(one_hot(drawing.classes), 1.0, None)
    lengths = [replace(text, text=length) for text, length in zip(texts_of(drawing), ("8.00 m", "4.00 m", "3.90 m"), strict=True)]
    doors = estimate_scale(parsed, lengths)
    assert not doors.written
    areas = [parse_lost_area(text) for text in ("13.4 m", "12:6 m", "7.1m", "22,5 m", "6.0 m")]
    assert areas == [13.4, 12.6, 7.1, 22.5, 6.0] and parse_lost_area("6 m x 5.0 m") is None
    true = doors.resolution * 1.05
    lost = [(true, f"{area} m", area) for area in areas[:4]] + [(2 * true, "6.0 m", 6.0)]
    assert select_lost_areas(lost, doors, 1.0) == [row[:2] for row in lost[:4]]
    assert not select_lost_areas(lost[:2], doors, 1.0) and not select_lost_areas(lost, doors, 3.0)


@pytest.mark.parametrize("turns", [1, 3])
def test_upright_texts_are_read_from_below_and_from_above(turns):
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    page = Image.new("RGB", (600, 200), "white")
    ImageDraw.Draw(page).text((200, 80), "Kitchen", "black", ImageFont.load_default(40))
    (text,) = read_texts(np.rot90(np.array(page), turns))
    assert text.text == "Kitchen" and text.height == pytest.approx(45, rel=0.3)


def write_row(texts, step, start=(100.0, 40.0), upright=False, height=10.0):
    """Dimensions in a row: texts whose middles lie where those of their lengths are, step pixels a metre."""
    out, at = [], 0.0
    for text, length in texts:
        along = start[0] + (at + length / 2) * step
        out.append(PictureText(text, (start[1], along) if upright else (along, start[1]), height, 0.9))
        at += length
    return out


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize(
    "texts",
    [
        [("4.00", 4.0), ("3,50", 3.5), ("2.25 m", 2.25), ("1.10", 1.1)],
        [("400", 4.0), ("350", 3.5), ("225", 2.25), ("88", 0.88)],
        [("4000", 4.0), ("3500", 3.5), ("2250", 2.25), ("880", 0.88)],
        [("13'-6\"", 13.5 * 0.3048), ("9' 6\"", 9.5 * 0.3048), ("7'", 7 * 0.3048), ("3'-2 1/2\"", 38 * 0.0254)],
    ],
)
def test_dimensions_in_a_row_give_the_scale(texts, upright):
    drawing = draw(Hand(**{**vars(PLAIN), "names": 0.0}))
    parsed = find_structure(one_hot(drawing.classes), 1.0, None)
    row = write_row(texts, 30.0, upright=upright)
    wrong = PictureText("7.77", (row[1].place[0] + 43.0, row[1].place[1] + 97.0), 10.0, 1.0)
    scale = estimate_scale(parsed, [*row, wrong])
    assert scale.written and scale.resolution == pytest.approx(1 / 30, rel=0.005) and scale.spread < 0.03
    assert scale.dimensions == tuple(row)


def test_numbers_of_rooms_in_a_row_are_no_dimensions():
    drawing = draw(Hand(**{**vars(PLAIN), "names": 0.0}))
    parsed = find_structure(one_hot(drawing.classes), 1.0, None)
    numbers = [PictureText(f"1.{k:02d}", (40.0 + 60 * k, 100.0), 10.0, 1.0) for k in range(1, 6)]
    far = [PictureText(f"{k}.20", (40.0 + 30 * k * (k - 1), 100.0), 10.0, 1.0) for k in range(1, 6)]  # a third of a usual plan
    for texts in (numbers, far):
        assert not estimate_scale(parsed, texts).written


def test_a_piece_of_the_page_beside_an_entrance_is_no_room():
    drawing = draw()
    classes = drawing.classes.copy()
    rows, columns = np.nonzero(drawing.rooms >= 0)
    beside = np.zeros(classes.shape, bool)
    beside[rows.min() : rows.min() + 60, columns.min() - 40 : columns.min() - 8] = True
    classes[beside & (classes == DRAWING_CLASSES.index("page"))] = DRAWING_CLASSES.index("floor")
    parsed = find_structure(one_hot(classes), 1.0, 30.0)
    assert count_rooms(parsed) == 3


def paint(grey):
    """A picture of greys of 0..1."""
    return np.repeat(np.round(grey * 255).astype(np.uint8)[..., None], 3, axis=2)


def test_grids_of_robots_are_no_drawings():
    grid = np.full((200, 200), 205 / 255)
    grid[50:150, 50:150] = 254 / 255
    grid[50:150, 50] = 0
    assert find_page(paint(grid)) is None
    page = find_page(draw().picture)
    assert page is not None and not page.mended and (page.matrix == np.eye(3)).all()
    assert find_page(draw().picture[:50, :50]) is None


def test_rooms_painted_in_colours_as_bright_as_unknown_are_no_grid():
    page = np.full((200, 200, 3), 255, np.uint8)
    page[50:150, 50:150] = 222, 205, 188
    assert find_page(page) is not None
    page[50:150, 50:150] = 205
    assert find_page(page) is None


def test_floor_without_walls_is_no_room():
    classes = np.full((200, 200), DRAWING_CLASSES.index("page"))
    classes[20:100, 20:100] = DRAWING_CLASSES.index("wall")
    classes[24:96, 24:96] = DRAWING_CLASSES.index("floor")
    classes[130:190, 130:190] = DRAWING_CLASSES.index("floor")
    parsed = find_structure(one_hot(classes), 1.0, 20.0)
    assert parsed.free[50, 50] and not parsed.free[160, 160]


def test_pictures_are_looked_at_in_pixels_that_the_network_knows():
    assert choose_zoom((800, 600), 0.05) == 1.0
    assert choose_zoom((800, 600), 0.01) == pytest.approx(1 / 4)
    assert choose_zoom((800, 600), 0.24) == pytest.approx(2.0)
    assert choose_zoom((1280, 600), None) == pytest.approx(0.5) and choose_zoom((500, 600), None) == 1.0


def test_tiles_give_what_the_whole_gives():
    def run(picture):
        bright = picture.mean(axis=1)[:, None]
        return (np.repeat(bright, len(DRAWING_CLASSES), axis=1),)

    picture = np.random.default_rng(0).integers(0, 255, (1500, 700, 3), dtype=np.uint8)
    whole = compute_drawing_probabilities(picture, run)
    assert whole.shape == (1500, 700, len(DRAWING_CLASSES))
    assert np.allclose(whole[..., 0], picture.mean(axis=2) / 255, atol=1e-3)


def test_spoiled_pages_keep_their_truth():
    drawing = draw()
    for seed in range(20):
        page = spoil_page(drawing, np.random.default_rng(seed))
        assert page.picture.dtype == np.uint8 and page.picture.shape[:2] == page.classes.shape == page.rooms.shape
        shares = [np.bincount(c.ravel(), minlength=8) / c.size for c in (drawing.classes, page.classes)]
        assert np.abs(shares[0] - shares[1]).max() < 0.2
        again = spoil_page(drawing, np.random.default_rng(seed))
        assert (again.picture == page.picture).all()


def draw_case(path, labels=True):
    """A plan with a hall and four rooms as an estate agent's program draws it: 0.02 m a pixel."""
    picture = Image.new("RGB", (760, 600), "white")
    pen = ImageDraw.Draw(picture)
    for wall in ((80, 70, 680, 84), (80, 506, 680, 520), (80, 70, 94, 520), (666, 70, 680, 520)):
        pen.rectangle(wall, fill="black")
    for wall in ((80, 268, 680, 276), (80, 336, 680, 344), (376, 70, 384, 276), (326, 336, 334, 520)):
        pen.rectangle(wall, fill="black")
    pen.rectangle((78, 277, 96, 335), fill="white")
    for x, y, way in ((200, 268, -1), (500, 268, -1), (180, 336, 1), (480, 336, 1)):
        pen.rectangle((x, y, x + 45, y + 8), fill="white")
        face = y if way < 0 else y + 8
        pen.line((x, face, x, face + way * 45), fill="black", width=2)
        pen.arc((x - 45, face - 45, x + 45, face + 45), *((270, 360) if way < 0 else (0, 90)), fill="black")
    for x0, y0 in ((150, 70), (480, 70), (150, 506), (500, 506)):
        pen.rectangle((x0, y0, x0 + 80, y0 + 14), fill="white", outline="black")
        pen.line((x0, y0 + 7, x0 + 80, y0 + 7), fill="black")
    if labels:
        font = load_font(0, 24)
        for text, place in (("BEDROOM", (230, 160)), ("LIVING", (520, 160)), ("HALL", (370, 306)), ("OFFICE", (500, 440))):
            pen.text(place, text, fill="black", font=font, anchor="mm")
    picture.save(path)
    return path


@pytest.mark.parametrize("text", ["12 m²", "Küche", "2 × 3"])
def test_fonts_of_tex_do_not_write_what_they_lack(text):
    # Their tables name "¿" where others have "²", and nothing at all for "ü".
    plain = [load_font(number, 20, "12 m2").getname()[0] for number in range(19)]
    fonts = [load_font(number, 20, text).getname()[0] for number in range(19)]
    assert [name for name in plain if name.startswith("cm")] and not [name for name in fonts if name.startswith("cm")]
    assert [a for a in plain if not a.startswith("cm")] == [
        a for a, b in zip(fonts, plain, strict=True) if not b.startswith("cm")
    ]


@pytest.mark.parametrize("labels", [True, *list_longer(False)])
def test_a_drawn_plan_has_its_rooms_and_nothing_outside(tmp_path, labels):
    map = extract(read_points(draw_case(tmp_path / "plan.png", labels), resolution=0.02, text=False))
    assert len(map.rooms) == 5 and (map.rooms["outside"] < 0.5).all()
    assert sorted(np.bincount(map.edges["rooms"].ravel(), minlength=5).tolist()) == [1, 1, 1, 1, 4]
    assert map.rooms["area"].sum() == pytest.approx(11.4 * 8.2, rel=0.12)
    assert any("read as a drawn plan" in warning for warning in map.warnings)


def test_without_the_parsing_the_page_is_floor(tmp_path):
    map = extract(read_points(draw_case(tmp_path / "plan.png"), resolution=0.02, drawing=False))
    assert len(map.rooms) > 5


@pytest.mark.longer
def test_names_and_scale_are_read_where_the_reader_is_installed(case_dir):
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    map = extract(read_points(case_dir / "plan-with-labels" / "plan.png"))
    assert len(map.rooms) == 5 and map.rooms["area"].sum() == pytest.approx(98, rel=0.1)
    assert len(map.edges) == 4 and (map.rooms["outside"] < 0.5).all()
    names = dict(zip(map.landmarks.get_values(), map.landmarks.table["room"].tolist(), strict=True))
    assert {"BEDROOM", "LIVING", "HALL", "KITCHEN", "OFFICE"} <= set(names) and len(set(names.values())) == 5


def test_a_plan_painted_in_colours_is_read_as_a_drawing(tmp_path):
    path = draw_case(tmp_path / "plan.png")
    pixels = np.array(Image.open(path))
    pixels[90:260, 100:370][(pixels[90:260, 100:370] > 250).all(axis=2)] = 222, 205, 188
    Image.fromarray(pixels).save(path)
    map = extract(read_points(path, resolution=0.02, text=False))
    assert len(map.rooms) == 5 and any("read as a drawn plan" in warning for warning in map.warnings)
