"""Where was a scan taken: single scans and short walks in an atlas of maps, and captures of a real floor cut small.

``python evaluate.py task=locate data=test`` makes maps of simulated buildings of all kinds, one of each by one of some sensors,
and asks where scans of a later session were taken. Two in six more are of a building without a map. ``data=captures`` asks in
an atlas of real homes and one capture of a real floor where windows of its other captures are (development set). ``data=more``: a
camera that is turned once, and a robot's laser that drives a few metres. ``data=size``: the same scans in atlases of more and
more maps, those from 100 on of houses; they are made where they are missing, which takes five seconds each, a house one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.localisation import (
    MORE_SCANS,
    SCANS,
    LocatedMap,
    load_located_map,
    make_located_map,
    make_located_scan,
)
from topomerge.datasets.real.office_floor import iter_pairs
from topomerge.datasets.real.sources import DEVELOPMENT_FOLDERS
from topomerge.errors import InputError
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data, measure_missing
from topomerge.extraction.extract import extract
from topomerge.fusion.atlas.locate import LOCATE, decide, find_places, prepare_query
from topomerge.fusion.atlas.place_index import PlaceIndex
from topomerge.io.maps import load_map
from topomerge.io.points import read_points
from topomerge.matching.poses import wrap_yaw
from topomerge.statistics import bootstrap_mean, compute_exact_interval
from topomerge.types import Array, LogFn, PointCloud, Sim3

MAKERS = ("topomerge.fusion.atlas.locate", "topomerge.fusion.atlas.place_index", "topomerge.datasets.pairs.localisation")
MAPS = {"validation": 24, "test": 50}
FIRST = {"validation": 0, "test": 24}  # building that is judged: by the first ones of the test the threshold was chosen
SIZE_SCANS, ASKED, MANY = ("station", "sweep", "walk"), 5, 1000  # by which growth is measured; buildings; maps that none has made
RIGHT_POSE = (0.3, np.radians(5.0))  # m and rad
RIGHT_PLACE = 1.0  # m: of captures, whose rooms are cut in different ways, and which drift bends
CAPTURES, WINDOWS, WINDOW = 12, 2, 7.0  # pairs of captures, windows of each and m along a side
HOMES = 12  # maps of other places beside the capture
OUTCOMES = ("right", "wrong", "ambiguous", "not here", "unreadable")


@dataclass
class Settings(TaskSettings):
    """Settings of the task; `data.limit`: buildings that are asked for (0: all of the atlas).

    Args:
        sizes: maps of the atlases of ``data=size``.
    """

    sizes: list[int] = field(default_factory=lambda: [50, 100, 1000])


def list_inputs(settings: Settings) -> list[str]:
    """Return names of what is measured."""
    if settings.data.set == "captures":
        return [f"capture {k}" for k in range(settings.data.limit or CAPTURES)]
    if settings.data.set == "size":
        return [f"building {k} of {size}" for size in settings.sizes for k in range(FIRST["test"], FIRST["test"] + ASKED)]
    split = "test" if settings.data.set == "more" else settings.data.set or "validation"
    return [f"building {k}" for k in range(FIRST[split], MAPS[split])][: settings.data.limit or None]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure what is missing."""
    split = settings.data.set or "validation"
    path = Path(settings.cache) / "evaluation" / f"locate_{split}.jsonl"
    names = list_inputs(settings)
    if split == "captures":
        items: dict[str, Any] = {name: (k,) for k, name in enumerate(names)}
        return measure_missing(path, items, measure_capture, log_line, settings)
    kinds = {"more": MORE_SCANS, "size": SIZE_SCANS}.get(split, SCANS)
    split = split if split in MAPS else "test"
    folder = Path(settings.cache) / "locate" / split
    folder.mkdir(parents=True, exist_ok=True)
    numbers = [[int(word) for word in name.split()[1::2]] for name in names]
    sizes = [of[1] if len(of) > 1 else MAPS[split] for of in numbers]
    items = {name: (split, of[0], folder, kinds, size) for name, of, size in zip(names, numbers, sizes, strict=True)}
    return measure_missing(path, items, measure_building, log_line, settings)


@cache
def load_atlas(split: str, folder: Path, size: int) -> tuple[PlaceIndex, list[LocatedMap]]:
    """Load the index of so many maps of a split, made where they are missing, and their truth."""
    with limit_threads():
        maps = [load_located_map(make_located_map(split, k, folder)) for k in range(size)]
        return PlaceIndex.from_maps({m.path.stem: load_map(m.path) for m in maps}), maps


