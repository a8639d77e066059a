"""Tables of docs/results/bending.md, from the rows that `bending` measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.merging import bending_text as text
from benchmarks.merging.bending_measures import area_under_curve, recall_at, with_interval, within
from benchmarks.merging.tables import physical_of, put, rows_of, share, table
from topomerge.statistics import interval_text
from topomerge.training.belief_hypotheses import right
from topomerge.types import Array

Row = dict[str, Any]
LARGE_COMMON = 80.0  # m2
AIM_CONFLICT = 0.12  # share of walls on free floor
FALSE_RATES = (0.01, 0.05)
SENSOR_CLASSES = ("tls", "lidar", "depth", "tablet", "laser2d", "drawing")


def rooms(rows: Sequence[Row], key: str, value: str) -> tuple[list[float], list[str]]:
    """A value of every room, and the physical building of each."""
    pairs = [(r[value], physical_of(row)) for row in rows for r in row.get(key, ())]
    return [v for v, _ in pairs], [p for _, p in pairs]


def median_of(rows: Sequence[Row], key: str, value: str, digits: int) -> str:
    """Median over rooms."""
    values, groups = rooms(rows, key, value)
    return with_interval(lambda k: float(np.median(np.array(values)[k])), groups, digits) if values else "–"


def area_of(high: Sequence[float], low: Sequence[float], groups: Sequence[str]) -> str:
    """Area under the curve, with its interval.

    Args:
        groups: buildings of the right poses, then of the wrong ones.
    """
    both = np.array([*high, *low])

    def area(k: Array) -> float:
        some, other = both[k[k < len(high)]], both[k[k >= len(high)]]
        return area_under_curve(some, other) if len(some) and len(other) else float("nan")

    return with_interval(area, groups, 3)


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


def simulated(rows: Sequence[Row]) -> str:
    """Tables of the pairs with drift."""
    large = [r for r in rows if r["common"] >= LARGE_COMMON]
    heads = ("pairs", "pose wrong", *(f"{what} {when}" for what in text.ROOM_HEADS for when in ("rigid", "bent")))
    factors = sorted({r["factor"] for r in large})
    by_factor = [[f"{f:g}", *of_rooms([r for r in large if r["factor"] == f])] for f in factors]
    unnamed = [[f"{f:g}", *of_rooms([r for r in large if r["factor"] == f], "unnamed")] for f in factors]
    usual = [r for r in large if r["factor"] == 1.0]
    by_sensor = [[s, *of_rooms([r for r in usual if s in r["sensors"]])] for s in SENSOR_CLASSES]
    parts = [
        text.SIMULATED, table(("drift", *heads), by_factor), straight([r for r in rows if r["factor"] == 0.0]), text.BY_SENSOR,
        table(("with", *heads), by_sensor), text.UNNAMED, table(("drift", *heads), unnamed), seconds(rows),
    ]  # fmt: skip
    return "\n\n".join(parts)


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


def office(rows: Sequence[Row]) -> str:
    """The office floor to choose by."""
    good = [r for r in rows if r["right"]]
    if not good:
        return "The office floor was not measured."
    lines = []
    for title, few in (("captures", [r for r in good if "drawing" not in r["sensors"]]),
                       ("with the drawing", [r for r in good if "drawing" in r["sensors"]]), ("all", good)):  # fmt: skip
        if not few:
            continue
        shares = [np.array([r[k]["conflict_share"] for r in few]) for k in ("rigid", "bent")]
        points = [np.median(np.concatenate([r["key_points"][k] for r in few])) for k in (0, 1)]
        cells = [f"{np.median(s):.3f}" for s in shares] + [f"{100 * np.mean(s < AIM_CONFLICT):.0f}" for s in shares]
        lines.append([title, len(few), *cells, *(f"{p:.2f}" for p in points)])
    said = f"Of {len(rows)} pairs the best rigid pose is right (0.5 m, 5°) in {len(good)}."
    return "\n\n".join([text.OFFICE, said, table(text.OFFICE_HEADS, lines), seconds(good)])


def told_apart(rows: Sequence[Row]) -> str:
    """Right and wrong poses, by conflict alone and by all that is counted."""
    kinds = {"simulated": lambda r: r["source"] != "halmstad", "office floor": lambda r: r["source"] == "halmstad"}
    lines = []
    for title, belongs in kinds.items():
        poses = [(p, r) for r in rows if belongs(r) for p in r["poses"]]
        yes, no = ([p for p, _ in poses if p["label"] == label] for label in ("right", "wrong"))
        groups = [physical_of(r) for label in ("right", "wrong") for p, r in poses if p["label"] == label]
        if not yes or not no:
            continue
        for way, sign in (("drawn", -1.0), ("score", 1.0)):
            for how in ("rigid", "bent"):
                high, low = ([sign * p[how][way] for p in some] for some in (yes, no))
                recall = [f"{100 * recall_at(high, low, f):.0f}" for f in FALSE_RATES]
                lines.append([title, text.WAYS[way], how, len(yes), len(no), area_of(high, low, groups), *recall])
    return "\n\n".join(
        [text.APART, table((*text.APART_HEADS, *(f"recall at {100 * f:.0f} % false" for f in FALSE_RATES)), lines)]
    )


def growth(rows: Sequence[Row]) -> str:
    """Time over the number of rooms."""
    lines = []
    for r in sorted(rows, key=lambda r: r["rooms"]):
        s = r["seconds"]
        rigid = f"{s['register']:.1f}" if s["register"] > 0.05 else "–"
        lines.append([r["rooms"], sum(r["pieces"]), f"{s['prepare']:.1f}", rigid, f"{s['bend']:.1f}"])
    return "\n\n".join([text.GROWTH, table(text.GROWTH_HEADS, lines)])


def measured(name: str) -> list[Row]:
    """The rows of a file, each once: a run that was stopped may have written one twice."""
    return list({r["name"]: r for r in rows_of(name)}.values())


def write(target: str, split: str = "test") -> None:
    """Write the section between its marks."""
    parts = [
        text.BENDING_COMMANDS.format(split=split),
        "### Rooms of simulated pairs", simulated(measured(f"bending_simulated_{split}.jsonl")),
        "### The office floor", office(measured("bending_floor.jsonl")),
        "### Right and wrong poses", told_apart(measured(f"bending_wrong_{split}.jsonl")),
        "### Time", growth(measured("bending_growth.jsonl")),
    ]  # fmt: skip
    put(Path(target), table(text.DRIFT_HEADS, text.drift_table()), "drift")
    put(Path(target), "\n\n".join(parts), "bending")
