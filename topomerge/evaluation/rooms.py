"""Rooms, doors, edges and storeys of extracted maps against the truth: ``python evaluate.py task=rooms data=homes``.

Sets: ``dev`` (training buildings, to develop on; the default), ``homes`` and ``marked`` (for development), ``all`` or some of
``simulated``, ``hard``, ``plans``, ``grids``, ``ifc``, ``pairs``, ``look`` (test buildings). A row is measured again when
the scan, the preset or the code has changed. The measures are in `topomerge/metrics.py` and `datasets/simulation/floor_truth.py`.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.pairs.edited_truth import TRUTH_SUFFIX
from topomerge.datasets.simulation.floor_truth import evaluate_map, predict_columns
from topomerge.errors import InputError
from topomerge.evaluation.cases import GROUPS, MARKS, SELECTIONS, select_cases
from topomerge.evaluation.documents import compute_mean, write_mean, write_table
from topomerge.evaluation.scans import EDITED_SOURCE, Case, Scan, load_scan
from topomerge.evaluation.tasks import Row, TaskSettings, find_optional_data, limit_cases, measure_missing
from topomerge.extraction.attributes import find_rooms_at
from topomerge.extraction.extract import extract
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.zones import cut_zones
from topomerge.io.listing import describe_room
from topomerge.types import LogFn, TopometricMap

MAKERS = ("topomerge.extraction.extract", "topomerge.metrics", "topomerge.evaluation.scans")
VOXEL = 0.1  # m, edge of the cells
NAN = float("nan")
NOTHING: Row = {
    "iou": 0.0, "mcc": 0.0, "precision": NAN, "recall": 0.0, "door_precision": NAN, "door_recall": 0.0, "edge_precision": NAN,
    "edge_recall": 0.0, "storeys": 0.0,
}  # fmt: skip
COLUMNS = {
    "iou": "IoU", "mcc": "MCC", "precision": "P", "recall": "R", "door_precision": "doors P", "door_recall": "doors R",
    "edge_precision": "edges P", "edge_recall": "edges R", "storeys": "storeys", "seconds": "s",
}  # fmt: skip
WITH_INTERVAL = ("iou", "mcc")
FAILED = 0.5  # mean IoU
ZONED = ("home", "ipa", "gdc")  # sources of real grids, whose zones are scored beside their rooms
STATES = ("room", "glimpsed", "outside", "no room")  # what a map says of a marked place
LISTED = ("dev", "homes", "grids", "look")  # sets whose cases are listed
HEADLINES = {  # set of cases -> figure of the README
    "ordinary": "rooms-simulated",
    "grids, bare": "rooms-grids",
    "grids, furnished": "rooms-grids-furnished",
    "homes of vacuum robots": "rooms-homes",
}


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        presets: of the extraction.
        pictures: draw each case into ``<folder>/pictures``.
        fresh: make the scans again: the simulator has changed.
        path: a folder of `topomerge dataset from-edits`, whose maps are measured in place of a set.
    """

    presets: str = "default"
    pictures: bool = False
    fresh: bool = False
    path: str = ""


def list_cases(settings: Settings) -> list[Case]:
    """List the cases of the sets.

    Raises:
        InputError: there is no such set.
    """
    if settings.path:
        return _list_edited_cases(settings)
    names = (settings.data.set or "dev").split(",")
    known = [*GROUPS, *SELECTIONS, "all"]
    if unknown := set(names) - set(known):
        raise InputError(f"data.set={','.join(sorted(unknown))}: {', '.join(known)} are possible")
    return [case for case in select_cases(names, settings.data.limit or None) if settings.data.only in case.name]


def _list_edited_cases(settings: Settings) -> list[Case]:
    """Return the corrected maps of a folder."""
    files = sorted(Path(settings.path).glob(f"*{TRUTH_SUFFIX}"))
    if settings.data.set or not files:
        reason = "is for corrected maps; leave data out" if settings.data.set else f"holds no *{TRUTH_SUFFIX}"
        raise InputError(f"path={settings.path}: {reason} (topomerge dataset from-edits makes such a folder)")
    cases = [Case("corrected maps", EDITED_SOURCE, str(file), seed=zlib.crc32(file.read_bytes())) for file in files]
    return limit_cases(cases, settings)


