"""One cached pair: made from an item, written as an archive of arrays, read back as tensors."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.degrade import UNCHANGED, degraded
from topomerge.datasets.pairs.drawing import with_plan
from topomerge.datasets.pairs.evaluation_pair import kept_arrays, save_maps, told_of_maps
from topomerge.datasets.pairs.items import Item, difficulty_of
from topomerge.datasets.pairs.pairs import Pair, make_pair
from topomerge.datasets.pairs.truth import room_truth, true_matches

from topomerge.embedding.graph import from_arrays, graph_arrays
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io import archive
from topomerge.io.atomic import replacing
from topomerge.io.listing import plain
from topomerge.types import Array, TopometricMap

if TYPE_CHECKING:
    from torch import Tensor
    from torch_geometric.data import Data

FEWEST = 2  # rooms that must come out of each map
LONGEST = 600.0  # s a pair: a hundred times what is usual, so that no slow machine makes another set


class TooLongError(InputError):
    """An item took too long; on another machine it may not."""


@dataclass(frozen=True)
class Row:
    """What became of an item: `reason` is empty where the pair was made."""

    name: str
    reason: str
    seconds: float


@dataclass(frozen=True)
class Example:
    """A cached pair.

    Args:
        a, b: graphs of the two maps (`embedding.graph`), with `true_room` (-1: none), `true_iou` and `true_one`.
        matches: (M, 2) extracted rooms of a and of b that are the same true room; rooms may be in several.
        transform: (4, 4) float64 T_ab; nan where there is none.
        about: sensors, overlap, kind, building, ...
    """

    a: Data
    b: Data
    matches: Tensor
    transform: Tensor
    about: dict[str, Any]


def make_file(item: Item, plans: Sequence[Sequence[Plan]], folder: str) -> Row:
    """Make an item's file in a folder, or one that tells why there is none. It never raises: what went wrong is in the row.

    One thread is used, so that as many workers as cores don't fight for them.
    """
    began = time.perf_counter()
    try:
        with one_thread(), time_limit(LONGEST):
            arrays = keep(item, plans, Path(folder)) if item.maps else make_arrays(item, plans)
            archive.write(arrays, Path(folder) / f"{item.name}.npz")
        reason = ""
    except Exception as error:  # one bad item must not end a build
        reason = " ".join(str(error).split())[:200]
        reason = reason if isinstance(error, InputError) else f"{type(error).__name__}: {reason}"
        if isinstance(error, InputError) and not isinstance(error, TooLongError):
            with replacing(Path(folder) / f"{item.name}.refused") as beside:  # the same inputs would be refused again
                beside.write_text(reason + "\n", encoding="utf-8")
    return Row(item.name, reason, time.perf_counter() - began)


def refusal(folder: Path, name: str) -> str:
    """Why an item was refused before; empty where it was not."""
    path = folder / f"{name}.refused"
    return path.read_text(encoding="utf-8").strip() if path.is_file() else ""


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS, OpenMP and numba to one thread."""
    import numba
    from threadpoolctl import threadpool_limits

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        numba.set_num_threads(threads)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """End what takes too long with an `InputError`; without effect in threads, which get no signals."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_: object) -> NoReturn:
        raise TooLongError(f"takes longer than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def make_arrays(item: Item, plans: Sequence[Sequence[Plan]]) -> dict[str, Array]:
    """Simulate, extract, judge: the arrays of an item.

    Raises:
        InputError: no candidate has such a pair, or a map has hardly a room.
    """
    pair = degraded(_first_pair(item, plans), item.change, item.seed)
    return pair_arrays(pair, extracted(pair, item), told_of(item))


def keep(item: Item, plans: Sequence[Sequence[Plan]], folder: Path) -> dict[str, Array]:
    """As `make_arrays`, with what evaluation needs (`kept`); the maps are written into the folder."""
    pair = degraded(_first_pair(item, plans), item.change, item.seed)
    maps = extracted(pair, item)
    arrays = pair_arrays(pair, maps, {**told_of(item), **told_of_maps(pair, maps)})
    arrays |= kept_arrays(pair, maps, (arrays["a.true_room"], arrays["b.true_room"]))
    save_maps(maps, folder, item.name)
    return arrays


def extracted(pair: Pair, item: Item) -> tuple[TopometricMap, TopometricMap]:
    """The maps of both clouds; with the space that rays crossed where they are kept.

    Raises:
        InputError: hardly a room comes out of one of them.
    """
    a, b = (extract(cloud, voxel_size=item.voxel_size, carve=item.maps) for cloud in (pair.a, pair.b))
    if min(len(a.rooms), len(b.rooms)) < FEWEST:
        raise InputError(f"fewer than {FEWEST} rooms were extracted from a map of {' or '.join(item.sensors)}")
    return a, b


def told_of(item: Item) -> dict[str, Any]:
    """What a file tells of its item; names of what came later are left out where they say nothing."""
    told = asdict(item)
    if item.change == UNCHANGED:
        del told["change"]
    if not item.maps:
        del told["maps"]
    return {**told, "file": f"{item.name}.npz", "asked_overlap": item.overlap, "points_per_room": item.points_per_room}


def pair_arrays(pair: Pair, maps: Sequence[TopometricMap], told: Mapping[str, Any]) -> dict[str, Array]:
    """The arrays of a file: the graphs of two maps, their true rooms, and what is told of them."""
    truths = [room_truth(m, cloud) for m, cloud in zip(maps, (pair.a, pair.b), strict=True)]
    matches = true_matches(truths[0], truths[1], pair.shared)
    arrays: dict[str, Array] = {}
    for side, found, truth in zip("ab", maps, truths, strict=True):
        arrays |= {f"{side}.{name}": array for name, array in graph_arrays(found, told["points_per_room"]).items()}
        arrays |= {f"{side}.true_{name}": truth[name] for name in ("room", "iou", "one")}
    arrays["matches"] = matches
    arrays["transform"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
    known = {
        **told,
        "building": pair.building,
        "overlap": round(pair.overlap, 4),
        "visited": [len(v) for v in pair.visited],
        "extracted": [len(t) for t in truths],
        "identified": [int((t["room"] >= 0).sum()) for t in truths],
        "one_to_one": [int(t["one"].sum()) for t in truths],
        "partners": [len(set(matches[:, k].tolist())) for k in (0, 1)],
        "points": [len(pair.a), len(pair.b)],
    }
    text = json.dumps(plain(known), sort_keys=True, ensure_ascii=False)
    arrays["about"] = np.frombuffer(text.encode(), np.uint8)
    return arrays


def _first_pair(item: Item, plans: Sequence[Sequence[Plan]]) -> Pair:
    """The pair of the first candidate that has one."""
    refused: InputError | None = None
    for k in range(len(item.buildings)):
        try:
            building, other = candidate(item, k, plans)
            rng = np.random.default_rng([item.seed, k])
            pair = make_pair(building, item.pair_settings, rng, other, difficulty_of(item), item.source)
            return with_plan(pair, building) if item.change[0] == "plan" else pair
        except InputError as error:
            refused = error
    raise refused or InputError("an item without buildings")


def candidate(item: Item, k: int, plans: Sequence[Sequence[Plan]]) -> tuple[Building, Building | None]:
    """Candidate k of an item's buildings, and its other building where the item is a hard negative that has one."""
    other = _building(item, len(item.buildings), plans) if item.hard == "other-building" else None
    return _building(item, k, plans), other


