"""Real map pairs with published or measured truth, one module a source."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.core.builder import print_lines
from topomerge.datasets.pairs.flat_maps import compute_cells, encode_rows, thin
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.floorplans import Refusal

from topomerge.errors import InputError
from topomerge.types import Array, Sim3

FIT_CELL = 0.05  # m, of the columns in which walls are looked for
BAND = (0.4, 2.0)  # m above the floor
FIT_STEP = 0.1  # m of height
FILLED_SHARE = 0.5  # share of the steps in that band that a wall fills
SEEN_REACH = 0.3  # m; a wall of b is in a's sight when a knows something that near
REACHES = (1.0, 0.5, 0.3, 0.2)  # m; partners are looked for ever closer


@dataclass(frozen=True)
class WallResidual:
    """How far b's walls lie from a's under a transform, where a has seen anything.

    Args:
        median: m.
        near: share of them within 0.2 m.
        seen: share of b's walls that lie where a has seen anything.
        moved: m by which `fit_walls`, started at the transform, moves the middle of those walls: how exact the truth is, where
            the maps themselves are.
        turned: degrees, the same.
    """

    median: float
    near: float
    seen: float
    moved: float = float("inf")
    turned: float = float("inf")


def find_wall_points(points: Array, floor: float) -> Array:
    """Find (n, 2) float64 middles of the columns of points (m, 3) that are filled like a wall above a floor at a height, m."""
    points = points[(points[:, 2] > floor + BAND[0]) & (points[:, 2] < floor + BAND[1])]
    if not len(points):
        return np.empty((0, 2))
    cells = compute_cells(points, np.array([FIT_CELL, FIT_CELL, FIT_STEP]))
    _, first, column = np.unique(encode_rows(cells[:, :2])[0], return_index=True, return_inverse=True)
    steps = np.unique(encode_rows(np.column_stack([column, cells[:, 2]]))[0], return_index=True)[1]
    filled = np.bincount(column[steps], minlength=len(first)) >= FILLED_SHARE * (BAND[1] - BAND[0]) / FIT_STEP
    many = np.bincount(column)
    return np.column_stack([np.bincount(column, points[:, k]) / many for k in range(2)])[filled]


def find_pair_walls(pair: Pair, truth: Sim3) -> tuple[Array, Array]:
    """Find (n, 2) walls of a and of b over b's lowest floor, in a's frame."""
    a = pair.a.points.astype(np.float64) + pair.a.shift
    b = truth.apply(pair.b.points.astype(np.float64) + pair.b.shift)
    floor = float(np.percentile(b[:, 2], 1))
    return find_wall_points(a, floor), find_wall_points(b, floor)


def measure_residual(pair: Pair) -> WallResidual:
    """Measure the residual of a pair's walls under its truth.

    Raises:
        InputError: the maps are of two places.
    """
    if pair.truth is None:
        raise InputError(f"{pair.name}: maps of two places have no walls in common")
    a, b = find_pair_walls(pair, pair.truth)
    walls_of_a = cKDTree(thin(pair.a.points[:, :2].astype(np.float64) + pair.a.shift[:2], 2 * FIT_CELL))
    seen = walls_of_a.query(b, distance_upper_bound=SEEN_REACH)[0] <= SEEN_REACH
    if not seen.any() or not len(a):
        return WallResidual(float("inf"), 0.0, 0.0)
    b = b[seen]
    distance, middle = cKDTree(a).query(b)[0], b.mean(axis=0)
    better = fit_walls(a - middle, b - middle, Sim3())
    moved, turned = float(np.hypot(*better.translation[:2])), float(abs(np.degrees(better.yaw)))
    return WallResidual(float(np.median(distance)), float((distance < 0.2).mean()), float(seen.mean()), moved, turned)


def fit_walls(a: Array, b: Array, guess: Sim3, scale: bool = False) -> Sim3:
    """Return the similarity near a guess that lays walls b (m, 2) on walls a (n, 2): iterated closest points (Besl & McKay 1992),
    trimmed at `REACHES`.

    Args:
        scale: fit the scale, too; else the guess's is kept.
    """
    tree, x = cKDTree(a), b[:, 0] + 1j * b[:, 1]  # a plane similarity is one product and one sum of complex numbers
    turn = guess.scale * np.exp(1j * guess.yaw)
    shift = complex(*guess.translation[:2])
    for reach in np.repeat(REACHES, 20):
        moved = turn * x + shift
        distance, partner = tree.query(np.column_stack([moved.real, moved.imag]), distance_upper_bound=reach)
        near = np.isfinite(distance)
        if near.sum() < 3:
            break
        p, q = x[near], a[partner[near]] @ [1, 1j]
        p0, q0 = p.mean(), q.mean()
        product = (np.conj(p - p0) * (q - q0)).sum()
        turn = product / (np.abs(p - p0) ** 2).sum() if scale else product / abs(product) * guess.scale
        shift = q0 - turn * p0
    return Sim3(float(np.angle(turn)), (float(shift.real), float(shift.imag), guess.translation[2]), float(abs(turn)))


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
    """Yield every real pair, one at a time: they are large. Names are source/pair, the same on every machine.

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
        yield from collect(source, iter_pair_makers(source, folder))


