"""The simulated pairs of grids, and drawings, that benchmarks of merging run on: those that the belief in merges is fitted to
(``train``) and judged on (``test``).

    python -m benchmarks.merging.cached_pairs test jobs=2       # makes what is missing, in cache/grids
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import build_grids

from topomerge.errors import InputError

PAIRS_CACHE = Path("cache")
SETS = {"train": "grids", "test": "grids_heldout"}
DRAWN = "_drawings"  # of the names of splits


def pair_files(split: str, kinds: tuple[str, ...] = ()) -> list[Path]:
    """Files of a split, ``test_drawings`` among them, in their order; of these kinds, or all.

    Raises:
        InputError: they were not made yet.
    """
    name = SETS[split.removesuffix(DRAWN)] + (DRAWN if split.endswith(DRAWN) else "")
    manifest = PAIRS_CACHE / f"{name}.jsonl"
    if not manifest.is_file():
        made = f"python -m benchmarks.merging.cached_pairs {split.removesuffix(DRAWN)}"
        raise InputError(f"{manifest}: no such manifest; make it with {made}")
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    rows.sort(key=lambda row: (row.get("set", 0), row.get("item", 0), row["file"]))
    return [PAIRS_CACHE / "grids" / row["file"] for row in rows if not kinds or row["kind"] in kinds]


def main(split: str, *words: str) -> None:
    """Make what is missing of a split."""
    from topomerge.training.tasks import settings_of

    settings = settings_of(["task=merge_belief", f"data={SETS[split]}", *words])
    for build in (build_grids, build_drawings):
        print(build(settings.data, settings, lambda text: print(text, flush=True))[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
