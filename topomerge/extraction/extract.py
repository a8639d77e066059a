"""Point cloud -> topometric map: the steps of section 2 of the seeds, in their order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from topomerge.archive import read_weights_json
from topomerge.blas import limit_blas_threads
from topomerge.errors import InputError
from topomerge.extraction.attributes import estimate_attributes
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.elevations.wall_doors import WALL_DOOR_FEATURES, build_door_candidates
from topomerge.extraction.landmarks import add_landmarks
from topomerge.extraction.navigable import add_crossed_cells, compute_navigable_volume, find_free_space
from topomerge.extraction.parameters import DefaultParameters, Parameters, ThesisParameters, resolve_parameters
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.extraction.plans.passages import Pair, Passage, compute_door_features, predict_door, sort_pair
from topomerge.extraction.plans.plan_network import LOOKS
from topomerge.extraction.plans.storey_floor import build_floor
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.scan import Scan, read_scan
from topomerge.extraction.segment import (
    LEAST_FLAT_ROOM,
    LEAST_ROOM,
    RasterisedStoreys,
    Scorer,
    SegmentedStorey,
    find_rooms_of_segments,
    log_odds,
    partition_rooms,
    rasterise_storeys,
    score_by_plan,
    segment_storey,
)
from topomerge.extraction.slices import is_slice, raise_slice
from topomerge.extraction.topology import build_topometric_map, select_rooms_with_floor
from topomerge.extraction.views.view_rooms import segment_views
from topomerge.extraction.walls import relabel_walls, unroll_walls
from topomerge.kernels import run_side_by_side
from topomerge.numpy_nn import sigmoid
from topomerge.progress import Progress, Stopwatch
from topomerge.types import EDGE_DTYPE, LEVELLED, Array, PointCloud, TopometricMap, VoxelGrid, add_outline_odds

# What the score of a passage weighs: the log odds of a door by the plan, and by the walls, on average along a doorway that they
# show there; 0 where they show none or speak against one.
# The sensor's way is no evidence here: fitted, it got a weight of the wrong sign (docs/adr/0024).
SCORE_INPUTS = ("constant", "plan", "shown")
KINDS = ("walls",)  # of scans that have a model: walls show at heights
PASSAGES_FILE = "passages.json"
MOST_LOG_ODDS = 8.0
JOINED_LOOKS = 1  # at the plan of joined maps: their rooms were cut by four looks each, and have a say (docs/adr/0031)


def find_passages(storeys: Sequence[SegmentedStorey], walls: StoreyWalls | None, weigh: bool = True) -> list[SegmentedStorey]:
    """Gather what walls show of every passage of all storeys; they come back with it.

    Args:
        walls: None of a scan that shows none at heights.
        weigh: do walls have a say? Of joined maps the rooms of their parts have it.
    """
    if walls is None or not weigh:
        return list(storeys)
    shown = _find_shown_doors(storeys, walls)
    out, first = [], 0
    for storey in storeys:
        passages = {
            (a, b): replace(passage, shown=shown.get((a + first, b + first), 0.0)) for (a, b), passage in storey.passages.items()
        }
        out.append(replace(storey, passages=passages))
        first += storey.count
    return out


def score_passages(x: Array, passages: Sequence[Passage], weights: Array) -> Array:
    """Return (n,) calibrated probability that a door parts the two sides of each passage, by all evidence.

    Args:
        x: (n, 17) `DOOR_FEATURES` of the sides as they have grown.
        weights: (3,) of `SCORE_INPUTS`.
    """
    shown = np.array([passage.shown for passage in passages], float)
    return sigmoid(compute_inputs(log_odds(predict_door(x)), shown) @ weights)


def choose_scorer(walls: bool) -> Scorer:
    """Return the score of a scan's passages: by all evidence; of slices, raised plans and joined maps by plan and parts.

    Args:
        walls: does the scan show walls at heights, and is it of one map?

    Raises:
        InputError: the weights that ship are damaged.
    """
    # Slices: a model of their own was fitted and was no better (log loss .265 with it, .248 without: docs/adr/0024).
    if not walls:
        return score_by_plan
    weights = np.array(read_weights_json("topomerge.extraction", PASSAGES_FILE).get("walls", ()), float)
    if weights.shape != (len(SCORE_INPUTS),) or not np.isfinite(weights).all():
        numbers = f"walls must be {len(SCORE_INPUTS)} numbers"
        raise InputError(f"{PASSAGES_FILE}: {numbers}: run train.py task=passages export=package")
    return partial(score_passages, weights=weights)


def compute_inputs(plan: Array, shown: Array) -> Array:
    """Return (n, 3) `SCORE_INPUTS` of passages.

    Args:
        plan: (n,) log odds of a door by the plan alone.
        shown: (n,) by the walls.
    """
    plan = np.clip(plan, -MOST_LOG_ODDS, MOST_LOG_ODDS)
    return np.column_stack([np.ones(len(plan)), plan, shown])


def _find_shown_doors(storeys: Sequence[SegmentedStorey], walls: StoreyWalls) -> dict[Pair, float]:
    """Return the log odds of the surest doorway that walls show between each two segments, none below 0."""
    edges, first = [np.zeros(0, EDGE_DTYPE)], 0
    for storey in storeys:
        edges.append(_edges_of(storey, first))
        first += storey.count
    complete = np.concatenate([np.zeros(0), *(storey.completeness for storey in storeys)])
    candidates = build_door_candidates(np.concatenate(edges), complete, [storey.classes for storey in storeys], walls)
    odds = np.maximum(candidates.features[:, WALL_DOOR_FEATURES.index("wall_mean")], 0)
    shown: dict[Pair, float] = {}
    for rooms, value in zip(candidates.edges["rooms"].tolist(), odds.tolist(), strict=True):
        shown[sort_pair(*rooms)] = max(shown.get(sort_pair(*rooms), 0.0), value)
    return shown


def _edges_of(storey: SegmentedStorey, first: int) -> Array:
    """Return the EDGE_DTYPE of a storey's passages, between segments numbered from `first` on."""
    out = np.zeros(len(storey.passages), EDGE_DTYPE)
    if not len(out):
        return out
    peak = np.zeros(storey.count)
    inside = storey.segment >= 0
    np.maximum.at(peak, storey.segment[inside], storey.clearance[inside])
    area = storey.areas
    pairs = list(storey.passages)
    x = np.array([compute_door_features(storey.passages[p], peak[list(p)], area[list(p)]) for p in pairs])
    out["confidence"] = predict_door(x)
    for row, pair in zip(out, pairs, strict=True):
        passage = storey.passages[pair]
        row["rooms"], row["centre"], row["width"] = np.array(pair) + first, storey.locate_centre(passage), passage.width
        row["direction"], row["open"] = np.arctan2(passage.across[0], -passage.across[1]) % np.pi, True
        row["kind"] = "door"
    return out


