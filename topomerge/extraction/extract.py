"""Point cloud -> topometric map: the steps of section 2 of the seeds, in their order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from topomerge.blas import one_blas_thread
from topomerge.extraction.attributes import estimate_attributes
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.navigable import free_space, navigable_volume, with_crossed_cells
from topomerge.extraction.parameters import DefaultParameters, Parameters, ThesisParameters, chosen_parameters
from topomerge.extraction.partition import (
    FLAT_LEAST,
    ROOM_LEAST,
    find_rooms_of_segments,
    partition_rooms,
)
from topomerge.extraction.passages import choose_scorer, find_passages
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.extraction.plans.storey_floor import floor_of_storeys
from topomerge.extraction.plans.storey_plan import Floor
from topomerge.extraction.scan import Scan, read_scan
from topomerge.extraction.segment import RasterisedStoreys, SegmentedStorey, rasterise_storeys, segment_storey
from topomerge.extraction.slices import is_slice, with_raised_slice
from topomerge.extraction.stopwatch import Progress, Stopwatch
from topomerge.extraction.topology import rooms_with_floor, topometric_map
from topomerge.extraction.views.view_rooms import rooms_of_views
from topomerge.extraction.walls import relabel_walls, split_at_doorways, unroll_walls
from topomerge.types import LEVELLED, Array, PointCloud, TopometricMap, VoxelGrid, with_outline_odds

COARSE_CELL = 0.15  # m: in larger ones, the walls beside a door leave too little of it


@one_blas_thread
def extract(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud],
    *,
    voxel_size: float = 0.1,
    preset: str | Parameters = "default",
    name: str | None = None,
    progress: Progress | None = None,
    parts: Sequence[PartRooms] = (),
    **overrides: Any,
) -> TopometricMap:
    """Extract rooms, doors and storeys (seeds 2).

    Args:
        source: a cloud, chunks of one, (N, 3) points, or occupied cells.
        voxel_size: edge length of a cell, m (a grid keeps its own).
        preset: ``"default"``, ``"thesis"``, or the parameters of one of them (`PRESETS`).
        name: where the map comes from; the cloud's own source by default.
        progress: called now and then with the share done and a text.
        parts: rooms of the maps that these cells were joined of, which have a say in where rooms part (`fusion.fuse`).
        overrides: single parameters of the preset.

    Raises:
        InputError: no finite point, an absurd extent, no floor that somebody could stand on, or a parameter that the preset does
            not have.
    """
    p = chosen_parameters(preset, overrides)
    watch = Stopwatch(progress)
    doubts: list[str] = []
    scan, navigable = read_navigable(source, voxel_size, p, watch)
    if isinstance(p, ThesisParameters):
        watch.begin("rooms", 0.4)
        floor = rooms_of_views(scan.grid, navigable, p, watch)  # 2.4 to 2.6
        map = topometric_map(scan.grid, floor, p.standing_height)  # 2.7
        map = replace(map, rooms=with_outline_odds(map.rooms))
    else:
        floor, walls = cut_rooms(scan, navigable, p, watch, parts)
        watch.begin("topology", 0.85)
        map = topometric_map(scan.grid, floor, p.standing_height)  # 2.7
        watch.begin("odds of rooms, doors on walls", 0.87)
        map, doubts = estimate_attributes(map, scan, floor, walls, p.walls)

    watch.begin("free space", 0.9)
    free = free_space(scan, navigable, p.range) if p.carve else scan.free

    chosen = {**asdict(p), **floor.chosen_parameters, "voxel_size": scan.grid.edge}
    if scan.levelling is not None:
        chosen[LEVELLED] = scan.levelling.tolist()
    return replace(
        map,
        free=free,
        source=scan.source if name is None else name,
        parameters={**chosen, "preset": preset if isinstance(preset, str) else "custom"},
        seconds=watch.end(),
        warnings=(*scan.warnings, *doubts, *_doubts(map)),
    )


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
    scan = with_raised_slice(scan) if p.assume else scan
    watch.begin("navigable volume", 0.3)
    scan, navigable = navigable_volume(scan, p)  # 2.3
    if scan.flat or isinstance(p, ThesisParameters):
        return scan, navigable
    return with_crossed_cells(scan), navigable


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
    rasters, places = rasterise_storeys(scan, navigable, p.standing_height), scan.places
    narrow = min(p.narrow, p.slice_door if scan.flat else p.door)
    storeys = [segment_storey(rasters, i, narrow, parts, places) for i in range(len(rasters.numbers))]
    watch.begin("walls", 0.6)
    walls = unroll_walls(scan, navigable, rasters, storeys) if p.walls else None
    if walls is not None:
        storeys, walls = split_at_doorways(storeys, walls)
    return Evidence(rasters, find_passages(storeys, walls, p.walls and not parts), walls)


def cut_rooms(
    scan: Scan, navigable: VoxelGrid, p: DefaultParameters, watch: Stopwatch, parts: Sequence[PartRooms] = ()
) -> tuple[Floor, StoreyWalls | None]:
    """Cut the storeys of a scan into rooms, once, by all evidence (docs/adr/0024).

    Returns:
        The floors of all storeys; their walls with the rooms of the map beside them, None of a scan that shows none at heights.
    """
    found = gather_evidence(scan, navigable, p, watch, parts)
    watch.begin("rooms", 0.75)
    weigh = p.walls and not parts
    score = choose_scorer(weigh and found.walls is not None)
    door = p.slice_door if scan.flat else p.door
    least = FLAT_LEAST if scan.flat else ROOM_LEAST
    cut = [partition_rooms(storey, score, door, least) for storey in found.storeys]  # 2.6
    floor = floor_of_storeys(scan.grid, navigable, found.rasters.storey, found.rasters.storeys, cut, found.rasters.factor)
    if found.walls is None:
        return floor, None
    return floor, relabel_walls(found.walls, find_rooms_of_segments(cut, rooms_with_floor(floor)))


def _doubts(map: TopometricMap) -> list[str]:
    """What the user should know about the map as a whole."""
    doubts = []
    if map.grid.edge > COARSE_CELL:
        doubts.append(f"cells of {map.grid.edge:g} m are coarse: doors may be lost, {COARSE_CELL} m or less finds them")
    if not len(map.rooms):
        doubts.append("no room was found: take larger voxels if the points are sparse, smaller ones if they are dense")
    return doubts
