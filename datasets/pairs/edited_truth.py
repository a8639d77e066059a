"""Truth from corrections: true rooms, doors and matches out of maps that somebody corrected, and how much there was to correct.

Of each map with a journal that holds, the corrected map becomes a capture of a `pairs.yaml` (`data=folder`), and a truth for the
evaluation of rooms (`evaluate.py task=rooms path=DIR`). Merges that were decided by hand become its pairs.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.merged_truth import TriedPair, write_pairs_file
from topomerge.datasets.pairs.pairs_file import PAIRS_FILE, Capture, PairsFile, Split
from topomerge.datasets.simulation.floor_truth import (
    OUTSIDE_ROOMS,
    TRUTH_CELL,
    TRUTH_MARGIN,
    FloorTruth,
    mask_unseen,
    predict_columns,
)

from topomerge.archive import replace_on_success
from topomerge.edits.apply import EditedMap, apply_edits
from topomerge.edits.journal import JOURNAL_SUFFIX, Edit, find_journal, read_journal, select_effective
from topomerge.errors import InputError
from topomerge.extraction.cleaning import compute_cell_means
from topomerge.extraction.landmarks import load_map_with_landmarks
from topomerge.fusion.decisions import find_decisions, read_merge_listing
from topomerge.io.maps import save_map
from topomerge.structure.floors import build_floor_polygons
from topomerge.types import TopometricMap, TrueRoom, find_room_names

TRUTH_SUFFIX = ".truth.npz"
USUAL_HEIGHT = 2.5  # m, of storeys whose ceiling was not seen
MERGE_FILE = f"merge{JOURNAL_SUFFIX}"


@dataclass(frozen=True)
class EditedTruth:
    """The outcome of a folder: lines of a table, and how many maps, edits, rooms and pairs there are."""

    lines: tuple[str, ...]
    maps: int
    edits: int
    rooms: int
    pairs: int


def build_edited_truth(path: str | Path, output: str | Path) -> EditedTruth:
    """Write what corrected maps teach into a folder.

    Args:
        path: a folder with maps and their journals, also in folders below: of an atlas, of merges.
        output: folder that is written to, made if need be.

    Raises:
        InputError: no such folder, no map with a journal that holds, or the folder can't be written.
    """
    folder, out = Path(path), Path(output)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give one with maps (.tmap) and their journals")
    files = [p for p in sorted(folder.rglob("*.tmap")) if find_journal(p).is_file() and out.resolve() not in p.resolve().parents]
    edited = {file: apply_edits(load_map_with_landmarks(file), read_journal(find_journal(file)).edits) for file in files}
    edited = {file: done for file, done in edited.items() if done.applied}
    names = _name_files(list(edited))
    decisions = [p for p in sorted(folder.rglob(MERGE_FILE)) if p.with_name("merge.json").is_file()]
    if not edited and not decisions:
        raise InputError(f"{folder}: holds no map that was corrected; edit one with `topomerge edit` or `topomerge studio`")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file, done in edited.items():
            with replace_on_success(out / f"{names[file]}.tmap") as temporary:
                save_map(done.map, temporary)
            save_map_truth(done.map, out / f"{names[file]}{TRUTH_SUFFIX}")
        pairs, captures = _collect_pairs(decisions, edited, names, out)
        if any(pair.pose is not None for pair in pairs):
            listing = PairsFile(out / PAIRS_FILE, str(out / PAIRS_FILE), captures, (), Split())
            write_pairs_file(
                listing, {name: load_map_with_landmarks(c.path) for name, c in captures.items()}, pairs, out / PAIRS_FILE
            )
    except OSError as error:
        raise InputError(f"{out}: can't be written ({error.strerror or error}); give another folder") from error
    lines = _format_table(edited, names)
    lines += [f"{pair.a} {pair.b}: {'different' if pair.pose is None else 'one place'}" for pair in pairs]
    rooms, edits = sum(len(d.map.rooms) for d in edited.values()), sum(len(d.applied) for d in edited.values())
    return EditedTruth(tuple(lines), len(edited), edits, rooms, len(pairs))


def _name_files(files: Sequence[Path]) -> dict[Path, str]:
    """Choose a name for each map, its own unless another one has it."""
    taken: Counter[str] = Counter()
    names = {}
    for file in files:
        taken[file.stem] += 1
        names[file] = file.stem if taken[file.stem] == 1 else f"{file.stem}-{taken[file.stem]}"
    return names


def _format_table(edited: Mapping[Path, EditedMap], names: Mapping[Path, str]) -> list[str]:
    """Tabulate the edits a room of each map and of all, the measure in the field, and what was edited."""
    rows = [("map", "rooms", "edits", "a room", "what was edited")]
    ops: Counter[str] = Counter()
    for file, done in edited.items():
        own = Counter(edit.op for edit in done.applied)
        rows.append(_format_counts(names[file], len(done.map.rooms), own))
        ops += own
    rows.append(_format_counts("all", sum(len(done.map.rooms) for done in edited.values()), ops))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ["  ".join([*(word.ljust(wide) for word, wide in zip(row, widths, strict=False)), row[4]]) for row in rows]
    return lines + [f"{names[file]}: {refused}" for file, done in edited.items() for refused in done.refused]


def _format_counts(name: str, rooms: int, ops: Counter[str]) -> tuple[str, str, str, str, str]:
    text = ", ".join(f"{count} {op}" for op, count in sorted(ops.items(), key=lambda one: (-one[1], one[0])))
    return name, str(rooms), str(ops.total()), f"{ops.total() / max(rooms, 1):.2f}", text


def _collect_pairs(
    decisions: Sequence[Path], edited: Mapping[Path, EditedMap], names: Mapping[Path, str], out: Path
) -> tuple[list[TriedPair], dict[str, Capture]]:
    """Return the pairs that somebody decided, and the captures of all pairs; maps without corrections of their own are captures,
    too."""
    corrected = {file.resolve(): out / f"{names[file]}.tmap" for file in edited}
    pairs: dict[tuple[str, str], TriedPair] = {}
    captures: dict[str, Capture] = {}
    for journal in decisions:
        sources = [Path(str(one["source"])) for one in read_merge_listing(journal.parent)["maps"]]
        places = [_find_source(source, journal.parent) for source in sources]
        used = {k for edit in select_effective(read_journal(journal).edits) for k in _list_maps(edit)}
        if any(k >= len(places) for k in used) or None in places[: max(used, default=-1) + 1]:
            continue  # of clouds, or of maps that are gone
        last = max(used, default=-1) + 1
        maps = [replace(load_map_with_landmarks(p), source=str(s)) for p, s in zip(places[:last], sources, strict=False) if p]
        for (i, j), pose in find_decisions(maps, read_journal(journal).edits).poses.items():
            ends = []
            for k in (i, j):
                place = places[k]
                assert place is not None
                file = corrected.get(place.resolve(), place)
                ends.append(next((n for n, c in captures.items() if c.path == file), file.stem))
                captures.setdefault(ends[-1], Capture(ends[-1], file, ""))
            middle = maps[j].grid.compute_centroids().mean(axis=0)
            pairs[ends[0], ends[1]] = TriedPair(ends[0], ends[1], 1.0, pose, middle)
    return list(pairs.values()), captures


def _list_maps(edit: Edit) -> list[int]:
    return [*edit.values.get("maps", (0, edit.values.get("map", 0)))]


def _find_source(source: Path, folder: Path) -> Path | None:
    """Return the .tmap that a merge was made of: as it is named, or beside the folder of the merge."""
    places = (source, folder / source.name, folder.parent / source.name)
    return next((p for p in places if p.suffix.lower() == ".tmap" and p.is_file()), None)


# The truth about rooms.


def save_map_truth(map: TopometricMap, path: Path) -> None:
    """Write the points of a map, one a cell, and its rooms and doors as what is true about them (`evaluation.scans`)."""
    truth, rooms = build_map_truth(map)
    points = compute_cell_means(map.grid)
    shift = points.mean(axis=0).round() if len(points) else np.zeros(3)
    listed = [{"name": r.name, "polygon": np.round(r.polygon, 4).tolist(), "floor": r.floor, "ceiling": r.ceiling} for r in rooms]
    arrays = {"points": (points - shift).astype(np.float32), "shift": shift, "source": np.array(map.source)}
    arrays |= {f"truth.{name}": np.asarray(value) for name, value in vars(truth).items()}
    with replace_on_success(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, rooms=np.array(json.dumps(listed)), **arrays)


def build_map_truth(map: TopometricMap) -> tuple[FloorTruth, tuple[TrueRoom, ...]]:
    """Take the rooms and doors of a map for true.

    Rooms that were only looked into, or are outside, are not expected of an extraction.

    Returns:
        The truth in the frame of the map, and its rooms.

    Raises:
        InputError: a map without rooms.
    """
    if not len(map.rooms):
        raise InputError(f"{map.source or 'map'}: has no rooms, so nothing is true about it; take another map")
    floors = map.storeys["floor"]
    seen = np.where(np.isnan(map.storeys["ceiling"]), floors + USUAL_HEIGHT, map.storeys["ceiling"])
    names = find_room_names(map.landmarks, len(map.rooms))
    rooms = []
    for r, shape in enumerate(build_floor_polygons(map)):
        outline = max(shape.geoms, key=lambda g: g.area).exterior.coords if len(shape.geoms) else [map.rooms["lo"][r][:2]] * 4
        storey = int(map.rooms["storey"][r])
        polygon = np.array(outline, float)[:-1, :2]
        rooms.append(TrueRoom(names[r] or f"room {r}", polygon, float(floors[storey]), float(seen[storey]), storey))
    level = np.isin(map.edges["kind"], ("door", "opening"))
    doors = np.column_stack([map.edges["rooms"], map.edges["centre"]])[level].astype(float).reshape(-1, 5)
    low, high = map.grid.bounds
    rows, columns = np.ceil((high - low + 2 * TRUTH_MARGIN)[1::-1] / TRUTH_CELL).astype(int).tolist()
    truth = FloorTruth(
        raster=np.full((len(floors), rows, columns), OUTSIDE_ROOMS, np.int32),
        origin=low[:2] - TRUTH_MARGIN,
        visited=(map.rooms["entered"] >= 0.5) & (map.rooms["outside"] < 0.5),
        floors=floors.astype(float),
        height=(seen - floors).astype(float),
        doors=doors,
        edges=np.unique(map.edges["rooms"], axis=0).astype(np.int64).reshape(-1, 2),
        matrix=np.eye(4),
        anchors=np.zeros((0, 3)),
        drift=np.zeros((0, 3)),
        complete=np.array(True),
    )
    truth = replace(truth, raster=predict_columns(map, truth))
    return mask_unseen(truth, compute_cell_means(map.grid)), tuple(rooms)
