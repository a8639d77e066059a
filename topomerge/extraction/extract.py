"""Point cloud -> topometric map: the steps of section 2 of the seeds, in their order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.assumed import any_ceiling, extruded, has_floor, is_slice, with_assumed_floor
from topomerge.extraction.ceilings import without_ceilings
from topomerge.extraction.convolution import Kernel, sphere, stick
from topomerge.extraction.dilation import dilate_upwards
from topomerge.extraction.distance_field import horizontal_distance_field
from topomerge.extraction.floors import floor_components, largest_component
from topomerge.extraction.free_space import carve_rays, carve_views
from topomerge.extraction.gaps import bridge_gaps
from topomerge.extraction.noise import without_flying_cells, without_gaps
from topomerge.extraction.plans.plan_rooms import rooms_of_plans
from topomerge.extraction.rooms import Floor, navigable_floor, split_rooms
from topomerge.extraction.topology import topometric_map
from topomerge.extraction.unobstructed import unobstructed
from topomerge.extraction.views.clustering import INFLATIONS, cluster_views
from topomerge.extraction.views.propagation import propagate_labels
from topomerge.extraction.views.similarity import jaccard_similarity
from topomerge.extraction.views.views import best_of_tiles, local_maxima, raise_views
from topomerge.extraction.views.visibility import visible_cells
from topomerge.extraction.views.votes import vote
from topomerge.extraction.voxels import voxelise
from topomerge.types import Array, PointCloud, TopometricMap, VoxelGrid

Progress = Callable[[float, str], None]


FINEST, COARSE, COARSEST = 0.02, 0.15, 0.3  # m: above the second, walls beside a door leave too little of it
HEIGHT_OF_EYES = 1.5  # m, of the views that carve
MOST_RAYS = 400_000  # kept of a portion of two million points


@dataclass(frozen=True)
class Preset:
    """Parameters of the extraction; lengths in metres.

    With `door` above 0 rooms come from the plans of the storeys (docs/adr/0004), otherwise from the views, as in the thesis: then
    everything from `view_spacing` to `absorb` counts.
    """

    noise: float = 0.4  # cells with a smaller share of the usual number of neighbours are in nobody's way; 0: all are
    sparse: float = 3.5  # cells are doubled until they have that many neighbours of 26 (median): fewer are no surface; 0: never
    stem_height: float = 0.25  # a step may stand beside the foot
    body_width: float = 0.30
    body_height: float = 1.50  # with the stem 1.75: a grown-up
    dilation: float = 0.25
    bridge: float = 0.30  # half the gap in the floor that is bridged; 0: none
    ceilings: bool = False  # may the upper side of a ceiling be floor?
    largest_only: bool = False  # keep the largest component, or all that are floors
    view_spacing: float = 1.0  # one view for each tile of this size; 0: local maxima of the distance field
    view_radius: float = 0.5  # of the local maxima
    view_height: float = 2.3  # over the lintels of most doors, and always below the ceiling
    view_clearance: float = 0.3  # from the ceiling; 0: views may end up in it
    range: float = 5.0
    tolerance: float = 0.2  # noisy walls are cells thick
    least_similarity: float = 0.3
    inflations: tuple[float, ...] = INFLATIONS
    propagation_cells: float = 2.0  # radius of the neighbourhood, in cells as in the thesis
    propagation_rounds: int = 10
    least_volume: float = 0.128  # of a room's occupied cells, m3
    absorb: bool = True  # give smaller pieces to the room they touch
    door: float = 0.5  # narrowings of the floor that are doors with this probability part rooms; 0: rooms come from the views
    narrow: float = 0.2  # and with this one areas of a room
    assume: bool = True  # a floor for slices and for scans of the upper half of rooms
    carve: bool = True  # the space that rays crossed


PRESETS = {
    "default": Preset(),
    "thesis": Preset(
        noise=0.0,
        sparse=0.0,
        body_height=0.75,
        bridge=0.0,
        ceilings=True,
        largest_only=True,
        view_spacing=0.0,
        view_height=1.6,
        view_clearance=0.0,
        tolerance=0.0,
        absorb=False,
        door=0.0,
        assume=False,
        carve=False,
    ),
}


def extract(
    source: PointCloud | VoxelGrid | Array | Iterable[PointCloud],
    *,
    voxel_size: float = 0.1,
    preset: str | Preset = "default",
    name: str | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> TopometricMap:
    """Extract rooms, doors and storeys (seeds 2).

    Args:
        source: a cloud, chunks of one, (N, 3) points, or occupied cells.
        voxel_size: edge length of a cell, m (a grid keeps its own).
        preset: ``"default"``, ``"thesis"`` or a `Preset`.
        name: where the map comes from; the cloud's own source by default.
        progress: called now and then with the share done and a text.
        overrides: single parameters of the preset.

    Raises:
        InputError: no finite point, an absurd extent, or no floor that somebody could stand on.
    """
    p = _preset(preset, overrides)
    edge = source.edge if isinstance(source, VoxelGrid) else voxel_size
    if not (isinstance(edge, int | float) and FINEST <= edge <= COARSEST):
        raise InputError(f"voxel size must be between {FINEST} and {COARSEST} m to find rooms and doors, not {edge}")
    known: dict[str, Any] = {"warnings": []}
    try:
        return _extract(source, voxel_size, p, preset, name, known, _Clock(progress))
    except InputError as error:  # what looked wrong on the way is often the reason
        if not known["warnings"]:
            raise
        raise InputError(f"{error} (and {'; '.join(known['warnings'])})") from error


def _extract(
    source: Any, voxel_size: float, p: Preset, preset: str | Preset, name: str | None, known: dict[str, Any], clock: _Clock
) -> TopometricMap:
    """The steps themselves."""
    with clock("read and voxelise", 0.0):
        grid = _grid(source, voxel_size, known)
        if p.sparse and not isinstance(source, VoxelGrid):
            grid = without_gaps(grid, p.sparse, known["warnings"])
        if p.assume:
            grid = _upright(grid, known)
    with clock("navigable volume", 0.3):
        grid, navigable = _standing(grid, p, known)
    parameters = {**asdict(p), "voxel_size": grid.edge, "preset": preset if isinstance(preset, str) else "custom"}
    if p.door:
        with clock("rooms", 0.4):
            floor = rooms_of_plans(grid, navigable, p.door, p.narrow, p.stem_height + p.body_height)
    else:
        floor, parameters["inflation"] = rooms_of_views(grid, navigable, p, clock)
    with clock("topology", 0.85):
        result = topometric_map(grid, floor, p.stem_height + p.body_height)
    with clock("free space", 0.9):
        free = known.get("free") or free_space(grid, navigable, known.get("rays"), p)
    if grid.edge > COARSE:
        known["warnings"].append(f"cells of {grid.edge:g} m are coarse: doors may be lost, {COARSE} m or less finds them")
    if not len(result.rooms):
        known["warnings"].append("no room was found: take larger voxels if the points are sparse, smaller ones if they are dense")
    return replace(
        result,
        free=free,
        source=name if name is not None else known.get("source", ""),
        parameters=parameters,
        seconds=clock.seconds,
        warnings=tuple(known["warnings"]),
    )


def _upright(grid: VoxelGrid, known: dict[str, Any]) -> VoxelGrid:
    """A slice gets walls and a floor."""
    if not is_slice(grid):
        return grid
    known["warnings"].append("the scan is a slice: walls of 2.4 m and a floor were assumed")
    return extruded(grid, known.get("rays"))


def _standing(grid: VoxelGrid, p: Preset, known: dict[str, Any]) -> tuple[VoxelGrid, VoxelGrid]:
    """The navigable volume; if no floor was seen, of the grid with an assumed one."""
    try:
        navigable = navigable_volume(grid, p)
        if not p.assume or has_floor(grid, navigable, p.stem_height + p.body_height):
            return grid, navigable
    except InputError:
        if not p.assume or not any_ceiling(grid):
            raise
    known["warnings"].append("no floor was seen: one was assumed")
    grid = with_assumed_floor(grid, known.get("rays"))
    return grid, navigable_volume(grid, p)


def navigable_volume(grid: VoxelGrid, p: Preset) -> VoxelGrid:
    """Where a body can walk (seeds 2.3): standing room, joined upwards over steps, in connected parts.

    Raises:
        InputError: nowhere is room for a body on a floor.
    """
    body = stick_kernel(grid, p)
    if p.noise:
        grid = without_flying_cells(grid, p.noise)
    standing = unobstructed(grid, body)
    if not p.ceilings:
        standing = without_ceilings(grid, standing)
    if p.bridge:
        standing = bridge_gaps(grid, standing, body, p.bridge)
    dilated = dilate_upwards(standing, p.dilation)
    navigable = largest_component(dilated) if p.largest_only else floor_components(dilated)
    if not len(navigable):
        raise InputError(
            f"no floor found: nowhere is an area of 1 m2 with {p.stem_height + p.body_height:g} m of empty space above it; check "
            "--up and --unit, or take larger voxels if the points are sparse"
        )
    return navigable


def free_space(grid: VoxelGrid, navigable: VoxelGrid, rays: tuple[Array, Array] | None, p: Preset) -> VoxelGrid | None:
    """Cells known to be empty: crossed by the sensor's rays, or where its places are unknown, seen through from views."""
    if not p.carve:
        return None
    if rays is not None:
        return carve_rays(grid, *rays)
    return carve_views(grid, navigable, HEIGHT_OF_EYES, p.range)


