"""Tables in Markdown: the one writer of all tasks, with intervals over physical buildings."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from topomerge.statistics import interval_text

Row = dict[str, Any]


def write_table(heads: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """Write a table."""
    return "\n".join([write_line(heads), "|" + "---|" * len(heads), *map(write_line, lines)])


def write_line(cells: Sequence[object]) -> str:
    """Write a line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def write_mean(rows: Sequence[Row], key: str) -> str:
    """Write the mean of a value with its 95 % interval over places (`interval_text`)."""
    return interval_text(np.array([float(r.get(key, np.nan)) for r in rows]), np.array([r["place"] for r in rows]))


def compute_mean(rows: Sequence[Row], key: str) -> str:
    """Write the mean of a value alone."""
    return re.split(r"[, ]", write_mean(rows, key))[0]


def write_share(counts: Iterable[int]) -> str:
    """Write right ones of all: 0.95 (19 of 20)."""
    right, every = counts
    return f"{right / every:.2f} ({right} of {every})" if every else "none"


def write_medians(errors: Iterable[Any]) -> list[str]:
    """Write the median of each array of errors; – where nothing was compared."""
    return [f"{np.nanmedian(e):.2f}" if np.isfinite(e).any() else "–" for e in map(np.asarray, errors)]


def group_rows(rows: Iterable[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    """Group rows in the order in which they come."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups
