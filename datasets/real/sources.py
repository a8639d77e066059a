"""Real map pairs with published or measured truth, one module a source: Halmstad, UTexas, CARMEN, STRANDS, IFC.

They are for evaluation: none of their buildings may train. `python -m topomerge.datasets.real.sources --table FOLDER` measures
how far
the walls of each pair lie apart under its truth.
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

SOURCES = ("halmstad", "utexas", "strands", "carmen", "ifc")
HEAD = (
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
        folder: with one folder a source, named as in its module's `FOLDER`.
        sources: some of `SOURCES`; None: all.

    Raises:
        InputError: no such folder or source.
    """
    folder, sources = Path(folder), SOURCES if sources is None else tuple(sources)
    unknown = sorted(set(sources) - set(SOURCES))
    if unknown:
        raise InputError(f"source {unknown[0]!r}: {', '.join(SOURCES)} are possible")
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one that holds the data sets")
    return _iterate(folder, sources)


def _iterate(folder: Path, sources: Sequence[str]) -> Iterator[tuple[str, Pair | Refusal]]:
    for source in sources:
        module = import_module(f"topomerge.datasets.real.{source}")
        yield from collect(source, module.pairs(folder / module.FOLDER))


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
    """Cells of a pair under `HEAD`."""
    assert pair.truth is not None
    found, truth = residual(pair), pair.truth
    million = " / ".join(f"{len(c) / 1e6:.2f} M" for c in (pair.a, pair.b))
    numbers = f"{np.degrees(truth.yaw):.1f}", f"{truth.scale:.3f}", f"{pair.overlap:.2f}", str(len(pair.shared) or "-")
    sizes = f"{found.median:.3f}", f"{found.near:.0%}", f"{found.seen:.0%}", f"{found.moved:.2f} m, {found.turned:.2f}°"
    return (f"{pair.source}/{pair.name}", " / ".join(pair.sensors), million, *numbers, *sizes)


def table(results: Iterator[tuple[str, Pair | Refusal]]) -> Iterator[str]:
    """Lines of a table of the pairs in Markdown; refusals, with their count, follow it."""
    yield "| " + " | ".join(HEAD) + " |"
    yield "|" + "---|" * len(HEAD)
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
    parser.add_argument("--sources", nargs="*", choices=SOURCES, help="only these")
    options = parser.parse_args(arguments)
    return print_lines(_table(options.table, options.sources))


def _table(folder: Path, sources: Sequence[str] | None) -> Iterator[str]:
    yield from table(iter_real_pairs(folder, sources))


if __name__ == "__main__":
    sys.exit(main())
