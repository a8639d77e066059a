"""Real pairs, extracted once and written like simulated ones (`pairs.evaluation_pair`): a file a pair, named by its inputs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from topomerge.datasets.core.builder import time_limit
from topomerge.datasets.pairs.evaluation_pair import evaluation_arrays, pair_statistics, save_maps
from topomerge.datasets.pairs.example import pair_arrays
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.plans.floorplans import Refusal
from topomerge.datasets.real.sources import FOLDERS_BY_SOURCE, collect, pair_makers

from topomerge.code_digest import code_digest
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io import archive

LONGEST_PAIR = 600.0  # s a pair
POINTS_A_ROOM = 512  # a room


def real_evaluation_pairs(
    data: str | Path, cache: Path, sources: Sequence[str], voxel_size: float = 0.1, say: Callable[[str], None] = lambda text: None
) -> list[Path]:
    """Files of all real pairs of some sources, made where they are missing; what is refused is said and left out.

    Raises:
        InputError: no folder of real data.
    """
    if not str(data) or not Path(data).is_dir():
        raise InputError(f"{data or 'data.folder'}: no such folder; set TOPOMERGE_DATA to the one that holds the data sets")
    folder = cache / "real"
    folder.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    for source in sources:
        files += _source(Path(data), folder, source, voxel_size, say)
    return files


def _source(data: Path, folder: Path, source: str, voxel_size: float, say: Callable[[str], None]) -> list[Path]:
    """Files of a source; a list of them lies beside, so that nothing is read where all are there."""
    whole = f"{source}-{digest(data, source, voxel_size)}"
    listed = folder / f"{whole}.json"
    if listed.exists():
        return [folder / name for name in json.loads(listed.read_text(encoding="utf-8"))]
    names = []
    for title, make in _makers(data, source):
        path = folder / f"{hashlib.sha256(f'{whole}/{title}'.encode()).hexdigest()[:24]}.npz"
        if not path.exists():
            _, pair = next(iter(collect(source, iter([(title, make)]))))
            reason = pair.reason if isinstance(pair, Refusal) else _extract_and_write(pair, path, voxel_size)
            say(f"{source}/{title}: {reason or 'extracted'}")
            if reason:
                continue
        names.append(path.name)
    listed.write_text(json.dumps(names) + "\n", encoding="utf-8")
    return [folder / name for name in names]


def _makers(data: Path, source: str) -> list[tuple[str, Callable[[], Pair]]]:
    try:
        return list(pair_makers(source, data))
    except Exception as error:
        raise InputError(f"{source}: can't be read ({' '.join(str(error).split())[:150]})") from error


def digest(data: Path, source: str, voxel_size: float) -> str:
    """Hash of a source's files, of the voxel size, and of the code and weights that make pairs and maps of them."""
    whole = hashlib.sha256(f"{code_digest(__name__)} {voxel_size}".encode())
    for file in sorted(p for p in (data / FOLDERS_BY_SOURCE[source]).rglob("*") if p.is_file()):
        whole.update(file.relative_to(data).as_posix().encode() + hashlib.sha256(file.read_bytes()).digest())
    return whole.hexdigest()[:16]


def _extract_and_write(pair: Pair, path: Path, voxel_size: float) -> str:
    """Extract a pair and write its files; why it can't be done, or nothing."""
    try:
        with time_limit(LONGEST_PAIR):
            a, b = (extract(cloud, voxel_size=voxel_size) for cloud in (pair.a, pair.b))
            entries = {"file": path.name, "points_per_room": POINTS_A_ROOM, "title": pair.name, **pair_statistics(pair, (a, b))}
            arrays = pair_arrays(pair, (a, b), entries)
            arrays |= evaluation_arrays(pair, (a, b), (arrays["a.true_room"], arrays["b.true_room"]))
            save_maps((a, b), path.parent, path.stem)
            archive.write(arrays, path)
    except Exception as error:  # one bad pair never ends a run
        return f"{type(error).__name__}: {error}"[:200]
    return ""
