"""Scans against floor plans: the maps of cached pairs of grids (`grid_pairs`) and drawings, of what they show and of what not.

Each map gets a drawing of its own storey, and one that is not its own: of another building, another storey, or the twin wing. A
third of the drawings have no scale, as real ones do (`about`: ``scaled``). Buildings and frames are drawn again from the pairs'
own seeds, and checked against the cached truth.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.builder import BuildReport, BuildRow, BuildSettings, build_set, make_item
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.evaluation_pair import convert_to_sim3
from topomerge.datasets.pairs.example import build_candidate
from topomerge.datasets.pairs.flat_maps import extrude_flat
from topomerge.datasets.pairs.grid_pairs import (
    COLUMN_EDGE,
    GRID_FORMAT,
    LONGEST_GRID_PAIR,
    GridItem,
    GridPair,
    GridRecipe,
    build_grid,
    compute_seen_columns,
    draw_grid_items,
    load_grids,
    measure_outline_misfit,
    unpack_pair,
)
from topomerge.datasets.pairs.items import select_plans
from topomerge.datasets.pairs.pairs import choose_visited_places, draw_frames

from topomerge import archive
from topomerge.errors import InputError
from topomerge.types import Array, LogFn, Sim3

UNSCALED_EVERY = 3  # every third drawing has no scale
WALL_CELL = 0.1  # m
WALLS_APART = 0.3  # m between walls that differ
LOOKBACK = 3  # pairs before this one, the nearest of which that is of another building is drawn as a stranger
Plans = Sequence[tuple[object, ...]]


@dataclass(frozen=True, eq=False)
class MapOrigin:
    """Where a cached map was taken: building, frame (building -> map), storey, and the rooms that were visited."""

    name: str
    side: str
    building: Building
    frame: Sim3
    storey: int
    visited: Array


@dataclass(frozen=True)
class DrawingItem:
    """Everything that the bytes of one file depend on: the pair and those before it, whose map, and its own storey or not."""

    pair: GridItem
    before: tuple[GridItem, ...]
    side: str
    own: bool

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        inputs = ["drawings", GRID_FORMAT, self.pair.name, [b.name for b in self.before], self.side, self.own]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def build_drawings(
    recipe: GridRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None
) -> tuple[list[Path], BuildReport]:
    """Build the files of drawings of a set whose pairs were built (`grid_pairs.build_grids`), made where they are missing.

    Raises:
        InputError: more drawings than pairs.
    """
    if len(recipe.drawings) > len(recipe.sets) or any(d > s for d, s in zip(recipe.drawings, recipe.sets, strict=False)):
        raise InputError(f"data.drawings must be at most the pairs of each of data.sets, not {recipe.drawings}")
    items, plans = draw_grid_items(recipe)
    folder = Path(sharing.cache).resolve() / "grids"
    built = [item for item in items if (folder / f"{item.name}.npz").exists()]
    tasks = []
    for k, item in enumerate(built):
        if item.set < len(recipe.drawings) and item.number < recipe.drawings[item.set]:
            before = tuple(built[max(k - LOOKBACK, 0) : k][::-1])
            given = [list(select_plans(one.item, plans)) for one in (item, *before)]
            for side in "ab":
                tasks += [(DrawingItem(item, before, side, own), given, str(folder)) for own in (True, False)]
    report = build_set(
        folder.parent / f"{recipe.manifest}_drawings.jsonl", tasks, make_drawing, sharing, log_line, unit="drawings"
    )
    return [path for item, _, _ in tasks if (path := folder / f"{item.name}.npz").exists()], report


def make_drawing(item: DrawingItem, plans: Sequence[Plans], folder: str) -> BuildRow:
    """Make an item's file."""

    def make() -> dict[str, Array]:
        scanned, drawn, storey, kind = choose_drawn_place(item, plans, Path(folder))
        number = 4 * item.pair.number + 2 * "ab".index(item.side) + (not item.own)
        rng = np.random.default_rng([item.pair.set, number, 1])
        frame = draw_frames(2, number % UNSCALED_EVERY == 0, rng)[1]
        path = Path(folder) / f"{item.pair.name}.npz"
        return _add_common_area(build_drawing_arrays(path, scanned, drawn, storey, kind, frame, f"{item.name}.npz"), scanned)

    return make_item(item.name, folder, make, LONGEST_GRID_PAIR)


def choose_drawn_place(item: DrawingItem, plans: Sequence[Plans], folder: Path) -> tuple[MapOrigin, MapOrigin, int, str]:
    """Choose the map's place, the place that is drawn, its storey, and the kind of the pair.

    Raises:
        InputError: there is no such drawing.
    """
    places = find_places(load_grids(folder / f"{item.pair.name}.npz"), item.pair, plans[0])
    here = next((p for p in places if p.side == item.side), None)
    hard = item.pair.item.hard
    if here is None:
        raise InputError("the map is of several storeys, or the generator gives another pair by now")
    if item.own:
        if item.side == "b" and hard != "other-building" and len(places) > 1:
            raise InputError("the same storey was drawn for the other map")
        return here, here, here.storey, "overlap"
    if hard:
        drawn = next((p for p in places if p.side != item.side), here)
        return here, drawn, drawn.storey, hard
    if len(here.building.storeys) > 1:
        return here, here, 1 - min(here.storey, 1), "other-storey"
    for one, given in zip(item.before, plans[1:], strict=True):
        earlier = find_places(load_grids(folder / f"{one.name}.npz"), one, given)
        if earlier and earlier[-1].building.name != here.building.name:
            return here, earlier[-1], earlier[-1].storey, "other-building"
    raise InputError("no pair before it is of another building")


