"""Measures of the sealed run, an item a call, and their tables. The caller chooses the split of the items.

Rooms: procedural buildings by five sensors, and sealed plans of real buildings, scanned. Merges: pairs of grids as those that the
belief in merges is judged on (`datasets.pairs.grid_pairs`), two scans of each sealed plan, both halves of each sealed robot grid
(one capture: what it shows is less than two), robot grids of two places, and sealed buildings of published sets. How rooms are
ranked: `count_pair_ranks`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.layouts import BUILDING_KINDS
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import limit_threads, limit_time
from topomerge.datasets.core.building import Difficulty, find_physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, find_twins, match_overlapping_rooms
from topomerge.datasets.pairs.flat_maps import FlatMap, build_flat_pair, read_flat
from topomerge.datasets.pairs.grid_pairs import (
    GridItem,
    GridPair,
    GridRecipe,
    build_grid,
    compute_free_grid,
    draw_grid_items,
    load_grids,
    make_grids,
    measure_common_area,
)
from topomerge.datasets.pairs.pairs import Pair, PairSettings, make_pair
from topomerge.datasets.pairs.parts import find_true_matches, match_true_rooms
from topomerge.datasets.plans import splits
from topomerge.datasets.plans.floorplans import Refusal, iter_plans, list_plan_names
from topomerge.datasets.plans.sealed import SEALED_FOLDERS, is_sealed, is_sealed_file
from topomerge.datasets.public.sources import iter_public_pairs
from topomerge.datasets.simulation.floor_truth import evaluate_map
from topomerge.embedding.learned import build_embedder
from topomerge.errors import InputError
from topomerge.evaluation.merges import compare_pose, time_registration
from topomerge.evaluation.scans import Case, make_scan, simulate_case
from topomerge.evaluation.score import count_ranks
from topomerge.evaluation.tables import compute_value, format_value
from topomerge.extraction.extract import extract
from topomerge.matching.assignment import compute_descriptor_costs
from topomerge.statistics import compute_exact_interval, format_interval
from topomerge.training.belief_hypotheses import is_distinguishable
from topomerge.types import Array, Sim3, TopometricMap

Row = dict[str, Any]
RANKED = ("learned", "engineered")
SENSOR_PAIRS = (("tls", "depth"), ("lidar", "tablet"), ("depth", "laser2d"), ("tls", "lidar"))
RANKED_ROOMS, RANKED_OVERLAP = 10, 0.5
RANKED_METRICS = ("recall@1", "recall@1_single", "recall@5")


def rank_building_rooms(kind: str, seed: int, sensors: tuple[str, str]) -> list[Row]:
    """Return two scans of a procedural building."""
    settings = PairSettings(overlap=RANKED_OVERLAP, sensors=sensors, rooms=RANKED_ROOMS)
    pair = make_pair(make_building(kind, seed), settings, seed, source="procedural")
    return count_pair_ranks(pair, find_physical_building("procedural", pair.building))


def count_pair_ranks(pair: Pair, place: str) -> list[Row]:
    """Return the counts of a pair's rooms, a row for each embedder; none where no room has a partner."""
    maps = [extract(cloud, voxel_size=0.1) for cloud in (pair.a, pair.b)]
    judged = build_evaluation_pair(pair, maps)
    if not len(judged.matches):
        return []
    out = []
    for name in RANKED:
        describe = build_embedder(name)
        counts = count_ranks(judged, compute_descriptor_costs(describe(maps[0]), describe(maps[1])))
        out.append({"place": place, "building": place, "pair": pair.name, "embedder": name, **counts})
    return out


