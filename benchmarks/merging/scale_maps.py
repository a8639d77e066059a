"""A thousand small simulated maps of three hundred buildings: what `benchmarks/merging/scale.py` measures large atlases with.

``python -m benchmarks.merging.scale_maps 300`` makes the maps of the first 300 buildings in ``cache/scale``, three or four of
each (ten of three buildings), and leaves out what is there: it may be stopped at any moment and started again. A map is a walk
through four rooms of a storey by depth camera or tablet, each with a session of its own: furniture, doors and drift differ.
Buildings are of the test split, which sets no weight; ``scale_maps 60 train`` makes some of the training split, to choose by, in
``cache/scale_train``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.pairs import Atlas
from topomerge.datasets.plans.splits import seeds

from benchmarks.merging.atlas_maps import sim3_of
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.atomic import replacing
from topomerge.io.maps import save_map
from topomerge.types import Sim3

SCALE_CACHE = Path("cache/scale")
SMALL_KINDS = ("house", "apartment", "hotel", "lab")
WALKS = ("depth", "tablet", "depth", "tablet")  # the last one of every third building only
ROOMS_OF_A_WALK = 4
SEEDS_TRIED = 10
FIRST_SEED = {"train": 500}  # from the first one of the split, whose first ones are those of benchmarks/extraction


@dataclass(frozen=True)
class ScaleMap:
    """A map that was made, and T_0k: where it lies in the first one of its building."""

    file: Path
    building: int
    truth: Sim3


def sensors_of(building: int) -> tuple[str, ...]:
    """One for each map of a building."""
    return WALKS if building % 3 == 0 else WALKS[:-1]


def cache_of(split: str) -> Path:
    """Where the maps of a split lie."""
    return SCALE_CACHE if split == "test" else SCALE_CACHE.with_name(f"{SCALE_CACHE.name}_{split}")


def _walks(building: int, split: str) -> Atlas:
    """The clouds of a building's maps: of the first seed whose rooms can all be reached."""
    first = seeds(split)[0] + FIRST_SEED.get(split, 0) + SEEDS_TRIED * building
    for seed in range(first, first + SEEDS_TRIED):
        try:
            made = make_building(SMALL_KINDS[building % len(SMALL_KINDS)], seed)
            return make_atlas(made, sensors_of(building), np.random.default_rng([building, 2]), ROOMS_OF_A_WALK)
        except InputError:
            continue
    raise InputError(f"no maps of building {building} can be made")


def make(building: int, split: str = "test") -> None:
    """Make the maps of a building, unless they are there."""
    folder = cache_of(split)
    about = folder / f"b{building:03d}.json"
    if about.exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    with one_thread():
        walks = _walks(building, split)
        for k, cloud in enumerate(walks.maps):
            path = folder / f"b{building:03d}_m{k}.tmap"
            save_map(replace(extract(cloud), source=path.stem), path)
    with replacing(about) as beside:
        beside.write_text(json.dumps({"building": walks.building, "truth": [t.matrix.tolist() for t in walks.truth]}))


def scale_maps(buildings: int, split: str = "test") -> Iterator[ScaleMap]:
    """The maps of the first buildings.

    Raises:
        InputError: they were not made.
    """
    folder = cache_of(split)
    for b in range(buildings):
        about = folder / f"b{b:03d}.json"
        if not about.exists():
            raise InputError(f"{about} is missing; python -m benchmarks.merging.scale_maps {buildings} {split} makes it")
        for k, matrix in enumerate(json.loads(about.read_text())["truth"]):
            yield ScaleMap(folder / f"b{b:03d}_m{k}.tmap", b, sim3_of(np.array(matrix)))


if __name__ == "__main__":
    for number in range(int(sys.argv[1])):
        make(number, *sys.argv[2:3])
        print(number, flush=True)
