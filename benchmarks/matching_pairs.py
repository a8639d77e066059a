"""Pairs of extracted maps with their truth, for `benchmarks/matching.py`: two .tmap and a .json a pair, made once and reused.

Run from the root: ``python benchmarks/matching_pairs.py FOLDER [pairs] [split]``. Pairs are drawn as those of `train_small`, with
overlaps of 25, 50 and 75 % and no hard negatives; TOPOMERGE_DATA adds real plans to the procedural buildings. What is there is
kept: take a new folder after the extraction changed.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.example import _first_pair, one_thread, time_limit
from topomerge.datasets.pairs import Pair
from topomerge.datasets.recipe import Item, Recipe, draw_items, library, plans_of
from topomerge.datasets.truth import room_truth, true_matches

import topomerge as tm
from topomerge.errors import InputError
from topomerge.types import Array, Sim3, TopometricMap, TrueRoom

KINDS = {"office": 3.0, "openplan": 1.0, "apartment": 2.0, "hotel": 2.0, "hospital": 2.0, "school": 2.0, "lab": 1.0, "house": 1.0}
SENSORS = {"tls": 3.0, "lidar": 2.0, "depth": 3.0, "tablet": 1.0}
TWIN_AREA, TWIN_SIDE = 0.05, 0.25  # share, m: rooms that differ by less are near-identical
LEAST_ROOMS = 2


@dataclass(frozen=True)
class MapPair:
    """Two extracted maps; `matches` (M, 2) of extracted rooms; `twin` (R_a,): another room of b looks the same."""

    name: str
    a: TopometricMap
    b: TopometricMap
    matches: Array
    true_a: Array  # true room of each extracted room, -1 none
    true_b: Array
    one_a: Array  # is it the one that is assigned to the true room?
    one_b: Array
    twin: Array
    transform: Sim3
    about: dict[str, Any]


def recipe_of(split: str, pairs: int) -> Recipe:
    """What is drawn."""
    data = os.environ.get("TOPOMERGE_DATA", "")
    sources = {"procedural": 0.65, "r2v": 0.1, "campus": 0.25} if data else {"procedural": 1.0}
    return Recipe("matching", split, pairs, 0, data, sources, KINDS, [0.25, 0.5, 0.75], SENSORS, [6, 15], 0.15)


def make(folder: Path, pairs: int, split: str) -> None:
    """Make what is not there yet; what can't be made is named and leaves an empty .json."""
    folder.mkdir(parents=True, exist_ok=True)
    recipe = recipe_of(split, pairs)
    plans = library(recipe)
    for number, item in enumerate(draw_items(recipe, plans)):
        stem = folder / f"{number:04d}"
        if stem.with_suffix(".json").exists():
            continue
        try:
            with one_thread(), time_limit(600):
                about = _make_one(item, list(plans_of(item, plans)), stem)
        except InputError as error:
            about = {"refused": str(error)}
        stem.with_suffix(".json").write_text(json.dumps(about), encoding="utf-8")
        print(number, about.get("building", about.get("refused")), flush=True)


def _make_one(item: Item, plans: list[Any], stem: Path) -> dict[str, Any]:
    pair: Pair = _first_pair(item, plans)
    maps = [tm.extract(cloud, voxel_size=item.voxel_size) for cloud in (pair.a, pair.b)]
    if min(len(m.rooms) for m in maps) < LEAST_ROOMS:
        raise InputError("fewer than two rooms came out of a map")
    truths = [room_truth(m, cloud) for m, cloud in zip(maps, (pair.a, pair.b), strict=True)]
    matches = true_matches(truths[0], truths[1], pair.shared)
    for side, found in zip("ab", maps, strict=True):
        tm.save_map(found, stem.with_name(f"{stem.name}{side}.tmap"))
    assert pair.truth is not None
    return {
        "name": pair.name,
        "building": f"{pair.source}/{pair.building}",
        "sensors": pair.sensors,
        "overlap": pair.overlap,
        "matches": matches.tolist(),
        "true": [t["room"].tolist() for t in truths],
        "one": [t["one"].tolist() for t in truths],
        "twin": twins(truths[0]["room"], truths[1]["room"], pair.a.rooms, pair.b.rooms).tolist(),
        "transform": [pair.truth.yaw, *pair.truth.translation, pair.truth.scale],
    }


def twins(true_a: Array, true_b: Array, rooms_a: tuple[TrueRoom, ...], rooms_b: tuple[TrueRoom, ...]) -> Array:
    """(R_a,) bool: does b hold a room, another than the true partner, whose plan has the same area and sides?"""
    of_a, of_b = (np.array([_plan(room) for room in rooms]) for rooms in (rooms_a, rooms_b))
    out = np.zeros(len(true_a), bool)
    for i in np.flatnonzero(true_a >= 0):
        mine = of_a[true_a[i]]
        others = of_b[[t for t in set(true_b.tolist()) if t >= 0 and t != true_a[i]]].reshape(-1, 3)
        alike = (abs(others[:, 0] / mine[0] - 1) < TWIN_AREA) & (abs(others[:, 1:] - mine[1:]) < TWIN_SIDE).all(axis=1)
        out[i] = alike.any()
    return out


def _plan(room: TrueRoom) -> tuple[float, float, float]:
    """Area, m2, and sides of the smallest rectangle about it, m."""
    shape = shapely.Polygon(room.polygon)
    corners = np.array(shapely.minimum_rotated_rectangle(shape).exterior.coords)
    sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
    return float(shape.area), float(sides.min()), float(sides.max())


def load(folder: Path) -> list[MapPair]:
    """All pairs of a folder that have at least one true match."""
    found = []
    for path in sorted(folder.glob("*.json")):
        about = json.loads(path.read_text(encoding="utf-8"))
        if not about.get("matches"):
            continue
        a, b = (tm.load_map(path.with_name(f"{path.stem}{side}.tmap")) for side in "ab")
        true_a, true_b, one_a, one_b = (np.array(x) for x in (*about["true"], *about["one"]))
        yaw, x, y, z, scale = about["transform"]
        matches, twin = np.array(about["matches"], np.int64), np.array(about["twin"], bool)
        where = Sim3(yaw, (x, y, z), scale)
        found.append(MapPair(about["name"], a, b, matches, true_a, true_b, one_a, one_b, twin, where, about))
    return found


if __name__ == "__main__":
    make(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 100, sys.argv[3] if len(sys.argv) > 3 else "train")
