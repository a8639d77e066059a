"""Pairs of one's own captures (`pairs_file`): extracted once, split by physical building, for training and for evaluation alike.

Everything lies in `cache`/own: `captures/` holds a map and its graph for each capture, named by a hash of its bytes and of how
it was read and extracted. `pairs/` holds a file for each pair (`evaluation_pair`). ``<folder>-<hash>-<part>.jsonl`` lists those
of a part, as any set of pairs is listed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from topomerge.datasets.core.builder import BuildRow, build_set, make_item, read_refusal
from topomerge.datasets.pairs.evaluation_pair import compute_anchor
from topomerge.datasets.pairs.pairs_file import (
    NO_OVERLAP,
    OWN_DATA,
    PARTS,
    Capture,
    PairsFile,
    PairTruth,
    RoomOverlap,
    are_on_two_storeys,
    find_overlap,
    read_pairs_file,
)

from topomerge import archive
from topomerge.archive import convert_to_plain
from topomerge.code_digest import compute_code_digest
from topomerge.embedding.graph import POINTS_PER_ROOM, build_graph_arrays
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.maps import load_map, save_map
from topomerge.io.points import OCTREES, read_chunks
from topomerge.matching.assignment import has_twin
from topomerge.registry import DATASETS
from topomerge.types import Array, LogFn, TopometricMap

OWN_SOURCE, OWN_FOLDER = "own", "own"  # source of the pairs; folder of the cache
LONGEST_CAPTURE, LONGEST_OWN_PAIR = 7200.0, 600.0  # s of a processor
TWIN_COLUMNS = (0, 3, 4)  # area, length, width of a room in its graph's `x`
NAMING = (".yaml", ".yml", ".gltf")  # files that name others
CAPTURE_FORMAT = 1  # of the files of captures: raise it when `make_capture` writes others
CAPTURE_CODE = tuple(f"topomerge.{name}" for name in ("io.points", "extraction.extract", "embedding.graph", "embedding.sheets"))
ATTEMPTS = 100  # draws of captures into parts


@dataclass
class OwnSharing:
    """Where and by how many processes sets are made (`core.builder.BuildSettings`)."""

    cache: str
    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])


@dataclass(frozen=True)
class CaptureItem:
    """Everything that the map of a capture depends on."""

    content: str
    options: str
    voxel_size: float
    code: str

    @property
    def name(self) -> str:
        """A hash of it."""
        return _hash(asdict(self))


@dataclass(frozen=True)
class OwnPairItem:
    """Everything that the file of a pair depends on.

    Args:
        captures: names of the files of both captures in the cache.
        names, sensors: of the captures.
        building: of both, or of a and of b with " + " between.
        kind: as of `pairs.PAIR_KINDS`.
        truth: matrix and rooms, as JSON.
    """

    captures: tuple[str, str]
    names: tuple[str, str]
    sensors: tuple[str, str]
    building: str
    kind: str
    truth: str
    code: str

    @property
    def name(self) -> str:
        """A hash of it."""
        return _hash(asdict(self))


@dataclass(frozen=True)
class OwnSets:
    """The sets of a folder: manifest of each part, and what somebody who reads scores should know."""

    manifests: Mapping[str, Path]
    warnings: tuple[str, ...]


def check_own_path(data: str, path: str) -> None:
    """Refuse ``data=folder``, or another of `topomerge.registry.DATASETS`, without a path, and a path without it.

    Args:
        data: name of the set that is asked for.

    Raises:
        InputError: names the key.
    """
    if data in DATASETS and not path:
        raise InputError(f"path: data={data} needs path=<its folder{', with a pairs.yaml' if data == OWN_DATA else ''}>")
    if path and data not in DATASETS:
        raise InputError(f"path={path}: is of data={OWN_DATA}, not of data={data}; name this, or leave the path out")


def build_own_sets(
    path: str | Path, cache: str | Path, jobs: int = 1, log_line: LogFn = lambda text: None, data: str = OWN_DATA
) -> OwnSets:
    """Extract the captures of a folder, find the true matches of its pairs, and list the pairs of each part.

    Raises:
        InputError: the first thing that is wrong with the folder, in one line.
    """
    listing = read_pairs_file(path, data)
    items, faults = extract_captures(listing, cache, jobs, log_line)
    if faults:
        raise InputError(f"{listing.where}: {next(iter(faults.values()))}")
    parts, warnings = split_pairs(listing)
    own = Path(cache).resolve() / OWN_FOLDER
    tasks = {
        part: [(_pair_item(listing, items, pair), (pair, str(own / "captures")), str(own / "pairs")) for pair in pairs]
        for part, pairs in parts.items()
    }
    digest = _hash({part: [task[0].name for task in of] for part, of in tasks.items()})[:8]
    stem = f"{re.sub(r'[^A-Za-z0-9._]', '_', listing.path.parent.resolve().name)}-{digest}"
    manifests = {part: own / f"{stem}-{part}.jsonl" for part in PARTS}
    for part, of in tasks.items():
        if not manifests[part].exists() or not all((own / "pairs" / f"{task[0].name}.npz").exists() for task in of):
            build_set(manifests[part], of, make_pair_file, OwnSharing(str(cache), jobs), log_line)
        _check_part(part, of, manifests[part], listing)
    for text in warnings:
        log_line(f"{listing.where}: {text}")
    return OwnSets(manifests, warnings)


def extract_captures(
    listing: PairsFile, cache: str | Path, jobs: int = 1, log_line: LogFn = lambda text: None
) -> tuple[dict[str, CaptureItem], dict[str, str]]:
    """Extract the captures that the cache lacks.

    Returns:
        Item of each capture by its name; and what is wrong with those that have no map.
    """
    folder = Path(cache).resolve() / OWN_FOLDER / "captures"
    code = f"{CAPTURE_FORMAT} {compute_code_digest(*CAPTURE_CODE)}"
    items: dict[str, CaptureItem] = {}
    tasks = []
    for capture in listing.captures.values():
        options = json.dumps(convert_to_plain(dict(capture.read)), sort_keys=True)
        item = CaptureItem(hash_capture(capture), options, listing.voxel_size, code)
        if item not in items.values():
            tasks.append((item, str(capture.path), str(folder)))
        items[capture.name] = item
    if not all((folder / f"{item.name}.npz").exists() for item, _, _ in tasks):
        build_set(folder.parent / "captures.jsonl", tasks, make_capture, OwnSharing(str(cache), jobs), log_line, unit="captures")
    faults = {}
    for name, item in items.items():
        if not (folder / f"{item.name}.npz").exists():
            reason = read_refusal(folder, item.name) or "took too long or too much memory; see the lines above"
            path = str(listing.captures[name].path)
            faults[name] = reason if path in reason else f"{path}: {reason}"
    return items, faults


def hash_capture(capture: Capture) -> str:
    """Hash the bytes of a capture and of the files that it names: of a folder or an octree all, else those beside it."""
    path, companion = capture.path, capture.path.parent
    if path.is_dir() or path.name in OCTREES:
        top = path if path.is_dir() else companion
        files = sorted(p for p in top.rglob("*") if p.is_file())
    else:
        top, files = companion, [path]
        if path.suffix.lower() in NAMING:
            text = path.read_text(encoding="utf-8", errors="replace")
            files += sorted(p for p in companion.rglob("*") if p != path and p.name in text and p.is_file())
    if capture.read.get("poses"):
        files.append(Path(capture.read["poses"]))
    digest = hashlib.sha256(path.name.encode())
    for file in files:
        if file.is_file():
            name = file.relative_to(top).as_posix() if file.is_relative_to(top) else file.name
            with file.open("rb") as stream:
                digest.update(name.encode() + hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()[:24]


def make_capture(item: CaptureItem, path: str, folder: str) -> BuildRow:
    """Make the map and the graph of a capture in a folder."""

    def make() -> dict[str, Array]:
        map = read_capture(Path(path), json.loads(item.options), item.voxel_size)
        if not len(map.rooms):
            raise InputError(f"{path}: no rooms come out of it; give a capture that shows floor and walls, or leave it out")
        save_map(map, Path(folder) / f"{item.name}.tmap")
        about = json.dumps({"file": f"{item.name}.npz", "source": path, "rooms": len(map.rooms)}, sort_keys=True)
        arrays = {**build_graph_arrays(map, POINTS_PER_ROOM), **build_sheet_arrays(map)}
        return {**arrays, "about": np.frombuffer(about.encode(), np.uint8)}

    return make_item(item.name, folder, make, LONGEST_CAPTURE)


def read_capture(path: Path, options: Mapping[str, Any], voxel_size: float) -> TopometricMap:
    """Read a `.tmap`, or extract the map of anything else."""
    if path.suffix.lower() == ".tmap":
        return load_map(path)
    return extract(read_chunks(path, **options), voxel_size=voxel_size, name=path.name)


def split_pairs(listing: PairsFile) -> tuple[dict[str, list[PairTruth]], tuple[str, ...]]:
    """Split pairs into `PARTS` by physical building, and draw negatives in each part.

    Of one building only, captures are held out instead. A pair is of the latest part that one of its captures is of. With two
    buildings the same one is watched and tested.

    Returns:
        Pairs of each part, and warnings.

    Raises:
        InputError: too few captures to hold any out.
    """
    pairs = [pair for pair in listing.pairs if not pair.different]
    building = {name: capture.building for name, capture in listing.captures.items()}
    buildings = sorted({building[pair.a] for pair in pairs})
    warnings: list[str] = []
    if len(buildings) == 1:
        only = f"all pairs are of building {buildings[0]!r}"
        if listing.split.part:
            raise InputError(f"{listing.where}: split: {only}; give shares, which hold out captures")
        of = _captures_held_out(listing, pairs)
        warnings.append(f"{only}: captures are held out, and nothing is said of other buildings")
    else:
        drawn = listing.split.part or _drawn(buildings, listing)
        of = {name: drawn.get(at, PARTS[0]) for name, at in building.items()}

    def part_of(a: str, b: str) -> str:
        return max((of[a], of[b]), key=PARTS.index)

    parts = {part: [pair for pair in listing.pairs if part_of(pair.a, pair.b) == part] for part in PARTS}
    for part in PARTS:
        parts[part] += _negatives(listing, parts[part], part, part_of)
    for missing, other in (("val", "test"), ("test", "val")):
        if missing not in of.values():
            parts[missing] = parts[other]
            warnings.append("too little to hold out twice: the pairs that are watched are those of the test, which flatters it")
    return parts, tuple(warnings)


def _drawn(buildings: Sequence[str], listing: PairsFile) -> dict[str, str]:
    """Draw the part of each building: shares of them, at least one for test and training, and with three one to be watched."""
    order = sorted(buildings, key=lambda name: _hash([listing.split.seed, name]))
    counts = [max(round(share * len(order)), 1) for share in listing.split.shares[1:]]
    counts[0] = counts[0] if len(order) > 2 else 0
    while sum(counts) > len(order) - 1:
        counts[counts.index(max(counts))] -= 1
    held = dict.fromkeys(order[: counts[1]], "test") | dict.fromkeys(order[counts[1] : sum(counts)], "val")
    return dict.fromkeys(order, "train") | held


def _captures_held_out(listing: PairsFile, pairs: Sequence[PairTruth]) -> dict[str, str]:
    """Return the part of each capture of one building, so that every part has a pair; of few captures none are watched.

    Raises:
        InputError: there are too few.
    """
    names = sorted({name for pair in pairs for name in (pair.a, pair.b)})
    watched, tested = (max(round(share * len(names)), 1) for share in listing.split.shares[1:])
    for number, attempt in itertools.product(sorted({watched, 0}, reverse=True), range(ATTEMPTS)):
        order = sorted(names, key=lambda name: _hash([listing.split.seed, attempt, name]))
        drawn = dict.fromkeys(order, "train") | dict.fromkeys(order[:tested], "test")
        drawn |= dict.fromkeys(order[tested : tested + number], "val")
        found = {max((drawn[pair.a], drawn[pair.b]), key=PARTS.index) for pair in pairs}
        if found >= set(drawn.values()) | {"train"}:
            return {name: drawn.get(name, "train") for name in listing.captures}
    text = f"of its {len(names)} captures, all of one building, none can be held out (topomerge dataset check shows them)"
    raise InputError(
        f"{listing.where}: {text}; add captures of it, or of another building; topomerge dataset check shows each pair"
    )


def _negatives(
    listing: PairsFile, positives: Sequence[PairTruth], part: str, part_of: Callable[[str, str], str]
) -> list[PairTruth]:
    """Draw pairs of two buildings, or of two storeys, in a number that goes by the pairs of a part."""
    listed = {frozenset((pair.a, pair.b)) for pair in listing.pairs}
    near = {name for pair in positives for name in (pair.a, pair.b)}
    choices = [
        (a.name, b.name)
        for a, b in itertools.combinations(listing.captures.values(), 2)
        if (a.building != b.building or are_on_two_storeys(a, b))
        and near & {a.name, b.name}
        and part_of(a.name, b.name) == part
        and frozenset((a.name, b.name)) not in listed
    ]
    # A part of one building has no others of its own to tell it from: then they are of an earlier part.
    choices = [(a, b) for a, b in choices if part_of(a, a) == part_of(b, b)] or choices
    number = min(int(np.ceil(listing.negatives * len(positives))), len(choices))
    order = np.random.default_rng([listing.split.seed, PARTS.index(part)]).permutation(len(choices))[:number]
    return [PairTruth(a, b, different=True, listed=False) for a, b in (choices[k] for k in sorted(order.tolist()))]


def _pair_item(listing: PairsFile, items: Mapping[str, CaptureItem], pair: PairTruth) -> OwnPairItem:
    a, b = listing.captures[pair.a], listing.captures[pair.b]
    apart = pair.different
    truth = json.dumps(convert_to_plain({"matrix": pair.matrix, "rooms": pair.rooms}))
    return OwnPairItem(
        captures=(items[a.name].name, items[b.name].name),
        names=(a.name, b.name),
        sensors=(a.sensor, b.sensor),
        building=f"{a.building} + {b.building}" if a.building != b.building else a.building,
        kind=("other-building" if a.building != b.building else "other-storey") if apart else "overlap",
        truth=truth,
        code=compute_code_digest(__name__),
    )


def make_pair_file(item: OwnPairItem, given: tuple[PairTruth, str], folder: str) -> BuildRow:
    """Make the file of a pair in a folder, with both maps beside it."""
    truth, captures = given

    def make() -> dict[str, Array]:
        maps = tuple(load_map(Path(captures) / f"{name}.tmap") for name in item.captures)
        arrays: dict[str, Array] = {}
        for side, name in zip("ab", item.captures, strict=True):
            graph = archive.read(Path(captures) / f"{name}.npz", "capture")
            arrays |= {f"{side}.{key}": value for key, value in graph.items() if key != "about"}
            shutil.copyfile(Path(captures) / f"{name}.tmap", Path(folder) / f"{item.name}{side}.tmap")
        return arrays | build_truth_arrays(item, find_overlap(truth, (maps[0], maps[1])), (maps[0], maps[1]), arrays)

    return make_item(item.name, folder, make, LONGEST_OWN_PAIR)


def build_truth_arrays(
    item: OwnPairItem, overlap: RoomOverlap, maps: tuple[TopometricMap, TopometricMap], graphs: Mapping[str, Array]
) -> dict[str, Array]:
    """Build the arrays of a pair's file that say what is true (`example.build_pair_arrays`,
    `evaluation_pair.build_evaluation_arrays`)."""
    sizes = [len(map.rooms) for map in maps]
    matches, pose = overlap.matches, overlap.transform
    arrays: dict[str, Array] = {"matches": matches, "laid": np.zeros((0, 2), np.int64)}
    ends = (matches[:, 0], sizes[0] + matches[:, 1])
    _, group = connected_components(coo_array((np.ones(len(matches)), ends), shape=(sum(sizes), sum(sizes))), directed=False)
    best = {int(group[ends[0][k]]): k for k in np.argsort(overlap.fit, kind="stable").tolist()}  # the last one fits best
    for k, side in enumerate("ab"):
        mine = matches[:, k]
        true = np.full(sizes[k], -1, np.int32)
        true[mine] = group[ends[k]]
        iou, one = np.zeros(sizes[k], np.float32), np.zeros(sizes[k], bool)
        np.maximum.at(iou, mine, overlap.fit.astype(np.float32))
        one[mine[list(best.values())]] = True
        rooms = np.unique(mine)
        twin = np.zeros(sizes[k], bool)
        twin[rooms] = has_twin(graphs[f"{'ba'[k]}.x"][:, TWIN_COLUMNS], matches[:, [k, 1 - k]], rooms)
        arrays |= {f"{side}.true_room": true, f"{side}.true_iou": iou, f"{side}.true_one": one, f"{side}.twin": twin}
    arrays["transform"] = np.full((4, 4), np.nan) if pose is None else pose.matrix
    arrays["anchor"] = compute_anchor(SimpleNamespace(truth=pose), maps)
    partners = [len(set(matches[:, k].tolist())) for k in (0, 1)]
    about = {
        "file": f"{item.name}.npz", "title": "-".join(item.names), "captures": item.names, "source": OWN_SOURCE,
        "building": item.building, "kind": item.kind, "sensors": item.sensors, "common": round(overlap.common, 2),
        "overlap": round(sum(partners) / max(sum(sizes), 1), 4), "rooms": "labelled", "extracted": sizes, "partners": partners,
        "scale_free": pose is not None and abs(pose.scale - 1) > 0.03, "points_per_room": POINTS_PER_ROOM,
    }  # fmt: skip
    text = json.dumps(convert_to_plain(about), sort_keys=True, ensure_ascii=False)
    return arrays | {"about": np.frombuffer(text.encode(), np.uint8)}


def _check_part(part: str, tasks: Sequence[tuple[OwnPairItem, Any, str]], manifest: Path, listing: PairsFile) -> None:
    """Raise InputError for a listed pair that could not be made, or a part in which no rooms match."""
    reasons: list[str] = []
    for item, (pair, _), folder in tasks:
        if (Path(folder) / f"{item.name}.npz").exists():
            continue
        reasons.append(read_refusal(Path(folder), item.name) or f"{pair.a} and {pair.b}: could not be made")
        if pair.listed or NO_OVERLAP not in reasons[-1]:
            raise InputError(f"{listing.where}: {reasons[-1]}")
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    if not any(sum(row["partners"]) for row in rows):
        why = f" ({reasons[0]})" if reasons else ""
        raise InputError(
            f"{listing.where}: no rooms match in the pairs of {part}{why}; see topomerge dataset check, or change split"
        )


def check_folder(
    path: str | Path, cache: str | Path, jobs: int = 1, log_line: LogFn = lambda text: None
) -> tuple[list[str], int]:
    """Check the captures and pairs of a folder.

    Returns:
        Lines of a table: of each pair its rooms, the rooms that match, the area in common, and what is wrong; and how many
        captures and pairs are wrong.

    Raises:
        InputError: its `pairs.yaml` can't be used at all.
    """
    listing = read_pairs_file(path)
    items, faults = extract_captures(listing, cache, jobs, log_line)
    folder = Path(cache).resolve() / OWN_FOLDER / "captures"
    maps = {name: load_map(folder / f"{item.name}.tmap") for name, item in items.items() if name not in faults}
    try:
        parts, warnings = split_pairs(listing)
    except InputError as error:
        parts, warnings = {"": list(listing.pairs)}, (str(error),)
    rows = [("part", "pair", "rooms", "m2", "matched rooms")]
    wrong = len(faults)
    for part, pair in ((part, pair) for part, of in parts.items() for pair in of):
        counts = [str(len(maps[name].rooms)) if name in maps else "-" for name in (pair.a, pair.b)]
        common, notes = "-", "a capture has no map"
        if pair.a in maps and pair.b in maps:
            try:
                overlap = find_overlap(pair, (maps[pair.a], maps[pair.b]))
                common = f"{overlap.common:.1f}"
                notes = " ".join(f"{i}-{j}" for i, j in overlap.matches.tolist()) or ("different" if pair.different else "none")
            except InputError as error:
                wrong, notes = wrong + pair.listed, f"WRONG: {error}" if pair.listed else "left out: no floor in common"
        rows.append((part, f"{pair.a} {pair.b}", " ".join(counts), common, notes))
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ["  ".join([*(text.ljust(w) for text, w in zip(row, widths, strict=False)), row[-1]]) for row in rows]
    lines += [f"WRONG: {name}: {reason}" for name, reason in faults.items()]
    return [*lines, *(f"note: {text}" for text in warnings)], wrong


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(convert_to_plain(value), sort_keys=True).encode()).hexdigest()[:24]
