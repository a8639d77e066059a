"""Pairs of extracted maps that are kept for evaluation: two `.tmap` beside the pair's file, and what judges them.

Beside what `example.build_pair_arrays` gives, the file holds for each room whether another room of the other map looks the same
(`a.twin`, `b.twin`), a point of b at which errors of a pose are measured (`anchor`) and, for real pairs whose rooms nobody
labelled, the rooms that lie over each other under the true transform (`laid`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import shapely
from topomerge.datasets.pairs.pairs import Pair

from topomerge import archive
from topomerge.embedding.graph import find_column
from topomerge.errors import InputError
from topomerge.io.maps import load_map, save_map
from topomerge.matching.consistency import find_matches
from topomerge.matching.room_plans import build_room_plans
from topomerge.types import Array, Sim3, TopometricMap, TrueRoom

TWIN_AREA, TWIN_SIDE = 0.05, 0.25  # share, m: rooms that differ by less are near-identical
GLIMPSED_COLUMN = find_column("x", "glimpsed")
COLUMN_SIZE = 0.2  # m, columns by which the area in common is measured
UNDER_FLOOR = 0.15  # m: what is that far below a floor is the ceiling of the storey below
STOREY_APART = 1.0  # m between two storeys, at least
FEWEST_COLUMNS = 50  # columns: maps that share fewer have no middle of what both saw
SAME_ROOM_IOU = 0.4  # IoU from which rooms that lie over each other are one


class HasTruth(Protocol):
    """Anything with a true transform, or None where it is not known."""

    @property
    def truth(self) -> Sim3 | None:
        """T_ab, maps b into a."""


@dataclass(frozen=True, eq=False)
class EvaluationPair:
    """A pair of maps with its truth, for evaluation; `maps` reads the maps.

    Args:
        name: of the files.
        matches: (M, 2) extracted rooms of a and of b that are one true room.
        true: of each map, (R,) true room of each extracted one, -1 none.
        one: of each map, (R,) is it the one that is assigned to the true room?
        twin: of each map, (R,) does the other map hold a near-identical room, another than its true partner?
        glimpsed: of each map, (R,) was it looked into only?
        transform: T_ab; None where there is none.
        anchor: (3,) a point of b in the middle of what both maps saw: drift bends maps, and no pose is right everywhere.
        about: sensors, source, building, overlap, kind, common (m2 that both saw), rooms ("labelled" or "laid"), ...
    """

    name: str
    folder: Path
    matches: Array
    true: tuple[Array, Array]
    one: tuple[Array, Array]
    twin: tuple[Array, Array]
    glimpsed: tuple[Array, Array]
    transform: Sim3 | None
    anchor: Array
    about: dict[str, Any]

    def load_maps(self) -> tuple[TopometricMap, TopometricMap]:
        """Load the two extracted maps."""
        a, b = (load_map(self.folder / f"{self.name}{side}.tmap") for side in "ab")
        return a, b


def save_maps(maps: Sequence[TopometricMap], folder: Path, name: str) -> None:
    """Write both maps under the name of their pair."""
    for side, map in zip("ab", maps, strict=True):
        save_map(map, folder / f"{name}{side}.tmap")


def load_evaluation_pair(path: Path) -> EvaluationPair:
    """Load an evaluation pair from its file.

    Raises:
        InputError: no such file, damaged, or its maps were not kept.
    """
    data = archive.read(path, "evaluation pair")
    if "anchor" not in data:
        raise InputError(f"{path}: its maps were not kept; build it with data.maps=true")
    about = json.loads(data["about"].tobytes())
    true, one, twin = ((data[f"a.{name}"], data[f"b.{name}"]) for name in ("true_room", "true_one", "twin"))
    glimpsed = (data["a.x"][:, GLIMPSED_COLUMN] > 0.5, data["b.x"][:, GLIMPSED_COLUMN] > 0.5)
    by_overlap = about["rooms"] == "laid"
    matches = data["laid" if by_overlap else "matches"]
    if by_overlap:  # no labels: the rooms that lie over each other stand for true ones
        true = _number_matched_rooms(matches, tuple(len(t) for t in true))
        one = (true[0] >= 0, true[1] >= 0)
    pose = convert_to_sim3(data["transform"])
    return EvaluationPair(path.stem, path.parent, matches, true, one, twin, glimpsed, pose, data["anchor"], about)


def load_set(manifest: Path) -> list[EvaluationPair]:
    """Load all pairs of a manifest that `build` wrote.

    Raises:
        InputError: no such manifest, or a pair's maps were not kept.
    """
    if not manifest.is_file():
        raise InputError(f"{manifest}: no such manifest; make it with python -m topomerge.datasets.pairs.build")
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    return [load_evaluation_pair(manifest.parent / "pairs" / row["file"]) for row in rows]


def _number_matched_rooms(matches: Array, sizes: Sequence[int]) -> tuple[Array, Array]:
    """Return a number of its own for each match; rooms without one have -1."""
    out = [np.full(n, -1) for n in sizes]
    for k, (i, j) in enumerate(matches.tolist()):
        out[0][i] = out[1][j] = k
    return out[0], out[1]


def convert_to_sim3(matrix: Array) -> Sim3 | None:
    """Return the similarity of a (4, 4) matrix; None of nan."""
    if np.isnan(matrix).any():
        return None
    x, y, z = matrix[:3, 3].tolist()
    return Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), float(matrix[2, 2]))


def compute_pair_statistics(pair: Pair, maps: Sequence[TopometricMap]) -> dict[str, Any]:
    """Compute the statistics that the file of an evaluation pair has beside the usual."""
    return {
        "source": pair.source,
        "kind": pair.kind,
        "sensors": pair.sensors,
        "common": round(measure_common_area(maps, pair.truth if pair.kind == "overlap" else None), 2),
        "rooms": "labelled" if pair.a.rooms else "laid",
        "scale_free": pair.truth is not None and abs(pair.truth.scale - 1) > 0.03,
    }


def build_evaluation_arrays(pair: Pair, maps: Sequence[TopometricMap], true: tuple[Array, Array]) -> dict[str, Array]:
    """Build the arrays that the file of an evaluation pair has beside the usual."""
    arrays = {"anchor": compute_anchor(pair, maps)}
    rooms = (pair.a.rooms, pair.b.rooms)
    same = pair.kind == "overlap"
    for k, side in enumerate("ab"):
        arrays[f"{side}.twin"] = find_twins(true[k], true[1 - k], rooms[k], rooms[1 - k], same)
    arrays["laid"] = match_overlapping_rooms(pair, maps) if not pair.a.rooms else np.zeros((0, 2), np.int64)
    return arrays


def find_twins(true: Array, other: Array, rooms: Sequence[TrueRoom], others: Sequence[TrueRoom], same: bool = True) -> Array:
    """Return (R,) bool: does the other map hold a room, another than the true partner, whose plan has the same area and sides?

    Args:
        true, other: true room of each extracted room of this map and of the other one, -1 none.
        rooms, others: their true rooms, in frames that may be turned but not scaled.
        same: are the true rooms numbered alike?
    """
    out = np.zeros(len(true), bool)
    if not rooms or not others:
        return out
    own_plans, others_plans = np.array([_measure_plan(r) for r in rooms]), np.array([_measure_plan(r) for r in others])
    held = np.unique(other[other >= 0])
    for i in np.flatnonzero(true >= 0):
        mine, these = own_plans[true[i]], others_plans[held[held != true[i]] if same else held]
        alike = (abs(these[:, 0] / mine[0] - 1) < TWIN_AREA) & (abs(these[:, 1:] - mine[1:]) < TWIN_SIDE).all(axis=1)
        out[i] = alike.any()
    return out


def _measure_plan(room: TrueRoom) -> tuple[float, float, float]:
    """Return the area, m2, and the sides of the smallest rectangle about it, m."""
    shape = shapely.Polygon(room.polygon)
    corners = np.array(shapely.minimum_rotated_rectangle(shape).exterior.coords)
    sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
    return float(shape.area), float(sides.min()), float(sides.max())


def measure_common_area(maps: Sequence[TopometricMap], truth: Sim3 | None) -> float:
    """Measure the area, m2, of which both maps saw something, on the same storey; 0 where they are of two places."""
    if truth is None:
        return 0.0
    floors = np.sort([*maps[0].storeys["floor"], *(truth.scale * maps[1].storeys["floor"] + truth.translation[2])])
    floors = floors[np.diff(floors, prepend=-np.inf) > STOREY_APART] - UNDER_FLOOR
    both = np.intersect1d(_compute_columns(maps[0], Sim3(), floors), _compute_columns(maps[1], truth, floors))
    return float(len(both) * COLUMN_SIZE**2)


def _compute_columns(map: TopometricMap, into: Sim3, floors: Array) -> Array:
    """Return the sorted keys of the (storey, x, y) columns of which a map knows anything, in another frame."""
    at = into.apply(np.concatenate([map.grid.compute_centroids(), map.navigable.compute_centroids()]))
    rows = np.column_stack([np.searchsorted(floors, at[:, 2]) - 1, np.floor(at[:, :2] / COLUMN_SIZE)]).astype(np.int64)
    return np.unique(rows[:, 0] * 2**40 + (rows[:, 1] + 2**18) * 2**20 + rows[:, 2] + 2**18)


def compute_anchor(pair: HasTruth, maps: Sequence[TopometricMap]) -> Array:
    """Compute (3,) middle of the cells of b that a has seen, too; of all where these are hardly any."""
    cells = maps[1].grid.compute_centroids()
    if pair.truth is not None:
        seen = [np.floor(c / 0.5).astype(np.int64) for c in (maps[0].grid.compute_centroids(), pair.truth.apply(cells))]
        keys = [k[:, 0] * 2**42 + k[:, 1] * 2**21 + k[:, 2] for k in seen]
        both = np.isin(keys[1], keys[0])
        cells = cells[both] if both.sum() > FEWEST_COLUMNS else cells
    middle: Array = cells.mean(axis=0)
    return middle


def match_overlapping_rooms(pair: Pair, maps: Sequence[TopometricMap]) -> Array:
    """Return (M, 2) rooms of which most of both lies over each other under the true transform, one to one."""
    t = pair.truth
    if t is None or pair.kind != "overlap":
        return np.zeros((0, 2), np.int64)
    rooms, fit = find_matches(t, (build_room_plans(maps[0]), build_room_plans(maps[1])))
    matches: list[tuple[int, int]] = []
    for i, j in rooms[np.argsort(-fit, kind="stable")][: int((fit >= SAME_ROOM_IOU).sum())].tolist():
        if i not in {k[0] for k in matches} and j not in {k[1] for k in matches}:
            matches.append((i, j))
    return np.array(sorted(matches), np.int64).reshape(-1, 2)
