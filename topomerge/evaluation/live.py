"""Robots that map at the same time: how long after a person could tell they are joined, wrong joins, and what it takes.

``python evaluate.py task=live``: simulated robots drive through rooms that they share, or through other buildings. What they see
is put into `fusion.live` in the time that it takes them; updates come as the bridge lets them. A person could tell two robots'
maps together from when they share as much floor as the least with which any pair of the draw was joined rightly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.localisation import MAPPED_KINDS, simulate_robot
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.plans.splits import get_seed_range
from topomerge.datasets.simulation.walk import sample_part
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, measure_missing
from topomerge.fusion.bridge import Bridge
from topomerge.fusion.live import LiveMerger
from topomerge.matching.poses import wrap_yaw
from topomerge.types import Array, LogFn, Sim3

MAKERS = ("topomerge.fusion.bridge", "topomerge.datasets.pairs.localisation")
CASES = (2, 2, 3, 2, 0, 2, 3, 2)  # robots of each in one building; 0: two robots in two buildings
ROOMS, FIRST = 8, 60_000  # rooms of a case, of which each robot visits six; first seed beyond that of the split
VISITED = 6
SPEED, RATE = 0.5, 10.0  # m/s of a robot, scans a second
SCANS = 60  # of a robot, at most, 2 m apart
CELL = 0.25  # m, of floor that is counted as seen
RIGHT = (0.5, np.radians(5.0))  # m and rad


@dataclass
class Settings(TaskSettings):
    """Settings of the task; `data.limit`: cases."""


def list_inputs(settings: Settings) -> list[str]:
    """Return names of what is measured."""
    return [f"case {k}" for k in range(len(CASES))][: settings.data.limit or None]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure what is missing."""
    path = Path(settings.cache) / "evaluation" / "live.jsonl"
    return measure_missing(path, {name: (k,) for k, name in enumerate(list_inputs(settings))}, measure_case, log_line, settings)


def measure_case(number: int) -> Row:
    """Let the robots of a case drive, and note what was told and when."""
    rng = np.random.default_rng([number, 55])
    robots = list(draw_robots(number, rng))
    with TemporaryDirectory() as folder, limit_threads():
        merger = LiveMerger(Path(folder))
        bridge = Bridge(merger, [], lambda event: None)
        taken, events, free, updates = 0.0, [], 0.0, 0.0
        shown: dict[str, set[tuple[int, int]]] = {name: set() for name, *_ in robots}
        shared: list[tuple[float, dict[str, int]]] = []
        for time, name, pose, points in sorted(iterate_scans(robots), key=lambda s: s[:2]):
            began = process_time()
            merger.get_robot(name, name).add_scan(points, pose)
            taken += process_time() - began
            frame = next(frame for of, _, frame, _ in robots if of == name)
            shown[name] |= list_floor(frame.inverse(), pose, points)
            shared.append((time, {a + b: len(shown[a] & shown[b]) for a, b in combinations(shown, 2)}))
            if time >= free:
                began = process_time()
                found = merger.update()
                took = process_time() - began
                updates += took
                events += [{"time": time + took, **judge_event(event, robots)} for event in found if event["event"] != "settle"]
                free = time + max(bridge.every, took / bridge.share)
        end = shared[-1][0]
    first = {pair: next(([t, n[pair] * CELL**2] for t, n in shared if n[pair]), None) for pair in shared[-1][1]}
    areas = [[round(t, 1), {pair: round(n * CELL**2, 1) for pair, n in of.items()}] for t, of in shared]
    together = {a + b: one == two for (a, one, *_), (b, two, *_) in combinations(robots, 2)}
    return {
        "robots": len(robots), "together": together, "events": events, "end": end, "first": first, "areas": areas,
        "add": taken / len(shared), "update": updates / end,
    }  # fmt: skip


