"""The pairs of maps, as cells, that merges are measured on: simulated ones (those that the belief in merges is fitted to are
``train``, those that it is judged on ``test``), drawings, look-alikes, and real ones."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.config import compose
from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.build import Build
from topomerge.datasets.pairs.grid_drawings import build_drawings
from topomerge.datasets.pairs.grid_pairs import GridPair, build_grids, grid_items
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, build_lookalikes
from topomerge.datasets.real.cached_grids import real_grid_pairs
from topomerge.evaluation.tasks import Say, find_real_data
from topomerge.training.tasks import settings_of
from topomerge.types import Array, Sim3

SETS = {"train": "grids", "test": "grids_heldout"}
LOOKALIKE_SETS = {"train": "lookalikes", "test": "lookalikes_heldout"}
DRAWN = "_drawings"  # of the names of splits
SCALELESS = ("halmstad",)  # no metres per pixel are known
# Split -> sources of `datasets.real`; None: all that evaluate.
REAL_SPLITS = {"real": None, "development": ("office_floor",), "storeys": ("storeys",)}


@dataclass
class LookalikeBuild(Build):
    """Settings of the build of look-alikes."""

    data: LookalikeRecipe = field(default_factory=LookalikeRecipe)  # type: ignore[assignment]


def make_pair_files(split: str, cache: str, jobs: int, say: Say) -> list[Path]:
    """Make the files of a split, ``test_drawings`` among them, that are missing; all in their order.

    Raises:
        InputError: nothing tells where the real plans are, of which many pairs are.
    """
    find_real_data()
    settings = read_recipe(split, (f"cache={cache}", f"jobs={jobs}"))
    made = build_drawings if split.endswith(DRAWN) else build_grids
    return list(made(settings.data, settings, say)[0])


def make_lookalike_files(split: str, cache: str, jobs: int, say: Say) -> list[Path]:
    """Make the files of look-alikes of a split that are missing; all in their order."""
    settings = compose("build", LookalikeBuild, [f"data={LOOKALIKE_SETS[split]}", f"cache={cache}", f"jobs={jobs}"])
    paths, report = build_lookalikes(settings.data, settings, say)
    say(f"{report.items} pairs, {report.made} made now; refused: {report.refused}")
    return paths


def iterate_real_pairs(split: str = "real") -> Iterator[GridPair]:
    """Iterate over the real pairs, at 0.1 m; of splits ``development`` and ``storeys`` those that one may choose by."""
    return real_grid_pairs(str(find_real_data()), REAL_SPLITS[split])


def upright(matrix: Array, pair: GridPair) -> Sim3 | None:
    """Turn a pose into one under gravity that keeps the place where errors are measured; None where the map was turned over."""
    if not np.isfinite(matrix).all() or matrix[2, 2] < 0.9:
        return None
    yaw = float(np.arctan2(matrix[1, 0], matrix[0, 0]))
    placed = matrix[:3, :3] @ pair.anchor + matrix[:3, 3] - Sim3(yaw).apply(pair.anchor[None])[0]
    x, y, z = placed.tolist()
    return Sim3(yaw, (x, y, z))


@cache
def other_buildings(split: str) -> dict[tuple[int, int], str]:
    """Of pairs of two buildings, by set and number: the name of the second one, which the files do not tell."""
    items, _ = grid_items(read_recipe(split).data)
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
    sources = sources or (find_source(names[0]), find_source(names[1]))
    physical = [physical_building(*of) for of in zip(sources, names, strict=True)]
    out = {"source": sources[0], "building": names[0], "physical": physical[0]}
    return out | {"other_source": sources[1], "other": names[1], "physical_other": physical[1]}


def hard_of(pair: GridPair) -> list[str]:
    """What makes a cached pair hard beside its kind (`grid_pairs`: every sixth, every eighth)."""
    difficulty: dict[str, float] = pair.about.get("difficulty", {})  # type: ignore[assignment]
    limits = {"much moved furniture": ("moved", 0.6), "glass walls": ("glass", 0.5)}
    return [title for title, (name, least) in limits.items() if difficulty.get(name, 0.0) >= least]


def find_source(name: str) -> str:
    """Find the source of a building, procedural, campus or r2v: what `grid_pairs.WEIGHTS` draws from."""
    if re.fullmatch(r"[a-z]+-\d+-\d+", name):
        return "procedural"
    return "campus" if name.startswith(("school/", "office/")) else "r2v"


def read_recipe(split: str, words: tuple[str, ...] = ()) -> Any:
    """Read the settings of the task that the pairs of a split are made with."""
    return settings_of(["task=merge_belief", f"data={SETS[split.removesuffix(DRAWN)]}", *words])


def find_places(pair: GridPair, split: str) -> dict[str, str]:
    """Find source and buildings of a pair (`places_of`)."""
    if split in REAL_SPLITS:
        name, source = str(pair.about["building"]), str(pair.about["source"])
        return places_of((name, name), (source, source))
    return places_of(buildings_of(pair, split))