def _building(item: Item, k: int, plans: Sequence[Sequence[Plan]]) -> Building:
    """Candidate k; after the last one comes the other building."""
    name = (*item.buildings, item.other[0])[k]
    if item.source == "procedural":
        return make_building(item.kind, int(name), item.storeys, difficulty_of(item))
    return erect(plans[k], difficulty_of(item), item.seed % 100_000 + k, name, item.source)


def about(path: Path) -> dict[str, Any]:
    """What a cached pair is, after checking that the whole file can be read.

    Raises:
        InputError: it is damaged.
    """
    found: dict[str, Any] = json.loads(archive.read(path, "cached pair")["about"].tobytes())
    return found


def load_example(path: str | Path) -> Example:
    """Read a cached pair as tensors; nothing is unpickled.

    Raises:
        InputError: no such file, or it is damaged.
    """
    import torch

    arrays = archive.read(path, "cached pair")
    told = json.loads(arrays.pop("about").tobytes())
    sides = [from_arrays({n[2:]: a for n, a in arrays.items() if n.startswith(f"{s}.")}) for s in "ab"]
    matches, transform = torch.from_numpy(arrays["matches"]), torch.from_numpy(arrays["transform"])
    return Example(sides[0], sides[1], matches, transform, told)


class PairSet:
    """The pairs of a manifest, as a data set for `torch.utils.data.DataLoader`."""

    def __init__(self, manifest: str | Path) -> None:
        path = Path(manifest)
        if not path.is_file():
            raise InputError(f"{path}: no such manifest; make it with python -m topomerge.datasets.pairs.build")
        self.rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        self.folder = path.parent / "pairs"

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Example:
        return load_example(self.folder / self.rows[index]["file"])

    def __iter__(self) -> Iterator[Example]:
        return (self[i] for i in range(len(self)))
