"""Plans of storeys as the extraction sees them, with what truly stands there."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.layouts import BUILDING_KINDS
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import BuildReport, BuildRow, BuildSettings, build_set, check_sharing, make_item
from topomerge.datasets.core.building import Building, Difficulty, Plan
from topomerge.datasets.pairs.drawing import compute_plan_truth, simulate_grid_map
from topomerge.datasets.pairs.flat_maps import simulate_robot_grid
from topomerge.datasets.pairs.items import compute_plan_digest
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.sensors import corrupt_cloud, cut_upper_half, get_sensor, measure_drift, remove_sensor_drift
from topomerge.datasets.simulation.walk import sample_part

from topomerge import archive
from topomerge.archive import convert_to_plain
from topomerge.errors import InputError
from topomerge.extraction.navigable import add_crossed_cells, compute_navigable_volume
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.plan import build_profile_bands, build_storey_plan, locate_columns
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import is_slice, raise_slice
from topomerge.extraction.storeys import find_storeys, measure_floor_to_ceiling
from topomerge.types import Array, LogFn, PointCloud, Sim3

PLAN_FORMAT = 4  # raise it when the same item gives other bytes: it is part of the files' names
SOURCE_SHARES = {"procedural": 0.55, "r2v": 0.3, "campus": 0.15}
SENSOR_SHARES = {"tls": 0.16, "lidar": 0.16, "depth": 0.12, "tablet": 0.12, "mono": 0.08, "laser2d": 0.2, "drawn": 0.16}
# Of what robots and draughtsmen leave: grids of 2D lasers, drawings, and slices.
FLAT_SOURCE_SHARES = {"procedural": 0.35, "r2v": 0.5, "campus": 0.15}
FLAT_SENSOR_SHARES = {"robot": 0.5, "drawn": 0.3, "laser2d": 0.2}
SPOIL_SHARES = {"": 0.48, "sparse": 0.16, "noise": 0.1, "below2": 0.1, "drift": 0.06, "above": 0.1}  # above: no lower half
ROOMS_VISITED = (4, 9)  # at least, less than
Plans = Mapping[str, Sequence[tuple[str, Plan]]]


@dataclass(frozen=True)
class PlanItem:
    """Everything that the bytes of one file depend on: the seed, where the building is from, of how many plans one was drawn,
    which, and its digest; and is it a slice, a grid or a drawing?"""

    seed: int
    source: str
    candidates: int
    plan: str
    digest: str
    flat: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of the plans that are made from them."""
        return self.compute_name(PLAN_FORMAT)

    def compute_name(self, version: int) -> str:
        """Compute a hash of the inputs and of the version of what is made from them."""
        return hashlib.sha256(json.dumps([version, convert_to_plain(asdict(self))], sort_keys=True).encode()).hexdigest()[:24]


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


def simulate_item_scan(item: PlanItem, plan: Plan | None) -> SimulatedScan:
    """Simulate the scan of an item.

    Args:
        plan: the real plan that it names; None: its building is procedural.
    """
    seed = item.seed
    rng = np.random.default_rng(seed)
    difficulty = draw_difficulty(rng)
    source, sensor = draw_source(rng, item.flat)
    if plan is not None:
        rng.integers(item.candidates)  # which plan: drawn already
        building = build_building([plan], difficulty, rng, f"{source}-{seed}")
    else:
        floors = 1 if sensor in FLAT_SENSOR_SHARES else int(rng.choice([1, 1, 1, 2]))
        building = make_building(str(rng.choice(BUILDING_KINDS)), seed, floors, difficulty)
    visited = sample_part(building, int(rng.integers(*ROOMS_VISITED)), rng)
    if sensor == "drawn":
        cloud, shift = simulate_grid_map(building, visited, rng), None
    elif sensor == "robot":
        cloud, shift = (
            replace(simulate_robot_grid(building, get_sensor("laser2d"), visited, rng, Sim3()), rooms=(), labels=None),
            None,
        )
    else:
        cloud, shift = scan_with_drift(building, sensor, visited, rng, seed)
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.75 else 0.0)
    return SimulatedScan(building, sensor, visited, cloud, shift, frame)


def draw_item(seed: int, plans: Plans, flat: bool = False) -> PlanItem:
    """Draw the item of a seed; `make_examples` draws the same numbers again.

    Args:
        flat: a slice, a robot's grid or a drawing.
    """
    rng = np.random.default_rng(seed)
    draw_difficulty(rng)
    source, _ = draw_source(rng, flat)
    entries = plans.get(source, ())
    if not entries:
        return PlanItem(seed, "procedural", 0, "", "", flat)
    name, plan = entries[int(rng.integers(len(entries)))]
    return PlanItem(seed, source, len(entries), name, compute_plan_digest((plan,)), flat)


