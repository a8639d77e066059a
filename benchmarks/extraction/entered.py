"""Which rooms were only looked into: their odds against the truth, and the rooms' precision with them and without.

``python -m benchmarks.extraction.entered --write docs/results/rooms.md`` scans simulated buildings of the validation list, one
of each kind by each sensor, and extracts each scan with the places of the sensor and without; robots' grids have none. *Before*
are the same maps judged as when rooms of which less than 0.6 of the outline was seen were called glimpsed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.simulation.floor_truth import judge, said
from topomerge.datasets.simulation.room_truth import room_truth

from benchmarks.extraction.cases import BUILDING_KINDS, CASE_SENSORS, IPA
from benchmarks.extraction.scans import Case, Scan, load
from benchmarks.extraction.tables import replace_section
from topomerge.training.closed_form import calibration_error
from topomerge.training.room_odds import ANSWER_OF, guess_scores
from topomerge.types import ROOM_ODDS, Array, with_outline_odds

ENTERED_MARK = "entered"
VALIDATION, TRAINING = 800_900, 41_000  # first seeds
BANDS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
Row = dict[str, Any]


def cases(development: bool, grids: bool = True) -> list[Case]:
    """A building of each kind by each sensor, and robots' grids."""
    first = TRAINING if development else VALIDATION
    made = [
        Case(f"by {sensor}", "procedural", kind, sensor, first + 10 * j + i, rooms=8)
        for j, sensor in enumerate(CASE_SENSORS)
        for i, kind in enumerate(BUILDING_KINDS)
    ]
    return made + [Case("grids", "ipa", name) for name in IPA if grids and not development]


def measured(case: Case, scan: Scan, posed: bool) -> Row:
    """The odds of the rooms of a map, what is true about them, and its scores before and now."""
    from topomerge.extraction.extract import extract

    cloud = scan.cloud if posed else replace(scan.cloud, poses=None, pose_of=None)
    map = extract(cloud, voxel_size=case.voxel, carve=False)
    assert scan.truth is not None
    columns = said(map, scan.truth)
    truth = room_truth(map, scan.truth, scan.rooms, columns)
    before = replace(map, rooms=with_outline_odds(map.rooms))
    row: Row = {"set": case.set, "posed": posed, "completeness": map.rooms["completeness"][truth.judged]}
    row |= {name: map.rooms[name][truth.judged] for name in ROOM_ODDS}
    row |= {f"true {name}": getattr(truth, ANSWER_OF[name])[truth.judged] for name in ROOM_ODDS}
    for word, judged in (("before", before), ("now", map)):
        verdict = judge(judged, scan.truth, columns)
        scores = {"rooms P": verdict.rooms.precision, "rooms R": verdict.rooms.recall, "IoU": verdict.rooms.iou}
        scores |= {"doors P": verdict.doors.precision, "doors R": verdict.doors.recall}
        scores |= {"edges P": verdict.edges.precision, "edges R": verdict.edges.recall}
        row |= {f"{name} {word}": value for name, value in scores.items()}
    return row


def report(rows: Sequence[Row], command: str) -> str:
    """Both tables as Markdown."""
    sets = list(dict.fromkeys(row["set"] for row in rows))
    lines = [f"`{command}`", "", f"{len({(r['set'], r['case']) for r in rows})} maps, means over the maps of a set.", ""]
    names = ["rooms P", "rooms R", "doors P", "doors R", "edges P", "edges R"]
    head = ["set", "poses", "rooms", "entered", "AUC", "AUC of completeness", *(f"{n}: before, now" for n in names)]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for title in [*sets, "all"]:
        for posed in (True, False):
            mine = [r for r in rows if (title == "all" or r["set"] == title) and r["posed"] == posed]
            if mine:
                cells = [title, "yes" if posed else "no", *_separation(mine)]
                cells += [", ".join(f"{np.nanmean([r[f'{n} {w}'] for r in mine]):.2f}" for w in ("before", "now")) for n in names]
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *_calibration(rows)])


def _separation(rows: Sequence[Row]) -> list[str]:
    true = _joined(rows, "true entered") > 0
    scores = [guess_scores(_joined(rows, name), true)["auc"] for name in ("entered", "completeness")]
    both = true.any() and not true.all()
    return [str(len(true)), f"{true.mean():.2f}", *(f"{score:.3f}" if both else "–" for score in scores)]


def _joined(rows: Sequence[Mapping[str, Array]], name: str) -> Array:
    return np.concatenate([np.asarray(row[name], float) for row in rows])


def _calibration(rows: Sequence[Row]) -> list[str]:
    """How often it was so, in bands of the probability."""
    bands = [f"{a:g} to {b:g}" for a, b in pairwise(BANDS)]
    head = ["probability", "poses", "AUC", "calibration error", *bands]
    lines = ["How often it was so where the probability was in a band (number of rooms):", ""]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in ROOM_ODDS:
        for posed in (True, False) if name == "entered" else (False,):
            mine = [r for r in rows if r["posed"] == posed]
            p, true = _joined(mine, name), _joined(mine, f"true {name}") > 0
            cells = [name, "yes" if posed else "no", f"{guess_scores(p, true)['auc']:.3f}", f"{calibration_error(p, true):.3f}"]
            for low, high in pairwise(BANDS):
                band = (p >= low) & (p < high + (high == 1))
                cells.append(f"{true[band].mean():.2f} ({band.sum()})" if band.any() else "–")
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def main(words: list[str] | None = None) -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dev", action="store_true", help="buildings of the training list")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--scans", type=Path, default=Path("cache/scans"))
    parser.add_argument("--write", type=Path, help="file whose section between the marks is replaced")
    settings = parser.parse_args(words)
    data = Path(os.environ["TOPOMERGE_DATA"]) if os.environ.get("TOPOMERGE_DATA") else None
    rows: list[Row] = []
    for case in cases(settings.dev, data is not None):
        if settings.only in case.name:
            scan = load(case, settings.scans, data)
            posed_scan = scan.cloud.poses is not None
            rows += [{**measured(case, scan, posed), "case": case.name} for posed in ((True, False) if posed_scan else (False,))]
            shown = [f"{r['rooms P before']:.2f} {r['rooms P now']:.2f}" for r in rows if r["case"] == case.name]
            print(case.name, *shown, file=sys.stderr, flush=True)
    command = " ".join(["python -m benchmarks.extraction.entered", *(words if words is not None else sys.argv[1:])])
    print(report(rows, command))
    if settings.write:
        replace_section(settings.write, report(rows, command), ENTERED_MARK)
    return 0


if __name__ == "__main__":
    sys.exit(main())
