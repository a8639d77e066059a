"""No building of the evaluation, nor a sibling storey, is in training."""

from __future__ import annotations

from itertools import chain, combinations
from pathlib import Path

import pytest
from topomerge.datasets.plans import splits
from topomerge.datasets.plans.floorplans import iter_plans, siblings

from topomerge.errors import InputError

FOLDERS = Path(__file__).parents[3] / "datasets" / "plans" / "splits"


def lines(split: str) -> set[str]:
    text = (FOLDERS / f"{split}.txt").read_text()
    return {line for line in text.splitlines() if line and not line.startswith("#")}


@pytest.mark.parametrize(("one", "other"), list(combinations(splits.SPLITS, 2)))
def test_splits_are_disjoint(one: str, other: str) -> None:
    assert lines(one) and not lines(one) & lines(other)
    a, b = splits.seeds(one), splits.seeds(other)
    assert a[0] <= a[1] < b[0] <= b[1] or b[1] < a[0]


def test_what_evaluation_stands_on_never_trains() -> None:
    for source in splits.TEST_ONLY:
        assert splits.split_of(source, "whatever") == "test"
        assert not any(line.startswith(f"{source}/") for split in ("train", "validation") for line in lines(split))
    assert {"utexas", "ipa", "halmstad", "carmen", "ifc", "octomap"} <= set(splits.TEST_ONLY)
    assert not set(splits.TEST_ONLY) & set(splits.FOLDERS)


def test_plans_of_one_property_stay_together() -> None:
    where = {}
    for split in splits.SPLITS:
        for name in splits.members(split, "r2v"):
            assert where.setdefault(name.rpartition("/")[0], split) == split


def test_split_of() -> None:
    assert splits.split_of("procedural", "7") == "train"
    assert splits.split_of("procedural", "950000") == "test"
    assert splits.split_of("procedural", "office") is None
    assert splits.split_of("nowhere", "x") is None
    name = splits.members("train", "campus")[0]
    assert splits.split_of("campus", name) == "train"
    with pytest.raises(InputError, match="split 'holdout'"):
        splits.members("holdout", "r2v")


def test_groups_join_what_overlaps() -> None:
    assert splits.groups("edcba", [("a", "b"), ("d", "c"), ("b", "c"), ("x", "e")]) == [["a", "b", "c", "d"], ["e", "x"]]


def test_deal_takes_whole_groups_and_starves_no_training() -> None:
    groups = [[f"{i}/{k}" for k in range(1 + i % 3)] for i in range(40)]
    dealt = splits.deal("x", groups)
    total = sum(map(len, groups))
    assert sorted(chain(*dealt.values())) == sorted(chain(*groups))
    assert all({g[0] in dealt[s] for g in groups if set(g) & set(dealt[s])} <= {True} for s in splits.SPLITS)
    assert 0.1 * total <= len(dealt["test"]) <= 0.1 * total + 3
    assert splits.deal("x", [["a"], ["b"]])["train"]


@pytest.mark.data
@pytest.mark.slow
def test_every_plan_is_in_a_split_with_its_siblings(data_dir: Path) -> None:
    for source, folder in splits.FOLDERS.items():
        if not (data_dir / folder).is_dir():
            continue
        names = {name for name, plan in iter_plans(data_dir / folder) if hasattr(plan, "rooms")}
        where = {name: splits.split_of(source, name) for name in names}
        assert None not in where.values()
        for group in siblings(data_dir / folder):
            assert len({where[name] for name in group if name in names}) <= 1, group
