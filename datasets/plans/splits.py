"""Which building is for training, which for validation, which for the test: text lists in `datasets/plans/splits/`.

A line names a building as `source/name` (name as of `floorplans.iter_plans`), all of a source as `source/*`, or seeds of
procedural buildings as `procedural/first..last`. Sources that evaluation stands on are in the test as a whole. Storeys of one
building, and plans of one property, are never apart. A fourth list, `sealed.txt`, is opened by the sealed run alone and goes
before all others (`plans.sealed`). The other lists were written by ``python -m topomerge.datasets.plans.splits
FOLDER``,
FOLDER being that of the real data; what came into the world since then is in no split until they are written again.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.core.building import Plan, find_physical_building
from topomerge.datasets.plans.sealed import SEALED, is_sealed, read_list, refuse_split

from topomerge.errors import InputError

SPLITS = ("train", "validation", "test")
FOLDERS = {  # source -> folder of the real data
    "r2v": "plans_r2v_apartments",
    "campus": "plans_schools_offices",
    "mall": "plans_malls",
    "rmf": "sim_rmf_buildings",
    "home": "homes_vacuum_robots",
}
TEST_ONLY = {
    "utexas": ("utexas_gdc_floors", "utexas_amrl_vectormaps"),  # one building by two surveys
    "ipa": ("grids_ipa_room_segmentation",),
    "halmstad": ("halmstad_robot_maps",),
    "carmen": ("carmen_logs",),
    "ifc": ("ifc_buildings",),
    "octomap": ("octomap_freiburg078",),
    "strands": ("grids_rose2_homes_strands",),
    "ipad": ("ipad_lidar_rooms",),
    "libpointmatcher": ("pair_libpointmatcher_apartment",),
}
DEVELOPMENT = ("home",)  # extraction was chosen by them: their share of the test goes to validation
SPLIT_SEEDS = {"train": (0, 799_999), "validation": (800_000, 899_999), "test": (900_000, 999_999)}
SHARES = {"validation": 0.1, "test": 0.1}  # of the plans of a source; the rest is for training


def find_split(source: str, name: str) -> str | None:
    """Find the split of a building, or None where no list names it. `name` is the seed of a procedural building."""
    if is_sealed(source, name):
        return SEALED
    for split in SPLITS:
        names, whole, seeds = _read(split)
        if source in whole or f"{source}/{name}" in names:
            return split
        if source == "procedural" and name.isdecimal() and seeds[0] <= int(name) <= seeds[1]:
            return split
    return None


def list_members(split: str, source: str) -> list[str]:
    """List names of the buildings of a source in a split, ascending.

    Raises:
        InputError: unknown split, or the sealed one.
    """
    names, _, _ = _read(split)
    return sorted(n.removeprefix(f"{source}/") for n in names if n.startswith(f"{source}/"))


def get_seed_range(split: str) -> tuple[int, int]:
    """Return first and last seed of the procedural buildings of a split.

    Raises:
        InputError: unknown split, or the sealed one.
    """
    return _read(split)[2]


def _read(split: str) -> tuple[frozenset[str], frozenset[str], tuple[int, int]]:
    """Read the buildings, whole sources and seeds of a split."""
    refuse_split(split)
    if split not in (*SPLITS, SEALED):
        raise InputError(f"split {split!r}: {', '.join(SPLITS)} are possible")
    return read_list(split)


def group_names(names: Iterable[str], together: Iterable[Iterable[str]]) -> list[list[str]]:
    """Return groups of names that must not be parted, as `together` says; each ascending, and the groups, too."""
    of = {name: {name} for name in names}
    for some in together:
        joined: set[str] = set().union(*(of.get(name, {name}) for name in some))
        for name in joined:
            of[name] = joined
    return sorted({id(group): sorted(group) for group in of.values()}.values())


def iter_relatives(source: str, plans: Mapping[str, Plan]) -> Iterator[list[str]]:
    """Yield plans of one property, and plans whose rooms have the same sizes: the same apartment is on offer more than once."""
    by: dict[object, list[str]] = {}
    for name, plan in plans.items():
        areas = np.sort([shapely.Polygon(room.polygon).area for room in plan.rooms])
        by.setdefault((len(areas), *np.round(areas / areas.sum(), 2).tolist()), []).append(name)
        if source == "r2v":
            by.setdefault(name.rpartition("/")[0], []).append(name)
        if source == "home":
            by.setdefault(find_physical_building(source, name), []).append(name)
    yield from by.values()


def assign_splits(source: str, drawn: list[list[str]]) -> dict[str, list[str]]:
    """Deal groups to the splits in the order of a hash of their names: the test takes its share first, one group at least."""
    order = sorted(drawn, key=lambda group: hashlib.sha256(f"{source}/{group[0]}".encode()).digest())
    total, out = sum(map(len, drawn)), {split: list[str]() for split in SPLITS}
    for k, group in enumerate(order):
        left = len(order) - k
        hungry = [s for s in ("test", "validation") if len(out[s]) < SHARES[s] * total and (left > 1 or out["train"])]
        out[hungry[0] if hungry else "train"] += group
    if source in DEVELOPMENT:
        out["validation"] += out["test"]
        out["test"] = []
    return out


def write_lists(data: Path, folder: Path) -> None:
    """Write the lists from the real data that is in `data`."""
    from topomerge.datasets.plans.floorplans import Refusal, group_siblings, iter_plans

    from topomerge.archive import replace_on_success

    lines: dict[str, list[str]] = {split: [f"procedural/{a}..{b}"] for split, (a, b) in SPLIT_SEEDS.items()}
    lines["test"] += [f"{source}/*" for source in TEST_ONLY]
    for source, name in FOLDERS.items():
        taken = {n: plan for n, plan in iter_plans(data / name) if not isinstance(plan, Refusal)}
        dealt = assign_splits(source, group_names(taken, [*group_siblings(data / name), *iter_relatives(source, taken)]))
        for split in SPLITS:
            lines[split] += sorted(f"{source}/{n}" for n in dealt[split] if n in taken)
    for split in SPLITS:
        head = f"# Buildings for {split}: written by python -m topomerge.datasets.plans.splits; see datasets/plans/splits.py\n"
        with replace_on_success(folder / f"{split}.txt") as temporary:
            temporary.write_text(head + "\n".join(lines[split]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_lists(Path(sys.argv[1]), Path(__file__).parent / "splits")
