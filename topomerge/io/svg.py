"""SVG plans: drawn by resvg without texts, whose places are taken from the file, and read as a drawing.

What lies outside of the file is not looked at: references to other files and addresses are cut out, declarations refused.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from topomerge.errors import InputError
from topomerge.io.drawing import trace_drawing
from topomerge.io.drawn_page import DrawnPage, find_page
from topomerge.io.grid import build_drawn_pieces
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_in_subprocess
from topomerge.io.written_lengths import PictureText
from topomerge.types import Array

SECONDS, MEMORY = 300, 6 << 30  # of the processor, and bytes: a picture with the network takes 20 s and 1.5 GB
LARGEST_FILE = 1 << 26  # bytes
LONGEST_SIDE, SHORTEST_SIDE = 3000, 1200  # px of the longer side
SHORTEST_READ = 2400  # px, likewise, where letters are outlines, which are read on the picture
MOST_LEVELS, MOST_TEXTS = 200, 20_000
PIXELS_AN_INCH = 96  # CSS
LENGTHS = {"": 1.0, "px": 1.0, "in": 96.0, "cm": 96 / 2.54, "mm": 96 / 25.4, "pt": 96 / 72, "pc": 16.0}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
TRANSFORM = re.compile(r"(matrix|translate|scale|rotate)\s*\(([^)]*)\)")


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the floor and the walls of the plan on a picture."""
    if find_spec("resvg_py") is None:
        raise ImportError("no resvg_py", name="resvg_py")
    yield from read_in_subprocess("svg", "an SVG drawing", path, options, SECONDS, MEMORY)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process.

    Raises:
        InputError: it is no SVG, declares entities, or is too large; as `trace_drawing`.
    """
    root = load_svg(path)
    size, paper = measure_size(path, root)
    longest = max(size)
    shortest = SHORTEST_SIDE if find_svg_texts(root, size, 1.0) else SHORTEST_READ
    zoom = min(max(longest, shortest), LONGEST_SIDE) / longest
    picture = draw_svg(path, root, size, zoom)
    page = 0.0254 / PIXELS_AN_INCH / zoom if paper else None
    drawn = find_page(picture) or DrawnPage(picture)
    traced = trace_drawing(path, drawn, options.resolution, find_svg_texts(root, size, zoom) or None, page, options.text)
    yield from build_drawn_pieces(path, traced, options)


def load_svg(path: Path) -> xml.Element:
    """Load the tree of an SVG file without what it refers to outside of itself.

    Raises:
        InputError: it is none, or declares entities.
    """
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{path}: has more than {LARGEST_FILE >> 20} MB, too many for a plan; export it with less in it")
    data = path.read_bytes()
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if re.search(r"<!ENTITY|<!DOCTYPE[^>]*\[", text):
        raise InputError(f"{path}: declares entities, which are not read as they can be a bomb; save it as plain SVG")
    try:
        root = xml.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))  # its encoding is undone
    except xml.ParseError as error:
        raise build_damage_error(path, "an SVG file", error) from error
    if _get_name(root) != "svg":
        raise InputError(f"{path}: is XML, but no SVG ({_get_name(root)[:40]}); export it as SVG")
    levels = [(root, 1)]
    for element, level in levels:
        if level > MOST_LEVELS:
            raise InputError(f"{path}: its groups lie more than {MOST_LEVELS} deep in each other; save it as plain SVG")
        for key in [k for k in element.attrib if k.rpartition("}")[2] == "href"]:
            if not element.attrib[key].strip().startswith(("#", "data:image/png", "data:image/jp")):
                del element.attrib[key]
        levels += [(child, level + 1) for child in element]
    return root


def _get_name(element: xml.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def parse_length(text: str | None) -> tuple[float, bool] | None:
    """Parse a length: CSS pixels, and is it one of paper (cm, mm, in, pt)? None: it is none, or a share."""
    found = re.fullmatch(rf"\s*({NUMBER})\s*([a-z]*)\s*", text or "")
    if not found or found[2] not in LENGTHS:
        return None
    return float(found[1]) * LENGTHS[found[2]], found[2] not in ("", "px")


def _read_box(root: xml.Element) -> list[float]:
    values = [float(v) for v in re.findall(NUMBER, root.get("viewBox", ""))]
    return values if len(values) == 4 and min(values[2:]) > 0 and all(map(math.isfinite, values)) else []


def measure_size(path: Path, root: xml.Element) -> tuple[tuple[float, float], bool]:
    """Measure width and height in CSS pixels; are they lengths on paper?

    Raises:
        InputError: the file states no size.
    """
    box = _read_box(root)
    found = [parse_length(root.get(name)) for name in ("width", "height")]
    if None in found and not box:
        raise InputError(f"{path}: states neither width and height nor a viewBox; save it with one")
    if None in found:
        return (box[2], box[3]), False
    (width, paper), (height, _) = (f for f in found if f is not None)
    if not (0 < width < 1e7 and 0 < height < 1e7 and max(width, height) / min(width, height) < 100):
        raise InputError(f"{path}: has a size of {width:g} x {height:g} px; save it with the size of a page")
    return (width, height), paper


def draw_svg(path: Path, root: xml.Element, size: tuple[float, float], zoom: float) -> Array:
    """Draw a tree without its texts: (h, w, 3) uint8.

    Raises:
        InputError: it can't be drawn, or nothing is on it.
    """
    import resvg_py
    from PIL import Image

    width, height = (max(round(side * zoom), 1) for side in size)
    try:
        drawn = resvg_py.svg_to_bytes(
            svg_string=xml.tostring(root, encoding="unicode"),
            skip_system_fonts=True,
            background="#ffffff",
            width=width,
            height=height,
            dpi=PIXELS_AN_INCH,
        )
    except ValueError as error:
        raise build_damage_error(path, "an SVG file", error) from error
    with Image.open(io.BytesIO(bytes(drawn)), formats=("PNG",)) as image:
        picture = np.array(image.convert("RGB"))
    if (picture == picture[0, 0]).all():
        raise InputError(f"{path}: there is nothing in it; export it again")
    return picture


def find_svg_texts(root: xml.Element, size: tuple[float, float], zoom: float) -> tuple[PictureText, ...]:
    """Find the texts of a tree with their places in pixels, `zoom` a CSS pixel."""
    start = np.diag([zoom, zoom, 1.0])
    if box := _read_box(root):
        fit = min(size[0] / box[2], size[1] / box[3])
        left, top = ((side - fit * length) / 2 - fit * low for side, length, low in zip(size, box[2:], box[:2], strict=True))
        start = start @ np.array([[fit, 0, left], [0, fit, top], [0, 0, 1]])
    found: list[PictureText] = []
    open_elements = [(root, start, 16.0)]
    while open_elements and len(found) < MOST_TEXTS:
        element, matrix, height = open_elements.pop()
        matrix = matrix @ parse_transform(element.get("transform", ""))
        own = re.search(rf"font-size\s*:\s*({NUMBER})", element.get("style", "")) or re.match(
            NUMBER, element.get("font-size", "")
        )
        height = float(own[own.lastindex or 0]) if own else height
        if _get_name(element) in ("defs", "symbol", "title", "desc", "metadata", "style"):
            continue
        if _get_name(element) == "text":
            found += _find_lines(element, matrix, height)
        else:
            open_elements += [(child, matrix, height) for child in reversed(element)]
    return tuple(found)


def _find_lines(element: xml.Element, matrix: Array, height: float) -> Iterator[PictureText]:
    """Yield the lines of a text: each tspan with a y or dy of its own begins one."""
    lines: list[tuple[list[float], str]] = []
    place = _read_place(element, [0.0, 0.0])
    lines.append((place, element.text or ""))
    for child in element:
        if lines[-1][1].strip() and {"y", "dy"} & set(child.attrib):
            place = _read_place(child, [place[0], place[1] + 1.2 * height])
            lines.append((place, ""))
        elif not lines[-1][1].strip():
            lines[-1] = (_read_place(child, place), "")
        lines[-1] = (lines[-1][0], lines[-1][1] + "".join(child.itertext()) + (child.tail or ""))
    style = element.get("style", "") + f"text-anchor:{element.get('text-anchor', '')}"
    anchor = 0.0 if "anchor:middle" in style else -0.5 if "anchor:end" in style else 0.5
    for (x, y), text in lines:
        content = " ".join(text.split())
        middle = matrix @ [x + anchor * 0.55 * height * len(content), y - 0.35 * height, 1.0]
        size = height * math.sqrt(abs(np.linalg.det(matrix[:2, :2])))
        if content and np.isfinite(middle).all() and np.abs(middle).max() < 1e6 and math.isfinite(size):
            yield PictureText(content, (float(middle[0]), float(middle[1])), float(size), 1.0)


def _read_place(element: xml.Element, default: list[float]) -> list[float]:
    """Return x and y of a text, where they are stated."""
    found = [re.match(NUMBER, element.get(name, "").strip()) for name in ("x", "y")]
    return [float(f[0]) if f else value for f, value in zip(found, default, strict=True)]


def parse_transform(text: str) -> Array:
    """Parse a transform as a (3, 3) matrix; what it does not know changes nothing."""
    matrix = np.eye(3)
    for name, numbers in TRANSFORM.findall(text):
        v = [float(n) for n in re.findall(NUMBER, numbers)]
        step = np.eye(3)
        if name == "matrix" and len(v) == 6:
            step[:2] = np.array(v).reshape(3, 2).T
        elif name == "translate" and v:
            step[:2, 2] = v[0], v[1] if len(v) > 1 else 0.0
        elif name == "scale" and v:
            step[0, 0], step[1, 1] = v[0], v[-1]
        elif name == "rotate" and v:
            cos, sin = math.cos(math.radians(v[0])), math.sin(math.radians(v[0]))
            step[:2, :2] = [[cos, -sin], [sin, cos]]
            if len(v) == 3:
                step[:2, 2] = np.array(v[1:]) - step[:2, :2] @ v[1:]
        matrix = matrix @ step
    return matrix
