"""How many edits correct a map: ``python evaluate.py task=edits``.

A simulated user sees the true rooms and doors of a scan and corrects its extracted map, one edit after the other, as somebody
would in the studio: cuts that are missing, rooms that are one, floor that is no room, then doors. Each edit has to bring the map
nearer to the truth, and is applied as any other (`topomerge.edits`). Cuts are straight lines. Minutes of a person are computed,
not timed: the keystroke-level model (Card, Moran and Newell, "The keystroke-level model for user performance time with
interactive systems", CACM 23, 1980) over the studio's own gestures.

``data=homes`` (the default): homes as vacuum robots drew them; ``data=dev``: training buildings. The first ten are taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.simulation.floor_truth import (
    LEAST_SEEN_AREA,
    OUTSIDE_ROOMS,
    TRUTH_CELL,
    FloorTruth,
    evaluate_map,
    predict_columns,
)
from topomerge.edits.apply import apply_edits
from topomerge.edits.draft import find_room_place
from topomerge.edits.journal import Edit, append_edits, find_journal
from topomerge.evaluation.cases import select_cases
from topomerge.evaluation.documents import write_mean, write_table
from topomerge.evaluation.rooms import VOXEL
from topomerge.evaluation.scans import Case, load_scan
from topomerge.evaluation.tasks import Data, Row, TaskSettings, find_optional_data, measure_missing
from topomerge.extraction.extract import extract
from topomerge.io.maps import save_map
from topomerge.metrics import match_places
from topomerge.types import Array, LogFn, TopometricMap

MAKERS = ("topomerge.extraction.extract", "topomerge.edits.apply", "topomerge.evaluation.scans")
LEAST_GAIN = 0.05  # in the sum of the IoU of the true rooms, of an edit of rooms that is worth it
LEAST_PIECE = 1.0  # m2 of a true room in a found one, from which on a user would part them
PIECE_SHARE = 0.2  # of the true room, likewise
ANGLES = np.radians((0.0, 90.0, 45.0, 135.0))  # of lines that are tried, and the one that parts both rooms best
NEAR_LINE = 1.0  # m: the line is as long as the floor this near to it
LEAST_FRAGMENT = 0.25  # m2 of a found room in a true one, from which on it is joined to others there
MOVED_DOOR = 1.5  # m between a wrong door and a missing one, up to which it is moved
MOST_EDITS = 400  # of a map
THINK, POINT, CLICK, KEY = 1.35, 1.1, 0.2, 0.28  # s, operators M, P, BB and K (a good typist) of the keystroke-level model
GESTURES = {  # keys and places that are clicked; joins click each room
    "split_room": (1, 2),
    "join_rooms": (1, 0),
    "set_room": (1, 1),
    "add_door": (1, 1),
    "delete_door": (1, 1),
    "move_door": (1, 2),
}
SHOWN = ("split_room", "join_rooms", "set_room", "add_door", "delete_door", "move_door")
HEADS = ("map", "rooms", "IoU before", "after", "doors P/R before", "after", "edits", "a room", *SHOWN, "minutes")


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        keep: folder for each extracted map with its journal, as `topomerge dataset from-edits` takes them; empty: none. Cases
            that were measured before are corrected again.
    """

    data: Data = field(default_factory=lambda: Data(limit=10))
    keep: str = ""


def list_cases(settings: Settings) -> list[Case]:
    """List the scans that are corrected."""
    cases = [case for case in select_cases((settings.data.set or "homes").split(",")) if settings.data.only in case.name]
    return cases[: settings.data.limit or None]


