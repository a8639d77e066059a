"""`pairs.yaml`: which captures a folder of one's own holds, and what is true of each two of them: which of their rooms are one.

    captures:                                   # each a file or folder of any format that is read, or a .tmap
      - {file: home/a.ply}                      # name: a; building: home, the folder of the file
      - {file: home/b.laz, storey: "1", frame: survey, sensor: lidar}
      - {name: c, file: scans/c.png, building: home, read: {resolution: 0.05}}
    pairs:                                      # the truth about a and b, one of:
      - {a: a, b: b, transform: {x: 1.5, y: -2, z: 0, yaw_deg: 30, scale: 1}}       # it maps b into a
      - {a: a, b: c, transform: [[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 0], [0, 0, 0, 1]]}
      - {a: b, b: c, rooms: [[0, 3], [2, 5]]}   # room 0 of b is room 3 of c, as topomerge extract numbers them
      - {a: a, b: d, different: true}           # they show no place in common
    split: {train: 0.6, val: 0.2, test: 0.2, seed: 0}      # shares of the buildings, or lists of their names
    negatives: 0.25                             # pairs of two buildings, for each pair with a place in common
    voxel_size: 0.1

Two captures of one building that name the same `frame` are a pair without being listed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import SAME_ROOM_IOU, measure_common_area

from topomerge.errors import InputError
from topomerge.io.piece import OPTION_NAMES
from topomerge.matching.consistency import find_matches, propose_hypotheses
from topomerge.matching.room_plans import build_room_plans
from topomerge.registry import DATASETS
from topomerge.types import Array, Sim3, TopometricMap, convert_pose_to_maps

PAIRS_FILE = "pairs.yaml"
OWN_DATA = "folder"  # name of the set on the command line: configs/data/folder.yaml
LARGEST_FILE = 20 << 20  # bytes
PARTS = ("train", "val", "test")
KEYS = ("captures", "pairs", "split", "negatives", "voxel_size")
CAPTURE_KEYS = ("name", "file", "building", "storey", "frame", "sensor", "read")
PAIR_KEYS = ("a", "b", "transform", "rooms", "different")
POSE_KEYS = ("x", "y", "z", "yaw_deg", "scale")
NO_ROTATION = 1e-3  # by which the entries of a rotation that was written down may be off
SCALES = (0.01, 100.0)
MOST_ROOMS = 1_000_000  # of a map
LONGEST_TEXT = 1000  # letters of a name or path


@dataclass(frozen=True)
class Capture:
    """A capture: its file, the physical building and storey it shows, and the frame that its coordinates are in."""

    name: str
    path: Path
    building: str
    storey: str = ""
    frame: str = ""
    sensor: str = "scan"
    read: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PairTruth:
    """The truth about two captures.

    Args:
        a, b: their names.
        matrix: (4, 4) float64, maps b into a, in the coordinates of the files; None where it is not known.
        rooms: (i, j), room i of a is room j of b; None: those that lie over each other.
        different: they show no place in common.
        listed: it stands in the file; else it follows from a common frame, or was drawn.
    """

    a: str
    b: str
    matrix: Array | None = None
    rooms: tuple[tuple[int, int], ...] | None = None
    different: bool = False
    listed: bool = True


@dataclass(frozen=True)
class Split:
    """Shares of the buildings in each of `PARTS`, or the part of each building by name; and the seed of the draw."""

    shares: tuple[float, float, float] = (0.6, 0.2, 0.2)
    part: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0


@dataclass(frozen=True)
class PairsFile:
    """The content of a `pairs.yaml`.

    Args:
        path: of the file; where: what messages call it: a data set of one's own has no such file.
    """

    path: Path
    where: str
    captures: Mapping[str, Capture]
    pairs: tuple[PairTruth, ...]
    split: Split
    negatives: float = 0.25
    voxel_size: float = 0.1


def read_pairs_table(folder: Path) -> Any:
    """Read what a `pairs.yaml` in a folder, or a file of another name, holds, as it is."""
    return _parsed(_find_file(folder))


def _find_file(path: Path) -> Path:
    return path / PAIRS_FILE if path.is_dir() else path


def read_pairs_file(path: str | Path, data: str = OWN_DATA, paired: bool = True) -> PairsFile:
    """Read the pairs of a folder and check them.

    Args:
        data: of `topomerge.registry.DATASETS`: function of the folder that returns the table of a `pairs.yaml`, with files
            relative to it; `OWN_DATA` reads that file itself, or one of another name.
        paired: two of its captures must share a place.

    Raises:
        InputError: one line that names the file, the entry, and what is wrong.
    """
    file = Path(path)
    if not file.exists():
        raise InputError(f"{file}: no such folder; give one with a {PAIRS_FILE}")
    given = DATASETS[data](file)
    file = _find_file(file)
    where = str(file) if data == OWN_DATA else f"{file.parent} (data={data})"
    given = _table(given, where, KEYS)
    entries = _list(given.get("captures"), f"{where}: captures")
    if not entries:
        raise InputError(f"{where}: lists no captures; enter each file under captures")
    captures: dict[str, Capture] = {}
    for k, entry in enumerate(entries):
        capture = _capture(entry, f"{where}: captures[{k}]", file.parent)
        if capture.name in captures:
            raise InputError(f"{where}: captures[{k}]: a second capture is called {capture.name!r}; give it another name")
        captures[capture.name] = capture
    rows = _list(given.get("pairs"), f"{where}: pairs")
    pairs = tuple(_pair(row, f"{where}: pairs[{k}]", captures) for k, row in enumerate(rows))
    twice = [frozenset((p.a, p.b)) for p in pairs]
    if repeated := next((k for k, names in enumerate(twice) if names in twice[:k]), None):
        raise InputError(
            f"{where}: pairs[{repeated}]: {pairs[repeated].a} and {pairs[repeated].b} are listed before; keep one of the two"
        )
    pairs += tuple(_pairs_of_frames(captures, set(twice)))
    if paired and not any(not pair.different for pair in pairs):
        raise InputError(f"{where}: no two captures share a place; list pairs, or name the frame that captures have in common")
    negatives = _number(given.get("negatives", 0.25), f"{where}: negatives", 0.0, 10.0)
    voxel_size = _number(given.get("voxel_size", 0.1), f"{where}: voxel_size", 0.02, 1.0)
    split = _split(given.get("split", {}), f"{where}: split", {c.building for c in captures.values()})
    return PairsFile(file, where, captures, pairs, split, negatives, voxel_size)


def read_transform(value: Any, where: str) -> Array:
    """Read a pose, as a table of `POSE_KEYS` or as four rows of four numbers, as a (4, 4) matrix.

    Raises:
        InputError: it is no rotation, scale and shift.
    """
    if isinstance(value, Mapping):
        entries = _table(value, where, POSE_KEYS)
        x, y, z, yaw = (_number(entries.get(key, 0.0), f"{where}.{key}") for key in POSE_KEYS[:4])
        scale = _number(entries.get("scale", 1.0), f"{where}.scale", *SCALES)
        c, s = scale * math.cos(math.radians(yaw)), scale * math.sin(math.radians(yaw))
        return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, scale, z], [0, 0, 0, 1.0]])
    rows = [_list(row, f"{where}[{k}]") for k, row in enumerate(_list(value, where))]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise InputError(f"{where}: must be four rows of four numbers, or a table of {', '.join(POSE_KEYS)}")
    matrix = np.array([[_number(v, f"{where}[{i}][{k}]") for k, v in enumerate(row)] for i, row in enumerate(rows)])
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise InputError(f"{where}: its last row must be 0, 0, 0, 1; write the shift into the last column")
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if not determinant > 0:
        raise InputError(f"{where}: is no rotation (determinant {determinant:.3g}): it mirrors or flattens; give a rotation")
    scale = determinant ** (1 / 3)
    rotation = matrix[:3, :3] / scale
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > NO_ROTATION:
        raise InputError(f"{where}: is no rotation times a scale (its axes are off by {off:.2g}); give one that does not shear")
    _number(scale, f"{where}: its scale", *SCALES)
    return matrix


def _parsed(file: Path) -> Any:
    import yaml

    try:
        if file.stat().st_size > LARGEST_FILE:
            raise InputError(f"{file}: is larger than {LARGEST_FILE >> 20} MB; it should list captures only")
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{file.parent}: holds no {file.name}; write one that lists its captures (docs/training.md)") from None
    except OSError as error:
        raise InputError(f"{file}: can't be read ({error.strerror or error}); check its permissions") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: is no YAML ({' '.join(str(error).split())[:150]}); correct it there") from error


def _capture(entry: Any, where: str, folder: Path) -> Capture:
    entry = _table(entry, where, CAPTURE_KEYS)
    if not entry.get("file"):
        raise InputError(f"{where}: names no file; give file: and its path from {folder}")
    texts = {key: _text(entry.get(key, ""), f"{where}.{key}") for key in CAPTURE_KEYS[:-1]}
    path = folder / texts["file"]
    try:
        found, above = path.exists(), path.parent.resolve()
    except (OSError, RuntimeError) as error:  # a name that is too long, links in a circle
        raise InputError(f"{where}: {path}: can't be read ({error}); correct its path") from error
    if not found:
        raise InputError(f"{where}: {path}: no such file; correct its path")
    read = dict(_table(entry.get("read", {}), f"{where}.read", OPTION_NAMES))
    if read.get("poses"):
        poses = folder / _text(read["poses"], f"{where}.read.poses")
        read["poses"] = str(poses) if poses.name and poses.is_file() else read["poses"]  # else it names what a bag holds
    texts["building"] = texts["building"] or (folder.resolve() if above == folder.resolve() else above).name
    texts["name"] = texts["name"] or path.stem
    del texts["file"]
    return Capture(path=path, read=read, **{key: text for key, text in texts.items() if text})


def _pair(row: Any, where: str, captures: Mapping[str, Capture]) -> PairTruth:
    row = _table(row, where, PAIR_KEYS)
    a, b = (_text(row.get(key, ""), f"{where}.{key}") for key in "ab")
    for name in (a, b):
        if name not in captures:
            raise InputError(f"{where}: no capture is called {name!r}; enter it under captures")
    if a == b:
        raise InputError(f"{where}: a and b are both {a!r}; name two captures")
    given = [key for key in PAIR_KEYS[2:] if row.get(key) not in (None, False)]
    framed = captures[a].frame != "" and captures[a].frame == captures[b].frame
    if len(given) > 1 or (not given and not framed):
        text = f"has {' and '.join(given)}" if given else "says nothing of how they lie to each other"
        raise InputError(f"{where}: {text}; give one of {', '.join(PAIR_KEYS[2:])}, or both captures the same frame")
    if given and given[0] == "different":
        if row["different"] is not True:
            raise InputError(f"{where}.different: must be true, not {_shown(row['different'])}; else leave it out")
        return PairTruth(a, b, different=True)
    if captures[a].building != captures[b].building:
        text = f"{a} is of building {captures[a].building!r}, {b} of {captures[b].building!r}"
        raise InputError(f"{where}: {text}; captures that share a place need the same building")
    if given == ["rooms"]:
        return PairTruth(a, b, rooms=_rooms(row["rooms"], f"{where}.rooms"))
    return PairTruth(a, b, read_transform(row["transform"], f"{where}.transform") if given else np.eye(4))


def _rooms(value: Any, where: str) -> tuple[tuple[int, int], ...]:
    rows = _list(value, where)
    for row in rows:
        proper = isinstance(row, list) and len(row) == 2 and all(type(room) is int and 0 <= room < MOST_ROOMS for room in row)
        if not proper:
            raise InputError(f"{where}: {_shown(row)} is no pair of rooms; give [room of a, room of b], counted from 0")
    if not rows:
        raise InputError(f"{where}: lists no rooms; give [room of a, room of b]")
    return tuple(sorted({(row[0], row[1]) for row in rows}))


def _pairs_of_frames(captures: Mapping[str, Capture], listed: set[frozenset[str]]) -> Iterator[PairTruth]:
    """Yield pairs of captures in one frame, of one building, on storeys that may be the same, which are not listed."""
    for a, b in itertools.combinations(captures.values(), 2):
        framed = a.frame != "" and a.frame == b.frame and a.building == b.building
        if framed and not are_on_two_storeys(a, b) and frozenset((a.name, b.name)) not in listed:
            yield PairTruth(a.name, b.name, np.eye(4), listed=False)


def are_on_two_storeys(a: Capture, b: Capture) -> bool:
    """Return whether two captures of one building are known to show two storeys."""
    return a.storey != "" and b.storey != "" and a.storey != b.storey


def _split(value: Any, where: str, buildings: set[str]) -> Split:
    entries = _table(value, where, (*PARTS, "seed"))
    seed = entries.get("seed", 0)
    if type(seed) is not int or seed < 0:
        raise InputError(f"{where}.seed: must be a whole number, 0 or more, not {_shown(seed)}")
    given = {part: entries[part] for part in PARTS if part in entries}
    if not given:
        return Split(seed=seed)
    if not any(isinstance(of, list) for of in given.values()):
        shares = [_number(given.get(part, 0.0), f"{where}.{part}", 0.0) for part in PARTS]
        if min(shares) <= 0:
            raise InputError(f"{where}: must give {', '.join(PARTS)} a share above 0 each, or lists of buildings")
        total = sum(shares)
        return Split((shares[0] / total, shares[1] / total, shares[2] / total), seed=seed)
    part_of: dict[str, str] = {}
    for part, names in given.items():
        for name in (_text(n, f"{where}.{part}") for n in _list(names, f"{where}.{part}")):
            if name not in buildings:
                raise InputError(f"{where}.{part}: no capture is of building {name!r}; there are {', '.join(sorted(buildings))}")
            if name in part_of:
                raise InputError(f"{where}.{part}: building {name!r} is in {part_of[name]}, too; keep one of the two")
            part_of[name] = part
    if missing := sorted(buildings - set(part_of)):
        raise InputError(f"{where}: says nothing of building {missing[0]!r}; enter it under one of {', '.join(PARTS)}")
    return Split(part=part_of, seed=seed)


def _table(value: Any, where: str, keys: Sequence[str]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: must be a table of {', '.join(keys)}, not {type(value).__name__}")
    if unknown := next((key for key in value if key not in keys), None):
        raise InputError(f"{where}: unknown key {_shown(unknown)}; {', '.join(keys)} are possible")
    return value


def _list(value: Any, where: str) -> list[Any]:
    if value is None:
        return []
    if not isinstance(value, list):
        raise InputError(f"{where}: must be a list, not {type(value).__name__}")
    return value


def _text(value: Any, where: str) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise InputError(f"{where}: must be a text, not {_shown(value)}")
    text = str(value).strip()
    if not text.isprintable() or len(text) > LONGEST_TEXT:
        raise InputError(f"{where}: must be one line of at most {LONGEST_TEXT} letters, not {_shown(text)}")
    return text


def _number(value: Any, where: str, least: float = -1e9, most: float = 1e9) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or (isinstance(value, float) and not math.isfinite(value)):
        raise InputError(f"{where}: must be a number, not {_shown(value)}")
    if not least <= value <= most:
        raise InputError(f"{where}: must be {least:g} to {most:g}, not {_shown(value)}")
    return float(value)


def _shown(value: Any) -> str:
    """Return a short text of a value of a stranger's file, which may be huge."""
    if isinstance(value, list) and len(value) <= 4 and not any(isinstance(v, list | Mapping) for v in value):
        return f"[{', '.join(_shown(v) for v in value)}]"
    if value is None or isinstance(value, bool | float):
        return repr(value)
    if isinstance(value, int):
        return repr(value) if abs(value) < 10**30 else "a huge number"
    return repr(value[:60]) if isinstance(value, str) else f"a {type(value).__name__}"


