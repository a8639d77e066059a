"""One cached pair: made from an item, written as an archive of arrays, read back as tensors."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import BuildRow, make_item
from topomerge.datasets.core.building import Building, Plan
from topomerge.datasets.pairs.atlases import make_atlas
from topomerge.datasets.pairs.evaluation_pair import build_evaluation_arrays, compute_pair_statistics, save_maps
from topomerge.datasets.pairs.items import SIDES, Item, get_difficulty
from topomerge.datasets.pairs.pairs import Atlas, Pair, make_pair, simulate_signs
from topomerge.datasets.pairs.parts import find_true_matches, match_true_rooms
from topomerge.datasets.simulation.signs import READERS

from topomerge import archive
from topomerge.archive import convert_to_plain
from topomerge.embedding.graph import build_graph_arrays, convert_to_tensors
from topomerge.embedding.sheets import build_sheet_arrays
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.landmarks import add_landmarks
from topomerge.types import Array, Landmarks, PointCloud, TopometricMap

if TYPE_CHECKING:
    from torch import Tensor
    from torch_geometric.data import Data

FEWEST_ROOMS = 2  # rooms that must come out of each map
Made = TypeVar("Made")
LONGEST_PAIR = 600.0  # s of a processor: a hundred times what is usual, so that no slow machine makes another set


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


def make_file(item: Item, plans: Sequence[Sequence[Plan]], folder: str) -> BuildRow:
    """Make an item's file in a folder, or one that says why there is none (`core.builder.make_item`)."""
    return make_item(
        item.name,
        folder,
        lambda: make_evaluation_arrays(item, plans, Path(folder)) if item.maps else make_arrays(item, plans),
        LONGEST_PAIR,
    )


def make_arrays(item: Item, plans: Sequence[Sequence[Plan]]) -> dict[str, Array]:
    """Simulate, extract, judge: the arrays of an item.

    Raises:
        InputError: no candidate has such a pair, or a map has hardly a room.
    """
    if item.more:
        return build_several_maps(item, plans)
    pair, signs = make_first_pair(item, plans)
    return build_pair_arrays(pair, extract_maps((pair.a, pair.b), item, signs), describe_item(item))


def build_several_maps(item: Item, plans: Sequence[Sequence[Plan]]) -> dict[str, Array]:
    """Return the arrays of an item of three or more maps of a building: those of each map, and under "matches.ac", "transform.ac"
    and so on what is true of each two; "matches" and "transform" are those of the first two.

    Raises:
        InputError: no candidate has such walks, or a map has hardly a room.
    """
    sensors, sides = (*item.sensors, *item.more), SIDES[: 2 + len(item.more)]

    def make(k: int, rng: np.random.Generator) -> Atlas:
        return make_atlas(
            build_candidate(item, k, plans)[0], sensors, rng, item.rooms, False, get_difficulty(item), item.source, item.drifts
        )

    atlas = _make_first(item, make)
    maps = extract_maps(atlas.maps, item)
    truths = [match_true_rooms(m, cloud) for m, cloud in zip(maps, atlas.maps, strict=True)]
    arrays = _build_map_arrays(sides, maps, truths, item.points_per_room)
    for i, j in itertools.combinations(range(len(maps)), 2):
        ending = "" if (i, j) == (0, 1) else f".{sides[i]}{sides[j]}"
        arrays[f"matches{ending}"] = find_true_matches(truths[i], truths[j], atlas.shared[i, j])
        arrays[f"transform{ending}"] = (atlas.truth[i].inverse() @ atlas.truth[j]).matrix
    entries = {**describe_item(item), "building": atlas.building, "sides": sides, "sensors": list(sensors)}
    text = json.dumps(convert_to_plain({**entries, "extracted": [len(t) for t in truths]}), sort_keys=True, ensure_ascii=False)
    return arrays | {"about": np.frombuffer(text.encode(), np.uint8)}


def _build_map_arrays(
    sides: str, maps: Sequence[TopometricMap], truths: Sequence[Array], points_per_room: int
) -> dict[str, Array]:
    """Return the graph, the storeys from above and true rooms of each map."""
    arrays: dict[str, Array] = {}
    for side, map, truth in zip(sides, maps, truths, strict=True):
        arrays |= {f"{side}.{name}": array for name, array in build_graph_arrays(map, points_per_room).items()}
        arrays |= {f"{side}.{name}": array for name, array in build_sheet_arrays(map).items()}
        arrays |= {f"{side}.true_{name}": truth[name] for name in ("room", "iou", "one")}
    return arrays


def make_evaluation_arrays(item: Item, plans: Sequence[Sequence[Plan]], folder: Path) -> dict[str, Array]:
    """Make the arrays of `make_arrays` and those for evaluation (`evaluation_pair`); the maps are written into the folder."""
    pair, signs = make_first_pair(item, plans)
    maps = extract_maps((pair.a, pair.b), item, signs)
    arrays = build_pair_arrays(pair, maps, {**describe_item(item), **compute_pair_statistics(pair, maps)})
    arrays |= build_evaluation_arrays(pair, maps, (arrays["a.true_room"], arrays["b.true_room"]))
    save_maps(maps, folder, item.name)
    return arrays


