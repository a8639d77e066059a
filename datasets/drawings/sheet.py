"""A page under way, and the hand that draws on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from topomerge.networks.drawing import PAGE, TEXT
from topomerge.types import Array

FINER = 2  # times as many pixels a side are drawn than are kept: lines have soft edges
WALL_STYLES = {"filled": 0.5, "grey": 0.12, "double": 0.14, "hatched": 0.08, "single": 0.16}


@dataclass(frozen=True)
class DrawnText:
    """A text on a drawing: what it says, its middle (column, row), px, its room, or -1, and the height of its letters, px."""

    text: str
    place: tuple[float, float]
    room: int
    height: float


@dataclass(frozen=True, eq=False)
class Drawing:
    """A page.

    Args:
        picture: (h, w, 3) uint8.
        classes: (h, w) uint8, of `networks.drawing.DRAWING_CLASSES`.
        rooms: (h, w) int16, room of each pixel, -1 none.
        texts: names, areas and dimensions that the hand wrote, before the page was spoilt.
        scale: px/m.
    """

    picture: Array
    classes: Array
    rooms: Array
    texts: tuple[DrawnText, ...]
    scale: float


@dataclass(frozen=True)
class Hand:
    """How somebody draws; drawn by `choose_hand`."""

    walls: str
    ink: tuple[int, int, int]
    outer: float  # m
    inner: float  # m
    line: int  # px of thin lines, in finer pixels
    colours: bool
    doors: str
    windows: str
    furniture: float  # pieces for each 4 m2
    tiles: float
    names: float
    areas: str
    dimensions: bool
    font: int
    letter: float  # height of letters, m


def choose_hand(rng: np.random.Generator) -> Hand:
    """Choose a hand."""
    dark = int(rng.integers(0, 70)) if rng.random() < 0.8 else int(rng.integers(70, 130))
    ink = (dark, dark, dark) if rng.random() < 0.85 else tuple(int(v) for v in rng.integers(0, 140, 3))
    style = str(rng.choice(list(WALL_STYLES), p=np.array(list(WALL_STYLES.values())) / sum(WALL_STYLES.values())))
    return Hand(
        walls=style,
        ink=(ink[0], ink[1], ink[2]),
        outer=float(rng.uniform(0.1, 0.4)),
        inner=float(rng.uniform(0.04, 0.2)),
        line=int(rng.integers(1, 5)),
        colours=bool(rng.random() < 0.35),
        doors=str(rng.choice(["arc", "gap", "leaf", "threshold", "box"], p=[0.6, 0.16, 0.08, 0.08, 0.08])),
        windows=str(rng.choice(["lines", "one", "box", "blue", "plain"], p=[0.5, 0.15, 0.15, 0.1, 0.1])),
        furniture=float(rng.choice([0, 0.25, 0.6, 1.2], p=[0.3, 0.2, 0.3, 0.2])),
        tiles=float(rng.choice([0, 0.4], p=[0.7, 0.3])),
        names=float(rng.choice([0, 0.8, 1.0], p=[0.2, 0.3, 0.5])),
        areas=str(rng.choice(["", "m2", "size", "feet", "both"], p=[0.35, 0.25, 0.15, 0.15, 0.1])),
        dimensions=bool(rng.random() < 0.3),
        font=int(rng.integers(1 << 16)),
        letter=float(rng.uniform(0.16, 0.42)),
    )


class Sheet:
    """A page under way: picture and classes in finer pixels.

    Args:
        side: px of the picture that is kept.
        scale: finer px/m; corner: (2,) m, of the lower left.
    """

    def __init__(self, side: tuple[int, int], scale: float, corner: Array, paper: tuple[int, int, int]) -> None:
        self.shape = side[0] * FINER, side[1] * FINER
        self.scale, self.corner = scale, corner
        size = self.shape[::-1]
        self.picture, self.classes = Image.new("RGB", size, paper), Image.new("L", size, PAGE)
        self.rooms = Image.new("I", size, 0)
        self.draw, self.mark, self.label = (ImageDraw.Draw(i) for i in (self.picture, self.classes, self.rooms))
        self.mark.fontmode = "1"  # classes have no grades between them
        self.texts: list[DrawnText] = []

    def place(self, points: Array) -> list[tuple[float, float]]:
        """Return the finer pixels (column, row) of points (n, 2), m."""
        at = (np.asarray(points, np.float64).reshape(-1, 2) - self.corner) * self.scale
        at[:, 1] = self.shape[0] - 1 - at[:, 1]
        return [(float(x), float(y)) for x, y in at]

    def fill(self, points: Array, colour: tuple[int, int, int] | None, kind: int | None = None) -> None:
        """Fill a polygon."""
        corners = self.place(points)
        if colour is not None:
            self.draw.polygon(corners, fill=colour)
        if kind is not None:
            self.mark.polygon(corners, fill=kind)

    def draw_line(self, points: Array, colour: tuple[int, int, int], width: int, kind: int | None = None) -> None:
        """Draw a line through points."""
        corners = self.place(points)
        self.draw.line(corners, fill=colour, width=width, joint="curve")
        if kind is not None:
            self.mark.line(corners, fill=kind, width=max(width, 2), joint="curve")

    def paint(self, mask: Array, colour: tuple[int, int, int], kind: int | None = None) -> None:
        """Paint the pixels of a mask."""
        image = Image.fromarray(mask.astype(np.uint8) * 255)
        self.picture.paste(colour, mask=image)
        if kind is not None:
            self.classes.paste(kind, mask=image)

    def write(
        self, text: str, at: tuple[float, float], height: float, font: int, colour: tuple[int, int, int], room: int = -1
    ) -> None:
        """Write a text about a place, in finer pixels."""
        height = max(int(height), 7)
        letters = load_font(font, height, text)
        box = self.draw.textbbox(at, text, font=letters, anchor="mm")
        if box[0] < 2 or box[1] < 2 or box[2] > self.shape[1] - 2 or box[3] > self.shape[0] - 2:
            return
        self.draw.text(at, text, fill=colour, font=letters, anchor="mm")
        self.mark.text(at, text, fill=TEXT, font=letters, anchor="mm")
        self.texts.append(DrawnText(text, (at[0] / FINER, at[1] / FINER), room, height / FINER))


@cache
def _list_fonts() -> tuple[str, ...]:
    import matplotlib

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    plain = [
        p.name for p in sorted(folder.glob("*.ttf")) if p.name.startswith(("DejaVu", "STIXGeneral", "cmr10", "cmtt10", "cmss10"))
    ]
    return tuple(str(folder / name) for name in plain if "Display" not in name)


def load_font(number: int, size: int, text: str = "") -> ImageFont.FreeTypeFont:
    """Load a font of matplotlib that can write a text.

    Args:
        number: any; the fonts are counted round and round.
        size: height of letters, px.
        text: what is to be written; in DejaVu Sans if the font has ASCII only and the text has more.
    """
    fonts = _list_fonts()
    path = fonts[number % len(fonts)]
    # The tables of the fonts of TeX name "¿" where others have "²".
    if not text.isascii() and Path(path).name.startswith("cm"):
        path = next(p for p in fonts if Path(p).name == "DejaVuSans.ttf")
    return _open_font(path, size)


@cache
def _open_font(path: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(path, size)