def draw_source(rng: np.random.Generator, flat: bool) -> tuple[str, str]:
    """Draw the source of a building and the sensor that it is scanned by."""
    sources, sensors = (FLAT_SOURCE_SHARES, FLAT_SENSOR_SHARES) if flat else (SOURCE_SHARES, SENSOR_SHARES)
    source = str(rng.choice(list(sources), p=list(sources.values())))
    return source, str(rng.choice(list(sensors), p=list(sensors.values())))


def draw_difficulty(rng: np.random.Generator) -> Difficulty:
    """Draw a difficulty from tidy to hard, all kinds at once."""
    wide = {"ceiling_spread": 0.4, "furniture": 2.0, "clutter": 1.0, "glass": 0.2, "lamps": 1.0, "beams": 0.5, "columns": 1.0}
    drawn = {name: float(rng.uniform(0, most)) for name, most in (wide | {"slopes": 0.5, "curved": 0.4}).items()}
    ajar = float(rng.uniform(0.4, 0.9))
    lintels = float(rng.choice([0, 0.5, 0.9, 1.0]))
    return Difficulty(**drawn, open=ajar, half=float(rng.uniform(0, 1 - ajar)), lintels=lintels)


def scan_with_drift(building: Building, name: str, visited: Array, rng: np.random.Generator, seed: int) -> tuple[PointCloud, Any]:
    """Return a scan, and places of it with what undoes its drift there (None: it has none)."""
    sensor = get_sensor(name)
    spoil = str(rng.choice(list(SPOIL_SHARES), p=list(SPOIL_SHARES.values()))) if sensor.beams != 1 and name != "mono" else ""
    if spoil == "below2" and sensor.lowest > 0:  # hardly anything would be left
        spoil = ""
    if spoil == "drift":
        sensor = replace(sensor, drift=1.0)
    elif rng.random() < 0.6:
        sensor = replace(sensor, drift=0.0, tilt=0.0)
    spacing = max(sensor.spacing, 0.05) if sensor.beams != 1 else None
    cloud = scan_building(building, sensor, visited, np.random.default_rng(seed), spacing)
    shift = None
    if sensor.drift:
        straight = scan_building(building, remove_sensor_drift(sensor), visited, np.random.default_rng(seed), budget=8)
        shift = measure_drift(cloud, straight)
    cloud = cut_upper_half(cloud, building, rng) if spoil == "above" else corrupt_cloud(cloud, building, spoil, rng)
    return replace(cloud, rooms=()), shift


LONGEST_SCAN = 600.0  # s of a processor
VOXEL_SIZES = (0.1, 0.1, 0.1, 0.08, 0.15)  # m
PLANS_READ = 1000  # of a source
PLAN_RASTERS = ("wall", "inside", "profile", "ceiling")


@dataclass
class PlanRecipe:
    """A set of scans whose plans are learned from.

    Args:
        name: of the manifest.
        split: train, validation or test: of which real plans, and in which range the seeds lie.
        scans: how many; seed: of the first one, from the beginning of the split's range on.
        folder: of the real data; empty: procedural buildings only.
        flat: slices, robots' grids and drawings alone; sparse: share of scans that lose most of their points, there;
            frameless: share of scans whose doors mostly have no frame, there.
        surroundings: do the buildings stand in the open, so that sensors see gardens, streets and fans of rays
            (`simulate_open_scan`)?
    """

    name: str = "plan_scans"
    split: str = "train"
    scans: int = 300
    seed: int = 100_000
    folder: str = ""
    flat: bool = False
    sparse: float = 0.0
    frameless: float = 0.0
    surroundings: bool = False


@dataclass(frozen=True, eq=False)
class PlanExample:
    """A plan with what is true about it.

    Args:
        room: (nx, ny) int16 true room, -1 none.
        truth: (nx, ny) uint8, index into `drawing.TRUE_CLASSES`.
        visited: (n,) rooms that the surveyor was in.
        source: sensor/where the building is from.
    """

    plan: StoreyPlan
    room: Array
    truth: Array
    visited: Array
    source: str


ItemT = TypeVar("ItemT", bound=PlanItem)
MakeFile = Callable[[Any, Plan | None, str], BuildRow]


def check_plans(recipe: PlanRecipe) -> None:
    """Refuse a recipe that nothing can be made of.

    Raises:
        InputError: names the key.
    """
    first, last = splits.get_seed_range(recipe.split)
    if recipe.scans < 1:
        raise InputError(f"data.scans must be 1 or more, not {recipe.scans}")
    if not 0 <= recipe.sparse <= 1:
        raise InputError(f"data.sparse must be 0 to 1, not {recipe.sparse}")
    if not 0 <= recipe.seed <= last - first - recipe.scans:
        raise InputError(f"data.seed must be 0 to {last - first - recipe.scans} in split {recipe.split}, not {recipe.seed}")


