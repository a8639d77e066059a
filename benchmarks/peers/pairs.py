"""The pairs that peers are compared on, in the order in which they are run.

Cells of kind and area in turn, and of pairs that must not merge each kind; real pairs; pairs with all points that were simulated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import load_set
from topomerge.datasets.pairs.example import make_first_pair
from topomerge.datasets.pairs.grid_pairs import GridItem, GridPair, draw_grid_items, load_grids
from topomerge.datasets.pairs.items import Library, select_plans

from topomerge.errors import InputError
from topomerge.evaluation.merge_report import modality
from topomerge.evaluation.tasks import iterate_real_pairs, make_pair_files, read_recipe
from topomerge.extraction.cleaning import compute_cell_means
from topomerge.types import Array, VoxelGrid

HELDOUT = Path("cache/evaluation/heldout.jsonl")
AREA_BINS = {"<40 m²": (1.0, 40.0), "40–80 m²": (40.0, 80.0), "≥80 m²": (80.0, np.inf)}
OVERLAP_BINS = {"<0.25": (0.0, 0.25), "0.25–0.5": (0.25, 0.5), "≥0.5": (0.5, np.inf)}
PAIR_CLASSES = ("3D–3D", "with a slice", "with a floor plan")  # `merge_report.modality`
ORDINARY = PAIR_CLASSES[0]
MOST_AREA = tuple(AREA_BINS)[-1]
COMMON_TURN = 4  # ordinary pairs with the largest area in a turn, where other cells have one
FIRST_PAIRS, RAW_PAIRS = 30, 30  # test pairs of that cell before all others; pairs with all their points
PEER_SPLITS = {  # sets whose buildings `register` can tell
    "train": "train", "test": "test", "raw": "test", "thinned": "test", "real": "real",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class PeerPair:
    """A pair as cells, and the clouds that the peers get: (n, 3) m of b and of a, b at the scale of a."""

    pair: GridPair
    b: Array
    a: Array


def list_pair_files(split: str) -> list[Path]:
    """List the files of a split, made where they are missing."""
    return make_pair_files(split, "cache", 1, print)


def find_bin(value: float, bins: Mapping[str, tuple[float, float]] = AREA_BINS) -> str:
    """Return the bin of a value; of the area that both maps saw if nothing else is said."""
    return next(name for name, (low, high) in bins.items() if low <= value < high)


def find_cell(about: Mapping[str, Any]) -> tuple[str, str]:
    """Return the class of sensors, and the area in common or, of pairs that must not merge, their kind."""
    alike = about["kind"] == "overlap"
    shared = "nothing in common" if alike and about["common"] < 1 else ""
    return modality(about), shared or (find_bin(about["common"]) if alike else about["kind"])


def described(pair: GridPair) -> dict[str, Any]:
    """Select the properties of a pair that a line of results reports."""
    names = ("sensors", "building", "kind", "source", "overlap", "differs", "walls_differ", "lookalike", "tellable", "furniture")
    return {name: pair.about[name] for name in names if name in pair.about}


def iter_in_turn(groups: Mapping[tuple[str, str], Sequence[Path]], many: Callable[[tuple[str, str]], int]) -> Iterator[Path]:
    """Yield `many` of each group in each turn, until all have had theirs."""
    turns = max((-(-len(paths) // many(key)) for key, paths in groups.items()), default=0)
    for k in range(turns):
        for key, paths in sorted(groups.items()):
            yield from paths[k * many(key) : (k + 1) * many(key)]


def group_by_cell(paths: Sequence[Path]) -> dict[tuple[str, str], list[Path]]:
    """Group files by `find_cell`; drawings of unknown scale are left out, as the peers have no scale to find."""
    groups: dict[tuple[str, str], list[Path]] = {}
    for path in paths:
        with np.load(path) as arrays:
            about = json.loads(arrays["about"].tobytes())
        if not about.get("scaled"):
            groups.setdefault(find_cell(about), []).append(path)
    return groups


def list_cached_order(what: str) -> list[Path]:
    """List the files of ``train``, ``test``, ``raw`` or ``thinned`` in their order; of a manifest of such pairs, cells in turn.

    Ordinary scans that share most are four in each turn; in the test set thirty of them come first.
    """
    if what.endswith(".jsonl"):
        lines = Path(what).read_text(encoding="utf-8").splitlines()
        scaled_too = [Path(what).parent / "grids" / json.loads(line)["file"] for line in lines]
        return list(iter_in_turn(group_by_cell(scaled_too), lambda key: 1))
    most = (ORDINARY, MOST_AREA)
    often = lambda key: COMMON_TURN if key == most else 1  # noqa: E731
    if what in ("raw", "thinned"):
        groups = {k: v for k, v in group_by_cell(list_pair_files("test")).items() if k[0] == ORDINARY and k[1] in AREA_BINS}
        return list(iter_in_turn(groups, often))[:RAW_PAIRS]
    groups = group_by_cell([*list_pair_files(what), *_list_drawings(what)])
    first = groups.get(most, [])[: FIRST_PAIRS if what == "test" else 0]
    groups[most] = groups.get(most, [])[len(first) :]
    return [*first, *iter_in_turn(groups, often)]


def _list_drawings(split: str) -> list[Path]:
    """Floor plans of a split; none where they are not made yet, as they come last."""
    try:
        return list_pair_files(f"{split}_drawings")
    except InputError as missing:
        print(missing, flush=True)
        return []


def iter_peer_pairs(what: str, done: set[str]) -> Iterator[PeerPair]:
    """Yield the pairs that are not done: of `list_cached_order`, or ``real``, or ``heldout`` (maps that `evaluate.py` kept).

    Raises:
        InputError: the cached pairs of ``raw`` were made by another version.
    """
    if what in ("real", "heldout"):
        every = iterate_real_pairs() if what == "real" else iter_heldout_pairs()
        yield from (thin_pair(pair) for pair in every if pair.name not in done)
        return
    left = [path for path in list_cached_order(what) if path.stem not in done]
    items = load_raw_items({path.stem for path in left}) if what == "raw" else {}
    if older := [path for path in left if what == "raw" and path.stem not in items]:
        command = "python evaluate.py task=merges data=test"
        raise InputError(
            f"{older[0]}: was made by another version, its points can't be simulated again; make the pairs anew: {command}"
        )
    for path in left:
        pair = load_grids(path)
        yield simulate_raw_pair(pair, *items[path.stem]) if what == "raw" else thin_pair(pair)


def thin_pair(pair: GridPair) -> PeerPair:
    """Return the means of the points of 0.1 m cells; b at the scale of a."""
    size = pair.truth.scale if pair.truth is not None else 1.0
    return PeerPair(pair, compute_cell_means(pair.b).astype(float) * size, compute_cell_means(pair.a).astype(float))


def load_raw_items(names: set[str]) -> dict[str, tuple[GridItem, Library]]:
    """Return the items of test pairs, which they can be simulated from again."""
    items, plans = draw_grid_items(read_recipe("test").data)
    return {item.name: (item, plans) for item in items if item.name in names}


def simulate_raw_pair(pair: GridPair, item: GridItem, plans: Library) -> PeerPair:
    """Return all simulated points of a cached pair; its cells are what they were.

    Raises:
        ValueError: the generator gives another pair by now.
    """
    simulated, _ = make_first_pair(item.item, list(select_plans(item.item, plans)))
    pose, truth = simulated.truth, pair.truth
    if pose is None or truth is None or np.abs(pose.matrix - truth.matrix).max() > 1e-6:
        raise ValueError(f"{pair.name}: the generator gives another pair by now")
    b, a = (cloud.points.astype(float) + cloud.shift for cloud in (simulated.b, simulated.a))
    return PeerPair(pair, b, a)


def iter_heldout_pairs() -> Iterator[GridPair]:
    """Yield held-out pairs of extracted maps that show something in common, as cells."""
    for evaluation_pair in load_set(HELDOUT):
        if evaluation_pair.transform is None or evaluation_pair.about["common"] < 1 or evaluation_pair.about["scale_free"]:
            continue
        maps = evaluation_pair.load_maps()
        a, b = (m.grid for m in maps)
        about = {key: evaluation_pair.about[key] for key in ("sensors", "source")}
        about |= {"building": str(evaluation_pair.about["building"]), "kind": "overlap", "evaluation_pair": evaluation_pair}
        free, common = (maps[0].free, maps[1].free), evaluation_pair.about["common"]
        yield GridPair(evaluation_pair.name, a, b, free, evaluation_pair.transform, common, about)


def scale_pair(pair: GridPair) -> GridPair:
    """Return the pair with b brought to the scale of a, to judge poses of methods that were given it."""
    size = pair.truth.scale if pair.truth is not None else 1.0
    if pair.truth is None or size == 1.0:
        return pair
    grid = VoxelGrid(pair.b.cells, pair.b.origin * size, pair.b.edge * size, pair.b.shape, pair.b.properties)
    return replace(pair, b=grid, free=(pair.free[0], None), truth=replace(pair.truth, scale=1.0))