def extract_maps(clouds: Sequence[PointCloud], item: Item, signs: Sequence[Landmarks] = ()) -> tuple[TopometricMap, ...]:
    """Extract the maps of clouds, with the space that rays crossed where they are kept, and the signs of each, if any.

    Raises:
        InputError: hardly a room comes out of one of them.
    """
    maps = tuple(extract(cloud, voxel_size=item.voxel_size, carve=item.maps) for cloud in clouds)
    if min(len(m.rooms) for m in maps) < FEWEST_ROOMS:
        raise InputError(f"fewer than {FEWEST_ROOMS} rooms were extracted from a map of {' or '.join(item.sensors)}")
    return tuple(add_landmarks(m, of) for m, of in zip(maps, signs, strict=True)) if signs else maps


def describe_item(item: Item) -> dict[str, Any]:
    """Describe an item as in a file; fields that came later are left out where they have their defaults."""
    entries = asdict(item)
    if not item.maps:
        del entries["maps"]
    if not item.more:
        del entries["more"]
    for name in ("drifts", "signs"):
        if not entries[name]:
            del entries[name]
    return {**entries, "file": f"{item.name}.npz", "asked_overlap": item.overlap, "points_per_room": item.points_per_room}


def build_pair_arrays(pair: Pair, maps: Sequence[TopometricMap], item_entries: Mapping[str, Any]) -> dict[str, Array]:
    """Build the arrays of a file: the graphs of two maps, their true rooms, and what stands about them."""
    truths = [match_true_rooms(m, cloud) for m, cloud in zip(maps, (pair.a, pair.b), strict=True)]
    matches = find_true_matches(truths[0], truths[1], pair.shared)
    arrays = _build_map_arrays("ab", maps, truths, item_entries["points_per_room"])
    arrays["matches"] = matches
    arrays["transform"] = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.matrix
    entries = {
        **item_entries,
        "building": pair.building,
        "overlap": round(pair.overlap, 4),
        "visited": [len(v) for v in pair.visited],
        "extracted": [len(t) for t in truths],
        "identified": [int((t["room"] >= 0).sum()) for t in truths],
        "one_to_one": [int(t["one"].sum()) for t in truths],
        "partners": [len(set(matches[:, k].tolist())) for k in (0, 1)],
        "points": [len(pair.a), len(pair.b)],
    }
    text = json.dumps(convert_to_plain(entries), sort_keys=True, ensure_ascii=False)
    arrays["about"] = np.frombuffer(text.encode(), np.uint8)
    return arrays


def make_first_pair(item: Item, plans: Sequence[Sequence[Plan]]) -> tuple[Pair, list[Landmarks]]:
    """Return the pair of the first candidate that has one, and the signs that both maps read; none without."""

    def make(k: int, rng: np.random.Generator) -> tuple[Pair, list[Landmarks]]:
        building, other = build_candidate(item, k, plans)
        pair = make_pair(building, item.pair_settings, rng, other, get_difficulty(item), item.source)
        signs = simulate_signs(building, pair, READERS[item.signs]) if item.signs else []
        return pair, signs

    return _make_first(item, make)


def _make_first(item: Item, make: Callable[[int, np.random.Generator], Made]) -> Made:
    """Make an example of the first of an item's candidates that gives one, from its number and a generator of its own."""
    refused: InputError | None = None
    for k in range(len(item.buildings)):
        try:
            return make(k, np.random.default_rng([item.seed, k]))
        except InputError as error:
            refused = error
    raise refused or InputError("an item without buildings")


def build_candidate(item: Item, k: int, plans: Sequence[Sequence[Plan]]) -> tuple[Building, Building | None]:
    """Build candidate k of an item's buildings, and its other building where the item is a hard negative that has one."""
    other = _build_building(item, len(item.buildings), plans) if item.hard == "other-building" else None
    return _build_building(item, k, plans), other


def _build_building(item: Item, k: int, plans: Sequence[Sequence[Plan]]) -> Building:
    """Build candidate k; after the last one comes the other building."""
    name = (*item.buildings, item.other[0])[k]
    if item.source == "procedural":
        return make_building(item.kind, int(name), item.storeys, get_difficulty(item))
    return build_building(plans[k], get_difficulty(item), item.seed % 100_000 + k, name, item.source)


def load_example(path: str | Path) -> Example:
    """Read a cached pair as tensors; nothing is unpickled.

    Raises:
        InputError: no such file, or it is damaged.
    """
    import torch

    arrays = archive.read(path, "cached pair")
    entries = json.loads(arrays.pop("about").tobytes())
    sides = [convert_to_tensors({n[2:]: a for n, a in arrays.items() if n.startswith(f"{s}.")}) for s in "ab"]
    matches, transform = torch.from_numpy(arrays["matches"]), torch.from_numpy(arrays["transform"])
    return Example(sides[0], sides[1], matches, transform, entries)


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
