"""Predictions, one file a pair: what each variant says of its rooms, which rooms match, and where the maps lie.

Seconds are of the processor, so that other jobs on the machine do not count.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.code_digest import code_digest
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows, aligned
from topomerge.errors import InputError
from topomerge.evaluation.describe import Inputs, Maps, described, trained
from topomerge.evaluation.settings import Evaluation, Variant, variants
from topomerge.fusion.match_belief import believed_matches
from topomerge.fusion.pipeline import merge
from topomerge.fusion.result import RoomMatch
from topomerge.io import archive
from topomerge.io.listing import plain
from topomerge.matching.costs import descriptor_costs
from topomerge.matching.match import match
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.verify import model
from topomerge.types import Array

WALLS_ALONE = "walls alone"  # way of merging
CODE = tuple(f"topomerge.{name}" for name in ("embedding.embedders", "matching.costs", "matching.match", "fusion.pipeline"))


def predict(path: Path, target: Path, settings: Evaluation) -> str:
    """Write the predictions of the kept pair `path` to `target`; its name.

    Raises:
        InputError: the pair can't be read.
    """
    pair = load_evaluation_pair(path)
    maps = pair.maps()
    evaluated_variants = list(variants(settings))
    arrays: dict[str, Array] = {}
    record: dict[str, Any] = {"pair": pair.name, "version": topomerge.__version__, "code": code_digest(*CODE)}
    inputs = Inputs()
    rows = {v.name: described(v, maps, path, settings, inputs) for v in evaluated_variants}
    record["seconds"] = {name: seconds for name, (_, seconds) in rows.items()}
    for v in evaluated_variants:
        a, b = aligned(*rows[v.name][0])
        arrays[f"{v.name}/a"], arrays[f"{v.name}/b"] = a.astype(np.float32), b.astype(np.float32)
        arrays[f"{v.name}/cost"] = descriptor_costs(a, b).astype(np.float32)
        for method in v.methods:
            arrays |= {
                f"{v.name}/{method}/{key}": value
                for key, value in matched(v, method, maps, rows[v.name][0], pair.about["scale_free"]).items()
            }
    record["merge"] = {WALLS_ALONE: by_walls_alone(maps, pair)} if settings.merge and settings.walls_alone else {}
    mergers = [v for v in evaluated_variants if merges(v, settings)]
    record["merge"] |= {v.name: merged(maps, rows[v.name][0], pair, settings.poses) for v in mergers}
    arrays["told"] = np.frombuffer(json.dumps(plain(record)).encode(), np.uint8)
    archive.write(arrays, target)
    return pair.name


def merges(variant: Variant, settings: Evaluation) -> bool:
    """Does this variant merge maps, too?"""
    return settings.merge and (bool(variant.run) or (variant.descriptor in settings.mergers and variant.k == 0))


def matched(variant: Variant, method: str, maps: Maps, rows: tuple[Rows, Rows], free: bool = False) -> dict[str, Array]:
    """`rooms` (M, 2), `probability` (M,) and `seconds` of a method; `free`: the second map has a scale of its own."""
    began = time.process_time()
    if method == "mutual":
        rooms, probability = mutual(trained(variant.run), maps) if variant.run else (np.zeros((0, 2), int), np.zeros(0))
    elif method == "attention" and free:
        rooms, probability = np.zeros((0, 2), int), np.zeros(0)
    else:
        name, largest = ("assignment", np.inf) if method == "full" else (method, None)
        room_matches = match(*maps, given(maps, rows), name, scale_free=free, largest_cost=largest)
        room_matches = believed_matches(room_matches, *maps, name)
        rooms, probability = room_matches.rooms, room_matches.probability
    return {"rooms": rooms.astype(np.int32), "probability": probability, "seconds": np.array(time.process_time() - began)}


def given(maps: Maps, rows: tuple[Rows, Rows]) -> Descriptor:
    """The descriptor that gives rows that were made before."""
    rows_by_map = {id(m): r for m, r in zip(maps, rows, strict=True)}
    return lambda m: rows_by_map[id(m)]


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


def merged(maps: Maps, rows: tuple[Rows, Rows], pair: EvaluationPair, poses: str) -> dict[str, Any]:
    """What the merge of both maps says: as plain values."""
    began = time.process_time()
    try:
        result = merge(maps, scale=_scale(pair), embedder=given(maps, rows), poses=poses)
    except InputError as error:
        return {"refused": str(error), **_verdict(None, False, (), 0.0)}
    return _verdict(result.registration, result.merged, result.matches, time.process_time() - began)


def by_walls_alone(maps: Maps, pair: EvaluationPair) -> dict[str, Any]:
    """The same without the rooms: registration of walls and free space, to which no descriptor proposes a pose."""
    began = time.process_time()
    registration = register(*maps, scale=_scale(pair))
    return _verdict(registration, registration.accepted, (), time.process_time() - began)


def _scale(pair: EvaluationPair) -> str:
    return "free" if pair.about["scale_free"] else "fixed"


def _verdict(registration: Registration | None, believed: bool, matches: Sequence[RoomMatch], seconds: float) -> dict[str, Any]:
    transform = None if registration is None else registration.transform
    return {
        "probability": float(registration.probability) if registration else 0.0,
        "believed": believed,
        "threshold": float(model()["threshold"]),
        "pose": None if transform is None else transform.matrix.tolist(),
        "rooms": [list(m.rooms) for m in matches],
        "chance": [m.probability for m in matches],
        "seconds": seconds,
    }


def predict_all(pairs: Sequence[Path], folder: Path, settings: Evaluation, say: Callable[[str], None]) -> list[Path]:
    """Files of the predictions of all pairs, made where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    targets = [folder / f"{p.stem}.npz" for p in pairs]
    left = [(p, t) for p, t in zip(pairs, targets, strict=True) if settings.remake or not t.exists()]
    said = time.monotonic()
    for number, _ in enumerate(_done(left, settings), 1):
        if time.monotonic() - said > 10 or number == len(left):
            said = time.monotonic()
            say(f"{len(targets) - len(left) + number} of {len(targets)} pairs predicted")
    return targets


def _done(left: Sequence[tuple[Path, Path]], settings: Evaluation) -> Iterator[str]:
    if settings.jobs == 1:
        return (predict(p, t, settings) for p, t in left)
    from joblib import Parallel, delayed

    parallel = Parallel(settings.jobs, return_as="generator", batch_size=1)
    names: Iterator[str] = parallel(delayed(predict)(p, t, settings) for p, t in left)
    return names
