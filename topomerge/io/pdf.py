"""PDF plans: one page as a picture with its texts as they are, read as a drawing.

pypdfium2 draws pages and knows the places of texts (pdfminer.six does not draw). The library is in a process of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from ctypes import byref, c_float, c_int
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.drawing import trace_drawing
from topomerge.io.drawn_page import DrawnPage, find_page
from topomerge.io.grid import build_drawn_pieces
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_head, read_in_subprocess
from topomerge.io.written_lengths import PictureText
from topomerge.types import Array

SECONDS, MEMORY = 300, 6 << 30  # of the processor, and bytes: a page with the network takes 20 s and 1.5 GB
POINT = 0.0254 / 72  # m of paper
FINEST_DOTS = 200  # an inch
LONGEST_SIDE = 3000  # px
SMALLEST_PAGE = 20.0  # points
MOST_PAGES = 100  # are looked at for content
MOST_TEXTS = 20_000
WORD_GAP, SAME_LINE = 0.8, 0.25  # of the height of letters: between words of a text; parts of it overlap so much across it
SCANNED = 0.2  # of a page are images where a plan may be among them; logos are smaller
Box = tuple[float, float, float, float]  # left, bottom, right, top, points


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the floor and the walls of the plan on a page."""
    if find_spec("pypdfium2") is None:
        raise ImportError("no pypdfium2", name="pypdfium2")
    read_head(path, "a PDF file", b"%PDF-", 8)
    yield from read_in_subprocess("pdf", "a PDF drawing", path, options, SECONDS, MEMORY)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process.

    Raises:
        InputError: no page, or several, hold anything; as `trace_drawing`.
    """
    import pypdfium2

    try:
        document = pypdfium2.PdfDocument(path)
    except pypdfium2.PdfiumError as error:
        if "password" in str(error).lower():
            raise InputError(f"{path}: is locked by a password; save it without one") from error
        raise build_damage_error(path, "a PDF file", error) from error
    with document:
        page = document[choose_page(path, document, options.page)]
        scanned = is_scanned(page)
        picture, texts, dots = draw_page(path, page)
    drawn = find_page(picture) or DrawnPage(picture)
    traced = trace_drawing(path, drawn, options.resolution, texts or None, POINT / dots, options.text, more_texts=scanned)
    yield from build_drawn_pieces(path, traced, options)


def choose_page(path: Path, document: Any, number: int | None) -> int:
    """Choose the page of a document, from 0: the one that is asked for, or the only one that holds anything.

    Raises:
        InputError: there is no such page, or none or several hold anything.
    """
    count = len(document)
    if number is not None:
        if number > count:
            raise InputError(f"{path}: has {count:,} pages; --page {number} is none of them")
        if not holds_anything(document[number - 1]):
            raise InputError(f"{path}: there is nothing on page {number}; give another --page")
        return number - 1
    found = []
    for index in range(min(count, MOST_PAGES)):
        if holds_anything(document[index]):
            found.append(index)
        if len(found) > 1 or (found and count == 1):
            break
    if len(found) > 1:
        raise InputError(f"{path}: has {count:,} pages; name the one with the plan by --page, such as --page {found[0] + 1}")
    if not found:
        where = "in it" if count <= MOST_PAGES else f"on its first {MOST_PAGES} pages; name the one with the plan by --page"
        raise InputError(f"{path}: there is nothing {where}" + ("; export it again" if count <= MOST_PAGES else ""))
    return found[0]


def holds_anything(page: Any) -> bool:
    """Return whether a page has any line, picture or text."""
    return next(iter(page.get_objects(max_depth=1)), None) is not None


def draw_page(path: Path, page: Any) -> tuple[Array, tuple[PictureText, ...], float]:
    """Draw a page without its texts: (h, w, 3) uint8, the texts, and pixels a point.

    Raises:
        InputError: the page is of no size.
    """
    width, height = page.get_size()
    if not (min(width, height) >= SMALLEST_PAGE and max(width, height) < math.inf):
        raise InputError(f"{path}: its page has a size of {width:g} x {height:g} points; export it again")
    dots = min(FINEST_DOTS / 72, LONGEST_SIDE / max(width, height))
    texts = find_page_texts(page, dots)
    if texts:
        from pypdfium2 import raw

        for item, _ in find_objects(page):
            if raw.FPDFPageObj_GetType(item) == raw.FPDF_PAGEOBJ_TEXT:  # letters are no walls
                raw.FPDFTextObj_SetTextRenderMode(item, raw.FPDF_TEXTRENDERMODE_INVISIBLE)
    image = page.render(scale=dots, rev_byteorder=True, fill_color=(255, 255, 255, 255)).to_pil()
    return np.array(image.convert("RGB")), texts, dots


def find_objects(page: Any) -> Iterator[tuple[Any, float]]:
    """Yield the objects of a page, those within its forms too, and the area on the page of a unit of area of theirs."""
    from pypdfium2 import raw

    found = [(raw.FPDFPage_GetObject(page, k), 1.0) for k in range(raw.FPDFPage_CountObjects(page))]
    for item, scale in found:
        yield item, scale
        if raw.FPDFPageObj_GetType(item) == raw.FPDF_PAGEOBJ_FORM:
            matrix = raw.FS_MATRIX()
            raw.FPDFPageObj_GetMatrix(item, byref(matrix))
            inner = scale * abs(matrix.a * matrix.d - matrix.b * matrix.c)
            found += [(raw.FPDFFormObj_GetObject(item, k), inner) for k in range(raw.FPDFFormObj_CountObjects(item))]


def is_scanned(page: Any) -> bool:
    """Return whether a scan may be on a page, and no invisible text says what is written on it."""
    from pypdfium2 import raw

    area = 0.0
    for item, scale in find_objects(page):
        kind = raw.FPDFPageObj_GetType(item)
        if kind == raw.FPDF_PAGEOBJ_TEXT and raw.FPDFTextObj_GetTextRenderMode(item) == raw.FPDF_TEXTRENDERMODE_INVISIBLE:
            return False
        if kind == raw.FPDF_PAGEOBJ_IMAGE:
            left, bottom, right, top = sides = [c_float() for _ in range(4)]
            if raw.FPDFPageObj_GetBounds(item, *map(byref, sides)):
                area += scale * (right.value - left.value) * (top.value - bottom.value)
    return area >= SCANNED * math.prod(page.get_size())


def find_page_texts(page: Any, dots: float) -> tuple[PictureText, ...]:
    """Find the texts of a page with their places in pixels, `dots` a point."""
    from pypdfium2.raw import FPDF_PageToDevice

    content = page.get_textpage()
    width, height = (round(v * dots) for v in page.get_size())
    found = []
    for left, bottom, right, top in find_text_boxes(content):
        phrase = " ".join(content.get_text_bounded(left, bottom, right, top).split())
        column, row = c_int(), c_int()  # as the page is turned and cropped
        middle = (left + right) / 2, (bottom + top) / 2
        FPDF_PageToDevice(page, 0, 0, width, height, 0, *middle, byref(column), byref(row))
        if phrase:
            size = min(top - bottom, right - left) * dots
            found.append(PictureText(phrase, (float(column.value), float(row.value)), size, 1.0))
    return tuple(found)


def find_text_boxes(content: Any) -> list[Box]:
    """Find the boxes of the texts of a page; programs write letters and words of a text one by one."""
    boxes: list[Box] = []
    for index in range(min(content.count_rects(), MOST_TEXTS)):
        box = content.get_rect(index)
        if boxes and any(continues(boxes[-1], box, k) and is_written_along(content, box, k) for k in (0, 1)):
            lows, highs = zip(boxes[-1][:2], box[:2], strict=True), zip(boxes[-1][2:], box[2:], strict=True)
            (left, bottom), (right, top) = map(min, lows), map(max, highs)
            box = left, bottom, right, top
            boxes.pop()
        boxes.append(box)
    return boxes


def continues(text: Box, box: Box, axis: int) -> bool:
    """Return whether a box is the next on the line of a text along an axis, 0 for x, 1 for y."""
    gap = max(text[axis], box[axis]) - min(text[axis + 2], box[axis + 2])
    across = 1 - axis
    overlap = min(text[across + 2], box[across + 2]) - max(text[across], box[across])
    heights = text[across + 2] - text[across], box[across + 2] - box[across]
    return abs(gap) <= WORD_GAP * max(heights) and overlap >= SAME_LINE * min(heights)


def is_written_along(content: Any, box: Box, axis: int) -> bool:
    """Return whether the letters in a box stand beside each other along an axis of the page."""
    from pypdfium2.raw import FPDFText_GetCharAngle

    left, bottom, right, top = box
    index = content.get_index((left + right) / 2, (bottom + top) / 2, (right - left) / 2, (top - bottom) / 2)
    if index is None:
        return False
    angle = FPDFText_GetCharAngle(content, index)
    return bool(abs(math.cos(angle)) > abs(math.sin(angle))) == (axis == 0)