COARSE_CELL = 0.15  # m: in larger ones, the walls beside a door leave too little of it


@limit_blas_threads
def extract(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud],
    *,
    voxel_size: float = 0.1,
    preset: str | Parameters = "default",
    name: str | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> TopometricMap:
    """Extract rooms, doors and storeys (seeds 2).

    Args:
        source: a cloud, chunks of one, (N, 3) points, or occupied cells.
        voxel_size: edge length of a cell, m (a grid keeps its own).
        preset: ``"default"``, ``"thesis"``, or the parameters of one of them (`PRESETS`).
        name: where the map comes from; the cloud's own source by default.
        progress: called now and then with the share done and a text.
        overrides: single parameters of the preset.

    Raises:
        InputError: no finite point, an absurd extent, no floor that somebody could stand on, or a parameter that the preset does
            not have.
    """
    p = resolve_parameters(preset, overrides)
    watch = Stopwatch(progress)
    warnings: list[str] = []
    scan, navigable = read_navigable(source, voxel_size, p, watch)
    if isinstance(p, ThesisParameters):
        watch.begin("rooms", 0.4)
        floor = segment_views(scan.grid, navigable, p, watch)  # 2.4 to 2.6
        map = build_topometric_map(scan.grid, floor, p.standing_height)  # 2.7
        map = replace(map, rooms=add_outline_odds(map.rooms))
    else:
        floor, walls = cut_rooms(scan, navigable, p, watch)
        watch.begin("topology", 0.85)
        map = build_topometric_map(scan.grid, floor, p.standing_height)  # 2.7
        watch.begin("odds of rooms, doors on walls", 0.87)
        map, warnings = estimate_attributes(map, scan, floor, walls, p.walls)

    watch.begin("free space", 0.9)
    free = find_free_space(scan, navigable, p.range) if p.carve else scan.free

    chosen = {**asdict(p), **floor.chosen_parameters, "voxel_size": scan.grid.edge}
    if scan.levelling is not None:
        chosen[LEVELLED] = scan.levelling.tolist()
    map = replace(
        map,
        free=free,
        source=scan.source if name is None else name,
        parameters={**chosen, "preset": preset if isinstance(preset, str) else "custom"},
        seconds=watch.end(),
        warnings=(*scan.warnings, *warnings, *list_warnings(map)),
    )
    return add_landmarks(map, scan.landmarks)


