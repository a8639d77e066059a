"""Each kind of line and symbol of a drawn plan by itself: its mask is where its ink is."""

import numpy as np
import pytest
from scipy import ndimage
from topomerge.datasets.drawings.hands import draw_plan, draw_tiles, draw_treads, furnish_rooms
from topomerge.datasets.drawings.shapes import DrawingShapes, OpeningShape, RoomShape
from topomerge.datasets.drawings.sheet import WALL_STYLES, Hand, Sheet

from topomerge.io.written_lengths import parse_lengths
from topomerge.networks.drawing import DOOR, FLOOR, PAGE, STAIRS, SYMBOL, TEXT, WALL, WINDOW

SCALE = 60.0  # px/m
SIDE = (380, 420)  # px
CORNER = np.array([-1.5, -1.6])
THICK = 0.3  # m, of outer walls


class Choices:
    """A generator of random numbers of which some are given."""

    def __init__(self, random=0.5, poisson=0, kind=None, seed=0):
        self._rng, self._random, self._poisson, self._kind = np.random.default_rng(seed), random, poisson, kind

    def random(self):
        return self._random

    def poisson(self, rate):
        return self._poisson

    def integers(self, *ends):
        return self._kind if self._kind is not None and ends == (9,) else self._rng.integers(*ends)

    def __getattr__(self, name):
        return getattr(self._rng, name)


def hand(**changes):
    plain = {
        "walls": "filled", "ink": (0, 0, 0), "outer": THICK, "inner": 0.15, "line": 2, "colours": False, "doors": "gap",
        "windows": "lines", "furniture": 0.0, "tiles": 0.0, "names": 0.0, "areas": "", "dimensions": False, "font": 3,
        "letter": 0.3,
    }  # fmt: skip
    return Hand(**{**plain, **changes})


def room(kind="office"):
    return RoomShape(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]), kind)


def draw(openings=(), choices=None, kind="office", **changes):
    """A room of 4 x 3 m with openings in its outer walls."""
    shapes = DrawingShapes("room", (room(kind),), tuple(openings))
    return draw_plan(shapes, hand(**changes), choices or Choices(), SIDE, SCALE, CORNER)


def draw_window(style):
    middle = 3.0 + THICK / 2
    return draw([OpeningShape("window", np.array([[1.0, middle], [3.0, middle]]), THICK)], windows=style)


def draw_door(style, width=0.9, kind="door", **changes):
    middle = -THICK / 2
    return draw([OpeningShape(kind, np.array([[1.0, middle], [1.0 + width, middle]]), THICK)], doors=style, **changes)


def blank():
    return Sheet(SIDE, SCALE, CORNER, (255, 255, 255))


def find_ink(picture, least=60):
    return np.abs(np.asarray(picture, int) - 255).max(axis=2) > least


def wider(mask, by=1):
    return ndimage.binary_dilation(mask, np.ones((3, 3)), by)


def locate(x, y):
    """The pixel (row, column) of a place, m."""
    column, row = np.array([x, y]) - CORNER
    return SIDE[0] - 1 - int(row * SCALE), int(column * SCALE)


def count_strokes(line):
    """How many runs of ink a line of pixels crosses."""
    return int((np.diff(np.r_[0, line.astype(int)]) == 1).sum())


def count_parts(mask):
    return int(ndimage.label(mask, np.ones((3, 3)))[1])


def assert_same(ink, mask, by=1, where=True):
    """Nothing of the ink is outside of the mask, and nothing of the mask has no ink, but for soft edges."""
    assert (mask & where).any()
    assert not (ink & ~wider(mask, by) & where).any() and not (mask & ~wider(ink, by) & where).any()


def assert_is_outer_wall(mask):
    """The mask is the ring of outer walls about the room, as thick as the hand draws them, with half of an inner one inside."""
    for x, y in ((-THICK / 2, 1.5), (4 + THICK / 2, 1.5), (2.0, -THICK / 2), (2.0, 3 + THICK / 2)):
        assert mask[locate(x, y)]
    assert not mask[locate(2.0, 1.5)] and not mask[locate(-THICK - 0.1, 1.5)] and not mask[locate(2.0, 3.1 + THICK)]
    across = mask[locate(2.0, 1.5)[0]]
    assert across.sum() / SCALE == pytest.approx(2 * (THICK + 0.15 / 2), abs=0.1)


@pytest.mark.parametrize("style", ["filled", "grey"])
def test_full_walls(style):
    drawing = draw(walls=style)
    mask = drawing.classes == WALL
    assert_is_outer_wall(mask)
    assert_same(find_ink(drawing.picture), mask)
    middle = drawing.picture[locate(-THICK / 2, 1.5)]
    assert (middle == (0 if style == "filled" else 150)).all()


