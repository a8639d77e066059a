"""A cached set of pairs as one file that is read in a second, and then stays in memory.

It stands in `packed/` beside the manifest, named by a hash of what is in it. Points are millimetres in 16 bits. Nothing but
NumPy is needed to read it: a machine that only trains has no use for the extraction.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from topomerge import archive
from topomerge.datasets.core.building import find_physical_building
from topomerge.embedding.engineered import compute_door_layout
from topomerge.embedding.graph import add_proximity_edges, count_columns
from topomerge.embedding.network import LANDMARK_PART
from topomerge.errors import InputError
from topomerge.types import Array

PACKED_FORMAT = 7
PAIRS_PER_CHUNK = 100  # pairs; descriptors that take long are stored chunk by chunk
PACKED_TABLES = ("x", "edge_attr", "door_attr", "pos", "edge_pos")  # no network reads positions: they depend on the frame
INDICES = ("edge_index", "door_index", "near_index")
PACKED_INDICES = INDICES[:2]
ROWS_OF = {
    "edge_attr": "edges",
    "edge_pos": "edges",
    "edge_index": "edges",
    "door_attr": "doors",
    "door_index": "doors",
}  # of the others: rooms
EXTRAS = ("engineered", "shapedna")
SHEET = ("sheet", "sheet_room", "anchor", "door_anchor", "turn")
Graph = dict[str, Tensor]


@dataclass(frozen=True)
class GraphPair:
    """Tensors of two maps by name (`embedding.graph`; `room_points` are int16 millimetres) and what is true about them.

    Args:
        matches: (M, 2) rooms of a and of b that are one true room.
        true: (R,) true room of each room of a and of b, -1 none.
        iou: (R,) how much of each room and of its true room is common to both.
        about: building, sensors, overlap, source, ...
        transform: (4, 4) T_ab, which maps points of b into the frame of a; nan where there is none.
    """

    a: Graph
    b: Graph
    matches: Tensor
    true: tuple[Tensor, Tensor]
    iou: tuple[Tensor, Tensor]
    about: dict[str, Any]
    transform: Tensor

    @cached_property
    def buildings(self) -> tuple[str, str]:
        """The physical buildings of a and of b; what b shows is not named where it is another building."""
        name = str(self.about.get("building", self.about.get("file")))
        first = find_physical_building(str(self.about.get("source", "procedural")), name)
        if self.about.get("hard") == "other-building":
            return first, f"other than {first}: {self.about.get('file')}"
        return first, first

    @cached_property
    def building_numbers(self) -> tuple[int, int]:
        """A number of each of `buildings`, the same in every process."""
        first, second = (int.from_bytes(hashlib.sha256(name.encode()).digest()[:7]) for name in self.buildings)
        return first, second


def load_pairs(
    manifest: str | Path,
    extras: Sequence[str] = (),
    log_line: Callable[[str], None] = lambda text: None,
    limit: int = 0,
    around: float = 0.0,
) -> list[GraphPair]:
    """Load the pairs of a manifest (`datasets.pairs.build`), from the packed file, which is made if there is none.

    Args:
        manifest: or a packed file itself.
        extras: what is wanted, too: of `EXTRAS`, `landmarks`, `near`, the layout of doors, or `sheet`, the storeys from above.
        limit: of the first pairs only; 0: all.
        around: m within which rooms are neighbours, too (`embedding.graph.add_proximity_edges`); 0: by doors only.

    Raises:
        InputError: no such manifest, or a file is damaged.
    """
    path = Path(manifest)
    if path.suffix == ".npz" and "sheet" in extras:
        raise InputError(f"{path}: a packed set holds no storeys from above; give its manifest")
    if path.suffix == ".npz":
        arrays = archive.read(path, "packed set")
        if "transform" not in arrays:
            raise InputError(f"{path}: was packed by an earlier version; give its manifest, and it is packed again")
        return _add_layout(_unpack_pairs(arrays, _get_landmarks(arrays, extras))[: limit or None], extras, around)
    rows = _read_rows(path)
    names = [str(row["file"]) for row in rows]
    digest = hashlib.sha256(json.dumps([PACKED_FORMAT, names]).encode()).hexdigest()[:12]
    folder = path.parent / "packed"
    folder.mkdir(exist_ok=True)
    packed_file = folder / f"{path.stem}-{digest}.npz"
    if not packed_file.exists():
        log_line(f"packing {len(names)} files")
        files = [archive.read(path.parent / "pairs" / name, "cached pair") for name in names]
        archive.write(
            _pack_pairs([p for file, row in zip(files, rows, strict=True) for p in split_pairs(file, row)]), packed_file
        )
    arrays = archive.read(packed_file, "packed set")
    tables = {name: _compute_extra(name, arrays, packed_file, log_line, limit) for name in extras if name in EXTRAS}
    tables |= _get_landmarks(arrays, extras)
    pairs = _add_layout(_unpack_pairs(arrays, tables)[: limit or None], extras, around)
    if "sheet" in extras:
        _add_sheets(pairs, [path.parent / "pairs" / name for name in names], packed_file, log_line)
    return pairs


def split_pairs(file: Mapping[str, Array], row: Mapping[str, Any]) -> list[tuple[dict[str, Array], dict[str, Any]]]:
    """Return the pairs of a cached file of two or more maps of a building, each with its arrays ("a.…", "b.…", matches,
    transform) and its row; those of a file of several that share no room are left out."""
    sides, out = str(row.get("sides", "ab")), []
    for s, t in itertools.combinations(sides, 2):
        ending = "" if (s, t) == ("a", "b") else f".{s}{t}"
        pair = {f"{to}.{n[2:]}": v for side, to in ((s, "a"), (t, "b")) for n, v in file.items() if n.startswith(f"{side}.")}
        pair |= {name: file[f"{name}{ending}"] for name in ("matches", "transform")}
        if len(sides) == 2 or len(pair["matches"]):
            about = {"sensors": [row["sensors"][sides.index(side)] for side in (s, t)]} if len(sides) > 2 else {}
            out.append((pair, {**row, **about, "sides": s + t}))
    return out


def _add_sheets(pairs: Sequence[GraphPair], files: Sequence[Path], packed_file: Path, log_line: Callable[[str], None]) -> None:
    """Add the storeys of all maps from above (`embedding.surroundings`), packed in chunks, too: of all files, so that a chunk
    serves any `limit`."""
    of_file: dict[str, list[GraphPair]] = {}
    for pair in pairs:
        of_file.setdefault(str(pair.about["file"]), []).append(pair)
    for k, first in enumerate(range(0, len(files), PAIRS_PER_CHUNK)):
        chunk = files[first : first + PAIRS_PER_CHUNK]
        if not any(file.name in of_file for file in chunk):
            continue
        path = packed_file.with_name(f"{packed_file.stem}-sheets-{k}.npz")
        if not path.exists():
            log_line(f"packing storeys of files {first} to {first + len(chunk)}")
            read = {file.stem: archive.read(file, "cached pair") for file in chunk}
            named = {f"{stem}.{n}": v for stem, one in read.items() for n, v in one.items() if n.partition(".")[2] in SHEET}
            archive.write(named, path)
        arrays = archive.read(path, "storeys")
        for file in chunk:
            for pair in of_file.get(file.name, []):
                for side, graph in zip(pair.about["sides"], (pair.a, pair.b), strict=True):
                    graph.update({name: torch.from_numpy(arrays[f"{file.stem}.{side}.{name}"]) for name in SHEET})


def _get_landmarks(arrays: Mapping[str, Array], extras: Sequence[str]) -> dict[str, Array]:
    """Get the landmark features of all rooms, where they are asked for; 0 in sets without any."""
    none = np.zeros((len(arrays["x"]), count_columns(LANDMARK_PART)), np.float32)
    return {LANDMARK_PART: arrays.get(LANDMARK_PART, none)} if LANDMARK_PART in extras else {}


def _add_layout(pairs: list[GraphPair], extras: Sequence[str], around: float) -> list[GraphPair]:
    for graph in (g for pair in pairs for g in (pair.a, pair.b)) if around else ():
        near = add_proximity_edges({n: graph[n].numpy() for n in ("pos", "edge_index", "edge_attr", "edge_pos")}, around)
        graph.update({name: torch.from_numpy(array) for name, array in near.items()})
        del graph["door_index"], graph["door_attr"]  # of the edges before
    if "near" in extras:
        for graph in (g for pair in pairs for g in (pair.a, pair.b)):
            layout = compute_door_layout(*(graph[name].numpy() for name in ("edge_index", "pos", "edge_pos")))
            graph["near_index"], graph["near_attr"] = (torch.from_numpy(array) for array in layout)
    return pairs


def _read_rows(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        advice = f"make it with python -m topomerge.datasets.pairs.build data={path.stem}"
        raise InputError(f"{path}: {error.strerror or error}; {advice}") from error
    rows = [json.loads(line) for line in text.splitlines()]
    if not rows:
        raise InputError(f"{path}: no pairs in it")
    return rows


def _pack_pairs(pairs_and_rows: list[tuple[dict[str, Array], dict[str, Any]]]) -> dict[str, Array]:
    """Pack all maps behind each other, a0 b0 a1 b1 ..., with how many rooms, edges and pairs of doors each has."""
    pairs, rows = zip(*pairs_and_rows, strict=True)
    sides = [{n[2:]: v for n, v in pair.items() if n.startswith(f"{s}.")} for pair in pairs for s in "ab"]
    out = {name: np.concatenate([side[name] for side in sides]).astype(np.float32) for name in PACKED_TABLES}
    out |= {name: np.concatenate([side[name] for side in sides], axis=1).astype(np.int32) for name in PACKED_INDICES}
    points = np.concatenate([np.round(side["room_points"] * 1000).clip(-32767, 32767).astype(np.int16) for side in sides])
    out["room_points"] = points
    if any(LANDMARK_PART in side for side in sides):
        width = count_columns(LANDMARK_PART)
        out[LANDMARK_PART] = np.concatenate([s.get(LANDMARK_PART, np.zeros((len(s["x"]), width), np.float32)) for s in sides])
    for name, of in (("rooms", "x"), ("edges", "edge_attr"), ("doors", "door_attr")):
        out[name] = np.array([len(side[of]) for side in sides])
    out["true"] = np.concatenate([side["true_room"] for side in sides]).astype(np.int32)
    out["iou"] = np.concatenate([side["true_iou"] for side in sides]).astype(np.float32)
    out["matches"] = np.concatenate([pair["matches"] for pair in pairs]).astype(np.int32)
    out["transform"] = np.stack([pair["transform"] for pair in pairs])
    out["partners"] = np.array([len(pair["matches"]) for pair in pairs])
    about = json.dumps([_select_columns(row) for row in rows], ensure_ascii=False)
    return out | {"about": np.frombuffer(about.encode(), np.uint8)}


def _select_columns(row: dict[str, Any]) -> dict[str, Any]:
    columns = ("file", "sides", "building", "source", "kind", "sensors", "overlap", "hard", "storeys")
    return {key: row[key] for key in columns if key in row}


def _unpack_pairs(arrays: dict[str, Array], extras: dict[str, Array]) -> list[GraphPair]:
    counts = {name: arrays[name].tolist() for name in ("rooms", "edges", "doors")}
    tensors = {name: torch.from_numpy(arrays[name]) for name in (*PACKED_TABLES, *PACKED_INDICES, "room_points")}
    tensors |= {name: torch.from_numpy(values) for name, values in extras.items()}
    split = {}
    for name, tensor in tensors.items():
        split[name] = tensor.split(counts[ROWS_OF.get(name, "rooms")], dim=1 if name in PACKED_INDICES else 0)
    maps = range(len(counts["rooms"]))
    graphs = [{name: parts[i].long() if name in PACKED_INDICES else parts[i] for name, parts in split.items()} for i in maps]
    true = torch.from_numpy(arrays["true"]).long().split(counts["rooms"])
    matches = torch.from_numpy(arrays["matches"]).long().split(arrays["partners"].tolist())
    about = json.loads(arrays["about"].tobytes())
    iou = torch.from_numpy(arrays["iou"]).split(counts["rooms"])
    truth = [list(zip(of[::2], of[1::2], strict=True)) for of in (true, iou)]
    poses = torch.from_numpy(arrays["transform"]).unbind()
    return [GraphPair(*one) for one in zip(graphs[::2], graphs[1::2], matches, *truth, about, poses, strict=True)]


def _compute_extra(name: str, arrays: dict[str, Array], packed_file: Path, log_line: Callable[[str], None], limit: int) -> Array:
    """Return a descriptor of all rooms, 0 of those beyond the limit; chunks that were reckoned before are read."""
    from topomerge.embedding.engineered import compute_point_features, compute_point_spectra

    reckon = {"engineered": compute_point_features, "shapedna": compute_point_spectra}[name]
    ends = np.concatenate([[0], np.cumsum(arrays["rooms"])])
    requested = int(ends[2 * limit]) if 0 < 2 * limit < len(ends) else len(arrays["x"])
    starts = np.append(ends[: -1 : 2 * PAIRS_PER_CHUNK], len(arrays["x"]))
    chunks = []
    for k, (first, last) in enumerate(itertools.pairwise(starts)):
        path = packed_file.with_name(f"{packed_file.stem}-{name}-{k}.npz")
        if first < requested and not path.exists():
            log_line(f"{name} of rooms {first} to {last} of {requested}")
            archive.write({"values": reckon(convert_to_metres(arrays["room_points"][first:last]))}, path)
        empty = np.zeros((last - first, count_columns(name)), np.float32)
        chunks.append(archive.read(path, "descriptors")["values"] if first < requested else empty)
    return np.concatenate(chunks)


def convert_to_metres(points: Array) -> Array:
    """Return points in millimetres as float32 in metres."""
    return points.astype(np.float32) * np.float32(0.001)


def hold_out(pairs: Sequence[GraphPair]) -> tuple[list[GraphPair], list[GraphPair]]:
    """Keep a tenth of the pairs from training, by whole physical buildings in the order of a hash of their names; at least one of
    them has rooms that match.

    Raises:
        InputError: no pair has any, or all that have are of one building.
    """
    buildings = [pair.buildings[0] for pair in pairs]
    held: set[str] = set()
    for name in sorted(set(buildings), key=lambda name: hashlib.sha256(name.encode()).digest()):
        watched = [p for p, of in zip(pairs, buildings, strict=True) if of in held]
        if 10 * len(watched) >= len(pairs) and any(len(p.matches) for p in watched):
            break
        held.add(name)
    parts = tuple([p for p, of in zip(pairs, buildings, strict=True) if (of in held) is which] for which in (False, True))
    if not all(any(len(p.matches) for p in part) for part in parts):
        raise InputError("too few pairs whose rooms match, to train on some buildings and watch others; make more of them")
    return parts[0], parts[1]


def number_buildings(names: Sequence[str]) -> Array:
    """Return (n,) number of each building, in the order in which they first come."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names], np.int64)


def mark_watched(buildings: Sequence[str], every: int) -> Array:
    """Return (n,) bool: the scans of every n-th building are watched."""
    return np.asarray(number_buildings(buildings) % every == 0)


def read_scan_building(path: Path) -> str:
    """Return the physical building of a cached scan (`plan_examples.build_scans`); each procedural one has a seed of its own.

    Raises:
        InputError: the file is damaged.
    """
    row = json.loads(archive.read(path, "cached scan", only=["about"])["about"].tobytes())
    return find_physical_building(row["source"], row["plan"]) if row["plan"] else f"procedural/{row['seed']}"


def name_building(row: Mapping[str, Any]) -> str:
    """Return the physical building of what is known about a pair of maps; of two buildings that of the first map."""
    return find_physical_building(str(row.get("source", "procedural")), str(row["building"]))
