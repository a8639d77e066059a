"""A flat drawn in the ways of CAD: two lines for each wall, doors and windows as blocks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.io.drawing import ParsedDrawing

WALL = 0.2  # m
# Rooms of a flat of 9.4 x 7.4 m by their clear lower left corners and sizes, m; their names.
ROOMS = {
    "LIVING": (0.2, 0.2, 5.0, 4.0),
    "KITCHEN": (5.4, 0.2, 3.8, 4.0),
    "BATH": (0.2, 4.4, 2.4, 2.8),
    "BED": (2.8, 4.4, 6.4, 2.8),
}
OUTER = (9.4, 7.4)
# Hinge, width, and quarter turns of each door; a door's gap runs along x at 0 turns. The first one leads out.
DOORS = [((2.0, 0.0), 1.0, 0), ((5.4, 1.5), 0.8, 1), ((1.0, 4.2), 0.8, 0), ((3.4, 4.2), 0.8, 0)]
WINDOWS = [((6.0, 0.0), 1.6), ((6.0, 7.2), 1.6)]


def parse_dark_lines(picture: np.ndarray, resolution: float | None = None) -> ParsedDrawing:
    """Parse a picture without a network: dark pixels are walls, and what they enclose is floor."""
    dark = picture.mean(axis=2) < 128
    label, _ = ndimage.label(~dark)
    return ParsedDrawing(
        dark, ~dark & (label != label[0, 0]), np.zeros_like(dark), np.zeros_like(dark), np.zeros(dark.shape, np.float32), 1.0
    )


def _cut(start: float, end: float, gaps: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """What is left of an interval without gaps."""
    pieces, at = [], start
    for low, high in sorted(gaps):
        pieces.append((at, low))
        at = high
    return [*pieces, (at, end)]


def wall_lines() -> list[np.ndarray]:
    """(2, 2) lines of all walls, m: the outline of each room and of the flat, cut at doors and windows, and the jambs."""
    openings = []  # low x, low y, high x, high y
    for (x, y), width, turns in DOORS:
        openings.append((x, y, x + width, y + WALL) if turns == 0 else (x - WALL, y, x, y + width))
    openings += [(x, y, x + width, y + WALL) for (x, y), width in WINDOWS]
    lines = []
    for x, y, w, h in (*ROOMS.values(), (0.0, 0.0, *OUTER)):
        for level in (y, y + h):
            gaps = [(o[0], o[2]) for o in openings if o[1] - 1e-6 <= level <= o[3] + 1e-6 and o[0] > x and o[2] < x + w]
            lines += [[(a, level), (b, level)] for a, b in _cut(x, x + w, gaps)]
        for level in (x, x + w):
            gaps = [(o[1], o[3]) for o in openings if o[0] - 1e-6 <= level <= o[2] + 1e-6 and o[1] > y and o[3] < y + h]
            lines += [[(level, a), (level, b)] for a, b in _cut(y, y + h, gaps)]
    for x0, y0, x1, y1 in openings:
        along_x = x1 - x0 > y1 - y0
        lines += [[(x0, y0), (x0, y1)], [(x1, y0), (x1, y1)]] if along_x else [[(x0, y0), (x1, y0)], [(x0, y1), (x1, y1)]]
    return [np.array(line) for line in lines]


def write_flat(
    path: Path,
    unit: float = 0.0254,
    code: int = 1,
    turn: float = 0.0,
    names: tuple[str, str, str] = ("A-WALL", "DOOR", "WINDOW"),
    shift: tuple[float, float] = (0.0, 0.0),
    **more: Any,
) -> Path:
    """Write the flat as DXF.

    Args:
        path: of the file.
        unit: m of a unit of the drawing; code: its $INSUNITS.
        turn: degrees.
        names: of the layer of walls and of the blocks of doors and of windows.
        shift: m.
        more: `sheet`: a frame and furniture as lines of their layers; `windows`: False leaves the openings without them.
    """
    import ezdxf

    document = ezdxf.new("R2010")
    document.header["$INSUNITS"] = code
    model = document.modelspace()
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))

    def place(x: float, y: float) -> tuple[float, float]:
        return ((cos * x - sin * y + shift[0]) / unit, (sin * x + cos * y + shift[1]) / unit)

    for line in wall_lines():
        model.add_line(place(*line[0]), place(*line[1]), dxfattribs={"layer": names[0]})
    door = document.blocks.new(names[1])  # a leaf that stands open, of the width 1
    door.add_line((0, 0), (0, 1))
    door.add_arc((0, 0), 1, 0, 90)
    window = document.blocks.new(names[2])  # of the length 1 and the thickness 1
    window.add_lwpolyline([(0, 0), (1, 0), (1, 1), (0, 1)], close=True)
    window.add_line((0, 0.5), (1, 0.5))
    for (x, y), width, turns in DOORS:
        mirrored = {"yscale": -width / unit} if turns else {"yscale": width / unit}
        attributes = {"xscale": width / unit, "rotation": turn + 90 * turns, **mirrored}
        model.add_blockref(names[1], place(x, y + (0 if turns else WALL)), dxfattribs=attributes)
    for (x, y), width in WINDOWS if more.get("windows", True) else ():
        attributes = {"xscale": width / unit, "yscale": WALL / unit, "rotation": turn}
        model.add_blockref(names[2], place(x, y), dxfattribs=attributes)
    for name, (x, y, w, h) in ROOMS.items():
        middle = {"insert": place(x + w / 2, y + h / 2), "attachment_point": 5}
        model.add_mtext(f"{name}\n{w * h:.1f} m2", dxfattribs={**middle, "char_height": 0.2 / unit})
    if more.get("sheet"):
        model.add_lwpolyline([place(*p) for p in ((-3, -3), (14, -3), (14, 11), (-3, 11))], close=True, dxfattribs={"layer": "0"})
        model.add_circle(place(7.0, 2.0), 0.5 / unit, dxfattribs={"layer": "MOEBEL"})
        model.add_text("WALL TYPE 3: 1/2 GYPSUM", dxfattribs={"layer": "NOTES", "insert": place(10, 9), "height": 0.3 / unit})
    document.saveas(path)
    return path
