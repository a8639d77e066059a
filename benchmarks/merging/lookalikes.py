"""False merges of places made to be alike: `register` and its verdict on look-alikes (`datasets.pairs.lookalikes`).

``python -m benchmarks.merging.lookalikes [split] [words]`` makes what is missing of ``train`` or ``test`` in cache/grids
(words: ``jobs=2``, ``data.pairs.mirror=5``, ...), runs what is missing and prints a table; resumable: a line of JSON a pair in
``cache/merge/lookalikes_<split>.jsonl``, with the fields of `strangers` and ``lookalike``, ``furniture``, ``tellable``,
``amount``, ``repeats``, ``common`` and two errors [horizontal m, vertical m, degrees]: ``err`` against the true pose, null where
the maps share nothing, and ``alike_err`` against the false one.

None may be believed but at a true pose. What nobody can tell apart is a column of its own: the right answer there is to abstain.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.build import Build
from topomerge.datasets.pairs.evaluation_pair import sim3_of
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids
from topomerge.datasets.pairs.lookalike_places import LOOKALIKES
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, build_lookalikes

from topomerge.config import compose
from topomerge.registration.pipeline import register
from topomerge.training.belief_hypotheses import error, right

LOOKALIKE_SETS = {"train": "lookalikes", "test": "lookalikes_heldout"}
COPIED = ("lookalike", "furniture", "tellable", "amount", "repeats", "kind", "building", "sensors", "common", "scaled")
Row = dict[str, Any]


@dataclass
class LookalikeBuild(Build):
    """Settings of the build."""

    data: LookalikeRecipe = field(default_factory=LookalikeRecipe)  # type: ignore[assignment]


def lookalike_files(split: str, words: Sequence[str] = ()) -> list[Path]:
    """The cached pairs of a split; what is missing is made."""
    settings = compose("build", LookalikeBuild, [f"data={LOOKALIKE_SETS[split]}", *words])
    paths, report = build_lookalikes(settings.data, settings, lambda text: print(text, file=sys.stderr, flush=True))
    print(f"{report.items} pairs, {report.made} made now in {report.seconds:.0f} s; refused: {report.refused}")
    return paths


def lookalike_row(pair: GridPair) -> Row:
    """What `register` says of a pair."""
    began = time.process_time()
    scale = "free" if pair.about["scaled"] else "fixed"
    registration = register(pair.a, pair.b, free=pair.free, scale=scale)
    seconds = time.process_time() - began
    about = {"name": pair.name, **{key: pair.about[key] for key in COPIED}}
    alike = None if pair.about["alike"] is None else sim3_of(np.array(pair.about["alike"]))
    pose = registration.transform
    at_alike = replace(pair, truth=alike, about={**pair.about, "kind": "overlap"})
    errors = {"err": pose and error(pose, pair), "alike_err": pose and error(pose, at_alike)}
    said = {"probability": registration.probability, "believed": registration.accepted, "posterior": registration.posterior}
    said |= {"seconds": seconds}
    return {**about, **errors, **said}


def believed_wrongly(row: Row) -> bool:
    """A false merge: believed, and not at a true pose."""
    return bool(row["believed"]) and not right(row["err"], row["sensors"])


def table(rows: Iterable[Row]) -> str:
    """Markdown: false merges by kind, of pairs that somebody could tell apart and of those that nobody could; and pairs with
    rooms in common: merged right."""
    rows = list(rows)
    lines = [
        "| kind | distinguishable | believed wrongly | indistinguishable | believed wrongly | rooms in common | merged right |"
    ]
    lines.append("|---|---|---|---|---|---|---|")
    for kind in (*LOOKALIKES, "unknown scale", "empty", "all"):
        of = [r for r in rows if kind in (r["lookalike"], "all") or (kind == "empty" and r["furniture"] == "empty")]
        of += [r for r in rows if kind == "unknown scale" and r["scaled"]]
        cells = [kind]
        for tellable in (True, False):
            some = [r for r in of if r["tellable"] == tellable]
            cells += [str(len(some)), str(sum(map(believed_wrongly, some)))]
        shared = [r for r in of if r["kind"] == "overlap"]
        cells += [str(len(shared)), str(sum(r["believed"] and right(r["err"], r["sensors"]) for r in shared))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(split: str = "test", *words: str) -> None:
    """Make and run what is missing, and count."""
    paths = lookalike_files(split, words)
    target = Path("cache/merge") / f"lookalikes_{split}.jsonl"
    target.parent.mkdir(parents=True, exist_ok=True)
    done = {r["name"]: r for r in map(json.loads, target.read_text().splitlines())} if target.exists() else {}
    for path in (p for p in paths if p.stem not in done):
        done[path.stem] = lookalike_row(load_grids(path))
        with target.open("a") as out:
            out.write(json.dumps(done[path.stem]) + "\n")
    print(table(done[path.stem] for path in paths))


if __name__ == "__main__":
    main(*sys.argv[1:])
