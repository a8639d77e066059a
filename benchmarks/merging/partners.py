"""Which pairs of an atlas are worth a registration: how many of those that share a place are among those that are registered.

``python -m benchmarks.merging.partners 60 train [--write FILE]``: maps of the first 60 buildings of the training split, to choose
by, which ``python -m benchmarks.merging.scale_maps 60 train`` makes; ``300 test`` those that test. A pair shares a place if both
maps saw `SHARED` m2 of it. What atlases of these maps (``benchmarks/merging/scale.py``) have laid coarsely is not laid again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.evaluation_pair import common_area

from benchmarks.merging.laid_coarsely import held
from benchmarks.merging.scale_maps import ScaleMap, cache_of, scale_maps
from benchmarks.retrieval_many import SHARED
from topomerge.evaluation.tables import write_section
from topomerge.fusion.atlas.partners import COARSE_PARTNERS, LIKELY_PARTNERS, MOST_PARTNERS, most_alike, partners_of
from topomerge.io.maps import load_map
from topomerge.statistics import interval_text

BY_LOOKS = (10, COARSE_PARTNERS)  # partners that a map names
Pairs = set[tuple[int, int]]


def pairs_that_share(maps: Sequence[ScaleMap]) -> Pairs:
    """Pairs of maps of one building that saw enough of one place."""
    out = set()
    for number in sorted({m.building for m in maps}):
        of = [k for k, m in enumerate(maps) if m.building == number]
        opened = {k: load_map(maps[k].file) for k in of}
        for i, j in combinations(of, 2):
            if common_area([opened[i], opened[j]], maps[i].truth.inverse() @ maps[j].truth) >= SHARED:
                out.add((i, j))
    return out


def joinable(count: int, pairs: Pairs) -> int:
    """How many maps pairs join to another one, a set of them less its first one."""
    ends = np.array(sorted(pairs), np.int64).reshape(-1, 2).T
    links = coo_array((np.ones(len(pairs)), tuple(ends)), shape=(count, count))
    return count - int(connected_components(links, directed=False)[0])


def study(maps: Sequence[ScaleMap], folder: Path) -> str:
    """The table."""
    atlas = held(maps, folder)
    share = pairs_that_share(maps)
    began = time.process_time()
    rows = [atlas.rows(k) for k in range(len(atlas))]
    described = time.process_time() - began
    before = len(atlas.memory.coarse)
    chosen = {}
    for number in BY_LOOKS:
        named = most_alike(rows, number)
        chosen[f"the {number} most similar maps"] = {(min(k, m), max(k, m)) for k, of in enumerate(named) for m in of}
    began = time.process_time()
    best = partners_of(atlas)[0]
    laid, seconds = len(atlas.memory.coarse) - before, time.process_time() - began
    words = f"of these {COARSE_PARTNERS}, the {MOST_PARTNERS} that align best coarsely, and the {LIKELY_PARTNERS} most similar"
    chosen[words] = {(min(k, m), max(k, m)) for k, of in enumerate(best) for m in of}
    true, possible = sorted(share), joinable(len(maps), share)
    groups = np.array([maps[i].building for i, _ in true])
    lines = [
        f"{len(maps)} maps of {len({m.building for m in maps})} buildings; {len(share)} pairs share {SHARED:g} m² or more, "
        f"through which {possible} maps can be joined to others. In brackets 95 % intervals over buildings.",
        "",
        "| a map is registered with | pairs per map | share of the pairs with a common place | maps that can be joined |",
        "|---|---|---|---|",
    ]
    for name, pairs in chosen.items():
        recall = interval_text(np.array([pair in pairs for pair in true], float), groups)
        joined = joinable(len(maps), share & pairs)
        lines.append(f"| {name} | {2 * len(pairs) / len(maps):.1f} | {recall} | {joined} of {possible} |")
    if laid:
        each = 1000 * seconds / laid, 1000 * described / len(maps)
        lines += [
            "",
            f"On one core: {each[0]:.0f} ms per coarse alignment of a pair, {each[1]:.0f} ms per map for room descriptors.",
        ]
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, and write where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.merging.partners", description=__doc__)
    parser.add_argument("buildings", type=int, help="how many")
    parser.add_argument("split", choices=("train", "test"))
    parser.add_argument("--write", type=Path, help="file whose section between the marks `partners-SPLIT` is replaced")
    args = parser.parse_args(words)
    with one_thread():
        text = study(list(scale_maps(args.buildings, args.split)), cache_of(args.split))
    print(text)
    if args.write:
        command = " ".join(["python -m benchmarks.merging.partners", *(sys.argv[1:] if words is None else words)])
        write_section(args.write, f"partners-{args.split}", f"`{command}`\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
