"""Finding a place among many maps: are the right building and the right room among the first? (`fusion.atlas.find`)

``python -m benchmarks.retrieval [MANIFEST] [--descriptor NAME] [--write FILE]``: of a cached set of evaluation pairs (by default
``cache/evaluation/heldout.jsonl``, which ``python -m topomerge.datasets.pairs.build data=heldout cache=cache/evaluation`` makes)
the first map of each pair stands in the atlas, and the second map of each pair that has a room in common is looked for.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_set

from topomerge.embedding.embedders import embedder
from topomerge.embedding.turns import Rows
from topomerge.evaluation.tables import write_section
from topomerge.fusion.atlas.find import ranked
from topomerge.statistics import interval_text
from topomerge.types import Array

FIRST = (1, 5, 10)
HELDOUT = Path("cache/evaluation/heldout.jsonl")


@dataclass(frozen=True)
class Search:
    """A map that was looked for.

    Args:
        building: the physical one.
        rank: of the first map of its building, from 1.
        rooms: share of its rooms with a partner that stand beside it in the pair's map, if that map is named.
        seconds: of the search, without the rows of the new map.
    """

    building: str
    rank: int
    rooms: float
    seconds: float


def building(pair: EvaluationPair) -> str:
    """The physical building of a pair."""
    return physical_building(str(pair.about["source"]), str(pair.about["building"]))


def searches(pairs: Sequence[EvaluationPair], rows: Sequence[tuple[Rows, Rows]]) -> list[Search]:
    """Look for the second map of each pair that has a room in common among the first maps of all pairs."""
    names = [str(k) for k in range(len(pairs))]
    of = [building(pair) for pair in pairs]
    out = []
    for k, pair in enumerate(pairs):
        if not len(pair.matches):
            continue
        began = time.process_time()
        sightings = ranked(names, [a for a, _ in rows], rows[k][1], len(pairs))
        seconds = time.process_time() - began
        rank = next(n for n, s in enumerate(sightings, 1) if of[int(s.name)] == of[k])
        best = {new: room for new, room, _ in next(s for s in sightings if s.name == str(k)).rooms}
        true = {(int(i), int(j)) for i, j in pair.matches}
        with_partner = sorted({j for _, j in true})
        right = [(best.get(j), j) in true for j in with_partner]
        out.append(Search(of[k], rank, float(np.mean(right)), seconds))
    return out


def table(results: Sequence[Search], maps: int, buildings: int, rooms: int, name: str) -> str:
    """The results as Markdown."""
    groups = np.array([r.building for r in results])

    def share(values: Sequence[float]) -> str:
        return interval_text(np.array(values, float), groups)

    first = [share([r.rank <= n for r in results]) for n in FIRST]
    chance = [1 - (1 - 1 / buildings) ** n for n in FIRST]
    seconds: Array = np.array([r.seconds for r in results])
    return "\n".join(
        [
            f"{len(results)} maps of {len(set(groups))} physical buildings looked for among {maps} maps of {buildings} with "
            f"{rooms} rooms; in brackets 95 % intervals over buildings.",
            "",
            "| embedder | building first | among 5 | among 10 | rooms named right | s a search |",
            "|---|---|---|---|---|---|",
            f"| {name} | {' | '.join(first)} | {share([r.rooms for r in results])} | {np.median(seconds):.2f} |",
            f"| by chance | {' | '.join(f'{c:.2f}' for c in chance)} | | |",
        ]
    )


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, and write where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.retrieval", description=__doc__)
    parser.add_argument("manifest", nargs="?", type=Path, default=HELDOUT)
    parser.add_argument("--descriptor", default="learned", help="as of topomerge match")
    parser.add_argument("--write", type=Path, help="file whose section between the marks `retrieval` is replaced")
    args = parser.parse_args(words)
    pairs = load_set(args.manifest)
    describe = embedder(args.descriptor)
    rows = []
    for pair in pairs:
        a, b = pair.maps()
        rows.append((describe(a), describe(b)))
    results = searches(pairs, rows)
    buildings = len({building(pair) for pair in pairs})
    text = table(results, len(pairs), buildings, sum(len(a) for a, _ in rows), args.descriptor)
    command = " ".join(["python -m benchmarks.retrieval", *(sys.argv[1:] if words is None else words)])
    print(text)
    if args.write:
        write_section(args.write, "retrieval", f"`{command}`\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