def draw_robots(number: int, rng: np.random.Generator) -> Iterator[tuple[str, int, Sim3, list[tuple[float, Array, Array]]]]:
    """Draw the robots of a case: name, number of the building, its frame, and what it sees."""
    first, _ = get_seed_range("test")
    count, kind = CASES[number], MAPPED_KINDS[number % len(MAPPED_KINDS)]
    for k, name in enumerate("abc"[: count or 2]):
        seed = first + FIRST + 2 * number + (k if not count else 0)
        building = make_building(kind, seed)
        rooms = sample_part(building, ROOMS, np.random.default_rng(seed))
        own = rng.permutation(rooms)[:VISITED].tolist()
        (frame,) = draw_frames(1, False, rng)
        yield name, seed, frame, simulate_robot(building, own, frame, rng)[:SCANS]


def iterate_scans(robots: Sequence[tuple[str, int, Sim3, Any]]) -> Iterator[tuple[float, str, Array, Array]]:
    """Iterate over the scans of all robots: s since they started, name, pose and points."""
    for name, _, _, scans in robots:
        yield from ((driven / SPEED, name, pose, points) for driven, pose, points in scans)


def list_floor(back: Sim3, pose: Array, points: Array) -> set[tuple[int, int]]:
    """List the cells of the building in which a scan shows floor, or walls above it."""
    seen = back.apply(points @ pose[:3, :3].T + pose[:3, 3])
    low = seen[seen[:, 2] < np.percentile(seen[:, 2], 2) + 0.15]
    return set(map(tuple, np.floor(low[:, :2] / CELL).astype(int).tolist()))


def judge_event(event: Row, robots: Sequence[tuple[str, int, Sim3, Any]]) -> Row:
    """Tell of an event whether the pose is right."""
    (_, one, frame_a, _), (_, two, frame_b, scans_b) = (next(r for r in robots if r[0] == n) for n in event["robots"])
    row = {"event": event["event"], "pair": "".join(event["robots"]), "p": event["probability"]}
    if "matrix" not in event:
        return row
    matrix, true = np.array(event["matrix"]), frame_a @ frame_b.inverse()
    published = Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), tuple(matrix[:3, 3].tolist()))
    middle = np.mean([pose[:3, 3] for _, pose, _ in scans_b], axis=0)[None]
    away = float(np.linalg.norm(published.apply(middle) - true.apply(middle)))
    right = one == two and away < RIGHT[0] and abs(wrap_yaw(published.yaw - true.yaw)) < RIGHT[1]
    return {**row, "away": away, "right": bool(right)}


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate a line a pair of robots."""
    least = min((find_area(r, e) for r in rows for e in r["events"] if e.get("right")), default=float("inf"))
    lines: list[list[object]] = []
    for row in rows:
        for pair, together in row["together"].items():
            own = [e for e in row["events"] if e["pair"] == pair]
            joined = next((e for e in own if e.get("right")), None)
            tellable = next((t for t, of in row["areas"] if of[pair] >= least), None) if together else None
            ends = [e for e in own if e.get("right") or e["event"] == "parted"]
            wrong = [(e, next((f["time"] for f in ends if f["time"] > e["time"]), None)) for e in own if e.get("right") is False]
            lines.append([
                f"{row['name']}, {row['robots']} robots", pair[0] + ", " + pair[1], "one" if together else "two",
                f"{row['areas'][-1][1][pair]:.0f}" if together else "–", "–" if tellable is None else f"{tellable:.0f}",
                "–" if joined is None else f"{joined['time']:.0f}",
                "–" if joined is None or tellable is None else f"{max(joined['time'] - tellable, 0.0):.0f}",
                ", ".join("to the end" if gone is None else f"{gone - e['time']:.0f} s" for e, gone in wrong) or "none",
                f"{row['end']:.0f}", f"{100 * (row['robots'] * RATE * row['add'] + row['update']):.0f}",
            ])  # fmt: skip
    head = ["case", "robots", "buildings", "floor that both saw at the end, m²", "a person could tell, s", "joined rightly, s",
            "delay, s", "wrong joins, and how long", "drive, s", "of a core, %, at 10 Hz"]  # fmt: skip
    return {"live": write_table(head, lines)}


def find_area(row: Row, event: Row) -> float:
    """Find the floor, m2, that a pair had in common when it was joined."""
    return float(next((of[event["pair"]] for t, of in reversed(row["areas"]) if t <= event["time"]), 0.0))
