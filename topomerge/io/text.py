"""Tables of points: xyz, txt, csv, pts, asc.

Any delimiter, with or without a header line, comments and further columns. A header is searched for x, y, z and red, green,
blue; without one the first three numbers of a line are the coordinates, and three whole numbers 0..255 that follow (also
after an intensity) are colours.
"""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import Piece, ReadOptions, convert_to_uint8, is_outside_link
from topomerge.types import Array

LINES_A_TIME = 1 << 18  # lines parsed at a time
HEAD_BYTES = 1 << 16  # bytes from which the layout is found
COMMENTS = ("#", "//", "%", "!")
AXES = (("x", "y", "z"), ("x[m]", "y[m]", "z[m]"), ("x_m", "y_m", "z_m"), ("easting", "northing", "height"))
COLOR_COLUMNS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass(frozen=True)
class _Layout:
    """How the lines of a table are to be read."""

    delimiter: str | None  # None: white space
    columns: tuple[int, ...]  # x, y, z and, where known, red, green, blue
    skip: int  # lines before the first row
    comma: bool = False  # decimal commas


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read blocks of points of a table."""
    del options
    size = path.stat().st_size
    layout = _sniff(path)
    with path.open("rb") as stream:
        lines = io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace")
        for values in iter_rows(path, lines, layout.columns, layout.delimiter, layout.skip, layout.comma):
            colors = values[:, 3:].clip(0, 65535) if values.shape[1] == 6 else None
            integers = colors is not None and bool((colors == np.rint(colors)).all())
            if colors is not None and integers:
                colors = colors.astype(np.int64)
            yield Piece(values[:, :3], None if colors is None else convert_to_uint8(colors), done=stream.tell() / size)


def iter_rows(
    path: Path,
    lines: Iterable[str],
    columns: tuple[int, ...],
    delimiter: str | None = None,
    skip: int = 0,
    comma: bool = False,
) -> Iterator[Array]:
    """Yield blocks (n, len(columns)) float64 of a stream of text lines; the first `skip` lines are passed over.

    Raises:
        InputError: a line that is not a row of numbers, with its number.
    """
    lines = iter(lines)
    before = sum(1 for _ in itertools.islice(lines, skip))
    while block := list(itertools.islice(lines, LINES_A_TIME)):
        if comma:
            block = [line.replace(",", ".") for line in block]
        try:
            values = _parse(block, columns, delimiter)
        except (ValueError, IndexError):
            block = [_strip_comment(line) for line in block]  # comments other than # cost time, so they are sought only now
            try:
                values = _parse(block, columns, delimiter)
            except (ValueError, IndexError) as error:
                number, line = _find_first_bad_line(block, columns, delimiter)
                shown = "" if is_outside_link(path) else f" ({line[:40]!r})"
                what = f"line {before + number} is not a row of numbers{shown}"
                raise InputError(f"{path}: {what}; mend or remove it") from error
        before += len(block)
        if len(values):
            yield values


def _parse(block: list[str], columns: tuple[int, ...], delimiter: str | None) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a block of blank lines is no news
        return np.loadtxt(block, np.float64, comments="#", delimiter=delimiter, usecols=columns, ndmin=2)


def _strip_comment(line: str) -> str:
    """Return the line without a comment."""
    for mark in COMMENTS:
        line = line.split(mark, 1)[0]
    return line


def _find_first_bad_line(block: list[str], columns: tuple[int, ...], delimiter: str | None) -> tuple[int, str]:
    """Return the number (from 1) and text of the first line of a block that can't be read."""
    for number, line in enumerate(block, 1):
        fields = line.strip().split(delimiter)
        try:
            if fields not in ([], [""]):
                [float(fields[c]) for c in columns]
        except (ValueError, IndexError):
            return number, line.strip()
    return len(block), block[-1].strip()


def _sniff(path: Path) -> _Layout:
    """Return the delimiter, columns and first row of a table, from its first lines."""
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if b"\0" in head:
        raise InputError(f"{path}: is not text; export it as a table of x y z, or give it the suffix of its format")
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    if len(head) == HEAD_BYTES and len(lines) > 1:
        lines.pop()  # perhaps half a line
    header: list[str] = []
    for number, line in enumerate(lines):
        text = _strip_comment(line).strip() or line.strip("#/%! \t")
        delimiter, comma = _detect_delimiter(text)
        fields = [f.strip().strip('"').lower() for f in text.split(delimiter)]
        if any(all(n in fields for n in names) for names in AXES):
            header = fields
        elif _strip_comment(line).strip() and len(_find_numeric_fields(fields, comma)) >= 3:
            numbers = _find_numeric_fields(fields, comma)
            columns = _match_header_columns(header, len(fields)) or _guess_columns(numbers, lines[number:], delimiter)
            return _Layout(delimiter, columns, number, comma)
    raise InputError(f"{path}: no line with three numbers found; a table of points has x y z in each line")


def _detect_delimiter(text: str) -> tuple[str | None, bool]:
    """Return the delimiter of a line (None: white space), and whether its numbers have decimal commas."""
    if ";" in text:
        return ";", "," in text and "." not in text
    if re.search(r"\d,\d+[ \t]+-?\d", text):
        return None, True
    return next((mark for mark in (",", "|") if mark in text), None), False


def _find_numeric_fields(fields: list[str], comma: bool) -> list[int]:
    """Return which of the fields are numbers."""
    numeric_columns = []
    for column, text in enumerate(fields):
        try:
            float(text.replace(",", ".") if comma else text)
        except ValueError:
            continue
        numeric_columns.append(column)
    return numeric_columns


def _match_header_columns(header: list[str], width: int) -> tuple[int, ...]:
    """Return the columns of x, y, z and of colours by their names; none where no header fits."""
    if len(header) != width:
        return ()
    axes = next(names for names in AXES if all(n in header for n in names))
    colors = next((names for names in COLOR_COLUMNS if all(n in header for n in names)), ())
    return tuple(header.index(n) for n in (*axes, *colors))


def _guess_columns(numbers: list[int], lines: list[str], delimiter: str | None) -> tuple[int, ...]:
    """Guess the columns of x, y, z and of colours by what stands in them."""
    for start in (3, 4):  # x y z r g b, and x y z intensity r g b
        if len(numbers) >= start + 3 and _are_bytes(lines, numbers[start : start + 3], delimiter):
            return (*numbers[:3], *numbers[start : start + 3])
    return tuple(numbers[:3])


def _are_bytes(lines: list[str], columns: list[int], delimiter: str | None) -> bool:
    rows = [fields for line in lines if (fields := _strip_comment(line).strip().split(delimiter)) not in ([], [""])]
    return all(
        len(fields) > columns[-1] and all(re.fullmatch(r"\s*\d{1,3}(\.0*)?\s*", fields[c]) for c in columns)
        and all(float(fields[c]) <= 255 for c in columns)
        for fields in rows
    )  # fmt: skip
