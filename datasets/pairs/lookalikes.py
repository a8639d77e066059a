"""Look-alikes: pairs of maps of places that were made to be alike and must not be put together there (perceptual aliasing).

The files are those of `grid_pairs`, made by the builder (`core.builder`): the same item gives the same bytes, and what was killed
goes on where it was. Kinds and furniture are in `lookalike_places`; who could tell a pair apart, and by what, in
`lookalike_rule`.

What `about` tells beside the usual: ``lookalike`` (the kind), ``furniture``, ``tellable``, ``amount`` (what that stands on),
``repeats`` (a map shows the repetition by itself), ``alike`` (4 x 4, the false pose T_ab at which they differ least), ``scaled``
(the scale of b is unknown).

Maps that show places apart have no truth, and ``kind`` lookalike. Parts of a row that really overlap, by `LEAST_SHARED` or more,
have their true pose, and ``kind`` overlap: a pose there is right, and the wrong ones are off by whole rooms.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.builder import Report, Row, Say, Sharing, build_set, check_sharing, make_item
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.pairs.grid_pairs import GRID_FORMAT, LONGEST_GRID_PAIR, WEIGHTS, pair_arrays, unpacked
from topomerge.datasets.pairs.lookalike_places import FURNISHED, LOOKALIKES, Places, draw_places
from topomerge.datasets.pairs.lookalike_rule import Shown, judged_poses
from topomerge.datasets.pairs.pairs import Pair, draw_frames
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.session import session

from topomerge.errors import InputError
from topomerge.types import Array, Sim3, VoxelGrid

LOOKALIKE_FORMAT = 1  # raise it when the same item gives other bytes: it is part of the files' names
LEAST_SHARED = 1.0  # m2 of the same place that both maps show, from which on a pair has a truth
POINT_SPACING = 0.06  # m between points of a scan, at least: the grids' cells are 0.1 m
SENSORS_OF = {"storeys": {**WEIGHTS["sensors"], "laser2d": 4.0}}  # robots' grids are of storeys whose corridors have one plan
DAY = Difficulty(moved=0.03, gone=0.02, doors_moved=0.3, people=0.1)  # what a day changes
MONTHS = Difficulty(moved=0.15, gone=0.1, doors_moved=0.3, people=0.1)  # between two visits of one place
FURNITURE_SHARES = {
    "shifted-row": (0.5, 0.2, 0.15, 0.15),
    "hotel-corridors": (0.4, 0.35, 0.1, 0.15),
    "same-room": (0.05, 0.05, 0.75, 0.15),
    "mirror": (0.55, 0.05, 0.25, 0.15),
    "modules": (0.2, 0.15, 0.5, 0.15),
    "storeys": (0.0, 0.05, 0.8, 0.15),
    "point-symmetric": (0.0, 0.0, 0.85, 0.15),
}  # of `FURNISHED`


@dataclass
class LookalikeRecipe:
    """A set of look-alikes.

    Args:
        name: of the manifest.
        split: train, validation or test: from whose seeds the buildings come.
        pairs: of each kind of `lookalike_places.LOOKALIKES`.
        sensors: weight of each; empty: `grid_pairs.WEIGHTS`.
        scaled: share of the pairs whose second map has an unknown scale.
        again: of each kind, so many beside: the first one of the two places, visited a second time. They belong together; without
            them whatever is learned takes the look of these buildings for a sign of look-alikes.
        seed: of the draw of the set.
    """

    name: str = "lookalikes"
    split: str = "train"
    pairs: dict[str, int] = field(default_factory=dict)
    sensors: dict[str, float] = field(default_factory=dict)
    scaled: float = 0.1
    seed: int = 0
    again: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class LookalikeItem:
    """Everything that the bytes of one file depend on.

    Args:
        number: of the pair within its kind.
        seed: of the building, from the seeds of its split.
        furniture: one of `FURNISHED`.
        scaled: has b an unknown scale?
        again: are both maps of one place?
    """

    kind: str
    number: int
    seed: int
    furniture: str
    sensors: tuple[str, str]
    scaled: bool
    again: bool = False

    @property
    def name(self) -> str:
        """A hash of the inputs and of the versions of what is made from them."""
        values = list(vars(self).values())
        inputs = ["lookalikes", LOOKALIKE_FORMAT, GRID_FORMAT, *(values if self.again else values[:-1])]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]


def lookalike_items(recipe: LookalikeRecipe) -> list[LookalikeItem]:
    """The items of a set, kinds in turn; a longer set of a kind begins with the shorter one.

    Raises:
        InputError: an unknown kind, sensor or split, or numbers out of range.
    """
    for kind, count in (*recipe.pairs.items(), *recipe.again.items()):
        if kind not in LOOKALIKES or count < 0:
            raise InputError(f"data.pairs.{kind}: {count}: give a number of pairs of {', '.join(LOOKALIKES)}")
    if not any((*recipe.pairs.values(), *recipe.again.values())) or not 0 <= recipe.scaled <= 1:
        raise InputError("data.pairs: give pairs of a kind or more, and data.scaled from 0 to 1")
    first, last = splits.seeds(recipe.split)
    out = []
    both = ((recipe.pairs, False), (recipe.again, True))
    rows = [
        (n, k, again) for of, again in both for n in range(max(of.values(), default=0)) for k in LOOKALIKES if n < of.get(k, 0)
    ]
    for number, kind, again in rows:
        rng = np.random.default_rng([recipe.seed, LOOKALIKES.index(kind), number])
        sensors = dict(recipe.sensors or SENSORS_OF.get(kind, WEIGHTS["sensors"]))
        names = sorted(sensors)
        weights = np.array([sensors[get_sensor(name).name] for name in names])
        a, b = rng.choice(len(names), 2, p=weights / weights.sum()).tolist()
        furniture = str(rng.choice(FURNISHED, p=FURNITURE_SHARES[kind]))
        seed, scaled = int(rng.integers(first, last + 1)), bool(rng.random() < recipe.scaled)
        out.append(LookalikeItem(kind, number, seed, furniture, (names[a], names[b]), scaled, again))
    return out


def build_lookalikes(recipe: LookalikeRecipe, sharing: Sharing, say: Say = lambda text: None) -> tuple[list[Path], Report]:
    """The files of a set, made where they are missing, in the order of their items."""
    check_sharing(sharing)
    folder = Path(sharing.cache).resolve() / "grids"
    items = lookalike_items(recipe)
    begin, step = sharing.part
    tasks = [(item, None, str(folder)) for item in items[begin - 1 :: step]]
    report = build_set(folder.parent / f"{recipe.name}.jsonl", tasks, make_lookalike, sharing, say)
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def make_lookalike(item: LookalikeItem, given: None, folder: str) -> Row:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: lookalike_arrays(item), LONGEST_GRID_PAIR)


def lookalike_arrays(item: LookalikeItem) -> dict[str, Array]:
    """The arrays of a pair: places, two days, two scans, and who could tell."""
    places = draw_places(item.kind, item.furniture, item.seed)
    if item.again:
        first, rooms = places.buildings[0], places.visited[0]
        places = replace(places, buildings=(first, first), visited=(rooms, rooms), poses=(), same=True)
    rng = np.random.default_rng([item.seed, item.number, LOOKALIKES.index(item.kind)])
    frames = draw_frames(2, item.scaled, rng)
    days = [session(building, MONTHS if item.again else DAY, rng) for building in places.buildings]
    clouds = [
        scan(day, name, rooms, rng, max(get_sensor(name).spacing, POINT_SPACING), frame=frame)
        for day, name, rooms, frame in zip(days, item.sensors, places.visited, frames, strict=True)
    ]
    truth = frames[0] @ frames[1].inverse()
    kind = "overlap" if places.same else "other-building"
    pair = Pair(
        f"{item.kind}-{item.seed}", clouds[0], clouds[1], truth if places.same else None, (), 0.0, item.sensors, "procedural",
        f"{item.kind}-{item.seed}", kind,
    )  # fmt: skip
    arrays = pair_arrays(pair, {"source": "procedural", "set": LOOKALIKES.index(item.kind), "item": item.number})
    about = json.loads(arrays["about"].tobytes())
    grids = unpacked(item.name, arrays)
    seen = [seen_columns(g, f, frame.inverse()) for g, f, frame in zip((grids.a, grids.b), grids.free, frames, strict=True)]
    shown = [Shown(day, columns, name) for day, columns, name in zip(days, seen, item.sensors, strict=True)]
    about |= _who_tells(shown, places, frames) | _shared(about["common"], seen)
    if about["kind"] != "overlap":
        arrays["truth"] = np.full((4, 4), np.nan)
    about |= {"lookalike": item.kind, "furniture": item.furniture, "scaled": item.scaled, "file": f"{item.name}.npz"}
    arrays["about"] = np.frombuffer(json.dumps(about, sort_keys=True).encode(), np.uint8)
    return arrays


def seen_columns(grid: VoxelGrid, free: VoxelGrid | None, back: Sim3) -> Array:
    """(n, 2) columns of which a map knows anything, m, in the building's coordinates."""
    points = np.concatenate([grid.centroids(), *([free.centroids()] if free is not None else [])])
    return np.unique(np.round(back.apply(points)[:, :2], 1), axis=0)


def _who_tells(shown: list[Shown], places: Places, frames: list[Sim3]) -> dict[str, Any]:
    """Who could tell, by what, and where they are alike."""
    tellable, amount, pose = judged_poses(shown[0], shown[1], places.poses)
    alike = None if pose is None else (frames[0] @ pose @ frames[1].inverse()).matrix.round(6).tolist()
    return {"tellable": tellable, "amount": amount, "alike": alike, "repeats": places.repeats}


def _shared(common: float, seen: list[Array]) -> dict[str, Any]:
    """Kind of the pair, and the share of what both maps show of one place; hardly anything is nothing."""
    if common < LEAST_SHARED:
        return {"kind": "lookalike", "overlap": 0.0, "common": 0.0}
    mean = (len(seen[0]) + len(seen[1])) / 2 * 0.01
    return {"kind": "overlap", "overlap": round(min(common / mean, 1.0), 3)}
