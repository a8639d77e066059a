"""Maps that bend: every shared room of pairs whose drift is known, before bending and after.

``python evaluate.py task=bending data=test data.limit=40 write=docs/results/bending.md``; set ``validation`` to choose by. Both
maps are cells of 0.1 m; bending knows the sensors, and once more without (``unnamed``). Rows are kept when the code changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial import cKDTree

from topomerge.datasets.pairs.drifted_pairs import DriftedPair, iter_drifted_pairs
from topomerge.datasets.pairs.grid_pairs import GridPair
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.false_merges import get_physical_building
from topomerge.evaluation.merge_report import format_share
from topomerge.evaluation.tasks import Row, TaskSettings, describe_places, find_buildings, find_real_data, measure_missing
from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import Drift, get_sensor_drift
from topomerge.registration.pipeline import register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.statistics import FEWEST_GROUPS, OUTSIDE, format_interval
from topomerge.training.belief_hypotheses import compute_pose_error, is_hypothesis_right
from topomerge.types import Array, LogFn, Sim3

MATCHED = 0.75  # m between places of both maps that are compared
LEAST_COMMON = 2.0  # m2 of a room that both maps show
COLUMN = 0.5  # m, of the places
DRAWS = 400
ROOM_LIMITS = (0.1, 1.0)  # m, degrees


class Bending(Protocol):
    """A transform that moves the points of a map (`types.placement.Deformation`)."""

    def apply(self, points: Array) -> Array: ...


def measure_displacements(bent: DriftedPair, side: int, pose: Sim3, bending: Bending | None = None) -> tuple[Array, Array]:
    """Return places of a map in the building's frame (n, 3), and by how much (n, 3) m, in the frame of map a, they are laid
    beside it.

    Args:
        side: 0: map a, which stays where it is; 1: map b, laid by `pose`.
    """
    undrift, frames = bent.undrift[side], bent.frames
    true = frames[side].inverse().apply(undrift.places + undrift.shifts)
    placed = undrift.places if bending is None else bending.apply(undrift.places)
    return true, (placed if side == 0 else pose.apply(placed)) - frames[0].apply(true)


def measure_room_errors(
    bent: DriftedPair, pose: Sim3, bendings: Sequence[Bending | None] = (None, None)
) -> list[dict[str, float]]:
    """Measure, of each room that both surveyors were in, how far (m, horizontally) and by how many degrees b's lies off a's.

    The mean displacement and the turn that fits best, over the places of b that are near one of a in the same room; rooms of
    which both show less than `LEAST_COMMON` are left out.
    """
    (at_a, off_a), (at_b, off_b) = (measure_displacements(bent, side, pose, bendings[side]) for side in (0, 1))
    out = []
    for room in bent.shared.tolist():
        rows_a, rows_b = (np.flatnonzero(u.rooms == room) for u in bent.undrift)
        if not len(rows_a) or not len(rows_b):
            continue
        far, nearest = cKDTree(at_a[rows_a]).query(at_b[rows_b])
        rows_b, rows_a = rows_b[far <= MATCHED], rows_a[nearest[far <= MATCHED]]
        area = len(np.unique(np.floor(at_b[rows_b, :2] / COLUMN), axis=0)) * COLUMN**2
        if area >= LEAST_COMMON:
            shift, turn = fit_shift_and_turn(bent.frames[0].apply(at_b[rows_b])[:, :2], (off_b[rows_b] - off_a[rows_a])[:, :2])
            out.append({"room": room, "area": area, "shift": shift, "turn": turn})
    return out


def fit_shift_and_turn(points: Array, off: Array) -> tuple[float, float]:
    """Return the length of the mean (m), and turn (degrees) of the rigid move that explains displacements (n, 2) of points (n, 2)
    best."""
    mean = off.mean(axis=0)
    rel = (points - points.mean(axis=0)) @ (1, 1j)
    turned = rel + (off - mean) @ (1, 1j)
    return float(np.hypot(*mean)), float(np.degrees(abs(np.angle((np.conj(rel) * turned).sum()))))


def within(rooms: Sequence[dict[str, float]], limits: tuple[float, float] = ROOM_LIMITS) -> bool:
    """Return whether every room is within m and degrees."""
    return all(r["shift"] <= limits[0] and r["turn"] <= limits[1] for r in rooms)


def format_with_interval(statistic: Callable[[Array], float], groups: Sequence[str], digits: int) -> str:
    """Format a statistic of all rows with its 95 % interval by drawing whole groups (buildings) with
    replacement; without one where there are fewer than `FEWEST_GROUPS`.

    Args:
        statistic: of row numbers (n,), which may come more than once.
        groups: of each row.
    """
    names, owner = np.unique(np.asarray(groups), return_inverse=True)
    every = f"{statistic(np.arange(len(owner))):.{digits}f}"
    if len(names) < FEWEST_GROUPS:
        return every
    members, rng = [np.flatnonzero(owner == k) for k in range(len(names))], np.random.default_rng(0)
    drawn = [np.concatenate([members[k] for k in rng.integers(len(names), size=len(names))]) for _ in range(DRAWS)]
    low, high = np.nanquantile([statistic(rows) for rows in drawn], [OUTSIDE, 1 - OUTSIDE])
    return f"{every} [{low:.{digits}f}, {high:.{digits}f}]"


MAKERS = ("topomerge.registration.pipeline", "topomerge.registration.bend.bend", "topomerge.datasets.pairs.drifted_pairs")
BENT_PAIRS = 40  # if no limit is given
LARGE_COMMON = 80.0  # m2
SENSOR_CLASSES = ("tls", "lidar", "depth", "tablet", "laser2d", "drawing")
ROOM_HEADS = ("every room within 0.1 m, 1° %,", "median m,", "median °,")


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the pairs' recipe."""
    return [f"{settings.data.set or 'validation'} {settings.data.limit or BENT_PAIRS}"]