def build_plans(
    recipe: PlanRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None
) -> tuple[list[Path], BuildReport]:
    """Build the files of a set, made where they are missing, in the order of the seeds."""
    return build_scans(recipe, "plans", partial(draw_item, flat=recipe.flat), make_plan_file, sharing, log_line)


def build_scans(
    recipe: PlanRecipe, kind: str, draw: Callable[[int, Plans], ItemT], make: MakeFile, sharing: BuildSettings, log_line: LogFn
) -> tuple[list[Path], BuildReport]:
    """Build the files of a set of scans, made where they are missing, in the order of the seeds.

    Args:
        kind: folder of the files in the cache.
        draw: the item of a seed.
        make: an item's file, from its plan, in a folder.
    """
    check_plans(recipe)
    check_sharing(sharing)
    log_line("reading plans")
    plans = load_real_plans(recipe)
    first = splits.get_seed_range(recipe.split)[0] + recipe.seed
    items = [draw(seed, plans) for seed in range(first, first + recipe.scans)]
    folder = Path(sharing.cache).resolve() / kind
    plan_of_item = {(source, name): plan for source, entries in plans.items() for name, plan in entries}
    begin, step = sharing.part
    tasks = [(item, plan_of_item.get((item.source, item.plan)), str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.name}.jsonl", tasks, make, sharing, log_line, unit="scans")
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def load_real_plans(recipe: PlanRecipe) -> Plans:
    """Load plans of apartments, schools and offices of the split, if there are any."""
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans

    plans: dict[str, list[tuple[str, Plan]]] = {}
    for source in ("r2v", "campus") if recipe.folder else ():
        requested = set(splits.list_members(recipe.split, source))
        entries = iter_plans(Path(recipe.folder) / splits.FOLDERS[source], requested)
        plans[source] = [(name, plan) for name, plan in entries if not isinstance(plan, Refusal)][:PLANS_READ]
    return plans


def make_plan_file(item: PlanItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: build_example_arrays(item, make_examples(item, plan)), LONGEST_SCAN)


def build_example_arrays(item: PlanItem, examples: Sequence[PlanExample]) -> dict[str, Array]:
    """Build the arrays of a file."""
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
    """Load the examples of a file.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached plans")
    examples = []
    for k in range(int(arrays["count"])):
        edge = float(arrays[f"edge.{k}"])
        rasters: dict[str, Any] = {name: arrays[f"{name}.{k}"] for name in PLAN_RASTERS}
        shape = rasters["wall"].shape
        plan = StoreyPlan(np.zeros(2), edge, bands=build_profile_bands(edge), floor=np.zeros(shape), **rasters)
        room, truth, visited = (arrays[f"{name}.{k}"] for name in ("room", "truth", "visited"))
        examples.append(PlanExample(plan, room, truth, visited, str(arrays[f"source.{k}"])))
    return examples


def make_examples(item: PlanItem, plan: Plan | None) -> list[PlanExample]:
    """Make the storeys of one scan."""
    scan = simulate_item_scan(item, plan)
    storeys = build_storey_plans(transform_cloud(scan.cloud, scan.frame), VOXEL_SIZES[item.seed % len(VOXEL_SIZES)])
    if not storeys:
        raise InputError(f"{item.seed}: no storey was seen")
    return [
        PlanExample(
            plan,
            *compute_plan_truth(scan.building, plan, places, scan.frame, scan.shift),
            scan.visited,
            f"{scan.sensor}/{item.source}",
        )
        for plan, places in storeys
    ]


def build_storey_plans(cloud: PointCloud, edge: float) -> list[tuple[StoreyPlan, Array]]:
    """Build the plans of a scan as the extraction makes them, and the places (nx, ny, 3) of their columns' floors."""
    p = PRESETS["default"]
    scan = read_scan(cloud, edge, p.sparse)
    flat = is_slice(scan.grid)
    upright, navigable = compute_navigable_volume(raise_slice(scan), p)
    grid, crossed = upright.grid, None if flat else add_crossed_cells(upright).crossed
    storeys, storey = find_storeys(navigable, measure_floor_to_ceiling(grid, navigable, p.standing_height))
    out = []
    for k in range(len(storeys)):
        if (storey == k).any():
            plan = build_storey_plan(grid, navigable, storey, k, crossed)
            low, base = locate_columns(plan, grid)
            columns = np.stack(np.meshgrid(*(np.arange(n) for n in plan.wall.shape), indexing="ij"), axis=-1) + low
            cells = np.concatenate([columns, np.full((*plan.wall.shape, 1), np.median(base))], axis=-1)
            out.append((plan, grid.origin + (cells + 0.5) * grid.edge))
    return out
