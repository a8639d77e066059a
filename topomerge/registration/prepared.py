"""A map prepared for registration and bending: each part is made when it is first needed and once only."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from topomerge.extraction.cleaning import compute_cell_means
from topomerge.matching.poses import PlanFields
from topomerge.registration.bend.measure import Target, WallLines, build_wall_lines, sample_walls
from topomerge.registration.bend.pieces import Pieces, build_pieces, detect_sensor
from topomerge.registration.refine import Surface, build_surface
from topomerge.registration.storeys import build_plans
from topomerge.types import Array, TopometricMap, VoxelGrid

Map = TopometricMap | VoxelGrid
SENT_COLUMNS = 8_000_000  # of the plans of a map: more are drawn where they are needed, and not sent from process to process
BENDING_PARTS = ("pieces", "samples", "lines", "targets")
RASTERS = ("kind", "to_wall", "field", "to_any", "core", "face", "walls", "directions", "tall", "hung", "profile")
UNBENT = ("drawing", "raised")  # sensors whose maps mostly stay as they are


@dataclass(frozen=True, eq=False)
class Prepared:
    """A prepared map; the map itself may be loaded again when it is needed.

    Args:
        load: gives the map, topometric or occupied cells.
        storeys: their plans, lowest first.
        order: larger maps come first; among equal ones the order is arbitrary, but always the same.
        middle: (3,) of its cells, m.
        sensor: what it was measured by, as far as one can say.
        make_surface: its points and normals, for the fine registration.
        has_landmarks: does the map hold any?
    """

    load: Callable[[], Map]
    storeys: tuple[PlanFields, ...]
    order: tuple[int, str]
    middle: Array
    sensor: str
    make_surface: Callable[[], Surface]
    has_landmarks: bool = False

    @property
    def surface(self) -> Surface:
        """Its points and normals."""
        return self.make_surface()

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces that it is bent by."""
        map = self.load()
        return build_pieces(self.storeys, map if isinstance(map, TopometricMap) else None)

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """The walls by which each piece is registered."""
        return sample_walls(self.pieces)

    @cached_property
    def lines(self) -> tuple[WallLines, ...]:
        """The walls of each storey as lines."""
        middles = compute_cell_means(get_grid(self.load()))
        return tuple(build_wall_lines(s, middles) for s in self.storeys)

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        """The storeys, for pieces of other maps to be registered on."""
        return tuple(Target(s) for s in self.storeys)

    def complete(self) -> Prepared:
        """Draw what nearly every registration needs, and return the same object: in another process or thread, that is done for
        both maps at once."""
        for fields in self.storeys:
            for name in RASTERS if len(fields.walls) else ():
                getattr(fields, name)
        if self.sensor not in UNBENT and len(self.pieces):
            for name in BENDING_PARTS:
                getattr(self, name)
        if not any(fields.plan.sliced for fields in self.storeys):  # a slice has no planes
            self.make_surface()
        return self

    def pack(self) -> dict[str, Any] | None:
        """Return all that was drawn by `complete` without the map, as it is sent to another process; None of plans that are too
        large for that."""
        if sum(fields.plan.wall.size for fields in self.storeys) > SENT_COLUMNS:
            return None
        # Drawn beside the cloud's extraction, in its process: after it one process would work alone (docs/adr/0050).
        known = {name: value for name, value in vars(self.complete()).items() if name not in ("load", "make_surface")}
        sliced = any(fields.plan.sliced for fields in self.storeys)
        return {**known, "surface": None if sliced else self.make_surface()}


def unpack_prepared(parts: Mapping[str, Any], map: Map) -> Prepared:
    """Return what `Prepared.pack` sent, with the map it was drawn from."""
    surface, grid = parts["surface"], get_grid(map)
    make_surface = cache(lambda: build_surface(grid) if surface is None else surface)
    names = ("storeys", "order", "middle", "sensor", "has_landmarks")
    prepared = Prepared(load=lambda: map, make_surface=make_surface, **{name: parts[name] for name in names})
    vars(prepared).update((name, parts[name]) for name in BENDING_PARTS if name in parts)
    return prepared


def prepare(map: Map, free: VoxelGrid | None = None) -> Prepared:
    """Prepare the plans of a map, with what is drawn from them when it is first needed.

    Args:
        free: cells known to be empty; a topometric map brings its own.

    Raises:
        InputError: an empty map.
    """
    storeys = tuple(PlanFields(p) for p in build_plans(map, free))
    grid = get_grid(map)
    make_surface = cache(lambda: build_surface(grid))
    return Prepared(
        lambda: map,
        storeys,
        compute_registration_order(map),
        compute_cell_means(grid).mean(axis=0),
        detect_sensor(map),
        make_surface,
        isinstance(map, TopometricMap) and len(map.landmarks) > 0,
    )


def get_grid(map: Map) -> VoxelGrid:
    """Return the occupied cells of a map."""
    return map.grid if isinstance(map, TopometricMap) else map


def compute_registration_order(map: Map) -> tuple[int, str]:
    """Compute the key of an order in which larger maps come first; among equal ones it is arbitrary, but always the same."""
    grid = get_grid(map)
    digest = hashlib.sha256(np.ascontiguousarray(grid.cells).tobytes() + grid.origin.tobytes()).hexdigest()
    return -len(grid), digest