@lru_cache(maxsize=1)
def load_bent(split: str, pairs: int, cache: str) -> dict[str, DriftedPair]:
    """Load the pairs of a split, made where they are missing."""
    maker = iter_drifted_pairs(split, str(find_real_data()), pairs, Path(cache) / "bent", lambda text: None)
    return {bent.pair.name: bent for bent in maker}


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure the pairs that are missing."""
    split, pairs = settings.data.set or "validation", settings.data.limit or BENT_PAIRS
    names = [name for name in load_bent(split, pairs, settings.cache) if settings.data.only in name]
    items = {name: (name, split, pairs, settings.cache) for name in names}
    path = Path(settings.cache) / "evaluation" / f"bending_{split}.jsonl"
    return measure_missing(path, items, measure_pair, log_line, settings)


def measure_pair(name: str, split: str, pairs: int, cache: str) -> Row:
    """Measure a pair of a split."""
    return build_simulated_row(load_bent(split, pairs, cache)[name], split)


def prepare_pair(pair: GridPair) -> tuple[Prepared, Prepared]:
    """Return both maps as cells only."""
    a, b = (prepare(g, f) for g, f in zip((pair.a, pair.b), pair.free, strict=True))
    return a, b


def get_drift(pair: GridPair) -> tuple[Drift, Drift]:
    """Return the usual drift of both maps' sensors; one that is not listed is unknown."""
    names: Any = pair.about["sensors"]
    a, b = (get_sensor_drift("unknown" if name == "phone" else name) for name in names)
    return a, b


def build_simulated_row(bent: DriftedPair, split: str) -> Row:
    """Return the rooms of a pair under the pose of the rigid registration, and bent."""
    pair = bent.pair
    a, b = prepare_pair(pair)
    clock = [time.process_time()]
    pose = register(a, b).transform
    clock.append(time.process_time())
    about = {k: pair.about[k] for k in ("sensors", "factor", "overlap")}
    row: Row = {"name": pair.name, **about, **describe_places(find_buildings(pair, split)), "common": pair.common}
    row["err"] = None if pose is None else compute_pose_error(pose, pair)
    if pose is None:
        return {**row, "rooms": [], "seconds": {"register": clock[1] - clock[0]}}
    named = bend(a, b, pose, drift=get_drift(pair))
    clock.append(time.process_time())
    unnamed = bend(a, b, pose)
    row["rooms"] = measure_room_errors(bent, pose)
    for key, result in (("named", named), ("unnamed", unnamed)):
        row[key] = measure_room_errors(bent, result.transform, result.deformations)
        row[f"{key}_bend"] = {**result.features, "reason": result.reason}
    return {**row, "seconds": {"register": clock[1] - clock[0], "bend": clock[2] - clock[1]}}


