"""Simulated maps and real ones, side by side: ``python -m topomerge.datasets.reports.realism [--fast]`` prints what
`docs/data.md` shows.

Rooms are true ones wherever there are any (plans, spaces of a model, labelled grids); of the real clouds without them the room is
the outline of the points. Nothing here goes through the extraction. Simulated maps come from training seeds and training plans;
the real ones are evaluation data and only looked at.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from topomerge.datasets.core.script import print_lines
from topomerge.datasets.reports.realism_sources import map_rows, plan_rows

from topomerge.errors import InputError


def lines(title: str, columns: Mapping[str, str], rows: Iterable[tuple[str, Mapping[str, float]]]) -> Iterator[str]:
    """A table in Markdown.

    Args:
        columns: heading -> key and format, as in "area:.1f".
    """
    yield f"| {title} | " + " | ".join(columns) + " |"
    yield "|---" * (len(columns) + 1) + "|"
    for name, row in rows:
        cells = []
        for wanted in columns.values():
            key, _, form = wanted.partition(":")
            value = row.get(key, np.nan)
            cells.append(format(value, form) if np.isfinite(value) else "")
        yield f"| {name} | " + " | ".join(cells) + " |"


ROOM_COLUMNS = {
    "storeys": "storeys:.0f", "rooms a storey": "rooms:.1f", "area 25 %, m²": "25 %:.1f", "50 %": "area:.1f", "75 %": "75 %:.1f",
    "< 5 m²": "small:.0%", "> 100 m²": "large:.0%", "door 10 %, m": "door 10 %:.2f", "50 % ": "door:.2f", "90 %": "door 90 %:.2f",
    "of one width": "equal:.0%",
}  # fmt: skip
MAP_COLUMNS = {
    "rooms": "seen:.0f", "points a m² of floor": "points:.0f", "a m² seen": "density:.0f", "floor unseen": "floor:.0%",
    "ceiling": "ceiling:.0%", "walls 0–1 m": "wall 0:.0%", "1–2 m": "wall 1:.0%", "2–3 m": "wall 2:.0%", "clutter": "clutter:.0%",
    "flat, mm": "flat:.0f", "upright": "upright:.0f", "at 90 %": "rough:.0f", "no plane": "loose:.0%",
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m topomerge.datasets.reports.realism", description=__doc__)
    parser.add_argument("--fast", action="store_true", help="three kinds of buildings, one of each, and few plans")
    parser.add_argument("--data", type=Path, default=os.environ.get("TOPOMERGE_DATA"), help="folder of the real data")
    options = parser.parse_args(arguments)
    return print_lines(_tables(options.data, options.fast))


def _tables(folder: str | Path | None, fast: bool) -> Iterator[str]:
    if not folder:
        raise InputError("name the folder of the real data: --data, or TOPOMERGE_DATA")
    yield from lines("rooms and doors", ROOM_COLUMNS, plan_rows(Path(folder), fast))
    yield ""
    yield from lines("surfaces", MAP_COLUMNS, map_rows(Path(folder), fast))


if __name__ == "__main__":
    sys.exit(main())
