"""The extraction against the truth: rooms, doors, graph, storeys and seconds, on scans that nobody tuned it to.

``python benchmarks/extraction.py --dev`` runs the small set for development (training buildings only), ``--set NAME ...`` others.
Scans are kept under ``cache/scans/``; a line a case goes to ``OUT/results.jsonl``, and a case is run again only when its scan,
the preset or the code has changed. The definitions are in `topomerge/metrics.py` and `datasets/judge.py`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import numpy as np
from extraction_cases import SETS
from extraction_scans import Case, load
from extraction_tables import markdown

ROOT = HERE.parent
CODE = ("topomerge/extraction", "topomerge/kernels", "topomerge/metrics.py", "topomerge/types.py", "datasets/judge.py")
Row = dict[str, Any]


def code_hash() -> str:
    """Of all that the numbers depend on beside the scan."""
    files = [f for name in CODE for f in (sorted((ROOT / name).rglob("*.py")) if (ROOT / name).is_dir() else [ROOT / name])]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def key_of(case: Case, preset: str, code: str) -> str:
    """What a line of results is found by."""
    from topomerge.extraction.extract import PRESETS

    inputs = [case.key, asdict(PRESETS[preset]), code]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:20]


def measure(case: Case, preset: str, key: str, scans: Path, data: Path | None, out: Path, picture: bool) -> Row:
    """Run a case in this process."""
    from topomerge.datasets.example import one_thread

    row: Row = {"key": key, "set": case.set, "case": case.name, "place": case.place, "sensor": case.sensor, "preset": preset}
    with one_thread():
        try:
            scan = load(case, scans, data)
        except Exception as error:
            return {**row, "key": "", "error": f"no scan: {type(error).__name__}: {error}"}
        row["points"] = len(scan.cloud)
        return {**row, **_scored(scan, preset, case, out, picture)}


def _scored(scan: Any, preset: str, case: Case, out: Path, picture: bool) -> Row:
    from topomerge.datasets.judge import judge, said
    from topomerge.extraction.extract import extract

    began = perf_counter()
    try:
        found = extract(scan.cloud, preset=preset)
    except Exception as error:  # a map that fails altogether counts as nothing found
        return {**NOTHING, "error": f"{type(error).__name__}: {error}", "seconds": perf_counter() - began, "picture": picture}
    row: Row = {"seconds": round(perf_counter() - began, 3), "picture": picture, "error": ""}
    columns = said(found, scan.truth)
    verdict = judge(found, scan.truth, columns)
    rooms, doors, edges = verdict.rooms, verdict.doors, verdict.edges
    row |= {"iou": rooms.iou, "mcc": rooms.mcc, "precision": rooms.precision, "recall": rooms.recall}
    row |= {"door_precision": doors.precision, "door_recall": doors.recall}
    row |= {"edge_precision": edges.precision, "edge_recall": edges.recall, "storeys": float(verdict.storeys)}
    row |= {"rooms": verdict.true_rooms, "found": verdict.found_rooms, "doors": doors.true, "doors_found": doors.found}
    row |= {"levels": verdict.true_storeys, "levels_found": verdict.found_storeys}
    row["worst"] = {scan.rooms[i].name: round(float(rooms.each[i]), 2) for i in np.argsort(rooms.each)[:5] if scan.truth.visited[i]}
    if picture:
        from extraction_picture import save

        title = f"{case.name}  {preset}: IoU {rooms.iou:.2f}, MCC {rooms.mcc:.2f}, doors {doors.precision:.2f}/{doors.recall:.2f}"
        title += f", rooms {verdict.found_rooms}/{verdict.true_rooms}, {row['seconds']:.1f} s"
        save(scan, found, columns, verdict, title, out / "pictures" / f"{case.name}-{preset}.png")
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}


NOTHING: Row = {
    "iou": 0.0, "mcc": 0.0, "precision": float("nan"), "recall": 0.0, "door_precision": float("nan"), "door_recall": 0.0,
    "edge_precision": float("nan"), "edge_recall": 0.0, "storeys": 0.0,
}  # fmt: skip


def run(tasks: list[tuple[Any, ...]], jobs: int) -> Iterator[Row]:
    """Rows as they come."""
    if jobs == 1:
        for task in tasks:
            yield measure(*task)
        return
    from joblib import Parallel, delayed

    yield from Parallel(jobs, return_as="generator_unordered", batch_size=1, pre_dispatch=jobs)(delayed(measure)(*t) for t in tasks)


def known_rows(path: Path) -> dict[str, Row]:
    """Lines of earlier runs by their keys."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["key"]: row for row in map(json.loads, lines)}


def results(cases: list[Case], presets: list[str], settings: argparse.Namespace) -> list[Row]:
    """A row for each case and preset, those that are missing made now."""
    out, code = Path(settings.out), code_hash()
    out.mkdir(parents=True, exist_ok=True)
    known = known_rows(out / "results.jsonl")
    data = Path(os.environ["TOPOMERGE_DATA"]) if os.environ.get("TOPOMERGE_DATA") else None
    scans = Path(settings.scans)
    wanted = [(case, preset, key_of(case, preset, code)) for case in cases for preset in presets]
    missing = [w for w in wanted if w[2] not in known or (settings.pictures and not known[w[2]].get("picture"))]
    tasks = [(*w, scans, data, out, settings.pictures) for w in missing]
    rows = {}
    with (out / "results.jsonl").open("a", encoding="utf-8") as file:
        for n, row in enumerate(run(tasks, settings.jobs), 1):
            print(f"# {n}/{len(tasks)} {row['case']} {row['preset']} {_short(row)}", file=sys.stderr, flush=True)
            if row["key"]:
                file.write(json.dumps(row) + "\n")
                file.flush()
            rows[row["case"], row["preset"]] = row
    found = [rows.get((case.name, preset)) or known[key] for case, preset, key in wanted]
    return [{**row, "set": case.set, "case": case.name} for row, (case, _, _) in zip(found, wanted, strict=True)]


def _short(row: Row) -> str:
    if row.get("error"):
        return str(row["error"])[:120]
    return f"IoU {row['iou']:.3f} MCC {row['mcc']:.3f} doors {row['door_precision']:.2f}/{row['door_recall']:.2f} {row['seconds']:.1f} s"


def arguments(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", nargs="+", choices=sorted(SETS), default=[], help="sets of cases")
    parser.add_argument("--dev", action="store_true", help="the set for development")
    parser.add_argument("--preset", default="default", help="one or more presets, with commas between them")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, help="so many cases of each set")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--out", default=str(ROOT / "cache" / "extraction"))
    parser.add_argument("--scans", default=str(ROOT / "cache" / "scans"))
    parser.add_argument("--pictures", action="store_true")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    settings = arguments(words)
    names = settings.set or ["dev"]
    cases = [c for name in names for c in SETS[name]()[: settings.limit] if settings.only in c.name]
    rows = results(cases, settings.preset.split(","), settings)
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
