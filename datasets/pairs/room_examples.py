"""Rooms of simulated scans with what is true about them: what the odds of rooms are fitted to (`extraction.room_odds`).

The scans are drawn as those of `plan_examples` are (`scan_items`). Each is extracted with the sensor's places and as if they were
unknown. Scans of buildings with their surroundings (`open_scans`) are extracted without the places only. A file holds the rooms
of one scan.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import Row, Say, Sharing, make_item
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.open_scans import open_scan
from topomerge.datasets.pairs.plan_examples import LONGEST_SCAN, VOXEL_SIZES, PlanRecipe, build_scans
from topomerge.datasets.pairs.scan_items import PlanItem, Plans, draw_item, scan_of_item
from topomerge.datasets.simulation.floor_truth import in_frame, truth_of
from topomerge.datasets.simulation.room_truth import room_truth
from topomerge.datasets.simulation.scanner import moved

from topomerge.extraction.extract import extract
from topomerge.extraction.room_odds import GRID_FEATURES, POSE_FEATURES, ROOM_FEATURES, pose_features, room_features
from topomerge.extraction.scan import read_scan
from topomerge.io import archive
from topomerge.types import Array

ROOM_EXAMPLE_FORMAT = 5  # raise it when the same item gives other bytes: it is part of the files' names
ANSWERS = ("one", "whole", "entered", "outside")


@dataclass(frozen=True)
class RoomItem(PlanItem):
    """As of plans, and does the building stand in the open? What is made of it has a version of its own."""

    surroundings: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return self.named(ROOM_EXAMPLE_FORMAT)


def build_rooms(recipe: PlanRecipe, sharing: Sharing, say: Say = lambda text: None) -> list[Path]:
    """The files of a set, made where they are missing, in the order of the seeds."""
    draw = partial(draw_room_item, flat=recipe.flat, surroundings=recipe.surroundings)
    return build_scans(recipe, "rooms", draw, make_room_file, sharing, say)[0]


def draw_room_item(seed: int, plans: Plans, flat: bool = False, surroundings: bool = False) -> RoomItem:
    """The item of a seed: that of `scan_items`."""
    return RoomItem(**asdict(draw_item(seed, plans, flat)), surroundings=surroundings)


def make_room_file(item: RoomItem, plan: Plan | None, folder: str) -> Row:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: room_rows(item, plan), LONGEST_SCAN)


def room_rows(item: RoomItem, plan: Plan | None) -> Mapping[str, Array]:
    """Features and answers of the rooms of a scan: `x` and answers without poses; `posed.x`, `posed.p` and answers with them. `x`
    are `GRID_FEATURES` of robots' grids of buildings that stand in the open."""
    made = open_scan(item, plan) if item.surroundings else scan_of_item(item, plan)
    features = GRID_FEATURES if item.surroundings and item.flat else ROOM_FEATURES
    visited = np.isin(np.arange(len(made.building.rooms)), made.visited)
    anchors, drift = made.shift or (None, None)
    points = made.cloud.points.astype(np.float64) + made.cloud.shift
    truth = in_frame(truth_of(made.building, visited, points, anchors, drift), made.frame)
    cloud, voxel = moved(made.cloud, made.frame), VOXEL_SIZES[item.seed % len(VOXEL_SIZES)]
    arrays: dict[str, Array] = {}
    for prefix, source in (("", replace(cloud, poses=None, pose_of=None)), ("posed.", cloud)):
        if prefix and (source.poses is None or item.surroundings):
            continue
        map = extract(source, voxel_size=voxel, carve=False)
        answers = room_truth(map, truth, made.building.rooms)
        rows = answers.judged
        arrays |= {f"{prefix}{name}": getattr(answers, name)[rows] for name in ANSWERS}
        arrays[f"{prefix}x"] = room_features(map, features)[rows]
        if prefix:
            poses = pose_features(map, read_scan(cloud, voxel).rays)
            arrays["posed.p"] = (np.full((len(rows), len(POSE_FEATURES)), np.nan) if poses is None else poses)[rows]
    about = {"file": f"{item.name}.npz", **asdict(item), "sensor": made.sensor}
    return {**arrays, "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)}


def read_room_rows(path: Path) -> dict[str, Array]:
    """The arrays of a file, and its sensor.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached rooms")
    arrays["sensor"] = np.array(json.loads(arrays.pop("about").tobytes())["sensor"])
    return arrays
