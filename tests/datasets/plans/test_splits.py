"""No building of the evaluation, nor a sibling storey, is in training."""

from __future__ import annotations

from collections.abc import Collection
from itertools import chain, combinations
from pathlib import Path

import pytest
from topomerge.datasets.core.building import Plan, find_physical_building
from topomerge.datasets.plans import splits
from topomerge.datasets.plans.floorplans import group_siblings, iter_plans, list_plan_names

from tests.datasets.plans import plan_files as write
from topomerge.errors import InputError

FOLDERS = Path(__file__).parents[3] / "datasets" / "plans" / "splits"


def lines(split: str) -> set[str]:
    text = (FOLDERS / f"{split}.txt").read_text()
    return {line for line in text.splitlines() if line and not line.startswith("#")}


@pytest.mark.parametrize(("one", "other"), list(combinations(splits.SPLITS, 2)))
def test_splits_are_disjoint(one: str, other: str) -> None:
    assert lines(one) and not lines(one) & lines(other)
    a, b = splits.get_seed_range(one), splits.get_seed_range(other)
    assert a[0] <= a[1] < b[0] <= b[1] or b[1] < a[0]


def test_what_evaluation_stands_on_never_trains() -> None:
    for source in splits.TEST_ONLY:
        assert splits.find_split(source, "whatever") == "test"
        assert not any(line.startswith(f"{source}/") for split in ("train", "validation") for line in lines(split))
    assert {"utexas", "ipa", "halmstad", "carmen", "ifc", "octomap"} <= set(splits.TEST_ONLY)
    assert not set(splits.TEST_ONLY) & set(splits.FOLDERS)


def test_plans_of_one_property_stay_together() -> None:
    where = {}
    for split in splits.SPLITS:
        for name in splits.list_members(split, "r2v"):
            assert where.setdefault(name.rpartition("/")[0], split) == split


def test_a_physical_building_is_in_one_split() -> None:
    where: dict[str, set[str]] = {}
    for split in splits.SPLITS:
        for source in splits.FOLDERS:
            for name in splits.list_members(split, source):
                where.setdefault(find_physical_building(source, name), set()).add(split)
    assert len(where) > 100 and all(len(of) == 1 for of in where.values())


def test_split_of() -> None:
    assert splits.find_split("procedural", "7") == "train"
    assert splits.find_split("procedural", "950000") == "test"
    assert splits.find_split("procedural", "office") is None
    assert splits.find_split("nowhere", "x") is None
    name = splits.list_members("train", "campus")[0]
    assert splits.find_split("campus", name) == "train"
    with pytest.raises(InputError, match="split 'holdout'"):
        splits.list_members("holdout", "r2v")


def test_groups_join_what_overlaps() -> None:
    assert splits.group_names("edcba", [("a", "b"), ("d", "c"), ("b", "c"), ("x", "e")]) == [["a", "b", "c", "d"], ["e", "x"]]


def test_deal_takes_whole_groups_and_starves_no_training() -> None:
    groups = [[f"{i}/{k}" for k in range(1 + i % 3)] for i in range(40)]
    dealt = splits.assign_splits("x", groups)
    total = sum(map(len, groups))
    assert sorted(chain(*dealt.values())) == sorted(chain(*groups))
    assert all({g[0] in dealt[s] for g in groups if set(g) & set(dealt[s])} <= {True} for s in splits.SPLITS)
    assert 0.1 * total <= len(dealt["test"]) <= 0.1 * total + 3
    assert splits.assign_splits("x", [["a"], ["b"]])["train"]


def leaks(folder: Path, source: str, listed: Collection[str]) -> list[str]:
    """What of a folder is in no split though it can be read, storeys of one building in several, and lines without a plan."""
    names = list_plan_names(folder)
    unlisted = {name for name in names if splits.find_split(source, name) is None}
    wrong = [name for name, plan in iter_plans(folder, unlisted) if name in unlisted and isinstance(plan, Plan)]
    for group in group_siblings(folder):
        where = {splits.find_split(source, name) for name in group} - {None}
        wrong += [" and ".join(group)] * (len(where) > 1)
    return [*wrong, *sorted(set(listed) - set(names))]


def test_the_guard_bites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("school1", "school2", "lonely"):
        write.campus(tmp_path / f"{name}.xml")
    (tmp_path / "bad.xml").write_text("<building/>")
    lists = {"school1": "train", "school2": "train", "lonely": "test"}
    monkeypatch.setattr(splits, "find_split", lambda source, name: lists.get(name))
    assert leaks(tmp_path, "campus", lists) == []
    lists["school2"] = "test"
    assert leaks(tmp_path, "campus", lists) == ["school1 and school2"]
    del lists["lonely"]
    assert leaks(tmp_path, "campus", [*lists, "gone"]) == ["lonely", "school1 and school2", "gone"]


@pytest.mark.longer
@pytest.mark.data
@pytest.mark.parametrize("source", splits.FOLDERS)
def test_every_plan_is_in_a_split_with_its_siblings(source: str, data_dir: Path) -> None:
    """Every file is opened for its names; a plan is read only where no list has its name."""
    folder = data_dir / splits.FOLDERS[source]
    if not folder.is_dir():
        pytest.skip(f"TOPOMERGE_DATA has no {folder.name}")
    listed = [name for split in splits.SPLITS for name in splits.list_members(split, source)]
    assert listed and leaks(folder, source, listed) == []


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("source", splits.FOLDERS)
def test_plans_with_equal_rooms_are_never_apart(source: str, data_dir: Path) -> None:
    folder = data_dir / splits.FOLDERS[source]
    plans = {name: plan for name, plan in iter_plans(folder) if isinstance(plan, Plan)}
    for group in splits.iter_relatives(source, plans):
        assert len({splits.find_split(source, name) for name in group}) == 1, group


def test_homes_that_extraction_was_chosen_by_are_no_test() -> None:
    dealt = splits.assign_splits("home", [[f"home {k}"] for k in range(20)])
    assert not dealt["test"] and len(dealt["validation"]) >= 4 and len(dealt["train"]) + len(dealt["validation"]) == 20
    assert splits.list_members("train", "home") and not splits.list_members("test", "home")