def measure_building(split: str, number: int, folder: Path, kinds: Sequence[str], size: int) -> Row:
    """Ask where scans of some kinds were taken in a building with a map, and for a third of these in one without."""
    index, maps = load_atlas(split, folder, size)
    scans = []
    for n, kind in enumerate(kinds):
        for negative in (False, True) if (number + n) % 3 == 0 else (False,):
            try:
                scan = make_located_scan(split, number, kind, negative)
            except InputError:
                continue
            pose, moved = maps[number].place_scan(scan)
            true = replace(pose, translation=tuple((np.array(pose.translation) + moved).tolist()))  # type: ignore[arg-type]
            scans.append({"kind": kind, **measure_scan(index, scan.cloud, None if negative else (number, true))})
    return {"scans": scans, "maps": size, "storeys": len(index.storeys)}


def measure_scan(index: PlaceIndex, cloud: PointCloud, truth: tuple[int, Sim3] | None, near: float = 0.0) -> Row:
    """Ask where a scan was taken.

    Args:
        truth: number of its map and true pose there; None: it is of no map.
        near: m within which a place is right whatever its room is called; 0: the room counts.
    """
    began = process_time()
    try:
        query = prepare_query(cloud)
    except InputError:
        return {"stranger": truth is None, "status": "unreadable", "seconds": process_time() - began}
    answer = decide(index, query, find_places(index, query, LOCATE))
    row = {"stranger": truth is None, "status": answer.status, "seconds": process_time() - began, "told": answer.told}
    if answer.places:
        row |= {"p": answer.places[0].probability, "nowhere": answer.nowhere}
    if truth is None:
        return row
    own, pose = truth
    name, at = index.maps[own].name, pose.apply(query.place[None])[0]
    room = find_true_room(index, own, at)
    checks = [check_place(p, name, room, pose, at, near) for p in answer.places[: max(answer.told, 1)]]
    return row | {"among": any(c["room"] for c in checks), **({} if not checks else checks[0])}


def find_true_room(index: PlaceIndex, own: int, at: Array) -> int:
    """Find the room of a map at a place, -1 none."""
    for storey in index.storeys:
        fields, rooms = storey.load() if storey.map == own else (None, None)
        if fields is None or rooms is None or not -0.8 < at[2] - fields.plan.floor_guess < 2.5:
            continue
        cell = np.floor((at[:2] - fields.plan.origin) / fields.plan.edge).astype(int)
        if ((cell >= 0) & (cell < rooms.shape)).all():
            return int(rooms[tuple(cell)])
    return -1


def check_place(place: Any, name: str, room: int, pose: Sim3, at: Array, near: float) -> Row:
    """Check a place that was told: is the room right, and the pose?"""
    away = float(np.hypot(*(np.array(place.at) - at)[:2]))
    turned = abs(wrap_yaw(place.pose.yaw - pose.yaw))
    here = place.map == name
    right = here and (away < near if near else (place.room == room or away < RIGHT_POSE[0]))
    return {"room": right, "pose": here and away < RIGHT_POSE[0] and bool(turned < RIGHT_POSE[1]), "away": away if here else None}


@cache
def load_captures() -> tuple[tuple[tuple[str, PointCloud, PointCloud, Sim3], ...], dict[str, Any]]:
    """Load pairs of captures of the real floor, spread over all, and maps of homes."""
    data = find_real_data()
    every = list(iter_pairs(data / DEVELOPMENT_FOLDERS["office_floor"]))
    chosen = [every[k] for k in np.linspace(0, len(every) - 1, CAPTURES).round().astype(int)]
    pairs = tuple((name, p.a, p.b, p.truth) for name, p in ((name, make()) for name, make in chosen) if p.truth is not None)
    homes = {}
    for path in sorted((data / "homes_vacuum_robots").glob("*.json"))[: 3 * HOMES]:
        try:
            homes[path.stem] = extract(read_points(path))
        except InputError:
            continue
        if len(homes) == HOMES:
            break
    return pairs, homes


def measure_capture(number: int) -> Row:
    """Ask for windows of one capture in an atlas of another capture and homes, and in one of the homes alone."""
    pairs, homes = load_captures()
    name, a, b, truth = pairs[number % len(pairs)]
    scaled = replace(b, points=(b.points * truth.scale).astype(np.float32))
    true = Sim3(truth.yaw, truth.translation)
    with limit_threads():
        index = PlaceIndex.from_maps({"floor": extract(a), **homes})
        alone = PlaceIndex.from_maps(homes)
    scans = []
    for window in iter_windows(scaled, true, a, np.random.default_rng([number, 54])):
        scans.append({"kind": "window", **measure_scan(index, window, (0, true), RIGHT_PLACE)})
        scans.append({"kind": "window", **measure_scan(alone, window, None)})
    return {"pair": name, "scans": scans}


