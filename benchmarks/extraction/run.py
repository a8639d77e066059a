"""The extraction against the truth: rooms, doors, graph, storeys, consistency and seconds, on maps that set no weight.

``python -m benchmarks.extraction.run --dev`` runs the small set for development (training buildings only), ``--set all``
everything
else, ``--quick`` two cases of each set. Scans are made once and kept under ``cache/scans/`` (``--fresh`` makes them again). Each
case gives a line of ``OUT/results.jsonl``; it is run again only when its scan, the preset or the code has changed.
``--write docs/results/rooms.md`` writes the tables there. The definitions are in `topomerge/metrics.py` and
`datasets/simulation/floor_truth.py`.
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
from typing import Any

from benchmarks.extraction.agree import with_agreement
from benchmarks.extraction.cases import GROUPS, SELECTIONS, chosen
from benchmarks.extraction.classic import METHODS
from benchmarks.extraction.measure import Row, measure
from benchmarks.extraction.scans import Case
from benchmarks.extraction.tables import listing, summary, write
from topomerge.code_digest import code_digest

ROOT = Path(__file__).parent.parent.parent
MAKERS = tuple(f"topomerge.{name}" for name in ("extraction.extract", "metrics", "datasets.simulation.floor_truth"))  # of a row


def key_of(case: Case, preset: str, code: str) -> str:
    """What a line of results is found by."""
    from topomerge.extraction.parameters import PRESETS

    varied = [case.thin, case.turn, case.shuffle, case.voxel]
    inputs = [case.key, varied, preset if preset in METHODS else asdict(PRESETS[preset]), code]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:20]


def _peer_code() -> str:
    """What the rows of classic methods depend on: their own files, and the judge's."""
    files = (Path(__file__).parent / f"{name}.py" for name in ("classic", "occupancy", "voronoi_graph"))
    own = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    return own + code_digest(*MAKERS[1:])


def run(tasks: list[tuple[Any, ...]], jobs: int) -> Iterator[tuple[int, Row]]:
    """Numbers of tasks and their rows, as they come."""
    if jobs == 1:
        for n, task in enumerate(tasks):
            yield n, measure(*task)
        return
    from joblib import Parallel, delayed

    work = (delayed(_numbered)(n, *t) for n, t in enumerate(tasks))
    yield from Parallel(jobs, return_as="generator_unordered", batch_size=1, pre_dispatch=jobs)(work)


def _numbered(number: int, *task: Any) -> tuple[int, Row]:
    return number, measure(*task)


def cached_rows(path: Path) -> dict[str, Row]:
    """Lines of earlier runs by their keys."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["key"]: row for row in map(json.loads, lines)}


def results(cases: list[Case], presets: list[str], settings: argparse.Namespace) -> list[Row]:
    """A row for each case and preset; those that are missing are made now."""
    out, scans, code = Path(settings.out), Path(settings.scans), code_digest(*MAKERS)
    out.mkdir(parents=True, exist_ok=True)
    rows_by_key = cached_rows(out / "results.jsonl")
    if settings.fresh:
        rows_by_key = {}
        for key in {case.key for case in cases}:
            (scans / f"{key}.npz").unlink(missing_ok=True)
    data = Path(os.environ["TOPOMERGE_DATA"]) if os.environ.get("TOPOMERGE_DATA") else None
    codes = {preset: _peer_code() if preset in METHODS else code for preset in presets}
    wanted = [(case, preset, key_of(case, preset, codes[preset])) for case in cases for preset in presets]
    missing = [w for w in wanted if w[2] not in rows_by_key or (settings.pictures and not rows_by_key[w[2]].get("picture"))]
    missing = list({w[2]: w for w in missing}.values())
    with (out / "results.jsonl").open("a", encoding="utf-8") as file:
        for done, (n, row) in enumerate(run([(*w, scans, data, out, settings.pictures) for w in missing], settings.jobs), 1):
            case, preset, key = missing[n]
            print(f"# {done}/{len(missing)} {case.name} {preset} {_short(row)}", file=sys.stderr, flush=True)
            rows_by_key[key] = row
            if row["key"]:
                file.write(json.dumps(row) + "\n")
                file.flush()
    empty_about = {"set": "", "case": "", "place": "", "sensor": "", "kind": "", "scan": "", "day": 0}
    about = [
        empty_about | {"set": c.set, "case": c.name, "place": c.place, "kind": c.building, "scan": c.key, "day": c.day}
        for c, _, _ in wanted
    ]
    return with_agreement([{**rows_by_key[w[2]], **a, "key": w[2]} for w, a in zip(wanted, about, strict=True)], out)


def _short(row: Row) -> str:
    if row.get("missing") or row.get("error"):
        return str(row.get("missing") or row["error"])[:160]
    if "iou" not in row:
        return f"{row['found']} rooms, {row['seconds']:.1f} s"
    doors = f"{row['door_precision']:.2f}/{row['door_recall']:.2f}" if "door_precision" in row else "–"
    return f"IoU {row['iou']:.3f} MCC {row['mcc']:.3f} doors {doors} {row['seconds']:.1f} s"


def arguments(words: list[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*GROUPS, *SELECTIONS, "all"]
    parser.add_argument("--set", nargs="+", choices=names, default=[], help="groups of cases; all: all but dev")
    parser.add_argument("--dev", action="store_true", help="the set for development (the default)")
    parser.add_argument("--preset", default="default", help="presets, or classic methods, with commas between them")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, help="so many cases of each set")
    parser.add_argument("--quick", action="store_true", help="two cases of each set")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--out", default=str(ROOT / "cache" / "extraction"))
    parser.add_argument("--scans", default=str(ROOT / "cache" / "scans"))
    parser.add_argument("--pictures", action="store_true", help="a picture of each case, into OUT/pictures")
    parser.add_argument("--fresh", action="store_true", help="make the scans again: the simulator has changed")
    parser.add_argument("--write", type=Path, help="file whose section between the marks of the extraction is replaced")
    parser.add_argument("--mark", default="extraction", help="name of that section's marks")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> int:
    settings = arguments(words)
    names = [*settings.set, *(["dev"] if settings.dev or not settings.set else [])]
    cases = [c for c in chosen(names, 2 if settings.quick else settings.limit) if settings.only in c.name]
    rows = results(cases, settings.preset.split(","), settings)
    print(listing(rows), summary(rows), sep="\n\n")
    if settings.write:
        command = " ".join(["python -m benchmarks.extraction.run", *(words if words is not None else sys.argv[1:])])
        write(settings.write, rows, command, settings.mark)
    return 0


if __name__ == "__main__":
    sys.exit(main())