def build_evaluation_pair(pair: Pair, maps: Sequence[TopometricMap]) -> EvaluationPair:
    """Build the truth of two extracted maps, without keeping the maps."""
    truths = [match_true_rooms(map, cloud) for map, cloud in zip(maps, (pair.a, pair.b), strict=True)]
    labelled = bool(pair.a.rooms)
    matches = find_true_matches(truths[0], truths[1], pair.shared) if labelled else match_overlapping_rooms(pair, maps)
    true, rooms = [truth["room"] for truth in truths], (pair.a.rooms, pair.b.rooms)
    alike = [find_twins(true[k], true[1 - k], rooms[k], rooms[1 - k]) for k in (0, 1)]
    glimpsed = [np.array(map.rooms["glimpsed"], bool) for map in maps]
    one = [truth["one"] for truth in truths]
    about = {"rooms": "labelled" if labelled else "laid"}
    return EvaluationPair(
        pair.name, Path(), matches, (true[0], true[1]), (one[0], one[1]), (alike[0], alike[1]), (glimpsed[0], glimpsed[1]),
        pair.truth, np.zeros(3), about,
    )  # fmt: skip


def table(rows: Sequence[Row]) -> list[str]:
    """Return lines in Markdown."""
    out = ["| ranking of rooms | embedder | pairs | buildings | rooms with a partner | recall@1 | without twin | recall@5 |"]
    out.append("|" + "---|" * 8)
    for group in dict.fromkeys(row["group"] for row in rows):
        for name in RANKED:
            some = [row for row in rows if row["group"] == group and row["embedder"] == name]
            sizes = [len(some), len({row["place"] for row in some}), sum(row["queries"] for row in some)]
            scores = [format_value(compute_value(some, column)) for column in RANKED_METRICS]
            out.append(f"| {' | '.join([group, name, *map(str, sizes), *scores])} |")
    return out


SEALED_PARTS = ("rooms", "merges", "ranking")
SENSORS_OF_ROOMS = ("tls", "lidar", "depth", "tablet", "laser2d")
VISITED_ROOMS = {"procedural": 8, "plan": 12}  # rooms a map
VAST = 500.0  # m2; a plan with such a hall is not furnished: it takes minutes
LONGEST_ITEM = 600.0  # s of a processor
FULL_SETS, SMALL_SETS = [60, 20, 30], [2]  # pairs of grids of each set
HALF = 0.65  # share of a robot's grid that each of its halves shows
LEAST_COMMON = 40.0  # m2 in common: with less nobody asks for a merge


@dataclass(frozen=True)
class SealedItem:
    """One thing to measure.

    Args:
        part: of `SEALED_PARTS`.
        group: the row of the tables that it belongs to.
        make: what gives its rows; it can be sent to another process.
        arguments: of `make`.
    """

    part: str
    group: str
    make: Callable[..., list[Row]]
    arguments: tuple[Any, ...]


def list_items(split: str, data: Path | None, public: Sequence[tuple[str, Path]], small: bool) -> list[SealedItem]:
    """List all that is measured, the longest first.

    Args:
        split: of the procedural buildings.
        data: folder of the real data, or None.
        public: sources and folders of published sets.
        small: two or three items only.
    """
    recipe = GridRecipe(name="sealed", split=split, sets=list(SMALL_SETS if small else FULL_SETS), drawings=[], rooms=[4, 15])
    out = [SealedItem("merges", "procedural", measure_grid_pair, (item,)) for item in draw_grid_items(recipe)[0]]
    out += [SealedItem("merges", f"published: {source}", measure_public_pairs, (source, folder)) for source, folder in public]
    if data is not None:
        for folder, name in list_sealed_plans(data):
            out.append(SealedItem("merges", "real plans", measure_plan_pair, (folder, name)))
            out.append(SealedItem("rooms", "real plans", measure_plan_rooms, (folder, name)))
            out.append(SealedItem("ranking", "real plans", rank_plan_rooms, (folder, name)))
        out.append(SealedItem("merges", "robots' grids", measure_robot_pairs, (data,)))
        out.append(SealedItem("ranking", "robots' grids", rank_robot_rooms, (data,)))
    first = splits.get_seed_range(split)[0]
    kinds, sensors = (BUILDING_KINDS[-1:], SENSORS_OF_ROOMS[:1]) if small else (BUILDING_KINDS, SENSORS_OF_ROOMS)
    for i, sensor in enumerate(sensors):
        for k, kind in enumerate(kinds):
            case = Case(sensor, "procedural", kind, sensor, first + 100 + 10 * i + k, rooms=VISITED_ROOMS["procedural"])
            out.append(SealedItem("rooms", sensor, measure_rooms, (case,)))
    for i, scanners in enumerate(SENSOR_PAIRS[:1] if small else SENSOR_PAIRS):
        for k, kind in enumerate(kinds):
            out.append(SealedItem("ranking", "procedural", rank_building_rooms, (kind, first + 200 + 10 * i + k, scanners)))
    return out


