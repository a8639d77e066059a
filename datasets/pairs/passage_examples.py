"""Passages between segments of scans, with all evidence, and whether they part two rooms: what their score is fitted to.

The scans are those of `plan_examples`. A passage is an example where most of both segments lies in true rooms. Segments of one
true room are then merged, as a perfect score would, and what remains gives more examples.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.builder import BuildRow, BuildSettings, make_item
from topomerge.datasets.core.building import Plan
from topomerge.datasets.pairs.plan_examples import LONGEST_SCAN, PlanItem, PlanRecipe, build_scans, draw_item, simulate_item_scan
from topomerge.datasets.pairs.plan_truth import compute_plan_truth
from topomerge.datasets.simulation.scanner import transform_cloud

from topomerge import archive
from topomerge.extraction.extract import gather_evidence, read_navigable
from topomerge.extraction.parameters import PRESETS, DefaultParameters
from topomerge.extraction.plans.passages import DOOR_FEATURES, compute_door_features
from topomerge.extraction.segment import GrowingRooms, SegmentedStorey, log_odds, score_by_plan
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.types import Array, LogFn

PASSAGE_FORMAT = 3  # raise it when the same item gives other bytes: it is part of the files' names
MAP_CELL = 0.1  # m
PURE = 0.7  # share of a segment in its true room; segments between rooms are no example


@dataclass(frozen=True)
class PassageItem(PlanItem):
    """As of plans: all that the bytes of one file depend on."""

    @property
    def name(self) -> str:
        """A hash of the inputs and of the version of what is made from them."""
        return self.compute_name(PASSAGE_FORMAT)


@dataclass(frozen=True, eq=False)
class PassageExamples:
    """The passages of a scan.

    Args:
        features: (n, 17) `DOOR_FEATURES`.
        plan: (n,) log odds of a door by the plan alone.
        shown: (n,) log odds of a door by the walls.
        parted: (n,) bool, do they part two true rooms?
        kind: "walls", or "" of a scan that shows none at heights (`passages.choose_scorer`).
        building: the physical one, where that is known.
    """

    features: Array
    plan: Array
    shown: Array
    parted: Array
    kind: str
    building: str = ""


def build_passages(recipe: PlanRecipe, sharing: BuildSettings, log_line: LogFn = lambda text: None) -> list[Path]:
    """Return the files of a set, made where they are missing, in the order of the seeds."""
    return build_scans(recipe, "passages", partial(_draw, flat=recipe.flat), make_passage_file, sharing, log_line)[0]


def make_passage_file(item: PlanItem, plan: Plan | None, folder: str) -> BuildRow:
    """Make an item's file."""
    return make_item(item.name, folder, lambda: _arrays(item, make_passages(item, plan)), LONGEST_SCAN)


def load_passages(path: Path) -> PassageExamples:
    """Return the passages of a file.

    Raises:
        InputError: it is damaged.
    """
    arrays = archive.read(path, "cached passages")
    values: dict[str, Any] = {name: arrays[name] for name in ("features", "plan", "shown", "parted")}
    return PassageExamples(**values, kind=str(arrays["kind"]))


def make_passages(item: PlanItem, plan: Plan | None) -> PassageExamples:
    """Return the passages of one scan."""
    simulated, p, watch = simulate_item_scan(item, plan), PRESETS["default"], Stopwatch()
    assert isinstance(p, DefaultParameters)
    scan, navigable = read_navigable(transform_cloud(simulated.cloud, simulated.frame), MAP_CELL, p, watch)
    found = gather_evidence(scan, navigable, p, watch)
    visited = set(simulated.visited.tolist())
    rows: list[tuple[Array, float, float, bool]] = []
    for storey in found.storeys:
        columns = np.stack(np.meshgrid(*(np.arange(n) for n in storey.segment.shape), indexing="ij"), axis=-1)
        flat = storey.plan.origin + (columns + 0.5) * storey.plan.edge
        places = np.concatenate([flat, storey.plan.floor[..., None]], axis=-1)
        rows += collect_storey_passages(
            storey, compute_plan_truth(simulated.building, storey.plan, places, simulated.frame, simulated.shift)[0], visited
        )
    count, kind = len(rows), "walls" if found.walls is not None else ""
    features, odds, shown, parted = zip(*rows, strict=True) if rows else ((), (), (), ())
    return PassageExamples(
        np.array(features, float).reshape(count, len(DOOR_FEATURES)),
        np.array(odds, float),
        np.array(shown, float),
        np.array(parted, bool),
        kind,
    )


def collect_storey_passages(storey: SegmentedStorey, truth: Array, visited: set[int]) -> list[tuple[Array, float, float, bool]]:
    """Features, log odds by the plan and by the walls, and answer of the passages of a storey.

    They are collected before and while segments of one true room are merged.

    Args:
        truth: (nx, ny) true room of each column, -1 none.
        visited: rooms that the surveyor was in; passages between others are no examples.
    """
    inside = storey.segment >= 0
    votes = np.zeros((storey.count, int(truth.max(initial=-1)) + 2))  # the last column: of no room
    np.add.at(votes, (storey.segment[inside], truth[inside]), 1)
    room = np.where(votes.max(axis=1, initial=0) >= PURE * votes.sum(axis=1), votes.argmax(axis=1), -1)
    room[room == votes.shape[1] - 1] = -1
    growing = GrowingRooms(storey.segment, storey.clearance, storey.passages, storey.plan.edge, score_by_plan)
    rows: list[tuple[Array, float, float, bool]] = []

    def add(pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            if room[a] >= 0 and room[b] >= 0 and (room[a] in visited or room[b] in visited):
                passage, odds = growing.passages[a, b], float(log_odds(np.array(growing.door_probability[a, b])))
                features = compute_door_features(passage, growing.peak[[a, b]], growing.area[[a, b]])
                rows.append((features, odds, passage.shown, bool(room[a] != room[b])))

    add(list(growing.passages))
    while same := [pair for pair in growing.passages if room[pair[0]] >= 0 and room[pair[0]] == room[pair[1]]]:
        weakest = min(same, key=lambda pair: (growing.door_probability[pair], pair))
        growing.merge(weakest)
        add([pair for pair in growing.passages if weakest[0] in pair])
    return rows


def _draw(seed: int, plans: Any, flat: bool) -> PassageItem:
    return PassageItem(**asdict(draw_item(seed, plans, flat)))


def _arrays(item: PlanItem, examples: PassageExamples) -> dict[str, Array]:
    """The arrays of a file."""
    about = {"file": f"{item.name}.npz", **asdict(item)}
    values = {name: getattr(examples, name) for name in ("features", "plan", "shown", "parted")}
    return {**values, "kind": np.array(examples.kind), "about": np.frombuffer(json.dumps(about).encode(), np.uint8)}
