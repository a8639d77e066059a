"""Sets of simulated partial maps of one building, extracted and cached: what `benchmarks/merging/atlas.py` measures atlases with.

``python -m benchmarks.merging.atlas_maps test 8 4`` makes four sets of eight maps in ``cache/atlas/test``, unless they are there.
Sensors and kinds of building are mixed; in every second set of four or more maps the last map is of another building of the same
kind, which must stay apart. Buildings of the test split set no weight.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import one_thread
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.pairs import Atlas
from topomerge.datasets.plans.splits import seeds

from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.maps import save_map
from topomerge.types import Array, Sim3

ATLAS_KINDS = ("office", "hospital", "school", "hotel", "lab", "openplan")
ATLAS_SENSORS = {"tls": 3, "lidar": 2, "depth": 3, "tablet": 1, "laser2d": 1}
ATLAS_ROOMS = (6, 12)  # of a map, fewest and most
ATLAS_CACHE = Path("cache/atlas")


@dataclass(frozen=True)
class AtlasSet:
    """Files of maps, T_0k of each (None: of another building), and what they were made of."""

    name: str
    files: tuple[Path, ...]
    truth: tuple[Sim3 | None, ...]
    about: dict[str, object]


def draw(split: str, maps: int, number: int) -> tuple[Atlas, Atlas | None]:
    """The clouds of a set, and where it has one the other building's."""
    rng = np.random.default_rng([maps, number, {"train": 0, "validation": 1, "test": 2}[split]])
    names = sorted(ATLAS_SENSORS)
    weight = np.array([ATLAS_SENSORS[n] for n in names], float)
    sensors = rng.choice(names, maps, p=weight / weight.sum()).tolist()
    first, last = seeds(split)
    for _ in range(20):
        kind, seed = str(rng.choice(ATLAS_KINDS)), int(rng.integers(first, last))
        rooms = int(rng.integers(ATLAS_ROOMS[0], ATLAS_ROOMS[1] + 1))
        other = number % 2 == 1 and maps >= 4
        try:
            atlas = make_atlas(make_building(kind, seed), sensors, rng, rooms)
            return atlas, make_atlas(make_building(kind, seed + 1), sensors[-2:], rng, rooms) if other else None
        except InputError:
            continue
    raise InputError(f"no set of {maps} maps number {number} can be made")


def make(split: str, maps: int, number: int) -> Path:
    """Make one set, unless it is there."""
    folder = ATLAS_CACHE / split / f"{maps:02d}_{number:02d}"
    if (folder / "truth.json").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    with one_thread():
        atlas, other = draw(split, maps, number)
        clouds = list(atlas.maps)
        truth: list[Array | None] = [t.matrix for t in atlas.truth]
        if other is not None:
            clouds[-1], truth[-1] = other.maps[1], None
        for k, cloud in enumerate(clouds):
            name = f"map_{k:02d}_{atlas.sensors[k]}"
            save_map(replace(extract(cloud), source=name), folder / f"{name}.tmap")
    rooms = [[k, m, len(shared)] for (k, m), shared in sorted(atlas.shared.items())]
    about = {
        "building": atlas.building,
        "sensors": atlas.sensors,
        "shared": rooms,
        "truth": [None if t is None else t.tolist() for t in truth],
    }
    (folder / "truth.json").write_text(json.dumps(about))
    print(f"{folder} {atlas.building} {time.perf_counter() - began:.0f} s", flush=True)
    return folder


def load(folder: Path) -> AtlasSet:
    """A set that was made."""
    about = json.loads((folder / "truth.json").read_text())
    truth = tuple(None if t is None else sim3_of(np.array(t)) for t in about.pop("truth"))
    return AtlasSet(folder.name, tuple(sorted(folder.glob("map_*.tmap"))), truth, about)


def sim3_of(matrix: Array) -> Sim3:
    """The similarity of a (4, 4) matrix."""
    x, y, z = matrix[:3, 3].tolist()
    return Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), float(matrix[2, 2]))


def sets(split: str, maps: int) -> Iterator[AtlasSet]:
    """All sets of so many maps that were made."""
    for folder in sorted((ATLAS_CACHE / split).glob(f"{maps:02d}_*")):
        if (folder / "truth.json").exists():
            yield load(folder)


if __name__ == "__main__":
    for number in range(int(sys.argv[3])):
        make(sys.argv[1], int(sys.argv[2]), number)