def test_double_walls_are_inked_along_their_edges_only():
    drawing = draw(walls="double")
    mask, ink = drawing.classes == WALL, find_ink(drawing.picture)
    assert_is_outer_wall(mask)
    core = ndimage.binary_erosion(mask, np.ones((3, 3)), 4)
    assert not (ink & ~wider(mask)).any() and not (ink & core).any()
    edge = mask & ~ndimage.binary_erosion(mask)
    assert not (edge & ~wider(ink)).any()


def test_hatched_walls_are_walls_between_their_hatches():
    drawing = draw(walls="hatched")
    mask, ink = drawing.classes == WALL, find_ink(drawing.picture)
    assert_is_outer_wall(mask)
    assert not (ink & ~wider(mask)).any() and not (mask & ~wider(ink, 7)).any()
    core = ndimage.binary_erosion(mask, np.ones((3, 3)), 4)
    assert 0.15 < ink[core].mean() < 0.6


def test_single_walls_are_a_line_about_the_room():
    drawing = draw(walls="single")
    mask = drawing.classes == WALL
    assert_same(find_ink(drawing.picture), mask)
    assert mask[locate(0.0, 1.5)] and not mask[locate(-THICK / 2, 1.5)] and not mask[locate(2.0, 1.5)]


def test_every_style_of_wall_is_tried():
    assert set(WALL_STYLES) == {"filled", "grey", "double", "hatched", "single"}


@pytest.mark.parametrize(("style", "strokes"), [("box", 2), ("one", 3), ("blue", 3), ("lines", 4), ("plain", 5)])
def test_windows(style, strokes):
    drawing = draw_window(style)
    mask = drawing.classes == WINDOW
    rows, columns = np.nonzero(mask)
    assert np.ptp(columns) / SCALE == pytest.approx(2.0, abs=0.05) and np.ptp(rows) / SCALE == pytest.approx(THICK, abs=0.15)
    assert mask[locate(2.0, 3 + THICK / 2)] and count_parts(mask) == 1
    column = locate(1.7, 3.0)[1]
    inside = wider(mask)[:, column] & (np.arange(SIDE[0]) < locate(0, 2.5)[0])
    assert count_strokes(find_ink(drawing.picture, 110)[inside, column]) == strokes
    paper = drawing.picture[ndimage.binary_erosion(mask, np.ones((3, 3)), 2)].max(axis=0)
    assert tuple(paper) == ((170, 205, 235) if style == "blue" else (255, 255, 255))


@pytest.mark.parametrize("style", ["arc", "leaf", "gap", "threshold", "box"])
def test_the_gap_of_a_door_is_a_door(style):
    drawing = draw_door(style)
    mask, ink = drawing.classes == DOOR, find_ink(drawing.picture)
    rows, columns = np.nonzero(mask)
    assert np.ptp(columns) / SCALE == pytest.approx(0.9, abs=0.05) and np.ptp(rows) / SCALE == pytest.approx(THICK, abs=0.15)
    assert count_parts(mask) == 1 and not (ink & ndimage.binary_erosion(mask, np.ones((3, 3)), 3)).any()
    column = locate(1.45, -THICK / 2)[1]
    down = ink[rows.min() - 1 : rows.max() + 2, column]
    assert count_strokes(down) == (2 if style in ("threshold", "box") else 0)
    assert not (ink & ~wider(np.isin(drawing.classes, (WALL, DOOR, SYMBOL)), 2)).any()
    assert (drawing.classes == SYMBOL).any() == (style in ("arc", "leaf"))


@pytest.mark.parametrize(("width", "leaves"), [(0.9, 1), (1.6, 2)])
@pytest.mark.parametrize("style", ["arc", "leaf"])
def test_leaves_and_arcs_are_symbols(style, width, leaves):
    drawing = draw_door(style, width, line=4)
    mask, ink = drawing.classes == SYMBOL, find_ink(drawing.picture)
    apart = ~wider(np.isin(drawing.classes, (WALL, DOOR)), 2)
    assert_same(ink, mask, where=apart)
    assert style == "arc" or count_parts(mask & apart) == leaves
    rows, columns = np.nonzero(mask)
    assert np.ptp(rows) / SCALE == pytest.approx(width / leaves, abs=0.25)
    far = np.ptp(columns) / SCALE
    assert far == pytest.approx(width, abs=0.1) if style == "arc" or leaves == 2 else far < 0.1


def test_an_opening_without_a_door_has_no_leaf():
    drawing = draw_door("arc", kind="opening")
    assert (drawing.classes == DOOR).any() and not (drawing.classes == SYMBOL).any()
    assert not find_ink(drawing.picture)[ndimage.binary_erosion(drawing.classes == DOOR, np.ones((3, 3)), 2)].any()


def keep(sheet):
    """Picture and classes of a sheet, in its own pixels."""
    return find_ink(sheet.picture), np.asarray(sheet.classes)


def test_treads_of_a_flight():
    sheet = blank()
    draw_treads(sheet, np.array([[0.0, 0.0], [2.9, 0.0], [2.9, 1.0], [0.0, 1.0]]), hand(), Choices())
    ink, classes = keep(sheet)
    assert_same(ink, classes == STAIRS)
    assert set(np.unique(classes)) == {PAGE, STAIRS}
    y = sheet.place(np.array([[0.0, 0.25]]))[0][1]
    assert count_strokes(ink[int(y)]) == 11  # ten treads of .29 m


