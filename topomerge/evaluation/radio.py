"""Evaluation of radio readings: poses, storeys and verdicts, by real walks on storeys whose law was fitted on the others.

``python evaluate.py task=radio`` parts the walks on each storey of `wifi_malls` in two sets, in frames of their own, and asks for
the pose from radio alone: of all walks, and of few. It asks which of five storeys readings are from, and how right poses and
wrong ones of small maps are told. ``data=storeys`` puts access points on real storeys of one plan (`storeys_jsk`), by the law of
loss of `datasets.simulation.radio`, and scores right and wrong storeys.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from topomerge.datasets.pairs.flat_maps import FlatMap, read_flat
from topomerge.datasets.real.sources import DEVELOPMENT_FOLDERS
from topomerge.datasets.real.storeys import STOREYS
from topomerge.datasets.real.wifi_malls import WIFI_STOREYS, WifiStorey, build_walk_map, split_walks
from topomerge.datasets.simulation.radio import (
    HELD,
    RADIO_CELL,
    RadioPlan,
    RadioSettings,
    place_access_points,
    simulate_readings,
)
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data, measure_missing
from topomerge.landmarks.radio import (
    DISTANCE_EDGES,
    LIKENESS_EDGES,
    WRONG,
    RadioLaw,
    collect_radio_scans,
    load_radio_law,
    score_radio,
)
from topomerge.landmarks.radio_search import RIGHT, build_radio_index, propose_radio_poses, rank_maps
from topomerge.statistics import compute_exact_interval
from topomerge.training.radio_law import (
    build_trials,
    count_pairs,
    draw_cases,
    fit_left_out,
    fit_left_out_odds,
    measure_log_loss,
    read_storeys,
    score_cases,
)
from topomerge.types import Landmarks, LogFn, Sim3

MAKERS = ("topomerge.landmarks.radio_search", "topomerge.training.radio_law", "topomerge.datasets.simulation.radio")
WALKS = (0, 15, 5)  # of each map; 0: half of all
SEED, VERDICT_SEED = 1000, 2000  # first of the splits; of those of small maps
TRIALS = 20  # of a storey
FAR, ALIKE = RIGHT, 0.5  # m of error that must be told as unsure; likeness of pairs that are
QUERIES = ("all scans", "one walk", "one scan")
LEVELS = {"1f": 0, "2f": 1, "3f": 2, "6f": 5, "7f": 6, "8f": 7, "b1f": -1}
DENSITY = 1.5  # access points for 100 m2
PARTS = 4  # splits of each real storey
TRACK_GAP = 2.0  # m between scans
SHARE = 0.65  # of a storey that each of two maps covers


@dataclass
class Settings(TaskSettings):
    """Settings of the task; `data.limit`: trials of each storey (0: 20)."""


def list_inputs(settings: Settings) -> list[str]:
    """Return names of what is measured."""
    if settings.data.set == "storeys":
        return [f"{building} {part}" for building in STOREYS for part in range(PARTS)]
    return [f"{name} {walks or 'all'}" for name in WIFI_STOREYS for walks in WALKS]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure each storey."""
    data = find_real_data()
    path = Path(settings.cache) / "evaluation" / f"radio-{settings.data.set or 'walks'}.jsonl"
    trials = settings.data.limit or TRIALS
    if settings.data.set == "storeys":
        items = {f"{building} {part}": (data, building, part) for building in STOREYS for part in range(PARTS)}
        return measure_missing(path, items, measure_building, log_line, settings)
    kept = str(Path(settings.cache) / "radio")
    walks = {f"{name} {walks or 'all'} {trials}": (name, walks, trials, kept) for name in WIFI_STOREYS for walks in WALKS}
    return measure_missing(path, walks, measure_walks, log_line, settings)


@cache
def load_left_out(folder: str) -> tuple[dict[str, WifiStorey], dict[str, RadioLaw]]:
    """Load the storeys, and for each the law, and the odds of poses, that were fitted on the others."""
    storeys = read_storeys()
    counts = count_pairs(storeys)
    odds = fit_left_out_odds(build_trials(storeys, counts, Path(folder), lambda line: None))
    laws = fit_left_out(counts, load_radio_law().discount)
    return storeys, {name: replace(law, pose_odds=odds[name]) for name, law in laws.items()}


