"""One case of the extraction's benchmark: the map is made and judged, by a preset or by a classic method on its grid."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from topomerge.datasets.simulation.floor_truth import Truth, Verdict

from benchmarks.extraction.agree import keep
from benchmarks.extraction.classic import METHODS
from benchmarks.extraction.occupancy import floor_grids, judged, segmented, survey_scores
from benchmarks.extraction.scans import Case, Scan, load
from topomerge.types import Array

Row = dict[str, Any]
NAN = float("nan")
NOTHING: Row = {
    "iou": 0.0, "mcc": 0.0, "precision": NAN, "recall": 0.0, "door_precision": NAN, "door_recall": 0.0, "edge_precision": NAN,
    "edge_recall": 0.0, "storeys": 0.0,
}  # fmt: skip


def measure(case: Case, preset: str, key: str, scans: Path, data: Path | None, out: Path, picture: bool) -> Row:
    """Run a case in this process."""
    from topomerge.datasets.core.builder import one_thread

    row: Row = {"key": key, "preset": preset, "picture": picture, "error": ""}
    with one_thread():
        warm(preset)
        try:
            scan = load(case, scans, data)
        except Exception as error:
            return {**row, "key": "", "missing": f"{type(error).__name__}: {error}"}
        row["points"] = len(scan.cloud)
        if preset in METHODS:
            return _rounded({**row, **_peer_measured(scan, preset, case, out if picture else None)})
        return _rounded({**row, **_measured(scan, preset, case, out, picture, key)})


@cache
def warm(preset: str) -> None:
    """Load what is compiled, so that the first map's seconds are like the others'."""
    from topomerge.errors import InputError
    from topomerge.extraction.extract import extract

    if preset in METHODS:
        return
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 4, 0.05), np.arange(0, 4, 0.05)))
    box = [np.column_stack([x, y, np.full(len(x), z)]) for z in (0.0, 2.5)]
    box += [np.column_stack([np.full(len(x), z), x, 2.5 / 4 * y]) for z in (0.0, 4.0)]
    with suppress(InputError):
        extract(np.concatenate([*box, *(b[:, [1, 0, 2]] for b in box[2:])]), preset=preset)


def _measured(scan: Scan, preset: str, case: Case, out: Path, picture: bool, key: str) -> Row:
    from topomerge.extraction.extract import extract

    began = process_time()
    try:
        extracted = extract(scan.cloud, preset=preset, voxel_size=case.voxel)
    except Exception as error:  # a map that fails altogether counts as nothing found
        row = {"error": f"{type(error).__name__}: {error}", "seconds": process_time() - began}
        return row if scan.truth is None else {**NOTHING, **row}
    row = {"seconds": process_time() - began, "found": int((~extracted.rooms["glimpsed"]).sum())}
    row |= {"doors_found": len(extracted.edges), "levels_found": len(extracted.storeys)}
    path = out / "pictures" / f"{case.name}-{preset}.png"
    if scan.truth is None:
        if picture:
            from topomerge.viz.figures import save_figure

            path.parent.mkdir(parents=True, exist_ok=True)
            save_figure(extracted, path)
        return row
    return {**row, **_judged(scan, extracted, f"{case.name}  {preset}", path if picture else None, out / "said" / f"{key}.npz")}


def _peer_measured(scan: Scan, method: str, case: Case, picture_to: Path | None) -> Row:
    """A classic method on the scan's grids; it has neither doors nor storeys to be judged by."""
    if scan.truth is None:
        return {"missing": "nothing is true about it"}
    began = process_time()
    grids = floor_grids(scan)
    columns, count = segmented(scan, method, grids)
    row: Row = {"seconds": process_time() - began, "found": count}
    verdict = judged(scan.truth, columns, count)
    if picture_to is not None:
        from benchmarks.extraction.picture import save_columns

        title = f"{case.name}  {method}: IoU {verdict.rooms.iou:.2f}, rooms {count}/{verdict.true_rooms}"
        save_columns(scan, columns, title, picture_to / "pictures" / f"{case.name}-{method}.png")
    return row | _room_row(scan.truth, columns, verdict)


def _room_row(truth: Truth, columns: Array, verdict: Verdict) -> Row:
    rooms = verdict.rooms
    row: Row = {"iou": rooms.iou, "mcc": rooms.mcc, "precision": rooms.precision, "recall": rooms.recall}
    row["survey_precision"], row["survey_recall"] = survey_scores(truth, columns)
    return row | {"rooms": verdict.true_rooms}


def _judged(scan: Scan, extracted: Any, name: str, picture: Path | None, said_to: Path) -> Row:
    from topomerge.datasets.simulation.floor_truth import judge, said

    assert scan.truth is not None
    columns = said(extracted, scan.truth)
    keep(said_to, columns, scan.truth)
    verdict = judge(extracted, scan.truth, columns)
    rooms, doors, edges = verdict.rooms, verdict.doors, verdict.edges
    row = _room_row(scan.truth, columns, verdict)
    row |= {"door_precision": doors.precision, "door_recall": doors.recall}
    row |= {"edge_precision": edges.precision, "edge_recall": edges.recall, "storeys": float(verdict.storeys)}
    row |= {"doors": doors.true, "levels": verdict.true_storeys}
    order = [i for i in np.argsort(rooms.each, kind="stable") if scan.truth.visited[i]][:4]
    row["worst"] = {scan.rooms[i].name or str(i): round(float(rooms.each[i]), 2) for i in order}
    if picture:
        from benchmarks.extraction.picture import save

        title = f"{name}: IoU {rooms.iou:.2f}, MCC {rooms.mcc:.2f}, doors {doors.precision:.2f}/{doors.recall:.2f}"
        save(scan, extracted, columns, verdict, f"{title}, rooms {verdict.found_rooms}/{verdict.true_rooms}", picture)
    return row


def _rounded(row: Row) -> Row:
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}
