"""Real pairs as pairs of grids (`pairs.grid_pairs`), and those of the development floor cached as such: one may fit to them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from topomerge.datasets.core.builder import Say
from topomerge.datasets.pairs.grid_pairs import GRID_FORMAT, GridPair, common_area, free_of, grid_arrays, grid_of
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.real.sources import iter_real_pairs

from topomerge.io import archive

SLICES = ["laser2d", "laser2d"]  # what the captures of the floor are to the verdict: seen at one height, with no scale


def real_grid_pairs(folder: str | Path, sources: Sequence[str] | None = None) -> Iterator[GridPair]:
    """The real pairs of some sources (all but those to choose by where None are named) at 0.1 m."""
    for name, pair in iter_real_pairs(folder, sources):
        if isinstance(pair, Pair):
            a, b = grid_of(pair.a), grid_of(pair.b)
            free = tuple(free_of(c, g) if c.poses is not None else c.free for c, g in ((pair.a, a), (pair.b, b)))
            about: dict[str, object] = {
                "sensors": list(pair.sensors),
                "kind": pair.kind,
                "building": pair.building,
                "source": pair.source,
            }
            about["overlap"] = pair.overlap
            common = common_area(pair, a, b, (free[0], free[1]))
            yield GridPair(name, a, b, (free[0], free[1]), pair.truth, common, about)


def build_floor(folder: str | Path, cache: str | Path, say: Say = lambda text: None) -> list[Path]:
    """Files of the pairs of the development floor, in the order of the pairs, as `build_grids` makes those of simulated ones.

    Raises:
        InputError: the floor is not in the folder.
    """
    place = Path(cache).resolve() / "grids"
    place.mkdir(parents=True, exist_ok=True)
    listed = place.parent / "development_floor.jsonl"
    rows = [json.loads(line) for line in listed.read_text(encoding="utf-8").splitlines()] if listed.is_file() else []
    if rows and all((place / row["file"]).exists() for row in rows):
        return [place / row["file"] for row in rows]
    rows = []
    for pair in real_grid_pairs(folder, ("office_floor",)):
        name = hashlib.sha256(json.dumps(["floor", GRID_FORMAT, pair.name]).encode()).hexdigest()[:24]
        about = {**pair.about, "sensors": SLICES, "scaled": True, "common": pair.common, "captures": pair.name.rpartition("/")[2]}
        arrays = {**grid_arrays("a", pair.a, pair.free[0]), **grid_arrays("b", pair.b, pair.free[1])}
        arrays["truth"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
        arrays["about"] = np.frombuffer(json.dumps(about, sort_keys=True, default=str).encode(), np.uint8)
        archive.write(arrays, place / f"{name}.npz")
        rows.append({"file": f"{name}.npz", "pair": pair.name})
        say(f"{pair.name}: {len(rows)}")
    listed.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return [place / row["file"] for row in rows]
