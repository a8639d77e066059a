"""Samplers: which pairs an epoch has; each a name in a registry, and somebody else's, too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.graphs import pair, write_set
from topomerge.errors import InputError
from topomerge.registry import SAMPLERS
from topomerge.training.embedding import fit
from topomerge.training.samplers import balance_buildings, draw_pairs
from topomerge.training.settings import Training, check

PAIRS = [replace(pair(k), about={"building": "many" if k < 8 else "few"}) for k in range(10)]


def draw(seed: int, name: str = "shuffle") -> list[int]:
    """Draw the pairs of an epoch."""
    return draw_pairs(name, PAIRS, torch.Generator().manual_seed(seed)).tolist()


def test_a_shuffled_epoch_has_each_pair_once() -> None:
    assert draw(1) == draw(1) != draw(2)
    assert sorted(draw(1)) == list(range(len(PAIRS)))


def test_buildings_come_equally_often_however_many_pairs_they_have() -> None:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.cat([balance_buildings(PAIRS, generator) for _ in range(200)])
    assert (drawn >= 8).float().mean() == pytest.approx(0.5, abs=0.04)
    assert len(draw(1, "buildings")) == len(PAIRS) and draw(1, "buildings") == draw(1, "buildings")


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ([0, 1], "sampler=odd: must return 10 numbers of pairs, not torch.int64 (2,)"),
        ([0.5] * 10, "sampler=odd: must return 10 numbers of pairs, not torch.float32 (10,)"),
        ([10] * 10, "sampler=odd: the pairs are 0 to 9, not 10 to 10"),
        ("nothing", "sampler=odd: must return 10 numbers of pairs, not 'nothing'"),
    ],
)
def test_what_somebody_elses_sampler_must_return(order: object, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SAMPLERS._registered, "odd", lambda pairs, generator: order)
    with pytest.raises(InputError) as refused:
        draw(0, "odd")
    assert str(refused.value) == said


def test_an_unknown_sampler_is_one_line() -> None:
    with pytest.raises(InputError, match=r"^sampler: unknown 'nothing'; shuffle, buildings are possible"):
        check(Training(sampler="nothing"))


def test_a_training_takes_its_pairs_from_the_sampler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unexported: None) -> None:
    asked = []

    def sort_pairs(pairs: list[object], generator: torch.Generator) -> list[int]:
        asked.append((len(pairs), generator.initial_seed()))
        return list(range(len(pairs)))

    monkeypatch.setitem(SAMPLERS._registered, "sorted", sort_pairs)
    write_set(tmp_path, "some", 6)
    write_set(tmp_path, "other", 2)
    common = {"runs": str(tmp_path), "cache": str(tmp_path), "data": "some", "validation": "other", "logger": []}
    fit(Training(**common, epochs=2, batch=2, sampler="sorted"), lambda text: None)
    assert [count for count, _ in asked] == [6, 6] and asked[0][1] != asked[1][1]