LEAST_COMMON = 1.0  # m2 that both captures of a pair see
MOST_TILT = 3.0  # degrees by which a transform may tip a map over
AGREEING_ROOMS = 0.6  # share of the rooms in `rooms` that one pose must lay over each other
NO_OVERLAP = "share no floor"


@dataclass(frozen=True, eq=False)
class RoomOverlap:
    """How two maps lie to each other.

    Args:
        transform: T_ab of the maps; None where they show two places.
        matches: (M, 2) rooms that are one; of a room in pieces each piece.
        fit: (M,) IoU of each, of a piece the share that lies inside.
        common: m2 that both saw.
    """

    transform: Sim3 | None
    matches: Array
    fit: Array
    common: float


def find_overlap(truth: PairTruth, maps: tuple[TopometricMap, TopometricMap]) -> RoomOverlap:
    """Find which rooms of two maps are one, by the truth about them.

    Raises:
        InputError: rooms that do not exist, a transform that tips a map over, or maps without anything in common.
    """
    if truth.different:
        return RoomOverlap(None, np.zeros((0, 2), np.int64), np.zeros(0), 0.0)
    plans = (build_room_plans(maps[0]), build_room_plans(maps[1]))
    if truth.rooms is not None:
        given = np.array(truth.rooms, np.int64)
        _check_rooms(truth, given, maps)
        pose = find_pose_of_rooms(truth, given, maps)
    else:
        assert truth.matrix is not None
        pose = find_upright_pose(truth, convert_pose_to_maps(truth.matrix, maps[1].levelling, maps[0].levelling), maps[1])
    common = measure_common_area(maps, pose)
    if common < LEAST_COMMON:
        at = ", ".join(f"{x:.1f}" for x in pose.apply(maps[1].grid.compute_centroids().mean(axis=0)[None])[0])
        middle = ", ".join(f"{x:.1f}" for x in maps[0].grid.compute_centroids().mean(axis=0))
        raise InputError(
            f"{truth.a}, {truth.b}: {NO_OVERLAP} under their truth: b's middle comes to {at}, a's is {middle}; "
            f"correct it, or say different: true"
        )
    rooms, fit = find_matches(pose, plans)
    if truth.rooms is not None:
        found = {(int(i), int(j)): float(value) for (i, j), value in zip(rooms, fit, strict=True)}
        return RoomOverlap(pose, given, np.array([found.get((i, j), SAME_ROOM_IOU) for i, j in truth.rooms]), common)
    return RoomOverlap(pose, rooms[fit >= SAME_ROOM_IOU], fit[fit >= SAME_ROOM_IOU], common)