def measured(item: SealedItem) -> list[Row]:
    """Return the rows of an item; of one that fails, one that says why."""
    about = {"part": item.part, "group": item.group}
    try:
        with (
            limit_threads(),
            limit_time(LONGEST_ITEM * (8 if item.make in (measure_robot_pairs, rank_robot_rooms, measure_public_pairs) else 1)),
        ):
            return [about | row for row in item.make(*item.arguments)]
    except Exception as error:  # one bad item never ends a run
        text = " ".join(str(error).split())[:150]
        return [about | {"failed": text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"}]


def measure_rooms(case: Case) -> list[Row]:
    """Return rooms of a procedural building."""
    return [_build_room_row(make_scan(case, None), f"procedural/{case.building}-{case.seed}")]


def measure_plan_rooms(folder: Path, name: str) -> list[Row]:
    """Return rooms of a plan that is erected and scanned."""
    source, building = _load_plan(folder, name)
    case = Case("real plans", source, name, "tls", 1, rooms=min(VISITED_ROOMS["plan"], len(building.rooms)))
    return [_build_room_row(simulate_case(case, building), find_physical_building(source, name))]


def _build_room_row(scan: Any, place: str) -> Row:
    rooms = evaluate_map(extract(scan.cloud, voxel_size=0.1), scan.truth).rooms
    return {"place": place, "iou": rooms.iou, "mcc": rooms.mcc, "recall": rooms.recall, "precision": rooms.precision}


def list_sealed_plans(data: Path) -> list[tuple[Path, str]]:
    """List the folders and names of the sealed line maps; a mall's hall takes minutes to scan, and is left for another time."""
    folder = data / SEALED_FOLDERS["utexas"][0]
    return [(folder, n) for n in list_plan_names(folder) if is_sealed("utexas", n)] if folder.is_dir() else []


def _load_plan(folder: Path, name: str) -> tuple[str, Any]:
    """Return the source of a plan and the building that is made of it.

    Raises:
        InputError: it can't be read.
    """
    (plan,) = (plan for n, plan in iter_plans(folder, {name}) if n == name)
    if isinstance(plan, Refusal):
        raise InputError(f"{name}: {plan.reason}")
    source = next(s for s, names in SEALED_FOLDERS.items() if folder.name in names)
    vast = any(np.ptp(room.polygon, axis=0).prod() > VAST for room in plan.rooms)
    difficulty = Difficulty(furniture=0.0, clutter=0.0) if vast else Difficulty()
    return source, build_building([plan], difficulty, 1, name=name, kind=source)


def measure_plan_pair(folder: Path, name: str) -> list[Row]:
    """Return two scans of a plan, half of their rooms in common."""
    pair = _simulate_plan_pair(folder, name)
    return [build_merge_row(_build_grid_pair(pair), find_physical_building(pair.source, name))]


def rank_plan_rooms(folder: Path, name: str) -> list[Row]:
    """Return the ranking of rooms between these scans."""
    pair = _simulate_plan_pair(folder, name)
    return count_pair_ranks(pair, find_physical_building(pair.source, name))


def _simulate_plan_pair(folder: Path, name: str) -> Pair:
    source, building = _load_plan(folder, name)
    settings = PairSettings(overlap=0.5, sensors=("tls", "depth"), rooms=VISITED_ROOMS["plan"])
    return make_pair(building, settings, 1, source=source)


def measure_grid_pair(item: GridItem) -> list[Row]:
    """Return a pair of grids, made in a folder that goes with it."""
    with tempfile.TemporaryDirectory() as folder:
        scan = make_grids(item, [], folder)
        if scan.reason:
            raise InputError(scan.reason)
        pair = load_grids(Path(folder) / f"{item.name}.npz")
    return [build_merge_row(pair, find_physical_building("procedural", str(pair.about["building"])))]


def measure_public_pairs(source: str, folder: Path) -> list[Row]:
    """Return the sealed pairs of a published set; of those that can't be read a row that says why."""
    out = []
    for name, pair in iter_public_pairs(folder, source):
        if not is_sealed(source, name.removeprefix(f"{source}/")):
            continue
        if isinstance(pair, Refusal):
            out.append({"failed": f"{name}: {pair.reason}"})
        else:
            out.append(build_merge_row(_build_grid_pair(pair), f"{source}/{pair.building}"))
    return out


def measure_robot_pairs(data: Path) -> list[Row]:
    """Measure halves of each sealed grid of known scale, and halves of grids of two places."""
    halves, out = [], []
    for number, (name, flats) in enumerate(load_robot_halves(data).items()):
        if isinstance(flats, str):
            out.append({"failed": flats})
            continue
        place = find_physical_building("strands", name)
        halves.append((place, *flats))
        out.append(build_merge_row(_build_grid_pair(build_pair(name, flats, place, number)), place))
    firsts = {place: (a, b) for place, a, b in reversed(halves)}
    for number, (one, other) in enumerate(combinations(sorted(firsts), 2)):
        flats = firsts[one][0], firsts[other][1]
        pair = build_flat_pair(f"{one}+{other}", *flats, Sim3(1.0), ("laser2d", "laser2d"), "strands", one, number)
        strangers = replace(pair, truth=None, kind="other-building", overlap=0.0, shared=())
        out.append(build_merge_row(_build_grid_pair(strangers), f"{one} + {other}"))
    return out


def rank_robot_rooms(data: Path) -> list[Row]:
    """Return the ranking of rooms between both halves of each sealed grid."""
    out: list[Row] = []
    for number, (name, flats) in enumerate(load_robot_halves(data).items()):
        place = find_physical_building("strands", name)
        out += [{"failed": flats}] if isinstance(flats, str) else count_pair_ranks(build_pair(name, flats, place, number), place)
    return out


def _build_grid_pair(pair: Pair) -> GridPair:
    """Return a pair as the registration takes it."""
    a, b = build_grid(pair.a), build_grid(pair.b)
    free = [c.free if c.poses is None else compute_free_grid(c, g) for c, g in ((pair.a, a), (pair.b, b))]
    about: dict[str, object] = {key: getattr(pair, key) for key in ("kind", "building", "source", "overlap")}
    seen = (free[0], free[1])
    return GridPair(
        pair.name, a, b, seen, pair.truth, measure_common_area(pair, a, b, seen), about | {"sensors": list(pair.sensors)}
    )


def build_merge_row(pair: GridPair, place: str) -> Row:
    """Register a pair; return its row of results."""
    outcome, registration = time_registration(pair.a, pair.b, bool(pair.about.get("scaled")), pair.free)
    pose = registration.transform
    about = {key: pair.about.get(key) for key in ("sensors", "kind", "overlap", "differs")}
    row = {"place": place, "common": pair.common, **about, "believed": outcome["believed"], "probability": outcome["probability"]}
    return row | compare_pose(pose, pair) | {"answered": pose is not None}


def load_robot_halves(data: Path) -> dict[str, tuple[FlatMap, FlatMap] | str]:
    """Return both halves of each sealed grid of known scale, or why there are none."""
    out: dict[str, tuple[FlatMap, FlatMap] | str] = {}
    folder = data / SEALED_FOLDERS["strands"][0]
    for number, path in enumerate(sorted(p for p in folder.rglob("*.yaml") if is_sealed_file(p))):
        try:
            out[path.stem] = cut_floor(read_flat(path), number)
        except InputError as error:
            out[path.stem] = f"{path.stem}: {' '.join(str(error).split())[:100]}"
    return out


def build_pair(name: str, flats: tuple[FlatMap, FlatMap], place: str, number: int) -> Pair:
    """Return a pair of both halves, each in a frame of its own."""
    return build_flat_pair(name, *flats, Sim3(), ("laser2d", "laser2d"), "strands", place, number)


def cut_floor(flat: FlatMap, seed: int) -> tuple[FlatMap, FlatMap]:
    """Return two parts of a floor, each `HALF` of its free floor, cut across at any angle.

    Raises:
        InputError: no free floor.
    """
    if not len(flat.free):
        raise InputError("no free floor in it")
    angle = np.random.default_rng(seed).uniform(0, np.pi)
    across = np.array([np.cos(angle), np.sin(angle)])
    low, high = np.quantile(flat.free @ across, [1 - HALF, HALF])
    return select_part(flat, lambda p: p @ across <= high), select_part(flat, lambda p: p @ across >= low)


def select_part(flat: FlatMap, inside: Callable[[Array], Array]) -> FlatMap:
    """Select a part of a floor."""
    return replace(flat, walls=flat.walls[inside(flat.walls)], free=flat.free[inside(flat.free)], poses=None)


# Tables
def classify_merge(row: Row) -> str:
    """Return the row of the table that a pair belongs to."""
    if row["kind"] != "overlap":
        alike = "" if is_distinguishable(row) else ", which nobody can tell apart"
        return f"{row['group']}: {row['kind'].replace('-', ' ')}{alike}"
    if row["common"] < 1 or row["overlap"] == 0:
        return f"{row['group']}: nothing in common"
    return f"{row['group']}: {'at least' if row['common'] >= LEAST_COMMON else 'less than'} {LEAST_COMMON:g} m² in common"


def format_tables(rows: Sequence[Row]) -> Iterator[str]:
    """Yield lines in Markdown: of each part that was measured, and what could not be."""
    fine = [row for row in rows if "failed" not in row]
    for part, lines in (("rooms", iter_room_table), ("merges", iter_merge_table), ("ranking", table)):
        if some := [row for row in fine if row["part"] == part]:
            yield from (*lines(some), "")
    lost = [row for row in rows if "failed" in row]
    yield f"Not measured: {len(lost)}{'.' if not lost else ':'}"
    yield from (f"- {row['part']}, {row['group']}: {row['failed']}" for row in lost)


def iter_room_table(rooms: Sequence[Row]) -> Iterator[str]:
    """Yield rooms by sensor."""
    yield from ("| rooms, maps of | maps | IoU | MCC | recall | precision |", "|---|---|---|---|---|---|")
    simulated = [row for row in rooms if row["group"] != "real plans"]
    for group, some in [*group_by_key(rooms, lambda row: row["group"]), ("all made buildings", simulated)]:
        scores = [
            format_interval(np.array([r[k] for r in some]), np.array([r["place"] for r in some]))
            for k in ("iou", "mcc", "recall", "precision")
        ]
        yield f"| {group} | {len(some)} | {' | '.join(scores)} |"


def iter_merge_table(rows: Sequence[Row]) -> Iterator[str]:
    """Yield merges by kind of pair."""
    yield "| merges | pairs | buildings | right | 0.1 m, 1° | right and believed | believed, wrong | such buildings, 95 % |"
    yield "|" + "---|" * 8
    for group, some in group_by_key(rows, classify_merge):
        wrong = sum(r["believed"] and not r["right"] for r in some)
        sums = [sum(r[k] for r in some) for k in ("right", "fine")] + [sum(r["right"] and r["believed"] for r in some)]
        places = {r["place"] for r in some}
        low, high = compute_exact_interval(len({r["place"] for r in some if r["believed"] and not r["right"]}), len(places))
        cells = (len(some), len(places), *sums, wrong, f"{100 * low:.0f}–{100 * high:.0f} %")
        yield f"| {group} | {' | '.join(map(str, cells))} |"


def group_by_key(rows: Sequence[Row], key: Callable[[Row], str]) -> list[tuple[str, list[Row]]]:
    """Group rows in the order in which they come."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return list(groups.items())
