"""Atlases of sets of simulated maps: time, maps placed right and wrong, registrations that were needed.

``python evaluate.py task=atlases data=test sizes=[2,4,8,16] sets=4`` makes the sets that are missing and puts each together.
Sensors and kinds of building are mixed; in every second set of four or more maps the last map is of another building of the same
kind, which must stay apart. A map is right within 0.5 m and 5 degrees of where it lies in the first map of its component, at its
own middle; with slices, which say nothing of heights, seen from above. Rows are kept when the code changes.

``data=small``: many small maps, three or four of each building, of four rooms, by depth camera or tablet; ``signs=.5``: half of
them have read the signs at their doors.
"""

from __future__ import annotations

import json
import resource
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.evaluation_pair import convert_to_sim3
from topomerge.datasets.pairs.pairs import Atlas, simulate_signs
from topomerge.datasets.plans.splits import get_seed_range
from topomerge.datasets.simulation.signs import READERS
from topomerge.errors import InputError
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, measure_missing
from topomerge.extraction.extract import extract
from topomerge.extraction.landmarks import add_landmarks
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import build_atlas
from topomerge.io.maps import save_map
from topomerge.matching.poses import pose_difference
from topomerge.types import Array, Landmarks, LogFn, Sim3

MAKERS = ("topomerge.extraction.extract", "topomerge.fusion.atlas.solve", "topomerge.datasets.pairs.atlases")
RIGHT = (0.5, np.radians(5.0))  # m, rad
ATLAS_COLUMNS: tuple[str, ...] = (
    "maps",
    "sets",
    "s on one core",
    "slowest",
    "peak MiB",
    "pairs registered",
    "of",
    "placed right",
    "wrong",
)
ATLAS_COLUMNS += ("median error m",)
ATLAS_KINDS = ("office", "hospital", "school", "hotel", "lab", "openplan")
ATLAS_SENSORS = {"tls": 3, "lidar": 2, "depth": 3, "tablet": 1, "laser2d": 1}
ATLAS_ROOMS = (6, 12)  # of a map, fewest and most
SMALL, SMALL_ROOMS, SMALL_SENSORS, OF_A_BUILDING = "small", 4, ("depth", "tablet"), (3, 4)


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        sizes: numbers of maps.
        sets: of each size.
        signs: share of the maps that have read the signs at their doors; of ``data=small`` only.
    """

    sizes: list[int] = field(default_factory=lambda: [2, 4])
    sets: int = 2
    signs: float = 0.0


def list_sets(settings: Settings) -> list[tuple[str, int, int]]:
    """List split, size and number of each set."""
    split = settings.data.set or "train"
    split = f"{SMALL}-{settings.signs:g}" if split == SMALL else split
    return [(split, size, number) for size in settings.sizes for number in range(settings.sets)]


def list_inputs(settings: Settings) -> list[str]:
    """Return names of the sets."""
    return [str(one) for one in list_sets(settings)]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure the sets that are missing."""
    cache = Path(settings.cache) / "atlas"
    if settings.signs and settings.data.set != SMALL:
        raise InputError(f"signs={settings.signs:g}: needs data={SMALL}")
    sets = list_sets(settings)
    items = {f"{split if SMALL in split else ''}{size:02d}_{k:02d}": (split, size, k, cache) for split, size, k in sets}
    path = Path(settings.cache) / "evaluation" / f"atlases_{settings.data.set or 'train'}.jsonl"
    return measure_missing(path, items, measure_set, log_line, settings)


@dataclass(frozen=True)
class AtlasSet:
    """Files of maps, T_0k of each (None: of another building), and what they were made of."""

    name: str
    files: tuple[Path, ...]
    truth: tuple[Sim3 | None, ...]
    about: dict[str, object]


def draw_set(split: str, maps: int, number: int) -> tuple[Atlas, Atlas | None]:
    """Return the clouds of a set, and where it has one the other building's."""
    rng = np.random.default_rng([maps, number, {"train": 0, "validation": 1, "test": 2}[split]])
    names = sorted(ATLAS_SENSORS)
    weight = np.array([ATLAS_SENSORS[n] for n in names], float)
    sensors = rng.choice(names, maps, p=weight / weight.sum()).tolist()
    first, last = get_seed_range(split)
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


