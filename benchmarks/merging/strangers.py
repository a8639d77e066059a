"""False merges: maps of different buildings put together, of the cached pairs of a split (``cached_pairs.py``), and maps with
floor plans that are not theirs.

``python -m benchmarks.merging.strangers [split] [pairs]``; resumable: one line of JSON a pair in
``cache/merge/strangers_*.jsonl``.
None of them may be believed. Each map is prepared once and tried with several others; of the floor plans all are taken. Split
``real``: the maps of the real pairs, of two buildings or of two storeys of one.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Collection, Iterator
from functools import cache, partial
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.grid_pairs import load_grids

from benchmarks.merging.cached_pairs import pair_files
from benchmarks.merging.register import SCALELESS, real_pairs
from topomerge.fusion.registration import Prepared, Registration, prepare, register
from topomerge.types import VoxelGrid

Row = dict[str, Any]
STOREYS = "utexas"  # all maps of this source are of one building
STRIDE = 7  # pairs are laid out in blocks of so many pairs, so that few maps are in memory at once


@cache
def maps(path: Path) -> tuple[str, tuple[Prepared, Prepared], list[str]]:
    """Building, both maps and their sensors of a cached pair."""
    pair = load_grids(path)
    a, b = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    return str(pair.about["building"]), (a, b), list(pair.about["sensors"])  # type: ignore[call-overload]


def strangers(split: str) -> Iterator[tuple[Path, Path]]:
    """Neighbours in a shuffled order: a of one, b of another."""
    paths = pair_files(split)
    order = np.random.default_rng(0).permutation(len(paths))
    for start in range(0, len(order), STRIDE):
        maps.cache_clear()
        block = order[start : start + STRIDE]
        yield from ((paths[i], paths[j]) for i in block for j in block if i != j)


def of_strangers(split: str, many: int, done: Collection[str]) -> Iterator[Row]:
    """Maps of two buildings."""
    for count, (first, second) in enumerate(strangers(split)):
        name = f"{first.stem}+{second.stem}"
        if count >= many:
            return
        if name in done:
            continue
        (where, (a, _), seen), (other, (_, b), by) = maps(first), maps(second)
        if where != other:
            about = {"name": name, "kind": "strangers", "building": where, "sensors": [seen[0], by[1]]}
            yield _row(about, partial(register, a, b, refined=False))


def of_real(many: int, done: Collection[str]) -> Iterator[Row]:
    """Real maps of two places, so that each place meets each other one before any does so again."""
    places: dict[str, list[tuple[str, str, str, Prepared]]] = {}
    for pair in real_pairs():
        source = str(pair.about["source"])
        place = pair.name.split("/")[1].split("-")[0] if source == STOREYS else str(pair.about["building"])
        for grid, free, sensor, side in zip((pair.a, pair.b), pair.free, pair.about["sensors"], "ab", strict=True):  # type: ignore[call-overload]
            cells = VoxelGrid(grid.cells, grid.origin, grid.edge, grid.shape)
            places.setdefault(place, []).append((f"{pair.name}:{side}", source, sensor, prepare(cells, free)))
    rng, count = np.random.default_rng(0), 0
    while True:
        for where, other in combinations(sorted(places), 2):
            i, j = (int(rng.integers(len(places[k]))) for k in (where, other))
            (one, source, seen, a), (two, origin, by, b) = places[where][i], places[other][j]
            count += 1
            if count > many:
                return
            name = f"{one}+{two}"
            if name not in done:
                kind = "other-storey" if source == origin == STOREYS else "other-building"
                about = {"name": name, "kind": kind, "building": where, "sensors": [seen, by]}
                scale = "free" if {source, origin} & set(SCALELESS) else "fixed"
                yield _row(about, partial(register, a, b, scale=scale, refined=False))


def of_drawings(split: str, done: Collection[str]) -> Iterator[Row]:
    """Maps and floor plans of another building, another storey or another wing."""
    for path in pair_files(f"{split}_drawings"):
        if path.stem in done:
            continue
        pair = load_grids(path)
        if pair.about["kind"] == "overlap":
            continue
        keys = ("kind", "building", "sensors", "differs", "walls_differ", "scaled")
        about = {k: pair.about[k] for k in keys if k in pair.about}
        scale = "free" if pair.about["scaled"] else "fixed"
        run = partial(register, pair.a, pair.b, free=pair.free, scale=scale, refined=False)
        yield _row({"name": path.stem, **about}, run)


def _row(about: Row, run: Callable[[], Registration]) -> Row:
    began = time.process_time()
    registration = run()
    seconds = time.process_time() - began
    return {**about, "probability": registration.probability, "believed": registration.accepted, "seconds": seconds}


def main(split: str = "train", pairs: str = "100") -> None:
    """Run what is missing and count."""
    target = Path("cache/merge") / f"strangers_{split}.jsonl"
    done = {r["name"]: r for r in map(json.loads, target.read_text().splitlines())} if target.exists() else {}
    simulated = () if split == "real" else chain(of_drawings(split, done), of_strangers(split, int(pairs), done))
    for row in of_real(int(pairs), done) if split == "real" else simulated:
        done[row["name"]] = row
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")
    rows = list(done.values())
    wrong = [r for r in rows if r["believed"]]
    most = sorted((r["probability"] for r in rows), reverse=True)[:5]
    print(f"{len(rows)} pairs that must not merge: {len(wrong)} believed; highest probabilities {np.round(most, 2)}")
    for row in wrong:
        print(row)


if __name__ == "__main__":
    main(*sys.argv[1:])
