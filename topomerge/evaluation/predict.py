"""Predictions, one file a pair: what each variant says of its rooms, which rooms match, and where the maps lie."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.datasets.kept import KeptPair, load_kept
from topomerge.embedding.embedders import embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.errors import InputError
from topomerge.evaluation.settings import Evaluation, Variant, variants
from topomerge.fusion.merge import merge
from topomerge.fusion.verify import model
from topomerge.io import archive
from topomerge.io.listing import plain
from topomerge.matching.costs import descriptor_costs
from topomerge.matching.match import match
from topomerge.types import Array, TopometricMap

Maps = tuple[TopometricMap, TopometricMap]


def predict(path: Path, target: Path, settings: Evaluation) -> None:
    """Write the predictions of the kept pair `path` to `target`, if they are not there.

    Raises:
        InputError: the pair can't be read.
    """
    if target.exists() and not settings.remake:
        return
    kept = load_kept(path)
    maps = kept.maps()
    some = list(variants(settings))
    arrays: dict[str, Array] = {}
    told: dict[str, Any] = {
        "pair": kept.name,
        "version": topomerge.__version__,
        "code": code("matching/*.py", "fusion/*.py", *UNTRAINED),
    }
    rows = {v.name: described(v, maps, path, settings) for v in some}
    told["seconds"] = {name: seconds for name, (_, seconds) in rows.items()}
    for v in some:
        a, b = rows[v.name][0]
        arrays[f"{v.name}/a"], arrays[f"{v.name}/b"] = a.astype(np.float32), b.astype(np.float32)
        arrays[f"{v.name}/cost"] = descriptor_costs(a, b).astype(np.float32)
        for method in v.methods:
            arrays |= {f"{v.name}/{method}/{key}": value for key, value in matched(v, method, maps, (a, b)).items()}
    told["merge"] = {v.name: merged(maps, rows[v.name][0], kept) for v in some if merges(v, settings)}
    arrays["told"] = np.frombuffer(json.dumps(plain(told)).encode(), np.uint8)
    archive.write(arrays, target)


def merges(variant: Variant, settings: Evaluation) -> bool:
    """Does this variant merge maps, too?"""
    return settings.merge and (bool(variant.run) or (variant.descriptor in settings.mergers and variant.k == 0))


UNTRAINED = (
    *(f"embedding/{n}" for n in ("engineered.*", "shapedna.py", "laplacian.py", "feather.py", "context.py", "room_cells.py")),
    "kernels/voronoi.py",
)


@cache
def code(*patterns: str) -> str:
    """Digest of the code that something comes from: files of the package, by pattern."""
    whole = hashlib.sha256()
    for pattern in patterns:
        for file in sorted(Path(topomerge.__file__).parent.glob(pattern)):
            whole.update(file.read_bytes())
    return whole.hexdigest()[:12]


def described(variant: Variant, maps: Maps, path: Path, settings: Evaluation) -> tuple[tuple[Array, Array], float]:
    """Descriptors (R, D) of both maps, from the cache where they are there, and the seconds that making them took.

    The columns of fewer steps of context are the first ones of more, so that only the largest k is made.
    """
    if variant.run:
        began = time.perf_counter()
        learned = trained(variant.run)
        a, b = (np.asarray(learned(m)) for m in maps)
        return (a, b), time.perf_counter() - began
    folder = Path(settings.cache) / "descriptors"
    folder.mkdir(parents=True, exist_ok=True)
    options = dict(settings.descriptors[variant.descriptor])
    top = max(settings.k)
    found, seconds = [], 0.0
    for side, m in zip("ab", maps, strict=True):
        source = path.with_name(f"{path.stem}{side}.tmap")
        rows, took = _cached(folder, source, m, options, top, variant.context if top else "join", variant.k)
        found.append(rows)
        seconds += took
    return (found[0], found[1]), seconds


def _cached(
    folder: Path, source: Path, m: TopometricMap, options: Mapping[str, Any], top: int, how: str, k: int
) -> tuple[Array, float]:
    inputs = [
        hashlib.sha256(source.read_bytes()).hexdigest(),
        plain(options),
        top,
        how if top else "",
        code(*UNTRAINED),
    ]
    file = folder / f"{hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:24]}.npz"
    if not file.exists():
        rest = {key: value for key, value in options.items() if key != "name"}
        own = _Timed(embedder(options["name"], **rest))
        rows = embedder(own, top, how)(m) if top else own(m)
        archive.write({"rows": rows, "seconds": np.array([own.first, own.total])}, file)
    data = archive.read(file, "cached descriptors")
    width = data["rows"].shape[1] // (top + 1)
    return data["rows"][:, : (k + 1) * width], float(data["seconds"][0] if k == 0 else data["seconds"][1])


class _Timed:
    """A descriptor that knows how long it took: at first, for the rooms themselves, and in all."""

    def __init__(self, describe: Descriptor) -> None:
        self.describe, self.first, self.total = describe, 0.0, 0.0

    def __call__(self, m: TopometricMap) -> Array:
        began = time.perf_counter()
        rows = self.describe(m)
        self.total += time.perf_counter() - began
        self.first = self.first or self.total
        return rows


@cache
def trained(run: str) -> Any:
    """A trained embedder; read once."""
    return topomerge.load_embedder(run)


def matched(variant: Variant, method: str, maps: Maps, rows: tuple[Array, Array]) -> dict[str, Array]:
    """`rooms` (M, 2), `probability` (M,) and `seconds` of a method."""
    began = time.perf_counter()
    if method == "mutual":
        rooms, probability = mutual(trained(variant.run), maps) if variant.run else (np.zeros((0, 2), int), np.zeros(0))
    else:
        found = match(*maps, given(maps, rows), "assignment" if method == "full" else method, largest_cost=LARGEST.get(method))
        rooms, probability = found.rooms, found.probability
    return {"rooms": rooms.astype(np.int32), "probability": probability, "seconds": np.array(time.perf_counter() - began)}


LARGEST = {"full": np.inf}


def given(maps: Maps, rows: tuple[Array, Array]) -> Descriptor:
    """The descriptor that gives rows that were made before."""
    known = {id(m): r for m, r in zip(maps, rows, strict=True)}
    return lambda m: known[id(m)]


def mutual(learned: Any, maps: Maps) -> tuple[Array, Array]:
    """Rooms that are each other's likeliest partner, likelier than none, and how likely: the geometric mean of both sides.

    Raises:
        InputError: the embedder tells no probabilities.
    """
    if not hasattr(learned, "probabilities"):
        raise InputError("methods: mutual needs an embedder that tells probabilities; leave it out")
    rows, columns = learned.probabilities(*maps)
    if not rows.size or not columns.size:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    best, back = rows.argmax(axis=1), columns.argmax(axis=1)
    i = np.array([k for k, j in enumerate(best.tolist()) if j < len(columns) and back[j] == k], np.int64)
    j = best[i]
    return np.stack([i, j], axis=1), np.sqrt(rows[i, j] * columns[j, i])


def merged(maps: Maps, rows: tuple[Array, Array], kept: KeptPair) -> dict[str, Any]:
    """What the merge of both maps says: as plain values."""
    scale = "free" if kept.about["scale_free"] else "fixed"
    began, cpu = time.perf_counter(), time.process_time()
    try:
        result = merge(maps, scale=scale, embedder=given(maps, rows))
    except InputError as error:
        return {
            "refused": str(error),
            "probability": 0.0,
            "believed": False,
            "pose": None,
            "rooms": [],
            "chance": [],
            "seconds": 0.0,
        }
    found = result.registration
    pose = None if found is None or found.transform is None else found.transform.matrix.tolist()
    return {
        "probability": float(result.probability),
        "believed": result.merged,
        "threshold": float(model()["threshold"]),
        "pose": pose,
        "rooms": [list(m.rooms) for m in result.matches],
        "chance": [m.probability for m in result.matches],
        "seconds": time.perf_counter() - began,
        "cpu": time.process_time() - cpu,
    }


def predict_all(pairs: Sequence[Path], folder: Path, settings: Evaluation, say: Callable[[str], None]) -> list[Path]:
    """Files of the predictions of all pairs, made where they are missing; what was made by other code is kept, and said."""
    folder.mkdir(parents=True, exist_ok=True)
    targets = [folder / f"{p.stem}.npz" for p in pairs]
    left = [(p, t) for p, t in zip(pairs, targets, strict=True) if settings.remake or not t.exists()]
    said = time.monotonic()
    for number, _ in enumerate(_done(left, settings), 1):
        if time.monotonic() - said > 10 or number == len(left):
            said = time.monotonic()
            say(f"{len(targets) - len(left) + number} of {len(targets)} pairs predicted")
    return targets


def _done(left: Sequence[tuple[Path, Path]], settings: Evaluation) -> Any:
    if settings.jobs == 1:
        return (predict(p, t, settings) for p, t in left)
    from joblib import Parallel, delayed

    parallel = Parallel(settings.jobs, return_as="generator", batch_size=1)
    return parallel(delayed(predict)(p, t, settings) for p, t in left)