def iter_pair_makers(source: str, folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of each pair of a source.

    Args:
        folder: of all real data.
    """
    makers: Iterator[tuple[str, Callable[[], Pair]]] = import_module(f"topomerge.datasets.real.{source}").iter_pairs(
        folder / FOLDERS_BY_SOURCE[source]
    )
    return makers


def collect(source: str, makers: Iterator[tuple[str, Callable[[], Pair]]]) -> Iterator[tuple[str, Pair | Refusal]]:
    """Yield pairs by their makers; whatever one of them, or the source as a whole, raises is a `Refusal`."""
    while True:
        try:
            name, make = next(makers)
        except StopIteration:
            return
        except Exception as error:  # the source as a whole can't be read
            yield source, Refusal(source, format_reason(error))
            return
        name = f"{source}/{name}"
        try:
            yield name, make()
        except Exception as error:  # one bad item never ends a run
            yield name, Refusal(name, format_reason(error))


def format_reason(error: Exception) -> str:
    """Return an error in one line."""
    text = " ".join(str(error).split())
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"[:200]


def format_row(pair: Pair) -> tuple[str, ...]:
    """Return cells of a pair under `TABLE_HEAD`."""
    assert pair.truth is not None
    fit, truth = measure_residual(pair), pair.truth
    million = " / ".join(f"{len(c) / 1e6:.2f} M" for c in (pair.a, pair.b))
    numbers = f"{np.degrees(truth.yaw):.1f}", f"{truth.scale:.3f}", f"{pair.overlap:.2f}", str(len(pair.shared) or "-")
    sizes = f"{fit.median:.3f}", f"{fit.near:.0%}", f"{fit.seen:.0%}", f"{fit.moved:.2f} m, {fit.turned:.2f}°"
    return (f"{pair.source}/{pair.name}", " / ".join(pair.sensors), million, *numbers, *sizes)


def iter_table_lines(results: Iterator[tuple[str, Pair | Refusal]]) -> Iterator[str]:
    """Yield lines of a table of the pairs in Markdown; refusals, with their count, follow it."""
    yield "| " + " | ".join(TABLE_HEAD) + " |"
    yield "|" + "---|" * len(TABLE_HEAD)
    refused = []
    for _, result in results:
        if isinstance(result, Refusal):
            refused.append(result)
        else:
            yield "| " + " | ".join(format_row(result)) + " |"
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
    return print_lines(_iter_source_table(options.table, options.sources))


def _iter_source_table(folder: Path, sources: Sequence[str] | None) -> Iterator[str]:
    yield from iter_table_lines(iter_real_pairs(folder, sources))


PROLONGED = {"2017": "2016"}  # session -> the one whose map it goes on from, and whose pixels it repeats where nothing moved


def find_captures(source: str, title: str) -> tuple[str, str]:
    """Return names of the captures, within the source, that map a and map b of a real pair come from; equal ones are one capture.

    Halmstad: each walk with a phone, and each drawing, is a capture of its own. UTexas: the robot grid and the line map of a
    floor are two surveys, while the partial grids hold the very pixels of the whole ones. STRANDS: a session each, but for that
    of 2017. CARMEN: the log. IFC: the model, as the rays of its scan are cast at the model's own walls.

    Args:
        title: of the pair, as `pairs` of the source's module names it.

    Raises:
        InputError: another source, or a title that its module does not give.
    """
    fields = title.split("-")
    if source == "halmstad" and len(fields) == 2:
        return fields[0], fields[1]
    if source == "utexas" and len(fields) == 2:
        return f"{fields[0]} grid", f"{fields[0]} {'lines' if fields[1] == 'lines' else 'grid'}"
    if source == "strands" and len(fields) == 3:
        first, second = (PROLONGED.get(year, year) for year in fields[1:])
        return f"{fields[0]} {first}", f"{fields[0]} {second}"
    if source == "carmen" and len(fields) >= 3:
        log = "-".join(fields[:-2])
        return log, log
    if source == "ifc" and len(fields) >= 2:
        model = title.removesuffix("-scan")
        return model, model
    raise InputError(f"{source}/{title}: no such real pair; its source is one of {', '.join(REAL_SOURCES)}")


if __name__ == "__main__":
    sys.exit(main())
