"""Maps that bend: every shared room of pairs whose drift is known, before bending and after.

``python evaluate.py task=bending data=test data.limit=40 write=docs/results/bending.md``; set ``validation`` to choose by. Both
maps are cells of 0.1 m; bending knows the sensors, and once more without (``unnamed``). Rows are kept when the code changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.pairs.bent_pairs import BentPair, bent_pairs
from topomerge.datasets.pairs.grid_pairs import GridPair
from topomerge.evaluation.bending_measures import room_errors, with_interval, within
from topomerge.evaluation.false_merges import physical_of
from topomerge.evaluation.grid_pairs import buildings_of, places_of
from topomerge.evaluation.markdown import write_table
from topomerge.evaluation.merge_report import share
from topomerge.evaluation.tasks import Row, Say, TaskSettings, find_real_data, measure_missing
from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import Drift, sensor_drift
from topomerge.registration.pipeline import register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.statistics import interval_text
from topomerge.training.belief_hypotheses import error, right

MAKERS = ("topomerge.registration.pipeline", "topomerge.registration.bend.bend", "topomerge.datasets.pairs.bent_pairs")
BENT_PAIRS = 40  # if no limit is given
LARGE_COMMON = 80.0  # m2
SENSOR_CLASSES = ("tls", "lidar", "depth", "tablet", "laser2d", "drawing")
ROOM_HEADS = ("every room within 0.1 m, 1° %,", "median m,", "median °,")


@dataclass
class Settings(TaskSettings):
    """Settings of the task."""


def list_inputs(settings: TaskSettings) -> list[str]:
    """Names of the pairs' recipe."""
    return [f"{settings.data.set or 'validation'} {settings.data.limit or BENT_PAIRS}"]


@lru_cache(maxsize=1)
def load_bent(split: str, pairs: int, cache: str) -> dict[str, BentPair]:
    """Load the pairs of a split, made where they are missing."""
    made = bent_pairs(split, str(find_real_data()), pairs, Path(cache) / "bent", lambda text: None)
    return {bent.pair.name: bent for bent in made}


def measure(settings: TaskSettings, say: Say) -> list[Row]:
    """Measure the pairs that are missing."""
    split, pairs = settings.data.set or "validation", settings.data.limit or BENT_PAIRS
    names = [name for name in load_bent(split, pairs, settings.cache) if settings.data.only in name]
    items = {name: (name, split, pairs, settings.cache) for name in names}
    path = Path(settings.cache) / "evaluation" / f"bending_{split}.jsonl"
    return measure_missing(path, items, measure_pair, say, settings)


def measure_pair(name: str, split: str, pairs: int, cache: str) -> Row:
    """Measure a pair of a split."""
    return simulated_row(load_bent(split, pairs, cache)[name], split)


def prepared(pair: GridPair) -> tuple[Prepared, Prepared]:
    """Both maps as cells only."""
    a, b = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    return a, b


def drift_of(pair: GridPair) -> tuple[Drift, Drift]:
    """The usual drift of both maps' sensors; one that is not listed is unknown."""
    names: Any = pair.about["sensors"]
    a, b = (sensor_drift("unknown" if name == "phone" else name) for name in names)
    return a, b


def simulated_row(bent: BentPair, split: str) -> Row:
    """The rooms of a pair under the pose of the rigid registration, and bent."""
    pair = bent.pair
    a, b = prepared(pair)
    clock = [time.process_time()]
    pose = register(a, b).transform
    clock.append(time.process_time())
    about = {k: pair.about[k] for k in ("sensors", "factor", "overlap")}
    row: Row = {"name": pair.name, **about, **places_of(buildings_of(pair, split)), "common": pair.common}
    row["err"] = None if pose is None else error(pose, pair)
    if pose is None:
        return {**row, "rooms": [], "seconds": {"register": clock[1] - clock[0]}}
    named = bend(a, b, pose, drift=drift_of(pair))
    clock.append(time.process_time())
    unnamed = bend(a, b, pose)
    row["rooms"] = room_errors(bent, pose)
    for key, result in (("named", named), ("unnamed", unnamed)):
        row[key] = room_errors(bent, result.transform, result.deformations)
        row[f"{key}_bend"] = {**result.features, "reason": result.reason}
    return {**row, "seconds": {"register": clock[1] - clock[0], "bend": clock[2] - clock[1]}}


