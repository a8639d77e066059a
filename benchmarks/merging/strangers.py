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
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.grid_pairs import load_grids

from benchmarks.merging.cached_pairs import buildings_of, hard_of, pair_files, places_of
from benchmarks.merging.register import SCALELESS, real_pairs
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.types import VoxelGrid

Row = dict[str, Any]
STOREYS = ("campus", "rmf", "mall", "utexas")  # sources whose plans of one building are storeys of it
STRIDE = 7  # pairs are laid out in blocks of so many pairs, so that few maps are in memory at once


@dataclass(frozen=True, eq=False)
class Side:
    """A map that is tried with maps of other places.

    Args:
        name: of its pair.
        hard: what makes that hard (`hard_of`).
    """

    name: str
    source: str
    building: str
    sensor: str
    map: Prepared
    hard: Sequence[str] = ()


@cache
def maps(path: Path, split: str) -> tuple[Side, Side]:
    """Both maps of a cached pair."""
    pair = load_grids(path)
    names = buildings_of(pair, split)
    sources, (one, other) = places_of(names), list(pair.about["sensors"])  # type: ignore[call-overload]
    a, b = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    first = Side(path.stem, sources["source"], names[0], one, a, hard_of(pair))
    return first, Side(path.stem, sources["other_source"], names[1], other, b, hard_of(pair))


def strangers(split: str) -> Iterator[tuple[Path, Path]]:
    """Neighbours in a shuffled order: a of one, b of another."""
    paths = pair_files(split)
    order = np.random.default_rng(0).permutation(len(paths))
    for start in range(0, len(order), STRIDE):
        maps.cache_clear()
        block = order[start : start + STRIDE]
        yield from ((paths[i], paths[j]) for i in block for j in block if i != j)


def of_strangers(split: str, many: int, done: Collection[str]) -> Iterator[Row]:
    """Maps of two buildings, or of two storeys of one."""
    for count, (first, second) in enumerate(strangers(split)):
        name = f"{first.stem}+{second.stem}"
        if count >= many:
            return
        if name not in done:
            a, b = maps(first, split)[0], maps(second, split)[1]
            kind = kind_of_two(a, b)
            if kind:
                yield _row({**about_two(a, b), "name": name, "kind": kind}, partial(register, a.map, b.map))


def about_two(a: Side, b: Side) -> Row:
    """What a row tells of two maps."""
    places = places_of((a.building, b.building), (a.source, b.source))
    return {**places, "sensors": [a.sensor, b.sensor], "hard": sorted({*a.hard, *b.hard})}


def kind_of_two(a: Side, b: Side) -> str:
    """strangers; other-storey of one physical building; nothing where the maps may show one place."""
    if physical_building(a.source, a.building) != physical_building(b.source, b.building):
        return "strangers"
    storeys = [set(side.building.split(" + ")) for side in (a, b)]
    return "other-storey" if a.source in STOREYS and storeys[0].isdisjoint(storeys[1]) else ""


def of_real(many: int, done: Collection[str]) -> Iterator[Row]:
    """Real maps of two places, so that each place meets each other one before any does so again."""
    places: dict[str, list[Side]] = {}
    for pair in real_pairs():
        source = str(pair.about["source"])
        place = pair.name.split("/")[1].split("-")[0] if source == "utexas" else str(pair.about["building"])
        for grid, free, sensor, side in zip((pair.a, pair.b), pair.free, pair.about["sensors"], "ab", strict=True):  # type: ignore[call-overload]
            cells = VoxelGrid(grid.cells, grid.origin, grid.edge, grid.shape)
            places.setdefault(place, []).append(Side(f"{pair.name}:{side}", source, place, sensor, prepare(cells, free)))
    rng, count = np.random.default_rng(0), 0
    while True:
        for where, other in combinations(sorted(places), 2):
            a, b = (places[k][int(rng.integers(len(places[k])))] for k in (where, other))
            count += 1
            if count > many:
                return
            name = f"{a.name}+{b.name}"
            if name not in done:
                scale = "free" if {a.source, b.source} & set(SCALELESS) else "fixed"
                about = {**about_two(a, b), "name": name, "kind": kind_of_two(a, b)}
                yield _row(about, partial(register, a.map, b.map, scale=scale))


def of_drawings(split: str, done: Collection[str]) -> Iterator[Row]:
    """Maps and floor plans of another building, another storey or another wing."""
    for path in pair_files(f"{split}_drawings"):
        if path.stem in done:
            continue
        pair = load_grids(path)
        if pair.about["kind"] == "overlap":
            continue
        keys = ("kind", "sensors", "differs", "walls_differ", "scaled")
        about = {k: pair.about[k] for k in keys if k in pair.about} | {"hard": hard_of(pair)}
        scale = "free" if pair.about["scaled"] else "fixed"
        run = partial(register, pair.a, pair.b, free=pair.free, scale=scale)
        yield _row({"name": path.stem, **about, **places_of(buildings_of(pair, split))}, run)


def _row(about: Row, run: Callable[[], Registration]) -> Row:
    began = time.process_time()
    registration = run()
    seconds = time.process_time() - began
    return {
        **about,
        "probability": registration.probability,
        "believed": registration.accepted,
        "seconds": seconds,
        "posterior": registration.posterior,
    }


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
