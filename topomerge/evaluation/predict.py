"""Predict matches and merges of cached pairs, with descriptors kept."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge import archive
from topomerge.archive import convert_to_plain
from topomerge.code_digest import compute_code_digest
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair
from topomerge.embedding.learned import EMBEDDERS, POINT_TABLES, build_embedder
from topomerge.embedding.quarter_turns import Descriptor, Rows, get_rows
from topomerge.errors import InputError
from topomerge.evaluation.settings import Evaluation, Variant, iter_variants
from topomerge.fusion.match_belief import update_match_probabilities
from topomerge.fusion.pipeline import merge
from topomerge.fusion.result import RoomMatch
from topomerge.matching.assignment import compute_descriptor_costs
from topomerge.matching.match import match
from topomerge.progress import Stopwatch
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.verify import load_model
from topomerge.types import Array, TopometricMap

Maps = tuple[TopometricMap, TopometricMap]


@cache
def load_trained(run: str) -> Any:
    """Return a trained embedder; read once."""
    return topomerge.load_embedder(run)


class Inputs:
    """Inputs of networks from the maps of a pair: made once, as several read the same; the seconds count for each that reads
    it."""

    def __init__(self) -> None:
        self.views: dict[tuple[int, bool, bool], list[dict[str, Array]]] = {}
        self.seconds: dict[tuple[int, bool, bool, str], float] = {}

    def embed_rows(self, learned: Any, side: int, m: TopometricMap) -> tuple[Rows, float]:
        """Return descriptors of a map by a network, and the seconds."""
        key = (side, learned.needs_points, learned.network.turns > 1)
        if key not in self.views:
            began = time.process_time()
            self.views[key] = learned.build_views(m)
            self.seconds[*key, ""] = time.process_time() - began
        views = self.views[key]
        arrays = views[0]
        extras = [name for name in POINT_TABLES if name in learned.network.geometry.parts]
        for name in extras:
            if name not in arrays and len(arrays["x"]):
                began = time.process_time()
                table = POINT_TABLES[name](arrays["room_points"])
                for view in views:
                    view[name] = table
                self.seconds[*key, name] = time.process_time() - began
        began = time.process_time()
        rows: Rows = learned.embed_views(views)[0]
        spent = sum(self.seconds.get((*key, name), 0.0) for name in ("", *extras))
        return rows, time.process_time() - began + spent


def describe_maps(
    variant: Variant, maps: Maps, path: Path, settings: Evaluation, inputs: Inputs
) -> tuple[tuple[Rows, Rows], float]:
    """Return descriptors of both maps of the pair `path`, and the seconds that making them took."""
    if variant.run:
        learned = load_trained(variant.run)
        (a, first), (b, second) = (inputs.embed_rows(learned, side, m) for side, m in enumerate(maps))
        return (a, b), first + second
    options = settings.descriptors[variant.descriptor]
    top = max(settings.k) if variant.k and variant.context == "join" else 0
    descriptors, seconds = [], 0.0
    for side, m in zip("ab", maps, strict=True):
        shelf = DescriptorCache(Path(settings.cache) / "descriptors", path.with_name(f"{path.stem}{side}.tmap"))
        rows, took = shelf.get_rows(m, options, top)
        if variant.context == "mean" and variant.k:
            rows = np.asarray(build_embedder(_wrap_rows(rows), variant.k, "mean")(m))
        descriptors.append(rows[:, : rows.shape[1] // (top + 1) * (variant.k + 1)] if top else rows)
        seconds += took
    return (descriptors[0], descriptors[1]), seconds


def digest_descriptor_code(name: str) -> str:
    """Compute the digest of the code and data that the descriptors of a name, alone or joined with surroundings, come from."""
    return compute_code_digest(EMBEDDERS[name].__module__, "topomerge.embedding.engineered")


def _wrap_rows(rows: Array) -> Descriptor:
    return lambda m: rows


class DescriptorCache:
    """Cached descriptors of the map of one file, named by a hash of the map, the options, the code and its data.

    Joined surroundings of fewer steps are the first columns of those of more, so that only the most are made.
    """

    def __init__(self, folder: Path, source: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.source = folder, source

    def get_rows(self, m: TopometricMap, options: Mapping[str, Any], steps: int) -> tuple[Array, float]:
        """Return (R, (steps + 1) D), the rooms' own rows and those of their joined surroundings; and the seconds that they
        took."""
        digest = hashlib.sha256(self.source.read_bytes()).hexdigest()
        inputs = json.dumps(
            [digest, convert_to_plain(dict(options)), steps, digest_descriptor_code(str(options["name"]))], sort_keys=True
        )
        file = self.folder / f"{hashlib.sha256(inputs.encode()).hexdigest()[:24]}.npz"
        if not file.exists():
            describe = build_embedder(str(options["name"]), **{k: v for k, v in options.items() if k != "name"})
            lone_rows, took = self.get_rows(m, options, 0) if steps else (None, 0.0)
            began = time.process_time()
            if lone_rows is None:
                rows = describe(m)
            else:
                rows = build_embedder(lambda other: lone_rows if other is m else describe(other), steps, "join")(m)
            archive.write({"rows": get_rows(rows), "seconds": np.array(took + time.process_time() - began)}, file)
        data = archive.read(file, "cached descriptors")
        return data["rows"], float(data["seconds"])


WALLS_ALONE = "walls alone"  # way of merging
CODE = tuple(f"topomerge.{name}" for name in ("embedding.learned", "matching.assignment", "matching.match", "fusion.pipeline"))


def predict(path: Path, target: Path, settings: Evaluation) -> str:
    """Write the predictions of the kept pair `path` to `target`; its name.

    Raises:
        InputError: the pair can't be read.
    """
    pair = load_evaluation_pair(path)
    maps = pair.load_maps()
    evaluated_variants = list(iter_variants(settings))
    arrays: dict[str, Array] = {}
    record: dict[str, Any] = {"pair": pair.name, "version": topomerge.__version__, "code": compute_code_digest(*CODE)}
    inputs = Inputs()
    rows = {v.name: describe_maps(v, maps, path, settings, inputs) for v in evaluated_variants}
    record["seconds"] = {name: seconds for name, (_, seconds) in rows.items()}
    for v in evaluated_variants:
        arrays[f"{v.name}/cost"] = compute_descriptor_costs(*rows[v.name][0]).astype(np.float32)
        for method in v.methods:
            arrays |= {
                f"{v.name}/{method}/{key}": value
                for key, value in match_rooms(v, method, maps, rows[v.name][0], pair.about["scale_free"]).items()
            }
    record["merge"] = {WALLS_ALONE: register_walls(maps, pair)} if settings.merge and settings.walls_alone else {}
    mergers = [v for v in evaluated_variants if has_merges(v, settings)]
    record["merge"] |= {v.name: merge_maps(maps, rows[v.name][0], pair, settings.poses) for v in mergers}
    arrays["told"] = np.frombuffer(json.dumps(convert_to_plain(record)).encode(), np.uint8)
    archive.write(arrays, target)
    return pair.name


def has_merges(variant: Variant, settings: Evaluation) -> bool:
    """Return whether this variant merges maps, too."""
    return settings.merge and (bool(variant.run) or (variant.descriptor in settings.mergers and variant.k == 0))


def match_rooms(variant: Variant, method: str, maps: Maps, rows: tuple[Rows, Rows], free: bool = False) -> dict[str, Array]:
    """Return `rooms` (M, 2), `probability` (M,) and `seconds` of a method; `free`: the second map has a scale of its own."""
    began = time.process_time()
    if method == "mutual":
        rooms, probability = (
            match_mutually(load_trained(variant.run), maps) if variant.run else (np.zeros((0, 2), int), np.zeros(0))
        )
    elif method == "attention" and free:
        rooms, probability = np.zeros((0, 2), int), np.zeros(0)
    else:
        name, largest = ("assignment", np.inf) if method == "full" else (method, None)
        room_matches = match(*maps, build_fixed_descriptor(maps, rows), name, scale_free=free, largest_cost=largest)
        room_matches = update_match_probabilities(room_matches, *maps, name)
        rooms, probability = room_matches.rooms, room_matches.probability
    return {"rooms": rooms.astype(np.int32), "probability": probability, "seconds": np.array(time.process_time() - began)}


def build_fixed_descriptor(maps: Maps, rows: tuple[Rows, Rows]) -> Descriptor:
    """Return the descriptor that gives rows that were made before."""
    rows_by_map = {id(m): r for m, r in zip(maps, rows, strict=True)}
    return lambda m: rows_by_map[id(m)]


def match_mutually(learned: Any, maps: Maps) -> tuple[Array, Array]:
    """Return rooms that are each other's likeliest partner, likelier than none, and how likely: the geometric mean of both sides.

    Raises:
        InputError: the embedder tells no probabilities.
    """
    if not hasattr(learned, "compute_probabilities"):
        raise InputError("methods: mutual needs an embedder that tells probabilities; leave it out")
    rows, columns = learned.compute_probabilities(*maps)
    if not rows.size or not columns.size:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    best, back = rows.argmax(axis=1), columns.argmax(axis=1)
    i = np.array([k for k, j in enumerate(best.tolist()) if j < len(columns) and back[j] == k], np.int64)
    j = best[i]
    return np.stack([i, j], axis=1), np.sqrt(rows[i, j] * columns[j, i])


def merge_maps(maps: Maps, rows: tuple[Rows, Rows], pair: EvaluationPair, poses: str) -> dict[str, Any]:
    """Merge both maps and return the verdict as plain values."""
    began = time.process_time()
    try:
        result = merge(maps, scale=_choose_scale(pair), embedder=build_fixed_descriptor(maps, rows), poses=poses)
    except InputError as error:
        return {"refused": str(error), **_build_verdict(None, False, (), 0.0)}
    return _build_verdict(result.registration, result.merged, result.matches, time.process_time() - began)


def register_walls(maps: Maps, pair: EvaluationPair) -> dict[str, Any]:
    """Register walls and free space without rooms: no descriptor proposes a pose."""
    began = time.process_time()
    registration = register(*maps, scale=_choose_scale(pair))
    return _build_verdict(registration, registration.accepted, (), time.process_time() - began)


def _choose_scale(pair: EvaluationPair) -> str:
    return "free" if pair.about["scale_free"] else "fixed"


def _build_verdict(
    registration: Registration | None, accepted: bool, matches: Sequence[RoomMatch], seconds: float
) -> dict[str, Any]:
    transform = None if registration is None else registration.transform
    return {
        "probability": float(registration.probability) if registration else 0.0,
        "believed": accepted,
        "threshold": float(load_model()["threshold"]),
        "pose": None if transform is None else transform.matrix.tolist(),
        "rooms": [list(m.rooms) for m in matches],
        "chance": [m.probability for m in matches],
        "seconds": seconds,
    }


def predict_all(pairs: Sequence[Path], folder: Path, settings: Evaluation, log_line: Callable[[str], None]) -> list[Path]:
    """Return files of the predictions of all pairs, made where they are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    targets = [folder / f"{p.stem}.npz" for p in pairs]
    left = [(p, t) for p, t in zip(pairs, targets, strict=True) if settings.remake or not t.exists()]
    last, watch = 0.0, Stopwatch()
    for number, _ in enumerate(_iter_predicted(left, settings), 1):
        if watch.elapsed - last > 10 or number == len(left):
            last = watch.elapsed
            log_line(f"{len(targets) - len(left) + number} of {len(targets)} pairs predicted")
    return targets


def _iter_predicted(left: Sequence[tuple[Path, Path]], settings: Evaluation) -> Iterator[str]:
    if settings.jobs == 1:
        return (predict(p, t, settings) for p, t in left)
    from joblib import Parallel, delayed

    parallel = Parallel(settings.jobs, return_as="generator", batch_size=1)
    names: Iterator[str] = parallel(delayed(predict)(p, t, settings) for p, t in left)
    return names