def find_places(pair: GridPair, item: GridItem, plans: Plans) -> list[MapOrigin]:
    """Find the places of both maps of a cached pair; maps of several storeys are left out. None where the generator gives another
    pair by now."""
    simulated = item.item
    for k in range(len(simulated.buildings)):
        try:
            building, other = build_candidate(simulated, k, plans)  # type: ignore[arg-type]
            rng = np.random.default_rng([simulated.seed, k])
            buildings, visited = choose_visited_places(building, simulated.pair_settings, other, rng)
        except InputError:
            continue
        frames = draw_frames(2, simulated.scale, rng)
        off = 0.0 if pair.truth is None else np.abs((frames[0] @ frames[1].inverse()).matrix - pair.truth.matrix).max()
        if building.name != pair.about["building"] or off > 1e-6:
            continue
        places = []
        for side, place, rooms, frame in zip("ab", buildings, visited, frames, strict=True):
            levels = {place.rooms[i].storey for i in rooms.tolist()}
            if len(levels) == 1:
                places.append(MapOrigin(pair.name, side, place, frame, levels.pop(), rooms))
        return places
    return []


def build_drawing_arrays(
    path: Path, here: MapOrigin, other: MapOrigin, storey: int, kind: str, frame: Sim3, file: str
) -> dict[str, Array]:
    """Build the cached arrays of a map of the pair at `path` and a drawing in `frame`: as `grid_pairs.build_pair_arrays`."""
    data = archive.read(path, "cached pair")
    about = json.loads(data["about"].tobytes())
    out = {f"a{key[1:]}": data[key] for key in data if key.startswith(f"{here.side}.")}
    flat = draw(other.building, storey).transform(replace(frame, translation=(*frame.translation[:2], 0.0)))
    floor = float(other.building.storeys["floor"][storey])
    grid = build_grid(extrude_flat(replace(flat, rooms=()), frame.translation[2] + frame.scale * floor))
    out |= {"b.cells": grid.cells.astype(np.int16), "b.origin": grid.origin, "b.shape": np.array(grid.shape)}
    out["b.mean"] = grid.properties["offset"]
    truth = here.frame @ frame.inverse() if kind in ("overlap", "other-storey") else None
    out["truth"] = np.full((4, 4), np.nan) if truth is None else truth.matrix
    sensor = about["sensors"]["ab".index(here.side)]
    names = [here.building.name] + [other.building.name] * (other.building.name != here.building.name)
    description = {"sensors": [sensor, "drawing"], "kind": kind, "building": " + ".join(names), "source": about["source"]}
    description |= {"overlap": float(kind == "overlap"), "scaled": frame.scale != 1.0, "common": 0.0}
    description |= measure_differences(here, other, storey) if kind in ("twin-wing", "other-storey") else {}
    out["about"] = np.frombuffer(json.dumps({**description, "file": file, "difficulty": about["difficulty"]}).encode(), np.uint8)
    return out


def measure_differences(here: MapOrigin, other: MapOrigin, storey: int) -> dict[str, float]:
    """Measure how two plans differ where the map was taken: twin wings by ``differs`` (m, as
    `grid_pairs.measure_wing_difference`), storeys by ``walls_differ`` (m2 of walls that only one of them has)."""
    if here.building is not other.building:
        outlines = [[p.building.rooms[i].polygon for i in here.visited.tolist()] for p in (here, other)]
        first = np.concatenate(outlines[0])
        return {"differs": min(measure_outline_misfit(first, np.concatenate([p[::k] for p in outlines[1]])) for k in (1, -1))}
    walls = [draw(here.building, k).walls for k in (here.storey, storey)]
    low = np.concatenate(walls).min(axis=0) - 1.0
    cells = [np.floor((w - low) / WALL_CELL).astype(int) for w in walls]
    shape = tuple(np.concatenate(cells).max(axis=0) + 10)
    image, seen = np.zeros((2, *shape), bool), np.zeros(shape, bool)
    for k in (0, 1):
        image[k][tuple(cells[k].T)] = True
    for i in here.visited.tolist():
        at = np.floor((here.building.rooms[i].polygon - low) / WALL_CELL).astype(int)
        seen[tuple(slice(max(a, 0), b) for a, b in zip(at.min(axis=0), at.max(axis=0), strict=True))] = True
    far = [ndimage.distance_transform_edt(~one) * WALL_CELL > WALLS_APART for one in image]
    return {"walls_differ": float(((image[0] & far[1]) | (image[1] & far[0]))[seen].sum() * WALL_CELL**2)}


def _add_common_area(arrays: dict[str, Array], here: MapOrigin) -> dict[str, Array]:
    """Add the area that the map saw of what is drawn."""
    about = json.loads(arrays["about"].tobytes())
    if about["kind"] == "overlap":
        pair = unpack_pair(here.name, arrays)
        floors = np.unique(np.round([r.floor + here.frame.translation[2] for r in here.building.rooms], 1))
        truth = convert_to_sim3(arrays["truth"])
        assert truth is not None
        both = np.intersect1d(
            compute_seen_columns(pair.a, pair.free[0], Sim3(), floors), compute_seen_columns(pair.b, None, truth, floors)
        )
        about["common"] = float(len(both) * COLUMN_EDGE**2)
    return {**arrays, "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)}
