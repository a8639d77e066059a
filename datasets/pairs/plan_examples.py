"""Plans of storeys as the extraction sees them, with what truly stands there: what networks of plans and doors learn from.

Scans of procedural buildings and of real plans of the split: all sensors, several voxel sizes, spoilt points, and grid maps drawn
from the plans with furniture in them, as robots make them; most of them turned. A file holds the storeys of one scan.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from topomerge.datasets.core.builder import Report, Row, Say, Sharing, build_set, check_sharing, make_item
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.plan_truth import truth_of
from topomerge.datasets.pairs.scan_items import PlanItem, Plans, draw_item, scan_of_item
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.scanner import moved

from topomerge.errors import InputError
from topomerge.extraction.navigable import navigable_volume, with_crossed_cells
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.plans.plan import columns_of, profile_bands, storey_plan
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import is_slice, with_raised_slice
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.io import archive
from topomerge.types import Array, PointCloud

LONGEST_SCAN = 600.0  # s
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
        surroundings: do the buildings stand in the open, so that sensors see gardens, streets and fans of rays (`open_scans`)?
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
        truth: (nx, ny) uint8, index into `plan_truth.TRUE_CLASSES`.
        visited: (n,) rooms that the surveyor was in.
        source: sensor/where the building is from.
    """

    plan: StoreyPlan
    room: Array
    truth: Array
    visited: Array
    source: str


ItemT = TypeVar("ItemT", bound=PlanItem)
MakeFile = Callable[[Any, Plan | None, str], Row]


def check_plans(recipe: PlanRecipe) -> None:
    """Refuse a recipe that nothing can be made of.

    Raises:
        InputError: names the key.
    """
    first, last = splits.seeds(recipe.split)
    if recipe.scans < 1:
        raise InputError(f"data.scans must be 1 or more, not {recipe.scans}")
    if not 0 <= recipe.sparse <= 1:
        raise InputError(f"data.sparse must be 0 to 1, not {recipe.sparse}")
    if not 0 <= recipe.seed <= last - first - recipe.scans:
        raise InputError(f"data.seed must be 0 to {last - first - recipe.scans} in split {recipe.split}, not {recipe.seed}")


def build_plans(recipe: PlanRecipe, sharing: Sharing, say: Say = lambda text: None) -> tuple[list[Path], Report]:
    """The files of a set, made where they are missing, in the order of the seeds."""
    return build_scans(recipe, "plans", partial(draw_item, flat=recipe.flat), make_plan_file, sharing, say)


def build_scans(
    recipe: PlanRecipe, kind: str, draw: Callable[[int, Plans], ItemT], make: MakeFile, sharing: Sharing, say: Say
) -> tuple[list[Path], Report]:
    """The files of a set of scans, made where they are missing, in the order of the seeds.

    Args:
        kind: folder of the files in the cache.
        draw: the item of a seed.
        make: an item's file, from its plan, in a folder.
    """
    check_plans(recipe)
    check_sharing(sharing)
    say("reading plans")
    plans = real_plans(recipe)
    first = splits.seeds(recipe.split)[0] + recipe.seed
    items = [draw(seed, plans) for seed in range(first, first + recipe.scans)]
    folder = Path(sharing.cache).resolve() / kind
    plan_of_item = {(source, name): plan for source, entries in plans.items() for name, plan in entries}
    begin, step = sharing.part
    tasks = [(item, plan_of_item.get((item.source, item.plan)), str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.name}.jsonl", tasks, make, sharing, say, unit="scans")
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


def storeys_of(cloud: PointCloud, edge: float) -> list[tuple[StoreyPlan, Array]]:
    """The plans of a scan as the extraction makes them, and the places (nx, ny, 3) of their columns' floors."""
    p = PRESETS["default"]
    scan = read_scan(cloud, edge, p.sparse)
    flat = is_slice(scan.grid)
    upright, navigable = navigable_volume(with_raised_slice(scan), p)
    grid, crossed = upright.grid, None if flat else with_crossed_cells(upright).crossed
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, p.standing_height))
    out = []
    for k in range(len(storeys)):
        if (storey == k).any():
            plan = storey_plan(grid, navigable, storey, k, crossed)
            low, base = columns_of(plan, grid)
            columns = np.stack(np.meshgrid(*(np.arange(n) for n in plan.wall.shape), indexing="ij"), axis=-1) + low
            cells = np.concatenate([columns, np.full((*plan.wall.shape, 1), np.median(base))], axis=-1)
            out.append((plan, grid.origin + (cells + 0.5) * grid.edge))
    return out
