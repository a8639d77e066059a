"""Plans of storeys as the extraction sees them, with what truly stands there: what networks of plans and doors learn from.

Scans of procedural buildings and of real plans of the split: all sensors, several voxel sizes, spoilt points, and grid maps drawn
from the plans with furniture in them, as robots make them; most of them turned. A file holds the storeys of one scan.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.buildings.profiles import BUILDING_KINDS
from topomerge.datasets.core.builder import Report, Row, Say, Sharing, build_set, check_sharing, make_item
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.items import digest
from topomerge.datasets.pairs.plan_truth import drawn_map, truth_of
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.scanner import moved, scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.spoils import drift_between, exact_sensor, spoilt, upper_half
from topomerge.datasets.simulation.walk import part

from topomerge.errors import InputError
from topomerge.extraction.navigable import navigable_volume
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.plan import columns_of, profile_bands, storey_plan
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import with_raised_slice
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.io import archive
from topomerge.io.listing import plain
from topomerge.types import Array, PointCloud, Sim3

PLAN_FORMAT = 1  # raise it when the same item gives other bytes: it is part of the files' names
LONGEST_SCAN = 600.0  # s
VOXEL_SIZES = (0.1, 0.1, 0.1, 0.08, 0.15)  # m
SOURCE_SHARES = {"procedural": 0.55, "r2v": 0.3, "campus": 0.15}
SENSOR_SHARES = {"tls": 0.16, "lidar": 0.16, "depth": 0.12, "tablet": 0.12, "mono": 0.08, "laser2d": 0.2, "drawn": 0.16}
SPOIL_SHARES = {"": 0.48, "sparse": 0.16, "noise": 0.1, "below2": 0.1, "drift": 0.06, "above": 0.1}  # above: no lower half
ROOMS_VISITED = (4, 9)  # at least, less than
PLANS_READ = 300  # of a source
PLAN_RASTERS = ("wall", "inside", "profile", "ceiling")


@dataclass
class PlanRecipe:
    """A set of scans whose plans are learned from.

    Args:
        name: of the manifest.
        split: train, validation or test: of which real plans, and in which range the seeds lie.
        scans: how many; seed: of the first one, from the beginning of the split's range on.
        folder: of the real data; empty: procedural buildings only.
    """

    name: str = "plan_scans"
    split: str = "train"
    scans: int = 300
    seed: int = 100_000
    folder: str = ""


@dataclass(frozen=True)
class PlanItem:
    """Everything that the bytes of one file depend on: the seed, where the building is from, of how many plans one was drawn,
    which, and its digest."""

    seed: int
    source: str
    candidates: int
    plan: str
    digest: str

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        return hashlib.sha256(json.dumps([PLAN_FORMAT, plain(asdict(self))], sort_keys=True).encode()).hexdigest()[:24]


@dataclass(frozen=True, eq=False)
class PlanExample:
    """A plan with what is true about it.

    Args:
        room: (nx, ny) int16 true room, -1 none.
        truth: (nx, ny) uint8, index into `plan_truth.TRUE_CLASSES`.
        visited: (n,) rooms that the surveyor was in.
        source: sensor/where the building is from.
    """

    plan: StoreyPlan
    room: Array
    truth: Array
    visited: Array
    source: str


Plans = Mapping[str, Sequence[tuple[str, Plan]]]


def check_plans(recipe: PlanRecipe) -> None:
    """Refuse a recipe that nothing can be made of.

    Raises:
        InputError: names the key.
    """
    first, last = splits.seeds(recipe.split)
    if recipe.scans < 1:
        raise InputError(f"data.scans must be 1 or more, not {recipe.scans}")
    if not 0 <= recipe.seed <= last - first - recipe.scans:
        raise InputError(f"data.seed must be 0 to {last - first - recipe.scans} in split {recipe.split}, not {recipe.seed}")


def build_plans(recipe: PlanRecipe, sharing: Sharing, say: Say = lambda text: None) -> tuple[list[Path], Report]:
    """The files of a set, made where they are missing, in the order of the seeds."""
    check_plans(recipe)
    check_sharing(sharing)
    say("reading plans")
    plans = real_plans(recipe)
    first = splits.seeds(recipe.split)[0] + recipe.seed
    items = [draw_item(seed, plans) for seed in range(first, first + recipe.scans)]
    folder = Path(sharing.cache).resolve() / "plans"
    plan_of_item = {(source, name): plan for source, entries in plans.items() for name, plan in entries}
    begin, step = sharing.part
    tasks = [(item, plan_of_item.get((item.source, item.plan)), str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.name}.jsonl", tasks, make_plan_file, sharing, say, unit="scans")
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def real_plans(recipe: PlanRecipe) -> Plans:
    """Plans of apartments, schools and offices of the split, if there are any."""
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans

    plans: dict[str, list[tuple[str, Plan]]] = {}
    for source in ("r2v", "campus") if recipe.folder else ():
        wanted = set(splits.members(recipe.split, source))
        entries = iter_plans(Path(recipe.folder) / splits.FOLDERS[source], wanted)
        plans[source] = [(name, plan) for name, plan in entries if not isinstance(plan, Refusal)][:PLANS_READ]
    return plans


def draw_item(seed: int, plans: Plans) -> PlanItem:
    """The item of a seed; `make_examples` draws the same numbers again."""
    rng = np.random.default_rng(seed)
    draw_difficulty(rng)
    source, _ = _draw_source(rng)
    entries = plans.get(source, ())
    if not entries:
        return PlanItem(seed, "procedural", 0, "", "")
    name, plan = entries[int(rng.integers(len(entries)))]
    return PlanItem(seed, source, len(entries), name, digest((plan,)))


def _draw_source(rng: np.random.Generator) -> tuple[str, str]:
    source = str(rng.choice(list(SOURCE_SHARES), p=list(SOURCE_SHARES.values())))
    return source, str(rng.choice(list(SENSOR_SHARES), p=list(SENSOR_SHARES.values())))


def make_plan_file(item: PlanItem, plan: Plan | None, folder: str) -> Row:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: example_arrays(item, make_examples(item, plan)), LONGEST_SCAN)


def example_arrays(item: PlanItem, examples: Sequence[PlanExample]) -> dict[str, Array]:
    """The arrays of a file."""
    arrays: dict[str, Any] = {"count": np.array(len(examples))}
    for k, e in enumerate(examples):
        rasters = {name: getattr(e.plan, name) for name in PLAN_RASTERS}
        rasters["ceiling"] = np.asarray(rasters["ceiling"], np.float32)
        arrays |= {f"{name}.{k}": values for name, values in rasters.items()}
        arrays |= {f"edge.{k}": np.array(e.plan.edge), f"source.{k}": np.array(e.source)}
        arrays |= {f"{name}.{k}": getattr(e, name) for name in ("room", "truth", "visited")}
    about = {"file": f"{item.name}.npz", **asdict(item), "sources": [e.source for e in examples]}
    return {**arrays, "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)}


def load_examples(path: Path) -> list[PlanExample]:
    """The examples of a file.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached plans")
    examples = []
    for k in range(int(arrays["count"])):
        edge = float(arrays[f"edge.{k}"])
        rasters: dict[str, Any] = {name: arrays[f"{name}.{k}"] for name in PLAN_RASTERS}
        shape = rasters["wall"].shape
        plan = StoreyPlan(np.zeros(2), edge, bands=profile_bands(edge), floor=np.zeros(shape), **rasters)
        room, truth, visited = (arrays[f"{name}.{k}"] for name in ("room", "truth", "visited"))
        examples.append(PlanExample(plan, room, truth, visited, str(arrays[f"source.{k}"])))
    return examples


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan of an item.

    Args:
        visited: (n,) rooms that the surveyor was in.
        cloud: in the building's frame.
        shift: places of it with what undoes its drift there; None: it has none.
        frame: in which it is looked at.
    """

    building: Building
    sensor: str
    visited: Array
    cloud: PointCloud
    shift: Any
    frame: Sim3


def scan_of_item(item: PlanItem, plan: Plan | None) -> SimulatedScan:
    """Simulate the scan of an item.

    Args:
        plan: the real plan that it names; None: its building is procedural.
    """
    seed = item.seed
    rng = np.random.default_rng(seed)
    difficulty = draw_difficulty(rng)
    source, sensor = _draw_source(rng)
    if plan is not None:
        rng.integers(item.candidates)  # which plan: drawn already
        building = erect([plan], difficulty, rng, f"{source}-{seed}")
    else:
        floors = 1 if sensor in ("laser2d", "drawn") else int(rng.choice([1, 1, 1, 2]))
        building = make_building(str(rng.choice(BUILDING_KINDS)), seed, floors, difficulty)
    visited = part(building, int(rng.integers(*ROOMS_VISITED)), rng)
    if sensor == "drawn":
        cloud, shift = drawn_map(building, visited, rng), None
    else:
        cloud, shift = scanned(building, sensor, visited, rng, seed)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    return SimulatedScan(building, sensor, visited, cloud, shift, frame)


def make_examples(item: PlanItem, plan: Plan | None) -> list[PlanExample]:
    """The storeys of one scan."""
    made = scan_of_item(item, plan)
    storeys = storeys_of(moved(made.cloud, made.frame), VOXEL_SIZES[item.seed % len(VOXEL_SIZES)])
    if not storeys:
        raise InputError(f"{item.seed}: no storey was seen")
    return [
        PlanExample(
            plan,
            *truth_of(made.building, plan, places, made.frame, made.shift),
            made.visited,
            f"{made.sensor}/{item.source}",
        )
        for plan, places in storeys
    ]


def draw_difficulty(rng: np.random.Generator) -> Difficulty:
    """From tidy to hard, all kinds at once."""
    wide = {"ceiling_spread": 0.4, "furniture": 2.0, "clutter": 1.0, "glass": 0.2, "lamps": 1.0, "beams": 0.5, "columns": 1.0}
    drawn = {name: float(rng.uniform(0, most)) for name, most in (wide | {"slopes": 0.5, "curved": 0.4}).items()}
    ajar = float(rng.uniform(0.4, 0.9))
    lintels = float(rng.choice([0, 0.5, 0.9, 1.0]))
    return Difficulty(**drawn, open=ajar, half=float(rng.uniform(0, 1 - ajar)), lintels=lintels)


def scanned(building: Building, name: str, visited: Array, rng: np.random.Generator, seed: int) -> tuple[PointCloud, Any]:
    """A scan, and places of it with what undoes its drift there (None: it has none)."""
    sensor = get_sensor(name)
    spoil = str(rng.choice(list(SPOIL_SHARES), p=list(SPOIL_SHARES.values()))) if sensor.beams != 1 and name != "mono" else ""
    if spoil == "below2" and sensor.lowest > 0:  # hardly anything would be left
        spoil = ""
    if spoil == "drift":
        sensor = replace(sensor, drift=1.0)
    elif rng.random() < 0.6:
        sensor = replace(sensor, drift=0.0, tilt=0.0)
    spacing = max(sensor.spacing, 0.05) if sensor.beams != 1 else None
    cloud = scan(building, sensor, visited, np.random.default_rng(seed), spacing)
    shift = None
    if sensor.drift:
        straight = scan(building, exact_sensor(sensor), visited, np.random.default_rng(seed), budget=8)
        shift = drift_between(cloud, straight)
    cloud = upper_half(cloud, building, rng) if spoil == "above" else spoilt(cloud, building, spoil, rng)
    return replace(cloud, rooms=()), shift


def storeys_of(cloud: PointCloud, edge: float) -> list[tuple[StoreyPlan, Array]]:
    """The plans of a scan as the extraction makes them, and the places (nx, ny, 3) of their columns' floors."""
    p = PRESETS["default"]
    upright, navigable = navigable_volume(with_raised_slice(read_scan(cloud, edge, p.sparse)), p)
    grid = upright.grid
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, p.standing_height))
    out = []
    for k in range(len(storeys)):
        if (storey == k).any():
            plan = storey_plan(grid, navigable, storey, k)
            low, base = columns_of(plan, grid)
            columns = np.stack(np.meshgrid(*(np.arange(n) for n in plan.wall.shape), indexing="ij"), axis=-1) + low
            cells = np.concatenate([columns, np.full((*plan.wall.shape, 1), np.median(base))], axis=-1)
            out.append((plan, grid.origin + (cells + 0.5) * grid.edge))
    return out
