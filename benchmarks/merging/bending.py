"""Maps that bend, measured: the rows of docs/results/bending.md.

    python -m benchmarks.merging.bending simulated 3600 [split] [pairs]     # rooms of pairs whose drift is known
    python -m benchmarks.merging.bending floor 1800                         # the office floor to choose by
    python -m benchmarks.merging.bending wrong 3600 [split]                 # right and wrong poses, told apart by conflict
    python -m benchmarks.merging.bending growth 600                         # time over the number of rooms
    python -m benchmarks.merging.bending tables docs/results/bending.md

Resumable: a line of JSON a pair in ``cache/merge/bending_<what>[_<split>].jsonl``; the number is how many seconds a run may take.
Seconds in the rows are of the processor. Both maps are cells of 0.1 m; bending knows the sensors, and once more without (rows
``unnamed``). Splits ``validation`` (simulated) and ``train`` (wrong) to choose by, ``test`` for tables.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import chain, zip_longest
from typing import Any

import numpy as np
from topomerge.datasets.pairs.bent_pairs import DRIFT_FACTORS, BentPair, bent_pairs, drifts
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids

from benchmarks.merging.bending_growth import timed
from benchmarks.merging.bending_measures import room_errors
from benchmarks.merging.bending_poses import judged, marked, stranger_pairs, wrong_poses
from benchmarks.merging.cached_pairs import PAIRS_CACHE, buildings_of, pair_files, places_of
from benchmarks.merging.register import real_pairs
from benchmarks.merging.tables import RESULTS_CACHE, rows_of
from benchmarks.real_data import real_data
from topomerge.code_digest import code_digest
from topomerge.registration.bend.bend import bend
from topomerge.registration.bend.pieces import Drift, sensor_drift
from topomerge.registration.pipeline import register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.training.belief_hypotheses import error, right

Row = dict[str, Any]
GROWTH_ROOMS = (10, 30, 100, 300, 1000)
SIMULATED_PAIRS = 40
OFFICE = "halmstad_office_f5"


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


def simulated(split: str, pairs: str, done: set[str]) -> Iterator[Row]:
    """Rows of the pairs with drift."""
    for bent in bent_pairs(split, str(real_data()), int(pairs), PAIRS_CACHE / "bent", partial(print, flush=True)):
        if bent.pair.name not in done:
            row = simulated_row(bent, split)
            yield from copies(row)  # with any factor the same pair
            yield row


def copies(row: Row) -> Iterator[Row]:
    """The row of a pair without drift of which no sensor drifts, under the other factors."""
    if not drifts(row["sensors"]):
        yield from ({**row, "name": f"{row['name']} drift {factor:g}", "factor": factor} for factor in DRIFT_FACTORS[1:])


def floor(done: set[str]) -> Iterator[Row]:
    """Rows of the office floor."""
    points = marked(real_data() / OFFICE)
    for pair in real_pairs("development"):
        if pair.name in done:
            continue
        a, b = prepared(pair)
        clock = [time.process_time()]
        best = register(a, b, scale="free")
        clock.append(time.process_time())
        pose, off = best.transform, None
        if pose is not None:
            off = error(pose, pair)
        row: Row = {"name": pair.name, "sensors": pair.about["sensors"], "common": pair.common, "err": off, "building": "F5"}
        row |= {"probability": best.probability, "source": "halmstad", "right": right(off, ("drawing",))}
        if pose is not None:
            bent = bend(a, b, pose, drift=drift_of(pair), scaled=True)
            clock.append(time.process_time())
            row |= judged(a, b, pose, bent)
            here, there = points(pair.name)
            before, after = pose.apply(there), bent.transform.apply(bent.deformations[1].apply(there))
            row["key_points"] = [apart(here, before), apart(bent.deformations[0].apply(here), after)]
            row["seconds"] = {"register": clock[1] - clock[0], "bend": clock[2] - clock[1]}
        yield row


def apart(a: Any, b: Any) -> list[float]:
    """Horizontal distances, m."""
    out: list[float] = np.hypot(*(a - b)[:, :2].T).round(4).tolist()
    return out


def wrong(split: str, done: set[str]) -> Iterator[Row]:
    """Rows of right and wrong poses of cached pairs and of the office floor; a pair and strangers in turn."""
    ours = (load_grids(path) for path in pair_files(split) if path.stem not in done)
    others = (pair for pair in stranger_pairs(split) if pair.name not in done)
    floors = (pair for pair in real_pairs("development") if pair.name not in done)
    for pair in filter(None, chain.from_iterable(zip_longest(ours, others, floors))):
        a, b = prepared(pair)
        real = pair.about["source"] == "halmstad"
        scaled = bool(real or pair.about.get("scaled"))
        best = register(a, b, scale="free" if scaled else "fixed")
        names: Any = ("F5", "F5") if real else pair.about.get("buildings") or buildings_of(pair, split)
        places = places_of(names, ("halmstad", "halmstad")) if real else places_of(names)
        row: Row = {"name": pair.name, "sensors": pair.about["sensors"], "kind": pair.about["kind"], **places, "poses": []}
        for label, pose in wrong_poses(best, pair):
            bent = bend(a, b, pose, drift=drift_of(pair), scaled=scaled)
            row["poses"].append({"label": label, **judged(a, b, pose, bent)})
        yield row


def growth(done: set[str]) -> Iterator[Row]:
    """Rows of storeys of more and more rooms."""
    timed(3)  # compiles
    yield from (timed(n) for n in GROWTH_ROOMS if f"{n} rooms" not in done)


def main(what: str, *words: str) -> None:
    """Run what is missing until the time is over, or write the tables."""
    if what == "tables":
        from benchmarks.merging.bending_tables import write

        write(*words)
        return
    began, split = time.monotonic(), (*words[1:], "validation" if what == "simulated" else "train")[0]
    suffix = f"_{split}" if what in ("simulated", "wrong") else ""
    target = RESULTS_CACHE / f"bending_{what}{suffix}.jsonl"
    target.parent.mkdir(parents=True, exist_ok=True)
    code, earlier = code_digest("topomerge.registration.bend.bend"), rows_of(target.name)
    done = {row["name"] for row in earlier}
    if any(row.get("code") != code for row in earlier):
        print(f"{target}: some of its rows are of another state of the code; delete it to measure them again")
    runs = {"floor": floor, "growth": growth}
    if what == "simulated":
        rows = simulated(split, (*words[2:], str(SIMULATED_PAIRS))[0], done)
    else:
        rows = wrong(split, done) if what == "wrong" else runs[what](done)
    for row in rows:
        with target.open("a") as out:
            out.write(json.dumps({**row, "code": code}) + "\n")
        if time.monotonic() - began > float(words[0]):
            print(f"{target}: {words[0]} s are over; run it again for the rest")
            break


if __name__ == "__main__":
    main(*sys.argv[1:])
