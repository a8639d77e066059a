"""Merges of pairs of maps, from cells: what is placed right, what is believed, and what must not be.

``python evaluate.py task=merges data=test,test_drawings,strangers,real,real_strangers,lookalikes write=docs/results/merging.md``.
Sets: ``test`` and ``test_drawings`` (simulated pairs, and maps with floor plans), ``strangers`` and ``drawn_strangers`` (maps of
two places), ``real`` and ``real_strangers`` (TOPOMERGE_DATA), ``lookalikes``, ``boxes`` (worlds of boxes, made by another
simulator); to develop on ``train``, ``train_drawings``, ``development`` (a real floor) and ``storeys``. ``data.limit`` is so many
pairs of each, of strangers three times as many. ``data=folder path=DIR``: one's own pairs, all that its `pairs.yaml` lists, and
as many of two places.

Right: within 0.5 m and 5 degrees (fine: 0.1 m, 1 degree) in the middle of what both maps saw; of slices and drawings horizontally
and on the right storey. Rows are kept when the code changes (a run takes hours), and that is told. Seconds are of the processor.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from math import ceil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs.evaluation_pair import compute_anchor, convert_to_sim3
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids
from topomerge.datasets.pairs.own_pairs import OWN_DATA, OWN_FOLDER, check_own_path, extract_captures
from topomerge.datasets.pairs.pairs_file import PairTruth, are_on_two_storeys, find_overlap, read_pairs_file
from topomerge.datasets.simulation.box_worlds import BOX_KINDS, is_right, load_pair
from topomerge.errors import InputError
from topomerge.evaluation.merge_report import compute_headline, tabulate_merges
from topomerge.evaluation.tasks import (
    DRAWN,
    SCALELESS,
    Row,
    TaskSettings,
    describe_places,
    find_places,
    iterate_real_pairs,
    list_difficulties,
    make_lookalike_files,
    make_pair_files,
    measure_missing,
)
from topomerge.io.maps import load_map
from topomerge.metrics import is_on_storey
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.training.belief_hypotheses import compute_pose_error, is_hypothesis_right
from topomerge.types import LogFn, Sim3

MAKERS = ("topomerge.registration.pipeline", "topomerge.datasets.pairs.grid_pairs", "topomerge.metrics")
FINE = (0.1, 1.0)  # m, degrees
COPIED = ("sensors", "kind", "overlap", "differs", "walls_differ", "scaled")
LOOKALIKE = ("lookalike", "furniture", "tellable", "amount", "repeats", "building")
STOREYS = ("campus", "rmf", "mall", "utexas")  # sources whose plans of one building are storeys of it
STRIDE = 7  # pairs are laid out in blocks of so many pairs, so that few maps are in memory at once
STRANGERS_EACH = 3  # pairs of strangers for each pair that a limit allows: they need no more maps
OWN_SCALED = 0.03  # of a true scale, from which on that of the maps is free
STRANGERS, BOX_SEEDS = 757, 8  # pairs of strangers, and of each kind of worlds of boxes, if no limit is given
Items = dict[str, tuple[Any, ...]]
__all__ = ["MAKERS", "Settings", "compute_headline", "list_inputs", "measure", "tabulate"]


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        path: of ``data=folder``: a folder of captures with a `pairs.yaml`.
    """

    path: str = ""


def list_sets(settings: TaskSettings) -> list[str]:
    """List the sets that are asked for.

    Raises:
        InputError: there is no such set.
    """
    names = (settings.data.set or "development").split(",")
    check_own_path(OWN_DATA if OWN_DATA in names else names[0], getattr(settings, "path", ""))
    if unknown := set(names) - set(SETS):
        raise InputError(f"data.set={','.join(sorted(unknown))}: {', '.join(SETS)} are possible")
    return names


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the sets: a split and a recipe say all about a pair."""
    return [f"{name} {settings.data.limit} {getattr(settings, 'path', '')}".strip() for name in list_sets(settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure the pairs of each set that are missing."""
    rows = []
    for name in list_sets(settings):
        find_items, work = SETS[name]
        items = {k: v for k, v in find_items(name, settings, log_line).items() if settings.data.only in k}
        path = Path(settings.cache) / "evaluation" / f"merges_{name}.jsonl"
        rows += [{"set": name, **row} for row in measure_missing(path, items, work, log_line, settings)]
    return rows


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate merges by what the maps share, pairs that must not merge, calibration, and real pairs."""
    return tabulate_merges(rows)


# Pairs that share a place


def find_pairs(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find the simulated pairs of a split."""
    limit = 0 if name.endswith(DRAWN) else settings.data.limit  # a drawing is not of every pair
    files = make_pair_files(name, settings.cache, settings.jobs, log_line, limit)
    if name.endswith(DRAWN):
        files = [file for file in files if load_grids(file).about["kind"] == "overlap"]
    return {file.stem: (file, name) for file in files[: settings.data.limit or None]}