def list_inputs(settings: Settings) -> list[str]:
    """Return names of the scans."""
    return [case.key for case in list_cases(settings)]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Correct every case."""
    scans, data = Path(settings.cache) / "scans", find_optional_data()
    keep = Path(settings.keep) if settings.keep else None
    items = {f"{case.name} {case.key}": (case, scans, data, keep) for case in list_cases(settings)}
    settings = replace(settings, remake=settings.remake or keep is not None)
    path = Path(settings.cache) / "evaluation" / "edits.jsonl"
    return measure_missing(path, items, measure_case, log_line, settings, compute_code_digest(*MAKERS, __name__))


def measure_case(case: Case, scans: Path, data: Path | None, keep: Path | None = None) -> Row:
    """Extract a case and correct its map; keep map and journal in a folder, where one is given."""
    with limit_threads():
        scan = load_scan(case, scans, data)
        assert scan.truth is not None
        map = extract(scan.cloud, voxel_size=VOXEL)
        edits, corrected = correct_to_truth(map, scan.truth)
        if keep is not None:
            save_corrections(map, edits, keep / f"{Path(case.building).stem}.tmap")
        row: Row = {"case": case.name, "place": case.place, "kind": case.building}
        for name, one in (("before", map), ("after", corrected)):
            scores = evaluate_map(one, scan.truth)
            row |= {f"iou_{name}": scores.rooms.iou, f"recall_{name}": scores.rooms.recall}
            row |= {f"door_precision_{name}": scores.doors.precision, f"door_recall_{name}": scores.doors.recall}
            row |= {"true_rooms": scores.true_rooms}
        counts = Counter(edit.op for edit in edits)
        row |= {"minutes": estimate_minutes(edits, len(map.rooms))}
        row |= {"edits": len(edits), "edits_a_room": len(edits) / max(scores.true_rooms, 1), "ops": dict(counts)}
    return row


def estimate_minutes(edits: Sequence[Edit], rooms: int) -> float:
    """Estimate how long a practised person takes in the studio to look at each room once and to make some edits.

    Each room and each edit takes a thought; the one hand is on the mouse, the other one on the keys. What the person must find
    out about the building is not in it.
    """
    seconds = THINK * rooms
    for edit in edits:
        keys, places = GESTURES[edit.op]
        places += len(edit.values["at"]) if edit.op == "join_rooms" else 0
        seconds += THINK + KEY * keys + (POINT + CLICK) * places
    return seconds / 60


def save_corrections(map: TopometricMap, edits: Sequence[Edit], path: Path) -> None:
    """Write an extracted map, and what was corrected as its journal, which begins anew."""
    path.parent.mkdir(parents=True, exist_ok=True)
    find_journal(path).unlink(missing_ok=True)
    save_map(map, path)
    if edits:
        append_edits(find_journal(path), edits)


def correct_to_truth(map: TopometricMap, truth: FloorTruth) -> tuple[list[Edit], TopometricMap]:
    """Correct a map edit by edit, as somebody would who knows the truth.

    Returns:
        The edits, and the corrected map.
    """
    edits: list[Edit] = []
    for iterate in (_iter_splits, _iter_joins, _iter_outsides):
        while len(edits) < MOST_EDITS:
            before = _sum_overlap(map, truth)
            found = next(_iter_better(map, truth, iterate(map, truth), before, iterate is _iter_outsides), None)
            if found is None:
                break
            edits.append(found[0])
            map = found[1]
    for edit in _list_door_edits(map, truth):
        done = apply_edits(map, [edit])
        edits, map = [*edits, *done.applied], done.map
    return edits, map


def _iter_better(
    map: TopometricMap, truth: FloorTruth, candidates: Iterator[Edit], before: float, always: bool
) -> Iterator[tuple[Edit, TopometricMap]]:
    """Yield those of some edits that apply and bring the rooms nearer to the truth, with the map that each makes."""
    for edit in candidates:
        done = apply_edits(map, [edit])
        if done.applied and (always or _sum_overlap(done.map, truth) >= before + LEAST_GAIN):
            yield edit, done.map


def _sum_overlap(map: TopometricMap, truth: FloorTruth) -> float:
    """Return the sum of the IoU of the true rooms that are expected."""
    scores = evaluate_map(map, truth)
    return float(scores.rooms.iou * scores.true_rooms) if scores.true_rooms else 0.0


def _count_overlap(map: TopometricMap, truth: FloorTruth) -> tuple[Array, Array, Array]:
    """Return (T, R) m2 that each true and each found room share; (T,) m2 of each true room that is expected, else 0; (R,) m2 of
    each found one."""
    columns = predict_columns(map, truth)
    judged = (truth.raster >= 0) | ((truth.raster == OUTSIDE_ROOMS) & (columns >= 0))
    true, found = truth.raster[judged], columns[judged]
    count, rooms = len(truth.visited), len(map.rooms)
    both = (true >= 0) & (found >= 0)
    shared = np.bincount(true[both].astype(np.int64) * max(rooms, 1) + found[both], minlength=count * max(rooms, 1))
    areas = np.bincount(true[true >= 0], minlength=count) * TRUTH_CELL**2
    expected = truth.visited & (areas >= LEAST_SEEN_AREA)
    of_found = np.bincount(found[found >= 0], minlength=rooms) * TRUTH_CELL**2
    return shared.reshape(count, max(rooms, 1)) * TRUTH_CELL**2, np.where(expected, areas, 0.0), of_found


def _iter_splits(map: TopometricMap, truth: FloorTruth) -> Iterator[Edit]:
    """Yield cuts of found rooms that hold pieces of several true ones, those first whose second piece is largest."""
    shared, areas, _ = _count_overlap(map, truth)
    large = (shared >= LEAST_PIECE) & (shared >= PIECE_SHARE * areas[:, None]) & (areas[:, None] > 0)
    rooms = np.flatnonzero(large.sum(axis=0) > 1)
    second = np.sort(np.where(large, shared, 0), axis=0)[-2] if len(shared) > 1 else np.zeros(shared.shape[1])
    columns = predict_columns(map, truth) if len(rooms) else None
    for room in sorted(rooms.tolist(), key=lambda r: -second[r]):
        assert columns is not None
        true = np.flatnonzero(large[:, room])
        place = find_room_place(map, room).tolist()
        for line in _propose_lines(truth, columns == room, true):
            yield Edit("split_room", {"at": place, "line": transform_to_scan(truth, line)[:, :2].tolist()})


def _propose_lines(truth: FloorTruth, room: Array, true: Array) -> list[Array]:
    """Return (2, 3) m, lines that part the pieces of true rooms in a found one, those first that leave the fewest pieces in
    two."""
    level, row, column = np.nonzero(room)
    k = int(np.bincount(level).argmax())
    row, column = row[level == k], column[level == k]
    label = truth.raster[k, row, column]
    places = truth.origin + (np.column_stack([column, row]) + 0.5) * TRUTH_CELL
    inside = np.isin(label, true)
    places, label = places[inside], label[inside]
    middles = np.stack([places[label == t].mean(axis=0) for t in true])
    lines: list[tuple[int, int, Array]] = []
    apart = middles[:, None] - middles[None]
    directions = [*ANGLES, *np.arctan2(apart[..., 1], apart[..., 0])[np.triu_indices(len(true), 1)]]
    for angle in directions:
        normal = np.array([np.cos(angle), np.sin(angle)])
        along = places @ normal
        for cut, torn in _find_cuts(along, label):
            near = places[np.abs(along - cut) <= NEAR_LINE] @ np.array([-normal[1], normal[0]])
            ends = np.array([near.min(), near.max()]) if len(near) else np.array([-1.0, 1.0])
            line = cut * normal + ends[:, None] * np.array([-normal[1], normal[0]])
            lines.append((torn, len(lines), np.column_stack([line, np.full(2, truth.floors[k])])))
    return [line for _, _, line in sorted(lines, key=lambda one: one[:2])[:6]]


def _find_cuts(along: Array, label: Array) -> list[tuple[float, int]]:
    """Return where to cut places along a direction so that few pieces lie on both sides, and how many cells lie wrong then; one
    cut for each two pieces that follow each other."""
    names = sorted(np.unique(label).tolist(), key=lambda t: float(np.median(along[label == t])))
    cuts = []
    for k in range(1, len(names)):
        first = np.isin(label, names[:k])
        order = np.argsort(along, kind="stable")
        wrong = np.cumsum(np.where(first[order], -1, 1)) + int(first.sum())
        best = int(wrong.argmin())
        after = along[order[min(best + 1, len(order) - 1)]]
        cuts.append((float((along[order[best]] + after) / 2), int(wrong[best])))
    return cuts


def _iter_joins(map: TopometricMap, truth: FloorTruth) -> Iterator[Edit]:
    """Yield found rooms that lie mostly in one true room."""
    shared, areas, of_found = _count_overlap(map, truth)
    for t in np.flatnonzero(areas > 0).tolist():
        pieces = [r for r in range(len(of_found)) if shared[t, r] > max(0.5 * of_found[r], LEAST_FRAGMENT)]
        if len(pieces) > 1:
            yield Edit("join_rooms", {"at": [find_room_place(map, r).tolist() for r in pieces]})


def _iter_outsides(map: TopometricMap, truth: FloorTruth) -> Iterator[Edit]:
    """Yield found rooms that count but lie in no true one: a user says that they are outside."""
    shared, _, of_found = _count_overlap(map, truth)
    count = ~(map.rooms["glimpsed"] | (map.rooms["outside"] > 0.5)) & (of_found >= LEAST_SEEN_AREA)
    if not bool(truth.complete):
        return
    for room in np.flatnonzero(count & (shared.sum(axis=0)[: len(count)] < 0.5 * of_found)).tolist():
        yield Edit("set_room", {"at": find_room_place(map, room).tolist(), "outside": True})


def _list_door_edits(map: TopometricMap, truth: FloorTruth) -> list[Edit]:
    """List the doors that are moved, added and deleted."""
    shared, areas, _ = _count_overlap(map, truth)
    own = shared.argmax(axis=1)  # the found room of each true one
    ends = truth.doors[:, :2].astype(np.int64)
    requested = ((ends >= 0) & np.append(areas > 0, False)[ends]).all(axis=1)
    level = np.isin(map.edges["kind"], ("door", "opening"))
    serious = level & ~(map.rooms["glimpsed"] | (map.rooms["outside"] > 0.5))[map.edges["rooms"]].any(axis=1)
    at = truth.transform_to_building(map.edges["centre"])
    candidates = np.flatnonzero(level)
    pairs = match_places(truth.doors[requested, 2:], at[candidates])
    missing = np.setdiff1d(np.flatnonzero(requested), np.flatnonzero(requested)[pairs[:, 0]])
    wrong = np.setdiff1d(np.flatnonzero(serious), candidates[pairs[:, 1]])
    if len(wrong):
        wrong = np.delete(wrong, match_places(truth.doors[~requested, 2:], at[wrong])[:, 1])
    edits: list[Edit] = []
    for d in missing.tolist():
        place = transform_to_scan(truth, truth.doors[d : d + 1, 2:])[0].tolist()
        places = [] if own[ends[d, 0]] == own[ends[d, 1]] else [find_room_place(map, int(own[t])).tolist() for t in ends[d]]
        between = {"between": places} if places else {}
        far = np.hypot(*(at[wrong] - truth.doors[d, 2:])[:, :2].T) if len(wrong) else np.zeros(0)
        if len(far) and far.min() <= MOVED_DOOR:
            edits.append(Edit("move_door", {"at": map.edges["centre"][wrong[far.argmin()]].tolist(), "to": place, **between}))
            wrong = np.delete(wrong, far.argmin())
        else:
            edits.append(Edit("add_door", {"at": place, **between}))
    return edits + [Edit("delete_door", {"at": map.edges["centre"][k].tolist()}) for k in wrong.tolist()]


def transform_to_scan(truth: FloorTruth, places: Array) -> Array:
    """Return (n, 3) places of the building in the frame of the scan, with its drift."""
    back = np.linalg.inv(truth.matrix)
    out = places @ back[:3, :3].T + back[:3, 3]
    if len(truth.anchors):
        out = out - truth.drift[cKDTree(truth.anchors).query(out)[1]]
    return np.asarray(out)


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate each map and all of them."""
    lines = []
    for row in rows:
        doors = [f"{row[f'door_precision_{n}']:.2f} / {row[f'door_recall_{n}']:.2f}" for n in ("before", "after")]
        ious = [f"{row[f'iou_{name}']:.2f}" for name in ("before", "after")]
        counts = [row["ops"].get(op, 0) for op in SHOWN]
        edits = [row["edits"], f"{row['edits_a_room']:.2f}", *counts, f"{row['minutes']:.1f}"]
        lines.append([row["kind"], row["true_rooms"], *ious, *doors, *edits])
    minutes = sum(row["minutes"] for row in rows)
    rooms, n_edits = (sum(row[name] for row in rows) for name in ("true_rooms", "edits"))
    text = (
        f"{len(rows)} maps with {rooms} true rooms: {n_edits} edits, {n_edits / max(rooms, 1):.2f} a room "
        f"(mean over maps {write_mean(rows, 'edits_a_room')}), {minutes:.1f} minutes. "
        f"Mean IoU {write_mean(rows, 'iou_before')} before and {write_mean(rows, 'iou_after')} after."
    )
    name = (settings.data.set or "homes").replace(",", "-")
    return {"corrections" if name == "homes" else f"corrections-{name}": f"{text}\n\n{write_table(HEADS, lines)}"}