def iter_windows(b: PointCloud, true: Sim3, a: PointCloud, rng: np.random.Generator) -> Iterator[PointCloud]:
    """Yield square windows of a capture, about places that the other one shows, too."""
    from scipy.spatial import cKDTree

    tree, count = cKDTree(a.points[::5, :2]), 0
    for row in rng.permutation(len(b.points))[:200].tolist():
        middle = b.points[row, :2]
        inside = (np.abs(b.points[:, :2] - middle) < WINDOW / 2).all(axis=1)
        placed = true.apply(b.points[inside][::20].astype(float))[:, :2]
        if inside.sum() > 300 and (tree.query(placed)[0] < 0.5).mean() > 0.7:
            free = b.free
            if free is not None:
                at = free.compute_centroids()[:, :2]
                free = free.select_cells((np.abs(at - middle) < WINDOW / 2).all(axis=1))
            yield PointCloud(b.points[inside], free=free, upright=True)
            count += 1
        if count == WINDOWS:
            return


def classify_outcome(scan: Row) -> str:
    """Classify an answer: of a scan that is told to be somewhere, right or wrong."""
    if scan["status"] != "located":
        return str(scan["status"])
    return "right" if scan.get("room") else "wrong"


def tabulate_sizes(rows: Sequence[Row]) -> str:
    """Tabulate a line an atlas, and what 1,000 maps would take by a line through the medians."""
    lines: list[list[object]] = []
    sizes = sorted({r["maps"] for r in rows})
    for size in sizes:
        own = [r for r in rows if r["maps"] == size]
        scans = [s for r in own for s in r["scans"]]
        seconds = [s["seconds"] for s in scans]
        known, unknown = ([classify_outcome(s) for s in scans if s["stranger"] == no] for no in (False, True))
        counts = [len(known), known.count("right"), known.count("wrong"), len(unknown), unknown.count("wrong")]
        lines.append([size, own[0]["storeys"], *counts, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"])
    if len(sizes) > 1 and max(sizes) < MANY:
        slope, start = np.polyfit(sizes, [float(line[-2]) for line in lines], 1)  # type: ignore[arg-type]
        lines.append([f"{MANY:,}, by a straight line", *["–"] * 6, f"{start + slope * MANY:.0f}", "–"])
    heads = ["maps", "storeys", "scans of a map", "told right", "told wrong", "of no map", "told wrong"]
    return write_table([*heads, "s of one core, median", "slowest"], lines)


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate a line a kind of scan, of places in the atlas and of others."""
    if settings.data.set == "size":
        return {"locate-size": tabulate_sizes(rows)}
    lines = []
    for negative in (False, True):
        kinds = list(dict.fromkeys(s["kind"] for r in rows for s in r["scans"]))
        for kind in [*kinds, *(["all"] if len(kinds) > 1 else [])]:
            some = [
                (k, s) for k, r in enumerate(rows) for s in r["scans"] if s["stranger"] == negative and kind in (s["kind"], "all")
            ]
            if some:
                lines.append(tabulate_line(kind, negative, some))
    head = ["scan", "of", "scans", "told and right room", "95 %", "pose of these within 0.3 m, 5°", "told and wrong", "95 %"]
    head += ["among those named", "cannot tell", "not here", "no walls", "s of one core, median", "slowest"]
    return {f"locate-{settings.data.set or 'validation'}": write_table(head, lines)}


def tabulate_line(kind: str, negative: bool, some: Sequence[tuple[int, Row]]) -> list[object]:
    """Tabulate some scans, each with the number of its building."""
    outcome = [classify_outcome(s) for _, s in some]
    counts = {name: outcome.count(name) for name in OUTCOMES}
    text = [s for (_, s), what in zip(some, outcome, strict=True) if what == "right"]
    share, low, high = bootstrap_mean(np.array([o == "right" for o in outcome], float), np.array([k for k, _ in some]))
    worst = compute_exact_interval(counts["wrong"], len(some))
    seconds = [s["seconds"] for _, s in some]
    named = sum(bool(s.get("among")) for _, s in some if s["status"] == "ambiguous" and s.get("told"))
    of = sum(s["status"] == "ambiguous" and bool(s.get("told")) for _, s in some)
    good = (
        ["–", "–", "–"]
        if negative
        else [f"{share:.2f}", f"{low:.2f}–{high:.2f}", f"{sum(s['pose'] for s in text)} of {len(text)}"]
    )
    return [
        kind, "no map" if negative else "a map", len(some), *good, counts["wrong"], f"{worst[0]:.3f}–{worst[1]:.3f}",
        "–" if negative else f"{named} of {of}", counts["ambiguous"], counts["not here"], counts["unreadable"],
        f"{np.median(seconds):.2f}", f"{max(seconds):.2f}",
    ]  # fmt: skip
