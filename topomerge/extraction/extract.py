"""Point cloud -> topometric map: the steps of section 2 of the seeds, in their order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from topomerge.blas import one_blas_thread
from topomerge.extraction.distinct_doors import distinct_doors
from topomerge.extraction.elevations.doorway_rooms import doors_inside_rooms
from topomerge.extraction.elevations.doorways import place_classes
from topomerge.extraction.elevations.elevation import wall_elevations
from topomerge.extraction.elevations.fixtures import with_fixtures
from topomerge.extraction.elevations.wall_doors import with_wall_doors
from topomerge.extraction.elevations.windows import with_windows
from topomerge.extraction.floor import Floor
from topomerge.extraction.floor_patches import without_patches
from topomerge.extraction.free_space import free_space, with_crossed_cells
from topomerge.extraction.navigable import navigable_volume
from topomerge.extraction.parameters import Parameters, ThesisParameters, chosen_parameters
from topomerge.extraction.plans.inner_doors import INNER_DOOR_DTYPE
from topomerge.extraction.plans.part_rooms import PartRooms
from topomerge.extraction.plans.plan_rooms import rooms_of_plans
from topomerge.extraction.plans.storey_rooms import OtherSigns
from topomerge.extraction.room_odds import with_room_odds
from topomerge.extraction.scan import Scan, read_scan
from topomerge.extraction.slices import is_raised, is_slice, with_raised_slice
from topomerge.extraction.small_rooms import gathered, without_small_rooms
from topomerge.extraction.stopwatch import Progress, Stopwatch
from topomerge.extraction.topology import topometric_map
from topomerge.extraction.views.view_rooms import rooms_of_views
from topomerge.extraction.walked_doors import with_walked_doors
from topomerge.extraction.walked_rooms import walked_rooms
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

    scan, navigable, floor, map = rooms_and_passages(source, voxel_size, p, watch, parts)

    watch.begin("odds of rooms, doors on walls", 0.87)
    made, doubts, again = _with_odds_and_openings(map, scan, floor, p)
    if not parts:  # rooms of joined maps are what their parts say
        if len(again.doors) and not isinstance(p, ThesisParameters):
            looks = [(plan, storey.probability) for plan, storey in zip(floor.plans, floor.classified_storeys, strict=True)]
            signs = OtherSigns(doors=again.doors, looked_at=looks, places=scan.places)
            floor = rooms_of_plans(scan.grid, navigable, p.door, p.narrow, p.standing_height, signs)
            made, doubts, again = _with_odds_and_openings(topometric_map(scan.grid, floor, p.standing_height), scan, floor, p)
        if again.one is not None:
            floor = gathered(floor, again.one)
            made, doubts, _ = _with_odds_and_openings(topometric_map(scan.grid, floor, p.standing_height), scan, floor, p)
    map = made

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


def rooms_and_passages(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud],
    voxel_size: float,
    p: Parameters,
    watch: Stopwatch,
    parts: Sequence[PartRooms] = (),
) -> tuple[Scan, VoxelGrid, Floor, TopometricMap]:
    """The scan, its navigable volume, its floors cut into rooms, and the map of these with what the floors show of doors.

    Args:
        source, voxel_size, parts: as of `extract`.
        p: of its preset.

    Raises:
        InputError: as `extract`.
    """
    watch.begin("read and voxelise", 0.0)
    scan = read_scan(source, voxel_size, p.sparse, p.level)  # 2.2
    flat = is_slice(scan.grid)
    scan = with_raised_slice(scan) if p.assume else scan

    watch.begin("navigable volume", 0.3)
    scan, navigable = navigable_volume(scan, p)  # 2.3

    watch.begin("rooms", 0.4)
    if isinstance(p, ThesisParameters):
        floor = rooms_of_views(scan.grid, navigable, p, watch)  # 2.4 to 2.6
    else:
        scan = scan if flat else with_crossed_cells(scan)
        signs = OtherSigns(parts, flat=flat, crossed=scan.crossed, raised=not flat and is_raised(scan.grid), places=scan.places)
        floor = rooms_of_plans(scan.grid, navigable, p.slice_door if flat else p.door, p.narrow, p.standing_height, signs)

    watch.begin("topology", 0.85)
    map = topometric_map(scan.grid, floor, p.standing_height)  # 2.7
    if flat and not isinstance(p, ThesisParameters) and p.walls and not parts:  # rooms of joined maps are what their parts say
        larger = without_small_rooms(floor, map)
        if larger is not floor:
            floor, map = larger, topometric_map(scan.grid, larger, p.standing_height)
    return scan, navigable, floor, map


class _Reconsidered(NamedTuple):
    """What walls and the sensor's way say of how the floors were cut: doors inside of rooms (`doorway_rooms.doors_inside_rooms`),
    and rooms that are one (`walked_rooms`)."""

    doors: Array = np.zeros(0, INNER_DOOR_DTYPE)
    one: Array | None = None


def _with_odds_and_openings(
    map: TopometricMap, scan: Scan, floor: Floor, p: Parameters
) -> tuple[TopometricMap, list[str], _Reconsidered]:
    """The map with how likely each room is one, with the doors, windows and fixtures that its walls show, and with the doors that
    the sensor was carried through; what is odd about its way; and what these say of its rooms."""
    if isinstance(p, ThesisParameters):  # its floors end before the walls: the odds were fitted to others
        return replace(map, rooms=with_outline_odds(map.rooms)), [], _Reconsidered()
    map = with_room_odds(map, scan.rays, scan.raised)
    walls = None
    if p.walls and scan.fine is not None and len(map.rooms):
        walls = wall_elevations(map, scan.fine, scan.shades, scan.crossed)
    classes = None if walls is None else place_classes(walls)
    again = _Reconsidered()
    if walls is not None and classes is not None:
        again = _Reconsidered(doors_inside_rooms(map, walls, classes))
    if p.walls:
        map, likeliest = with_wall_doors(map, floor.classified_storeys, walls, classes)
    map, doubt = with_walked_doors(map, scan.places)
    map = distinct_doors(map)
    if walls is not None:
        again = again._replace(one=walked_rooms(map, floor, likeliest))
    if walls is not None and classes is not None:
        map = with_fixtures(with_windows(map, walls, classes), walls, classes)
        map = without_patches(map, scan.places)
    return map, [doubt] if doubt else [], again


def _doubts(map: TopometricMap) -> list[str]:
    """What the user should know about the map as a whole."""
    doubts = []
    if map.grid.edge > COARSE_CELL:
        doubts.append(f"cells of {map.grid.edge:g} m are coarse: doors may be lost, {COARSE_CELL} m or less finds them")
    if not len(map.rooms):
        doubts.append("no room was found: take larger voxels if the points are sparse, smaller ones if they are dense")
    return doubts
