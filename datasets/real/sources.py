"""Real map pairs with published or measured truth, one module a source: Halmstad, UTexas, CARMEN, STRANDS, IFC.

Every source is a module `topomerge.datasets.real.<source>` with a function ``pairs(folder)``, which gives name and maker of each
pair, as the sets of `datasets.public` do; `REAL_FOLDERS` says where its files are. All are for evaluation: none of their
buildings may train. `DEVELOPMENT_FOLDERS` are for choosing by, and are read where they are named only.
`python -m topomerge.datasets.real.sources --table FOLDER` measures how far the walls of each pair lie apart under its truth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
from topomerge.datasets.core.script import print_lines
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.real.wall_fit import residual

from topomerge.errors import InputError

REAL_FOLDERS = {  # source -> folder of its files within that of the real data
    "halmstad": "halmstad_robot_maps",
    "utexas": "utexas_gdc_floors",
    "strands": "grids_rose2_homes_strands",
    "carmen": "carmen_logs",
    "ifc": "ifc_buildings",
}
REAL_SOURCES = tuple(REAL_FOLDERS)
# Likewise of what one chooses by, and never reports.
DEVELOPMENT_FOLDERS = {"office_floor": "halmstad_office_f5", "storeys": "storeys_jsk"}
FOLDERS_BY_SOURCE = {**REAL_FOLDERS, **DEVELOPMENT_FOLDERS}
TABLE_HEAD = (
    "pair",
    "sensors",
    "points",
    "yaw °",
    "scale",
    "overlap",
    "rooms in both",
    "median m",
    "within 0.2 m",
    "seen by a",
    "fit moves",
)


def iter_real_pairs(folder: str | Path, sources: Sequence[str] | None = None) -> Iterator[tuple[str, Pair | Refusal]]:
    """Every real pair, one at a time: they are large. Names are source/pair, the same on every machine.

    A pair whose files are missing or damaged is a `Refusal`, and the rest goes on.

    Args:
        folder: with one folder a source, named as in `REAL_FOLDERS`.
        sources: some of `REAL_SOURCES` or of `DEVELOPMENT_FOLDERS`; None: all of the former.

    Raises:
        InputError: no such folder or source.
    """
    folder, sources = Path(folder), REAL_SOURCES if sources is None else tuple(sources)
    unknown = sorted(set(sources) - set(FOLDERS_BY_SOURCE))
    if unknown:
        raise InputError(f"source {unknown[0]!r}: {', '.join(FOLDERS_BY_SOURCE)} are possible")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds the data sets")
    return _iterate(folder, sources)


def _iterate(folder: Path, sources: Sequence[str]) -> Iterator[tuple[str, Pair | Refusal]]:
    for source in sources:
        yield from collect(source, pair_makers(source, folder))


def pair_makers(source: str, folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Name and maker of each pair of a source.

    Args:
        folder: of all real data.
    """
    makers: Iterator[tuple[str, Callable[[], Pair]]] = import_module(f"topomerge.datasets.real.{source}").pairs(
        folder / FOLDERS_BY_SOURCE[source]
    )
    return makers


def collect(source: str, makers: Iterator[tuple[str, Callable[[], Pair]]]) -> Iterator[tuple[str, Pair | Refusal]]:
    """Pairs by their makers; whatever one of them, or the source as a whole, raises is a `Refusal`."""
    while True:
        try:
            name, make = next(makers)
        except StopIteration:
            return
        except Exception as error:  # the source as a whole can't be read
            yield source, Refusal(source, reason(error))
            return
        name = f"{source}/{name}"
        try:
            yield name, make()
        except Exception as error:  # one bad item never ends a run
            yield name, Refusal(name, reason(error))


def reason(error: Exception) -> str:
    """One line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"[:200]


def row(pair: Pair) -> tuple[str, ...]:
    """Cells of a pair under `TABLE_HEAD`."""
    assert pair.truth is not None
    fit, truth = residual(pair), pair.truth
    million = " / ".join(f"{len(c) / 1e6:.2f} M" for c in (pair.a, pair.b))
    numbers = f"{np.degrees(truth.yaw):.1f}", f"{truth.scale:.3f}", f"{pair.overlap:.2f}", str(len(pair.shared) or "-")
    sizes = f"{fit.median:.3f}", f"{fit.near:.0%}", f"{fit.seen:.0%}", f"{fit.moved:.2f} m, {fit.turned:.2f}°"
    return (f"{pair.source}/{pair.name}", " / ".join(pair.sensors), million, *numbers, *sizes)


def table(results: Iterator[tuple[str, Pair | Refusal]]) -> Iterator[str]:
    """Lines of a table of the pairs in Markdown; refusals, with their count, follow it."""
    yield "| " + " | ".join(TABLE_HEAD) + " |"
    yield "|" + "---|" * len(TABLE_HEAD)
    refused = []
    for _, result in results:
        if isinstance(result, Refusal):
            refused.append(result)
        else:
            yield "| " + " | ".join(row(result)) + " |"
    if refused:
        yield ""
        yield f"Refused: {len(refused)}"
        yield from (f"- {r.name}: {r.reason}" for r in refused)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m topomerge.datasets.real.sources", description=__doc__)
    parser.add_argument("--table", metavar="FOLDER", type=Path, required=True, help="the folder with the data sets")
    parser.add_argument("--sources", nargs="*", choices=tuple(FOLDERS_BY_SOURCE), help="only these")
    options = parser.parse_args(arguments)
    return print_lines(_table(options.table, options.sources))


def _table(folder: Path, sources: Sequence[str] | None) -> Iterator[str]:
    yield from table(iter_real_pairs(folder, sources))


if __name__ == "__main__":
    sys.exit(main())