def list_inputs(settings: Settings) -> list[str]:
    """Return names of the scans."""
    return [f"{case.key} {settings.presets}" for case in list_cases(settings)]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure every case with every preset.

    Raises:
        InputError: no such preset.
    """
    presets, cases = settings.presets.split(","), list_cases(settings)
    if unknown := set(presets) - set(PRESETS):
        raise InputError(f"presets={','.join(sorted(unknown))}: {', '.join(PRESETS)} are possible")
    scans, data = Path(settings.cache) / "scans", find_optional_data()
    for case in cases if settings.fresh else ():
        (scans / f"{case.key}.npz").unlink(missing_ok=True)
    pictures = str(Path(settings.folder) / "pictures") if settings.pictures else ""
    items = {f"{case.name} {case.key} {p}{pictures and ' drawn'}": (case, p, scans, data, pictures)
             for case in cases for p in presets}  # fmt: skip
    path = Path(settings.cache) / "evaluation" / "rooms.jsonl"
    return measure_missing(
        path, items, measure_case, log_line, settings, compute_code_digest(*MAKERS, __name__) + digest_presets(presets)
    )


def digest_presets(presets: Sequence[str]) -> str:
    """Write the parameters of presets as one short word."""
    from topomerge.evaluation.documents import digest_inputs

    return "-" + digest_inputs(f"{name} {asdict(PRESETS[name])}" for name in presets)


def measure_case(case: Case, preset: str, scans: Path, data: Path | None, pictures: str) -> Row:
    """Extract a case in this process and compare the map with the truth."""
    row: Row = {"case": case.name, "set": case.set, "place": case.place, "kind": case.building, "preset": preset, "error": ""}
    with limit_threads():
        load_compiled(preset)
        try:
            scan = load_scan(case, scans, data)
        except Exception as error:
            return {**row, "missing": f"{type(error).__name__}: {error}"}
        began = process_time()
        try:
            extracted = extract(scan.cloud, preset=preset, voxel_size=VOXEL)
        except Exception as error:  # a map that fails altogether counts as nothing found
            row |= {"error": f"{type(error).__name__}: {error}", "seconds": process_time() - began}
            return row if scan.truth is None else {**row, **NOTHING}
        row |= {"seconds": process_time() - began, "found": int((~extracted.rooms["glimpsed"]).sum())}
        row |= {"points": len(scan.cloud), "levels_found": len(extracted.storeys)}
        picture = Path(pictures) / f"{case.name}-{preset}.png" if pictures else None
        if case.building in MARKS:
            row |= {"marks": count_marks(extracted, MARKS[case.building])}
        if scan.truth is not None:
            row |= score_map(scan, extracted, f"{case.name}  {preset}", picture, case.source in ZONED)
        elif picture:
            from topomerge.viz.figures import save_figure

            picture.parent.mkdir(parents=True, exist_ok=True)
            save_figure(extracted, picture)
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}


def count_marks(map: TopometricMap, marks: Mapping[str, Sequence[tuple[float, float]]]) -> dict[str, dict[str, int]]:
    """Count, of each kind of marked places, how many lie in a room, in what is outside or only looked into, and in no room.

    Args:
        marks: kind -> places (x, y), m.
    """
    floor = float(map.storeys["floor"][0]) if len(map.storeys) else 0.0
    counts = {}
    for kind, places in marks.items():
        room = find_rooms_at(map, np.column_stack([np.array(places, float), np.full(len(places), floor)]))
        about = [map.rooms[r] if r >= 0 else None for r in room.tolist()]
        states = ["no room" if a is None else next((w for w in describe_room(a) if w in STATES), "room") for a in about]
        counts[kind] = {state: states.count(state) for state in STATES}
    return counts


@cache
def load_compiled(preset: str) -> None:
    """Load what is compiled, so that the first map's seconds are like the others'."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 4, 0.05), np.arange(0, 4, 0.05)))
    box = [np.column_stack([x, y, np.full(len(x), z)]) for z in (0.0, 2.5)]
    box += [np.column_stack([np.full(len(x), z), x, 2.5 / 4 * y]) for z in (0.0, 4.0)]
    with suppress(InputError):
        extract(np.concatenate([*box, *(b[:, [1, 0, 2]] for b in box[2:])]), preset=preset)


