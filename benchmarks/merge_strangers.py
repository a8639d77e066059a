"""False merges: maps of different buildings put together, of the cached pairs of a split (``merge_pairs.py``).

``python benchmarks/merge_strangers.py [split] [pairs]``; resumable: one line of JSON a pair in ``cache/merge/strangers_*.jsonl``.
None of them may be believed. Each map is prepared once and tried with several others.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from merge_pairs import load

from topomerge.fusion.registration import Prepared, prepare, register

STRIDE = 7  # pairs are laid out in blocks of so many pairs, so that few maps are in memory at once


@cache
def maps(path: Path) -> tuple[str, tuple[Prepared, Prepared], list[str]]:
    """Building, both maps and their sensors of a cached pair."""
    pair = load(path)
    a, b = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    return str(pair.about["building"]), (a, b), list(pair.about["sensors"])  # type: ignore[call-overload]


def strangers(split: str) -> Iterator[tuple[Path, Path]]:
    """Neighbours in a shuffled order: a of one, b of another."""
    paths = sorted((Path("cache/merge") / split).glob("*.npz"))
    order = np.random.default_rng(0).permutation(len(paths))
    for start in range(0, len(order), STRIDE):
        maps.cache_clear()
        block = order[start : start + STRIDE]
        yield from ((paths[i], paths[j]) for i in block for j in block if i != j)


def main(split: str = "train", pairs: str = "100") -> None:
    """Run what is missing and count."""
    target = Path("cache/merge") / f"strangers_{split}.jsonl"
    done = {r["name"]: r for r in map(json.loads, target.read_text().splitlines())} if target.exists() else {}
    for count, (first, second) in enumerate(strangers(split)):
        name = f"{first.stem}+{second.stem}"
        if count >= int(pairs):
            break
        if name in done:
            continue
        (where, (a, _), seen), (other, (_, b), by) = maps(first), maps(second)
        if where == other:
            continue
        began = time.process_time()
        found = register(a, b, refined=False)
        row = {"name": name, "buildings": [where, other], "sensors": [seen[0], by[1]], "probability": found.probability}
        row |= {"believed": found.accepted, "seconds": time.process_time() - began}
        done[name] = row
        with target.open("a") as out:
            out.write(json.dumps(row) + "\n")
    rows = list(done.values())
    wrong = [r for r in rows if r["believed"]]
    most = sorted((r["probability"] for r in rows), reverse=True)[:5]
    print(f"{len(rows)} pairs of maps of different buildings: {len(wrong)} believed; highest probabilities {np.round(most, 2)}")
    for row in wrong:
        print(row)


if __name__ == "__main__":
    main(*sys.argv[1:])