def find_real(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find the names of the real pairs of a split; each is read again where it is measured."""
    names = [pair.name for pair in iterate_real_pairs(name)]
    return {k: (k, name) for k in names[: settings.data.limit or None]}


def measure_pair(file: Path, split: str) -> Row:
    """Register a cached pair."""
    return score_pair(load_grids(file), split)


def measure_real(name: str, split: str) -> Row:
    """Register a real pair."""
    return score_pair(load_real(split)[name], split)


@lru_cache(maxsize=1)
def load_real(split: str) -> dict[str, GridPair]:
    """Load the real pairs of a split."""
    return {pair.name: pair for pair in iterate_real_pairs(split)}


def score_pair(pair: GridPair, split: str) -> Row:
    """Register a pair and compare with the truth."""
    about = {k: pair.about[k] for k in COPIED if k in pair.about}
    scaled = pair.about["source"] in SCALELESS or bool(pair.about.get("scaled"))
    row, registration = time_registration(pair.a, pair.b, scaled, pair.free)
    pose = registration.transform
    outcome = {"common": pair.common, "hard": list_difficulties(pair), "answered": pose is not None, **compare_pose(pose, pair)}
    return {**row, **about, **find_places(pair, split), **outcome}


def time_registration(a: Any, b: Any, scaled: bool, free: Any = None) -> tuple[Row, Registration]:
    """Register two maps on one core: what it says, and the seconds."""
    began = time.process_time()
    options = {} if free is None else {"free": free}
    with limit_threads():
        registration = register(a, b, scale="free" if scaled else "fixed", **options)
    outcome = {"probability": registration.probability, "believed": registration.accepted, "posterior": registration.posterior}
    return {**outcome, "seconds": time.process_time() - began}, registration


def compare_pose(pose: Sim3 | None, pair: GridPair) -> Row:
    """Compare a pose with the truth (``err``: horizontal and vertical, m, and degrees; ``scale``: by a factor): ``right`` and
    ``fine`` within 0.5 m and 5 degrees, 0.1 m and 1 degree, ``wrong_storey`` on another floor."""
    off = None if pose is None else compute_pose_error(pose, pair)
    sensors: Any = pair.about["sensors"]
    judged = {"right": is_hypothesis_right(off, sensors), "fine": is_hypothesis_right(off, sensors, FINE)}
    scale = None if pose is None or pair.truth is None else pose.scale / pair.truth.scale
    return {"err": off, "scale": scale, **judged, "wrong_storey": off is not None and not is_on_storey(off[1])}


# One's own pairs


def find_own(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find the listed pairs of a folder, and as many pairs of two buildings or storeys; captures are extracted where they are
    missing.

    Raises:
        InputError: the first thing that is wrong with the folder.
    """
    listing = read_pairs_file(getattr(settings, "path", ""))
    captures, faults = extract_captures(listing, settings.cache, settings.jobs, log_line)
    if faults:
        raise InputError(f"{listing.where}: {next(iter(faults.values()))}")
    listed = {frozenset((pair.a, pair.b)) for pair in listing.pairs}
    apart = [
        PairTruth(a.name, b.name, different=True, listed=False)
        for a, b in combinations(listing.captures.values(), 2)
        if (a.building != b.building or are_on_two_storeys(a, b)) and frozenset((a.name, b.name)) not in listed
    ]
    number = min(sum(not pair.different for pair in listing.pairs), len(apart))
    drawn = [apart[k] for k in sorted(np.random.default_rng(0).permutation(len(apart))[:number].tolist())]
    folder, items = Path(settings.cache).resolve() / OWN_FOLDER / "captures", Items()
    for pair in [*listing.pairs, *drawn]:
        files = folder / f"{captures[pair.a].name}.tmap", folder / f"{captures[pair.b].name}.tmap"
        about = {"pair": f"{pair.a} {pair.b}", "sensors": [listing.captures[k].sensor for k in (pair.a, pair.b)]}
        buildings = [listing.captures[k].building for k in (pair.a, pair.b)]
        about |= {"building": buildings[0], "physical": buildings[0], "physical_other": buildings[1]}
        items[f"{files[0].stem} {files[1].stem} {pair.matrix} {pair.rooms}"] = (files, pair, about, str(listing.path))
    return dict(list(items.items())[: settings.data.limit or None])


def measure_own(files: tuple[Path, Path], truth: PairTruth, about: Row, listing: str) -> Row:
    """Register two captures and compare with what their owner says.

    Raises:
        InputError: rooms that do not exist, or maps without anything in common under their truth.
    """
    a, b = (load_map(file) for file in files)
    try:
        overlap = find_overlap(truth, (a, b))
    except InputError as error:
        if truth.listed:
            raise InputError(f"{listing}: {error}") from error
        return {**about, "kind": ""}  # of one frame, but nothing was seen by both
    scale = 1.0 if overlap.transform is None else overlap.transform.scale
    row, registration = time_registration(a, b, abs(scale - 1) > OWN_SCALED)
    kind = "other-building" if truth.different else "overlap"
    pair = SimpleNamespace(truth=overlap.transform, about={"kind": kind, "sensors": about["sensors"]})
    pair.anchor = compute_anchor(pair, (a, b))
    pose = registration.transform
    judged = compare_pose(pose, cast(GridPair, pair))
    return {**row, **about, "kind": kind, "common": overlap.common, "answered": pose is not None, **judged}


# Pairs that must not merge


def find_strangers(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find neighbours in a shuffled order of the pairs of a split: map a of one, b of another."""
    most = STRANGERS_EACH * settings.data.limit or STRANGERS
    enough = ceil(most / (STRIDE - 1)) if settings.data.limit else 0
    files = make_pair_files("test", settings.cache, settings.jobs, log_line, enough)
    order = np.random.default_rng(0).permutation(len(files))
    blocks = [order[start : start + STRIDE] for start in range(0, len(order), STRIDE)]
    couples = [(files[i], files[j]) for block in blocks for i in block for j in block if i != j]
    return {f"{a.stem}+{b.stem}": (a, b, "test") for a, b in couples[:most]}


def find_drawn_strangers(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find maps and floor plans of another building, another storey or another wing."""
    files = make_pair_files("test_drawings", settings.cache, settings.jobs, log_line)
    apart = [file for file in files if load_grids(file).about["kind"] != "overlap"]
    return {file.stem: (file, "test_drawings") for file in apart[: settings.data.limit or None]}


def find_real_strangers(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find real maps of two places, so that each place meets each other one before any does so again."""
    places: dict[str, list[tuple[str, int]]] = {}
    for pair in iterate_real_pairs():
        places.setdefault(find_real_place(pair), []).extend([(pair.name, 0), (pair.name, 1)])
    rng, items = np.random.default_rng(0), Items()
    while places and len(items) < (settings.data.limit or STRANGERS):
        before = len(items)
        for pair_of_places in combinations(sorted(places), 2):
            one, other = (places[k][int(rng.integers(len(places[k])))] for k in pair_of_places)
            items.setdefault(f"{one[0]}:{'ab'[one[1]]}+{other[0]}:{'ab'[other[1]]}", (one, other))
        if len(items) == before:
            break
    return dict(list(items.items())[: settings.data.limit or STRANGERS])


def find_real_place(pair: GridPair) -> str:
    """Find the name of the place that a real pair shows: a storey, or a building."""
    name = pair.name.split("/")[1].split("-")[0]
    return name if pair.about["source"] == "utexas" else str(pair.about["building"])


@lru_cache(maxsize=2 * STRIDE)
def load_side(file: Path, split: str, side: int) -> tuple[Prepared, dict[str, Any]]:
    """Load and prepare one map of a cached pair, and what is told of it."""
    pair = load_grids(file)
    places, names = find_places(pair, split), ("", "other_")
    about = {
        "source": places[f"{names[side]}source"],
        "building": places[("building", "other")[side]],
        "hard": list_difficulties(pair),
    }
    sensors: Any = pair.about["sensors"]
    return prepare((pair.a, pair.b)[side], pair.free[side]), {**about, "sensor": sensors[side]}


def measure_strangers(first: Path, second: Path, split: str) -> Row:
    """Register map a of one pair and b of another."""
    (a, one), (b, other) = load_side(first, split, 0), load_side(second, split, 1)
    return score_strangers(a, b, one, other)


def measure_real_strangers(first: tuple[str, int], second: tuple[str, int]) -> Row:
    """Register maps of two real pairs."""
    sides = []
    for name, side in (first, second):
        pair = load_real("real")[name]
        sensors: Any = pair.about["sensors"]
        about = {"source": str(pair.about["source"]), "building": find_real_place(pair), "sensor": sensors[side], "hard": []}
        sides.append((prepare((pair.a, pair.b)[side], pair.free[side]), about))
    (a, one), (b, other) = sides
    return score_strangers(a, b, one, other)


def score_strangers(a: Prepared, b: Prepared, one: Row, other: Row) -> Row:
    """Register maps of two places; of maps that may show one place the kind is empty, and nothing is measured."""
    about: Row = {**describe_places((one["building"], other["building"]), (one["source"], other["source"]))}
    about |= {"sensors": [one["sensor"], other["sensor"]], "hard": sorted({*one["hard"], *other["hard"]})}
    about["kind"] = classify_strangers(one, other)
    if not about["kind"]:
        return about
    scaled = bool({one["source"], other["source"]} & set(SCALELESS))
    return {**time_registration(a, b, scaled)[0], **about}


def classify_strangers(one: Row, other: Row) -> str:
    """Classify two maps: strangers; other-storey of one physical building; nothing where they may show one place."""
    if find_physical_building(one["source"], one["building"]) != find_physical_building(other["source"], other["building"]):
        return "strangers"
    storeys = [set(side["building"].split(" + ")) for side in (one, other)]
    return "other-storey" if one["source"] in STOREYS and storeys[0].isdisjoint(storeys[1]) else ""


# Places made to be alike


def find_lookalikes(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find look-alikes."""
    split = "train" if name.startswith("train") else "test"
    files = make_lookalike_files(split, settings.cache, settings.jobs, log_line, settings.data.limit)
    return {file.stem: (file,) for file in files[: settings.data.limit or None]}


def measure_lookalike(file: Path) -> Row:
    """Register look-alikes; ``alike_err`` is the error against the false pose."""
    pair = load_grids(file)
    row, registration = time_registration(pair.a, pair.b, bool(pair.about["scaled"]), pair.free)
    about = {key: pair.about[key] for key in (*LOOKALIKE, *COPIED) if key in pair.about} | {"common": pair.common}
    alike = None if pair.about["alike"] is None else convert_to_sim3(np.array(pair.about["alike"]))
    pose = registration.transform
    at_alike = replace(pair, truth=alike, about={**pair.about, "kind": "overlap"})
    return {
        **row,
        **about,
        "err": pose and compute_pose_error(pose, pair),
        "alike_err": pose and compute_pose_error(pose, at_alike),
    }


def find_boxes(name: str, settings: TaskSettings, log_line: LogFn) -> Items:
    """Find worlds of boxes, some of each kind."""
    cache = Path(settings.cache) / "box_worlds"
    return {f"{kind}-{seed}": (kind, seed, cache) for kind in BOX_KINDS for seed in range(settings.data.limit or BOX_SEEDS)}


def measure_boxes(kind: str, seed: int, cache: Path) -> Row:
    """Register two maps of worlds of boxes."""
    a, b, truth, middle = load_pair(kind, seed, cache)
    row, registration = time_registration(a, b, False)
    return {**row, "kind": kind, "right": is_right(registration, kind, truth, middle)}


SETS: dict[str, tuple[Callable[[str, TaskSettings, LogFn], Items], Callable[..., Row]]] = {
    **dict.fromkeys(("test", "train", "test_drawings", "train_drawings"), (find_pairs, measure_pair)),
    **dict.fromkeys(("real", "development", "storeys"), (find_real, measure_real)),
    "strangers": (find_strangers, measure_strangers),
    "drawn_strangers": (find_drawn_strangers, measure_pair),
    "real_strangers": (find_real_strangers, measure_real_strangers),
    **dict.fromkeys(("lookalikes", "train_lookalikes"), (find_lookalikes, measure_lookalike)),
    "boxes": (find_boxes, measure_boxes),
    OWN_DATA: (find_own, measure_own),
}
