"""Settings by Hydra: every key of a schema can be overridden without a sign before it, and a wrong one is named in one line."""

from __future__ import annotations

import pytest
from topomerge.datasets.pairs.build import Build

from topomerge.config import compose
from topomerge.errors import InputError
from topomerge.evaluation.settings import Evaluation


def test_keys_that_a_recipe_leaves_out_can_be_overridden() -> None:
    settings = compose("build", Build, ["data=procedural", "data.maps=true", "data.sources.ipa=0.5"])
    assert settings.data.maps and settings.data.sources["ipa"] == 0.5
    assert compose("build", Build, ["cluster=tcp://host:1"]).cluster == "tcp://host:1"
    assert compose("evaluate", Evaluation, ["data.maps=false", "poses=rooms"]).data.maps is False


@pytest.mark.parametrize(
    ("word", "key"),
    [("data.map=true", "data.map"), ("data.maps=many", "data.maps"), ("job=3", "job"), ("data=nowhere", "data/nowhere"),
     ("data.seed=1.5", "data.seed"), ("data.sources.ipa=often", "data.sources.ipa")],
)  # fmt: skip
def test_a_wrong_key_or_value_is_one_line_with_its_name(word: str, key: str) -> None:
    with pytest.raises(InputError, match=key) as refused:
        compose("build", Build, [word])
    assert "\n" not in str(refused.value)