def score_map(scan: Scan, extracted: Any, name: str, picture: Path | None, zones: bool = False) -> Row:
    """Score the rooms, doors, edges and storeys of a map, and its zones where asked; draw them where a file is named."""
    assert scan.truth is not None
    columns = predict_columns(extracted, scan.truth)
    verdict = evaluate_map(extracted, scan.truth, columns)
    rooms, doors, edges = verdict.rooms, verdict.doors, verdict.edges
    row: Row = {"iou": rooms.iou, "mcc": rooms.mcc, "precision": rooms.precision, "recall": rooms.recall}
    row |= {"door_precision": doors.precision, "door_recall": doors.recall}
    row |= {"edge_precision": edges.precision, "edge_recall": edges.recall, "storeys": float(verdict.storeys)}
    row |= {"rooms": verdict.true_rooms, "doors": doors.true, "levels": verdict.true_storeys}
    if zones:
        finer = cut_zones(extracted)
        zoned = evaluate_map(finer, scan.truth).rooms
        row |= {"zones": len(finer.rooms), "zone_iou": zoned.iou}
        row["better_iou"] = float(np.maximum(rooms.each, zoned.each).sum() / max(verdict.true_rooms, 1))
    order = [i for i in np.argsort(rooms.each, kind="stable") if scan.truth.visited[i]][:4]
    row["worst"] = {scan.rooms[i].name or str(i): round(float(rooms.each[i]), 2) for i in order}
    if picture:
        from topomerge.evaluation.scans import save_picture

        title = f"{name}: IoU {rooms.iou:.2f}, MCC {rooms.mcc:.2f}, doors {doors.precision:.2f}/{doors.recall:.2f}"
        title = f"{title}, rooms {verdict.found_rooms}/{verdict.true_rooms}"
        save_picture(scan, extracted, columns, verdict, title, picture)
    return row


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate sets and kinds of buildings, presets beside each other, and list what failed; or each case where that is few."""
    rows = [r for r in rows if not r.get("missing")]
    judged = [r for r in rows if "iou" in r]
    name = settings.data.set or "dev"
    block = {"all": "extraction"}.get(name, name.replace(",", "-")) if settings.presets == "default" else "thesis"
    parts = [count_places(judged), tabulate_groups(judged, "set", "set")] if judged or name != "marked" else []
    simulated = [r for r in judged if r["set"].startswith("by ")]
    if simulated:
        parts += ["The same simulated buildings by kind:", tabulate_groups(simulated, "kind", "building")]
    if any("zone_iou" in r for r in judged):
        parts += [
            "Two cuts of one tree: rooms, and their zones. Better: of each true room the better of the two.",
            tabulate_levels(judged),
        ]
    if any("marks" in r for r in rows):
        parts.append(tabulate_marks(rows))
    if name in LISTED:
        parts.append(tabulate_cases(rows))
    return {block: "\n\n".join([*parts, *([list_failures(judged)] if judged or name != "marked" else [])])}


def count_places(rows: Sequence[Row]) -> str:
    """Say how many maps of how many buildings there are."""
    return f"{len({r['case'] for r in rows})} maps of {len({r['place'] for r in rows})} physical buildings."


def tabulate_groups(rows: Sequence[Row], key: str, title: str) -> str:
    """Tabulate means over the maps of each group, a line a preset."""
    lines = []
    for group, preset in dict.fromkeys((r[key], r["preset"]) for r in rows):
        these = [r for r in rows if (r[key], r["preset"]) == (group, preset)]
        means = [write_mean(these, k) if k in WITH_INTERVAL else compute_mean(these, k) for k in COLUMNS]
        lines.append([group, preset, len(these), *means])
    return write_table((title, "preset", "maps", *COLUMNS.values()), lines)


def tabulate_levels(rows: Sequence[Row]) -> str:
    """Tabulate the IoU of rooms, of their zones, and of the better of the two for each true room."""
    lines = []
    for group, preset in dict.fromkeys((r["set"], r["preset"]) for r in rows if "zone_iou" in r):
        these = [r for r in rows if (r["set"], r["preset"]) == (group, preset)]
        lines.append([group, preset, len(these), *(write_mean(these, key) for key in ("iou", "zone_iou", "better_iou"))])
    return write_table(("set", "preset", "maps", "IoU of rooms", "of zones", "of the better"), lines)


def tabulate_marks(rows: Sequence[Row]) -> str:
    """Tabulate what maps say of the places that were told apart by eye."""
    lines = []
    for kind, title in (("fan", "fans of rays"), ("letter", "painted letters"), ("room", "rooms")):
        counts = [r["marks"][kind] for r in rows if kind in r.get("marks", {})]
        lines.append([title, sum(sum(c.values()) for c in counts), *(sum(c[state] for c in counts) for state in STATES)])
    return write_table(("marked as", "places", "a room", "only looked into", "outside", "no room"), lines)


def tabulate_cases(rows: Sequence[Row]) -> str:
    """Tabulate each case."""
    lines = []
    for row in rows:
        values = [f"{row[k]:.2f}" if k in row and np.isfinite(row[k]) else "–" for k in COLUMNS]
        lines.append([row["case"], row["preset"], f"{row.get('found', 0)}/{row.get('rooms', '?')}", *values, row["error"][:60]])
    return write_table(("case", "preset", "rooms", *COLUMNS.values(), ""), lines)


def list_failures(rows: Sequence[Row]) -> str:
    """List the maps with a mean IoU below `FAILED`, the worst first, and those with wrong storeys."""
    bad = sorted((r for r in rows if r["iou"] < FAILED), key=lambda r: r["iou"])
    lines = [f"Mean IoU below {FAILED}: {len(bad)} maps."]
    for row in bad:
        why = row["error"] or ", ".join(f"{name} {iou:.2f}" for name, iou in row.get("worst", {}).items())
        counts = f"{row.get('found', 0)} rooms found of {row.get('rooms', '?')}"
        lines.append(f"- {row['case']} ({row['preset']}): {row['iou']:.2f} ({counts}; {why})")
    wrong = [r for r in rows if not r["storeys"] and not r["error"]]
    storeys = [f"{r['case']} ({r['levels_found']} instead of {r['levels']})" for r in wrong]
    return "\n".join([*lines, *([f"\nStoreys wrong: {'; '.join(storeys)}."] if wrong else [])])


def compute_headline(rows: Sequence[Row], settings: Settings) -> dict[str, tuple[str, str]]:
    """Compute the mean IoU of the sets that the README shows."""
    out = {}
    for name, figure in HEADLINES.items():
        these = [r for r in rows if r["set"] == name and r["preset"] == "default" and "iou" in r]
        if these:
            out[figure] = write_mean(these, "iou"), f"{len(these)} maps"
    return out
