"""Truth about captures that nobody measured: what the program itself believes of each two of them, by their geometry.

Each two captures are registered by their walls. Believed are poses of probability .99 or more. Of three or more captures that
hang together, a pair is kept if the poses of the others lead to the same place: poses are closed in cycles. What is kept is
written as a `pairs.yaml`. Rooms' descriptors take no part, so that they can learn from it.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from topomerge.datasets.pairs.own_pairs import OWN_FOLDER, extract_captures
from topomerge.datasets.pairs.pairs_file import PAIRS_FILE, Capture, PairsFile, PairTruth, Split, find_overlap, read_pairs_file

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.fusion.atlas.pairs import is_same_pose
from topomerge.io.maps import load_map
from topomerge.io.points import OCTREES, list_suffixes
from topomerge.registration.pipeline import register
from topomerge.registration.prepared import prepare
from topomerge.types import Array, LogFn, Sim3, TopometricMap, convert_pose_to_files

LEAST_BELIEVED = 0.99  # probability of a pose that is taken for true
DECIMALS = 6  # of the transforms that are written
MAP_SUFFIX = ".tmap"


@dataclass(frozen=True, eq=False)
class TriedPair:
    """Two captures that were registered.

    Args:
        a, b: their names.
        probability: of the best pose.
        pose: T_ab of the maps; None where there was none.
        middle: (3,) m, of b.
        refused: why it is not taken for true; empty: it is.
        rooms: pairs of rooms that are one under the pose.
    """

    a: str
    b: str
    probability: float
    pose: Sim3 | None
    middle: Array
    refused: str = ""
    rooms: int = 0

    def get_pose(self, first: str) -> Sim3:
        """Return the pose of the other capture in the frame of the one that is named."""
        assert self.pose is not None
        return self.pose if first == self.a else self.pose.inverse()


@dataclass(frozen=True)
class MergedTruth:
    """The outcome of a folder: the lines of a table, and how many pairs and captures were taken, of how many buildings."""

    lines: tuple[str, ...]
    pairs: int
    captures: int
    buildings: int


def build_merged_truth(
    path: str | Path,
    output: str | Path,
    cache: str | Path,
    jobs: int = 1,
    scale: str = "fixed",
    log_line: LogFn = lambda text: None,
) -> MergedTruth:
    """Write the `pairs.yaml` of a folder of captures without truth into another folder.

    Args:
        path: a folder of captures, or one with a `pairs.yaml`, of which only the captures are read.
        output: folder that is written to, made if need be.
        scale: "fixed", or "free" where the units of captures may differ.

    Raises:
        InputError: fewer than two captures have a map, none of their pairs is believed, or the folder can't be written.
    """
    listing = list_captures(path)
    items, faults = extract_captures(listing, cache, jobs, log_line)
    folder = Path(cache).resolve() / OWN_FOLDER / "captures"
    maps = {name: load_map(folder / f"{items[name].name}.tmap") for name in sorted(items) if name not in faults}
    if len(maps) < 2:
        reason = next(iter(faults.values()), "there is one capture only")
        raise InputError(f"{path}: {len(maps)} captures with rooms, at least 2 are needed ({reason})")
    tried = select_consistent(try_pairs(maps, scale, log_line))
    taken = [one for one in tried if not one.refused]
    lines = (*_format_table(tried), *(f"left out: {name}: {reason}" for name, reason in faults.items()))
    components = find_components(taken)
    if taken:
        write_pairs_file(listing, maps, taken, Path(output) / PAIRS_FILE)
    return MergedTruth(lines, len(taken), sum(map(len, components)), len(components))


def list_captures(path: str | Path) -> PairsFile:
    """List the captures of a folder: those of its `pairs.yaml`, or each file and folder that could be one.

    Raises:
        InputError: no such folder, or nothing in it.
    """
    place = Path(path)
    if place.is_file() or (place / PAIRS_FILE).is_file():
        return read_pairs_file(place, paired=False)
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; give one with captures")
    suffixes = (*list_suffixes(), MAP_SUFFIX)
    files = [p for p in sorted(place.iterdir()) if not p.name.startswith(".")]
    files = [p for p in files if p.is_dir() or p.suffix.lower() in suffixes or p.name in OCTREES]
    if len(files) < 2:
        raise InputError(f"{place}: holds {len(files)} captures that can be read, at least 2 are needed; add some")
    stems = [file.stem for file in files]
    names = [file.name if stems.count(file.stem) > 1 else file.stem for file in files]
    captures = {name: Capture(name, file, "") for name, file in zip(names, files, strict=True)}
    return PairsFile(place / PAIRS_FILE, str(place / PAIRS_FILE), captures, (), Split())


def try_pairs(maps: Mapping[str, TopometricMap], scale: str, log_line: LogFn) -> list[TriedPair]:
    """Register each two maps by their walls; refused are those that are not believed, or have no floor in common."""
    prepared = {name: prepare(map) for name, map in maps.items()}
    pairs, tried = list(itertools.combinations(maps, 2)), []
    for number, (a, b) in enumerate(pairs, 1):
        found = register(prepared[a], prepared[b], scale=scale)
        one = TriedPair(a, b, found.probability, found.transform, prepared[b].middle)
        if one.pose is None or found.probability < LEAST_BELIEVED:
            one = replace(one, refused=f"not believed ({found.reason})" if one.pose is None else "not believed")
        else:
            one = _measure_overlap(one, (maps[a], maps[b]))
        tried.append(one)
        if number % 10 == 0 or number == len(pairs):
            log_line(f"{number} of {len(pairs)} pairs registered, {sum(not t.refused for t in tried)} believed")
    return tried


def _measure_overlap(one: TriedPair, maps: tuple[TopometricMap, TopometricMap]) -> TriedPair:
    assert one.pose is not None
    matrix = convert_pose_to_files(one.pose, maps[1].levelling, maps[0].levelling)
    try:
        return replace(one, rooms=len(find_overlap(PairTruth(one.a, one.b, matrix), maps).matches))
    except InputError as error:
        return replace(one, refused=str(error))


def select_consistent(tried: Sequence[TriedPair]) -> list[TriedPair]:
    """Refuse believed pairs that others contradict, and of three or more captures those that no cycle confirms.

    Pairs are taken one by one, those first that most triangles confirm, then the more probable ones. A pair within what hangs
    together already must say what the pairs before say.
    """
    accepted = [one for one in tried if not one.refused]
    reasons: dict[tuple[str, str], str] = {}
    frame: dict[str, str] = {}
    pose: dict[str, Sim3] = {}
    for one in sorted(accepted, key=lambda one: (-_count_triangles(one, accepted), -one.probability, one.a, one.b)):
        for name in (one.a, one.b):
            frame.setdefault(name, name)
            pose.setdefault(name, Sim3())
        moved = pose[one.a] @ one.get_pose(one.a)
        if frame[one.a] == frame[one.b]:
            if not is_same_pose(moved, pose[one.b], one.middle):
                reasons[one.a, one.b] = "other pairs contradict it"
            continue
        shift, old = moved @ pose[one.b].inverse(), frame[one.b]
        for name in [name for name, of in frame.items() if of == old]:
            frame[name], pose[name] = frame[one.a], shift @ pose[name]
    kept = [one for one in accepted if (one.a, one.b) not in reasons]
    while loose := [one for one in kept if _is_unconfirmed(one, kept)]:
        weakest = min(loose, key=lambda one: (one.probability, one.a, one.b))
        reasons[weakest.a, weakest.b] = "no cycle of other pairs confirms it"
        kept.remove(weakest)
    return [replace(one, refused=one.refused or reasons.get((one.a, one.b), "")) for one in tried]


def _count_triangles(one: TriedPair, accepted: Sequence[TriedPair]) -> int:
    """Count how many triangles of believed pairs close over a pair, less those that do not."""
    assert one.pose is not None
    neighbours = [
        {other.b if other.a == end else other.a: other for other in accepted if end in (other.a, other.b)}
        for end in (one.a, one.b)
    ]
    third = neighbours[0].keys() & neighbours[1].keys()
    detours = [neighbours[0][name].get_pose(one.a) @ neighbours[1][name].get_pose(name) for name in third]
    return sum(1 if is_same_pose(way, one.pose, one.middle) else -1 for way in detours)


def _is_unconfirmed(one: TriedPair, kept: Sequence[TriedPair]) -> bool:
    """Return whether a pair alone holds three captures or more together."""
    component = next(of for of in find_components(kept) if one.a in of)
    return len(component) > 2 and component not in find_components([other for other in kept if other is not one])


def find_components(pairs: Sequence[TriedPair]) -> list[tuple[str, ...]]:
    """Find the captures that pairs hold together, by name."""
    groups: list[set[str]] = []
    for one in pairs:
        joined = [group for group in groups if group & {one.a, one.b}]
        groups = [group for group in groups if group not in joined] + [set().union({one.a, one.b}, *joined)]
    return sorted(tuple(sorted(group)) for group in groups)


def write_pairs_file(listing: PairsFile, maps: Mapping[str, TopometricMap], taken: Sequence[TriedPair], file: Path) -> None:
    """Write the captures that are part of a pair, each of the building that is called like the first capture of it. Pairs without
    a pose show two places.

    Raises:
        InputError: it can't be written.
    """
    import yaml

    above = file.parent.resolve()
    captures = []
    groups = find_components([one for one in taken if one.pose is not None])
    joined = {name for group in groups for name in group}
    apart = sorted({name for one in taken for name in (one.a, one.b)} - joined)
    for group in [*groups, *((name,) for name in apart)]:
        for name in group:
            capture = listing.captures[name]
            entry = {"name": name, "file": os.path.relpath(capture.path.resolve(), above), "building": group[0]}
            read = dict(capture.read)
            if read.get("poses") and Path(read["poses"]).is_file():
                read["poses"] = os.path.relpath(Path(read["poses"]).resolve(), above)
            captures.append({**entry, "sensor": capture.sensor, **({"read": read} if read else {})})
    pairs: list[dict[str, Any]] = []
    for one in taken:
        if one.pose is None:
            pairs.append({"a": one.a, "b": one.b, "different": True})
            continue
        matrix = convert_pose_to_files(one.pose, maps[one.b].levelling, maps[one.a].levelling)
        pairs.append({"a": one.a, "b": one.b, "transform": (matrix.round(DECIMALS) + 0.0).tolist()})
    # Captures that nothing connects may be of one building all the same: none are taken for strangers.
    values = {"captures": captures, "pairs": pairs, "negatives": 0.0, "voxel_size": listing.voxel_size}
    try:
        above.mkdir(parents=True, exist_ok=True)
        with replace_on_success(file) as temporary:
            temporary.write_text(yaml.safe_dump(values, sort_keys=False, allow_unicode=True), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file}: can't be written ({error.strerror or error}); give another folder") from error


def _format_table(tried: Sequence[TriedPair]) -> list[str]:
    rows = [("pair", "probability", "rooms", "")]
    for one in tried:
        formatted = "over 0.99" if one.probability > LEAST_BELIEVED else f"{one.probability:.2f}"
        rows.append((f"{one.a} {one.b}", formatted, str(one.rooms or "-"), f"refused: {one.refused}" if one.refused else "taken"))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    return ["  ".join([*(text.ljust(w) for text, w in zip(row, widths, strict=False)), row[3]]).rstrip() for row in rows]