def optimal_views(grid: VoxelGrid, navigable: VoxelGrid, p: Preset) -> Array:
    """(V, 3) positions from which the map is seen best (seeds 2.4)."""
    distance = horizontal_distance_field(navigable)
    if p.view_spacing:
        rows = best_of_tiles(navigable, distance, p.view_spacing)
    else:
        rows = local_maxima(navigable, distance, p.view_radius)
    return raise_views(grid, navigable.cells[rows], p.view_height, p.view_clearance or None)


def rooms_of_views(grid: VoxelGrid, navigable: VoxelGrid, p: Preset, clock: _Clock) -> tuple[Floor, float]:
    """Rooms as clusters of views that see the same cells (seeds 2.4 to 2.6), and the inflation of the clustering."""
    with clock("views", 0.4):
        views = optimal_views(grid, navigable, p)
    with clock("visibility", 0.45):
        visibility = visible_cells(grid, views, p.range, p.tolerance, clock.part(0.45, 0.65))
    with clock("similarity", 0.65):
        similarity = jaccard_similarity(visibility, p.least_similarity, views, 2 * p.range, grid.cells[:, 2])
    with clock("clusters", 0.75):
        cluster, inflation = cluster_views(similarity, p.inflations)
    with clock("rooms", 0.85):
        labels = vote(visibility, cluster)
        labels = propagate_labels(grid, labels, sphere(p.propagation_cells, 1.0), p.propagation_rounds)
        room = split_rooms(grid, labels, p.least_volume, p.absorb)
    return navigable_floor(grid, room, navigable, p.stem_height + p.body_height, p.body_width), inflation