def read_navigable(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud], voxel_size: float, p: Parameters, watch: Stopwatch
) -> tuple[Scan, VoxelGrid]:
    """Read a scan, complete it where it shows no floor, and find where a body can walk.

    Raises:
        InputError: as `extract`.
    """
    watch.begin("read and voxelise", 0.0)
    scan = read_scan(source, voxel_size, p.sparse, p.level)  # 2.2
    scan = replace(scan, flat=is_slice(scan.grid))
    scan = raise_slice(scan) if p.assume else scan
    watch.begin("navigable volume", 0.3)
    scan, navigable = compute_navigable_volume(scan, p)  # 2.3
    if scan.flat or isinstance(p, ThesisParameters):
        return scan, navigable
    return add_crossed_cells(scan), navigable


@dataclass(frozen=True, eq=False)
class Evidence:
    """All that is known of a scan's storeys before anything is cut.

    Args:
        rasters: the storeys seen from above.
        storeys: cut into segments, whose passages have all evidence.
        walls: with the segments beside them; None of a scan that shows none at heights.
    """

    rasters: RasterisedStoreys
    storeys: list[SegmentedStorey]
    walls: StoreyWalls | None


def gather_evidence(
    scan: Scan, navigable: VoxelGrid, p: DefaultParameters, watch: Stopwatch, parts: Sequence[PartRooms] = ()
) -> Evidence:
    """Cut the storeys into too many segments rather than too few, and gather what speaks for doors between them."""
    watch.begin("segments", 0.4)
    looks = JOINED_LOOKS if parts else LOOKS
    rasters, places = rasterise_storeys(scan, navigable, p.standing_height, looks), scan.places
    # Rather too many segments than too few: what is merged here, no later evidence can part (docs/adr/0024).
    narrow = min(p.narrow, p.slice_door if scan.flat else p.door)
    storeys = run_side_by_side(lambda i: segment_storey(rasters, i, narrow, parts, places), range(len(rasters.numbers)))
    watch.begin("walls", 0.6)
    walls = unroll_walls(scan, navigable, rasters, storeys) if p.walls else None
    return Evidence(rasters, find_passages(storeys, walls, p.walls and not parts), walls)


def cut_rooms(
    scan: Scan, navigable: VoxelGrid, p: DefaultParameters, watch: Stopwatch, parts: Sequence[PartRooms] = ()
) -> tuple[Floor, StoreyWalls | None]:
    """Cut the storeys of a scan into rooms, once, by all evidence (docs/adr/0024).

    Args:
        parts: rooms of the maps that these cells were joined of, which have a say in where rooms part (`fusion.joined_rooms`).

    Returns:
        The floors of all storeys; their walls with the rooms of the map beside them, None of a scan that shows none at heights.
    """
    found = gather_evidence(scan, navigable, p, watch, parts)
    watch.begin("rooms", 0.75)
    # Elevations of joined maps have no say: the faces of two maps differ by more than a leaf lies back (docs/adr/0014).
    weigh = p.walls and not parts
    score = choose_scorer(weigh and found.walls is not None)
    # Of slices surer doors only: else their furniture cuts rooms (docs/adr/0026).
    door, least = (p.slice_door, LEAST_FLAT_ROOM) if scan.flat else (p.door, LEAST_ROOM)
    cut = [partition_rooms(storey, score, door, least) for storey in found.storeys]  # 2.6
    floor = build_floor(scan.grid, navigable, found.rasters.storey, found.rasters.storeys, cut, found.rasters.factor)
    if found.walls is None:
        return floor, None
    return floor, relabel_walls(found.walls, find_rooms_of_segments(cut, select_rooms_with_floor(floor)))


def list_warnings(map: TopometricMap) -> list[str]:
    """List warnings about the map as a whole, for the user."""
    warnings = []
    if map.grid.edge > COARSE_CELL:
        warnings.append(f"cells of {map.grid.edge:g} m are coarse: doors may be lost, {COARSE_CELL} m or less finds them")
    if not len(map.rooms):
        warnings.append("no room was found: take larger voxels if the points are sparse, smaller ones if they are dense")
    return warnings