def rooms(rows: Sequence[Row], key: str, value: str) -> tuple[list[float], list[str]]:
    """A value of every room, and the physical building of each."""
    pairs = [(r[value], physical_of(row)) for row in rows for r in row.get(key, ())]
    return [v for v, _ in pairs], [p for _, p in pairs]


def median_of(rows: Sequence[Row], key: str, value: str, digits: int) -> str:
    """Median over rooms."""
    values, groups = rooms(rows, key, value)
    return with_interval(lambda k: float(np.median(np.array(values)[k])), groups, digits) if values else "–"


def of_rooms(rows: Sequence[Row], key: str = "named") -> list[object]:
    """Pairs, those whose rigid pose is wrong, shares with every shared room within the limits, and medians of rooms: each before
    and after bending."""
    rows = [r for r in rows if r["rooms"] or r["err"] is None]  # pairs without a room in common say nothing

    def all_right(name: str) -> Callable[[Row], bool]:
        return lambda r: bool(r["rooms"]) and within(r.get(name, [{"shift": np.inf, "turn": np.inf}]))

    shares = [share(rows, all_right(name)) if rows else "–" for name in ("rooms", key)]
    shifts = [median_of(rows, name, "shift", 3) for name in ("rooms", key)]
    turns = [median_of(rows, name, "turn", 2) for name in ("rooms", key)]
    wrong = sum(not right(r["err"], r["sensors"]) for r in rows)
    return [len(rows), wrong, *shares, *shifts, *turns]


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate the pairs with drift."""
    large = [r for r in rows if r["common"] >= LARGE_COMMON]
    heads = ("pairs", "pose wrong", *(f"{what} {when}" for what in ROOM_HEADS for when in ("rigid", "bent")))
    factors = sorted({r["factor"] for r in large})
    by_factor = [[f"{f:g}", *of_rooms([r for r in large if r["factor"] == f])] for f in factors]
    unnamed = [[f"{f:g}", *of_rooms([r for r in large if r["factor"] == f], "unnamed")] for f in factors]
    usual = [r for r in large if r["factor"] == 1.0]
    by_sensor = [[s, *of_rooms([r for r in usual if s in r["sensors"]])] for s in SENSOR_CLASSES]
    parts = [
        f"{len(rows)} pairs.", write_table(("drift", *heads), by_factor), straight([r for r in rows if r["factor"] == 0.0]),
        "By sensor, at the usual drift:", write_table(("with", *heads), by_sensor),
        "Where bending does not know the sensors:", write_table(("drift", *heads), unnamed), seconds(rows),
    ]  # fmt: skip
    return {"bending": "\n\n".join(parts)}


def straight(rows: Sequence[Row]) -> str:
    """How much worse pairs without drift become."""
    rows = [r for r in rows if r["rooms"] and r.get("named")]
    worse = [1000 * (np.mean([x["shift"] for x in r["named"]]) - np.mean([x["shift"] for x in r["rooms"]])) for r in rows]
    if not worse:
        return "No pair without drift was measured."
    mean = interval_text(np.array(worse), np.array([physical_of(r) for r in rows]), 1)
    many = share(rows, lambda r: bool(worse[rows.index(r)] > 1.0))
    return (
        f"Without drift: bending moves the rooms of a pair {mean} mm further from where they belong (mean of its rooms; below 0: "
        f"nearer), median {np.median(worse):.1f} mm; by more than 1 mm in {many} % of {len(rows)} pairs."
    )


def seconds(rows: Sequence[Row]) -> str:
    """Time of bending over that of the rigid registration."""
    times = [r["seconds"] for r in rows if "bend" in r["seconds"]]
    if not times:
        return ""
    ratio = np.median([t["bend"] / t["register"] for t in times])
    middle = [np.median([t[k] for t in times]) for k in ("register", "bend")]
    return f"Seconds of processor, median: rigid registration {middle[0]:.2f}, bending {middle[1]:.2f} ({ratio:.2f} of it)."


def compute_headline(rows: Sequence[Row], settings: TaskSettings) -> dict[str, tuple[str, str]]:
    """Compute the share of pairs at the usual drift with every shared room within 0.1 m and 1 degree, before and after."""
    usual = [r for r in rows if r["factor"] == 1.0 and r["common"] >= LARGE_COMMON]
    if not usual:
        return {}
    _, _, before, after, *_ = of_rooms(usual)
    return {"bending-rooms": (f"{before} %; {after} %", f"{len(usual)} pairs")}