def stick_kernel(grid: VoxelGrid, p: Preset) -> Kernel:
    """The stick that the preset describes, in cells of the grid; the body's width is the nearest odd number of them."""
    width = 2 * int((p.body_width / grid.edge - 1) / 2 + 0.5) + 1
    return stick(p.stem_height, width * grid.edge, p.body_height, grid.edge)


def _preset(preset: str | Preset, overrides: dict[str, Any]) -> Preset:
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise InputError(f"unknown preset {preset!r}: take one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    known = {f.name for f in fields(Preset)}
    for key in overrides:
        if key not in known:
            raise InputError(f"unknown parameter {key!r} of the extraction: it has {', '.join(sorted(known))}")
    return replace(preset, **overrides)


def _grid(source: Any, edge: float, known: dict[str, Any]) -> VoxelGrid:
    """The voxel grid; what a cloud knows beside its points goes into `known`."""
    if isinstance(source, VoxelGrid):
        return source
    if isinstance(source, np.ndarray):
        return voxelise(source, edge, known["warnings"])

    def chunks() -> Iterator[PointCloud]:
        for chunk in [source] if isinstance(source, PointCloud) else source:
            known["source"] = chunk.source
            known["free"] = chunk.free if chunk.free is not None else known.get("free")
            known["warnings"] += [w for w in chunk.warnings if w not in known["warnings"]]
            if chunk.poses is not None and chunk.pose_of is not None and len(chunk):
                rays.append(_rays(chunk))
            yield chunk

    rays: list[tuple[Array, Array]] = []
    grid = voxelise(chunks(), edge, known["warnings"])
    if rays:
        known["rays"] = tuple(np.concatenate(part) for part in zip(*rays, strict=True))
    return grid


def _rays(cloud: PointCloud) -> tuple[Array, Array]:
    """Places of the sensor and of what it saw, m: an even selection of the points whose pose is known."""
    assert cloud.poses is not None and cloud.pose_of is not None
    rows = np.arange(0, len(cloud), max(len(cloud) // MOST_RAYS, 1))
    rows = rows[cloud.pose_of[rows] >= 0]
    return cloud.poses[cloud.pose_of[rows], :3, 3], cloud.points[rows] + cloud.shift


class _Clock:
    """Seconds a step, and news of it."""

    def __init__(self, progress: Progress | None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress = progress

    def part(self, begin: float, end: float) -> Progress | None:
        """News of a step that takes the work from one share done to another."""
        if self.progress is None:
            return None
        whole = self.progress
        return lambda done, text: whole(begin + done * (end - begin), text)

    @contextmanager
    def __call__(self, step: str, done: float) -> Iterator[None]:
        if self.progress is not None:
            self.progress(done, step)
        began = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - began, 4)
