"""Real pairs, extracted once, and as pairs of grids."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import limit_time
from topomerge.datasets.pairs.evaluation_pair import build_evaluation_arrays, compute_pair_statistics, save_maps
from topomerge.datasets.pairs.example import build_pair_arrays
from topomerge.datasets.pairs.grid_pairs import (
    GRID_FORMAT,
    GridPair,
    build_grid,
    build_grid_arrays,
    compute_free_grid,
    measure_common_area,
)
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.real.sources import FOLDERS_BY_SOURCE, collect, iter_pair_makers, iter_real_pairs

from topomerge import archive
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.types import LogFn

LONGEST_PAIR = 600.0  # s of a processor a pair
POINTS_A_ROOM = 512  # a room


def build_real_pairs(
    data: str | Path,
    cache: Path,
    sources: Sequence[str],
    voxel_size: float = 0.1,
    log_line: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Build files of all real pairs of some sources, made where they are missing; what is refused is said and left out.

    Raises:
        InputError: no folder of real data.
    """
    if not str(data) or not Path(data).is_dir():
        raise InputError(f"{data or 'data.folder'}: no such folder; set TOPOMERGE_DATA to the one that holds the data sets")
    folder = cache / "real"
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for source in sources:
        files += _build_source(Path(data), folder, source, voxel_size, log_line)
    return files


def _build_source(data: Path, folder: Path, source: str, voxel_size: float, log_line: Callable[[str], None]) -> list[Path]:
    """Build the files of a source; a list of them lies beside, so that nothing is read where all are there."""
    whole = f"{source}-{compute_source_digest(data, source, voxel_size)}"
    listed = folder / f"{whole}.json"
    if listed.exists():
        return [folder / name for name in json.loads(listed.read_text(encoding="utf-8"))]
    names = []
    for title, make in _list_makers(data, source):
        path = folder / f"{hashlib.sha256(f'{whole}/{title}'.encode()).hexdigest()[:24]}.npz"
        if not path.exists():
            _, pair = next(iter(collect(source, iter([(title, make)]))))
            reason = pair.reason if isinstance(pair, Refusal) else _extract_and_write(pair, path, voxel_size)
            log_line(f"{source}/{title}: {reason or 'extracted'}")
            if reason:
                continue
        names.append(path.name)
    listed.write_text(json.dumps(names) + "\n", encoding="utf-8")
    return [folder / name for name in names]


def _list_makers(data: Path, source: str) -> list[tuple[str, Callable[[], Pair]]]:
    try:
        return list(iter_pair_makers(source, data))
    except Exception as error:
        raise InputError(f"{source}: can't be read ({' '.join(str(error).split())[:150]})") from error


def compute_source_digest(data: Path, source: str, voxel_size: float) -> str:
    """Compute the hash of a source's files, of the voxel size, and of the code and weights that make pairs and maps of them."""
    whole = hashlib.sha256(f"{compute_code_digest(__name__)} {voxel_size}".encode())
    for file in sorted(p for p in (data / FOLDERS_BY_SOURCE[source]).rglob("*") if p.is_file()):
        whole.update(file.relative_to(data).as_posix().encode() + hashlib.sha256(file.read_bytes()).digest())
    return whole.hexdigest()[:16]


def _extract_and_write(pair: Pair, path: Path, voxel_size: float) -> str:
    """Extract a pair and write its files; why it can't be done, or nothing."""
    try:
        with limit_time(LONGEST_PAIR):
            a, b = (extract(cloud, voxel_size=voxel_size) for cloud in (pair.a, pair.b))
            entries = {
                "file": path.name,
                "points_per_room": POINTS_A_ROOM,
                "title": pair.name,
                **compute_pair_statistics(pair, (a, b)),
            }
            arrays = build_pair_arrays(pair, (a, b), entries)
            arrays |= build_evaluation_arrays(pair, (a, b), (arrays["a.true_room"], arrays["b.true_room"]))
            save_maps((a, b), path.parent, path.stem)
            archive.write(arrays, path)
    except Exception as error:  # one bad pair never ends a run
        return f"{type(error).__name__}: {error}"[:200]
    return ""


SLICES = ["laser2d", "laser2d"]  # what the captures of the floor are to the verdict: seen at one height, with no scale


def iter_real_grid_pairs(folder: str | Path, sources: Sequence[str] | None = None) -> Iterator[GridPair]:
    """Yield the real pairs of some sources (all but those to choose by where None are named) at 0.1 m."""
    for name, pair in iter_real_pairs(folder, sources):
        if isinstance(pair, Pair):
            a, b = build_grid(pair.a), build_grid(pair.b)
            free = tuple(compute_free_grid(c, g) if c.poses is not None else c.free for c, g in ((pair.a, a), (pair.b, b)))
            about: dict[str, object] = {
                "sensors": list(pair.sensors),
                "kind": pair.kind,
                "building": pair.building,
                "source": pair.source,
            }
            about["overlap"] = pair.overlap
            common = measure_common_area(pair, a, b, (free[0], free[1]))
            yield GridPair(name, a, b, (free[0], free[1]), pair.truth, common, about)


def build_floor(folder: str | Path, cache: str | Path, log_line: LogFn = lambda text: None) -> list[Path]:
    """Build the files of the pairs of the development floor, in the order of the pairs, as `build_grids` makes those of simulated
    ones.

    Raises:
        InputError: the floor is not in the folder.
    """
    place = Path(cache).resolve() / "grids"
    place.mkdir(parents=True, exist_ok=True)
    listed = place.parent / "development_floor.jsonl"
    rows = [json.loads(line) for line in listed.read_text(encoding="utf-8").splitlines()] if listed.is_file() else []
    if rows and all((place / row["file"]).exists() for row in rows):
        return [place / row["file"] for row in rows]
    rows = []
    for pair in iter_real_grid_pairs(folder, ("office_floor",)):
        name = hashlib.sha256(json.dumps(["floor", GRID_FORMAT, pair.name]).encode()).hexdigest()[:24]
        about = {**pair.about, "sensors": SLICES, "scaled": True, "common": pair.common, "captures": pair.name.rpartition("/")[2]}
        arrays = {**build_grid_arrays("a", pair.a, pair.free[0]), **build_grid_arrays("b", pair.b, pair.free[1])}
        arrays["truth"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
        arrays["about"] = np.frombuffer(json.dumps(about, sort_keys=True, default=str).encode(), np.uint8)
        archive.write(arrays, place / f"{name}.npz")
        rows.append({"file": f"{name}.npz", "pair": pair.name})
        log_line(f"{pair.name}: {len(rows)}")
    listed.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return [place / row["file"] for row in rows]
