"""Rows of results of merging, and tables of them in Markdown: shares with their intervals over physical buildings."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.physical import physical_building

from topomerge.io.atomic import replacing
from topomerge.statistics import interval_text
from topomerge.training.belief_hypotheses import right

Row = dict[str, Any]
RESULTS_CACHE = Path("cache/merge")
METHOD_TITLES = {
    "ours": "topomerge", "learned": "topomerge, rooms matched by learning", "kiss02": "KISS-Matcher 0.2 m",
    "kiss03": "KISS-Matcher 0.3 m", "fpfh": "FPFH + RANSAC", "fgr": "FGR",
}  # fmt: skip
HEADS = ("pairs", "right", "right %", "within 0.1 m, 1° %", "right and believed %", "believed but wrong", "s")


def rows_of(name: str) -> list[Row]:
    """Lines of a file of results; none where there is no such file."""
    path = RESULTS_CACHE / name
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def good(row: Row, limits: tuple[float, float] = (0.5, 5.0)) -> bool:
    """Right within m and degrees; a slice or a drawing on the wrong storey is not. Maps of two places have no right pose."""
    return bool(right(row.get("err"), row["sensors"], limits))


def physical_of(row: Row) -> str:
    """The physical building of map a."""
    return str(row.get("physical") or physical_building(row.get("source", "procedural"), row["building"]))


def modality(row: Row) -> str:
    """Kind of a pair by what its maps show."""
    if "drawing" in row["sensors"]:
        return "with a floor plan"
    return "with a slice" if "laser2d" in row["sensors"] or "phone" in row["sensors"] else "3D–3D"


def share(rows: Sequence[Row], hit: Callable[[Row], bool]) -> str:
    """Per cent with its interval over physical buildings (`interval_text`)."""
    return interval_text([float(hit(r)) for r in rows], [physical_of(r) for r in rows], 0, 100.0)


def line(cells: Sequence[object]) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(str(c) for c in cells) + " |"


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown."""
    return "\n".join([line(heads), "|" + "---|" * len(heads), *(line(r) for r in rows)])


def measures(rows: Sequence[Row]) -> list[object]:
    """Number, right, fine, believed among the right ones, believed and wrong, seconds."""
    true = [r for r in rows if good(r)]
    wrong = sum(r["believed"] and r["answered"] and not good(r) for r in rows)
    seconds = float(np.median([r["seconds"] for r in rows]))
    shares = share(rows, good), share(rows, lambda r: good(r, (0.1, 1.0))), share(rows, lambda r: good(r) and r["believed"])
    return [len(rows), len(true), *shares, wrong, f"{seconds:.1f}"]


def by(
    rows: Sequence[Row],
    key: Callable[[Row], str],
    groups: Sequence[str],
    name: str,
    heads: Sequence[str] = HEADS,
    columns: Callable[[Sequence[Row]], Sequence[Any]] = measures,
) -> str:
    """A line a group and method: `columns` of its rows, under these heads; the method is named where there are several."""
    methods = {m: title for m, title in METHOD_TITLES.items() if any(r["method"] == m for r in rows)}
    out = []
    for group in groups:
        for method, title in methods.items():
            mine = [r for r in rows if r["method"] == method and key(r) == group]
            if mine:
                out.append([group, *([title] if len(methods) > 1 else []), *columns(mine)])
    return table([name, *(["method"] if len(methods) > 1 else []), *heads], out)


def put(path: Path, text: str, name: str = "merging") -> None:
    """Replace what stands between the marks, or add the section at the end."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    whole = path.read_text(encoding="utf-8")
    if begin not in whole:
        whole = f"{whole.rstrip()}\n\n## {name.capitalize()}\n\n{begin}\n{end}\n"
    before, rest = whole.split(begin, 1)
    with replacing(path) as beside:
        beside.write_text(f"{before}{begin}\n{text}\n{end}{rest.split(end, 1)[1]}", encoding="utf-8")