def measure_walks(name: str, walks: int, trials: int, folder: str) -> Row:
    """Measure poses of two sets of walks on a storey; of all walks, also the rank of the storey and verdicts of small maps.

    Args:
        folder: of the trials that the odds of poses are fitted to.
    """
    storeys, laws = load_left_out(folder)
    law, rows = laws[name], []
    for trial in range(trials):
        a, b, truth = split_walks(storeys[name], SEED + trial, walks)
        found = propose_radio_poses(a, b, 5, law)
        at = collect_radio_scans(b.landmarks).position
        errors = [float(np.linalg.norm((p.pose.apply(at) - truth.apply(at))[:, :2], axis=1).mean()) for p in found]
        best = found[0] if found else None
        outcome = (best.probability, best.sigma, best.is_sure) if best else (0.0, 999.0, False)
        rows.append([errors[0] if found else 999.0, *outcome, min(errors, default=999.0)])
    row: Row = {"storey": name, "walks": walks, "trials": rows}
    if walks == 0:
        row["ranked"] = dict.fromkeys(QUERIES, 0)
        for trial in range(trials):
            for query, right in rank_storey(storeys, name, SEED + trial).items():
                row["ranked"][query] += right
        verdicts = score_cases(draw_cases(storeys, [name], VERDICT_SEED), law)
        row["verdicts"] = {key: values.tolist() for key, values in verdicts.items()}
        row["discount"] = law.discount
    return row


def rank_storey(storeys: Mapping[str, WifiStorey], name: str, seed: int) -> dict[str, bool]:
    """Rank five storeys, each by one half of its walks, by readings of the other half of one; is that one first?"""
    halves = {n: split_walks(storey, seed) for n, storey in storeys.items()}
    index = build_radio_index([half[0] for half in halves.values()])
    other = halves[name][1].landmarks
    groups = other.table["group"]
    walk = storeys[name].walk
    one = walk[groups[0]]
    parts = {"all scans": other, "one walk": other.select(walk[groups] == one), "one scan": other.select(groups == groups[0])}
    right = list(storeys).index(name)
    return {query: bool((ranks := rank_maps(index, part)) and ranks[0].map == right) for query, part in parts.items()}


def build_flat_radio_plan(flat: FlatMap, level: int) -> RadioPlan:
    """Build the plan of a real storey, its floor about the origin."""
    middle = flat.free.mean(axis=0)
    walls, free = flat.walls - middle, flat.free - middle
    low = np.minimum(walls.min(axis=0), free.min(axis=0)) - 1.0
    cell = np.floor((walls - low) / RADIO_CELL).astype(int)
    raster = np.zeros(cell.max(axis=0)[::-1] + 1, bool)
    raster[cell[:, 1], cell[:, 0]] = True
    rows = np.unique(np.floor(free), axis=0, return_index=True)[1]
    return RadioPlan(raster, free[rows], low, 3.5 * level, level)


def simulate_sessions(plan: RadioPlan, plans: Sequence[RadioPlan], part: int) -> tuple[Landmarks, Landmarks]:
    """Simulate two sessions on one storey, each over a share of it, in its own heights."""
    settings = RadioSettings(density=DENSITY)
    points = place_access_points(plans, settings, 100 + part)
    along = plan.free[:, int(np.ptp(plan.free[:, 1]) > np.ptp(plan.free[:, 0]))]
    sides = along <= np.quantile(along, SHARE), along >= np.quantile(along, 1 - SHARE)
    out = []
    for session, side in enumerate(sides):
        track = plan.free[side]
        track = track[np.unique(np.floor(track / TRACK_GAP), axis=0, return_index=True)[1]]
        readings = simulate_readings(plans, points, track, plan.level, settings, session)
        readings.table["position"][:, 2] = HELD
        out.append(readings)
    return out[0], out[1]


