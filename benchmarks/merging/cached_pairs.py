"""The simulated pairs of grids, and drawings, that benchmarks of merging run on: those that the belief in merges is fitted to
(``train``) and judged on (``test``).

    python -m benchmarks.merging.cached_pairs test jobs=2       # makes what is missing, in cache/grids
"""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, build_grids, grid_items

from benchmarks.real_data import real_data
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


@cache
def other_buildings(split: str) -> dict[tuple[int, int], str]:
    """Of pairs of two buildings, by set and number: the name of the second one, which the files do not tell."""
    items, _ = grid_items(_settings(split).data)
    out = {}
    for k in items:
        if k.item.hard == "other-building":
            name = k.item.other[0]
            out[k.set, k.number] = f"{k.item.kind}-{name}-{k.item.storeys}" if k.item.source == "procedural" else name
    return out


def buildings_of(pair: GridPair, split: str) -> tuple[str, str]:
    """Names of the buildings of a and of b of a cached pair."""
    about: dict[str, Any] = pair.about
    whole = str(about["building"])
    if about["kind"] != "other-building":
        return whole, whole
    if "item" in about:
        return whole, other_buildings(split.removesuffix(DRAWN))[about["set"], about["item"]]
    first, _, second = whole.rpartition(" + ")  # of a drawing; storeys of one building are joined so, too
    return first, second


def places_of(names: tuple[str, str], sources: tuple[str, str] | None = None) -> dict[str, str]:
    """What a row of results tells of where its maps are from: names, sources and physical buildings of a and of b.

    Args:
        sources: None: as the names of cached pairs tell them.
    """
    sources = sources or (_source_of(names[0]), _source_of(names[1]))
    physical = [physical_building(*of) for of in zip(sources, names, strict=True)]
    out = {"source": sources[0], "building": names[0], "physical": physical[0]}
    return out | {"other_source": sources[1], "other": names[1], "physical_other": physical[1]}


def hard_of(pair: GridPair) -> list[str]:
    """What makes a cached pair hard beside its kind (`grid_pairs`: every sixth, every eighth)."""
    difficulty: dict[str, float] = pair.about.get("difficulty", {})  # type: ignore[assignment]
    limits = {"much moved furniture": ("moved", 0.6), "glass walls": ("glass", 0.5)}
    return [title for title, (name, least) in limits.items() if difficulty.get(name, 0.0) >= least]


def _source_of(name: str) -> str:
    """procedural, campus or r2v: what `grid_pairs.WEIGHTS` draws from."""
    if re.fullmatch(r"[a-z]+-\d+-\d+", name):
        return "procedural"
    return "campus" if name.startswith(("school/", "office/")) else "r2v"


def _settings(split: str, words: tuple[str, ...] = ()) -> Any:
    from topomerge.training.tasks import settings_of

    return settings_of(["task=merge_belief", f"data={SETS[split]}", *words])


def main(split: str, *words: str) -> None:
    """Make what is missing of a split.

    Raises:
        InputError: nothing tells where the real plans are, of which many pairs are.
    """
    real_data()
    settings = _settings(split, words)
    for build in (build_grids, build_drawings):
        print(build(settings.data, settings, lambda text: print(text, flush=True))[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
