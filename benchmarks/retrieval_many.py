"""Finding a place among hundreds of small maps: each of those of `merging/scale_maps.py` looked for among all others.

``python -m benchmarks.retrieval_many 300 [--descriptor NAME] [--write FILE]``: maps of the first 300 buildings, which
``python -m benchmarks.merging.scale_maps 300`` makes. Looked for are those that show `SHARED` m2 or more of what another map of
their building shows; the others only stand in the way. A map is a walk through four rooms: it shows a quarter of what
those of `retrieval.py` do.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.evaluation_pair import common_area

from benchmarks.merging.laid_coarsely import held
from benchmarks.merging.scale_maps import SCALE_CACHE, ScaleMap, scale_maps
from benchmarks.retrieval import FIRST
from topomerge.embedding.embedders import embedder
from topomerge.embedding.turns import Rows
from topomerge.evaluation.tables import write_section
from topomerge.fusion.atlas.find import LAID_COARSELY, SHORTLIST, Sighting, ranked, shortlist
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.partners import coarse_log_odds, nearest, owners, queries, vectors, votes
from topomerge.io.maps import load_map
from topomerge.statistics import interval_text
from topomerge.types import Array

SHARED = 10.0  # m2


@dataclass(frozen=True, eq=False)
class Described:
    """A map of a building: its rooms' rows, and the most that another map of the building shows of it, m2."""

    building: int
    rows: Rows
    shared: float


def described(maps: Sequence[ScaleMap], descriptor: str) -> list[Described]:
    """The maps, building by building, so that those of one building only are in memory at once."""
    describe, out = embedder(descriptor), []
    for number in sorted({m.building for m in maps}):
        of = [m for m in maps if m.building == number]
        opened = [load_map(m.file) for m in of]
        shared = np.zeros(len(of))
        for i, j in permutations(range(len(of)), 2):
            truth = of[i].truth.inverse() @ of[j].truth
            shared[j] = max(shared[j], common_area([opened[i], opened[j]], truth))
        out += [Described(number, describe(m), float(s)) for m, s in zip(opened, shared, strict=True)]
    return out


def search(maps: Sequence[Described], compared: int) -> tuple[Array, Array]:
    """Of each map that shares enough: the rank of the first other map of its building, from 1, and the seconds of the search.

    Args:
        compared: maps that are compared room by room; with fewer than all by a shortlist.
    """
    ranks, seconds = [], []
    for k, began, sightings in _sighted(maps, compared):
        seconds.append(time.process_time() - began)
        ranks.append(_rank(maps, k, [int(s.name) for s in sightings]))
    return np.array(ranks), np.array(seconds)


def _sighted(maps: Sequence[Described], compared: int) -> Iterator[tuple[int, float, tuple[Sighting, ...]]]:
    """Each map that shares enough, when its search began, and what it gave."""
    places = np.concatenate([vectors(m.rows) for m in maps])
    owner = owners([len(m.rows) for m in maps])
    for k, new in enumerate(maps):
        if new.shared < SHARED:
            continue
        began = time.process_time()
        others = list(range(len(maps)))
        if compared < len(maps):
            asked, mine = queries(new.rows), np.flatnonzero(owner == k)
            near = nearest(places, np.concatenate(asked), but=(int(mine[0]), int(mine[-1]) + 1))
            others = shortlist(votes(*near, len(asked), owner, len(maps)), compared)
        others = [n for n in others if n != k]
        yield k, began, ranked([str(n) for n in others], [maps[n].rows for n in others], new.rows, compared)


def _rank(maps: Sequence[Described], k: int, order: Sequence[int]) -> int:
    """Of the first other map of the building of map k, from 1; of none on the shortlist the last."""
    return next((n for n, m in enumerate(order, 1) if maps[m].building == maps[k].building), len(maps))


def laid_search(maps: Sequence[Described], held: Maps, compared: int) -> tuple[Array, Array]:
    """As `search`, with the first of each search ordered by how well the map lies on them, as `find` does.

    Args:
        held: the maps, with what was laid coarsely before.
    """
    ranks, seconds = [], []
    for k, began, sightings in _sighted(maps, compared):
        first = [int(s.name) for s in sightings[:LAID_COARSELY]]
        order = sorted(first, key=lambda n, k=k: -coarse_log_odds(held, k, n))  # type: ignore[misc]
        seconds.append(time.process_time() - began)
        ranks.append(_rank(maps, k, [*order, *(int(s.name) for s in sightings[LAID_COARSELY:])]))
    return np.array(ranks), np.array(seconds)


def table(maps: Sequence[Described], results: Sequence[tuple[str, Array, Array]]) -> str:
    """Named results as Markdown."""
    groups = np.array([m.building for m in maps if m.shared >= SHARED])
    lines = [
        f"Queries: {len(groups)} maps of {len(set(groups.tolist()))} buildings that share {SHARED:g} m² or more with another "
        f"map; atlas: the other {len(maps) - 1} maps of {len({m.building for m in maps})} buildings "
        f"({sum(len(m.rows) for m in maps)} rooms in all). In brackets 95 % intervals over buildings.",
        "",
        "| embedder | building first | among 5 | among 10 | s per query |",
        "|---|---|---|---|---|",
    ]
    for name, ranks, seconds in results:
        first = [interval_text((ranks <= n).astype(float), groups) for n in FIRST]
        lines.append(f"| {name} | {' | '.join(first)} | {np.median(seconds):.2f} |")
    alike = np.mean([sum(o.building == m.building for o in maps) - 1 for m in maps if m.shared >= SHARED]) / (len(maps) - 1)
    chance = " | ".join(f"{1 - (1 - alike) ** n:.2f}" for n in FIRST)
    return "\n".join([*lines, f"| by chance | {chance} | |"])


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, and write where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.retrieval_many", description=__doc__)
    parser.add_argument("buildings", type=int, help="how many")
    parser.add_argument("--descriptor", default="learned", help="as of topomerge match")
    parser.add_argument("--write", type=Path, help="file whose section between the marks `retrieval-many` is replaced")
    args = parser.parse_args(words)
    maps = described(list(scale_maps(args.buildings)), args.descriptor)
    results = [(args.descriptor, *search(maps, len(maps)))]
    results.append((f"{args.descriptor}, shortlist of {SHORTLIST}", *search(maps, SHORTLIST)))
    laid = f"{args.descriptor}, shortlist, {LAID_COARSELY} aligned coarsely"
    with one_thread():
        results.append((laid, *laid_search(maps, held(list(scale_maps(args.buildings)), SCALE_CACHE), SHORTLIST)))
    command = " ".join(["python -m benchmarks.retrieval_many", *(sys.argv[1:] if words is None else words)])
    text = table(maps, results)
    print(text)
    if args.write:
        write_section(args.write, "retrieval-many", f"`{command}`\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