def measure_building(data: Path, building: str, part: int) -> Row:
    """Score storeys of a real building: each against itself at another session, and against the others."""
    folder = data / DEVELOPMENT_FOLDERS["storeys"]
    plans = {s: build_flat_radio_plan(read_flat(folder / f"{building}-{s}.yaml"), LEVELS[s]) for s in STOREYS[building]}
    sessions = {s: simulate_sessions(plan, list(plans.values()), part) for s, plan in plans.items()}
    maps = {s: tuple(build_walk_map(part) for part in parts) for s, parts in sessions.items()}
    true = {s: score_radio(first, second, Sim3()) for s, (first, second) in maps.items()}
    false = {f"{s} {t}": score_radio(maps[s][0], maps[t][1], Sim3()) for s, t in combinations(maps, 2)}
    return {
        "building": building,
        "readings": sum(len(x) for p in sessions.values() for x in p),
        "true": true,
        "false": false,
    }


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate."""
    if settings.data.set == "storeys":
        return {"radio-storeys": tabulate_buildings(rows)}
    whole = [row for row in rows if row["walks"] == 0]
    return {
        "radio-aims": tabulate_aims(rows),
        "radio-left-out": tabulate_left_out(rows),
        "radio-law": tabulate_law(),
        "radio-poses": tabulate_poses(rows),
        "radio-ranks": tabulate_ranks(whole),
        "radio-verdicts": tabulate_verdicts(whole),
    }


def tabulate_aims(rows: Sequence[Row]) -> str:
    """Tabulate what is aimed at: errors, poses beyond `FAR` that are told as sure, and storeys found by all scans."""
    lines = []
    for walks in WALKS:
        some = [row for row in rows if row["walks"] == walks]
        trials = np.array([t for row in some for t in row["trials"]], float)
        error, sure = trials[:, 0], trials[:, 3] > 0
        medians = [float(np.median([t[0] for t in row["trials"]])) for row in some]
        wrong = int((sure & (error > FAR)).sum())
        right, asked = sum(row["ranked"]["all scans"] for row in some if walks == 0), len(trials) if walks == 0 else 0
        low, high = compute_exact_interval(right, asked) if asked else (0.0, 1.0)
        found = [f"{right} of {asked}", f"{100 * low:.1f} to {100 * high:.1f} %"] if asked else ["–", "–"]
        median = f"{np.median(error):.2f}"
        errors = [median, f"{min(medians):.2f} to {max(medians):.2f}", f"{error.max():.1f}", int((error > FAR).sum())]
        lines.append([walks or "half of all", len(trials), *errors, int(sure.sum()), wrong, *found])
    head = [
        "walks a map",
        "trials",
        "median m",
        "of a storey",
        "worst m",
        f"beyond {FAR:g} m",
        "told as sure",
        f"sure and beyond {FAR:g} m",
    ]
    return write_table([*head, "storey right", "95 %"], lines)


def tabulate_left_out(rows: Sequence[Row]) -> str:
    """Tabulate for each storey how well what the law of the others tells is calibrated: verdicts, probabilities and sigmas."""
    lines = []
    for name in WIFI_STOREYS:
        of = {row["walks"]: row for row in rows if row["storey"] == name}
        if not of:
            continue
        values = np.concatenate([np.array(v, float).reshape(-1, 2) for v in of[0]["verdicts"].values()])
        probability = 1 / (1 + np.exp(-values[:, 0]))
        cells = [
            len(values),
            f"{measure_log_loss({'all': values}):.3f}",
            f"{probability.mean():.2f}",
            f"{values[:, 1].mean():.2f}",
        ]
        for walks in WALKS[:2]:
            trials = np.array(of[walks]["trials"], float)
            z = np.sqrt(np.mean(trials[:, 0] ** 2 / trials[:, 2] ** 2))
            cells += [f"{trials[:, 1].mean():.2f}", f"{(trials[:, 0] <= FAR).mean():.2f}", f"{z:.2f}"]
        lines.append([name, *cells])
    head = ["storey left out", "verdicts", "log loss", "other place: told", "was"]
    for selection in ("half of all walks", f"{WALKS[1]} walks"):
        head += [f"{selection}: pose told right", f"within {FAR:g} m", "error over sigma"]
    return write_table(head, lines)


def tabulate_law() -> str:
    """Tabulate how many pairs of scans are alike at each distance, by counts of all storeys."""
    law = load_radio_law()
    share = np.exp(law.log_density)[:, :, LIKENESS_EDGES.searchsorted(ALIKE - 1e-9) + 1 :].sum(axis=2)
    ends = [*(f"{x:g}" for x in DISTANCE_EDGES[1:]), "more"]
    head = ["m, from", "to", "one storey", "one apart", "two or more apart"]
    cells = [[f"{value:.3f}" for value in column] for column in share.T]
    lines = [[f"{low:g}", end, *row] for low, end, row in zip(DISTANCE_EDGES, ends, cells, strict=True)]
    return write_table(head, lines)


def tabulate_poses(rows: Sequence[Row]) -> str:
    """Tabulate errors of poses, and how sure they were told."""
    lines = []
    for walks in WALKS:
        some = [row for row in rows if row["walks"] == walks]
        for name, group in [*((row["storey"], [row]) for row in some), ("all", some)]:
            trials = np.array([t for row in group for t in row["trials"]], float)
            error, sure = trials[:, 0], trials[:, 3] > 0
            errors = [f"{np.median(error[sure]):.2f}", f"{error[sure].max():.2f}"] if sure.any() else ["–", "–"]
            z = f"{np.sqrt(np.mean(error[sure] ** 2 / trials[sure, 2] ** 2)):.2f}" if sure.any() else "–"
            wrong = int((sure & (error > FAR)).sum())
            cells = [len(error), f"{np.median(error):.2f}", f"{error.max():.1f}", f"{1 - sure.mean():.2f}", *errors, wrong, z]
            lines.append([walks or "half of all", name, *cells])
    head = ["walks a map", "storey", "trials", "median m", "worst m", "told unsure", "sure: median m", "sure: worst m"]
    return write_table([*head, "sure and beyond 5 m", "error over sigma"], lines)


def tabulate_ranks(rows: Sequence[Row]) -> str:
    """Tabulate how often the right one of five storeys was first."""
    lines = []
    for query in QUERIES:
        right = [row["ranked"][query] for row in rows]
        trials = [len(row["trials"]) for row in rows]
        lines.append([query, *(f"{r} of {t}" for r, t in zip(right, trials, strict=True)), f"{sum(right) / sum(trials):.3f}"])
    return write_table(["readings of", *(row["storey"] for row in rows), "all"], lines)


def tabulate_verdicts(rows: Sequence[Row]) -> str:
    """Tabulate the calibration of log likelihood ratios: how often an alternative was right where it got such odds."""
    edges = [-np.inf, -6, -4, -2, -1, 0, 1, 2, 4, 6, np.inf]
    joined = {k: np.concatenate([np.array(row["verdicts"][k]).reshape(-1, 2) for row in rows]) for k in ("elsewhere", "storey")}
    lines = []
    for key, values in joined.items():
        for low, high in pairwise(edges):
            some = values[(values[:, 0] > low) & (values[:, 0] <= high)]
            if len(some):
                p = 1 / (1 + np.exp(-some[:, 0]))
                lines.append([key, f"{low:g} to {high:g}", len(some), f"{p.mean():.3f}", f"{some[:, 1].mean():.3f}"])
    table = write_table(["against this pose", "log odds", "maps", "told", "right"], lines)
    return f"Log loss {measure_log_loss(joined):.3f}.\n\n{table}"


def tabulate_buildings(rows: Sequence[Row]) -> str:
    """Tabulate log likelihood ratios of another storey against this one, of right pairs and of two storeys."""
    lines = []
    for building in STOREYS:
        some = [row for row in rows if row["building"] == building]
        for kind in ("true", "false"):
            values = np.array([[s[name] for name in WRONG] for row in some for s in row[kind].values()])
            storey = values[:, WRONG.index("storey")]
            quantiles = [f"{q:.1f}" for q in np.quantile(storey, [0, 0.1, 0.5, 0.9, 1])]
            wrong = (storey >= 0).mean() if kind == "true" else (storey <= 0).mean()
            lines.append([building, "one storey" if kind == "true" else "two storeys", len(values), *quantiles, f"{wrong:.3f}"])
    head = ["building", "maps of", "pairs", "least", "10 %", "median", "90 %", "most", "on the wrong side"]
    return write_table(head, lines)