def test_a_staircase_is_filled_with_treads():
    drawing = draw(kind="stairs")
    ink, mask = find_ink(drawing.picture), drawing.classes == STAIRS
    inside = ndimage.binary_erosion(drawing.rooms == 0, np.ones((3, 3)), 8)
    assert_same(ink, mask, where=inside)
    assert not mask[drawing.rooms < 0].any()


def fill_room(choices, **changes):
    """The ink and classes of what stands in a room, without its walls."""
    sheet, shapes = blank(), DrawingShapes("room", (room(),), ())
    sheet.fill(room().polygon, None, FLOOR)
    sheet.label.polygon(sheet.place(room().polygon), fill=1)
    furnish_rooms(sheet, shapes, hand(**changes), choices)
    return (*keep(sheet), np.asarray(sheet.rooms) == 1)


@pytest.mark.parametrize("kind", range(9))
def test_furniture(kind):
    ink, classes, inside = fill_room(Choices(kind=kind, poisson=4), furniture=1.0)
    mask = classes == SYMBOL
    assert_same(ink, mask)
    assert not (mask & ~inside).any() and set(np.unique(classes)) == {PAGE, FLOOR, SYMBOL}
    full = ndimage.binary_fill_holes(mask)
    assert full.sum() == mask.sum() if kind == 8 else full.sum() > 1.5 * mask.sum()


def test_no_furniture_where_the_hand_draws_none():
    ink, classes, _ = fill_room(Choices(poisson=4))
    assert not ink.any() and not (classes == SYMBOL).any()


def test_ways_out_are_symbols():
    ink, classes, _ = fill_room(Choices(random=0.1))
    assert_same(ink, classes == SYMBOL)


def test_tiles_are_floor():
    sheet = blank()
    sheet.fill(room().polygon, None, FLOOR)
    draw_tiles(sheet, room().polygon, Choices())
    ink, classes = find_ink(sheet.picture, 20), np.asarray(sheet.classes)
    assert ink.sum() > 2000 and (classes[ink] == FLOOR).all() and set(np.unique(classes)) == {PAGE, FLOOR}


def find_clear_floor(drawing):
    return (drawing.rooms == 0) & (drawing.classes != WALL)


def test_areas_are_of_the_floor_between_the_walls():
    drawing = draw(areas="m2", inner=0.2)
    (text,) = drawing.texts
    assert parse_lengths(text.text)[0] == pytest.approx(find_clear_floor(drawing).sum() / SCALE**2, abs=0.15)
    assert text.height == pytest.approx(0.3 * SCALE, abs=1)


def test_names_and_areas_are_texts():
    drawing = draw(names=1.0, areas="both")
    mask, inside = drawing.classes == TEXT, ndimage.binary_erosion(drawing.rooms == 0, np.ones((3, 3)), 8)
    assert_same(find_ink(drawing.picture) & inside, mask)
    assert [text.room for text in drawing.texts] == [0, 0, 0]
    clear = find_clear_floor(drawing)
    sides = tuple(np.ptp(side) / SCALE for side in np.nonzero(clear))[::-1]
    assert sides == pytest.approx((3.85, 2.85), abs=0.05)  # from wall to wall: half of a wall is on either side
    assert any(parse_lengths(text.text)[1] == pytest.approx(sides, abs=0.03) for text in drawing.texts)
    for text in drawing.texts:
        column, row = (int(v) for v in text.place)
        assert mask[row - 6 : row + 6, column - 12 : column + 12].any()


def test_chains_of_dimensions_are_texts_outside_and_say_lengths():
    drawing = draw(dimensions=True)
    ink, mask = find_ink(drawing.picture), drawing.classes == TEXT
    outside = ~wider(drawing.classes == WALL, 2) & (drawing.rooms < 0)
    assert_same(ink, mask, where=outside)
    lengths = [float(text.text) for text in drawing.texts]
    assert sum(lengths) <= 7.1 and all(length <= 4.0 for length in lengths) and lengths


def test_what_stands_outside_is_no_part_of_the_house():
    seen = set()
    for seed in range(4):
        drawing = draw(choices=Choices(poisson=3, seed=seed))
        house = wider(drawing.classes == WALL, 2) | (drawing.rooms >= 0)
        kinds = set(np.unique(drawing.classes[~house]))
        assert kinds <= {PAGE, SYMBOL, TEXT}
        assert_is_outer_wall(drawing.classes == WALL)
        ink = find_ink(drawing.picture, 20) & ~house
        for kind in kinds - {PAGE}:
            mask = (drawing.classes == kind) & ~house
            assert not (mask & ~wider(ink)).any()
        seen |= kinds
    assert seen == {PAGE, SYMBOL, TEXT}
