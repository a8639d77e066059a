"""Descriptors of the maps of a pair; those that are not trained are kept in a cache, as some take seconds a map."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import topomerge
from topomerge.code_digest import code_digest
from topomerge.embedding.embedders import EMBEDDERS, embedder
from topomerge.embedding.learned import POINT_TABLES
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.turns import Rows, numbers
from topomerge.evaluation.settings import Evaluation, Variant
from topomerge.io import archive
from topomerge.io.listing import plain
from topomerge.types import Array, TopometricMap

Maps = tuple[TopometricMap, TopometricMap]


@cache
def trained(run: str) -> Any:
    """A trained embedder; read once."""
    return topomerge.load_embedder(run)


class Inputs:
    """What networks read of the maps of a pair: made once, as several read the same; the seconds count for each that reads it."""

    def __init__(self) -> None:
        self.arrays: dict[tuple[int, bool, bool], dict[str, Array]] = {}
        self.seconds: dict[tuple[int, bool, bool, str], float] = {}

    def rows(self, learned: Any, side: int, m: TopometricMap) -> tuple[Rows, float]:
        """Descriptors of a map by a network, and the seconds."""
        key = (side, learned.needs_points, learned.network.turns > 1)
        if key not in self.arrays:
            began = time.process_time()
            self.arrays[key] = learned.arrays(m)
            self.seconds[*key, ""] = time.process_time() - began
        arrays = self.arrays[key]
        extras = [name for name in POINT_TABLES if name in learned.network.geometry.parts]
        for name in extras:
            if name not in arrays and len(arrays["x"]):
                began = time.process_time()
                arrays[name] = POINT_TABLES[name](arrays["room_points"])
                self.seconds[*key, name] = time.process_time() - began
        began = time.process_time()
        rows: Rows = learned.graph(arrays)[0]
        spent = sum(self.seconds.get((*key, name), 0.0) for name in ("", *extras))
        return rows, time.process_time() - began + spent


def described(variant: Variant, maps: Maps, path: Path, settings: Evaluation, inputs: Inputs) -> tuple[tuple[Rows, Rows], float]:
    """Descriptors of both maps of the pair `path`, and the seconds that making them took."""
    if variant.run:
        learned = trained(variant.run)
        (a, first), (b, second) = (inputs.rows(learned, side, m) for side, m in enumerate(maps))
        return (a, b), first + second
    options = settings.descriptors[variant.descriptor]
    top = max(settings.k) if variant.k and variant.context == "join" else 0
    descriptors, seconds = [], 0.0
    for side, m in zip("ab", maps, strict=True):
        shelf = Shelf(Path(settings.cache) / "descriptors", path.with_name(f"{path.stem}{side}.tmap"))
        rows, took = shelf.rows(m, options, top)
        if variant.context == "mean" and variant.k:
            rows = np.asarray(embedder(_gives(rows), variant.k, "mean")(m))
        descriptors.append(rows[:, : rows.shape[1] // (top + 1) * (variant.k + 1)] if top else rows)
        seconds += took
    return (descriptors[0], descriptors[1]), seconds


def code_of(name: str) -> str:
    """Digest of the code and data that the descriptors of a name, alone or joined with surroundings, come from."""
    return code_digest(EMBEDDERS[name].__module__, "topomerge.embedding.context")


def _gives(rows: Array) -> Descriptor:
    return lambda m: rows


class Shelf:
    """Cached descriptors of the map of one file, named by a hash of the map, the options, the code and its data.

    Joined surroundings of fewer steps are the first columns of those of more, so that only the most are made.
    """

    def __init__(self, folder: Path, source: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.source = folder, source

    def rows(self, m: TopometricMap, options: Mapping[str, Any], steps: int) -> tuple[Array, float]:
        """(R, (steps + 1) D) the rooms' own and those of their joined surroundings; and the seconds that they took."""
        digest = hashlib.sha256(self.source.read_bytes()).hexdigest()
        inputs = json.dumps([digest, plain(dict(options)), steps, code_of(str(options["name"]))], sort_keys=True)
        file = self.folder / f"{hashlib.sha256(inputs.encode()).hexdigest()[:24]}.npz"
        if not file.exists():
            describe = embedder(str(options["name"]), **{k: v for k, v in options.items() if k != "name"})
            lone_rows, took = self.rows(m, options, 0) if steps else (None, 0.0)
            began = time.process_time()
            if lone_rows is None:
                rows = describe(m)
            else:
                rows = embedder(lambda other: lone_rows if other is m else describe(other), steps, "join")(m)
            archive.write({"rows": numbers(rows), "seconds": np.array(took + time.process_time() - began)}, file)
        data = archive.read(file, "cached descriptors")
        return data["rows"], float(data["seconds"])