def make_small_set(signs: float, count: int, number: int, folder: Path) -> None:
    """Make small maps of many buildings of the test split, a share of which has read the signs at their doors."""
    rng, first_seed = np.random.default_rng([count, number, 51]), get_seed_range("test")[0]
    truth: list[Array] = []
    sensors: list[str] = []
    places: list[int] = []
    while len(truth) < count:
        place = len(set(places))
        kind, seed = ATLAS_KINDS[place % len(ATLAS_KINDS)], first_seed + 5_000 + 1_000 * number + place
        count_here = min(int(rng.choice(OF_A_BUILDING)), max(count - len(truth), 2))
        building = make_building(kind, seed)
        atlas = make_atlas(building, rng.choice(SMALL_SENSORS, count_here).tolist(), rng, SMALL_ROOMS)
        for cloud, frame, to_first, sensor in zip(atlas.maps, atlas.frames, atlas.truth, atlas.sensors, strict=True):
            name, read = f"map_{len(truth):04d}_{sensor}", rng.random() < signs
            landmarks = simulate_signs(building, cloud, READERS["good"], frame)[0] if read else Landmarks()
            save_map(add_landmarks(replace(extract(cloud), source=name), landmarks), folder / f"{name}.tmap")
            truth, sensors, places = [*truth, to_first.matrix], [*sensors, sensor], [*places, place]
    about = {"building": f"{len(set(places))} buildings", "sensors": sensors, "places": places}
    (folder / "truth.json").write_text(json.dumps({**about, "truth": [t.tolist() for t in truth]}))


def make_set(split: str, maps: int, number: int, cache: Path) -> Path:
    """Make one set, unless it is there."""
    folder = cache / split / f"{maps:02d}_{number:02d}"
    if (folder / "truth.json").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    if split.startswith(SMALL):
        with limit_threads():
            make_small_set(float(split.partition("-")[2]), maps, number, folder)
        return folder
    with limit_threads():
        atlas, other = draw_set(split, maps, number)
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
    return folder


def load_set(folder: Path) -> AtlasSet:
    """Return a set that was made."""
    about = json.loads((folder / "truth.json").read_text())
    truth = tuple(None if t is None else convert_to_sim3(np.array(t)) for t in about.pop("truth"))
    return AtlasSet(folder.name, tuple(sorted(folder.glob("map_*.tmap"))), truth, about)


def errors(atlas_set: AtlasSet, result: AtlasResult) -> dict[int, tuple[float, float] | None]:
    """Return the error of each map in its component's first map, m and rad; None for maps of two buildings in one component."""
    out: dict[int, tuple[float, float] | None] = {}
    sensors: Any = atlas_set.about["sensors"]
    places: Any = atlas_set.about.get("places", [0] * len(atlas_set.files))
    for members in result.components:
        first = members[0]
        for k in members[1:]:
            one, two = atlas_set.truth[first], atlas_set.truth[k]
            if one is None or two is None or places[first] != places[k]:
                out[k] = None
                continue
            true, middle = one.inverse() @ two, result.maps[k].grid.compute_centroids().mean(axis=0)
            off = result.transforms[k].apply(middle[None])[0] - true.apply(middle[None])[0]
            flat = "laser2d" in (sensors[first], sensors[k])
            out[k] = (float(np.linalg.norm(off[:2] if flat else off)), pose_difference(true, result.transforms[k], middle)[1])
    return out


def measure_set(split: str, maps: int, number: int, cache: Path) -> Row:
    """Make one set and put its maps together."""
    built = load_set(make_set(split, maps, number, cache))
    began = process_time()
    result = build_atlas(built.files)
    seconds = process_time() - began
    off = errors(built, result)
    right = [k for k, e in off.items() if e is not None and e[0] < RIGHT[0] and e[1] < RIGHT[1]]
    places: Any = built.about.get("places", [0] * len(built.files))
    belonging = {p for p, t in zip(places, built.truth, strict=True) if t is not None}
    best = dict.fromkeys(belonging, 0)  # of each building, the maps of its largest component that lie right
    for members in result.components:
        place = places[members[0]]
        best[place] = max(best.get(place, 0), sum(k in right for k in members[1:]))
    return {
        "maps": len(built.files),
        "seconds": seconds,  # of one core
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "registered": result.registered[0],
        "pairs": result.registered[1],
        "could": sum(t is not None for t in built.truth) - len(belonging),
        "right": sum(best.values()),
        "wrong": len(off) - len(right),
        "components": [list(c) for c in result.components if len(c) > 1],
        "errors": {str(k): e for k, e in off.items()},
        "thrown": [list(link.maps) for link in result.rejected],
        "building": built.about["building"],
        "sensors": built.about["sensors"],
    }


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate a line a size."""
    lines = []
    for size in settings.sizes:
        some = [r for r in rows if r["maps"] == size]
        if not some:
            continue
        seconds = [r["seconds"] for r in some]
        off = [e[0] for r in some for e in r["errors"].values() if e]
        cells = [
            size,
            len(some),
            f"{np.median(seconds):.1f}",
            f"{max(seconds):.1f}",
            f"{max(r['peak_mib'] for r in some):.0f}",
            f"{np.mean([r['registered'] for r in some]):.1f}",
            some[0]["pairs"],
            f"{sum(r['right'] for r in some)} of {sum(r['could'] for r in some)}",
            sum(r["wrong"] for r in some),
            f"{np.median(off):.2f}" if off else "–",
        ]
        lines.append(cells)
    name = "atlases" if settings.data.set != SMALL else "atlases-small" + ("-signs" if settings.signs else "")
    return {name: write_table(ATLAS_COLUMNS, lines)}