def _check_rooms(truth: PairTruth, given: Array, maps: Sequence[TopometricMap]) -> None:
    for name, column, map in zip((truth.a, truth.b), given.T, maps, strict=True):
        if column.max() >= len(map.rooms):
            has = f"it has rooms 0 to {len(map.rooms) - 1}"
            raise InputError(f"{truth.a}, {truth.b}: rooms: {name} has no room {column.max()}; {has} (topomerge info)")


def find_pose_of_rooms(truth: PairTruth, given: Array, maps: Sequence[TopometricMap]) -> Sim3:
    """Find the pose whose walls agree best among those that lay the given rooms over each other.

    Raises:
        InputError: none lays half of them over each other.
    """
    a, b = maps
    likeness = np.zeros((len(a.rooms), len(b.rooms)))
    likeness[tuple(given.T)] = 1.0
    requested = {(int(i), int(j)) for i, j in given}
    poses = propose_hypotheses(a, b, 1.0 - likeness, likeness)
    counts = [len(requested & {(int(i), int(j)) for i, j in pose.rooms}) for pose in poses]
    if max(counts, default=0) < AGREEING_ROOMS * len(requested):
        raise InputError(
            f"{truth.a}, {truth.b}: rooms: no pose lays these rooms over each other (at most {max(counts, default=0)} of "
            f"{len(requested)}); correct their numbers, or give a transform"
        )
    return poses[int(np.argmax(counts))].transform


def find_upright_pose(truth: PairTruth, matrix: Array, b: TopometricMap) -> Sim3:
    """Find the pose about the vertical of a (4, 4) matrix, which keeps the middle of b.

    Raises:
        InputError: the matrix tips b over.
    """
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    up = matrix[:3, 2] / scale
    tilt = float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))
    if tilt > MOST_TILT:
        raise InputError(
            f"{truth.a}, {truth.b}: transform: tips b over by {tilt:.0f} degrees, and maps stand upright; give a turn about "
            f"the vertical, or tell which axis is up by read: {{up: y}}"
        )
    middle = b.grid.compute_centroids().mean(axis=0)
    turned = Sim3(float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])), scale=scale)
    x, y, z = (matrix[:3, :3] @ middle + matrix[:3, 3] - turned.apply(middle[None])[0]).tolist()
    return Sim3(turned.yaw, (x, y, z), scale)