def rooms(rows: Sequence[Row], key: str, value: str) -> tuple[list[float], list[str]]:
    """Return a value of every room, and the physical building of each."""
    pairs = [(r[value], get_physical_building(row)) for row in rows for r in row.get(key, ())]
    return [v for v, _ in pairs], [p for _, p in pairs]


def format_median(rows: Sequence[Row], key: str, value: str, digits: int) -> str:
    """Format the median over rooms."""
    values, groups = rooms(rows, key, value)
    return format_with_interval(lambda k: float(np.median(np.array(values)[k])), groups, digits) if values else "–"


def format_room_cells(rows: Sequence[Row], key: str = "named") -> list[object]:
    """Format the pairs, those whose rigid pose is wrong, shares with every shared room within the limits, and medians of rooms:
    each before and after bending."""
    rows = [r for r in rows if r["rooms"] or r["err"] is None]  # pairs without a room in common say nothing

    def all_right(name: str) -> Callable[[Row], bool]:
        return lambda r: bool(r["rooms"]) and within(r.get(name, [{"shift": np.inf, "turn": np.inf}]))

    shares = [format_share(rows, all_right(name)) if rows else "–" for name in ("rooms", key)]
    shifts = [format_median(rows, name, "shift", 3) for name in ("rooms", key)]
    turns = [format_median(rows, name, "turn", 2) for name in ("rooms", key)]
    wrong = sum(not is_hypothesis_right(r["err"], r["sensors"]) for r in rows)
    return [len(rows), wrong, *shares, *shifts, *turns]


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate the pairs with drift."""
    large = [r for r in rows if r["common"] >= LARGE_COMMON]
    heads = ("pairs", "pose wrong", *(f"{what} {when}" for what in ROOM_HEADS for when in ("rigid", "bent")))
    factors = sorted({r["factor"] for r in large})
    by_factor = [[f"{f:g}", *format_room_cells([r for r in large if r["factor"] == f])] for f in factors]
    unnamed = [[f"{f:g}", *format_room_cells([r for r in large if r["factor"] == f], "unnamed")] for f in factors]
    usual = [r for r in large if r["factor"] == 1.0]
    by_sensor = [[s, *format_room_cells([r for r in usual if s in r["sensors"]])] for s in SENSOR_CLASSES]
    parts = [
        f"{len(rows)} pairs.", write_table(("drift", *heads), by_factor),
        format_straight([r for r in rows if r["factor"] == 0.0]),
        "By sensor, at the usual drift:", write_table(("with", *heads), by_sensor),
        "Where bending does not know the sensors:", write_table(("drift", *heads), unnamed), seconds(rows),
    ]  # fmt: skip
    return {"bending": "\n\n".join(parts)}


def format_straight(rows: Sequence[Row]) -> str:
    """Tell how much worse pairs without drift become."""
    rows = [r for r in rows if r["rooms"] and r.get("named")]
    worse = [1000 * (np.mean([x["shift"] for x in r["named"]]) - np.mean([x["shift"] for x in r["rooms"]])) for r in rows]
    if not worse:
        return "No pair without drift was measured."
    mean = format_interval(np.array(worse), np.array([get_physical_building(r) for r in rows]), 1)
    many = format_share(rows, lambda r: bool(worse[rows.index(r)] > 1.0))
    return (
        f"Without drift: bending moves the rooms of a pair {mean} mm further from where they belong (mean of its rooms; below 0: "
        f"nearer), median {np.median(worse):.1f} mm; by more than 1 mm in {many} % of {len(rows)} pairs."
    )


def seconds(rows: Sequence[Row]) -> str:
    """Measure the time of bending over that of the rigid registration."""
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
    _, _, before, after, *_ = format_room_cells(usual)
    return {"bending-rooms": (f"{before} %; {after} %", f"{len(usual)} pairs")}
