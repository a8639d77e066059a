"""Scans against floor plans: pairs of the cached maps (``merge_pairs.py``) and drawings, made once and cached (resumable).

``python -m benchmarks.merging.drawings train 200`` takes the first maps of the training pairs and draws for each its own
storey and
one that is not its own: of another building, another storey, or the twin wing. They lie in ``cache/merge/<split>_drawings``. A
third of the drawings have no scale, as real ones do (`about`: ``scaled``). Buildings and frames are drawn again from the pairs'
own seeds, and checked against the cached truth. ``... train differs`` tells of twin wings how far they differ where both look.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.drawing import draw
from topomerge.datasets.pairs.example import candidate
from topomerge.datasets.pairs.flat import raise_flat
from topomerge.datasets.pairs.items import Item, plans_of
from topomerge.datasets.pairs.pairs import draw_frames, visited_places
from topomerge.datasets.pairs.recipe import Library

from benchmarks.merging.pairs import COMMON, ELSEWHERE, GridPair, _misfit, columns_seen, grid_of, items, load, sim3_of, unpacked
from topomerge.errors import InputError
from topomerge.io import archive
from topomerge.types import Array, Sim3

SETS = {"train": {0: 220, 1: 100, 2: 160}, "test": {0: 175, 2: 60}}  # split -> seed -> items, as they were made
FREE = 3  # every third drawing has no scale
CELL = 0.1  # m
APART = 0.3  # m between walls that differ


@dataclass(frozen=True, eq=False)
class Place:
    """Where a cached map was taken: building, frame (building -> map), storey, and the rooms that were visited."""

    name: str
    side: str
    building: Building
    frame: Sim3
    storey: int
    visited: Array


def places_of(pair: GridPair, item: Item, plans: Library) -> list[Place]:
    """Both maps of a cached pair; maps of several storeys are left out. None where the generator gives another pair by now."""
    storeys = plans_of(item, plans)
    for k in range(len(item.buildings)):
        try:
            building, other = candidate(item, k, storeys)
            rng = np.random.default_rng([item.seed, k])
            known = visited_places(building, item.pair_settings, other, rng)
        except InputError:
            continue
        frames = draw_frames(2, item.scale, rng)
        off = 0.0 if pair.truth is None else np.abs((frames[0] @ frames[1].inverse()).matrix - pair.truth.matrix).max()
        if building.name != pair.about["building"] or off > 1e-6:
            continue
        found = []
        for side, place, visited, frame in zip("ab", *known, frames, strict=True):
            level = {place.rooms[i].storey for i in visited.tolist()}
            if len(level) == 1:
                found.append(Place(pair.name, side, place, frame, level.pop(), visited))
        return found
    print(f"{pair.name}: the generator gives another pair", flush=True)
    return []


def drawings(split: str, many: int) -> Iterator[tuple[Place, Place, int, str]]:
    """Map, place that is drawn, its storey, and the kind of the pair; own ones and others by turns."""
    before: Place | None = None
    for seed, count in SETS[split].items():
        todo, plans = items(split, count, seed)
        paths = sorted((Path("cache/merge") / split).glob(f"{seed}_*.npz"))
        for path in paths[: round(many * count / sum(SETS[split].values()))]:
            item = todo[int(path.stem.split("_")[1])]
            found = places_of(load(path), item, plans)
            for k, here in enumerate(found):
                there = found[1 - k] if len(found) > 1 else here
                if k == 0 or item.hard == "other-building":
                    yield here, here, here.storey, "overlap"
                if item.hard:
                    yield here, there, there.storey, item.hard
                elif len(here.building.storeys) > 1:
                    yield here, here, 1 - min(here.storey, 1), "other-storey"
                elif before is not None and before.building.name != here.building.name:
                    yield here, before, before.storey, "other-building"
                before = here


def arrays_of(split: str, here: Place, there: Place, storey: int, kind: str, frame: Sim3) -> dict[str, Array]:
    """What is cached of a map and a drawing in `frame`: as `merge_pairs.arrays_of`."""
    data = archive.read(Path("cache/merge") / split / f"{here.name}.npz", "cached pair")
    about = json.loads(data["about"].tobytes())
    out = {f"a{key[1:]}": data[key] for key in data if key.startswith(f"{here.side}.")}
    flat = draw(there.building, storey).moved(replace(frame, translation=(*frame.translation[:2], 0.0)))
    floor = float(there.building.storeys["floor"][storey])
    grid = grid_of(raise_flat(replace(flat, rooms=()), frame.translation[2] + frame.scale * floor))
    offset = (grid.properties["mean"] - grid.cell_bounds(grid.cells)[0]) / grid.edge
    out |= {"b.cells": grid.cells.astype(np.int16), "b.origin": grid.origin, "b.shape": np.array(grid.shape)}
    out["b.mean"] = np.clip(offset * 256, 0, 255).astype(np.uint8)
    truth = here.frame @ frame.inverse() if kind in ("overlap", "other-storey") else None
    out["truth"] = np.full((4, 4), np.nan) if truth is None else truth.matrix
    sensor = about["sensors"]["ab".index(here.side)]
    names = [here.building.name] + [there.building.name] * (there.building.name != here.building.name)
    known = {"sensors": [sensor, "drawing"], "kind": kind, "building": " + ".join(names), "source": about["source"]}
    known |= {"overlap": float(kind == "overlap"), "scaled": frame.scale != 1.0, "common": 0.0}
    known |= differing(here, there, storey) if kind in ("twin-wing", "other-storey") else {}
    out["about"] = np.frombuffer(json.dumps({**known, "difficulty": about["difficulty"]}).encode(), np.uint8)
    return out


def differing(here: Place, there: Place, storey: int) -> dict[str, float]:
    """How far the two plans differ where the map was taken, as a drawing shows nothing else: twin wings by ``differs`` (m, as
    `merge_pairs.differs`), storeys by ``walls_differ`` (m2 of walls that only one of them has)."""
    if here.building is not there.building:
        outlines = [[p.building.rooms[i].polygon for i in here.visited.tolist()] for p in (here, there)]
        first = np.concatenate(outlines[0])
        return {"differs": min(_misfit(first, np.concatenate([p[::k] for p in outlines[1]])) for k in (1, -1))}
    walls = [draw(here.building, k).walls for k in (here.storey, storey)]
    low = np.concatenate(walls).min(axis=0) - 1.0
    cells = [np.floor((w - low) / CELL).astype(int) for w in walls]
    shape = tuple(np.concatenate(cells).max(axis=0) + 10)
    image, seen = np.zeros((2, *shape), bool), np.zeros(shape, bool)
    for k in (0, 1):
        image[k][tuple(cells[k].T)] = True
    for i in here.visited.tolist():
        at = np.floor((here.building.rooms[i].polygon - low) / CELL).astype(int)
        seen[tuple(slice(max(a, 0), b) for a, b in zip(at.min(axis=0), at.max(axis=0), strict=True))] = True
    far = [ndimage.distance_transform_edt(~one) * CELL > APART for one in image]
    return {"walls_differ": float(((image[0] & far[1]) | (image[1] & far[0]))[seen].sum() * CELL**2)}


def missing_differs(split: str) -> dict[str, float]:
    """Of the twin wings among the cached pairs of two scans that do not tell it: `merge_pairs.differs` by the rooms that both
    surveyors went into. Kept in ``cache/merge/differs_<split>.json``."""
    target = Path("cache/merge") / f"differs_{split}.json"
    found: dict[str, float] = json.loads(target.read_text()) if target.exists() else {}
    for seed, count in SETS[split].items():
        paths = [p for p in sorted((Path("cache/merge") / split).glob(f"{seed}_*.npz")) if p.stem not in found]
        todo, plans = items(split, count, seed) if paths else ([], {})
        for path in paths:
            item = todo[int(path.stem.split("_")[1])]
            if item.hard != "twin-wing":
                continue
            pair = load(path)
            places = places_of(pair, item, plans) if pair.about.get("differs") is None else []
            if len(places) == 2:
                both = replace(places[0], visited=np.intersect1d(places[0].visited, places[1].visited))
                found[path.stem] = differing(both, places[1], 0)["differs"] if len(both.visited) else ELSEWHERE
    target.write_text(json.dumps(found, indent=1))
    return found


def make(split: str, many: int) -> Iterator[Path]:
    """Make what is missing."""
    folder = Path("cache/merge") / f"{split}_drawings"
    folder.mkdir(parents=True, exist_ok=True)
    for k, (here, there, storey, kind) in enumerate(drawings(split, many)):
        path = folder / f"{here.name}{here.side}_{kind}.npz"
        if not path.exists():
            began = time.perf_counter()
            rng = np.random.default_rng([k, many])
            frame = draw_frames(2, k % FREE == 0, rng)[1]
            archive.write(_with_common(arrays_of(split, here, there, storey, kind, frame), here), path)
            print(f"{path.name} {time.perf_counter() - began:.1f} s", flush=True)
        yield path


def _with_common(arrays: dict[str, Array], here: Place) -> dict[str, Array]:
    """With the area that the map saw of what is drawn."""
    about = json.loads(arrays["about"].tobytes())
    if about["kind"] == "overlap":
        pair = unpacked(here.name, arrays)
        floors = np.unique(np.round([r.floor + here.frame.translation[2] for r in here.building.rooms], 1))
        truth = sim3_of(arrays["truth"])
        both = np.intersect1d(columns_seen(pair.a, pair.free[0], Sim3(), floors), columns_seen(pair.b, None, truth, floors))
        about["common"] = float(len(both) * COMMON**2)
    return {**arrays, "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)}


if __name__ == "__main__":
    if sys.argv[2] == "differs":
        print(missing_differs(sys.argv[1]))
    else:
        for _ in make(sys.argv[1], int(sys.argv[2])):
            pass
